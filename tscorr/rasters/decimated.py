"""Rasters made small, for pictures and for a first look at their values."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling

from tscorr.grid import blocks
from tscorr.rasters.header import ENVIRONMENT, RasterInfo, opened
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
    shape, step = _decimated(info, max_size)
    indexes = list(bands or range(1, info.bands + 1))
    if info.pixel_by_pixel is None:
        with opened(info.path, ours=info.ours) as dataset:
            if step < LEAST_STEP or dataset.overviews(1):
                out_shape = len(indexes), *shape
                values = dataset.read(indexes, out_shape=out_shape, resampling=Resampling.average, masked=True)
                filled = np.ma.filled(values.astype(np.float32), np.nan)
                filled[~np.isfinite(filled)] = np.nan
                return filled
    return _means(info, shape, indexes)


def read_decimated_flags(info: RasterInfo, max_size: int) -> Array:
    """A flag layer on the pixels of `read_decimated`: (rows, cols), the nearest value."""
    shape, _ = _decimated(info, max_size)
    with opened(info.path, ours=info.ours) as dataset:
        return dataset.read(1, out_shape=shape)


def _decimated(info: RasterInfo, max_size: int) -> tuple[tuple[int, int], float]:
    """Shape of a raster that was made small, and the pixels that become one."""
    rows, cols = info.shape
    step = max(1.0, max(rows, cols) / max_size)
    return (max(1, round(rows / step)), max(1, round(cols / step))), step


def _means(info: RasterInfo, shape: tuple[int, int], indexes: Sequence[int]) -> Array:
    """Means of the valid values of the cells of a coarse grid, float32 (bands, *shape); read piece by piece."""
    total, count = np.zeros((2, len(indexes), *shape))
    edges = [np.arange(coarse) * fine // coarse for coarse, fine in zip(shape, info.shape, strict=True)]
    with rasterio.Env(**ENVIRONMENT), Reader(info) as reader:
        for block in blocks(info.shape, _piece(info)):
            values = reader.read(block, indexes)
            (i, rows), (j, cols) = (
                _cells(edge, first, length)
                for edge, first, length in zip(edges, (block.row, block.col), block.shape, strict=True)
            )
            missing = _missing(values, info.nodata)
            if missing is not None:
                values[missing] = 0
                count[:, i, j] -= _sums(missing, rows, cols)
            total[:, i, j] += _sums(values, rows, cols)
            count[:, i, j] += np.outer(np.diff(rows, append=block.height), np.diff(cols, append=block.width))
    means = (total / np.where(count > 0, count, np.nan)).astype(np.float32)
    means[~np.isfinite(means)] = np.nan
    return means


def _piece(info: RasterInfo) -> tuple[int, int]:
    """Rows and columns that are read at once, in whole tiles."""
    (tile_rows, tile_cols), cols = info.tile, info.shape[1]
    width = cols if tile_cols >= cols else max(1, PIECE_COLS // tile_cols) * tile_cols
    room = PIECE_BYTES / (min(width, cols) * info.bands * info.dtype.itemsize)  # rows
    return max(1, int(room / tile_rows)) * tile_rows, width


def _cells(edges: Array, first: int, length: int) -> tuple[slice, Array]:
    """The cells that a run of pixels lies in, and where in the run each of them starts."""
    cell = slice(
        int(np.searchsorted(edges, first, "right")) - 1, int(np.searchsorted(edges, first + length - 1, "right"))
    )
    return cell, np.maximum(edges[cell] - first, 0)


def _missing(values: Array, nodata: float | None) -> Array | None:
    """Where there are no data; None where nobody can say. An infinite value becomes nan, which no sum hides."""
    if values.dtype.kind == "f":
        values[np.isinf(values)] = np.nan
    if nodata is None:
        return None
    return np.isnan(values) if np.isnan(nodata) else values == nodata


def _sums(values: Array, rows: Array, cols: Array) -> Array:
    """Sums (bands, rows, cols) of the cells that start at these rows and columns of some values."""
    by_row = np.empty((len(values), len(rows), values.shape[2]))
    for i, (top, bottom) in enumerate(zip(rows, [*rows[1:], values.shape[1]], strict=True)):
        np.add.reduce(values[:, top:bottom], axis=1, dtype=float, out=by_row[:, i])
    return np.add.reduceat(by_row, cols, axis=2)
