"""Quantiles and shares of what was counted into bins of equal width, starting at 0."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

INCIDENCE_BIN_DEG = 0.25
TILT_BIN_DEG = 0.1
SHARE_BIN = 0.005


def quantile(counts: Array, q: float, bin_width: float) -> float:
    """The value below which the part q of what was counted lies; nan where nothing was.

    At most `bin_width` from the smallest value with at least that part at or below it (the "inverted_cdf"
    of numpy), because both lie in the same bin; values are taken as even inside a bin.
    """
    cumulated = np.cumsum(counts)
    total = cumulated[-1]
    if total <= 0:
        return float("nan")
    goal = q * total
    place = int(np.searchsorted(cumulated, goal)) if goal > 0 else int(np.flatnonzero(counts)[0])
    below = cumulated[place] - counts[place]
    return float((place + (goal - below) / counts[place]) * bin_width)


def above(counts: Array, threshold: float, bin_width: float) -> Array:
    """The counts without what lies below a threshold, evenly inside its bin; float, of the same shape."""
    upper_ends = np.arange(1, len(counts) + 1) * bin_width
    return counts * np.clip((upper_ends - threshold) / bin_width, 0, 1)
