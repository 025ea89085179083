"""How sure the corrected values of a scene are: a histogram for each material, for the report."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.kernels.tallies import count_sigmas

Array = NDArray[Any]

BINS_A_DECADE = 50
LOWEST, DECADES = 1e-6, 7
"""reflectance factor: from LOWEST over so many decades; what lies beyond is in the bins at the ends"""
INFINITE = 0x7F80
"""upper half of a float32 that is inf"""


def _places() -> Array:
    """The bin of each upper half of a float32, whose values are alike to 1 %: int32 (65536,); -1 from inf on."""
    middles = ((np.arange(INFINITE, dtype=np.uint32) << 16) + (1 << 15)).view(np.float32).astype(float)
    steps = np.log10(np.maximum(middles, LOWEST) / LOWEST) * BINS_A_DECADE
    places = np.full(1 << 16, -1, np.int32)
    places[:INFINITE] = np.minimum(steps, DECADES * BINS_A_DECADE - 1)
    return places


PLACES = _places()


class SigmaTally:
    """Sums over the corrected and uncorrectable pixels of a scene, by row of the corrector. Integers: no order counts.

    histogram : (materials, bins) of 1 sigma in all bands, bins of equal ratio.
    uncertain, touched : (materials,) pixels with UNCERTAIN, and those with something to remove.
    """

    def __init__(self, materials: int) -> None:
        self.histogram = np.zeros((materials, DECADES * BINS_A_DECADE), np.int64)
        self.uncertain = np.zeros(materials, np.int64)
        self.touched = np.zeros(materials, np.int64)

    def add(self, sigma: Array, flags: Array, rows: Array) -> None:
        """Add a block: sigma, float32 (bands, rows, cols), flags and rows of the corrector (rows, cols)."""
        count_sigmas(sigma.view(np.uint32), flags, rows, PLACES, self.histogram, self.uncertain, self.touched)

    @property
    def arrays(self) -> dict[str, Array]:
        """All sums by name, to be stored and added to those of another part of the scene."""
        return {"histogram": self.histogram, "uncertain": self.uncertain, "touched": self.touched}

    def quantile(self, row: int, share: float) -> float:
        """1 sigma that this share of the values of a material does not exceed, to 5 %; nan where there are none."""
        counts = self.histogram[row]
        if not counts.any():
            return float("nan")
        place = int(np.searchsorted(np.cumsum(counts), share * counts.sum()))
        return float(LOWEST * 10 ** ((place + 0.5) / BINS_A_DECADE))
