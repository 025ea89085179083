"""A loop over pixels that numpy is slow at: how a tile differs from pixel to pixel."""

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
