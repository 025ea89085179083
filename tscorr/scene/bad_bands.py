"""Bands that their file marks as bad: they take no part in anything and are written as they were read."""

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.materials import BandParameters, Material

Array = NDArray[Any]


class BadBands:
    """Takes the bad bands of an image out of sight and puts them back.

    bad : whether each band is bad; empty where none is. At least one is good.
    """

    def __init__(self, bad: tuple[bool, ...]) -> None:
        self.bands = np.flatnonzero(bad)
        self._stand_in = bad.index(False) if bad else 0

    def set_aside(self, image: Array) -> Array:
        """The bad bands of an image (bands, rows, cols), in whose place a good one stands from now on.

        So they neither count as nodata nor as saturated.
        """
        kept = image[self.bands]
        if self.bands.size:
            image[self.bands] = image[self._stand_in]
        return kept

    def put_back(self, image: Array, kept: Array) -> None:
        """Undo `set_aside`."""
        image[self.bands] = kept


def parameters_of(
    surface: Material, wavelengths_um: tuple[float, ...] | None, bad: tuple[bool, ...], bands: int
) -> BandParameters:
    """Parameters for each band; bad ones have no peak, and their wavelengths may be ones no material is known at."""
    if not bad:
        return surface.at(wavelengths_um, bands)
    good = ~np.array(bad)
    known = surface.at(
        None if wavelengths_um is None else [um for um, is_bad in zip(wavelengths_um, bad, strict=True) if not is_bad],
        int(good.sum()),
    )
    nearest = np.maximum(np.cumsum(good) - 1, 0)  # the good band before, so that a lobe is computed once
    filled = {entry.name: getattr(known, entry.name)[nearest] for entry in fields(known)}
    return BandParameters(**{**filled, "t1": np.where(good, filled["t1"], 0.0)})
