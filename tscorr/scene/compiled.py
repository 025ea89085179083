"""A loop over pixels that numpy is slow at: how often each value of a mask stands there."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def counts_of(flags):
    """Pixels with each value of uint16 flags (rows, cols): int64 (65536,)."""
    counts = np.zeros(1 << 16, np.int64)
    for i in range(flags.shape[0]):
        value, run = flags[i, 0], 0
        for j in range(flags.shape[1]):  # values stand in runs: they are counted without the memory
            if flags[i, j] == value:
                run += 1
            else:
                counts[value] += run
                value, run = flags[i, j], 1
        counts[value] += run
    return counts
