"""strips: a scene done strip by strip and joined has the values, flags and sums of the scene done at once."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from small_scene import (
    BANDS,
    class_map,
    heights,
    read_raster,
    write_config,
    write_image,
    write_raster,
)

from tscorr import batch, publish, rasters
from tscorr.config import load_config
from tscorr.correction import FLAG_VALUES
from tscorr.errors import InputError
from tscorr.scene import correct, strips
from tscorr.scene.overlap import overlaps
from tscorr.scene.sums import Sums

PRODUCTS = ["corrected", "flags", "removed", "azimuthal_width", "angles"]
TIMES = {"seconds", "peak_rss_mb", "mpixel_per_s"}
REPEATS = 27
"""of the small scene, from north to south: three rows of units, the last one short"""
SPLIT_MPIXEL = 0.04


def tall_inputs(folder):
    """A scene that is cut into three strips; each wall and ridge casts its shadow over edges of strips too."""
    classes, dsm = (np.tile(values, (REPEATS, 1)) for values in (class_map(), heights()))
    rng = np.random.default_rng(3)
    towers = rng.integers(0, dsm.shape[0] - 8, 60)
    for row, col in zip(towers, rng.integers(0, dsm.shape[1] - 8, 60), strict=True):
        dsm[row : row + 6, col : col + 5] = 14.0
    dsm[524:530, 35:40] = 14.0  # its shadow falls north, over the edge at row 512
    image = rng.integers(3000, 6000, (BANDS, *classes.shape)).astype(np.int16)
    write_image(folder / "image.tif", image)
    write_raster(folder / "class_map.tif", classes)
    write_raster(folder / "dsm.tif", dsm)


def planned(folder, name, **changes):
    """The tall scene with all products and a low sun."""
    config = write_config(
        folder,
        {"sun": {"zenith_deg": 60.0, "azimuth_deg": 170.0}, **changes},
        output={"directory": name, "quicklook": True, "products": PRODUCTS},
        run={"workers": 1},
    )
    (scene,) = batch.plan(load_config(config))
    return scene


def cut_of(scene, order=(2, 0, 1)):
    """The strips of a scene, done but not joined."""
    cut = strips.Strips(scene, SPLIT_MPIXEL)
    strips.prepare(cut)
    for number in order:
        strips.correct_strip(cut, number)
    return cut


def without_times(report):
    return {key: value for key, value in report.items() if key not in TIMES}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("strips")
    tall_inputs(folder)
    return folder


@pytest.fixture(scope="module")
def both(inputs):
    """Folders and reports of the scene done at once and in strips."""
    report = correct.correct_scene(planned(inputs, "whole"))
    joined = strips.join(cut_of(planned(inputs, "cut")), 1.0)
    return inputs / "whole/roofs", report, inputs / "cut/roofs", joined


@pytest.mark.parametrize("product", PRODUCTS)
def test_values_and_header_are_those_of_the_whole(both, product):
    whole, _, cut, _ = both
    with rasterio.open(whole / f"{product}.tif") as one, rasterio.open(cut / f"{product}.vrt") as two:
        assert one.read().tobytes() == two.read().tobytes()
        for what in (
            "crs",
            "transform",
            "shape",
            "dtypes",
            "scales",
            "offsets",
            "descriptions",
            "units",
            "colorinterp",
        ):
            assert getattr(one, what) == getattr(two, what), what
        np.testing.assert_equal(one.nodata, two.nodata)
        assert one.tags() == two.tags()
        for band in one.indexes:
            for domain in (None, "IMAGERY"):
                assert one.tags(band, ns=domain) == two.tags(band, ns=domain)


def test_the_shadows_of_the_scene_reach_over_the_edges_of_strips(both):
    """Else the test above would not see a strip that sweeps for itself."""
    flags = read_raster(both[0] / "flags.tif")[0]
    assert ((flags[510:512] & 8 > 0) & (flags[512:514] & 8 > 0)).any()


def test_the_report_is_that_of_the_whole_but_for_its_times(both):
    _, whole, _, cut = both
    assert without_times(whole) == without_times(cut)


def test_the_folder_holds_one_file_a_strip_and_verifies(both):
    _, _, cut, _ = both
    for product in PRODUCTS:
        assert len(list(cut.glob(f"{product}.????.tif"))) == 3
    assert publish.damaged(cut) == []
    assert [path.name for path in cut.parent.glob(".*")] == []
    assert (cut / "quicklook.png").exists()


def test_the_folder_can_be_moved(both, tmp_path):
    whole, _, cut, _ = both
    shutil.copytree(cut, tmp_path / "elsewhere")
    assert (read_raster(tmp_path / "elsewhere/flags.vrt") == read_raster(whole / "flags.tif")).all()


def test_the_stac_item_names_the_vrt_and_its_strips(both):
    _, _, cut, _ = both
    assets = json.loads((cut / "item.json").read_text())["assets"]
    assert assets["corrected"]["href"] == "./corrected.vrt"
    for asset in assets.values():
        assert (cut / asset["href"]).exists()
    named = {asset["href"].removeprefix("./") for asset in assets.values()}
    assert {path.name for path in cut.glob("*.tif")} <= named


def test_overlaps_read_a_joined_scene(both, inputs):
    whole, _, cut, _ = both
    scenes = planned(inputs, "whole"), planned(inputs, "cut")
    (shared,) = overlaps([(scenes[0], whole), (scenes[1], cut)])
    assert set(shared.materials) == {"roof_tile", "red_aluminum"}
    assert all(difference.rmse_after == 0 for difference in shared.materials.values())


def test_a_vrt_from_elsewhere_is_still_refused(both):
    with pytest.raises(InputError, match=r"flags\.vrt cannot be read"):
        rasters.describe(both[2] / "flags.vrt")


def test_steps_done_twice_or_half_leave_no_trace(both, inputs):
    whole, report, _, _ = both
    scene = planned(inputs, "again")
    cut = cut_of(scene, order=(1, 1, 0))
    half = cut.part(2).with_name(".0002.abcdef01.part")
    half.mkdir()
    (half / "flags.tif").write_bytes(b"half a file")
    strips.prepare(cut)
    with pytest.raises(FileNotFoundError):
        strips.join(cut, 1.0)
    assert not correct.target_of(scene).exists()
    before = {path: path.stat().st_mtime_ns for path in cut.part(1).iterdir()}
    cut_of(scene)
    assert {path: path.stat().st_mtime_ns for path in cut.part(1).iterdir()} == before
    assert without_times(strips.join(cut, 1.0)) == without_times(report)
    assert (read_raster(inputs / "again/roofs/corrected.vrt") == read_raster(whole / "corrected.tif")).all()
    assert [path.name for path in (inputs / "again").glob(".*")] == []


def test_sums_survive_their_way_through_json(inputs):
    scene = planned(inputs, "sums")
    sums = Sums(len(scene.materials), BANDS)
    rng = np.random.default_rng(1)
    sums.flags[rng.integers(0, FLAG_VALUES, 50)] = 2**53 + 1
    for values in sums.tally:
        values[...] = rng.integers(0, 2**62, values.shape) if values.dtype.kind == "i" else rng.random(values.shape)
    again = Sums(len(scene.materials), BANDS)
    strips.add_sums(again, json.loads(json.dumps(strips.plain_sums(sums))))
    assert (again.flags == sums.flags).all()
    for name, values in sums.tally._asdict().items():
        if name != "extremes":
            assert (getattr(again.tally, name) == values).all(), name
    assert (again.tally.extremes[:, 0] == sums.tally.extremes[:, 0]).all()


@pytest.mark.parametrize(("split_mpixel", "rows"), [(400, [1296]), (0.066, [1024, 272]), (1e-6, [512, 512, 272])])
def test_strips_are_whole_rows_of_units(inputs, split_mpixel, rows):
    cut = strips.Strips(planned(inputs, "none"), split_mpixel)
    assert [block.height for block in cut.blocks] == rows
    assert sum(block.height * block.width for block in cut.blocks) == 1296 * 64


def test_envi_files_are_not_cut(inputs):
    scene = planned(inputs, "envi")
    output = scene.config.output.model_copy(update={"format": "envi"})
    scene = replace(scene, config=scene.config.model_copy(update={"output": output}))
    assert len(strips.Strips(scene, SPLIT_MPIXEL).blocks) == 1


def test_strips_of_another_version_of_the_result_are_cleared(inputs):
    scene = planned(inputs, "cleared")
    mine = strips.Strips(scene, SPLIT_MPIXEL).folder
    others = [mine.with_name(".roofs.000000000000-512.strips"), mine.with_name(".roofs2.0000-512.strips")]
    for folder in (mine, *others):
        folder.mkdir(parents=True)
    strips.clear(scene, keep=mine)
    assert mine.exists()
    assert not others[0].exists()
    assert others[1].exists()
