"""Roof planes: made-up roofs with a closed form, the ray-traced sample, real roofs of Zurich."""

import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
from cityjson_roofs import angle_deg, rasterise, roof_polygons

from tscorr.terrain.roof_planes import HALO_PX, height_noise, roof_planes

SAMPLE = Path(__file__).parents[1] / "samples" / "delft"
CELLS = {"cell_x_m": 0.5, "cell_y_m": 0.5}


def read(name):
    with rasterio.open(SAMPLE / name) as file:
        return file.read().squeeze()


def gable(shape=(60, 80), slope_deg=35.0, turn_deg=30.0, cell_x_m=0.5, cell_y_m=0.5):
    """Heights, normals (3, rows, cols) and distance from the ridge of a gable roof over the whole array."""
    slope, turn = np.deg2rad([slope_deg, turn_deg])
    rows, cols = np.indices(shape)
    east, north = (cols - shape[1] / 2) * cell_x_m, (shape[0] / 2 - rows) * cell_y_m
    across = east * np.sin(turn) + north * np.cos(turn)  # to the right of the ridge, seen along it
    side = np.where(across > 0, 1.0, -1.0)
    normals = np.stack(
        [
            side * np.sin(slope) * np.sin(turn),
            side * np.sin(slope) * np.cos(turn),
            np.full(shape, np.cos(slope)),
        ]
    )
    return 30 - np.abs(across) * np.tan(slope), normals, np.abs(across)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("noise_m", [0.0, 0.03])
@pytest.mark.parametrize("slope_deg", [5.0, 35.0, 60.0])
def test_a_gable_keeps_both_faces_up_to_the_ridge(dtype, noise_m, slope_deg):
    cells = {"cell_x_m": 0.4, "cell_y_m": 0.6}
    heights, truth, distance = gable(slope_deg=slope_deg, **cells)
    heights = heights + np.random.default_rng(1).normal(0, noise_m, heights.shape)
    result = roof_planes(heights.astype(dtype), **cells, noise_m=noise_m)
    error = angle_deg(result.normals.astype(float), truth)
    # what the noise of each face's plane moves the ridge by; 1 mm where there is none
    unsure = 0.02 / np.tan(np.deg2rad(slope_deg)) if noise_m else 1e-3
    wrong = error[distance > unsure] > (0.15 if noise_m else 0.01)
    assert wrong.mean() < 0.001  # at a ridge of 5 degrees a height of 3 sigma is lost
    assert slope_deg == 5.0 or not wrong.any()
    assert np.median(error) < 0.1
    np.testing.assert_allclose(np.linalg.norm(result.normals.astype(float), axis=0), 1, atol=3e-7)
    assert result.normals.dtype == np.float32
    assert result.normals.flags.c_contiguous
    assert result.unreliable[distance > 1.0].sum() == 0


def test_a_valley_is_kept_as_a_ridge_is():
    heights, truth, distance = gable()
    heights, truth = 60 - heights, truth * [[[-1]], [[-1]], [[1]]]
    result = roof_planes(heights + np.random.default_rng(2).normal(0, 0.03, heights.shape), **CELLS, noise_m=0.03)
    assert angle_deg(result.normals.astype(float), truth)[distance > 0.03].max() < 0.15


def test_walls_stay_sharp():
    rng = np.random.default_rng(3)
    heights, roof, _ = gable((60, 60), slope_deg=25)
    rows, cols = np.indices(heights.shape)
    house = (abs(rows - 30) < 15) & (abs(cols - 30) < 12)
    truth = np.where(house, roof, np.array([0, 0, 1.0])[:, None, None])
    heights = np.where(house, heights, 20.0) + rng.normal(0, 0.03, heights.shape)
    result = roof_planes(heights.astype(np.float32), **CELLS, noise_m=0.03)
    error = angle_deg(result.normals.astype(float), truth)
    assert (error < 0.4).mean() > 0.998
    assert (result.unreliable & (error < 1)).mean() < 0.005


def test_a_flat_surface_points_up_exactly():
    result = roof_planes(np.full((30, 40), 12.5, np.float32), **CELLS)
    np.testing.assert_array_equal(result.normals[:2], 0)
    np.testing.assert_array_equal(result.normals[2], 1)
    assert not result.unreliable.any()
    assert result.sigma_deg.max() < 0.1


def test_voids_are_unreliable_and_finite():
    heights, truth, distance = gable()
    heights[20:24, 30:33] = np.nan
    heights[0, 0] = np.nan
    heights[50, 50] = np.inf
    result = roof_planes(heights, **CELLS, noise_m=0.0)
    void = ~np.isfinite(heights)
    assert np.isfinite(result.normals).all()
    assert result.unreliable[void].all()
    assert not result.unreliable[~void & (distance > 1)].any()
    assert angle_deg(result.normals.astype(float), truth)[~void & (distance > 0.01)].max() < 0.01


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (1, 1), (1, 9), (9, 1), (2, 2), (3, 3), (5, 5)])
@pytest.mark.parametrize("value", [7.0, np.nan])
def test_small_arrays_and_nothing_but_voids(shape, value):
    result = roof_planes(np.full(shape, value, np.float32), **CELLS)
    assert result.normals.shape == (3, *shape)
    assert result.unreliable.shape == result.sigma_deg.shape == shape
    np.testing.assert_array_equal(result.normals[2], 1)
    assert np.isfinite(result.sigma_deg).all()
    if np.isnan(value) or min(shape) < 3:
        assert result.unreliable.all()


