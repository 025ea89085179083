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
    DIFFUSE_RATE,
    EXCESS,
    FOUR,
    HALF,
    HIT,
    KIND,
    LEVEL,
    LIT,
    MARKS,
    METHOD,
    MISSING,
    NO_FLAG,
    OF_MATERIAL,
    ONE,
    QUARTER,
    RATIO,
    REACH,
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
    TAKE,
    TURNS,
    TURNS_W2,
    TURNS_W4,
    TWO,
    UNCERTAIN,
    W2,
    WAYS,
    WEIGHT,
    ZERO,
)
from tscorr.kernels.methods import set_parts, set_scatter


@njit(**BAND)
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
    hit_kinds = _hit_kinds(whole)
    if extras.simple:
        set_scatter(real, extras.scatter, row, start, stop)
    _set_turns(whole, real)
    if extras.view_variance[0] > 0:
        _add_view_turns(real, extras.view_variance[0])
    for b in range(bands):
        line, sigma, taken = image[b, row, start:stop], extras.sigma[b, row, start:stop], scratch.amounts[b]
        changed = False
        for place in range(peaks):
            q = present[place]
            if (hit_kinds >> (q & 31)) & 1 == 0:
                continue
            if b == 0 or not extras.same_variance[q, b]:
                _set_of_material(whole, real, np.int32(q), table.w2[q, b], extras.variance[q, b])
                changed = True
            if not plain:
                set_parts(whole, real, scratch.aims, np.int32(q), extras.sky[q, b], extras.parts[q, b])
                _set_cross(whole, real, np.int32(q), extras.cross[q, b])
        if changed:
            _set_spread(whole, real)
        if plain:
            _spread(sigma, taken, line, scale[b], offset[b], extras.noise[b], saturation[b], real)
        else:
            _spread_parts(sigma, taken, scratch.direct[b], line, scale[b], offset[b], saturation[b], whole, real)
    _mark_unsure(whole, real)


@njit(**BAND)
def _set_noise(sigma, line, scale, offset, noise, whole):
    """1 sigma of the image in one band; nan where it has no data."""
    a, b, nothing = np.float32(noise[0]), np.float32(noise[1]), np.float32(np.nan)
    for j in range(line.size):
        r = np.float32(line[j]) * np.float32(scale) + np.float32(offset)
        r = max(ZERO, r)
        sigma[j] = nothing if whole[MISSING + j] != 0 else a + b * r


@njit(**STEP)
def _hit_kinds(whole):
    """Which materials have pixels to correct: bits of their rows, modulo 32."""
    found = np.int32(0)
    for j in range(CHUNK):
        found |= whole[HIT + j] << (whole[KIND + j] & np.int32(31))
    return found


@njit(**STEP)
def _set_turns(whole, real):
    """Relative variance of the lobe from unsure normals: w^4, w^2 and constant parts. Nothing unsure so far.

    Twin of reference.direction_variance with `_add_view_turns`. One quotient gives the reciprocals of all cosines.
    Of pixels that are not lit it says nothing.
    """
    for j in range(CHUNK):
        cos_i, cos_r, cos_l = real[COS_I + j], real[COS_R + j], real[COS_L + j]
        alpha2, n2 = real[ALPHA2 + j], real[SCATTER2 + j]
        total, c2, product = cos_i + cos_r, cos_l * cos_l, cos_i * cos_r
        rest = total * cos_l
        per_all = ONE / (product * rest)
        per_product, per_rest = per_all * rest, per_all * product
        per_i, per_r, per_total, per_l = per_product * cos_r, per_product * cos_i, per_rest * cos_l, per_rest * total
        steeper = cos_i > cos_r  # the exitance
        inside = ((whole[WAYS + j] & SIMPLIFIED) != 0) | ((cos_r if steeper else cos_i) * total >= c2)
        level = (whole[WAYS + j] & LEVEL) != 0
        by_i = -per_i if inside else per_total - (per_i if steeper else ZERO)
        by_i = by_i + (per_i if level else ZERO)
        by_r = -per_r if inside else per_total - (ZERO if steeper else per_r)
        along = (HALF if level else ZERO) - (ONE if inside else ZERO)  # (by_i cos_i + by_r cos_r) / 2
        both = by_i + by_r
        stretch = ((T3 * alpha2 + T2) * alpha2 + T1) * alpha2 + ONE
        of_w2 = stretch * (both * cos_l - along * total * per_l)
        of_1 = both * both * QUARTER + by_i * by_r * (c2 - ONE) - along * along
        real[BY_R + j], real[STRETCH + j] = by_r, stretch
        n2 = n2 * FOUR
        real[TURNS_W4 + j] = n2 * (alpha2 + real[SCATTER2 + j])
        real[TURNS_W2 + j] = n2 * of_w2
        real[TURNS + j] = n2 * of_1
        real[EXCESS + j] = ZERO


