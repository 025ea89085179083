"""Rasters made small, for pictures and for a first look at their values."""

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from tscorr.grid import Block, blocks
from tscorr.rasters.header import RasterInfo, environment, opened
from tscorr.rasters.reading import Reader

Array = NDArray[Any]

LEAST_STEP = 4
"""up to so many pixels a cell GDAL weighs those that lie in two cells; beyond, each pixel counts in one"""
PIECE_BYTES = 16e6
PIECE_COLS = 2048


def read_decimated(info: RasterInfo, max_size: int, bands: Sequence[int] | None = None) -> Array:
    """Stored values of a raster (bands, rows, cols), float32, no side longer than `max_size`.

    Averages of the valid values; nan where there is none, or one is infinite. Overviews are used where the file has
    them; else each tile is decoded once.
    """
    shape, step = decimated(info.shape, max_size)
    indexes = list(bands or range(1, info.bands + 1))
    if info.pixel_by_pixel is None:
        with opened(info.path, ours=info.ours) as dataset:
            if step < LEAST_STEP or dataset.overviews(1):
                out_shape = len(indexes), *shape
                values = dataset.read(indexes, out_shape=out_shape, resampling=Resampling.average, masked=True)
                filled = np.ma.filled(values.astype(np.float32), np.nan)
                filled[~np.isfinite(filled)] = np.nan
                return filled
    means = Means(info.shape, shape, len(indexes))
    with environment(), Reader(info) as reader:
        for block in blocks(info.shape, _piece(info)):
            values = reader.read(block, indexes)
            missing = _missing(values, info.nodata)
            if missing is None:
                count = means.cells.sizes(block)
            else:
                values[missing] = 0
                count = means.cells.sums(block, ~missing)
            means.add(block, means.cells.sums(block, values), count)
    return means.values()


def read_decimated_flags(info: RasterInfo, max_size: int) -> Array:
    """A flag layer on the pixels of `read_decimated`: (rows, cols), the nearest value."""
    shape, _ = decimated(info.shape, max_size)
    with opened(info.path, ours=info.ours) as dataset:
        return dataset.read(1, out_shape=shape)


def decimated(shape: tuple[int, int], max_size: int) -> tuple[tuple[int, int], float]:
    """Shape of a raster that was made small, and how many pixels become one, along a side."""
    step = max(1.0, max(shape) / max_size)
    return (max(1, round(shape[0] / step)), max(1, round(shape[1] / step))), step


class Cells:
    """The cells of a coarse grid over a raster: rectangles of whole pixels.

    fine, coarse : (rows, cols) of the raster and of the grid.
    """

    def __init__(self, fine: tuple[int, int], coarse: tuple[int, int]) -> None:
        self._edges = [np.arange(n) * length // n for n, length in zip(coarse, fine, strict=True)]

    def under(self, block: Block) -> tuple[slice, slice]:
        """Rows and columns of the cells that a block has pixels of."""
        return self._run(0, block.row, block.height), self._run(1, block.col, block.width)

    def sums(self, block: Block, values: Array) -> Array:
        """Sums (layers, rows, cols) over the pixels that each cell has in a block, of values (layers, rows, cols)."""
        rows, cols = self._starts(block)
        by_row = np.empty((len(values), len(rows), block.width))
        for i, (top, bottom) in enumerate(zip(rows, [*rows, block.height][1:], strict=True)):
            np.add.reduce(values[:, top:bottom], axis=1, dtype=float, out=by_row[:, i])
        return np.add.reduceat(by_row, cols, axis=2)

    def sizes(self, block: Block) -> Array:
        """How many pixels each cell has in a block: (1, rows, cols)."""
        rows, cols = self._starts(block)
        return np.outer(np.diff(rows, append=block.height), np.diff(cols, append=block.width))[None]

    def _starts(self, block: Block) -> tuple[Array, Array]:
        """The first row and column in a block of each cell."""
        down, right = self.under(block)
        return np.maximum(self._edges[0][down] - block.row, 0), np.maximum(self._edges[1][right] - block.col, 0)

    def _run(self, axis: int, first: int, length: int) -> slice:
        start, last = np.searchsorted(self._edges[axis], (first, first + length - 1), "right") - 1
        return slice(int(start), int(last) + 1)


class Means:
    """Means over coarse cells, from blocks in any order and of any thread.

    fine, coarse : of the cells. layers : how many are averaged. counted : 1 where all have values in the same pixels.
    """

    def __init__(
        self, fine: tuple[int, int], coarse: tuple[int, int], layers: int, counted: int | None = None
    ) -> None:
        self.cells = Cells(fine, coarse)
        self._total = np.zeros((layers, *coarse), np.float32)  # of integers exact to 16 million, whatever the order
        self._count = np.zeros((counted or layers, *coarse), np.float32)
        self._lock = threading.Lock()

    def add(self, block: Block, sums: Array, counts: Array) -> None:
        """Add the sums (layers, rows, cols) of a block's cells, and of how many values they are."""
        under = self.cells.under(block)
        with self._lock:
            self._total[:, *under] += sums
            self._count[:, *under] += counts

    def values(self) -> Array:
        """The means, float32 (layers, rows, cols); nan where there is nothing, or not a number."""
        means = (self._total / np.where(self._count > 0, self._count, np.nan)).astype(np.float32)
        means[~np.isfinite(means)] = np.nan
        return means


def _piece(info: RasterInfo) -> tuple[int, int]:
    """Rows and columns that are read at once, in whole tiles."""
    (tile_rows, tile_cols), cols = info.tile, info.shape[1]
    width = cols if tile_cols >= cols else max(1, PIECE_COLS // tile_cols) * tile_cols
    room = PIECE_BYTES / (min(width, cols) * info.bands * info.dtype.itemsize)  # rows
    return max(1, int(room / tile_rows)) * tile_rows, width


def _missing(values: Array, nodata: float | None) -> Array | None:
    """Where there are no data; None where nobody can say. An infinite value becomes nan, which no sum hides."""
    if values.dtype.kind == "f":
        values[np.isinf(values)] = np.nan
    if nodata is None:
        return None
    return np.isnan(values) if np.isnan(nodata) else values == nodata
