"""How sure the corrected values of a scene are: a histogram for each material, for the report."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.correction.flags import PixelFlag, SpecularState, specular_state

Array = NDArray[Any]

BINS_A_DECADE = 50
LOWEST, DECADES = 1e-6, 7
"""reflectance factor: from LOWEST over so many decades; what lies beyond is in the bins at the ends"""


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
        """Add a block: sigma (bands, rows, cols), flags and rows of the corrector (rows, cols)."""
        state = specular_state(flags)
        where = np.nonzero((state == SpecularState.CORRECTED) | (state == SpecularState.UNCORRECTABLE))
        row, count = rows[where].astype(np.int64), len(self.touched)
        self.touched += np.bincount(row, minlength=count)
        self.uncertain += np.bincount(row[flags[where] & PixelFlag.UNCERTAIN != 0], minlength=count)
        bins = self.histogram.shape[1]
        for band in sigma:
            values = band[where]
            known = np.isfinite(values)  # not where uncorrectable pixels are nodata
            place = np.log10(np.maximum(values[known], LOWEST) / LOWEST) * BINS_A_DECADE
            at = row[known] * bins + np.minimum(place.astype(np.int64), bins - 1)
            self.histogram += np.bincount(at, minlength=self.histogram.size).reshape(self.histogram.shape)

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
