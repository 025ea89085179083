"""The sun while a scanner passes, and the sun that rasters hold."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS

from tscorr.angles import angle_between, grid_azimuth, unit_vector
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, convergence_deg, longitude_latitude
from tscorr.sun import solar_position, sun_along, sun_at, sun_of_rasters

START = datetime(2024, 6, 21, 11, 20, tzinfo=UTC)
PLACES = {
    "delft": (28992, 84664, 447719),
    "under the sun": (32632, 500000, 2595000),
    "sydney": (32756, 334000, 6252000),
    "arctic": (3413, 300000, -900000),
}


def grid_at(place, cell=100.0, shape=(100, 120)):
    epsg, x, y = PLACES[place]
    return Grid(CRS.from_epsg(epsg), Affine(cell, 0, x, 0, -cell, y), shape)


def sun_of_pixel(grid, row, col, time):
    """The sun of one pixel at one time, by SPA."""
    x, y = (float(value) for value in grid.xy(row, col))
    longitude, latitude = longitude_latitude(grid, x, y)
    zenith, azimuth = solar_position(time, latitude, longitude)
    return unit_vector(zenith, grid_azimuth(azimuth, convergence_deg(grid, x, y)))


@pytest.mark.parametrize("place", [place for place in PLACES if place != "sydney"])
def test_the_sun_moves_as_spa_says(place):
    """25 minutes of flight over 12 km: within 3e-4 degrees of each pixel's own sun at its own second.

    The second place has the sun within three degrees of the zenith, where azimuths race and vectors do not.
    """
    grid = grid_at(place)
    track = sun_along(grid, START, first_s=-40.0, last_s=1460.0, middle_s=700.0)
    rng = np.random.default_rng(3)
    rows, cols, seconds = rng.integers(0, 100, 40), rng.integers(0, 120, 40), rng.uniform(-40, 1460, 40)
    if place == "under the sun":
        assert track.zenith_deg < 3
    for row, col, second in zip(rows.tolist(), cols.tolist(), seconds.tolist(), strict=True):
        vector = track.vectors(Block(row, col, 1, 1), np.array([[second]]))[:, 0, 0]
        truth = sun_of_pixel(grid, row, col, START + timedelta(seconds=second))
        assert angle_between(vector, truth) < 3e-4
        assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-14)


def test_ten_minutes_are_two_degrees_and_a_half():
    grid = grid_at("delft", cell=1.0)
    track = sun_along(grid, START, first_s=0.0, last_s=600.0, middle_s=300.0)
    early, late = (track.vectors(Block(0, 0, 1, 1), np.full((1, 1), second))[:, 0, 0] for second in (0.0, 600.0))
    assert 2.2 < angle_between(early, late) < 2.5


def test_a_block_is_a_piece_of_the_whole_and_the_ends_hold():
    grid = grid_at("sydney")
    track = sun_along(grid, START - timedelta(hours=9), first_s=0.0, last_s=200.0, middle_s=90.0)
    seconds = np.random.default_rng(4).uniform(-1, 210, (100, 120))
    whole, block = track.vectors(Block(0, 0, 100, 120), seconds), Block(13, 40, 7, 11)
    np.testing.assert_array_equal(track.vectors(block, seconds[block.slices]), whole[:, *block.slices])
    at_end = track.vectors(block, np.full(block.shape, 200.0))
    np.testing.assert_array_equal(track.vectors(block, np.full(block.shape, 999.0)), at_end)


def test_the_centre_is_when_the_centre_was_seen():
    grid = grid_at("delft")
    track = sun_along(grid, START, first_s=0.0, last_s=600.0, middle_s=125.0)
    field = sun_at(grid, START + timedelta(seconds=125))
    assert angle_between(track.center, field.center) < 3e-4
    assert track.zenith_deg == pytest.approx(field.zenith_deg, abs=1e-9)
    assert track.azimuth_deg == pytest.approx(field.azimuth_deg, abs=1e-9)
    assert track.convergence_deg == field.convergence_deg
    assert track.time == field.time == START + timedelta(seconds=125)
    np.testing.assert_allclose(track.vectors(Block(0, 0, 100, 120))[:, 50, 60], track.center, atol=1e-4)


def test_a_flight_into_the_night_is_refused():
    grid = grid_at("delft")
    sun_along(grid, START, first_s=0.0, last_s=8 * 3600.0, middle_s=0.0)
    with pytest.raises(InputError, match=r"the sun from 2024-06-21T11:20:00\+00:00 to 2024-06-21T21:20:00\+00:00 has"):
        sun_along(grid, START, first_s=0.0, last_s=10 * 3600.0, middle_s=0.0)


def test_one_instant_is_a_track_too():
    track = sun_along(grid_at("delft"), START, first_s=5.0, last_s=5.0, middle_s=5.0)
    vector = track.vectors(Block(3, 4, 1, 1), np.full((1, 1), 5.0))[:, 0, 0]
    assert angle_between(vector, sun_of_pixel(grid_at("delft"), 3, 4, START + timedelta(seconds=5))) < 1e-4


def test_the_sun_of_rasters():
    """Read as it is; where there is none, that of the pixel nearest to the centre that has one."""
    grid = grid_at("delft", shape=(5, 7))
    values = np.zeros((3, 5, 7))
    values[:, 2, 4:] = unit_vector(np.full(3, 40.0), np.array([170.0, 180.0, 190.0]))
    sun = sun_of_rasters(grid, lambda block: values[:, *block.slices])
    np.testing.assert_array_equal(sun.center, values[:, 2, 4])
    assert sun.zenith_deg == pytest.approx(40)
    assert sun.azimuth_deg == pytest.approx(170 + convergence_deg(grid, *grid.center))
    assert sun.time is None
    vectors = sun.vectors(Block(1, 3, 2, 4), np.zeros((2, 4)))
    np.testing.assert_array_equal(vectors[:, 1, 1:], values[:, 2, 4:])
    np.testing.assert_array_equal(vectors[:, 0], np.tile(sun.center[:, None], 4))
    with pytest.raises(InputError, match="hold none over the image"):
        sun_of_rasters(grid, lambda block: np.zeros((3, *block.shape)))
