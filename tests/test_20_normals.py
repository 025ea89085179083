"""Window normals: closed-form planes, borders, voids, steps, tiles."""

import numpy as np
import pytest

from tscorr.errors import InputError
from tscorr.terrain.normals import HORN_HALO_PX, horn_normals, plane_fit_normals

CELLS = {"cell_x_m": 0.5, "cell_y_m": 0.8}
METHODS = [
    pytest.param(horn_normals, {}, id="horn"),
    pytest.param(plane_fit_normals, {"radius": 1}, id="fit-1"),
    pytest.param(plane_fit_normals, {"radius": 3}, id="fit-3"),
]


def plane(shape, slope_deg, aspect_deg, cell_x_m, cell_y_m):
    """Heights and normal of a plane that falls towards `aspect_deg` (clockwise from north)."""
    slope, aspect = np.deg2rad([slope_deg, aspect_deg])
    normal = np.array([np.sin(slope) * np.sin(aspect), np.sin(slope) * np.cos(aspect), np.cos(slope)])
    rows, cols = np.indices(shape)
    east, north = cols * cell_x_m, -rows * cell_y_m
    return 20.0 - (normal[0] * east + normal[1] * north) / normal[2], normal


@pytest.mark.parametrize(("method", "options"), METHODS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("slope_deg", "aspect_deg"), [(0, 0), (10, 0), (35, 90), (35, 213), (60, 300), (75, 45)])
def test_a_plane_gives_its_normal_up_to_the_border(method, options, dtype, slope_deg, aspect_deg):
    heights, normal = plane((12, 17), slope_deg, aspect_deg, **CELLS)
    result = method(heights.astype(dtype), **CELLS, **options, step_m=0.5)
    assert result.normals.dtype == np.float32
    assert result.normals.flags.c_contiguous
    tolerance = 2e-5 if dtype is np.float32 else 3e-7  # heights of 20 m in float32 step by 2e-6 m
    np.testing.assert_allclose(result.normals, np.broadcast_to(normal[:, None, None], (3, 12, 17)), atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(result.normals.astype(float), axis=0), 1, atol=3e-7)
    assert not result.unreliable.any()


def test_horn_has_the_published_weights():
    for row, col, weights in [
        (1, 1, (0, 0)),
        (0, 0, (1, -1)),
        (0, 1, (0, -2)),
        (1, 2, (-2, 0)),
        (2, 2, (-1, 1)),
    ]:
        heights = np.zeros((3, 3))
        heights[row, col] = 1.0
        east, north, up = horn_normals(heights, cell_x_m=0.5, cell_y_m=0.8).normals[:, 1, 1]
        np.testing.assert_allclose([east / up, north / up], np.array(weights) / [8 * 0.5, 8 * 0.8], rtol=1e-6)


def test_plane_fit_is_least_squares():
    rng = np.random.default_rng(1)
    heights = rng.normal(50, 1, (9, 9))
    rows, cols = np.indices((5, 5))
    design = np.column_stack([cols.ravel() * 0.5, -rows.ravel() * 0.8, np.ones(25)])
    rise_east, rise_north, _ = np.linalg.lstsq(design, heights[3:8, 2:7].ravel(), rcond=None)[0]
    east, north, up = plane_fit_normals(heights, **CELLS, radius=2).normals[:, 5, 4]
    np.testing.assert_allclose([east / up, north / up], [-rise_east, -rise_north], rtol=2e-6)


@pytest.mark.parametrize(("method", "options"), METHODS)
def test_voids_are_flagged_and_leave_finite_normals(method, options):
    heights, normal = plane((20, 20), 30, 120, **CELLS)
    heights[8:10, 7] = np.nan
    heights[0, 0] = np.nan
    result = method(heights, **CELLS, **options)
    radius = options.get("radius", 1)
    expected = np.zeros((20, 20), bool)
    expected[8 - radius : 10 + radius, 7 - radius : 8 + radius] = True
    expected[: radius + 1, : radius + 1] = True
    np.testing.assert_array_equal(result.unreliable, expected)
    # the heights that are there lie on the plane, so it is found all the same
    np.testing.assert_allclose(result.normals, np.broadcast_to(normal[:, None, None], (3, 20, 20)), atol=1e-6)


