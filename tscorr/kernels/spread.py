"""1 sigma of each corrected value of a chunk, and which of them are unsure."""

import numpy as np
from numba import njit

from tscorr.kernels.layout import (
    ALBEDO,
    ALPHA2,
    ASSESS,
    BACK,
    BACK_SKY,
    BACK_VARIANCE,
    BAND,
    BETA_RATE,
    BETA_SIGMA,
    BY_R,
    CHUNK,
    COS_I,
    COS_L,
    COS_R,
    CROSS,
    DIFFUSE,
    FOUR,
    HALF,
    HOLE,
    KIND,
    LEVEL,
    LIT,
    MARKS,
    METHOD,
    MISSING,
    NO_FLAG,
    OF_MATERIAL,
    ONE,
    RATIO,
    SCATTER2,
    SIMPLIFIED,
    SKY,
    SKY_SIGMA,
    SPREAD,
    STEP,
    STRETCH,
    T1,
    T2,
    T3,
    T4,
    T5,
    TAKE,
    TURNS,
    TURNS_W2,
    TURNS_W4,
    TWO,
    UNCERTAIN,
    UNSURE,
    WAYS,
    WEIGHT,
    ZERO,
)
from tscorr.kernels.methods import set_parts


@njit(**STEP)
def set_sigma(scratch, table, extras, peaks, hits, plain, image, row, start, stop, rules):
    """1 sigma of the corrected values of a chunk, before they are corrected; and flags of those that are unsure."""
    real, whole, present = scratch.real, scratch.whole, scratch.present
    scale, offset, saturation = rules.scale, rules.offset, rules.saturation
    bands = len(image)
    for b in range(bands if hits == 0 or not plain else 0):
        line = image[b, row, start:stop]
        _set_noise(extras.sigma[b, row, start:stop], line, scale[b], offset[b], extras.noise[b], whole)
    if hits == 0:
        return
    _set_holes(whole, real)
    _set_turns(whole, real)
    if extras.view_variance[0] > 0:
        _add_view_turns(whole, real, extras.view_variance[0])
    for b in range(bands):
        line, sigma, taken = image[b, row, start:stop], extras.sigma[b, row, start:stop], scratch.amounts[b]
        for place in range(peaks):
            q = present[place]
            if b == 0 or not extras.same_variance[q, b]:
                _set_spread(whole, real, np.int32(q), table.w2[q, b], extras.variance[q, b])
            if not plain:
                set_parts(whole, real, scratch.aims, np.int32(q), extras.sky[q, b], extras.parts[q, b])
                _set_cross(whole, real, np.int32(q), extras.cross[q, b], extras.variance[q, b])
        if plain:
            _spread(sigma, taken, line, scale[b], offset[b], extras.noise[b], saturation[b], whole, real)
        else:
            _spread_parts(sigma, taken, scratch.direct[b], line, scale[b], offset[b], saturation[b], whole, real)
    _mark_unsure(whole)


@njit(**BAND)
def _set_noise(sigma, line, scale, offset, noise, whole):
    """1 sigma of the image in one band; nan where it has no data."""
    a, b, nothing = np.float32(noise[0]), np.float32(noise[1]), np.float32(np.nan)
    for j in range(line.size):
        r = np.float32(line[j]) * np.float32(scale) + np.float32(offset)
        r = max(ZERO, r)
        sigma[j] = nothing if whole[MISSING + j] != 0 else a + b * r


@njit(**STEP)
def _set_holes(whole, real):
    """1 where there is data, else nan."""
    for j in range(CHUNK):
        real[HOLE + j] = ONE if whole[MISSING + j] == 0 else real.dtype.type(np.nan)


