"""A loop over pixels that numpy is slow at: how often each value of a mask stands there."""

from numba import njit

from tscorr.loops import LOOP


@njit(**LOOP)
def count_values(flags, counts):
    """Add to `counts`, int64, the pixels with each value of flags or classes: unsigned integers (rows, cols)."""
    for i in range(flags.shape[0]):
        value, run = flags[i, 0], 0
        for j in range(flags.shape[1]):  # values stand in runs: they are counted without the memory
            if flags[i, j] == value:
                run += 1
            else:
                counts[value] += run
                value, run = flags[i, j], 1
        counts[value] += run
