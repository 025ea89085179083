"""What the blocks of a scene add up to."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.correction import FLAG_VALUES, SINGLE_FLAGS, UNKNOWN_MATERIAL, BlockResult, add_tally, new_tally
from tscorr.correction.sigmas import SigmaTally
from tscorr.kernels import Tally

Array = NDArray[Any]


def counted(values: Array, size: int) -> Array:
    """How often each of so many values stands in an array (rows, cols) of unsigned integers."""
    from tscorr.scene.compiled import count_values

    counts = np.zeros(size, np.int64)
    count_values(values, counts)
    return counts


class Sums:
    """What the blocks of a scene add up to; integers and extremes, so that their order cannot matter."""

    def __init__(self, materials: int, bands: int) -> None:
        self.tally = new_tally(materials + 1, bands)
        self.flags = np.zeros(FLAG_VALUES, np.int64)
        """pixels with each value of the flags"""
        self.sigmas = SigmaTally(materials + 1)
        self.skipped = dict.fromkeys(
            ("blocks", "blocks_no_specular_material", "blocks_out_of_reach", "blocks_shadow_or_nodata"), 0
        )
        self.seconds = dict.fromkeys(("read", "geometry", "kernel", "write"), 0.0)
        self.peak_rss_mb = 0.0
        """of other processes that worked on the scene"""
        self._lock = threading.Lock()

    def add(self, result: BlockResult, rows: Array, kind: str | None) -> None:
        """Add a block of these rows of the corrector; `kind` says why most of its work was skipped, if it was."""
        counts, sigmas = counted(result.flags, FLAG_VALUES), None
        if result.sigma is not None:
            sigmas = SigmaTally(len(self.sigmas.touched))
            sigmas.add(result.sigma, result.flags, rows)
        with self._lock:
            self._add(result.tally, counts, kind)
            for name, values in ({} if sigmas is None else sigmas.arrays).items():
                self.sigmas.arrays[name] += values

    def add_idle(self, tally: Tally, kind: str) -> None:
        """Add a block in which the tally tells all flags: without confidence, image or anything to remove."""
        counts = np.zeros_like(self.flags)
        unknown = tally.states[0].sum()
        counts[UNKNOWN_MATERIAL], counts[0] = unknown, tally.states.sum() - unknown
        with self._lock:
            self._add(tally, counts, kind)

    def _add(self, tally: Tally, flags: Array, kind: str | None) -> None:
        add_tally(self.tally, tally)
        self.flags += flags
        self.skipped["blocks"] += 1
        if kind is not None:
            self.skipped[kind] += 1

    def flag_counts(self) -> dict[str, int]:
        """Pixels with each flag, by name."""
        found = np.flatnonzero(self.flags)
        return {str(flag.name): int(self.flags[found[found & flag != 0]].sum()) for flag in SINGLE_FLAGS}

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add the time of a block of code to one part of the work; summed over the workers."""
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds[part] += time.perf_counter() - start
