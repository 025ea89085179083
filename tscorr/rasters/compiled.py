"""Loops over pixels that numpy is slow at: how a tile differs from pixel to pixel, and back."""

import numpy as np
from numba import njit

from tscorr.loops import LOOP


@njit(**LOOP)
def set_differences(values, top, left, tile):
    """Predictor 2 of a tile (rows, cols, samples): each value less its left neighbour's, modulo the range of the type.

    values    : (samples, rows, cols), of unsigned integers as those of the tile.
    top, left : the tile's first pixel; what of it lies beyond the values is left as it is.
    Source: TIFF 6.0, section 14.
    """
    rows, cols = min(tile.shape[0], values.shape[1] - top), min(tile.shape[1], values.shape[2] - left)
    for i in range(rows):
        for sample in range(tile.shape[2]):
            line = values[sample, top + i, left : left + cols]
            tile[i, 0, sample] = line[0]
            for j in range(1, cols):
                tile[i, j, sample] = line[j] - line[j - 1]


@njit(**LOOP)
def set_sums(values, top, left, tile):
    """`set_differences` undone: values (samples, rows, cols) from the pixel `top`, `left` on, as far as they reach."""
    rows, cols = min(tile.shape[0], values.shape[1] - top), min(tile.shape[1], values.shape[2] - left)
    for i in range(rows):
        for sample in range(tile.shape[2]):
            line = values[sample, top + i, left : left + cols]
            total = tile[i, 0, sample]
            line[0] = total
            for j in range(1, cols):
                total += tile[i, j, sample]
                line[j] = total


@njit(**LOOP)
def set_sums_of_bytes(values, top, left, tile, line):
    """Predictor 3 of one band undone: numbers of 32 bits, as uint32 (rows, cols), from the pixel `top`, `left` on.

    tile : uint8 (rows, bytes): of each row the first bytes of all numbers, then the second, ...; as differences.
    line : memory for a row of it.
    Source: TIFF Technical Note 3, "Floating point predictor".
    """
    whole = line.size // 4
    rows, cols = min(tile.shape[0], values.shape[0] - top), min(whole, values.shape[1] - left)
    first, second, third = line[:whole], line[whole : 2 * whole], line[2 * whole : 3 * whole]
    for i in range(rows):
        total = np.uint8(0)
        for k in range(line.size):
            total = np.uint8(total + tile[i, k])
            line[k] = total
        found = values[top + i, left : left + cols]
        for j in range(cols):
            high = (np.uint32(first[j]) << np.uint32(24)) | (np.uint32(second[j]) << np.uint32(16))
            found[j] = high | (np.uint32(third[j]) << np.uint32(8)) | np.uint32(line[3 * whole + j])
