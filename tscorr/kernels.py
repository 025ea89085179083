"""The fast arithmetic: twins of `reference.py`, and the one loop that a run spends its time in.

The small functions take scalars and unit vectors as tuples of three, and are float64 where their arguments
are. `correct_block` works on chunks of a row, class by class, in place. Its rules: unit-stride loops over
scratch arrays so that LLVM vectorises them, indexed loads in loops of their own, constants of the width of
the data, no fastmath (so nan keeps its meaning and every instruction set gives the same bits), polynomials
instead of library calls.

Constants are np.float32 so that float32 arithmetic stays float32; all but the polynomials' are exact.
Compiled once for tables of float32 (`precision = "fast"`) and once for float64 ("exact"). Directions are float64 in
both: near grazing, where sun and view nearly cancel, float32 would lose the facet tilt.
This module imports nothing of ours: numba's cache does not see edits in other files.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

CHUNK = 128
"""pixels of a row that are worked on at a time: their scratch arrays stay in the L1 cache"""

ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
DEG_PER_RAD = 180 / math.pi

# Bits of PixelFlag, which correction.py documents.
NO_FLAG = np.uint16(0)
NODATA, NO_MATERIAL, SELF_SHADOW, CAST_SHADOW = np.uint16(1), np.uint16(2), np.uint16(4), np.uint16(8)
NOT_VIEWED, GRAZING = np.uint16(16), np.uint16(32)
CORRECTED, UNCORRECTABLE, NOT_ASSESSED = np.uint16(1 << 6), np.uint16(2 << 6), np.uint16(3 << 6)
SATURATED, CLIPPED = np.uint16(256), np.uint16(512)
HIDDEN = np.uint16(8 | 16)
QUALITY = np.uint16(2048 | 4096)
ON_ENTRY = np.uint16(8 | 16 | 2048 | 4096)

# What to do with an uncorrectable pixel.
BEST, KEEP, BLANK = 0, 1, 2

FRESNEL_DEGREE = 12

# alpha^2 / u over u = 1 - cos alpha in [0, 1]; largest relative error 7e-9
A0, A1, A2 = np.float32(2.0), np.float32(0.33333173), np.float32(0.08893097)
A3, A4, A5 = np.float32(0.028153064), np.float32(0.012210054), np.float32(-0.0016769501)
A6, A7, A8 = np.float32(0.009950104), np.float32(-0.006363017), np.float32(0.0028651212)
# 2^x over [-1/2, 1/2]; largest relative error 2e-9
E1, E2, E3 = np.float32(0.6931472), np.float32(0.24022646), np.float32(0.05550329)
E4, E5, E6 = np.float32(0.00961852), np.float32(0.001339986), np.float32(0.00015337576)
MINUS_LOG2_E = np.float32(-1.4426950408889634)
TWO_TO_32 = 4294967296.0
MOST_STEPS = np.float32(2**30)
"""more stored steps than any image has, and fewer than overflow an int32"""
BOUND_MARGIN = np.float32(0.999)
"""a chunk is skipped where its bound is below this part of the threshold: room for rounding"""
LOWEST_EXPONENT = np.float32(-126)  # of a normal float32; below, exp is 0


class MaterialTable(NamedTuple):
    """Materials as `correct_block` reads them; row 0 stands for "no material". Arrays (materials, ...)."""

    peak: Any
    """bool (m,): the material has a lobe and is to be corrected"""
    gain: Any
    """(m, bands): pi beta t1, what the lobe is multiplied with to be a reflectance factor"""
    w: Any
    """float64 (m, bands): 1/degree"""
    w2: Any
    """(m, bands): w^2 in rad^-2"""
    n: Any
    k: Any
    """float64 (m, bands): refractive index n - ik"""
    fresnel: Any
    """(m, bands, FRESNEL_DEGREE + 3): polynomial of F in x = cos_l * scale + shift, lowest power first, then scale and
    shift; scale is 0 where the polynomial misses its bound and `fresnel` is to be taken"""
    shared: Any
    """bool (m, bands): w, n and k are those of the band before"""
    bound: Any
    """(m,): no band's pi beta t1 F is larger"""
    one_w: Any
    """bool (m,): all bands have the same w"""
    simplified: Any
    """bool (m,): without G"""
    horizontal: Any
    """bool (m,): R refers to the horizontal plane, not to the facet"""
    cos_min: Any
    cos_max: Any
    """(m,): cosines of incidence and exitance that are not grazing"""
    negligible: Any
    """(m,): reflectance factor below which nothing is removed"""
    share: Any
    """(m,): share of the signal above which a pixel is uncorrectable"""
    policy: Any
    """int64 (m,): BEST, KEEP or BLANK"""


