"""What windows spread over a scene tell of the heights of its surface model."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import InputError
from tscorr.grid import Block
from tscorr.rasters import Reader
from tscorr.terrain.roof_planes import height_noise

SAMPLE_PX = 256
SAMPLES = 4
"""SAMPLES x SAMPLES windows of SAMPLE_PX are looked at"""


class HeightSurvey:
    """Middle height and noise of a surface model, read when the first is asked for: few scenes need either.

    heights : of the grid of a scene, nan where void. shape : rows and columns of the scene.
    """

    def __init__(self, heights: Reader, shape: tuple[int, int]) -> None:
        self._heights = heights
        self._shape = shape

    @cached_property
    def level_m(self) -> float:
        """Median of the heights. InputError where there are none. [m]"""
        known = np.concatenate([window[np.isfinite(window)] for window in self._windows])
        if not known.size:
            raise InputError(f"the surface model {self._heights.info.path} holds no heights under the image")
        return float(np.median(known))

    @cached_property
    def noise_m(self) -> float:
        """1 sigma of the uncorrelated noise of the heights. [m]"""
        return float(np.median([height_noise(window) for window in self._windows]))

    @cached_property
    def _windows(self) -> list[NDArray[Any]]:
        corners = {
            tuple(
                max(0, round((size - SAMPLE_PX) * step / (SAMPLES - 1)))
                for size, step in zip(self._shape, steps, strict=True)
            )
            for steps in np.ndindex(SAMPLES, SAMPLES)
        }
        rows, cols = self._shape
        return [
            self._heights.read(Block(row, col, min(SAMPLE_PX, rows - row), min(SAMPLE_PX, cols - col)), 1)
            for row, col in sorted(corners)
        ]
