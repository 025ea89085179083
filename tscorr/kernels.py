"""The fast arithmetic: twins of `reference.py`, and the one loop that a run spends its time in.

The small functions take scalars and unit vectors as tuples of three, and are float64 where their arguments
are. `correct_block` works on chunks of a row, class by class, in place. Its rules: unit-stride loops over
scratch arrays so that LLVM vectorises them, indexed loads in loops of their own, constants of the width of
the data, no fastmath (so nan keeps its meaning and every instruction set gives the same bits), polynomials
instead of library calls.

Constants are np.float32 so that float32 arithmetic stays float32; all but the polynomials' are exact.
Compiled once for float32 vectors (`precision = "fast"`) and once for float64 ("exact").
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
    """(m, bands, FRESNEL_DEGREE + 1): polynomial of F in x = cos_l * fresnel_scale + fresnel_shift"""
    fresnel_scale: Any
    fresnel_shift: Any
    """(m,)"""
    fresnel_exact: Any
    """bool (m, bands): the polynomial misses its bound, take `fresnel`"""
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
def _line(component, constant, row, start, stop):
    """A piece of a row of one component of a vector field; `constant` where the field is one pixel."""
    return constant[: stop - start] if component.size == 1 else component[row, start:stop]


@njit(cache=True, nogil=True, error_model="numpy")
def correct_block(image, removed, flags, material, sun, view, normal, table, rules, tally, options):
    """Take the specular part out of a block of an image, in place. Twin of reference.correct_block.

    image    : (bands, rows, cols), stored values; changed in place.
    removed  : the same shape and type, zeros on entry: what was taken away. Or of no rows: not wanted.
    flags    : uint16 (rows, cols). On entry CAST_SHADOW, NOT_VIEWED, NORMAL_UNRELIABLE, LOW_CONFIDENCE where
               they hold; on exit all bits of PixelFlag. Shadow and view bits are cleared where no material
               has a peak, since there nobody looked.
    material : uint8 (rows, cols), rows of `table`; 0 is no material.
    sun, view, normal : unit vectors, float (3, rows, cols), or (3, 1, 1) where constant; all of one type.
    options  : int64 (4,): exact, skip, first row of the block in the image, tally every so many rows.
    """
    bands, rows, cols = image.shape
    materials = table.peak.size
    exact, skip, first_row, stride = options[0] != 0, options[1] != 0, options[2], options[3]
    want_removed = removed.shape[1] == rows

    real = sun.dtype
    present = np.zeros(materials, np.bool_)
    sun_lines, view_lines = np.zeros((3, CHUNK), real), np.zeros((3, CHUNK), real)
    normal_lines = np.zeros((3, CHUNK), real)
    for c in range(3 if rows * cols > 0 else 0):
        sun_lines[c], view_lines[c], normal_lines[c] = sun[c, 0, 0], view[c, 0, 0], normal[c, 0, 0]
    kind, missing, full = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    assess, hit, over = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    state, clipped = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    simplified, horizontal = np.zeros(CHUNK, np.int32), np.zeros(CHUNK, np.int32)
    policy = np.zeros(CHUNK, np.int32)
    power_bits = np.zeros(CHUNK, np.int32)
    power = power_bits.view(np.float32)
    cos_i, cos_r, cos_l = np.zeros(CHUNK, real), np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    one_minus_cos, alpha2 = np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    cos_min, cos_max = np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    negligible, limit = np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    peak = np.zeros(CHUNK, real)
    shape, w2, exponential = np.zeros(CHUNK, real), np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    lobe, share = np.zeros(CHUNK, real), np.zeros(CHUNK, real)
    amount = np.zeros((bands, CHUNK), real)

    for row in range(rows):
        for start in range(0, cols, CHUNK):
            count = min(CHUNK, cols - start)
            stop = start + count
            marks, line = flags[row, start:stop], material[row, start:stop]

            # Which materials, and which pixels have data.
            present[:] = False
            for j in range(count):
                present[line[j]] = True
            for j in range(count):
                kind[j] = line[j]
                missing[j] = 0
                full[j] = 0
            for b in range(bands):
                saturation, values = rules.saturation[b], image[b, row, start:stop]
                for j in range(count):
                    value = np.float32(values[j])
                    missing[j] |= np.int32(value - value != ZERO)
                    full[j] |= np.int32(value >= saturation)
                if rules.has_nodata:
                    nodata = rules.nodata[0]
                    for j in range(count):
                        missing[j] |= np.int32(values[j] == nodata)
            any_peak = False
            for q in range(materials):
                if not present[q]:
                    continue
                any_peak |= table.peak[q]
                known = ON_ENTRY if table.peak[q] else QUALITY
                none = NO_MATERIAL | NOT_ASSESSED if q == 0 else NO_FLAG
                q32 = np.int32(q)
                pixels, gaps = 0, 0
                for j in range(count):
                    mine, gap = kind[j] == q32, missing[j] != 0
                    f = (marks[j] & known) | none | (SATURATED if full[j] != 0 else NO_FLAG)
                    f = (marks[j] & QUALITY) | NODATA | NOT_ASSESSED if gap else f
                    marks[j] = f if mine else marks[j]
                    pixels += np.int32(mine)
                    gaps += np.int32(mine & gap)
                tally.states[q, 3] += pixels if q == 0 else gaps
                if not table.peak[q] and q > 0:
                    tally.states[q, 0] += pixels - gaps
            if not any_peak:
                continue

            # Directions to cosines: everything about the geometry but the surface's material.
            sx = _line(sun[0], sun_lines[0], row, start, stop)
            sy = _line(sun[1], sun_lines[1], row, start, stop)
            sz = _line(sun[2], sun_lines[2], row, start, stop)
            vx = _line(view[0], view_lines[0], row, start, stop)
            vy = _line(view[1], view_lines[1], row, start, stop)
            vz = _line(view[2], view_lines[2], row, start, stop)
            nx = _line(normal[0], normal_lines[0], row, start, stop)
            ny = _line(normal[1], normal_lines[1], row, start, stop)
            nz = _line(normal[2], normal_lines[2], row, start, stop)
            for j in range(count):
                hx, hy, hz = sx[j] + vx[j], sy[j] + vy[j], sz[j] + vz[j]
                length = math.sqrt(hx * hx + hy * hy + hz * hz)
                inverse = ONE / length
                dx, dy, dz = nx[j] - hx * inverse, ny[j] - hy * inverse, nz[j] - hz * inverse
                one_minus_cos[j] = (dx * dx + dy * dy + dz * dz) * HALF
                cos_i[j] = nx[j] * sx[j] + ny[j] * sy[j] + nz[j] * sz[j]
                cos_r[j] = nx[j] * vx[j] + ny[j] * vy[j] + nz[j] * vz[j]
                cos_l[j] = length * HALF
            for j in range(count):
                u = one_minus_cos[j]
                high = (((A8 * u + A7) * u + A6) * u + A5) * u + A4
                alpha2[j] = ((((high * u + A3) * u + A2) * u + A1) * u + A0) * u

            # The rules of the material of each pixel.
            for j in range(count):
                assess[j] = 0
            for q in range(1, materials):
                if present[q] and table.peak[q]:
                    low, high, q32 = table.cos_min[q], table.cos_max[q], np.int32(q)
                    threshold, most, bound = table.negligible[q], table.share[q], table.bound[q]
                    is_simplified, is_horizontal = np.int32(table.simplified[q]), np.int32(table.horizontal[q])
                    what = np.int32(table.policy[q])
                    for j in range(count):
                        mine = kind[j] == q32
                        assess[j] |= np.int32(mine & (missing[j] == 0))
                        cos_min[j] = low if mine else cos_min[j]
                        cos_max[j] = high if mine else cos_max[j]
                        negligible[j] = threshold if mine else negligible[j]
                        limit[j] = most if mine else limit[j]
                        peak[j] = bound if mine else peak[j]
                    for j in range(count):
                        mine = kind[j] == q32
                        simplified[j] = is_simplified if mine else simplified[j]
                        horizontal[j] = is_horizontal if mine else horizontal[j]
                        policy[j] = what if mine else policy[j]

            # Which pixels can be assessed.
            for j in range(count):
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
            total_assessed = 0
            for j in range(count):
                total_assessed += assess[j]
            if total_assessed == 0:
                _count_states(tally, table, present, kind, missing, assess, state, count)
                continue

            # G / (cos_i cos_r), on the plane that R refers to; finite at grazing angles.
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
                on_level = horizontal[j] != 0
                numerator = numerator * (cos_i[j] if on_level else ONE)
                denominator = denominator * (sz[j] if on_level else ONE)
                shape[j] = (numerator if good else ZERO) / (denominator if good else ONE)
            tally.attenuated[0] += attenuated

            # The lobe of each band; bands with the same w, n, k share it.
            may_skip, outside = skip and not exact, False
            for q in range(1, materials):
                may_skip &= not (present[q] and table.peak[q]) or table.one_w[q]
            for b in range(bands):
                again = b == 0
                for q in range(1, materials):
                    again |= present[q] and table.peak[q] and not table.shared[q, b]
                if again and exact:
                    for j in range(count):
                        lobe[j] = ZERO
                        if assess[j] != 0:
                            q = kind[j]
                            angles = geometry((sx[j], sy[j], sz[j]), (vx[j], vy[j], vz[j]), (nx[j], ny[j], nz[j]))
                            f = specular(angles, table.w[q, b], table.n[q, b], table.k[q, b], simplified[j] != 0)
                            lobe[j] = f * cos_i[j] / sz[j] if horizontal[j] != 0 else f
                elif again:
                    for q in range(1, materials):
                        if present[q] and table.peak[q]:
                            part, q32 = table.w2[q, b], np.int32(q)
                            for j in range(count):
                                w2[j] = part if kind[j] == q32 else w2[j]
                    for j in range(count):
                        x = w2[j] * alpha2[j] * MINUS_LOG2_E
                        x = x if x > LOWEST_EXPONENT else LOWEST_EXPONENT
                        integer = np.int32(x - HALF)  # x <= 0: rounds to the nearest
                        power_bits[j] = (integer + np.int32(127)) << np.int32(23)
                        exponential[j] = x - np.float32(integer)
                    for j in range(count):
                        x = exponential[j]
                        p = (((((E6 * x + E5) * x + E4) * x + E3) * x + E2) * x + E1) * x + ONE
                        exponential[j] = p * power[j] * shape[j]
                    if may_skip and b == 0:
                        inside_lobe = np.int32(0)
                        for j in range(count):
                            inside_lobe |= np.int32(peak[j] * exponential[j] >= negligible[j] * BOUND_MARGIN)
                        if inside_lobe == 0:
                            outside = True
                            break
                    for q in range(1, materials):
                        if not (present[q] and table.peak[q]):
                            continue
                        q32 = np.int32(q)
                        if table.fresnel_exact[q, b]:
                            for j in range(count):
                                if kind[j] == q32:
                                    f = fresnel(np.float64(cos_l[j]), table.n[q, b], table.k[q, b])
                                    lobe[j] = f * exponential[j]
                        else:
                            scale, shift = table.fresnel_scale[q], table.fresnel_shift[q]
                            c = table.fresnel[q, b]
                            f0, f1, f2, f3, f4, f5, f6 = c[0], c[1], c[2], c[3], c[4], c[5], c[6]
                            f7, f8, f9, f10, f11, f12 = c[7], c[8], c[9], c[10], c[11], c[12]
                            for j in range(count):
                                x = cos_l[j] * scale + shift
                                f = (((((f12 * x + f11) * x + f10) * x + f9) * x + f8) * x + f7) * x + f6
                                f = (((((f * x + f5) * x + f4) * x + f3) * x + f2) * x + f1) * x + f0
                                lobe[j] = f * exponential[j] if kind[j] == q32 else lobe[j]
                amounts = amount[b]
                for q in range(1, materials):
                    if present[q] and table.peak[q]:
                        gain, q32 = table.gain[q, b], np.int32(q)
                        for j in range(count):
                            amounts[j] = gain * lobe[j] if kind[j] == q32 else amounts[j]

            if outside:
                for j in range(count):
                    state[j] = 0
                tally.out_of_lobe[0] += total_assessed
                _count_states(tally, table, present, kind, missing, assess, state, count)
                if (first_row + row) % stride == 0:
                    _tally_geometry(tally, count, kind, assess, cos_i, alpha2)
                continue

            # What becomes of each pixel.
            for j in range(count):
                hit[j] = 0
                over[j] = full[j]
                share[j] = ZERO
            for b in range(bands):
                scale, offset = rules.scale[b], rules.offset[b]
                values, amounts = image[b, row, start:stop], amount[b]
                for j in range(count):
                    a = amounts[j]
                    above = (assess[j] != 0) & (a >= negligible[j])
                    r = real.type(values[j]) * scale + offset
                    bright = r > ZERO
                    part = (a if bright else TWO) / (r if bright else ONE)
                    part = part if above else ZERO
                    share[j] = part if part > share[j] else share[j]
                    amounts[j] = a if above else ZERO
                    hit[j] |= np.int32(above)
                    over[j] |= np.int32(above & (part > limit[j]))
            hits, blanks = 0, 0
            for j in range(count):
                over[j] &= hit[j]
                state[j] = hit[j] + over[j]
                clipped[j] = 0
                hits += hit[j]
                blanks += np.int32((over[j] != 0) & (policy[j] == BLANK))
            _count_states(tally, table, present, kind, missing, assess, state, count)

            if hits > 0:
                for b in range(bands):
                    steps, lowest, saturation = rules.steps[b], rules.lowest[b], rules.saturation[b]
                    values, amounts = image[b, row, start:stop], amount[b]
                    nodata, dodges = real.type(rules.nodata[0]), rules.dodge
                    if rules.integer:
                        for j in range(count):
                            exponential[j] = real.type(np.int32(amounts[j] * steps + HALF))
                    else:
                        for j in range(count):
                            exponential[j] = amounts[j] * steps
                    for j in range(count):
                        value = real.type(values[j])
                        new = value - exponential[j]
                        low = new < lowest
                        floor = lowest if lowest < value else value
                        new = floor if low else new
                        dodge = dodges & (new == nodata)
                        new = new + ONE if dodge else new
                        take = (amounts[j] > ZERO) & (value < saturation)
                        take = take & ((state[j] == 1) | (policy[j] == BEST))
                        clipped[j] |= np.int32(take & (low | dodge))
                        new = new if take else value
                        exponential[j] = new
                        amounts[j] = value - new
                    if rules.integer:
                        for j in range(count):
                            values[j] = np.int32(exponential[j])
                    else:
                        for j in range(count):
                            values[j] = exponential[j]
                    if want_removed:
                        taken = removed[b, row, start:stop]
                        for j in range(count):
                            taken[j] = amounts[j] if hit[j] != 0 else taken[j]
                for j in range(count):
                    f = marks[j] | (CLIPPED if clipped[j] != 0 else NO_FLAG)
                    f |= CORRECTED if state[j] == 1 else NO_FLAG
                    marks[j] = f | (UNCORRECTABLE if state[j] == 2 else NO_FLAG)
                if blanks > 0:
                    for b in range(bands):
                        for j in range(count):
                            if state[j] == 2 and policy[j] == BLANK:
                                image[b, row, start + j] = rules.nodata[0]

            if (first_row + row) % stride == 0:
                _tally_geometry(tally, count, kind, assess, cos_i, alpha2)
                if hits > 0:
                    _tally_removed(tally, rules, count, kind, hit, share, amount, cos_i, cos_r, cos_l, simplified)


@njit(cache=True, nogil=True, error_model="numpy")
def _count_states(tally, table, present, kind, missing, assess, state, count):
    """Pixels of a chunk by material and state, for the materials with a peak."""
    for q in range(1, present.size):
        if present[q] and table.peak[q]:
            q32 = np.int32(q)
            negligible, corrected, uncorrectable, refused = 0, 0, 0, 0
            for j in range(count):
                mine = (kind[j] == q32) & (missing[j] == 0)
                done = mine & (assess[j] != 0)
                refused += np.int32(mine & (assess[j] == 0))
                negligible += np.int32(done & (state[j] == 0))
                corrected += np.int32(done & (state[j] == 1))
                uncorrectable += np.int32(done & (state[j] == 2))
            tally.states[q, 0] += negligible
            tally.states[q, 1] += corrected
            tally.states[q, 2] += uncorrectable
            tally.states[q, 3] += refused


@njit(cache=True, nogil=True, error_model="numpy")
def _tally_geometry(tally, count, kind, assess, cos_i, alpha2):
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
def _tally_removed(tally, rules, count, kind, hit, share, amount, cos_i, cos_r, cos_l, simplified):
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
