"""The surface under the pixels: heights and normals of any block of a scene."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Protocol

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


class Surface(Protocol):
    """Heights and normals of blocks of a scene."""

    def heights(self, block: Block) -> Array:
        """Heights (rows, cols), or (1, 1) where constant; never nan. [m]"""

    def normals(self, block: Block) -> tuple[Array, Array | None]:
        """Unit normals (3, rows, cols) or (3, 1, 1), east, north, up, and where they cannot be trusted."""


class FlatSurface:
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
        return np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1), None


class DsmSurface:
    """The surface of a DSM, with normals by Horn's 3 x 3 weights.

    read     : heights of a block, nan where void.
    level_m  : height that stands in for a void where the sensor's direction is computed.
    """

    def __init__(self, read: Read, *, cell_x_m: float, cell_y_m: float, level_m: float) -> None:
        self._read = read
        self._cell = {"cell_x_m": cell_x_m, "cell_y_m": cell_y_m}
        self._level_m = level_m

    def heights(self, block: Block) -> Array:
        """Heights (rows, cols). [m]"""
        return _filled(self._read(block), self._level_m)

    def normals(self, block: Block) -> tuple[Array, Array]:
        """Normals of the 3 x 3 windows."""
        halo = HORN_HALO_PX
        result = horn_normals(self._read(block.padded(halo)), **self._cell)
        inner = (slice(halo, -halo), slice(halo, -halo))
        return result.normals[:, *inner], result.unreliable[inner]


class RoofPlaneSurface:
    """The surface of a DSM, with the normals of planes fitted to roof faces.

    Planes are found in fixed tiles with a halo, so results do not depend on how a run is cut into blocks.
    The last `tiles_kept` tiles are remembered, since neighbouring blocks share them.
    """

    def __init__(
        self,
        read: Read,
        *,
        cell_x_m: float,
        cell_y_m: float,
        level_m: float,
        noise_m: float,
        tiles_kept: int = 12,
    ) -> None:
        self._read = read
        self._cell = {"cell_x_m": cell_x_m, "cell_y_m": cell_y_m}
        self._level_m = level_m
        self._noise_m = noise_m
        self._tiles: OrderedDict[tuple[int, int], RoofPlanes] = OrderedDict()
        self._kept = tiles_kept
        self._locks: dict[tuple[int, int], threading.Lock] = {}
        self._lock = threading.Lock()

    def heights(self, block: Block) -> Array:
        """Heights (rows, cols). [m]"""
        return _filled(self._read(block), self._level_m)

    def normals(self, block: Block) -> tuple[Array, Array]:
        """Normals of the faces that the pixels belong to."""
        normals = np.empty((3, *block.shape), np.float32)
        unreliable = np.empty(block.shape, np.bool_)
        for tile in _tiles_under(block):
            planes = self._planes(tile)
            top, left = max(tile.row, block.row), max(tile.col, block.col)
            bottom = min(tile.row + tile.height, block.row + block.height)
            right = min(tile.col + tile.width, block.col + block.width)
            here = (slice(top - block.row, bottom - block.row), slice(left - block.col, right - block.col))
            there = (slice(top - tile.row, bottom - tile.row), slice(left - tile.col, right - tile.col))
            normals[:, *here] = planes.normals[:, *there]
            unreliable[here] = planes.unreliable[there]
        return normals, unreliable

    def _planes(self, tile: Block) -> RoofPlanes:
        key = tile.row, tile.col
        with self._lock:
            own = self._locks.setdefault(key, threading.Lock())
        with own:
            with self._lock:
                if key in self._tiles:
                    self._tiles.move_to_end(key)
                    return self._tiles[key]
            found = roof_planes(self._read(tile.padded(HALO_PX)), noise_m=self._noise_m, **self._cell)
            inner = (slice(HALO_PX, -HALO_PX), slice(HALO_PX, -HALO_PX))
            planes = RoofPlanes(
                found.normals[:, *inner].copy(), found.unreliable[inner].copy(), found.sigma_deg[inner].copy()
            )
            with self._lock:
                self._tiles[key] = planes
                while len(self._tiles) > self._kept:
                    self._locks.pop(self._tiles.popitem(last=False)[0], None)
            return planes


class GivenNormals:
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


def _filled(heights: Array, level_m: float) -> Array:
    void = np.isnan(heights)
    return np.where(void, np.float32(level_m), heights) if void.any() else heights


def _tiles_under(block: Block) -> list[Block]:
    """The fixed tiles that a block touches."""
    rows = range(block.row // TILE_PX, -(-(block.row + block.height) // TILE_PX))
    cols = range(block.col // TILE_PX, -(-(block.col + block.width) // TILE_PX))
    return [Block(row * TILE_PX, col * TILE_PX, TILE_PX, TILE_PX) for row in rows for col in cols]