class PixelRules(NamedTuple):
    """What the stored values of an image mean. Arrays (bands,) unless said otherwise."""

    scale: Any
    offset: Any
    """reflectance factor = scale * stored + offset"""
    steps: Any
    """1 / scale"""
    saturation: Any
    """stored value from which a band is saturated; inf where there is none"""
    lowest: Any
    """smallest stored value that a correction may reach: reflectance 0, inside the type"""
    nodata: Any
    """(1,) in the image's type"""
    has_nodata: bool
    dodge: bool
    """a corrected value must step aside where it would read as nodata"""
    integer: bool


class Tally(NamedTuple):
    """Sums over pixels for the report. Integers, so that no order of blocks changes them."""

    states: Any
    """int64 (m, 4): pixels by material and SPECULAR_STATE"""
    removed: Any
    """int64 (m, bands): reflectance factor removed, in units of 2^-32"""
    incidence: Any
    """int64 (m, 360): histogram of the angle of incidence, bins of 0.25 degrees"""
    tilt: Any
    """int64 (m, 900): histogram of the facet tilt, bins of 0.1 degrees"""
    share: Any
    """int64 (m, 201): histogram of the specular share, bins of 0.005; the last is for 1, which nothing exceeds"""
    extremes: Any
    """float64 (m, 2): smallest facet tilt [deg], largest share"""
    attenuated: Any
    """float64 (2,): pixels with G below 1 and the largest relative change of R without G"""
    out_of_lobe: Any
    """int64 (1,): assessed pixels whose lobe was not computed, because it is provably negligible"""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def geometry(sun, view, normal):
    """Twin of reference.geometry by the half vector h: alpha from |n - h|, cos_l from |s + v|."""
    h = (sun[0] + view[0], sun[1] + view[1], sun[2] + view[2])
    length = math.sqrt(_dot(h, h))
    d = (normal[0] - h[0] / length, normal[1] - h[1] / length, normal[2] - h[2] / length)
    alpha = 2 * math.asin(math.sqrt(_dot(d, d)) / 2)
    return _dot(normal, sun), _dot(normal, view), length / 2, alpha


@njit(cache=True, nogil=True, error_model="numpy")
def facet_distribution(alpha, w):
    """Twin of reference.facet_distribution."""
    return math.exp(-((w * DEG_PER_RAD * alpha) ** 2))


@njit(cache=True, nogil=True, error_model="numpy")
def fresnel(cos_l, n, k):
    """Twin of reference.fresnel."""
    c2 = cos_l * cos_l
    s2 = (1 - cos_l) * (1 + cos_l)
    e = (n - 1) * (n + 1) - k * k
    nk2 = 2 * n * k
    e2 = e * e + nk2 * nk2
    if e2 == 0:
        return 0.0 * cos_l
    big_a = e + c2
    root = math.sqrt((math.hypot(big_a, nk2) + abs(big_a)) / 2)
    other = nk2 / 2 / root if root > 0 else 0.0
    a, b = (root, other) if big_a >= 0 else (other, root)
    n2 = e + 1
    s_wave = (cos_l + a) ** 2 + b * b
    p_wave = (n2 * cos_l + a) ** 2 + (nk2 * cos_l + b) ** 2
    return e2 / 2 * (1 / s_wave**2 + ((n2 * c2 - s2) ** 2 + (nk2 * c2) ** 2) / p_wave**2)