@pytest.mark.parametrize(("method", "options"), METHODS)
def test_nothing_but_voids_points_up(method, options):
    result = method(np.full((6, 5), np.nan, np.float32), **CELLS, **options)
    assert result.unreliable.all()
    np.testing.assert_array_equal(result.normals, np.broadcast_to([[[0.0]], [[0.0]], [[1.0]]], (3, 6, 5)))


@pytest.mark.parametrize(("method", "options"), METHODS)
@pytest.mark.parametrize("shape", [(0, 0), (0, 4), (1, 1), (1, 6), (6, 1), (2, 2), (2, 9)])
def test_small_arrays(method, options, shape):
    result = method(np.ones(shape, np.float32), **CELLS, **options)
    assert result.normals.shape == (3, *shape)
    assert result.unreliable.shape == shape
    assert result.unreliable.all()
    np.testing.assert_array_equal(result.normals[2], 1)


def test_step_edges_are_flagged_and_nothing_else():
    heights = np.zeros((20, 20))
    heights[:, 12:] = 3.0
    heights += np.random.default_rng(2).normal(0, 0.03, heights.shape)
    expected = np.zeros((20, 20), bool)
    expected[:, 11:13] = True
    np.testing.assert_array_equal(horn_normals(heights, cell_x_m=0.5, cell_y_m=0.5).unreliable, expected)
    expected[:, 9:15] = True
    fit = plane_fit_normals(heights, cell_x_m=0.5, cell_y_m=0.5, radius=3)
    np.testing.assert_array_equal(fit.unreliable, expected)


def test_the_step_threshold_can_be_set():
    heights = np.zeros((9, 9))
    heights[:, 5:] = 0.3
    assert not horn_normals(heights, cell_x_m=0.5, cell_y_m=0.5).unreliable.any()
    assert horn_normals(heights, cell_x_m=0.5, cell_y_m=0.5, step_m=0.2).unreliable[:, 4:6].all()
    assert plane_fit_normals(heights, cell_x_m=0.5, cell_y_m=0.5, step_m=0).unreliable[:, 4:6].all()


@pytest.mark.parametrize(
    ("method", "options", "halo"), [(horn_normals, {}, HORN_HALO_PX), (plane_fit_normals, {"radius": 2}, 2)]
)
def test_a_tile_with_its_halo_equals_the_whole(method, options, halo):
    rng = np.random.default_rng(3)
    heights = rng.normal(0, 0.4, (40, 50)).astype(np.float32)
    heights[12:14, 30] = np.nan
    whole = method(heights, **CELLS, **options)
    tile = method(heights[10 - halo : 25 + halo, 20 - halo : 41 + halo], **CELLS, **options)
    inner = np.s_[halo : halo + 15, halo : halo + 21]
    np.testing.assert_array_equal(tile.unreliable[inner], whole.unreliable[10:25, 20:41])
    np.testing.assert_array_equal(tile.normals[:, *inner], whole.normals[:, 10:25, 20:41])


def test_layout_and_byte_order_of_the_input_do_not_matter():
    heights = np.random.default_rng(4).normal(0, 1, (11, 13)).astype(np.float32)
    expected = horn_normals(heights, **CELLS).normals
    np.testing.assert_array_equal(horn_normals(np.asfortranarray(heights), **CELLS).normals, expected)
    padded = np.zeros((22, 26), np.float32)
    padded[::2, ::2] = heights
    np.testing.assert_array_equal(horn_normals(padded[::2, ::2], **CELLS).normals, expected)


def test_a_window_needs_a_radius():
    with pytest.raises(InputError, match="radius is 0"):
        plane_fit_normals(np.zeros((4, 4)), **CELLS, radius=0)
