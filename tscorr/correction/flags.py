"""What was done to each pixel, as bits."""

from enum import IntEnum, IntFlag
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr.errors import InputError

Array = NDArray[Any]


class PixelFlag(IntFlag):
    """What was done to a pixel, and why not more. Two bits hold the `SpecularState`.

    SELF_SHADOW to GRAZING, NORMAL_UNRELIABLE and the state are assessed where a material with a peak has data;
    LOW_CONFIDENCE says how sure the class was.
    """

    NODATA = 1 << 0
    NO_MATERIAL = 1 << 1
    SELF_SHADOW = 1 << 2
    CAST_SHADOW = 1 << 3
    NOT_VIEWED = 1 << 4
    GRAZING = 1 << 5
    SPECULAR_STATE = 3 << 6
    SATURATED = 1 << 8
    CLIPPED = 1 << 9
    UNCERTAIN = 1 << 10
    NORMAL_UNRELIABLE = 1 << 11
    LOW_CONFIDENCE = 1 << 12


SPECULAR_STATE_SHIFT = 6
FLAG_VALUES = 2 * max(PixelFlag)
"""a pixel's flags are below this"""
SINGLE_FLAGS = tuple(flag for flag in PixelFlag if flag is not PixelFlag.SPECULAR_STATE)


class SpecularState(IntEnum):
    """The states of CEOS-ARD, in bits 6 and 7 of the flags."""

    NEGLIGIBLE = 0
    CORRECTED = 1
    UNCORRECTABLE = 2
    NOT_ASSESSED = 3


def specular_state(flags: ArrayLike) -> Array:
    """The `SpecularState` of each pixel of a flag layer.

    >>> import tscorr
    >>> tscorr.specular_state([0, 64, 128 | tscorr.PixelFlag.SATURATED, 194])
    array([0, 1, 2, 3])
    """
    values = np.asarray(flags)
    if values.dtype.kind not in "iu":
        raise InputError(f"flags are {values.dtype}; allowed are integers")
    return (values >> SPECULAR_STATE_SHIFT) & 3
