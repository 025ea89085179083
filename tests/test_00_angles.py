"""Angle conventions: compass cases by hand, worked pixels of the Delft scene, exactness where arccos fails."""

import json
from pathlib import Path

import numpy as np
import pytest

from tscorr.angles import (
    angle_between,
    facet_angles,
    grid_azimuth,
    relative_azimuth,
    true_azimuth,
    unit_vector,
    wrap_360,
    zenith_azimuth,
)

TRUTH = json.loads((Path(__file__).parents[1] / "samples/delft/truth/angles.json").read_text())
PIXELS = [pixel for pixels in TRUTH["sample_pixels"].values() for pixel in pixels]


@pytest.mark.parametrize(
    ("azimuth", "wrapped"), [(0, 0), (360, 0), (-1e-17, 0), (-90, 270), (725, 5), (-720, 0), (359.5, 359.5)]
)
def test_wrap_360(azimuth, wrapped):
    assert wrap_360(azimuth) == wrapped


@pytest.mark.parametrize(
    ("view", "sun", "phi"),
    [
        (180, 180, 0),  # the sensor stands where the sun stands: back-scatter
        (0, 180, 180),  # it faces the sun: forward scatter, the peak
        (90, 180, 90),
        (350, 20, 30),  # one geometry, told in two ways
        (20, 350, 30),
        (-10, 380, 30),
        (1, 180, 179),
        (720.5, -360, 0.5),
    ],
)
def test_relative_azimuth_is_folded(view, sun, phi):
    assert relative_azimuth(view, sun) == pytest.approx(phi, abs=1e-12)
    assert relative_azimuth(sun, view) == pytest.approx(phi, abs=1e-12)


def test_relative_azimuth_broadcasts_and_keeps_nan():
    result = relative_azimuth([[0.0], [np.nan]], [10.0, 200.0, 300.0])
    np.testing.assert_allclose(result, [[10, 160, 60], [np.nan] * 3])


@pytest.mark.parametrize(
    ("zenith", "azimuth", "vector"),
    [
        (0, 123, (0, 0, 1)),
        (90, 0, (0, 1, 0)),
        (90, 90, (1, 0, 0)),
        (90, 180, (0, -1, 0)),
        (90, 270, (-1, 0, 0)),
        (30, 90, (0.5, 0, np.sqrt(0.75))),
        (180, 0, (0, 0, -1)),
    ],
)
def test_unit_vector_is_east_north_up(zenith, azimuth, vector):
    np.testing.assert_allclose(unit_vector(zenith, azimuth), vector, atol=2e-16)


def test_unit_vector_keeps_its_digits_near_the_horizon():
    """cos(89.9999999) of plain float64 trigonometry is wrong in its eighth digit."""
    elevation_deg = 90 - 89.9999999
    assert unit_vector(89.9999999, 40)[2] == pytest.approx(elevation_deg * np.pi / 180, rel=1e-15)
    assert unit_vector(90, 40)[2] == 0


def test_zenith_azimuth_is_the_inverse_of_unit_vector():
    rng = np.random.default_rng(3)
    zenith, azimuth = rng.uniform(0.1, 179.9, 500), rng.uniform(0, 360, 500)
    vectors = unit_vector(zenith, azimuth)
    np.testing.assert_allclose((vectors**2).sum(axis=0), 1, rtol=1e-15)
    np.testing.assert_allclose(zenith_azimuth(7.5 * vectors), [zenith, azimuth], rtol=1e-12)


def test_grid_and_true_azimuth_of_the_delft_sun():
    sun, convergence = TRUTH["sun"], TRUTH["grid_convergence_deg"]
    assert grid_azimuth(sun["azimuth_true_deg"], convergence) == pytest.approx(sun["azimuth_grid_deg"], abs=1e-7)
    assert true_azimuth(sun["azimuth_grid_deg"], convergence) == pytest.approx(sun["azimuth_true_deg"], abs=1e-7)
    assert grid_azimuth(1.0, 3.0) == 358.0
    assert true_azimuth(358.0, 3.0) == 1.0


def test_sun_vector_of_the_delft_scene():
    sun = TRUTH["sun"]
    vector = unit_vector(sun["zenith_deg"], sun["azimuth_grid_deg"])
    np.testing.assert_allclose(vector, sun["unit_vector_to_sun_grid"], atol=1e-8)


@pytest.mark.parametrize("pixel", PIXELS, ids=lambda pixel: f"{pixel['row']}-{pixel['col']}")
def test_facet_angles_of_the_worked_pixels(pixel):
    """Angles that the makers of the scene computed apart from its renderer; their inputs have 8 decimals."""
    sun = unit_vector(TRUTH["sun"]["zenith_deg"], TRUTH["sun"]["azimuth_grid_deg"])
    view = unit_vector(pixel["view_zenith_deg"], pixel["view_azimuth_grid_deg"])
    angles = facet_angles(sun, view, np.array(pixel["normal"]))
    expected = [pixel[f"{key}_deg"] for key in ("theta_i", "theta_r", "phi", "alpha", "theta_l")]
    found = [angles[key] for key in ("incidence", "exitance", "relative_azimuth", "facet_tilt", "local_angle")]
    np.testing.assert_allclose(found, expected, atol=5e-6)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-9, 1e-5, 0.1, 60.0, 179.9, 180 - 1e-7, 180.0])
def test_angle_between_is_exact_near_0_and_180(angle_deg):
    """At 1e-9 degrees the arccos of a dot product in float64 gives exactly 0."""
    turn = np.deg2rad(angle_deg)
    a, b = np.array([1.0, 0.0, 0.0]), np.array([np.cos(turn), np.sin(turn), 0.0])
    assert angle_between(a, b) == pytest.approx(angle_deg, rel=1e-15, abs=1e-14)


def test_facet_angles_do_not_change_when_all_vectors_turn_together():
    rng = np.random.default_rng(5)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    sun, view, normal = (unit_vector(rng.uniform(0, 70, 200), rng.uniform(0, 360, 200)) for _ in range(3))
    before = facet_angles(sun, view, normal)
    after = facet_angles(rotation @ sun, rotation @ view, rotation @ normal)
    for key, values in before.items():
        np.testing.assert_allclose(after[key], values, atol=1e-11, err_msg=key)
