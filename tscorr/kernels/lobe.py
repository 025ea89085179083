"""What the specular lobe adds to each pixel of a chunk, band by band."""

import math

import numpy as np
from numba import njit

from tscorr.kernels.equations import fresnel, geometry, specular
from tscorr.kernels.layout import (
    ALPHA2,
    ASSESS,
    AVERAGED,
    BAND,
    BOUND,
    BOUND_MARGIN,
    CHUNK,
    COS_I,
    COS_L,
    COS_R,
    E1,
    E2,
    E3,
    E4,
    E5,
    E6,
    EXPONENTIAL,
    FACTOR,
    FRESNEL_DEGREE,
    HALF,
    KIND,
    LEVEL,
    LIT,
    LOBE,
    LOWEST_EXPONENT,
    MINUS_LOG2_E,
    NEGLIGIBLE,
    NORMAL,
    ONE,
    POWER,
    REFERENCE,
    SCATTER2,
    SHAPE,
    SIMPLIFIED,
    STEP,
    SUBTRACT,
    SUN,
    SUN_UP,
    TWO,
    VIEW,
    W2,
    WAYS,
    WEIGHT,
    ZERO,
)


@njit(**STEP)
def set_shape(whole, real):
    """G / (cos_i cos_r), on the plane that R refers to; finite at grazing angles. The number of pixels with G < 1."""
    attenuated = np.int32(0)
    for j in range(CHUNK):
        good = whole[ASSESS + j] == LIT
        cos_i, cos_r, cos_l = real[COS_I + j], real[COS_R + j], real[COS_L + j]
        least = min(cos_r, cos_i)
        most = max(cos_i, cos_r)
        total = cos_i + cos_r
        c2 = cos_l * cos_l
        inside = least * total >= c2
        attenuated = np.int32(attenuated + np.int32(good & (not inside)))
        all_of_it = ((whole[WAYS + j] & SIMPLIFIED) != 0) | inside
        numerator = ONE if all_of_it else total
        denominator = cos_i * cos_r if all_of_it else most * c2
        level = (whole[WAYS + j] & LEVEL) != 0
        numerator = numerator * (cos_i if level else ONE)
        denominator = denominator * (real[SUN_UP + j] if level else ONE)
        real[SHAPE + j] = (numerator if good else ZERO) / (denominator if good else ONE)
    return attenuated


@njit(**BAND)
def set_amounts(scratch, table, peaks, skip, equations, extras):
    """The reflectance to remove in each band; False, and none of it, if the chunk is out of every lobe.

    Bands with the same w, n, k share the lobe. A chunk is out of it where the largest pi beta t1 F times the
    exponential stays below the threshold everywhere, which one exponential tells if all bands have the same w.
    """
    aims, real, whole, power, amounts, _, present = scratch
    may_skip, scattered, weighted = skip, False, False
    if extras is not None:
        weighted = extras.weight.size > 1
        for place in range(peaks):
            q = present[place]
            may_skip &= extras.method[q] != REFERENCE and not extras.has_sky[q]
            weighted &= extras.method[q] == SUBTRACT and not extras.has_sky[q]
            scattered |= extras.averaged[q]
    for place in range(peaks):
        may_skip &= table.one_w[present[place]]
    for b in range(len(amounts)):
        again = b == 0
        for place in range(peaks):
            again |= not table.shared[present[place], b]
        if again:
            if equations is None:
                for place in range(peaks):
                    q = present[place]
                    _set_w2(whole, real, np.int32(q), table.w2[q, b])
                if scattered:
                    _set_factors(whole, real, present[:peaks], table.w2[:, b])
                _set_exponential(whole, real, power)
                if scattered:
                    _scale(real, EXPONENTIAL, FACTOR)
                if weighted:
                    _scale(real, EXPONENTIAL, WEIGHT)
                if may_skip and b == 0 and _is_outside(real):
                    return False
                for place in range(peaks):
                    q = present[place]
                    _set_lobe(whole, real, np.int32(q), table.fresnel[q, b], table.n[q, b], table.k[q, b])
            else:
                if scattered:
                    _set_factors(whole, real, present[:peaks], table.w2[:, b])
                _set_lobe_by_equations(whole, real, aims, table.w[:, b], table.n[:, b], table.k[:, b])
                if weighted:
                    _scale(real, LOBE, WEIGHT)
        _set_amounts_of_all(real, amounts[b], table.gain[present[0], b])
        for place in range(1, peaks):
            q = present[place]
            _set_amount(whole, real, amounts[b], np.int32(q), table.gain[q, b])
    return True


