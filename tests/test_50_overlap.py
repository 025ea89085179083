"""Where scenes overlap: differences that are known beforehand, and the page of a batch that shows them."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS
from rasterio.warp import transform
from small_scene import BANDS, CELL, NORTH, SCALE, SHAPE, WEST, image_values, small_scene, write_image, write_raster

from tscorr import batch
from tscorr.config import load_config
from tscorr.correction import PixelFlag
from tscorr.grid import Block, Grid
from tscorr.scene.overlap import MOST_PAIRS, WINDOW_PX, WINDOWS, common_region, comparable, overlaps, windows

RD = CRS.from_epsg(28992)
NEGLIGIBLE, CORRECTED, UNCORRECTABLE, NOT_ASSESSED = (np.uint16(state << 6) for state in range(4))
MOVED = 3, 7
"""rows and columns by which the second scene's grid lies to the south-east of the first one's"""


def grid(shape, west=WEST, north=NORTH, cell=CELL, crs=RD):
    return Grid(crs, Affine(cell, 0, west, 0, -cell, north), shape)


def test_common_regions():
    here = grid((100, 200))
    assert common_region(here, here) == Block(0, 0, 100, 200)
    assert common_region(here, grid((100, 200), west=WEST + 10, north=NORTH - 5)) == Block(10, 20, 90, 180)
    assert common_region(here, grid((40, 50), west=WEST - 5, north=NORTH + 10)) == Block(0, 0, 20, 40)
    assert common_region(here, grid((100, 200), west=WEST + 100)) is None
    assert common_region(here, grid((100, 200), crs=None)) is None
    unnamed = grid((100, 200), crs=None)
    assert common_region(unnamed, unnamed) == Block(0, 0, 100, 200)


def test_common_regions_across_crs():
    """A square of 200 m in UTM, turned by less than 3 degrees against a grid of 1 m about the same point."""
    (x,), (y,) = transform(RD, CRS.from_epsg(32631), [84800.0], [447500.0])
    utm = Grid(CRS.from_epsg(32631), Affine(2, 0, x - 100, 0, -2, y + 100), (100, 100))
    region = common_region(grid((1000, 1000), west=84300, north=448000, cell=1), utm)
    assert 200 <= region.height <= 212
    assert 200 <= region.width <= 212
    assert abs(region.row + region.height / 2 - 500) <= 1
    assert abs(region.col + region.width / 2 - 500) <= 1


@pytest.mark.parametrize("shape", [(1, 1), (130, 700), (WINDOWS * WINDOW_PX, 90), (9000, 12000)])
def test_windows_lie_apart_inside_the_region(shape):
    region, seen = Block(5, 9, *shape), np.zeros(shape, np.uint8)
    found = list(windows(region))
    for window in found:
        seen[window.row - 5 : window.row - 5 + window.height, window.col - 9 : window.col - 9 + window.width] += 1
        assert window.row + window.height <= 5 + shape[0]
        assert window.col + window.width <= 9 + shape[1]
    assert seen.max() == 1
    assert len(found) <= WINDOWS**2
    if max(shape) <= WINDOWS * WINDOW_PX:
        assert seen.min() == 1
    else:  # spread: the last window is near the far end
        assert found[-1].row >= 5 + shape[0] * (1 - 1 / WINDOWS) - WINDOW_PX
        assert found[-1].col >= 9 + shape[1] * (1 - 1 / WINDOWS) - WINDOW_PX


def test_which_pixels_are_compared():
    states = np.array([NEGLIGIBLE, CORRECTED, UNCORRECTABLE, NOT_ASSESSED], np.uint16)
    one, two = np.meshgrid(states, states, indexing="ij")
    wanted = np.zeros((4, 4), bool)
    wanted[0, 1] = wanted[1, 0] = wanted[1, 1] = True
    np.testing.assert_array_equal(comparable(one, two), wanted)
    assert not comparable(one | PixelFlag.SATURATED, two).any()
    assert not comparable(one, two | PixelFlag.SATURATED).any()
    np.testing.assert_array_equal(comparable(one | PixelFlag.NORMAL_UNRELIABLE, two), wanted)


@pytest.fixture
def moved(tmp_path):
    """Two scenes on grids apart by whole pixels, and results made by hand.

    Over the ground that they share the images differ by 0.03 in every band, the corrected ones by 0.01. Only the
    tiles' block is flagged corrected, in the first scene.
    """
    rows, cols = MOVED
    values = image_values()
    ground = np.full((BANDS, SHAPE[0] + rows, SHAPE[1] + cols), 4000, np.int16)
    ground[:, : SHAPE[0], : SHAPE[1]] = values
    small_scene(tmp_path)
    west, north = WEST + cols * CELL, NORTH - rows * CELL
    write_image(tmp_path / "second.tif", ground[:, rows:, cols:] + 300, west=west, north=north)
    path = small_scene(tmp_path, {"name": "first"}, {"name": "second", "image": "second.tif"})
    results = []
    for scene, image, change, flag, place in (
        ("first", values, 0, CORRECTED, {}),
        ("second", ground[:, rows:, cols:], 100, NEGLIGIBLE, {"west": west, "north": north}),
    ):
        folder = tmp_path / "by_hand" / scene
        folder.mkdir(parents=True)
        write_image(folder / "corrected.tif", image + change, **place)
        flags = np.full(SHAPE, NEGLIGIBLE, np.uint16)
        if flag == CORRECTED:
            flags[6:20, 6:30] = CORRECTED
        write_raster(folder / "flags.tif", flags, **place)
        results.append(folder)
    return list(zip(batch.plan(load_config(path)), results, strict=True))


def test_the_difference_of_two_images_is_found(moved):
    (found,) = overlaps(moved)
    assert (found.first, found.second) == ("first", "second")
    assert set(found.materials) == {"roof_tile"}
    pixels, before, after = found.materials["roof_tile"]
    assert pixels == (20 - 6) * (30 - 7)  # the second scene starts at row 3, column 7
    assert before == pytest.approx(300 * SCALE)
    assert after == pytest.approx(100 * SCALE)


def test_a_scene_of_another_crs_is_compared_where_it_reaches(tmp_path):
    """Both images are uniform, so that any pixel beyond the second one's turned edge would show."""
    small_scene(tmp_path)
    (x,), (y,) = transform(RD, CRS.from_epsg(32631), [WEST + 9.0], [NORTH - 6.5])
    place = {"crs": "EPSG:32631", "west": x - 20, "north": y + 2.5}
    shape = 10, 80
    write_image(tmp_path / "image.tif", np.full((BANDS, *SHAPE), 4000, np.int16))
    write_image(tmp_path / "second.tif", np.full((BANDS, *shape), 4300, np.int16), **place)
    path = small_scene(tmp_path, {"name": "first"}, {"name": "second", "image": "second.tif"})
    write_image(tmp_path / "image.tif", np.full((BANDS, *SHAPE), 4000, np.int16))
    folders = tmp_path / "one", tmp_path / "two"
    for folder, size, value, where in zip(folders, (SHAPE, shape), (4000, 4100), ({}, place), strict=True):
        folder.mkdir()
        write_image(folder / "corrected.tif", np.full((BANDS, *size), value, np.int16), **where)
        write_raster(folder / "flags.tif", np.full(size, CORRECTED, np.uint16), **where)
    (found,) = overlaps(list(zip(batch.plan(load_config(path)), folders, strict=True)))
    pixels, before, after = found.materials["roof_tile"]
    assert 8 * 24 < pixels < 12 * 24  # ten rows of the tiles' block, askew
    assert before == pytest.approx(300 * SCALE)
    assert after == pytest.approx(100 * SCALE)


