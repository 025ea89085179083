"""The surface under the pixels: heights and normals of any block of a scene."""

import math
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tscorr.grid import Block
from tscorr.terrain.normals import HORN_HALO_PX, horn_normals
from tscorr.terrain.roof_planes import HALO_PX, RoofPlanes, roof_planes

Array = NDArray[Any]
Read = Callable[[Block], Array]
"""heights (rows, cols) or normals (3, rows, cols) of a block that may reach beyond the scene; nan is a void"""

TILE_PX = 512
"""roof planes are found in tiles of this side, wherever the blocks of a run are cut"""


class Relief(NamedTuple):
    """The surface under a block: `Surface.heights`, and both of `Surface.normals`."""

    heights: Array
    normals: Array
    unreliable: Array | None


class Survey(Protocol):
    """What is known of the heights of a whole scene; found out when it is first asked for."""

    @property
    def level_m(self) -> float:
        """The height that stands in for a void where the sensor's direction is computed."""

    @property
    def noise_m(self) -> float:
        """1 sigma of the uncorrelated noise of the heights."""


class Surface(Protocol):
    """Heights and normals of blocks of a scene."""

    def relief(self, block: Block, wanted: Array | None = None) -> Relief:
        """Heights and normals at once.

        wanted : bool (rows, cols), where the normals are wanted: what they are elsewhere means nothing.
        """
        del wanted
        return Relief(self.heights(block), *self.normals(block))

    def heights(self, block: Block) -> Array:
        """Heights (rows, cols), or (1, 1) where constant; never nan. [m]"""

    def normals(self, block: Block) -> tuple[Array, Array | None]:
        """Unit normals (3, rows, cols) or (3, 1, 1), east, north, up, and where they cannot be trusted."""

    def normal_sigma_deg(self, block: Block) -> Array:
        """1 sigma of the normals along each of two axes (rows, cols), or (1, 1) where constant; 0: not known. [deg]"""


class FlatSurface(Surface):
    """A horizontal surface at one height."""

    def __init__(self, height_m: float) -> None:
        self._height = np.array([[height_m]])

    def heights(self, block: Block) -> Array:
        """The height (1, 1). [m]"""
        del block
        return self._height

    def normals(self, block: Block) -> tuple[Array, None]:
        """Up."""
        del block
        return np.array([0, 0, 1], np.float32).reshape(3, 1, 1), None

    def normal_sigma_deg(self, block: Block) -> Array:
        """Not known. [deg]"""
        del block
        return np.zeros((1, 1), np.float32)


class DsmSurface(Surface):
    """The surface of a DSM, with normals by Horn's 3 x 3 weights.

    read : heights of a block, nan where void.
    """

    def __init__(self, read: Read, survey: Survey, *, cell_x_m: float, cell_y_m: float) -> None:
        self._read = read
        self._survey = survey
        self._cell = {"cell_x_m": cell_x_m, "cell_y_m": cell_y_m}

    def heights(self, block: Block) -> Array:
        """Heights (rows, cols). [m]"""
        return _filled(self._read(block), self._survey)

    def normals(self, block: Block) -> tuple[Array, Array | None]:
        """Normals of the 3 x 3 windows."""
        relief = self.relief(block)
        return relief.normals, relief.unreliable

    def relief(self, block: Block, wanted: Array | None = None) -> Relief:
        """Heights, and normals of the 3 x 3 windows; they are read once for both."""
        halo = HORN_HALO_PX
        around = self._around(block, wanted)
        normals, unreliable = horn_normals(around, halo=halo, wanted=wanted, **self._cell)
        return Relief(_filled(around[halo:-halo, halo:-halo], self._survey), normals, unreliable)

    def _around(self, block: Block, wanted: Array | None) -> Array:
        """Heights of a block and its apron; where no window reaches into the apron it is made up, not read."""
        halo = HORN_HALO_PX
        if wanted is None or wanted.size == 0:
            return self._read(block.padded(halo))
        edges = wanted[:halo], wanted[-halo:], wanted[:, :halo], wanted[:, -halo:]
        top, bottom, left, right = (halo * bool(edge.any()) for edge in edges)
        part = Block(block.row - top, block.col - left, block.height + top + bottom, block.width + left + right)
        missing = (halo - top, halo - bottom), (halo - left, halo - right)
        heights = self._read(part)
        return np.pad(heights, missing, mode="edge") if np.any(missing) else heights

    def normal_sigma_deg(self, block: Block) -> Array:
        """From the noise of the heights, (rows, cols). [deg]

        Each slope is sum(weight height) / 8 cells with Horn's weights +-(1, 2, 1): its error is sqrt(12) / 8 of the
        noise a cell. It turns the normal by cos^2 of the tilt downhill and by cos across; the rms of both.
        """
        slope = self._survey.noise_m * math.sqrt(12.0) / 8.0 / min(self._cell.values())
        up = self.normals(block)[0][2]
        return np.rad2deg(slope * np.sqrt((up**4 + up**2) / 2)).astype(np.float32)


