"""The sun's direction over a scene, from time and place or as given.

Positions come from NREL's solar position algorithm (pvlib, +-0.0003 degrees), topocentric, and refracted: the
direction that light arrives from, at 1013.25 hPa and 12 °C (2000 m up that is 0.005 degrees too much).
Within a scene directions are interpolated as vectors in the axes of the grid: convergence is that of each place.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cache, cached_property
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from tscorr.angles import angle_between, grid_azimuth, true_azimuth, unit_vector, zenith_azimuth
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, convergence_deg, convergences_deg, longitude_latitude, require_crs
from tscorr.loops import LOOP

Array = NDArray[Any]

CONSTANT_WITHIN_DEG = 1e-4
"""a direction that changes less than this over the scene is taken as constant"""


KNOT_S = 60.0
"""seconds between the knots of a moving sun: it turns by a quarter of a degree, and a chord of that errs by 1.4e-4"""


class Sun(Protocol):
    """Where the sun stands over a scene; vectors in the axes of its grid."""

    @property
    def zenith_deg(self) -> float:
        """At the centre of the scene."""

    @property
    def azimuth_deg(self) -> float:
        """At the centre of the scene, from true north."""

    @property
    def convergence_deg(self) -> float:
        """At the centre of the scene."""

    @property
    def time(self) -> datetime | None:
        """When the centre of the scene was lit so; None where that is not known."""

    @property
    def center(self) -> Array:
        """Unit vector (3,) at the middle of the scene."""

    @property
    def spread_deg(self) -> float:
        """No sun of the scene is farther from that of its centre; inf where that is not known."""

    def vectors(self, block: Block, seconds: Array | None = None) -> Array:
        """Unit vectors over a block: (3, rows, cols), or (3, 1, 1) where the sun is constant.

        seconds : (rows, cols), when each pixel was seen, where the view knows that; the sun may not move.
        """


@dataclass(frozen=True)
class SunField:
    """The sun at one instant: bilinear between the four corners.

    corners : (3, 2, 2), at the corners of the grid: [:, 0, 0] at row 0, column 0.
    Bilinear interpolation between corners 10 km apart errs by less than 1e-5 degrees, 100 km apart by 1e-3.
    """

    corners: Array
    shape: tuple[int, int]
    zenith_deg: float
    azimuth_deg: float
    convergence_deg: float
    time: datetime | None = None

    @cached_property
    def center(self) -> Array:
        """Unit vector (3,) at the middle of the scene."""
        mean = self.corners.mean(axis=(1, 2))
        return mean / np.linalg.norm(mean)

    @property
    def spread_deg(self) -> float:
        """The farthest of the corners: between them lies all else."""
        return float(angle_between(self.corners, self.center[:, None, None]).max())

    @cached_property
    def is_constant(self) -> bool:
        """Whether one vector serves the whole scene."""
        spread = np.abs(self.corners - self.center[:, None, None]).max()
        return bool(np.rad2deg(spread) < CONSTANT_WITHIN_DEG)

    def vectors(self, block: Block, seconds: Array | None = None) -> Array:
        """Unit vectors over a block: (3, rows, cols), or (3, 1, 1) where the sun is constant."""
        del seconds
        if self.is_constant:
            return self.center[:, None, None]
        instants = np.broadcast_to(0.0, block.shape)
        return _directions(np.ascontiguousarray(self.corners[:, None]), *_shares(block, self.shape), instants)


@dataclass(frozen=True, slots=True)
class SunTrack:
    """The sun while a scanner passes: linear in time between knots, bilinear between the corners.

    knots   : (3, times, 2, 2), at the corners of the grid, as `SunField.corners`, at even steps of time.
    first_s, step_s : time of the first knot and between knots, in the seconds of the view.
    middle_s : when the centre of the scene was seen.
    A knot each minute errs by less than 2e-4 degrees. Cast shadows are those of the sun at the centre's time.
    """

    knots: Array
    shape: tuple[int, int]
    first_s: float
    step_s: float
    middle_s: float
    zenith_deg: float
    azimuth_deg: float
    convergence_deg: float
    time: datetime | None = None

    @property
    def center(self) -> Array:
        """Unit vector (3,) at the middle of the scene, when it was seen."""
        return self._at(np.array([0.5]), np.array([0.5]), np.array([[self.middle_s]]))[:, 0, 0]

    @property
    def spread_deg(self) -> float:
        """The farthest of the knots: between them lies all else."""
        return float(angle_between(self.knots, self.center[:, None, None, None]).max())

    def vectors(self, block: Block, seconds: Array | None = None) -> Array:
        """Unit vectors (3, rows, cols) when each pixel was seen; where that is not known, when the centre was."""
        if seconds is None:
            seconds = np.full(block.shape, self.middle_s)
        return self._at(*_shares(block, self.shape), seconds)

    def _at(self, down: Array, right: Array, seconds: Array) -> Array:
        return _directions(self.knots, down, right, (seconds - self.first_s) / self.step_s)


@dataclass(frozen=True, slots=True)
class SunRaster:
    """The sun where rasters say it stands, pixel by pixel.

    read : a block to unit vectors (3, rows, cols) in the axes of the grid; of length 0 where the rasters hold none,
           and there the sun of the centre is taken.
    """

    read: Callable[[Block], Array]
    center: Array
    zenith_deg: float
    azimuth_deg: float
    convergence_deg: float
    time: datetime | None = None

    @property
    def spread_deg(self) -> float:
        """Not known: a raster may hold any sun."""
        return math.inf

    def vectors(self, block: Block, seconds: Array | None = None) -> Array:
        """Unit vectors (3, rows, cols)."""
        del seconds
        vectors = self.read(block)
        return np.where(vectors.any(axis=0), vectors, self.center[:, None, None])


def _shares(block: Block, shape: tuple[int, int]) -> tuple[Array, Array]:
    """How far down and how far right of the grid's first corner the pixels of a block lie, in [0, 1]."""
    down = (np.arange(block.height) + block.row + 0.5) / shape[0]
    right = (np.arange(block.width) + block.col + 0.5) / shape[1]
    return down, right


