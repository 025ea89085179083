"""The sun's direction: positions by other programs, interpolation between corners, what is refused."""

import csv
import json
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS

from tscorr.angles import angle_between, grid_azimuth, unit_vector, zenith_azimuth
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, convergence_deg, longitude_latitude
from tscorr.sun import CONSTANT_WITHIN_DEG, SunField, given_sun, solar_path, solar_position, sun_at

with (Path(__file__).parent / "data/sun_positions.csv").open() as file:
    POSITIONS = list(csv.DictReader(file))
TRUTH = json.loads((Path(__file__).parents[1] / "samples/delft/truth/angles.json").read_text())
DELFT = Grid(CRS.from_epsg(28992), Affine(0.5, 0, 84664, 0, -0.5, 447719), (576, 848))
TIME = datetime.fromisoformat(TRUTH["utc"])


def wide_grid(metres):
    """100 x 80 pixels around Delft that reach `metres` across."""
    cell = metres / 100
    return Grid(DELFT.crs, Affine(cell, 0, 84876 - 50 * cell, 0, -cell, 447575 + 40 * cell), (80, 100))


@pytest.mark.parametrize("row", POSITIONS, ids=lambda row: row["name"])
def test_refracted_positions(row):
    """NREL's published example and images of known time and place, within 0.001 degrees."""
    time, latitude, longitude = datetime.fromisoformat(row["utc"]), float(row["lat_deg"]), float(row["lon_deg"])
    zenith, azimuth = solar_position(time, latitude, longitude, float(row["alt_m"]))
    assert zenith == pytest.approx(float(row["spa_apparent_zenith"]), abs=0.001)
    assert azimuth == pytest.approx(float(row["spa_azimuth"]), abs=0.001)


def test_local_time_is_the_same_instant():
    local = datetime.fromisoformat("2024-05-15T15:30:00+02:00")
    np.testing.assert_allclose(solar_position(local, 52.0, 4.4), solar_position(TIME, 52.0, 4.4), atol=1e-9)


def test_the_sun_of_the_delft_scene():
    sun, truth = sun_at(DELFT, TIME, 45.0), TRUTH["sun"]
    assert sun.zenith_deg == pytest.approx(truth["zenith_deg"], abs=0.001)
    assert sun.azimuth_deg == pytest.approx(truth["azimuth_true_deg"], abs=0.001)
    assert sun.convergence_deg == pytest.approx(TRUTH["grid_convergence_deg"], abs=0.0005)
    assert angle_between(sun.center, np.array(truth["unit_vector_to_sun_grid"])) < 0.001


def test_the_convention_in_words():
    """At noon in the north the sun stands in the south and lights southern slopes; it sets in the west."""
    longitude = float(longitude_latitude(DELFT, *DELFT.center)[0])
    noon = datetime.fromisoformat("2024-05-15T12:00:00Z") - timedelta(hours=longitude / 15, minutes=3.7)
    east, north, up = sun_at(DELFT, noon).center
    assert abs(east) < 0.02
    assert north < -0.4
    assert up > 0.8
    east, north, up = sun_at(DELFT, TIME + timedelta(hours=5)).center
    assert east < -0.8
    assert 0 < up < 0.2


def test_the_path_of_the_sun_is_its_positions():
    minutes = np.array([[-30.0, 0.0], [15.0, 60.0]])
    zenith, azimuth = solar_path(TIME, minutes, 52.0, 4.4)
    for index in np.ndindex(2, 2):
        later = solar_position(TIME + timedelta(minutes=minutes[index]), 52.0, 4.4)
        np.testing.assert_allclose((zenith[index], azimuth[index]), later, atol=1e-9)


def test_a_sun_that_is_given():
    sun = given_sun(DELFT, 40.0, -10.0)
    zenith, azimuth = zenith_azimuth(sun.center)
    assert (sun.zenith_deg, sun.azimuth_deg) == (40, 350)
    assert zenith == pytest.approx(40)
    assert azimuth == pytest.approx(350 + 0.80596, abs=0.0005)
    assert sun.is_constant
    assert sun.vectors(Block(3, 4, 5, 6)).shape == (3, 1, 1)


def test_without_a_crs_a_given_sun_is_from_the_rows():
    sun = given_sun(Grid(None, Affine.identity(), (4, 4)), 30.0, 90.0)
    np.testing.assert_allclose(sun.center, unit_vector(30.0, 90.0), atol=1e-15)
    assert sun.convergence_deg == 0


@pytest.mark.parametrize("block", [Block(0, 0, 80, 100), Block(13, 40, 7, 11), Block(79, 99, 1, 1)], ids=str)
def test_between_the_corners_the_sun_is_where_it_is(block):
    """10 km: bilinear between the corners is within 1e-4 degrees of every pixel's own position."""
    grid = wide_grid(10_000)
    sun = sun_at(grid, TIME)
    assert not sun.is_constant
    vectors = sun.vectors(block)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1, rtol=1e-14)
    for row, col in ((0, 0), (block.height // 2, block.width // 2), (block.height - 1, block.width - 1)):
        x, y = grid.xy(block.row + row, block.col + col)
        longitude, latitude = longitude_latitude(grid, x, y)
        zenith, azimuth = solar_position(TIME, latitude, longitude)
        truth = unit_vector(zenith, grid_azimuth(azimuth, convergence_deg(grid, float(x), float(y))))
        assert angle_between(vectors[:, row, col], truth) < 1e-4


def test_a_block_is_a_piece_of_the_whole():
    sun = sun_at(wide_grid(10_000), TIME)
    block = Block(20, 30, 9, 8)
    np.testing.assert_array_equal(sun.vectors(block), sun.vectors(Block(0, 0, 80, 100))[:, *block.slices])


def test_where_the_sun_counts_as_constant():
    assert sun_at(wide_grid(5), TIME).is_constant
    angle = np.deg2rad(3 * CONSTANT_WITHIN_DEG)
    corners = np.tile(np.array([0.0, 0.0, 1.0])[:, None, None], (1, 2, 2))
    corners[:, 1, 1] = np.sin(angle), 0, np.cos(angle)
    assert not SunField(corners, (4, 4), 0.0, 0.0, 0.0).is_constant


@pytest.mark.parametrize("zenith", [90.0, 120.0, -1.0, float("nan")])
def test_a_sun_below_the_horizon_is_refused(zenith):
    with pytest.raises(InputError, match=r"the sun given has a zenith angle of .*; allowed is 0 to below 90"):
        given_sun(DELFT, zenith, 180.0)


def test_a_time_at_night_is_refused():
    with pytest.raises(InputError, match=r"the sun at 2024-05-15T23:30:00\+00:00 has a zenith angle of"):
        sun_at(DELFT, TIME + timedelta(hours=10))


def test_a_time_needs_a_place():
    with pytest.raises(InputError, match="no CRS"):
        sun_at(Grid(None, Affine.identity(), (4, 4)), TIME)