class RoofPlaneSurface(Surface):
    """The surface of a DSM, with the normals of planes fitted to roof faces.

    Planes are found in fixed tiles with a halo, so results do not depend on how a run is cut into blocks.
    The last `tiles_kept` tiles are remembered, since neighbouring blocks share them.
    """

    def __init__(
        self,
        read: Read,
        survey: Survey,
        *,
        cell_x_m: float,
        cell_y_m: float,
        tiles_kept: int = 12,
    ) -> None:
        self._read = read
        self._survey = survey
        self._cell = {"cell_x_m": cell_x_m, "cell_y_m": cell_y_m}
        self._tiles: OrderedDict[tuple[int, int], RoofPlanes] = OrderedDict()
        self._kept = tiles_kept
        self._locks: dict[tuple[int, int], threading.Lock] = {}
        self._lock = threading.Lock()

    def heights(self, block: Block) -> Array:
        """Heights (rows, cols). [m]"""
        return _filled(self._read(block), self._survey)

    def normals(self, block: Block) -> tuple[Array, Array]:
        """Normals of the faces that the pixels belong to."""
        normals = np.empty((3, *block.shape), np.float32)
        unreliable = np.empty(block.shape, np.bool_)
        for tile in _tiles_under(block):
            planes = self._planes(tile)
            here, there = _common(block, tile), _common(tile, block)
            normals[:, *here] = planes.normals[:, *there]
            unreliable[here] = planes.unreliable[there]
        return normals, unreliable

    def normal_sigma_deg(self, block: Block) -> Array:
        """From the noise of the heights and the size of the face, (rows, cols). [deg]"""
        sigma = np.empty(block.shape, np.float32)
        for tile in _tiles_under(block):
            here, there = _common(block, tile), _common(tile, block)
            sigma[here] = self._planes(tile).sigma_deg[there]
        return sigma

    def _planes(self, tile: Block) -> RoofPlanes:
        key = tile.row, tile.col
        with self._lock:
            own = self._locks.setdefault(key, threading.Lock())
        with own:
            with self._lock:
                if key in self._tiles:
                    self._tiles.move_to_end(key)
                    return self._tiles[key]
            found = roof_planes(self._read(tile.padded(HALO_PX)), noise_m=self._survey.noise_m, **self._cell)
            inner = (slice(HALO_PX, -HALO_PX), slice(HALO_PX, -HALO_PX))
            planes = RoofPlanes(
                found.normals[:, *inner].copy(), found.unreliable[inner].copy(), found.sigma_deg[inner].copy()
            )
            with self._lock:
                self._tiles[key] = planes
                while len(self._tiles) > self._kept:
                    self._locks.pop(self._tiles.popitem(last=False)[0], None)
            return planes


class GivenNormals(Surface):
    """Normals from a raster (3, rows, cols), and heights from another or constant."""

    def __init__(self, read: Read, surface: Surface) -> None:
        self._read = read
        self._surface = surface

    def heights(self, block: Block) -> Array:
        """Heights of the surface beneath. [m]"""
        return self._surface.heights(block)

    def normals(self, block: Block) -> tuple[Array, Array]:
        """The given vectors made unit; up, and not to be trusted, where there are none."""
        vectors = self._read(block).astype(np.float64)
        length = np.sqrt((vectors**2).sum(axis=0))
        missing = ~(length > 0.5)
        vectors = np.where(missing, np.array([0.0, 0.0, 1.0])[:, None, None], vectors)
        return vectors / np.where(missing, 1.0, length), missing

    def normal_sigma_deg(self, block: Block) -> Array:
        """Not known. [deg]"""
        del block
        return np.zeros((1, 1), np.float32)


def _filled(heights: Array, survey: Survey) -> Array:
    if heights.size == 0 or not np.isnan(heights.min()):  # which is nan where any is
        return heights
    return np.where(np.isnan(heights), np.float32(survey.level_m), heights)


def _common(block: Block, other: Block) -> tuple[slice, slice]:
    """The part of a block that another one covers, as slices of the block."""
    top, left = max(other.row, block.row), max(other.col, block.col)
    bottom = min(other.row + other.height, block.row + block.height)
    right = min(other.col + other.width, block.col + block.width)
    return slice(top - block.row, bottom - block.row), slice(left - block.col, right - block.col)


def _tiles_under(block: Block) -> list[Block]:
    """The fixed tiles that a block touches."""
    rows = range(block.row // TILE_PX, -(-(block.row + block.height) // TILE_PX))
    cols = range(block.col // TILE_PX, -(-(block.col + block.width) // TILE_PX))
    return [Block(row * TILE_PX, col * TILE_PX, TILE_PX, TILE_PX) for row in rows for col in cols]