def _directions(knots: Array, down: Array, right: Array, instants: Array) -> Array:
    """Unit vectors (3, rows, cols) between knots (3, times, 2, 2); `instants` (rows, cols) counts knots."""
    result = np.empty((3, *instants.shape))
    _between(knots, down, right, np.array(instants), result)
    return result


@njit(**LOOP)  # type: ignore[untyped-decorator] # numba has no types
def _between(knots: Array, down: Array, right: Array, instants: Array, result: Array) -> None:
    """`_directions` into `result`; nothing is allocated in compiled code, which halves what there is to compile."""
    height, width = instants.shape
    last = knots.shape[1] - 1
    for i in range(height):
        for j in range(width):
            time = min(max(instants[i, j], 0.0), float(last))
            early = min(int(time), max(last - 1, 0))
            late, part = min(early + 1, last), time - early
            square = 0.0
            for c in range(3):
                value = 0.0
                for k, share in ((early, 1 - part), (late, part)):
                    north = (1 - right[j]) * knots[c, k, 0, 0] + right[j] * knots[c, k, 0, 1]
                    south = (1 - right[j]) * knots[c, k, 1, 0] + right[j] * knots[c, k, 1, 1]
                    value += share * ((1 - down[i]) * north + down[i] * south)
                result[c, i, j] = value
                square += value * value
            for c in range(3):
                result[c, i, j] /= math.sqrt(square)


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
    corners, zenith, azimuth, convergence = _corners(grid, [time], height_m)
    _require_above_horizon(float(zenith.max()), f"the sun at {time.isoformat()}")
    return SunField(
        np.ascontiguousarray(corners[:, 0]),
        grid.shape,
        float(zenith[-1, 0]),
        float(azimuth[-1, 0]),
        float(convergence[-1]),
        time,
    )


