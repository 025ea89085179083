"""Where pixels are: blocks cover each once, coordinates there and back, convergence in closed form."""

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS

from tscorr.errors import InputError
from tscorr.grid import Block, Grid, blocks, convergence_deg, longitude_latitude, reproject

WGS84 = CRS.from_epsg(4326)
NORTH_UP = Affine(0.5, 0, 84664, 0, -0.5, 447719)
TURNED = Affine.translation(1000, 2000) @ Affine.rotation(30) @ Affine.scale(2, -3)


def grid_at(epsg, longitude, latitude):
    """A grid of 1 m pixels around a place, and the place's map coordinates."""
    crs = CRS.from_epsg(epsg)
    x, y = (float(value) for value in reproject(WGS84, crs, longitude, latitude))
    return Grid(crs, Affine(1, 0, x - 50, 0, -1, y + 50), (100, 100)), x, y


@pytest.mark.parametrize("shape", [(0, 5), (1, 1), (7, 11), (64, 64), (65, 1)])
@pytest.mark.parametrize("block_shape", [(1, 1), (3, 4), (64, 64), (100, 2)])
def test_blocks_cover_each_pixel_once_in_row_order(shape, block_shape):
    count = np.zeros(shape, int)
    order = []
    for block in blocks(shape, block_shape):
        assert count[block.slices].shape == block.shape
        assert 0 < block.height <= block_shape[0]
        assert 0 < block.width <= block_shape[1]
        count[block.slices] += 1
        order.append((block.row, block.col))
    assert np.all(count == 1)
    assert order == sorted(order)


def test_block_as_window_slices_and_with_a_margin():
    block = Block(10, 20, 3, 4)
    assert block.window.toslices() == block.slices == (slice(10, 13), slice(20, 24))
    assert block.padded(2) == Block(8, 18, 7, 8)


@pytest.mark.parametrize("transform", [NORTH_UP, TURNED], ids=["north up", "turned"])
def test_rowcol_is_the_inverse_of_xy(transform):
    grid = Grid(None, transform, (40, 60))
    row, col = np.meshgrid(np.linspace(-3, 43, 9), np.linspace(0, 59, 8), indexing="ij")
    np.testing.assert_allclose(grid.rowcol(*grid.xy(row, col)), [row, col], atol=1e-8)
    assert grid.xy(-0.5, -0.5) == pytest.approx(transform @ (0, 0))
    assert grid.xy(2, 3) == pytest.approx(transform @ (3.5, 2.5))
    assert grid.center == pytest.approx(transform @ (30, 20))
    np.testing.assert_allclose(
        np.transpose(grid.corners()), [transform @ corner for corner in ((0, 0), (60, 0), (60, 40), (0, 40))]
    )


@pytest.mark.parametrize("transform", [NORTH_UP, TURNED], ids=["north up", "turned"])
@pytest.mark.parametrize("block", [Block(5, 7, 10, 20), Block(-2, -3, 50, 70)], ids=["inside", "beyond"])
def test_a_crop_keeps_its_pixels_where_they_were(transform, block):
    grid = Grid(CRS.from_epsg(28992), transform, (40, 60))
    crop = grid.crop(block)
    assert (crop.crs, crop.shape) == (grid.crs, block.shape)
    np.testing.assert_allclose(crop.xy(1, 2), grid.xy(block.row + 1, block.col + 2))


def test_cell_size_and_orientation():
    assert Grid(None, NORTH_UP, (4, 4)).cell_size == (0.5, 0.5)
    assert Grid(None, TURNED, (4, 4)).cell_size == pytest.approx((2, 3))
    assert Grid(None, NORTH_UP, (4, 4)).is_north_up
    assert not Grid(None, TURNED, (4, 4)).is_north_up
    assert not Grid(None, Affine(0.5, 0, 0, 0, 0.5, 0), (4, 4)).is_north_up


def test_longitude_and_latitude_of_the_delft_scene():
    """samples/delft/truth/angles.json, scene_centre; 1e-6 degrees are 0.1 m."""
    grid = Grid(CRS.from_epsg(28992), NORTH_UP, (576, 848))
    assert grid.center == (84876.0, 447575.0)
    np.testing.assert_allclose(longitude_latitude(grid, *grid.center), [4.36575994, 52.01210095], atol=3e-6)