@njit(**STEP)
def _set_turns(whole, real):
    """Relative variance of the lobe from unsure normals: w^4, w^2 and constant parts.

    Twin of reference.direction_variance with `_add_view_turns`. alpha / sin alpha by its series in alpha^2, good to
    1e-4 up to 90 degrees.
    """
    for j in range(CHUNK):
        good = whole[ASSESS + j] == LIT
        cos_i, cos_r = real[COS_I + j] if good else ONE, real[COS_R + j] if good else ONE
        cos_l, alpha2, n2 = real[COS_L + j] if good else ONE, real[ALPHA2 + j], real[SCATTER2 + j]
        total = cos_i + cos_r
        per_i, per_r, per_total = ONE / cos_i, ONE / cos_r, ONE / total
        steeper = cos_i > cos_r  # the exitance
        inside = ((whole[WAYS + j] & SIMPLIFIED) != 0) | ((cos_r if steeper else cos_i) * total >= cos_l * cos_l)
        by_i = -per_i if inside else per_total - (per_i if steeper else ZERO)
        by_i = by_i + (per_i if (whole[WAYS + j] & LEVEL) != 0 else ZERO)
        by_r = -per_r if inside else per_total - (ZERO if steeper else per_r)
        along_i, along_r = by_i * cos_i, by_r * cos_r
        c2, both = cos_l * cos_l, by_i + by_r
        stretch = ((((T5 * alpha2 + T4) * alpha2 + T3) * alpha2 + T2) * alpha2 + T1) * alpha2 + ONE
        of_w2 = stretch * (both * cos_l - (along_i + along_r) * total * HALF / cos_l)
        across = by_i * by_r * (c2 - ONE)
        of_1 = both * both + FOUR * across - (along_i + along_r) * (along_i + along_r)
        real[BY_R + j], real[STRETCH + j] = by_r, stretch
        real[TURNS_W4 + j] = n2 * FOUR * (alpha2 + n2)
        real[TURNS_W2 + j] = n2 * FOUR * of_w2
        real[TURNS + j] = n2 * of_1


@njit(**STEP)
def _add_view_turns(whole, real, view_variance):
    """Add the variance from the direction to the sensor to that of `_set_turns`."""
    v2 = real.dtype.type(view_variance)
    for j in range(CHUNK):
        good = whole[ASSESS + j] == LIT
        cos_r, per_l = real[COS_R + j] if good else ONE, ONE / (real[COS_L + j] if good else ONE)
        lean, alpha2 = (cos_r - (real[COS_I + j] if good else ONE)) * HALF, real[ALPHA2 + j]
        by_r, stretch = real[BY_R + j], real[STRETCH + j]
        real[TURNS_W4 + j] += v2 * (alpha2 - stretch * stretch * lean * lean) * per_l * per_l
        real[TURNS_W2 + j] += v2 * TWO * by_r * (alpha2 / stretch - stretch * cos_r * lean) * per_l
        real[TURNS + j] += v2 * by_r * by_r * (ONE - cos_r * cos_r)


@njit(**BAND)
def _set_spread(whole, real, kind, w2, c):
    """Relative variance of the lobe of one material in one band: from its parameters, and with the directions."""
    c5, c4, c3, c2, c1, c0 = c[5], c[4], c[3], c[2], c[1], c[0]
    d5, d4, d3, d2, d1, d0 = c[11], c[10], c[9], c[8], c[7], c[6]
    of_alpha4, scale, shift = c[12], c[13], c[14]
    for j in range(CHUNK):
        x, alpha2 = real[COS_L + j] * scale + shift, real[ALPHA2 + j]
        at_top = ((((c5 * x + c4) * x + c3) * x + c2) * x + c1) * x + c0
        by_alpha2 = ((((d5 * x + d4) * x + d3) * x + d2) * x + d1) * x + d0
        of_material = at_top + alpha2 * (by_alpha2 + alpha2 * of_alpha4)
        of_material = max(ZERO, of_material)
        turned = (real[TURNS_W4 + j] * w2 + real[TURNS_W2 + j]) * w2 + real[TURNS + j]
        turned = max(ZERO, turned)
        mine = whole[KIND + j] == kind
        real[OF_MATERIAL + j] = of_material if mine else real[OF_MATERIAL + j]
        real[SPREAD + j] = of_material + turned if mine else real[SPREAD + j]


