"""Amounts against thresholds and signal, states of pixels, and what is taken from their values."""

import numpy as np
from numba import njit

from tscorr.kernels.layout import (
    ASSESS,
    BAND,
    BLANK,
    CHUNK,
    CLIPPED,
    CLIPS,
    ENDLESS,
    HALF,
    HIT,
    KEEP,
    LIMIT,
    MARKS,
    MOST_STEPS,
    NEGLIGIBLE,
    NO_FLAG,
    ONE,
    OVER,
    SATURATES,
    SHARE,
    STATE,
    STATE_SHIFT,
    STEP,
    TAKE,
    THRESHOLD,
    TWO,
    UNCORRECTABLE_STATE,
    WAYS,
    ZERO,
)


@njit(**STEP)
def clear(whole, real):
    """Nothing weighed so far; a pixel that is not assessed has a threshold that nothing reaches."""
    for j in range(CHUNK):
        real[THRESHOLD + j] = real[NEGLIGIBLE + j] if whole[ASSESS + j] != 0 else ENDLESS
        real[SHARE + j] = ZERO
        whole[HIT + j] = 0
        whole[OVER + j] = 0


@njit(**BAND)
def weigh(amounts, line, scale, offset, whole, real):
    """One band's amounts against threshold and signal; amounts below the threshold become 0."""
    for j in range(line.size):
        a = amounts[j]
        above = a >= real[THRESHOLD + j]
        r = real.dtype.type(line[j]) * scale + offset
        amounts[j] = a if above else ZERO
        whole[HIT + j] |= np.int32(above)
        whole[OVER + j] |= np.int32(above & ((a > real[LIMIT + j] * r) | (r <= ZERO)))


@njit(**STEP)
def set_share(amounts, line, scale, offset, real):
    """The largest share of the signal so far; 2 where there is something to take and no signal."""
    for j in range(line.size):
        a = amounts[j]
        r = real.dtype.type(line[j]) * scale + offset
        bright = r > ZERO
        part = (a if bright else TWO) / (r if bright else ONE)
        part = part if a > ZERO else ZERO
        real[SHARE + j] = max(real[SHARE + j], part)


@njit(**STEP)
def settle(whole):
    """SPECULAR_STATE from what `weigh` found in all bands; how many pixels to correct, and of them to blank."""
    hits, blanks = np.int32(0), np.int32(0)
    for j in range(CHUNK):
        hit, ways = whole[HIT + j], whole[WAYS + j]
        over = (whole[OVER + j] | whole[SATURATES + j]) & hit
        whole[STATE + j] |= hit + over
        whole[TAKE + j] = (over == 0) | ((ways & (KEEP | BLANK)) == 0)
        hits = np.int32(hits + hit)
        blanks = np.int32(blanks + np.int32((over != 0) & ((ways & BLANK) != 0)))
    return hits, blanks


@njit(**BAND)
def subtract(amounts, line, rules, b, whole, real):
    """One band less its amounts, in whole steps and held above 0; `amounts` become what was taken.

    In floating point the result is the difference of the two as they are stored, and so exactly input - removed.
    """
    steps, least, saturation = rules.steps[b], rules.lowest[b], rules.saturation[b]
    dodges, integer, blank = rules.dodge, rules.integer, real.dtype.type(rules.nodata[0])
    for j in range(line.size):
        value = real.dtype.type(line[j])
        part = amounts[j] * steps
        if integer is None:
            part = real.dtype.type(line.dtype.type(part))
        else:
            part = part + HALF
            part = real.dtype.type(np.int32(min(MOST_STEPS, part)))
        new = value - part
        low = new < least
        floor = min(value, least)
        new = floor if low else new
        dodge = dodges & (new == blank)
        new = new + ONE if dodge else new
        take = (amounts[j] != ZERO) & (value < saturation)
        take = take & (whole[TAKE + j] != 0)
        whole[CLIPS + j] |= np.int32(take & (low | dodge))
        taken = value - new if take else ZERO
        if integer is None:
            taken = real.dtype.type(line.dtype.type(taken))
            new = value - taken
        amounts[j] = taken
        line[j] = new if take else value


@njit(**BAND)
def keep(amounts, taken, whole):
    """Write down what was taken from one band."""
    for j in range(taken.size):
        taken[j] = amounts[j] if whole[HIT + j] != 0 else taken[j]


@njit(**STEP)
def blank_out(line, nodata, whole):
    """Nodata where a pixel is uncorrectable and its material wants it so."""
    for j in range(line.size):
        if whole[STATE + j] == UNCORRECTABLE_STATE and (whole[WAYS + j] & BLANK) != 0:
            line[j] = nodata


@njit(**STEP)
def store(marks, whole):
    """Flags of a chunk, complete."""
    for j in range(marks.size):
        f = whole[MARKS + j] | (CLIPPED if whole[CLIPS + j] != 0 else NO_FLAG)
        marks[j] = f | (whole[STATE + j] << STATE_SHIFT)