def test_reproject_keeps_x_first_and_the_shape():
    x, y = reproject(WGS84, CRS.from_epsg(3857), [[0.0, 180.0]], 0.0)
    np.testing.assert_allclose([x, y], [[[0, np.pi * 6378137]], [[0, 0]]], atol=1e-6)
    x, y = reproject(WGS84, WGS84, 4.0, [51.0, 52.0])
    np.testing.assert_array_equal([x, y], [[4, 4], [51, 52]])


def test_convergence_of_the_dutch_grid():
    """samples/delft/truth/angles.json: on the grid's own ellipsoid (Bessel), ours on WGS 84."""
    grid = Grid(CRS.from_epsg(28992), NORTH_UP, (576, 848))
    assert convergence_deg(grid, *grid.center) == pytest.approx(-0.80596283, abs=0.0005)


@pytest.mark.parametrize(
    ("epsg", "central", "longitude", "latitude"),
    [
        (32631, 3, 5.9, 52.0),
        (32631, 3, 0.1, 52.0),
        (32633, 15, 15.0, 48.0),
        (32633, 15, 17.0, 0.5),
        (32756, 153, 151.2, -33.9),  # Sydney, west of its meridian in the south: positive
        (32719, -69, -70.6, -53.0),
        (32719, -69, -66.2, -53.0),
    ],
)
def test_convergence_of_utm_in_closed_form(epsg, central, longitude, latitude):
    """Transverse Mercator on an ellipsoid: gamma = d sin(phi) (1 + d^2 cos^2(phi) / 3 (1 + 3 eta^2 + 2 eta^4)).

    Snyder, Map projections: a working manual, USGS 1987; the leading terms are those of the
    sphere, atan(tan(d) sin(phi)).
    """
    grid, x, y = grid_at(epsg, longitude, latitude)
    d, phi = np.deg2rad([longitude - central, latitude])
    sphere = np.rad2deg(np.arctan(np.tan(d) * np.sin(phi)))
    eta2 = 0.00673949674 * np.cos(phi) ** 2
    series = np.rad2deg(d * np.sin(phi) * (1 + (d * np.cos(phi)) ** 2 / 3 * (1 + 3 * eta2 + 2 * eta2**2)))
    assert convergence_deg(grid, x, y) == pytest.approx(sphere, abs=1e-4)
    assert convergence_deg(grid, x, y) == pytest.approx(series, abs=5e-6)


@pytest.mark.parametrize(
    ("epsg", "longitude", "latitude", "expected"),
    [
        (3413, -45.0, 70.0, 0.0),
        (3413, 15.0, 80.0, 60.0),
        (3413, -150.0, 65.0, -105.0),
        (3031, 0.0, -75.0, 0.0),
        (3031, 60.0, -75.0, -60.0),
        (3031, -130.0, -70.0, 130.0),
    ],
)
def test_convergence_of_a_polar_grid_is_its_longitude(epsg, longitude, latitude, expected):
    grid, x, y = grid_at(epsg, longitude, latitude)
    assert convergence_deg(grid, x, y) == pytest.approx(expected, abs=1e-5)


def test_convergence_of_longitude_and_latitude_is_zero():
    grid = Grid(WGS84, Affine(1e-5, 0, 4, 0, -1e-5, 52), (10, 10))
    assert convergence_deg(grid, 4.0, 52.0) == pytest.approx(0, abs=1e-12)


def test_without_a_crs_there_is_no_north():
    grid = Grid(None, NORTH_UP, (10, 10))
    with pytest.raises(InputError, match="no CRS"):
        convergence_deg(grid, 0, 0)
    with pytest.raises(InputError, match="no CRS"):
        longitude_latitude(grid, 0, 0)


def test_a_point_off_the_map_has_no_convergence():
    grid = Grid(CRS.from_epsg(32631), NORTH_UP, (10, 10))
    with pytest.raises(InputError, match="no place in EPSG:4326"):
        convergence_deg(grid, 1e9, 1e9)
    with pytest.raises(InputError, match="no place in EPSG:32631"):
        reproject(WGS84, grid.crs, 95.0, 0.0)
