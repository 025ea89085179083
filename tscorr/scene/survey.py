"""What windows spread over a scene tell of the heights of its surface model."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.grid import Block
from tscorr.rasters import Reader
from tscorr.terrain.roof_planes import height_noise

SAMPLE_PX = 256
SAMPLES = 4
"""SAMPLES x SAMPLES windows of SAMPLE_PX are looked at"""


class HeightSurvey:
    """Middle height and noise of a surface model, read when the first is asked for: few scenes need either.

    heights : of the grid of a scene, nan where void. shape : rows and columns of the scene.
    elsewhere_m : middle height of the whole surface model, for where it has none in these windows. [m]
    """

    def __init__(self, heights: Reader, shape: tuple[int, int], elsewhere_m: float) -> None:
        self._heights = heights
        self._shape = shape
        self._elsewhere_m = elsewhere_m

    @cached_property
    def level_m(self) -> float:
        """Median of the heights. [m]"""
        known = [window[np.isfinite(window)] for window in self._windows]
        return float(np.median(np.concatenate(known))) if known else self._elsewhere_m

    @cached_property
    def noise_m(self) -> float:
        """1 sigma of the uncorrelated noise of the heights. [m]"""
        return float(np.median([height_noise(window) for window in self._windows])) if self._windows else 0.0

    @cached_property
    def _windows(self) -> list[NDArray[Any]]:
        """Those that have heights."""
        corners = {
            tuple(
                max(0, round((size - SAMPLE_PX) * step / (SAMPLES - 1)))
                for size, step in zip(self._shape, steps, strict=True)
            )
            for steps in np.ndindex(SAMPLES, SAMPLES)
        }
        rows, cols = self._shape
        windows = [
            self._heights.read(Block(row, col, min(SAMPLE_PX, rows - row), min(SAMPLE_PX, cols - col)), 1)
            for row, col in sorted(corners)
        ]
        return [window for window in windows if np.isfinite(window).any()]
