"""Rasters of directions and of camera numbers, laid over the image whatever their resolution and CRS.

Angles cannot be interpolated (359 and 1 are two degrees apart), so pixels are made vectors first, in the raster's
own grid, and those are interpolated.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr import rasters
from tscorr.grid import Block, Grid, North, north_of, reproject, require_crs
from tscorr.sensor.compiled import bilinear_unit

Array = NDArray[Any]

LATTICE_PX = 32
"""pixels between the points that are turned into another CRS; over 32 pixels of 10 m, straight to 2 mm"""


class Band(NamedTuple):
    """One band of a raster, counted from 1, and what its stored values are multiplied by and moved by."""

    info: rasters.RasterInfo
    number: int
    scale: float = 1.0
    offset: float = 0.0


class LaidVectors:
    """Unit vectors made of the bands of rasters of one grid, over blocks of any other grid.

    vectors_of : function of the values of the bands, nan where void, to vectors (3, rows, cols) east of true north,
                 north and up; of length 0 where there is none.
    """

    def __init__(self, bands: Sequence[Band], vectors_of: Callable[..., Array]) -> None:
        self._bands = bands
        self._vectors_of = vectors_of
        self._readers = {band.info.path: rasters.Reader(band.info, fill=float("nan")) for band in bands}
        self._north: tuple[Grid, North] | None = None

    def __call__(self, grid: Grid, block: Block) -> Array:
        """Vectors (3, rows, cols) in the axes of the grid, of length 0 where there is none."""
        raster = self._bands[0].info.grid
        rows, cols = places(raster, grid, block)
        window = _window(rows, cols, raster.shape)
        if window is None:
            return np.zeros((3, *block.shape))
        source = np.ascontiguousarray(self._vectors_of(*self._values(window)), np.float64)
        turn = np.ascontiguousarray(self._north_of(grid).turn(block))
        result = np.zeros((3, *rows.shape))
        bilinear_unit(source, rows - window.row, cols - window.col, turn, result)
        return result

    def sample(self, most: int) -> list[Array]:
        """Values of each band at up to most x most pixels, nan where void."""
        pixels = _spread(self._bands[0].info.shape, most)
        return list(np.array([[values[0, 0] for values in self._values(pixel)] for pixel in pixels]).T)

    def _values(self, window: Block) -> list[Array]:
        return [
            self._readers[band.info.path].read(window, band.number).astype(np.float64) * band.scale + band.offset
            for band in self._bands
        ]

    def _north_of(self, grid: Grid) -> North:
        if self._north is None or self._north[0] != grid:
            self._north = grid, north_of(grid)
        return self._north[1]

    def close(self) -> None:
        """Close the files; the next block opens them again."""
        for reader in self._readers.values():
            reader.close()


class LaidNumbers:
    """Whole numbers of a raster over blocks of any grid: the nearest pixel's, or `none` where there is none."""

    def __init__(self, info: rasters.RasterInfo, none: int) -> None:
        self._info = info
        self._none = none
        self._reader = rasters.Reader(info)

    def __call__(self, grid: Grid, block: Block) -> Array:
        """Numbers, int64 (rows, cols)."""
        raster = self._info.grid
        rows, cols = (np.floor(_finite(place) + 0.5).astype(np.int64) for place in places(raster, grid, block))
        window = _window(rows, cols, raster.shape)
        result = np.full(block.shape, self._none, np.int64)
        if window is None:
            return result
        values = self._reader.read(window, 1)
        rows, cols = rows - window.row, cols - window.col
        inside = (rows >= 0) & (rows < window.height) & (cols >= 0) & (cols < window.width)
        found = values[rows[inside], cols[inside]].astype(np.int64)
        if self._info.nodata is not None:
            found[found == int(self._info.nodata)] = self._none
        result[inside] = found
        return result

    def sample(self, most: int) -> Array:
        """Numbers of up to most x most pixels, without nodata."""
        values = np.array([self._reader.read(pixel, 1)[0, 0] for pixel in _spread(self._info.shape, most)])
        return values if self._info.nodata is None else values[values != self._info.nodata]

    def close(self) -> None:
        """Close the file; the next block opens it again."""
        self._reader.close()


def places(raster: Grid, grid: Grid, block: Block) -> tuple[Array, Array]:
    """Fractional rows and columns of a raster, each (rows, cols), under the pixel centres of a block of a grid."""
    rows = np.arange(block.row, block.row + block.height)
    cols = np.arange(block.col, block.col + block.width)
    if raster.crs == grid.crs:
        return raster.rowcol(*grid.xy(rows[:, None], cols[None, :]))
    down, right = (np.arange(axis[0] // LATTICE_PX, axis[-1] // LATTICE_PX + 2) for axis in (rows, cols))
    x, y = grid.xy(down[:, None] * LATTICE_PX, right[None, :] * LATTICE_PX)
    nodes = np.stack(raster.rowcol(*reproject(require_crs(grid), require_crs(raster), x, y)))
    row, col = rows / LATTICE_PX - down[0], cols / LATTICE_PX - right[0]
    top, left = row.astype(int), col.astype(int)
    part = (row - top)[:, None]
    between = nodes[:, top] * (1 - part) + nodes[:, top + 1] * part
    part = col - left
    found = between[:, :, left] * (1 - part) + between[:, :, left + 1] * part
    return found[0], found[1]


def _finite(place: Array) -> Array:
    """Places that are nowhere in the raster's CRS, moved out of it."""
    return np.where(np.isfinite(place), place, -9.0)


def _spread(shape: tuple[int, int], most: int) -> list[Block]:
    """Up to most x most pixels, spread evenly from edge to edge."""
    down, right = (np.unique(np.linspace(0, size - 1, most).astype(int)) for size in shape)
    return [Block(int(row), int(col), 1, 1) for row in down for col in right]


def _window(rows: Array, cols: Array, shape: tuple[int, int]) -> Block | None:
    """The pixels of a raster of this shape that lie around these places; None where none does."""
    known = np.isfinite(rows) & np.isfinite(cols)
    if not known.any():
        return None
    ranges = []
    for axis, size in ((rows[known], shape[0]), (cols[known], shape[1])):
        if axis.max() < -0.6 or axis.min() > size - 0.4:
            return None
        first = min(max(int(np.floor(axis.min())), 0), size - 1)
        last = max(min(int(np.floor(axis.max())) + 1, size - 1), first)
        ranges.append((first, last - first + 1))
    (top, height), (left, width) = ranges
    return Block(top, left, height, width)
