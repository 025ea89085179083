"""The sun's direction over a scene, from time and place or as given.

Positions come from NREL's solar position algorithm (pvlib, +-0.0003 degrees), topocentric, and refracted: the
direction that light arrives from, at 1013.25 hPa and 12 °C (2000 m up that is 0.005 degrees too much).
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr.angles import grid_azimuth, unit_vector
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, convergence_deg, longitude_latitude, require_crs

Array = NDArray[Any]

CONSTANT_WITHIN_DEG = 1e-4
"""a direction that changes less than this over the scene is taken as constant"""


@dataclass(frozen=True, slots=True)
class SunField:
    """Unit vectors to the sun over a scene, in the axes of its grid: bilinear between the four corners.

    corners : (3, 2, 2), at the corners of the grid: [:, 0, 0] at row 0, column 0.
    Bilinear interpolation between corners 10 km apart errs by less than 1e-4 degrees.
    """

    corners: Array
    shape: tuple[int, int]
    zenith_deg: float
    azimuth_deg: float
    """at the centre, from true north"""
    convergence_deg: float

    @property
    def center(self) -> Array:
        """Unit vector (3,) at the middle of the scene."""
        mean = self.corners.mean(axis=(1, 2))
        return mean / np.linalg.norm(mean)

    @property
    def is_constant(self) -> bool:
        """Whether one vector serves the whole scene."""
        spread = np.abs(self.corners - self.center[:, None, None]).max()
        return bool(np.rad2deg(spread) < CONSTANT_WITHIN_DEG)

    def vectors(self, block: Block) -> Array:
        """Unit vectors over a block: (3, rows, cols), or (3, 1, 1) where the sun is constant."""
        if self.is_constant:
            return self.center[:, None, None]
        down = ((np.arange(block.height) + block.row + 0.5) / self.shape[0])[:, None]
        right = ((np.arange(block.width) + block.col + 0.5) / self.shape[1])[None, :]
        (nw, ne), (sw, se) = self.corners.transpose(1, 2, 0)[..., None, None]
        vectors = (1 - down) * ((1 - right) * nw + right * ne) + down * ((1 - right) * sw + right * se)
        return vectors / np.sqrt((vectors**2).sum(axis=0))


def given_sun(grid: Grid, zenith_deg: float, azimuth_deg: float) -> SunField:
    """The sun where the user says it is; azimuth from true north."""
    _require_above_horizon(zenith_deg, "the sun given")
    convergence = convergence_deg(grid, *grid.center) if grid.crs is not None else 0.0
    vector = unit_vector(zenith_deg, grid_azimuth(azimuth_deg, convergence))
    corners = np.broadcast_to(vector[:, None, None], (3, 2, 2))
    return SunField(corners, grid.shape, zenith_deg, azimuth_deg % 360, convergence)


def sun_at(grid: Grid, time: datetime, height_m: float = 0.0) -> SunField:
    """The sun over a grid at an instant; `height_m` above the ellipsoid.

    Raises InputError where the grid has no CRS or the sun is below the horizon.
    """
    require_crs(grid)
    xs, ys = grid.corners()
    center = grid.center
    x, y = np.append(xs, center[0]), np.append(ys, center[1])
    longitude, latitude = longitude_latitude(grid, x, y)
    zenith, azimuth = solar_position(time, latitude, longitude, height_m)
    convergence = np.array([convergence_deg(grid, *point) for point in zip(x, y, strict=True)])
    _require_above_horizon(float(zenith.max()), f"the sun at {time.isoformat()}")
    nw, ne, se, sw, _ = unit_vector(zenith, grid_azimuth(azimuth, convergence)).T
    corners = np.stack([np.stack([nw, ne]), np.stack([sw, se])]).transpose(2, 0, 1)
    return SunField(corners, grid.shape, float(zenith[-1]), float(azimuth[-1]), float(convergence[-1]))


def solar_position(
    time: datetime, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: float = 0.0
) -> tuple[Array, Array]:
    """Refracted zenith angle and azimuth from true north of the sun at places (any one shape). [deg]"""
    latitude, longitude = np.broadcast_arrays(
        np.asarray(latitude_deg, dtype=float), np.asarray(longitude_deg, dtype=float)
    )
    places = zip(latitude.ravel(), longitude.ravel(), strict=True)
    positions = np.array([_spa([time], *place, height_m)[0] for place in places])
    return positions[:, 0].reshape(latitude.shape), positions[:, 1].reshape(latitude.shape)


def solar_path(start: datetime, minutes: ArrayLike, latitude_deg: float, longitude_deg: float) -> tuple[Array, Array]:
    """Refracted zenith angle and azimuth from true north at one place, so many minutes after a start. [deg]"""
    offsets = np.asarray(minutes, dtype=float)
    times = [start + timedelta(minutes=float(offset)) for offset in offsets.ravel()]
    positions = _spa(times, latitude_deg, longitude_deg, 0.0)
    return positions[:, 0].reshape(offsets.shape), positions[:, 1].reshape(offsets.shape)


def _spa(times: list[datetime], latitude_deg: float, longitude_deg: float, height_m: float) -> Array:
    """Refracted zenith angle and azimuth (times, 2) by pvlib."""
    import pandas as pd
    from pvlib.solarposition import spa_python

    when = pd.DatetimeIndex([time.astimezone(UTC) for time in times])
    table = spa_python(when, latitude_deg, longitude_deg, altitude=height_m)
    return np.asarray(table[["apparent_zenith", "azimuth"]], dtype=float)


def _require_above_horizon(zenith_deg: float, what: str) -> None:
    if not 0 <= zenith_deg < 90:
        raise InputError(f"{what} has a zenith angle of {zenith_deg:.3f} degrees; allowed is 0 to below 90")