@njit(**STEP)
def _set_lobe_by_equations(whole, real, aims, w, n, k):
    """f_spec of all materials of a chunk in one band, on the plane that R refers to."""
    for j in range(CHUNK):
        real[LOBE + j] = ZERO
        if whole[ASSESS + j] == LIT:
            q = whole[KIND + j]
            factor = np.float64(real[FACTOR + j])
            sun = (aims[SUN + j], aims[SUN + CHUNK + j], aims[SUN + 2 * CHUNK + j])
            view = (aims[VIEW + j], aims[VIEW + CHUNK + j], aims[VIEW + 2 * CHUNK + j])
            normal = (aims[NORMAL + j], aims[NORMAL + CHUNK + j], aims[NORMAL + 2 * CHUNK + j])
            angles = geometry(sun, view, normal)
            f = factor * specular(angles, w[q] * math.sqrt(factor), n[q], k[q], (whole[WAYS + j] & SIMPLIFIED) != 0)
            real[LOBE + j] = f * angles[0] / sun[2] if (whole[WAYS + j] & LEVEL) != 0 else f


@njit(**STEP)
def _set_w2(whole, real, kind, w2):
    """w^2 of the pixels of one material."""
    for j in range(CHUNK):
        real[W2 + j] = w2 if whole[KIND + j] == kind else real[W2 + j]


@njit(**STEP)
def _set_factors(whole, real, kinds, w2):
    """Broaden the lobes of materials whose scattered normals are averaged."""
    for q in kinds:
        _set_w2(whole, real, np.int32(q), w2[q])
    _set_factor(whole, real)
    _scale(real, W2, FACTOR)


@njit(**STEP)
def _set_factor(whole, real):
    """(w_eff / w)^2 of the lobe averaged over scattered normals: twin of reference.broadened."""
    for j in range(CHUNK):
        factor = ONE / (ONE + TWO * real[W2 + j] * real[SCATTER2 + j])
        real[FACTOR + j] = factor if whole[AVERAGED + j] != 0 else ONE


@njit(**STEP)
def _scale(real, place, factor):
    """One line times another."""
    for j in range(CHUNK):
        real[place + j] *= real[factor + j]


@njit(**STEP)
def _set_exponential(whole, real, power):
    """exp(-w^2 alpha^2) times the shape: 2^x from the whole part of x as bits and a polynomial of the rest.

    power : the memory of whole[POWER:], read as float32.
    """
    for j in range(CHUNK):
        x = real[W2 + j] * real[ALPHA2 + j] * MINUS_LOG2_E
        above = x > LOWEST_EXPONENT
        x = x if above else ZERO
        nearest = np.int32(x - HALF)  # x <= 0
        whole[POWER + j] = (nearest + np.int32(127)) << np.int32(23) if above else np.int32(0)
        real[EXPONENTIAL + j] = x - np.float32(nearest)
    for j in range(CHUNK):
        x = real[EXPONENTIAL + j]
        p = (((((E6 * x + E5) * x + E4) * x + E3) * x + E2) * x + E1) * x + ONE
        real[EXPONENTIAL + j] = p * power[j] * real[SHAPE + j]


@njit(**STEP)
def _is_outside(real):
    """Whether no pixel of the chunk can have as much as its threshold to remove."""
    inside = np.int32(0)
    for j in range(CHUNK):
        inside |= np.int32(real[BOUND + j] * real[EXPONENTIAL + j] >= real[NEGLIGIBLE + j] * BOUND_MARGIN)
    return inside == 0


@njit(**STEP)
def _set_lobe(whole, real, kind, c, n, k):
    """f_spec of the pixels of one material: F times the exponential; F by polynomial or, where scale is 0, exact."""
    scale, shift = c[FRESNEL_DEGREE + 1], c[FRESNEL_DEGREE + 2]
    if scale == 0:
        for j in range(CHUNK):
            if whole[KIND + j] == kind:
                real[LOBE + j] = fresnel(np.float64(real[COS_L + j]), n, k) * real[EXPONENTIAL + j]
    else:
        f0, f1, f2, f3, f4, f5, f6 = c[0], c[1], c[2], c[3], c[4], c[5], c[6]
        f7, f8, f9, f10, f11, f12 = c[7], c[8], c[9], c[10], c[11], c[12]
        for j in range(CHUNK):
            x = real[COS_L + j] * scale + shift
            f = (((((f12 * x + f11) * x + f10) * x + f9) * x + f8) * x + f7) * x + f6
            f = (((((f * x + f5) * x + f4) * x + f3) * x + f2) * x + f1) * x + f0
            real[LOBE + j] = f * real[EXPONENTIAL + j] if whole[KIND + j] == kind else real[LOBE + j]


@njit(**BAND)
def _set_amounts_of_all(real, amounts, gain):
    """Amounts in one band as if all pixels were of one material; those that are not assessed are not looked at."""
    for j in range(CHUNK):
        amounts[j] = gain * real[LOBE + j]


@njit(**BAND)
def _set_amount(whole, real, amounts, kind, gain):
    """Amount of the pixels of one material in one band."""
    for j in range(CHUNK):
        amounts[j] = gain * real[LOBE + j] if whole[KIND + j] == kind else amounts[j]