@njit(**STEP)
def _add_view_turns(real, view_variance):
    """Add the variance from the direction to the sensor to that of `_set_turns`."""
    v2 = real.dtype.type(view_variance)
    for j in range(CHUNK):
        cos_r, per_l = real[COS_R + j], ONE / real[COS_L + j]
        lean, alpha2 = (cos_r - real[COS_I + j]) * HALF, real[ALPHA2 + j]
        by_r, stretch = real[BY_R + j], real[STRETCH + j]
        real[TURNS_W4 + j] += v2 * (alpha2 - stretch * stretch * lean * lean) * per_l * per_l
        real[TURNS_W2 + j] += v2 * TWO * by_r * (alpha2 / stretch - stretch * cos_r * lean) * per_l
        real[TURNS + j] += v2 * by_r * by_r * (ONE - cos_r * cos_r)


@njit(**BAND)
def _set_of_material(whole, real, kind, w2, c):
    """Relative variance of the lobe of one material in one band from its parameters, and its w^2."""
    c5, c4, c3, c2, c1, c0 = c[5], c[4], c[3], c[2], c[1], c[0]
    d4, d3, d2, d1, d0, by_alpha2 = c[10], c[9], c[8], c[7], c[6], c[11]
    for j in range(CHUNK):
        x = real[COS_L + j]
        rest = ((((c5 * x + c4) * x + c3) * x + c2) * x + c1) * x + c0
        lean = (((d4 * x + d3) * x + d2) * x + d1) * x + d0 - by_alpha2 * real[ALPHA2 + j]
        of_material = rest + lean * lean
        mine = whole[KIND + j] == kind
        real[OF_MATERIAL + j] = max(ZERO, of_material) if mine else real[OF_MATERIAL + j]
        real[W2 + j] = w2 if mine else real[W2 + j]


@njit(**STEP)
def _set_spread(whole, real):
    """Relative variance of the lobe where something is taken; nan where there are no data.

    And the `REACH`: an amount is unsure where it exceeds the signal when multiplied with 1 + 2 sigma.
    """
    for j in range(CHUNK):
        w2 = real[W2 + j]
        turned = (real[TURNS_W4 + j] * w2 + real[TURNS_W2 + j]) * w2 + real[TURNS + j]
        turned = max(ZERO, turned)
        take = (whole[ASSESS + j] == LIT) & (whole[HIT + j] != 0) & (whole[TAKE + j] != 0)
        spread = real[OF_MATERIAL + j] + turned if take else ZERO
        real[REACH + j] = ONE + TWO * np.sqrt(spread) if spread > ZERO else ZERO
        real[SPREAD + j] = spread if whole[MISSING + j] == 0 else real.dtype.type(np.nan)


@njit(**STEP)
def _set_cross(whole, real, kind, c):
    """Relative covariance of the lobe of one material and that at the reference geometry; variance of the latter."""
    for j in range(CHUNK):
        x = real[COS_L + j]
        at_top = ((((c[5] * x + c[4]) * x + c[3]) * x + c[2]) * x + c[1]) * x + c[0]
        mine = whole[KIND + j] == kind
        real[CROSS + j] = at_top + c[6] * real[ALPHA2 + j] if mine else real[CROSS + j]
        real[BACK_VARIANCE + j] = c[7] if mine else real[BACK_VARIANCE + j]


@njit(**BAND)
def _spread(sigma, amounts, line, scale, offset, noise, saturation, real):
    """1 sigma of one corrected band, and where that of what is removed exceeds half of what is left: subtraction."""
    base, share = real.dtype.type(noise[0]), real.dtype.type(noise[1])
    for j in range(line.size):
        value = real.dtype.type(line[j])
        a = amounts[j] if value < saturation else ZERO
        r = value * scale + offset
        r = max(ZERO, r)
        seen, excess = base + share * r, a * real[REACH + j] - r
        sigma[j] = np.sqrt(seen * seen + a * a * real[SPREAD + j])
        real[EXCESS + j] = max(real[EXCESS + j], excess)


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
        is_ratio, diffuse = whole[METHOD + j] == RATIO, real[DIFFUSE + j]
        of_beta -= specular_part * real[DIFFUSE_RATE + j] / (diffuse if diffuse > ZERO else ONE) if is_ratio else ZERO
        variance = error * error + sun * sun * (real[SPREAD + j] - real[OF_MATERIAL + j]) + of_beta * of_beta
        total = specular_part + diffuse
        per_total = ONE / (total if total > ZERO else ONE)
        change = real[WEIGHT + j] * (seen * diffuse * per_total * per_total if is_ratio else ONE)
        kept = ONE - real[WEIGHT + j] * specular_part * per_total if is_ratio else ONE
        variance = variance * change * change
        take = (a != ZERO) & (value < saturation)
        take = take & (whole[TAKE + j] != 0)
        sigma[j] = np.sqrt(noise * noise * kept * kept + variance) if take else noise
        excess = FOUR * variance - left * left if take else ZERO
        real[EXCESS + j] = max(real[EXCESS + j], excess)


@njit(**STEP)
def _mark_unsure(whole, real):
    """Flag the pixels that `_spread` found unsure."""
    for j in range(CHUNK):
        whole[MARKS + j] |= UNCERTAIN if real[EXCESS + j] > ZERO else NO_FLAG
