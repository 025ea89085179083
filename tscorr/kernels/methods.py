"""What only some runs ask of the correction: other methods, the light of the sky, weights, scattered normals."""

import math

import numpy as np
from numba import njit

from tscorr.kernels.layout import (
    ALBEDO,
    ASSESS,
    AVERAGED,
    BACK,
    BACK_SKY,
    BAND,
    BETA_RATE,
    BETA_SIGMA,
    CAST_SHADOW,
    CHUNK,
    CLIPS,
    COS_I,
    COS_MAX,
    COS_MIN,
    COS_R,
    DIFFUSE,
    DIFFUSE_RATE,
    GRAZING,
    HALF,
    HIT,
    KIND,
    LEVEL,
    LIMIT,
    LIT,
    MARKS,
    METHOD,
    MISSING,
    MOST_STEPS,
    NEGLIGIBLE,
    NEGLIGIBLE_STATE,
    NORMAL,
    NOT_VIEWED,
    ONE,
    OVER,
    RAD_PER_DEG,
    RATIO,
    REFERENCE,
    REFUSED_STATE,
    SCATTER2,
    SELF_SHADOW,
    SHADED,
    SHARE,
    SKIES,
    SKY,
    SKY_DEGREE,
    SKY_SIGMA,
    STATE,
    STEP,
    SUBTRACT,
    SUN_UP,
    TAKE,
    TWO,
    WAYS,
    WEIGHT,
    ZERO,
)


@njit(**BAND)
def set_extras(scratch, extras, peaks, row, start, stop):
    """What only some runs have of a chunk; True if all its materials are simply subtracted, without the sky."""
    real, whole, present, plain = scratch.real, scratch.whole, scratch.present, True
    if extras.weight.size > 1 or not extras.simple:
        _set_weight(real, extras.weight, row, start, stop)
    if not extras.simple:
        set_scatter(real, extras.scatter, row, start, stop)
        _clear_rules(whole)
    for place in range(0 if extras.simple else peaks):
        q = present[place]
        method, averaged, has_sky = (
            np.int32(extras.method[q]),
            np.int32(extras.averaged[q]),
            np.int32(extras.has_sky[q]),
        )
        _set_more(whole, real, np.int32(q), method, averaged, has_sky, extras.own_scatter[q])
        plain &= extras.method[q] == SUBTRACT and not extras.has_sky[q]
    return plain


@njit(**STEP)
def _set_weight(real, weight, row, start, stop):
    """Weights of a chunk."""
    if weight.size == 1:
        for j in range(CHUNK):
            real[WEIGHT + j] = weight[0, 0]
    else:
        line = weight[row, start:stop]
        for j in range(line.size):
            real[WEIGHT + j] = line[j]


@njit(**STEP)
def set_scatter(real, scatter, row, start, stop):
    """Variance of the normals of a chunk along each of two axes. [rad^2]"""
    if scatter.size == 1:
        sigma = scatter[0, 0] * RAD_PER_DEG
        for j in range(CHUNK):
            real[SCATTER2 + j] = sigma * sigma
    else:
        line = scatter[row, start:stop]
        for j in range(line.size):
            sigma = line[j] * RAD_PER_DEG
            real[SCATTER2 + j] = sigma * sigma


@njit(**STEP)
def _clear_rules(whole):
    """No rules of the kind that only some runs have."""
    for j in range(CHUNK):
        whole[AVERAGED + j] = 0
        whole[SKIES + j] = 0


@njit(**STEP)
def _set_more(whole, real, kind, method, averaged, has_sky, own_scatter):
    """The rules of one material for its pixels that only some runs have."""
    own, sigma = not math.isnan(own_scatter), own_scatter * RAD_PER_DEG
    for j in range(CHUNK):
        mine = whole[KIND + j] == kind
        whole[METHOD + j] = method if mine else whole[METHOD + j]
        whole[AVERAGED + j] = averaged if mine else whole[AVERAGED + j]
        whole[SKIES + j] = has_sky if mine else whole[SKIES + j]
        real[SCATTER2 + j] = sigma * sigma if mine & own else real[SCATTER2 + j]


@njit(**STEP)
def assess_shaded(whole, real):
    """Assess pixels in shadow for the light of the sky, where their material wants it; the number that is added."""
    total = np.int32(0)
    for j in range(CHUNK):
        f = whole[MARKS + j]
        shadow = (f & (SELF_SHADOW | CAST_SHADOW)) != 0
        steep = (real[COS_R + j] >= real[COS_MIN + j]) & (real[COS_R + j] <= real[COS_MAX + j])
        wanted = (whole[SKIES + j] != 0) & (whole[STATE + j] == REFUSED_STATE) & (whole[MISSING + j] == 0)
        shaded = wanted & shadow & steep & ((f & (NOT_VIEWED | GRAZING)) == 0)
        whole[ASSESS + j] = np.int32(SHADED) if shaded else whole[ASSESS + j]
        whole[STATE + j] = np.int32(NEGLIGIBLE_STATE) if shaded else whole[STATE + j]
        total = np.int32(total + np.int32(shaded))
    return total


@njit(**BAND)
def weigh_any(scratch, extras, peaks, line, rules, b):
    """`weigh` for any method, and with the sky's part."""
    for place in range(peaks):
        q = scratch.present[place]
        set_parts(scratch.whole, scratch.real, scratch.aims, np.int32(q), extras.sky[q, b], extras.parts[q, b])
    _weigh_parts(
        scratch.amounts[b], scratch.direct[b], line, rules.scale[b], rules.offset[b], scratch.whole, scratch.real
    )