def test_what_is_no_plane_is_unreliable():
    heights = np.random.default_rng(4).normal(0, 2, (40, 40))
    result = roof_planes(heights, **CELLS, noise_m=0.03)
    assert np.isfinite(result.normals).all()
    assert result.unreliable.mean() > 0.95


@pytest.mark.parametrize(("slope_deg", "aspect_deg"), [(0, 0), (30, 70), (50, 200)])
def test_sigma_is_the_scatter_of_the_normals(slope_deg, aspect_deg):
    rng = np.random.default_rng(5)
    slope, aspect = np.deg2rad([slope_deg, aspect_deg])
    truth = np.array([np.sin(slope) * np.sin(aspect), np.sin(slope) * np.cos(aspect), np.cos(slope)])
    rows, cols = np.indices((9, 22))
    plane = -(truth[0] * cols * 0.5 - truth[1] * rows * 0.8) / truth[2]
    plane[abs(cols - 1.5 * rows - 5) > 4] = np.nan  # a slanting face: the errors of the two slopes go together
    errors, sigmas = [], []
    for _ in range(300):
        heights = plane + rng.normal(0, 0.03, plane.shape)
        result = roof_planes(heights, cell_x_m=0.5, cell_y_m=0.8, noise_m=0.03)
        errors.append(angle_deg(result.normals[:, 4, 11].astype(float), truth))
        sigmas.append(result.sigma_deg[4, 11])
    assert np.median(sigmas) == pytest.approx(np.sqrt(np.mean(np.square(errors)) / 2), rel=0.12)


@pytest.mark.parametrize("noise_m", [0.01, 0.03, 0.1])
def test_noise_is_found_on_a_roof_with_walls_and_water(noise_m):
    rng = np.random.default_rng(6)
    heights, _, _ = gable((200, 200))
    heights = heights + 8.0 * (rng.random(heights.shape) < 0.02) + rng.normal(0, noise_m, heights.shape)
    heights[:60] = 0.25  # flattened water
    heights[150:160, 20:30] = np.nan
    assert height_noise(heights) == pytest.approx(noise_m, rel=0.1)


def test_noise_of_nothing_is_zero():
    for heights in (np.zeros((0, 0)), np.ones((2, 9)), np.ones((9, 9)), np.full((9, 9), np.nan)):
        assert height_noise(heights) == 0.0


def test_the_same_input_gives_the_same_bytes():
    heights, _, _ = gable()
    heights = heights + np.random.default_rng(7).normal(0, 0.03, heights.shape)
    first, again = (roof_planes(heights, **CELLS) for _ in range(2))
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    fortran = roof_planes(np.asfortranarray(heights), **CELLS)
    np.testing.assert_array_equal(fortran.normals, first.normals)


def test_ray_traced_roofs_of_the_sample():
    heights, classes, truth = read("dsm_noisy.tif"), read("class_map.tif"), read("truth/normals.tif")
    assert height_noise(heights) == pytest.approx(0.03, rel=0.1)
    result = roof_planes(heights, **CELLS, noise_m=0.03)
    roof = (classes >= 1) & (classes <= 4)
    error = angle_deg(result.normals.astype(float), truth)[roof]
    flagged = result.unreliable[roof]
    assert np.median(error) < 0.15
    assert np.percentile(error, 95) < 0.8
    assert (error > 10).mean() < 0.01
    assert (flagged & (error > 10)).sum() > 0.5 * (error > 10).sum()
    assert flagged.mean() < 0.03


def test_a_tile_with_its_halo_equals_the_whole_nearly():
    heights = read("dsm_noisy.tif")
    whole = roof_planes(heights, **CELLS, noise_m=0.03)
    row, col, size = 150, 200, 256
    tile = roof_planes(
        heights[row - HALO_PX : row + size + HALO_PX, col - HALO_PX : col + size + HALO_PX],
        **CELLS,
        noise_m=0.03,
    )
    inner = np.s_[HALO_PX : HALO_PX + size, HALO_PX : HALO_PX + size]
    outer = np.s_[row : row + size, col : col + size]
    difference = angle_deg(tile.normals[:, *inner].astype(float), whole.normals[:, *outer].astype(float))
    assert (difference < 0.1).mean() > 0.985
    assert (difference < 1.0).mean() > 0.997
    assert (tile.unreliable[inner] != whole.unreliable[outer]).mean() < 0.001


@pytest.mark.skipif("TSCORR_TEST_DATA" not in os.environ, reason="needs the folder TSCORR_TEST_DATA")
@pytest.mark.parametrize(
    ("cell_m", "noise_m", "limit_deg"),
    [
        (0.25, 0.03, 0.1),
        (0.5, 0.0, 0.01),
        (0.5, 0.03, 0.1),
        (0.5, 0.1, 0.3),
        (1.0, 0.0, 0.01),
        (1.0, 0.1, 0.5),
    ],
)
def test_real_roofs(cell_m, noise_m, limit_deg):
    rng = np.random.default_rng(8)
    errors = []
    for surfaces in roof_polygons(Path(os.environ["TSCORR_TEST_DATA"]) / "cityjson/zurich_subset_lod2.json"):
        raster = rasterise(surfaces, cell_m)
        heights = raster.heights + rng.normal(0, noise_m, raster.heights.shape)
        normals = roof_planes(heights.astype(np.float32), cell_x_m=cell_m, cell_y_m=cell_m, noise_m=noise_m).normals
        large = (raster.faces > 0) & (raster.areas[raster.faces] > 10)
        errors.append(angle_deg(normals.astype(float), raster.normals)[large])
    assert np.median(np.concatenate(errors)) < limit_deg