@njit(cache=True, nogil=True, error_model="numpy")
def attenuation(cos_i, cos_r, cos_l):
    """Twin of reference.attenuation."""
    return min(1.0, min(cos_i, cos_r) * (cos_i + cos_r) / (cos_l * cos_l))


@njit(cache=True, nogil=True, error_model="numpy")
def specular(geometry, w, n, k, simplified):
    """Twin of reference.specular."""
    cos_i, cos_r, cos_l, alpha = geometry
    if not (cos_i > 0 and cos_r > 0):
        return math.nan
    g = 1.0 if simplified else attenuation(cos_i, cos_r, cos_l)
    return fresnel(cos_l, n, k) / (cos_i * cos_r) * g * facet_distribution(alpha, w)


@njit(cache=True, nogil=True, error_model="numpy")
def correct_block(image, removed, flags, material, sun, view, normal, table, rules, tally, options):
    """Take the specular part out of a block of an image, in place. Twin of reference.correct_block.

    image    : (bands, rows, cols), stored values; changed in place.
    removed  : the same shape and type, zeros on entry: what was taken away. Or of no rows: not wanted.
    flags    : uint16 (rows, cols). On entry CAST_SHADOW, NOT_VIEWED, NORMAL_UNRELIABLE, LOW_CONFIDENCE where
               they hold; on exit all bits of PixelFlag. Shadow and view bits are cleared where no material
               has a peak, since there nobody looked.
    material : uint8 (rows, cols), rows of `table`; 0 is no material.
    sun, view, normal : unit vectors, float64 (3, rows, cols), or (3, 1, 1) where constant.
    options  : int64 (4,): exact, skip, first row of the block in the image, tally every so many rows.
    """
    bands, rows, cols = image.shape
    exact, skip, first_row, stride = options[0] != 0, options[1] != 0, options[2], options[3]
    want_removed = removed.shape[1] == rows
    real = table.gain.dtype
    peak, states = table.peak, tally.states  # taken out of their tuples once: each access costs a reference count
    cos_min_of, cos_max_of, negligible_of, limit_of = table.cos_min, table.cos_max, table.negligible, table.share
    bound_of, simplified_of, horizontal_of = table.bound, table.simplified, table.horizontal
    policy_of, w2_of, gain_of, shared_of, one_w = table.policy, table.w2, table.gain, table.shared, table.one_w
    fresnel_of, n_of, k_of = table.fresnel, table.n, table.k
    scale, offset, steps, lowest = rules.scale, rules.offset, rules.steps, rules.lowest
    saturation, nodata = rules.saturation, rules.nodata
    has_nodata, dodges, integer = rules.has_nodata, rules.dodge, rules.integer

    present = np.zeros(peak.size, np.bool_)
    fixed = np.zeros((9, CHUNK), np.float64)
    kind, missing, saturated = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    assess, hit, state = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    clipped, policy = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    simplified, horizontal = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    power_bits = np.zeros(CHUNK, np.int32)
    power = power_bits.view(np.float32)
    cos_i, cos_r, cos_l = np.zeros(CHUNK, real), np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    cos_min, cos_max, alpha2 = np.zeros(CHUNK, real), np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    negligible, limit, bound = np.zeros(CHUNK, real), np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    shape, w2, exponential = np.zeros(CHUNK, real), np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    lobe, share, new_values = np.zeros(CHUNK, real), np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    sun_up = np.zeros(CHUNK, real)
    amount = np.zeros((bands, CHUNK), real)
    if rows * cols > 0:
        _set_constants(fixed, sun, view, normal)

    for row in range(rows):
        tallied = (first_row + row) % stride == 0
        for start in range(0, cols, CHUNK):
            stop = min(start + CHUNK, cols)
            count = stop - start
            marks = flags[row, start:stop]

            # Which materials, and which pixels have data.
            _clear(missing)
            _clear(saturated)
            for b in range(bands):
                _look(missing, saturated, image[b, row, start:stop], saturation[b], has_nodata, nodata[0])
            _list(kind, present, material[row, start:stop])
            any_peak = False
            for q in range(present.size):
                if present[q]:
                    _mark(marks, kind, missing, saturated, np.int32(q), peak[q], states)
                    present[q] = peak[q]
                    any_peak |= peak[q]
            if not any_peak:
                continue

            # Everything about the geometry but the surface's material.
            sx, sy, sz = (
                _line(sun, fixed, 0, row, start, stop),
                _line(sun, fixed, 1, row, start, stop),
                _line(sun, fixed, 2, row, start, stop),
            )
            vx, vy, vz = (
                _line(view, fixed, 3, row, start, stop),
                _line(view, fixed, 4, row, start, stop),
                _line(view, fixed, 5, row, start, stop),
            )
            nx, ny, nz = (
                _line(normal, fixed, 6, row, start, stop),
                _line(normal, fixed, 7, row, start, stop),
                _line(normal, fixed, 8, row, start, stop),
            )
            _cosines(cos_i, cos_r, cos_l, alpha2, sun_up, sx, sy, sz, vx, vy, vz, nx, ny, nz)

            # The rules of each pixel's material, and whether it can be assessed.
            _clear(assess)
            for q in range(1, present.size):
                if present[q]:
                    q32 = np.int32(q)
                    _set(cos_min, kind, q32, cos_min_of[q])
                    _set(cos_max, kind, q32, cos_max_of[q])
                    _set(negligible, kind, q32, negligible_of[q])
                    _set(limit, kind, q32, limit_of[q])
                    _set(bound, kind, q32, bound_of[q])
                    _set(simplified, kind, q32, np.int32(simplified_of[q]))
                    _set(horizontal, kind, q32, np.int32(horizontal_of[q]))
                    _set(policy, kind, q32, np.int32(policy_of[q]))
                    _want(assess, kind, missing, q32, count)
            assessed = _assess(assess, cos_min, cos_max, cos_i, cos_r, marks)
            inside = assessed > 0
            if inside:
                tally.attenuated[0] += _set_shape(
                    assess, simplified, horizontal, cos_i, cos_r, cos_l, shape, sun_up, count
                )

            # The reflectance to remove in each band; bands with the same w, n, k share the lobe. A chunk is out of
            # the lobe if the largest pi beta t1 F times the exponential stays below the threshold everywhere.
            may_skip = skip
            for q in range(1, present.size):
                may_skip &= not present[q] or one_w[q]
            for b in range(bands if inside else 0):
                again = b == 0
                for q in range(1, present.size):
                    again |= present[q] and not shared_of[q, b]
                if again and exact:
                    for j in range(count):
                        lobe[j] = ZERO
                        if assess[j] != 0:
                            q = kind[j]
                            angles = geometry((sx[j], sy[j], sz[j]), (vx[j], vy[j], vz[j]), (nx[j], ny[j], nz[j]))
                            f = specular(angles, table.w[q, b], n_of[q, b], k_of[q, b], simplified[j] != 0)
                            lobe[j] = f * angles[0] / sz[j] if horizontal[j] != 0 else f
                elif again:
                    for q in range(1, present.size):
                        if present[q]:
                            _set(w2, kind, np.int32(q), w2_of[q, b])
                    _set_exponential(exponential, power_bits, power, w2, alpha2, shape)
                    if may_skip and b == 0 and _is_outside(negligible, bound, exponential, count):
                        inside = False
                        tally.out_of_lobe[0] += assessed
                        break
                    for q in range(1, present.size):
                        if present[q]:
                            _set_lobe(
                                lobe, kind, cos_l, exponential, np.int32(q), fresnel_of[q, b], n_of[q, b], k_of[q, b]
                            )
                for q in range(1, present.size):
                    if present[q]:
                        _set_amount(amount[b], lobe, kind, np.int32(q), gain_of[q, b])

            # What becomes of each pixel.
            _clear(hit)
            _clear(state)
            share[:] = ZERO
            if inside:
                for b in range(bands):
                    line = image[b, row, start:stop]
                    _weigh(amount[b], line, scale[b], offset[b], assess, negligible, limit, hit, state, share)
            hits = _settle(hit, state, saturated, count)
            for q in range(1, present.size):
                if present[q]:
                    _count_states(kind, missing, assess, state, np.int32(q), count, states)
            if hits > 0:
                _clear(clipped)
                for b in range(bands):
                    line = image[b, row, start:stop]
                    _subtract(
                        amount[b],
                        line,
                        new_values,
                        state,
                        policy,
                        clipped,
                        steps[b],
                        lowest[b],
                        saturation[b],
                        nodata[0],
                        dodges,
                        integer,
                    )
                    if want_removed:
                        _keep(amount[b], removed[b, row, start:stop], hit)
                blanks = _mark_states(marks, state, clipped, policy)
                if blanks > 0:
                    for b in range(bands):
                        _blank(image[b, row, start:stop], state, policy, nodata[0])
            if tallied and assessed > 0:
                _tally_geometry(kind, assess, cos_i, alpha2, count, tally)
                if hits > 0:
                    _tally_removed(kind, hit, simplified, cos_i, cos_r, cos_l, share, amount, count, rules, tally)


