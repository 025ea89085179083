"""What every view answers, and the two simplest: one direction, one projection centre."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import grid_azimuth, unit_vector
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, convergence_deg

Array = NDArray[Any]


class Look(NamedTuple):
    """How the pixels of a block were seen; finite everywhere.

    vectors : (3, rows, cols) unit vectors to the sensor, or (3, 1, 1) where constant; up where unseen.
    seconds : float (rows, cols), when, counted from the start of the trajectory; None where no time is known.
    unseen  : bool (rows, cols), where no sensor is known to have looked; None where that is nowhere.
    """

    vectors: Array
    seconds: Array | None = None
    unseen: Array | None = None


Fan = Callable[[Array, Array, float], tuple[Array, Array]]
"""Bounds on the directions that level patches of ground are seen in.

Given x and y (corners, patches) and a height [m]: vectors (3, corners, patches), not of unit length, and angles
(patches,) [deg]. Every view of a patch lies within that angle of the convex hull of its vectors; nan where it is
not certain that all of a patch was seen.
"""


class View(Protocol):
    """How a scene was seen."""

    def look(self, grid: Grid, block: Block, heights: Array, wanted: Array | None = None) -> Look:
        """How a block of a grid was seen.

        heights : (rows, cols), or (1, 1) where constant. [m]
        wanted  : bool (rows, cols), where it matters: what is said of other pixels means nothing. All if None.
        """

    def vectors(self, grid: Grid, block: Block, heights: Array) -> Array:
        """Unit vectors to the sensor alone: (3, rows, cols), or (3, 1, 1) where constant."""
        return self.look(grid, block, heights).vectors

    def check(self, grid: Grid, highest_m: float) -> None:
        """Raise InputError where the sensor cannot have seen this grid, whose highest point is given."""

    def describe(self, grid: Grid, block: Block, heights: Array) -> dict[str, str]:
        """What is known of how one pixel was seen, beyond its direction: lines by name."""
        del grid, block, heights
        return {}

    def fan(self, grid: Grid) -> Fan | None:
        """Bounds on the directions in which patches of a grid are seen, or None where there are none."""
        del grid
        return None


@dataclass(frozen=True)
class ConstantView(View):
    """One direction for the whole scene; zenith angle from the vertical, azimuth from true north.

    True north is that of the scene's centre: over 10 km it turns by 0.09 degrees times the tangent of latitude.
    """

    zenith_deg: float
    azimuth_deg: float

    def look(self, grid: Grid, block: Block, heights: Array, wanted: Array | None = None) -> Look:
        """The vector (3, 1, 1)."""
        del block, heights, wanted
        convergence = convergence_deg(grid, *grid.center) if grid.crs is not None else 0.0
        return Look(unit_vector(self.zenith_deg, grid_azimuth(self.azimuth_deg, convergence)).reshape(3, 1, 1))

    def check(self, grid: Grid, highest_m: float) -> None:
        """A constant view sees any grid."""

    def fan(self, grid: Grid) -> Fan:
        """The one vector."""
        vector = self.look(grid, Block(0, 0, 1, 1), np.zeros((1, 1))).vectors
        return lambda x, y, _: (np.broadcast_to(vector, (3, *x.shape)), np.zeros(y.shape[1:]))


LEVEL = np.zeros((1, 1), np.float32)
FARTHEST_OF_HEIGHT = 20
"""a camera farther away than this times its height, 87 degrees from the zenith, has another CRS than said"""


@dataclass(frozen=True)
class FrameView(View):
    """A frame camera: all pixels are seen from one projection centre, in coordinates of the grid. [m]"""

    position: tuple[float, float, float]

    def look(self, grid: Grid, block: Block, heights: Array, wanted: Array | None = None) -> Look:
        """Vectors (3, rows, cols) from the surface to the projection centre."""
        from tscorr.sensor.compiled import EVERYWHERE, towards

        transform, position = np.array(grid.transform[:6]), np.array(self.position)
        vectors, wanted = np.empty((3, *block.shape)), EVERYWHERE if wanted is None else wanted
        if heights.size == 1:  # compiled code knows one kind of heights only
            position[2] -= heights.item()
            heights = LEVEL
        towards(position, np.ascontiguousarray(heights), transform, block.row, block.col, wanted, vectors)
        return Look(vectors)

    def check(self, grid: Grid, highest_m: float) -> None:
        """The camera must be above the highest point of the scene, and not beyond its horizon."""
        if not self.position[2] > highest_m:
            raise InputError(
                f"the camera at height {self.position[2]:.1f} m is not above the surface, whose highest point "
                f"is at {highest_m:.1f} m"
            )
        x, y = grid.corners()
        away = float(np.hypot(x - self.position[0], y - self.position[1]).min())
        if away > FARTHEST_OF_HEIGHT * (self.position[2] - highest_m) + float(np.hypot(np.ptp(x), np.ptp(y))):
            raise InputError(
                f"the camera at {place(self.position)} is {away / 1000:.0f} km from the nearest corner of the scene, "
                f"far too low to see it; allowed is a position in the CRS of the image, or in that of crs = ..."
            )

    def fan(self, grid: Grid) -> Fan:
        """Vectors of the corners: those between are sums of them."""
        del grid
        east, north, up = self.position
        return lambda x, y, height_m: (
            np.stack([east - x, north - y, np.full_like(x, up - height_m)]),
            np.zeros(x.shape[1:]),
        )

    def describe(self, grid: Grid, block: Block, heights: Array) -> dict[str, str]:
        """Where the camera stood."""
        del grid, block, heights
        return {"seen from": place(self.position)}


def ground(grid: Grid, block: Block) -> tuple[Array, Array]:
    """Map coordinates of the pixel centres of a block, ready to broadcast to (rows, cols)."""
    rows = np.arange(block.row, block.row + block.height)[:, None]
    cols = np.arange(block.col, block.col + block.width)[None, :]
    x, y = grid.xy(rows, cols)
    return x, y


def unit(east: Any, north: Any, up: Any) -> Array:
    """Unit vectors (3, ...) of three components that broadcast."""
    vectors = np.stack(np.broadcast_arrays(east, north, up))
    vectors /= np.sqrt(np.einsum("i...,i...->...", vectors, vectors))
    return vectors


def place(position: Any) -> str:
    """A position (3,) in words."""
    x, y, z = map(float, position)
    return f"x {x:.2f}, y {y:.2f}, height {z:.2f} m"
