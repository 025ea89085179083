"""The benchmark against a copy runs, on a small city, and says what it measured."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rasterio._env import get_gdal_config

from tscorr import rasters
from tscorr.scene.run import Pipeline

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
import against_copy
import city
import measuring

SIZE = 128


@pytest.fixture
def quick(monkeypatch):
    """Runs that cost nothing: what a section asks for is what counts."""
    asked = []
    monkeypatch.setattr(against_copy, "run", asked.append)
    monkeypatch.setattr(against_copy, "gdal_copy", asked.append)
    monkeypatch.setattr(against_copy, "peak_mb", lambda _: 300.0)
    return asked


def measured(folder, *only, **keys):
    lines = list(against_copy.measure(folder, size=SIZE, pairs=1, only=only, **keys))
    assert not list(folder.iterdir())  # the scenes are deleted
    return {line.name: line for line in lines}


@pytest.mark.parametrize("interleave", ["pixel", "band"])
def test_run_and_copies_of_a_small_city(tmp_path, interleave):
    found = measured(tmp_path, "ratios", only_codec="none", only_interleave=interleave)
    of = f"uncompressed, by {interleave}: "
    assert 0.05 < found[of + "share of pixels in a lobe"].wall < 0.25
    for name in ("run / N", "run / G", "flat run / G", "run that is not published / G"):
        assert found[of + name].wall > 0
        assert found[of + name].cpu > 0
    assert found[of + "run / N"].most == (1.25 if interleave == "pixel" else 1.7)


def test_defaults_cog_and_report(tmp_path):
    found = measured(tmp_path, "defaults")
    assert 0 < found["report and quicklook / plain run, ZSTD 1"].wall < 1
    assert found["COG / run, ZSTD 1"].most == 3.3


def test_the_other_sections_name_their_bars(tmp_path, quick):
    found = measured(tmp_path, "difference", "workers", "memory", "growth", "sight")
    assert found["vrt / run, zstd"].most == 0.7
    assert found["2 % of the tiles, vrt / run of all, deflate"].most == 0.15
    assert found["one worker / two workers, zstd"].least == 1.6
    assert found["peak memory, six times as wide, MB"].most == 450
    assert f"time of a pixel, {2 * SIZE} / {int(0.2 * SIZE)} columns" in found
    assert found["cast shadow, sun at 45 deg / normals"].most == 5
    assert quick


def test_the_table_and_its_file_say_what_is_missed():
    lines = [measuring.Ratio("slow", 2.0, 1.5, most=1.3), measuring.Ratio("fast", 2.0, least=1.6)]
    text = measuring.table(lines)
    assert [line.endswith("MISSED") for line in text.splitlines()] == [False, True, False]
    assert json.loads(measuring.as_json(lines))[0] == {
        "name": "slow",
        "wall": 2.0,
        "cpu": 1.5,
        "most": 1.3,
        "least": None,
    }


def test_a_city_is_the_same_whatever_it_is_stored_as(tmp_path):
    one = city.make_city(tmp_path / "a", 100, 150, codec="none", tile=32)
    other = city.make_city(tmp_path / "b", 100, 150, codec="deflate", interleave="band", tile=32)
    for name in ("image.tif", "class_map.tif", "dsm.tif"):
        a, b = (rasters.describe(path.with_name(name)) for path in (one, other))
        with rasters.Reader(a) as first, rasters.Reader(b) as second:
            block = rasters.reading.Block(0, 0, 100, 150)
            np.testing.assert_array_equal(first.read(block), second.read(block))


def test_the_cache_of_gdal_is_small_in_every_thread_of_a_run(tmp_path, monkeypatch):
    image = city.make_city(tmp_path, 64, 64, tile=16)
    sizes = set()
    block = Pipeline.block

    def looking(self, part):
        sizes.add(get_gdal_config("GDAL_CACHEMAX"))
        count = block(self, part)
        sizes.add(get_gdal_config("GDAL_CACHEMAX"))
        return count

    monkeypatch.setattr(Pipeline, "block", looking)
    against_copy.run(city.write_config(image, workers=2))
    assert sizes == {32 << 20}  # not a twentieth of the machine's memory