def sun_along(
    grid: Grid, start: datetime, *, first_s: float, last_s: float, middle_s: float, height_m: float = 0.0
) -> SunTrack:
    """The sun over a grid from `first_s` to `last_s` seconds after `start`, its centre being seen at `middle_s`.

    Raises InputError where the grid has no CRS or the sun is below the horizon at any of these times.
    """
    steps = max(1, math.ceil((last_s - first_s) / KNOT_S))
    seconds = np.linspace(first_s, max(last_s, first_s + 1.0), steps + 1)
    times = [start + timedelta(seconds=float(second)) for second in (*seconds, middle_s)]
    corners, zenith, azimuth, convergence = _corners(grid, times, height_m)
    _require_above_horizon(float(zenith.max()), f"the sun from {times[0].isoformat()} to {times[-2].isoformat()}")
    return SunTrack(
        np.ascontiguousarray(corners[:, :-1]),
        grid.shape,
        float(seconds[0]),
        float(seconds[1] - seconds[0]),
        middle_s,
        float(zenith[-1, -1]),
        float(azimuth[-1, -1]),
        float(convergence[-1]),
        times[-1],
    )


def sun_of_rasters(grid: Grid, read: Callable[[Block], Array]) -> SunRaster:
    """The sun that rasters hold; the centre's is that of the pixel nearest to the centre that has one.

    Raises InputError where none of a few hundred pixels has one.
    """
    rows, cols = grid.shape
    lattice = [
        Block(int(row), int(col), 1, 1)
        for row in np.unique(np.linspace(0, rows - 1, 17).astype(int))
        for col in np.unique(np.linspace(0, cols - 1, 17).astype(int))
    ]
    lattice.sort(key=lambda block: abs(block.row / rows - 0.5) + abs(block.col / cols - 0.5))
    found = next((vector for block in lattice if (vector := read(block)[:, 0, 0]).any()), None)
    if found is None:
        raise InputError("the rasters of the sun's direction hold none over the image")
    convergence = convergence_deg(grid, *grid.center) if grid.crs is not None else 0.0
    zenith, azimuth = zenith_azimuth(found)
    _require_above_horizon(float(zenith), "the sun of the rasters")
    return SunRaster(read, found, float(zenith), float(true_azimuth(azimuth, convergence)), convergence)


def _corners(grid: Grid, times: list[datetime], height_m: float) -> tuple[Array, Array, Array, Array]:
    """The sun at the corners of a grid: vectors (3, times, 2, 2); and at the corners and, last, the centre:

    zenith angles and azimuths (5, times), convergences (5,). [deg]
    """
    require_crs(grid)
    xs, ys = grid.corners()
    center = grid.center
    x, y = np.append(xs, center[0]), np.append(ys, center[1])
    longitude, latitude = longitude_latitude(grid, x, y)
    convergence = convergences_deg(grid, x, y)
    positions = np.array(
        [_spa(times, *place, height_m) for place in zip(latitude.tolist(), longitude.tolist(), strict=True)]
    )
    zenith, azimuth = positions[..., 0], positions[..., 1]
    nw, ne, se, sw, _ = unit_vector(zenith, grid_azimuth(azimuth, convergence[:, None])).transpose(1, 0, 2)
    corners = np.stack([np.stack([nw, ne], axis=-1), np.stack([sw, se], axis=-1)], axis=-2)
    return corners, zenith, azimuth, convergence


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
    """Refracted zenith angle and azimuth (times, 2) by pvlib's implementation of the algorithm.

    As pvlib.solarposition.spa_python has it by default: 1013.25 hPa, 12 °C, 0.5667 degrees of refraction at the
    horizon, and 67 s between terrestrial and universal time.
    """
    seconds = np.array([time.timestamp() for time in times])
    place = latitude_deg, longitude_deg, height_m
    zenith, _, _, _, azimuth, _ = _algorithm().solar_position(
        seconds, *place, 1013.25, 12.0, 67.0, 0.5667, numthreads=1
    )
    return np.stack([zenith, azimuth], axis=1)


@cache
def _algorithm() -> Any:
    """The module pvlib.spa alone: the package would load scipy and pandas, a second of each start."""
    package = find_spec("pvlib")
    assert package is not None
    assert package.origin is not None
    spec = spec_from_file_location("tscorr.pvlib_spa", Path(package.origin).with_name("spa.py"))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _require_above_horizon(zenith_deg: float, what: str) -> None:
    if not 0 <= zenith_deg < 90:
        raise InputError(f"{what} has a zenith angle of {zenith_deg:.3f} degrees; allowed is 0 to below 90")