def test_the_order_of_scenes_does_not_matter(moved):
    (one,), (two,) = overlaps(moved), overlaps(moved[::-1])
    assert one.materials == two.materials


def test_scenes_that_cannot_be_compared_are_left_out(moved):
    (moved[1][1] / "flags.tif").unlink()
    assert overlaps(moved) == []


def test_the_number_of_pairs_is_bounded(moved, monkeypatch):
    calls = []
    monkeypatch.setattr("tscorr.scene.overlap.difference", lambda *pair: calls.append(pair))
    overlaps([*moved] * 8)
    assert len(calls) == MOST_PAIRS
    sizes = [region.height * region.width for _, _, region in calls]
    assert sizes == sorted(sizes, reverse=True)


def test_other_bands_are_not_compared(moved):
    scene, folder = moved[1]
    other = SimpleNamespace(wavelengths_um=(0.1, 0.2, 0.3), image=scene.image, grid=scene.grid, name="other")
    assert overlaps([moved[0], (other, folder)]) == []


# The batch.


def two_scenes(folder):
    """The small scene twice, seen into the glare and away from it."""
    away = {"name": "away", "view": {"kind": "constant", "zenith_deg": 40.0, "azimuth_deg": 180.0}}
    return small_scene(folder, {"name": "into"}, away, title="two views")


def test_a_run_leaves_a_page_of_all_scenes(tmp_path):
    path = two_scenes(tmp_path)
    batch.run(path)
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert 'href="into/report.html"' in page
    assert 'href="away/report.html"' in page
    assert page.index("into/report.html") < page.index("away/report.html")  # the worst first
    assert "roof tile" in page
    (overlap,) = json.loads((tmp_path / "out" / "batch.json").read_text(encoding="utf-8"))["overlaps"]
    assert (overlap["first"], overlap["second"]) == ("into", "away")
    pixels, before, after = overlap["materials"]["roof_tile"]
    assert before == 0  # one and the same image
    assert after > 0
    assert 0 < pixels <= np.sum(np.asarray(SHAPE)) * 100


def test_overlaps_are_not_computed_again_where_nothing_changed(tmp_path, monkeypatch):
    path = two_scenes(tmp_path)
    batch.run(path)
    first = [(tmp_path / "out" / name).read_bytes() for name in ("batch.json", "index.html")]
    with monkeypatch.context() as patch:
        patch.setattr(batch.overview, "overlaps", lambda _: pytest.fail("computed again"))
        batch.run(path)
    again = [(tmp_path / "out" / name).read_bytes() for name in ("batch.json", "index.html")]
    states = [json.loads(text)["overlaps"] for text in (first[0], again[0])]
    assert states[0] == states[1] != []
    assert b"was current" in again[1]
    (tmp_path / "out" / "batch.json").write_text("{}", encoding="utf-8")
    batch.run(path)
    assert json.loads((tmp_path / "out" / "batch.json").read_bytes())["overlaps"] == states[0]


def test_scenes_of_earlier_runs_stay_on_the_page(tmp_path):
    path = two_scenes(tmp_path)
    batch.run(path)
    batch.run(path, scenes=["into"])
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert 'href="away/report.html"' in page
    assert "of an earlier run" in page


def test_a_damaged_result_costs_the_comparison_and_nothing_else(tmp_path, monkeypatch, caplog):
    path = two_scenes(tmp_path)

    def fails(_):
        raise OSError("the disk is gone")

    monkeypatch.setattr(batch.overview, "overlaps", fails)
    assert batch.run(path).exit_code == 0
    assert "the overlaps of the scenes could not be compared: the disk is gone" in caplog.text
    assert (tmp_path / "out" / "index.html").exists()
