"""Observation geometry files: a real record, hand-made ones, and what gives a wrong one away."""

import os
from pathlib import Path

import numpy as np
import pytest

from tscorr.angles import unit_vector
from tscorr.errors import InputError
from tscorr.sensor import OBS_BANDS, Obs, check_obs, check_obs_slope

DATA = os.environ.get("TSCORR_TEST_DATA")


def bands(count=50, seed=0):
    """Consistent values (10, count) in the order of JPL."""
    rng = np.random.default_rng(seed)
    view = rng.uniform(1, 25, count), rng.uniform(0, 360, count)
    sun = rng.uniform(30, 50, count), rng.uniform(170, 190, count)
    ground = rng.uniform(0, 40, count), rng.uniform(0, 360, count)
    to_sensor, to_sun, normal = (unit_vector(*angles) for angles in (view, sun, ground))
    phase = np.rad2deg(np.arccos((to_sensor * to_sun).sum(axis=0)))
    cos_i = (normal * to_sun).sum(axis=0)
    return np.array(
        [np.full(count, 3000.0), *view[::-1], *sun[::-1], phase, *ground, cos_i, np.full(count, 10.2)],
        dtype=np.float32,
    )


def with_bands(**changes):
    """The bands with some of them replaced, by number from 1."""
    values = bands()
    for name, change in changes.items():
        values[int(name[1:]) - 1] = change(values)
    return Obs.of(values)


def gentle(values):
    """Cosine of the incidence angle on slopes of a thirtieth: at most 1.3 degrees."""
    return (unit_vector(values[6] * 180 / np.pi, values[7]) * unit_vector(values[4], values[3])).sum(axis=0)


def test_the_order_of_the_bands():
    obs = Obs.of(np.arange(1.0, 12.0)[:, None])
    found = [
        obs.view_azimuth,
        obs.view_zenith,
        obs.sun_azimuth,
        obs.sun_zenith,
        obs.phase,
        obs.slope,
        obs.aspect,
        obs.cos_i,
    ]
    assert np.concatenate(found).tolist() == [2, 3, 4, 5, 6, 7, 8, 9]
    assert OBS_BANDS[1:9] == (
        "to-sensor azimuth",
        "to-sensor zenith",
        "to-sun azimuth",
        "to-sun zenith",
        "phase",
        "slope",
        "aspect",
        "cosine i",
    )


def test_consistent_files_are_taken():
    check_obs(Obs.of(bands()), "x_obs")
    check_obs_slope(Obs.of(bands()), "x_obs")
    void = bands()
    void[:, ::3] = -9999
    check_obs(Obs.of(void), "x_obs")
    check_obs_slope(Obs.of(void), "x_obs")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {f"b{i}": lambda v, i=i: np.deg2rad(v[i - 1]) for i in (2, 3, 4, 5, 6)},
            "not in degrees: they are in radians",
        ),
        (
            {"b2": lambda v: v[2], "b3": lambda _: bands()[1], "b4": lambda v: v[4], "b5": lambda _: bands()[3]},
            "zenith stands before azimuth",
        ),
        ({"b2": lambda v: v[1] + 180}, r"x_obs: to-sensor azimuth .* make a phase angle of .* degrees; band 6 says"),
        ({"b6": lambda v: 180 - v[5]}, "band 6 says"),
        ({"b6": lambda v: v[8]}, "The bands are not in the order path length, to-sensor azimuth"),
        ({"b3": lambda v: v[2] * np.nan}, "x_obs holds no directions at all"),
    ],
)
def test_wrong_units_or_order_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        check_obs(with_bands(**changes), "x_obs")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"b7": lambda v: np.deg2rad(v[6])},
            r"x_obs: slope .* make cos i = .*; band 9 says .*: the slope is in radians",
        ),
        ({"b7": lambda v: np.deg2rad(v[6]), "b8": lambda v: np.deg2rad(v[7])}, "the slope is in radians"),
        ({"b7": lambda v: np.deg2rad(v[6] / 30), "b9": gentle}, "the slope is in radians"),
        ({"b8": lambda v: v[7] + 180}, r"band 9 says -?\d\.\d+. Allowed are degrees$"),
        ({"b7": lambda v: v[6] + np.nan}, "x_obs holds no slopes at all"),
    ],
)
def test_wrong_slopes_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        check_obs_slope(with_bands(**changes), "x_obs")


@pytest.mark.skipif(DATA is None, reason="TSCORR_TEST_DATA names no folder")
def test_a_pixel_of_aviris_3():
    """Its header calls the slope "rad"; its own cos i says that 0.26 are degrees."""
    path = Path(str(DATA)) / "aviris3-obs/AV320250308t200738_obs.txt"
    values = np.loadtxt(path)[:, None]
    check_obs(Obs.of(values), path.name)
    check_obs_slope(Obs.of(values), path.name)
    values[6] = np.rad2deg(values[6])
    with pytest.raises(
        InputError, match=r"slope 15.1577 and aspect 87.4172 .* make cos i = 0.71\d+; band 9 says 0.7629"
    ):
        check_obs_slope(Obs.of(values), path.name)