@njit(**STEP)
def set_parts(whole, real, aims, kind, sky, parts):
    """What one band of one material adds and shows besides the sun's lobe: sky, reference geometry, diffuse part."""
    of_sky, diffuse_sun, diffuse_sky, back, back_sky = parts[0], parts[1], parts[2], parts[3], parts[4]
    rate, sigma, sky_sigma, diffuse_sigma = parts[5], parts[6], parts[7], parts[8]
    scale, shift = sky[SKY_DEGREE + 1], sky[SKY_DEGREE + 2]
    s0, s1, s2, s3, s4, s5, s6 = sky[0], sky[1], sky[2], sky[3], sky[4], sky[5], sky[6]
    s7, s8, s9, s10, s11, s12 = sky[7], sky[8], sky[9], sky[10], sky[11], sky[12]
    for j in range(CHUNK):
        mine, level = whole[KIND + j] == kind, (whole[WAYS + j] & LEVEL) != 0
        lit, good = whole[ASSESS + j] == LIT, whole[ASSESS + j] != 0
        x = real[COS_R + j] * scale + shift
        a = (((((s12 * x + s11) * x + s10) * x + s9) * x + s8) * x + s7) * x + s6
        a = (((((a * x + s5) * x + s4) * x + s3) * x + s2) * x + s1) * x + s0
        plane = real[COS_I + j] / real[SUN_UP + j] if level else ONE
        sky_view = (ONE + real.dtype.type(aims[NORMAL + 2 * CHUNK + j])) * HALF if level else ONE
        plane = plane if lit else ZERO
        shown = diffuse_sun * plane + diffuse_sky * sky_view
        real[SKY + j] = (of_sky * a if good else ZERO) if mine else real[SKY + j]
        real[ALBEDO + j] = a - back_sky if mine else real[ALBEDO + j]
        real[BACK + j] = (back if lit else ZERO) if mine else real[BACK + j]
        real[BACK_SKY + j] = (of_sky * back_sky if good else ZERO) if mine else real[BACK_SKY + j]
        real[DIFFUSE + j] = shown if mine else real[DIFFUSE + j]
        real[DIFFUSE_RATE + j] = diffuse_sigma * (plane - sky_view) if mine else real[DIFFUSE_RATE + j]
        real[BETA_RATE + j] = rate if mine else real[BETA_RATE + j]
        real[BETA_SIGMA + j] = sigma if mine else real[BETA_SIGMA + j]
        real[SKY_SIGMA + j] = sky_sigma if mine else real[SKY_SIGMA + j]


@njit(**STEP)
def _weigh_parts(amounts, direct, line, scale, offset, whole, real):
    """`weigh` for any method and with the sky's part; the sun's part is kept in `direct`."""
    for j in range(line.size):
        sun = amounts[j]
        direct[j] = sun
        r = real.dtype.type(line[j]) * scale + offset
        bright = r > ZERO
        specular_part = sun + real[SKY + j]
        modelled = real[WEIGHT + j] * specular_part
        total = specular_part + real[DIFFUSE + j]
        adds = whole[METHOD + j] == REFERENCE
        of_ratio = (r if bright else ZERO) * modelled / (total if total > ZERO else ONE)
        normalised = real[WEIGHT + j] * (specular_part - (real[BACK + j] + real[BACK_SKY + j]))
        a = normalised if adds else of_ratio if whole[METHOD + j] == RATIO else modelled
        tested = abs(a) if adds else modelled
        above = (whole[ASSESS + j] != 0) & (tested >= real[NEGLIGIBLE + j]) & (tested > ZERO)
        part = ((modelled if adds else a) if bright else TWO) / (r if bright else ONE)
        part = part if above else ZERO
        real[SHARE + j] = max(real[SHARE + j], part)
        amounts[j] = a if above else ZERO
        whole[HIT + j] |= np.int32(above)
        whole[OVER + j] |= np.int32(above & (part > real[LIMIT + j]))


@njit(**STEP)
def exchange(amounts, line, rules, b, highest, whole, real):
    """`subtract` for amounts of either sign; the new value is held above 0 and in the range of the type."""
    steps, least, saturation = rules.steps[b], rules.lowest[b], rules.saturation[b]
    dodges, integer, blank = rules.dodge, rules.integer, real.dtype.type(rules.nodata[0])
    for j in range(line.size):
        value = real.dtype.type(line[j])
        part = amounts[j] * steps
        if integer is None:
            part = real.dtype.type(line.dtype.type(part))
        else:
            part = np.floor(part + HALF)
            part = min(MOST_STEPS, part)
        new = value - part
        low, most = new < least, max(value, highest)
        floor = min(value, least)
        new = floor if low else new
        high = new > most
        new = most if high else new
        dodge = dodges & (new == blank)
        new = new + ONE if dodge else new
        take = (amounts[j] != ZERO) & (value < saturation) & (whole[TAKE + j] != 0)
        whole[CLIPS + j] |= np.int32(take & (low | high | dodge))
        taken = value - new if take else ZERO
        if integer is None:
            taken = real.dtype.type(line.dtype.type(taken))
            new = value - taken
        amounts[j] = taken
        line[j] = new if take else value
