"""Sums over the pixels of a chunk for the report."""

import numpy as np
from numba import njit

from tscorr.kernels.equations import attenuation
from tscorr.kernels.layout import (
    ALPHA2,
    ASSESS,
    BLOCK,
    CHUNK,
    CORRECTED_STATE,
    COS_I,
    COS_L,
    COS_R,
    DEGREES_PER_RAD,
    HIT,
    INCIDENCE_BIN,
    KIND,
    LAST_QUARTER,
    LAST_TENTH,
    LIT,
    ONE,
    QUARTERS_PER_RAD,
    SHARE,
    SIMPLIFIED,
    STATE,
    STATE_SHIFT,
    STEP,
    TEN,
    TILT,
    TILT_BIN,
    TWO_TO_32,
    UNCERTAIN,
    UNCORRECTABLE_STATE,
    WAYS,
    ZERO,
)
from tscorr.kernels.pixels import arccos2


@njit(**STEP)
def count_states(whole, kind, count, states):
    """Pixels of one material by state."""
    negligible, corrected, uncorrectable, refused = np.int32(0), np.int32(0), np.int32(0), np.int32(0)
    for j in range(count):
        mine, state = whole[KIND + j] == kind, whole[STATE + j]
        negligible = np.int32(negligible + np.int32(mine & (state == 0)))
        corrected = np.int32(corrected + np.int32(mine & (state == 1)))
        uncorrectable = np.int32(uncorrectable + np.int32(mine & (state == 2)))
        refused = np.int32(refused + np.int32(mine & (state == 3)))
    states[kind, 0] += negligible
    states[kind, 1] += corrected
    states[kind, 2] += uncorrectable
    states[kind, 3] += refused


@njit(**STEP)
def tally_geometry(whole, real, count, tally):
    """Histograms of the angle of incidence and of the facet tilt over the assessed pixels of a chunk."""
    for j in range(CHUNK):
        u = ONE - real[COS_I + j]
        incidence = np.sqrt(arccos2(max(ZERO, u))) * QUARTERS_PER_RAD
        tilt = np.sqrt(real[ALPHA2 + j]) * DEGREES_PER_RAD
        real[TILT + j] = tilt
        assess = whole[ASSESS + j] == LIT
        whole[INCIDENCE_BIN + j] = np.int32(incidence if assess & (incidence < LAST_QUARTER) else LAST_QUARTER)
        whole[TILT_BIN + j] = np.int32(tilt * TEN if assess & (tilt * TEN < LAST_TENTH) else LAST_TENTH)
    for j in range(count):
        if whole[ASSESS + j] == LIT:
            q = whole[KIND + j]
            tally.incidence[q, whole[INCIDENCE_BIN + j]] += 1
            tally.tilt[q, whole[TILT_BIN + j]] += 1
            tally.extremes[q, 0] = min(tally.extremes[q, 0], np.float64(real[TILT + j]))


@njit(**STEP)
def tally_removed(whole, real, amounts, count, scale, tally):
    """Share, removed reflectance and the difference that G makes, over the pixels inside the lobe."""
    for j in range(count):
        if whole[HIT + j] != 0:
            q = whole[KIND + j]
            part = min(1.0, np.float64(real[SHARE + j]))
            tally.share[q, int(part * 200)] += 1
            tally.extremes[q, 1] = max(tally.extremes[q, 1], part)
            for b in range(scale.size):
                taken = np.float64(amounts[b, j]) * np.float64(scale[b])
                tally.removed[q, b] += np.int64(taken * TWO_TO_32 + 0.5)
            if whole[ASSESS + j] != LIT:
                continue
            g = attenuation(np.float64(real[COS_I + j]), np.float64(real[COS_R + j]), np.float64(real[COS_L + j]))
            change = 1 - g if (whole[WAYS + j] & SIMPLIFIED) != 0 else 1 / g - 1
            tally.attenuated[1] = max(tally.attenuated[1], part * change)


@njit(cache=True, **BLOCK)
def count_sigmas(bits, flags, rows, places, histogram, uncertain, touched):
    """Add a block to the sums of `SigmaTally`, over the pixels with something to remove.

    bits   : uint32 (bands, rows, cols), the bits of 1 sigma as float32.
    places : int32 (65536,), the bin of the histogram for the upper half of the bits; below 0: counted nowhere.
    """
    for i in range(flags.shape[0]):
        for j in range(flags.shape[1]):
            state = (flags[i, j] >> STATE_SHIFT) & 3
            if (state == CORRECTED_STATE) | (state == UNCORRECTABLE_STATE):
                touched[rows[i, j]] += 1
                uncertain[rows[i, j]] += (flags[i, j] & UNCERTAIN) != 0
        for b in range(bits.shape[0]):
            line = bits[b, i]
            for j in range(line.size):
                state = (flags[i, j] >> STATE_SHIFT) & 3
                place = places[line[j] >> 16]
                if ((state == CORRECTED_STATE) | (state == UNCORRECTABLE_STATE)) & (place >= 0):
                    histogram[rows[i, j], place] += 1