@njit(cache=True, nogil=True, error_model="numpy")
def _clear(values):
    """Zeros."""
    for j in range(CHUNK):
        values[j] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _set_constants(fixed, sun, view, normal):
    """The first vector of each field along whole lines: what `_line` gives for a field of one pixel."""
    for c in range(3):
        fixed[c, :], fixed[c + 3, :], fixed[c + 6, :] = sun[c, 0, 0], view[c, 0, 0], normal[c, 0, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _line(field, fixed, place, row, start, stop):
    """A piece of a row of one component of a vector field, constant where the field is one pixel."""
    return fixed[place, : stop - start] if field[0].size == 1 else field[place % 3, row, start:stop]


@njit(cache=True, nogil=True, error_model="numpy")
def _look(missing, saturated, line, saturation, has_nodata, nodata):
    """Which pixels have no data in a band, and which are saturated in it."""
    for j in range(line.size):
        value = np.float32(line[j])
        missing[j] |= np.int32(value - value != ZERO)
        saturated[j] |= np.int32(value >= saturation)
    if has_nodata:
        for j in range(line.size):
            missing[j] |= np.int32(line[j] == nodata)


@njit(cache=True, nogil=True, error_model="numpy")
def _list(kind, present, line):
    """The material of each pixel, as wide as the other arrays, and which materials there are."""
    present[:] = False
    for j in range(line.size):
        present[line[j]] = True
    for j in range(line.size):
        kind[j] = line[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(marks, kind, missing, saturated, q32, peak, states):
    """The flags of one material's pixels that need no geometry; counts those that are done with."""
    known = ON_ENTRY if peak else QUALITY
    none = NO_MATERIAL | NOT_ASSESSED if q32 == 0 else NO_FLAG
    pixels, gaps = 0, 0
    for j in range(marks.size):
        mine, gap = kind[j] == q32, missing[j] != 0
        f = (marks[j] & known) | none | (SATURATED if saturated[j] != 0 else NO_FLAG)
        f = (marks[j] & QUALITY) | NODATA | NOT_ASSESSED if gap else f
        marks[j] = f if mine else marks[j]
        pixels += np.int32(mine)
        gaps += np.int32(mine & gap)
    states[q32, 3] += pixels if q32 == 0 else gaps
    if not peak and q32 > 0:
        states[q32, 0] += pixels - gaps


@njit(cache=True, nogil=True, error_model="numpy")
def _cosines(cos_i, cos_r, cos_l, alpha2, sun_up, sx, sy, sz, vx, vy, vz, nx, ny, nz):
    """Directions to angles about the facet; alpha^2 by a polynomial in |n - h|^2 / 2 = 1 - cos alpha."""
    for j in range(sx.size):
        hx, hy, hz = sx[j] + vx[j], sy[j] + vy[j], sz[j] + vz[j]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        inverse = 1.0 / length
        dx, dy, dz = nx[j] - hx * inverse, ny[j] - hy * inverse, nz[j] - hz * inverse
        u = alpha2.dtype.type((dx * dx + dy * dy + dz * dz) * 0.5)
        high = (((A8 * u + A7) * u + A6) * u + A5) * u + A4
        alpha2[j] = ((((high * u + A3) * u + A2) * u + A1) * u + A0) * u
        cos_i[j] = nx[j] * sx[j] + ny[j] * sy[j] + nz[j] * sz[j]
        cos_r[j] = nx[j] * vx[j] + ny[j] * vy[j] + nz[j] * vz[j]
        cos_l[j] = length * 0.5
        sun_up[j] = sz[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _set(values, kind, q32, value):
    """Set the value of the pixels of one material."""
    for j in range(CHUNK):
        values[j] = value if kind[j] == q32 else values[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _want(assess, kind, missing, q32, count):
    """The pixels of one material are to be assessed where there is data."""
    for j in range(count):
        assess[j] |= np.int32((kind[j] == q32) & (missing[j] == 0))


@njit(cache=True, nogil=True, error_model="numpy")
def _assess(assess, cos_min, cos_max, cos_i, cos_r, marks):
    """Leave out pixels that are not lit, not seen, too steep or hidden, and flag why; the number that is left."""
    for j in range(marks.size):
        f = marks[j]
        least = cos_i[j] if cos_i[j] < cos_r[j] else cos_r[j]
        most = cos_r[j] if cos_i[j] < cos_r[j] else cos_i[j]
        wanted = assess[j] != 0
        lit, seen = cos_i[j] > ZERO, cos_r[j] > ZERO
        steep = (least >= cos_min[j]) & (most <= cos_max[j])
        free = lit & seen & steep & ((f & HIDDEN) == 0)
        assess[j] = np.int32(wanted & free)
        f |= NO_FLAG if free else NOT_ASSESSED
        f |= NO_FLAG if lit else SELF_SHADOW
        f |= NO_FLAG if seen else NOT_VIEWED
        f |= GRAZING if lit & seen & (not steep) else NO_FLAG
        marks[j] = f if wanted else marks[j]
    total = 0
    for j in range(marks.size):
        total += assess[j]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _set_shape(assess, simplified, horizontal, cos_i, cos_r, cos_l, shape, sun_up, count):
    """G / (cos_i cos_r), on the plane that R refers to; finite at grazing angles. The number of pixels with G < 1."""
    attenuated = 0
    for j in range(count):
        good = assess[j] != 0
        least = cos_i[j] if cos_i[j] < cos_r[j] else cos_r[j]
        most = cos_r[j] if cos_i[j] < cos_r[j] else cos_i[j]
        total = cos_i[j] + cos_r[j]
        c2 = cos_l[j] * cos_l[j]
        inside = least * total >= c2
        attenuated += np.int32(good & (not inside))
        whole = (simplified[j] != 0) | inside
        numerator = ONE if whole else total
        denominator = cos_i[j] * cos_r[j] if whole else most * c2
        level = horizontal[j] != 0
        numerator = numerator * (cos_i[j] if level else ONE)
        denominator = denominator * (sun_up[j] if level else ONE)
        shape[j] = (numerator if good else ZERO) / (denominator if good else ONE)
    return attenuated


@njit(cache=True, nogil=True, error_model="numpy")
def _set_amount(amounts, lobe, kind, q32, gain):
    """Amount of the pixels of one material in one band."""
    for j in range(CHUNK):
        amounts[j] = gain * lobe[j] if kind[j] == q32 else amounts[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _set_exponential(exponential, power_bits, power, w2, alpha2, shape):
    """exp(-w^2 alpha^2) times the shape: 2^x from the whole part of x as bits and a polynomial of the rest.

    power : the memory of `power_bits`, read as float32.
    """
    for j in range(CHUNK):
        x = w2[j] * alpha2[j] * MINUS_LOG2_E
        x = x if x > LOWEST_EXPONENT else LOWEST_EXPONENT
        whole = np.int32(x - HALF)  # x <= 0: rounds to the nearest
        power_bits[j] = (whole + np.int32(127)) << np.int32(23)
        exponential[j] = x - np.float32(whole)
    for j in range(CHUNK):
        x = exponential[j]
        p = (((((E6 * x + E5) * x + E4) * x + E3) * x + E2) * x + E1) * x + ONE
        exponential[j] = p * power[j] * shape[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _is_outside(negligible, bound, exponential, count):
    """Whether no pixel of the chunk can have as much as its threshold to remove."""
    inside = np.int32(0)
    for j in range(count):
        inside |= np.int32(bound[j] * exponential[j] >= negligible[j] * BOUND_MARGIN)
    return inside == 0


@njit(cache=True, nogil=True, error_model="numpy")
def _set_lobe(lobe, kind, cos_l, exponential, q32, c, n, k):
    """f_spec of the pixels of one material: F times the exponential; F by polynomial or, where scale is 0, exact."""
    scale, shift = c[FRESNEL_DEGREE + 1], c[FRESNEL_DEGREE + 2]
    if scale == 0:
        for j in range(CHUNK):
            if kind[j] == q32:
                lobe[j] = fresnel(np.float64(cos_l[j]), n, k) * exponential[j]
        return
    f0, f1, f2, f3, f4, f5, f6 = c[0], c[1], c[2], c[3], c[4], c[5], c[6]
    f7, f8, f9, f10, f11, f12 = c[7], c[8], c[9], c[10], c[11], c[12]
    for j in range(CHUNK):
        x = cos_l[j] * scale + shift
        f = (((((f12 * x + f11) * x + f10) * x + f9) * x + f8) * x + f7) * x + f6
        f = (((((f * x + f5) * x + f4) * x + f3) * x + f2) * x + f1) * x + f0
        lobe[j] = f * exponential[j] if kind[j] == q32 else lobe[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(amounts, line, scale, offset, assess, negligible, limit, hit, state, share):
    """One band's amounts against threshold and signal; amounts below the threshold become 0."""
    for j in range(line.size):
        a = amounts[j]
        above = (assess[j] != 0) & (a >= negligible[j])
        r = amounts.dtype.type(line[j]) * scale + offset
        bright = r > ZERO
        part = (a if bright else TWO) / (r if bright else ONE)
        part = part if above else ZERO
        share[j] = part if part > share[j] else share[j]
        amounts[j] = a if above else ZERO
        hit[j] |= np.int32(above)
        state[j] |= np.int32(above & (part > limit[j]))


@njit(cache=True, nogil=True, error_model="numpy")
def _settle(hit, state, saturated, count):
    """SPECULAR_STATE from what `_weigh` found in all bands; the number of pixels with something to remove."""
    hits = 0
    for j in range(count):
        state[j] = hit[j] + ((state[j] | saturated[j]) & hit[j])
        hits += hit[j]
    return hits


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract(amounts, line, new_values, state, policy, clipped, steps, lowest, saturation, nodata, dodges, integer):
    """One band less its amounts, rounded to stored steps and held above 0; `amounts` become what was taken."""
    real = amounts.dtype
    least, blank = lowest, real.type(nodata)
    if integer:
        for j in range(line.size):
            step = amounts[j] * steps + HALF
            new_values[j] = real.type(np.int32(step if step < MOST_STEPS else MOST_STEPS))
    else:
        for j in range(line.size):
            new_values[j] = line.dtype.type(amounts[j] * steps)  # so that input - removed is exact in the file
    for j in range(line.size):
        value = real.type(line[j])
        new = value - new_values[j]
        low = new < least
        floor = least if least < value else value
        new = floor if low else new
        dodge = dodges & (new == blank)
        new = new + ONE if dodge else new
        take = (amounts[j] > ZERO) & (value < saturation)
        take = take & ((state[j] == 1) | (policy[j] == BEST))
        clipped[j] |= np.int32(take & (low | dodge))
        new = new if take else value
        new_values[j] = new
        amounts[j] = value - new
    if integer:
        for j in range(line.size):
            line[j] = np.int32(new_values[j])
    else:
        for j in range(line.size):
            line[j] = new_values[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_states(marks, state, clipped, policy):
    """Flag what became of the pixels; the number of those to be blanked."""
    blanks = 0
    for j in range(marks.size):
        f = marks[j] | (CLIPPED if clipped[j] != 0 else NO_FLAG)
        f |= CORRECTED if state[j] == 1 else NO_FLAG
        marks[j] = f | (UNCORRECTABLE if state[j] == 2 else NO_FLAG)
        blanks += np.int32((state[j] == 2) & (policy[j] == BLANK))
    return blanks


@njit(cache=True, nogil=True, error_model="numpy")
def _blank(line, state, policy, nodata):
    """Nodata where a pixel is uncorrectable and its material wants it so."""
    for j in range(line.size):
        if state[j] == 2 and policy[j] == BLANK:
            line[j] = nodata


@njit(cache=True, nogil=True, error_model="numpy")
def _keep(amounts, taken, hit):
    """Write down what was taken from one band."""
    for j in range(taken.size):
        taken[j] = amounts[j] if hit[j] != 0 else taken[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _count_states(kind, missing, assess, state, q32, count, states):
    """Pixels of one material by state, of those with data."""
    negligible, corrected, uncorrectable, refused = 0, 0, 0, 0
    for j in range(count):
        mine = (kind[j] == q32) & (missing[j] == 0)
        done = mine & (assess[j] != 0)
        refused += np.int32(mine & (assess[j] == 0))
        negligible += np.int32(done & (state[j] == 0))
        corrected += np.int32(done & (state[j] == 1))
        uncorrectable += np.int32(done & (state[j] == 2))
    states[q32, 0] += negligible
    states[q32, 1] += corrected
    states[q32, 2] += uncorrectable
    states[q32, 3] += refused


@njit(cache=True, nogil=True, error_model="numpy")
def _tally_geometry(kind, assess, cos_i, alpha2, count, tally):
    """Histograms of the angle of incidence and of the facet tilt over the assessed pixels of a chunk."""
    for j in range(count):
        if assess[j] != 0:
            q = kind[j]
            incidence = math.acos(min(1.0, np.float64(cos_i[j]))) * DEG_PER_RAD
            tilt = math.sqrt(np.float64(alpha2[j])) * DEG_PER_RAD
            tally.incidence[q, min(359, int(incidence * 4))] += 1
            tally.tilt[q, min(899, int(tilt * 10))] += 1
            tally.extremes[q, 0] = min(tally.extremes[q, 0], tilt)


@njit(cache=True, nogil=True, error_model="numpy")
def _tally_removed(kind, hit, simplified, cos_i, cos_r, cos_l, share, amount, count, rules, tally):
    """Share, removed reflectance and the difference that G makes, over the pixels inside the lobe."""
    for j in range(count):
        if hit[j] != 0:
            q = kind[j]
            part = min(1.0, np.float64(share[j]))
            tally.share[q, int(part * 200)] += 1
            tally.extremes[q, 1] = max(tally.extremes[q, 1], part)
            for b in range(rules.scale.size):
                taken = np.float64(amount[b, j]) * np.float64(rules.scale[b])
                tally.removed[q, b] += np.int64(taken * TWO_TO_32 + 0.5)
            g = attenuation(np.float64(cos_i[j]), np.float64(cos_r[j]), np.float64(cos_l[j]))
            change = 1 - g if simplified[j] != 0 else 1 / g - 1
            tally.attenuated[1] = max(tally.attenuated[1], part * change)
