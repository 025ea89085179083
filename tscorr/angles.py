"""The only home of angle conventions.

Azimuths are clockwise from north, of the vectors surface→sun and surface→sensor. Vectors are east,
north, up. The relative azimuth is folded once, here: 0 is back-scatter, 180 forward scatter, where
the specular peak lies.

A picture in words: the sun stands in the south (azimuth 180), the camera in the north of a flat roof
(azimuth 0). The relative azimuth is 180: the camera looks into the glare.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]


def wrap_360(azimuth_deg: ArrayLike) -> Array:
    """The same azimuth in [0, 360). [deg]"""
    wrapped = np.mod(azimuth_deg, 360.0)
    return np.where(wrapped == 360.0, 0.0, wrapped)  # -1e-17 % 360 rounds to 360


def relative_azimuth(view_azimuth_deg: ArrayLike, solar_azimuth_deg: ArrayLike) -> Array:
    """Angle between the view and the solar azimuth, folded to [0, 180]. [deg]

    0 is back-scatter (sensor and sun on one side of the pixel), 180 is forward scatter, where the
    specular peak lies. Any finite inputs; shapes broadcast; nan gives nan.
    """
    difference = np.asarray(view_azimuth_deg, dtype=float) - np.asarray(solar_azimuth_deg, dtype=float)
    folded: Array = np.abs(np.mod(difference + 180.0, 360.0) - 180.0)
    return folded


def unit_vector(zenith_deg: ArrayLike, azimuth_deg: ArrayLike) -> Array:
    """Unit vector (3, ...) east, north, up of a zenith angle and an azimuth clockwise from north."""
    zenith, azimuth = np.broadcast_arrays(np.deg2rad(zenith_deg), np.deg2rad(azimuth_deg))
    horizontal = np.sin(zenith)
    up = np.sin(np.deg2rad(90.0 - np.asarray(zenith_deg, dtype=float))) + np.zeros_like(azimuth)
    return np.stack([horizontal * np.sin(azimuth), horizontal * np.cos(azimuth), up])


def zenith_azimuth(vector: ArrayLike) -> tuple[Array, Array]:
    """Zenith angle in [0, 180] and azimuth in [0, 360) of vectors (3, ...) of any length. [deg]"""
    east, north, up = np.asarray(vector, dtype=float)
    zenith = np.rad2deg(np.arctan2(np.hypot(east, north), up))
    return zenith, wrap_360(np.rad2deg(np.arctan2(east, north)))


def grid_azimuth(true_azimuth_deg: ArrayLike, convergence_deg: ArrayLike) -> Array:
    """Azimuth from grid north of an azimuth from true north. [deg]

    `convergence_deg` is positive where grid north lies east of true north.
    """
    return wrap_360(np.asarray(true_azimuth_deg, dtype=float) - np.asarray(convergence_deg, dtype=float))


def true_azimuth(grid_azimuth_deg: ArrayLike, convergence_deg: ArrayLike) -> Array:
    """Azimuth from true north of an azimuth from grid north: the inverse of `grid_azimuth`. [deg]"""
    return wrap_360(np.asarray(grid_azimuth_deg, dtype=float) + np.asarray(convergence_deg, dtype=float))


def facet_angles(sun: Array, view: Array, normal: Array) -> dict[str, Array]:
    """Angles about a facet, from unit vectors (3, ...) that broadcast. [deg]

    incidence, exitance : from the facet normal.
    relative_azimuth    : about the normal, 180 in forward scatter.
    facet_tilt          : angle of the half vector and the normal.
    local_angle         : half the angle between sun and sensor.
    """
    sun, view, normal = np.broadcast_arrays(sun, view, normal)
    half = sun + view
    half = half / np.sqrt((half**2).sum(axis=0))
    beside_sun, beside_view = np.cross(normal, sun, axis=0), np.cross(normal, view, axis=0)
    along = (beside_sun * beside_view).sum(axis=0)
    across = (normal * np.cross(beside_sun, beside_view, axis=0)).sum(axis=0)
    return {
        "incidence": angle_between(sun, normal),
        "exitance": angle_between(view, normal),
        "relative_azimuth": np.abs(np.rad2deg(np.arctan2(across, along))),
        "facet_tilt": angle_between(half, normal),
        "local_angle": angle_between(sun, view) / 2,
    }


def angle_between(a: Array, b: Array) -> Array:
    """Angle between unit vectors (3, ...), exact near 0 and near 180. [deg] (Kahan)"""
    difference, total = a - b, a + b
    return np.rad2deg(2 * np.arctan2(np.sqrt((difference**2).sum(axis=0)), np.sqrt((total**2).sum(axis=0))))
