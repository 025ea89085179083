"""Sizes, flags and coefficients of the kernel, the places of its scratch memory, and how it is compiled.

Constants are np.float32 so that float32 arithmetic stays float32; all but the polynomials' are exact.
"""

import math
from typing import Any

import numpy as np

CHUNK = 64
"""pixels of a row that are worked on at a time: their scratch arrays stay in the L1 cache"""

ENDLESS = np.float32(math.inf)
ZERO, QUARTER, HALF = np.float32(0), np.float32(0.25), np.float32(0.5)
ONE, TWO, FOUR = np.float32(1), np.float32(2), np.float32(4)

# Bits of PixelFlag, which tscorr.correction documents.
NO_FLAG = np.uint16(0)
NODATA, NO_MATERIAL, SELF_SHADOW, CAST_SHADOW = np.uint16(1), np.uint16(2), np.uint16(4), np.uint16(8)
NOT_VIEWED, GRAZING = np.uint16(16), np.uint16(32)
CORRECTED, UNCORRECTABLE, NOT_ASSESSED = np.uint16(1 << 6), np.uint16(2 << 6), np.uint16(3 << 6)
SATURATED, CLIPPED = np.uint16(256), np.uint16(512)
HIDDEN = np.uint16(8 | 16)
DOUBT = np.uint16(4096)
ON_ENTRY = np.uint16(8 | 16 | 2048 | 4096)

# SPECULAR_STATE, in bits 6 and 7.
NEGLIGIBLE_STATE, CORRECTED_STATE, UNCORRECTABLE_STATE, REFUSED_STATE = 0, 1, 2, 3
STATE_SHIFT = 6

# How a material is corrected: without G; R refers to the horizontal plane, not to the facet; an uncorrectable pixel
# keeps its value, or becomes nodata.
SIMPLIFIED, LEVEL, KEEP, BLANK = 1, 2, 4, 8

FRESNEL_DEGREE = 12
NO_KIND = np.int32(256)
"""beyond every row of a table"""

# alpha^2 / u over u = 1 - cos alpha in [0, 1]; largest relative error 7e-9
A0, A1, A2 = np.float32(2.0), np.float32(0.33333173), np.float32(0.08893097)
A3, A4, A5 = np.float32(0.028153064), np.float32(0.012210054), np.float32(-0.0016769501)
A6, A7, A8 = np.float32(0.009950104), np.float32(-0.006363017), np.float32(0.0028651212)
# 2^x over [-1/2, 1/2]; largest relative error 2e-9
E1, E2, E3 = np.float32(0.6931472), np.float32(0.24022646), np.float32(0.05550329)
E4, E5, E6 = np.float32(0.00961852), np.float32(0.001339986), np.float32(0.00015337576)
# alpha / sin alpha up to 90 degrees in alpha^2; largest relative error 1.2e-4
T1, T2, T3 = np.float32(0.1675884), np.float32(0.01720865), np.float32(0.00348418)
MINUS_LOG2_E = np.float32(-1.4426950408889634)
TWO_TO_32 = 4294967296.0
MOST_STEPS = np.float32(2**30)
"""more stored steps than any image has, and fewer than overflow an int32"""
BOUND_MARGIN = np.float32(0.999)
"""a chunk is skipped where its bound is below this part of the threshold: room for rounding"""
LOWEST_EXPONENT = np.float32(-100)
"""2 to the power of less is taken for 0, so that no product gets denormal, which costs 100 times as much"""

RAD_PER_DEG = np.float32(math.pi / 180)
DEGREES_PER_RAD, QUARTERS_PER_RAD, TEN = np.float32(180 / math.pi), np.float32(720 / math.pi), np.float32(10)
LAST_QUARTER, LAST_TENTH = np.float32(359), np.float32(899)
"""the last bins of the histograms"""

# Lines of `Scratch.aims`, `real` and `whole`.
SUN, VIEW, NORMAL = 0, 3 * CHUNK, 6 * CHUNK
(
    COS_I, COS_R, COS_L, ALPHA2, SUN_UP, COS_MIN, COS_MAX, NEGLIGIBLE, LIMIT, BOUND, SHAPE, W2, EXPONENTIAL, LOBE,
    SHARE, THRESHOLD, TILT,
    WEIGHT, SCATTER2, FACTOR, TURNS_W4, TURNS_W2, TURNS, BY_R, STRETCH, OF_MATERIAL, SPREAD, REACH, EXCESS, CROSS,
    BACK_VARIANCE, SKY, ALBEDO, BACK, BACK_SKY, DIFFUSE, DIFFUSE_RATE, BETA_RATE, BETA_SIGMA, SKY_SIGMA,
) = range(0, 40 * CHUNK, CHUNK)  # fmt: skip
(
    KIND, MISSING, SATURATES, ASSESS, HIT, OVER, CLIPS, MARKS, STATE, WAYS, TAKE, POWER, INCIDENCE_BIN, TILT_BIN,
    METHOD, AVERAGED, SKIES,
) = range(0, 17 * CHUNK, CHUNK)  # fmt: skip
# How a pixel is assessed.
LIT, SHADED = 1, 2

BLOCK: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
STEP: dict[str, Any] = {**BLOCK, "no_cpython_wrapper": True}
"""how `correct_block` and its steps are compiled: without reference counts, since nothing is allocated"""
BAND: dict[str, Any] = {**STEP, "forceinline": True}
"""and the steps of each band: a fifth of the time of a band went into calling them"""

# For `Extras`.
UNCERTAIN = np.uint16(1024)
SUBTRACT, RATIO, REFERENCE = 0, 1, 2
SKY_DEGREE, VARIANCE_DEGREE, LEAN_DEGREE = 12, 5, 4
