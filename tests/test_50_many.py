"""A batch of many scenes holds on to nothing, and a scene of many costs no more than a scene of a few."""

import gc
import json
import sys
from collections import Counter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from many_scenes import measured, write_scenes

from tscorr import batch, publish, rasters
from tscorr.config import load_config
from tscorr.scene import overlap

FEW, MANY, SIDE = 10, 40, 128

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="memory and files are counted in /proc")


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """Folder, result, footprint and overhead a scene of a batch of many, after one of a few; what was read."""
    few, folder = tmp_path_factory.mktemp("few"), tmp_path_factory.mktemp("many")
    batch.run(write_scenes(few, 2, side=SIDE))
    overhead_of_few = measured(write_scenes(few, FEW, side=SIDE))[3]
    hashed, compared = Counter(), []
    whole, difference = publish.digest, overlap.difference

    def digest(path, algorithm, stop=None):
        hashed[path.name] += 1
        return whole(path, algorithm, stop)

    def noted(one, two, region):
        compared.append((one[0].name, two[0].name))
        return difference(one, two, region)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publish, "digest", digest)
        patch.setattr(overlap, "difference", noted)
        result, footprint, _, overhead = measured(write_scenes(folder, MANY, side=SIDE))
    return folder, result, footprint, overhead / overhead_of_few, hashed, compared


def test_every_scene_of_many_is_done(many):
    folder, result, *_ = many
    assert [scene.state for scene in result.scenes] == ["done"] * MANY
    assert len(json.loads((folder / "out" / "batch.json").read_text())["scenes"]) == MANY
    assert (folder / "out" / "index.html").read_text().count('report.html"') == MANY


def test_no_file_no_thread_and_no_memory_is_kept_from_scene_to_scene(many):
    _, _, footprint, *_ = many
    assert len(set(footprint.files)) == 1
    assert max(footprint.threads) == footprint.threads[0]
    assert (
        footprint.growth_mb(warm_up=10) < 1
    )  # the allocator takes memory in steps; the benchmark looks at 400 scenes


def test_a_scene_of_many_costs_no_more_than_a_scene_of_a_few(many):
    assert many[3] < 1.5


def test_what_serves_all_scenes_is_hashed_once(many):
    hashed = many[4]
    assert hashed["dsm.tif"] == 1
    assert hashed["class_map.tif"] == 1
    assert hashed["line00_03.tif"] == 1


def test_the_header_of_what_serves_all_scenes_is_read_once(many, monkeypatch):
    described, describe = Counter(), rasters.describe

    def noted(path, **options):
        described[Path(path).name] += 1
        return describe(path, **options)

    monkeypatch.setattr(rasters, "describe", noted)
    batch.plan(load_config(many[0] / "city.toml"))
    assert described["class_map.tif"] == 1
    assert described["dsm.tif"] <= 2  # and once more for its heights, where they are not known yet


def test_the_largest_overlaps_are_compared_and_no_more_than_is_promised(many):
    compared = many[5]
    assert len(compared) == overlap.MOST_PAIRS
    for first, second in compared:
        (line, place), (other_line, other_place) = (
            map(int, name.removeprefix("line").split("_")) for name in (first, second)
        )
        assert abs(line - other_line) + abs(place - other_place) == 1


def test_few_pairs_of_many_scenes_are_looked_at(many):
    folder, *_ = many
    planned = batch.plan(load_config(folder / "city.toml"))
    pairs = list(overlap._neighbours([(scene, folder) for scene in planned]))
    near = {(one.name, two.name) for (one, _), (two, _) in pairs}
    meeting = {
        (one.name, two.name)
        for i, one in enumerate(planned)
        for two in planned[i + 1 :]
        if overlap.common_region(one.grid, two.grid) is not None
    }
    assert meeting <= near
    assert len(near) < 5 * MANY


def test_nothing_of_a_scene_waits_for_the_garbage_collector(tmp_path):
    config = write_scenes(tmp_path, 1, side=SIDE)
    batch.run(config)
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        batch.run(config, overwrite=True)
        gc.collect()
        rings = {type(thing).__name__ for thing in gc.garbage if type(thing).__module__.startswith("tscorr.")}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert rings == set()
