"""Views whose directions come from rasters: angles in degrees, interpolated as vectors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import unit_vector
from tscorr.errors import InputError
from tscorr.grid import Block, Grid
from tscorr.sensor.views import Look, View

Array = NDArray[Any]
ReadVectors = Callable[[Grid, Block], Array]
"""unit vectors (3, rows, cols) over a block of a grid, in its axes; of length 0 where there is none"""


@dataclass(frozen=True)
class RasterView(View):
    """Directions from rasters of angles."""

    read: ReadVectors

    def look(self, grid: Grid, block: Block, heights: Array, wanted: Array | None = None) -> Look:
        """Vectors (3, rows, cols); unseen where the rasters hold none."""
        del heights, wanted
        vectors = self.read(grid, block)
        missing = ~np.any(vectors, axis=0)
        if not missing.any():
            return Look(vectors)
        vectors[2][missing] = 1.0
        return Look(vectors, unseen=missing)

    def check(self, grid: Grid, highest_m: float) -> None:
        """The rasters are checked when they are opened."""


def angle_vectors(zenith_deg: Array, azimuth_deg: Array) -> Array:
    """Unit vectors (3, ...) from true north; of length 0 where an angle is void or the zenith angle beyond 90."""
    known = np.isfinite(zenith_deg) & np.isfinite(azimuth_deg) & (zenith_deg >= 0) & (zenith_deg <= 90)
    vectors = unit_vector(np.where(known, zenith_deg, 0), np.where(known, azimuth_deg, 0))
    return np.where(known, vectors, 0.0)


def check_angles(zenith_deg: Array, azimuth_deg: Array, where: str, *, sure_of_unit: bool = False) -> None:
    """Raise InputError where a sample of zenith angles and azimuths cannot be degrees, with the evidence.

    where        : the files, for the message.
    sure_of_unit : the user said that these are degrees.
    """
    known = np.isfinite(zenith_deg) & np.isfinite(azimuth_deg)
    if not known.any():
        raise InputError(f"{where} hold no angles at all")
    zenith, azimuth = zenith_deg[known], azimuth_deg[known]
    spans = (
        f"zenith angles from {zenith.min():.6g} to {zenith.max():.6g} and azimuths from {azimuth.min():.6g} to "
        f"{azimuth.max():.6g}"
    )
    if zenith.min() < 0 or zenith.max() > 90 or azimuth.min() < -360 or azimuth.max() > 360:
        raise InputError(
            f"{where} hold {spans}; allowed are 0 to 90 and -360 to 360 degrees. Are they scaled (give scale = 0.01), "
            f"or the wrong way round?"
        )
    looks_like_radians = (
        not sure_of_unit
        and zenith.max() <= np.pi / 2
        and azimuth.max() - azimuth.min() > 0.1
        and azimuth.min() >= -np.pi
        and azimuth.max() <= 2 * np.pi
    )
    if looks_like_radians:
        raise InputError(
            f"{where} hold {spans}: radians, by their look. Allowed are degrees: give scale = 57.29578 to turn "
            f"radians into degrees, or scale = 1 if these are degrees"
        )