@njit(**STEP)
def _set_cross(whole, real, kind, c, variance):
    """Relative covariance of the lobe of one material and that at the reference geometry; variance of the latter."""
    scale, shift = variance[13], variance[14]
    for j in range(CHUNK):
        x = real[COS_L + j] * scale + shift
        at_top = ((((c[5] * x + c[4]) * x + c[3]) * x + c[2]) * x + c[1]) * x + c[0]
        mine = whole[KIND + j] == kind
        real[CROSS + j] = at_top + c[6] * real[ALPHA2 + j] if mine else real[CROSS + j]
        real[BACK_VARIANCE + j] = c[7] if mine else real[BACK_VARIANCE + j]


@njit(**BAND)
def _spread(sigma, amounts, line, scale, offset, noise, saturation, whole, real):
    """1 sigma of one corrected band, and where that of what is removed exceeds half of what is left: subtraction."""
    base, share = real.dtype.type(noise[0]), real.dtype.type(noise[1])
    for j in range(line.size):
        a, value = amounts[j], real.dtype.type(line[j])
        a = a if (value < saturation) & (whole[TAKE + j] != 0) else ZERO
        r = value * scale + offset
        left = r - a if r > a else ZERO
        variance = a * a * real[SPREAD + j]
        seen = base + share * (max(ZERO, r))
        sigma[j] = np.sqrt(seen * seen + variance) * real[HOLE + j]
        whole[UNSURE + j] |= np.int32(FOUR * variance > left * left)


@njit(**STEP)
def _spread_parts(sigma, amounts, direct, line, scale, offset, saturation, whole, real):
    """`_spread` for any method and with the sky's part: twin of the sigma in correction.oracle."""
    for j in range(line.size):
        a, value, noise, sun = amounts[j], real.dtype.type(line[j]), real.dtype.type(sigma[j]), direct[j]
        r = value * scale + offset
        seen = max(ZERO, r)
        left = r - a
        left = max(ZERO, left)
        back, specular_part = real[BACK + j], sun + real[SKY + j]
        of_material = sun * sun * real[OF_MATERIAL + j] + back * (
            back * real[BACK_VARIANCE + j] - TWO * sun * real[CROSS + j]
        )
        error = np.sqrt(max(ZERO, of_material))
        error = error + abs(real[SKY + j] - real[BACK_SKY + j]) * real[SKY_SIGMA + j]
        of_beta = (sun - back) * real[BETA_RATE + j] - real[ALBEDO + j] * real[BETA_SIGMA + j]
        variance = error * error + sun * sun * (real[SPREAD + j] - real[OF_MATERIAL + j]) + of_beta * of_beta
        total = specular_part + real[DIFFUSE + j]
        per_total = ONE / (total if total > ZERO else ONE)
        is_ratio = whole[METHOD + j] == RATIO
        change = real[WEIGHT + j] * (seen * real[DIFFUSE + j] * per_total * per_total if is_ratio else ONE)
        kept = ONE - real[WEIGHT + j] * specular_part * per_total if is_ratio else ONE
        variance = variance * change * change
        take = (a != ZERO) & (value < saturation)
        take = take & (whole[TAKE + j] != 0)
        sigma[j] = np.sqrt(noise * noise * kept * kept + variance) if take else noise
        whole[UNSURE + j] |= np.int32(take & (FOUR * variance > left * left))


@njit(**STEP)
def _mark_unsure(whole):
    """Flag the pixels that `_spread` found unsure."""
    for j in range(CHUNK):
        whole[MARKS + j] |= UNCERTAIN if whole[UNSURE + j] != 0 else NO_FLAG
