"""A chunk's materials and directions: which of its pixels are to be assessed, and why others are not."""

import numpy as np
from numba import njit

from tscorr.kernels.layout import (
    A0,
    A1,
    A2,
    A3,
    A4,
    A5,
    A6,
    A7,
    A8,
    ALPHA2,
    ASSESS,
    BAND,
    BOUND,
    CHUNK,
    CLIPS,
    COS_I,
    COS_L,
    COS_MAX,
    COS_MIN,
    COS_R,
    DOUBT,
    ENDLESS,
    GRAZING,
    HIDDEN,
    KIND,
    LIMIT,
    MARKS,
    MISSING,
    NEGLIGIBLE,
    NEGLIGIBLE_STATE,
    NO_FLAG,
    NO_KIND,
    NO_MATERIAL,
    NODATA,
    NORMAL,
    NOT_VIEWED,
    ON_ENTRY,
    ONE,
    REFUSED_STATE,
    SATURATED,
    SATURATES,
    SELF_SHADOW,
    STATE,
    STEP,
    SUN,
    SUN_UP,
    VIEW,
    WAYS,
    ZERO,
)


@njit(**STEP)
def load(kinds, marks, whole):
    """Materials and flags of a chunk; no material beyond its end."""
    for j in range(CHUNK):
        whole[KIND + j] = 0
        whole[MISSING + j] = 0
        whole[SATURATES + j] = 0
        whole[ASSESS + j] = 0
        whole[CLIPS + j] = 0
    for j in range(kinds.size):
        whole[KIND + j] = kinds[j]
    for j in range(marks.size):
        whole[MARKS + j] = marks[j]


@njit(**BAND)
def look(line, rules, b, nodata, whole):
    """Which pixels have no data in a band, and which are saturated in it; integers always have a value.

    Most chunks of integers have neither, which a loop over narrow numbers tells in a fraction of the time.
    """
    saturation = rules.saturation[b]
    saturates, gaps = saturation < ENDLESS, rules.has_nodata
    if rules.integer is None:
        for j in range(line.size):
            value = np.float32(line[j])
            whole[MISSING + j] |= np.int32(value - value != ZERO)
    elif saturates | gaps:
        most, found = line[0], line[0] == nodata
        for j in range(line.size):
            most = line[j] if line[j] > most else most
            found |= line[j] == nodata
        saturates, gaps = saturates & (np.float32(most) >= saturation), gaps & found
    if saturates:
        for j in range(line.size):
            whole[SATURATES + j] |= np.int32(np.float32(line[j]) >= saturation)
    if gaps:
        for j in range(line.size):
            whole[MISSING + j] |= np.int32(line[j] == nodata)


@njit(**STEP)
def list_kinds(whole, count, peak, present):
    """List the materials of a chunk in `present`, those with a peak first; how many, and how many have one."""
    kinds, peaks, last = 0, 0, np.int32(-1)
    while True:
        least = NO_KIND
        for j in range(count):
            q = whole[KIND + j] if whole[KIND + j] > last else NO_KIND
            least = min(least, q)
        if least == NO_KIND:
            return kinds, peaks
        last = least
        present[kinds] = last
        kinds += 1
        if peak[last]:
            present[kinds - 1], present[peaks] = present[peaks], last
            peaks += 1


@njit(**STEP)
def set_rules(whole, real, table, q):
    """The rules of one material for its pixels, which are to be assessed."""
    kind, ways, bound = np.int32(q), np.int32(table.ways[q]), table.bound[q]
    cos_min, cos_max, negligible, limit = table.cos_min[q], table.cos_max[q], table.negligible[q], table.share[q]
    for j in range(CHUNK):
        mine = whole[KIND + j] == kind
        real[COS_MIN + j] = cos_min if mine else real[COS_MIN + j]
        real[COS_MAX + j] = cos_max if mine else real[COS_MAX + j]
        real[NEGLIGIBLE + j] = negligible if mine else real[NEGLIGIBLE + j]
        real[LIMIT + j] = limit if mine else real[LIMIT + j]
        real[BOUND + j] = bound if mine else real[BOUND + j]
        whole[WAYS + j] = ways if mine else whole[WAYS + j]
        whole[ASSESS + j] = np.int32(1) if mine else whole[ASSESS + j]


@njit(**STEP)
def mark_known(whole):
    """Flags and states that need no geometry; gaps are not to be assessed."""
    for j in range(CHUNK):
        gap, wanted = whole[MISSING + j] != 0, whole[ASSESS + j] != 0
        none = whole[KIND + j] == 0
        f = whole[MARKS + j] & (ON_ENTRY if wanted else DOUBT)
        f |= (NO_MATERIAL if none else NO_FLAG) | (SATURATED if whole[SATURATES + j] != 0 else NO_FLAG)
        whole[MARKS + j] = (whole[MARKS + j] & DOUBT) | NODATA if gap else f
        whole[STATE + j] = REFUSED_STATE if gap | none else NEGLIGIBLE_STATE
        whole[ASSESS + j] = np.int32(wanted & (not gap))


@njit(**STEP)
def aim(field, row, start, stop, aims):
    """Put the vectors of a chunk, which may be one for all pixels, into their lines."""
    for c in range(3):
        line = aims[c * CHUNK : (c + 1) * CHUNK]
        if field[c].size == 1:
            value = field[c, 0, 0]
            for j in range(CHUNK):
                line[j] = value
        else:
            given = field[c, row, start:stop]
            for j in range(given.size):
                line[j] = given[j]


@njit(**STEP)
def set_cosines(aims, real):
    """Directions to angles about the facet; alpha^2 by a polynomial in |n - h|^2 / 2 = 1 - cos alpha.

    1 / |s + v| is a float32 and one step of Newton: 4e-14 at a third of the time of a float64 root and quotient.
    """
    for j in range(CHUNK):
        sx, sy, sz = aims[SUN + j], aims[SUN + CHUNK + j], aims[SUN + 2 * CHUNK + j]
        vx, vy, vz = aims[VIEW + j], aims[VIEW + CHUNK + j], aims[VIEW + 2 * CHUNK + j]
        nx, ny, nz = aims[NORMAL + j], aims[NORMAL + CHUNK + j], aims[NORMAL + 2 * CHUNK + j]
        hx, hy, hz = sx + vx, sy + vy, sz + vz
        square = hx * hx + hy * hy + hz * hz
        guess = np.float64(ONE / np.sqrt(np.float32(square)))
        inverse = guess * (1.5 - 0.5 * square * guess * guess)
        dx, dy, dz = nx - hx * inverse, ny - hy * inverse, nz - hz * inverse
        real[ALPHA2 + j] = (dx * dx + dy * dy + dz * dz) * 0.5
        real[COS_I + j] = nx * sx + ny * sy + nz * sz
        real[COS_R + j] = nx * vx + ny * vy + nz * vz
        real[COS_L + j] = square * inverse * 0.5
        real[SUN_UP + j] = sz
    for j in range(CHUNK):
        real[ALPHA2 + j] = arccos2(real[ALPHA2 + j])


@njit(**STEP, inline="always")
def arccos2(u):
    """arccos(1 - u)^2."""
    high = (((A8 * u + A7) * u + A6) * u + A5) * u + A4
    return ((((high * u + A3) * u + A2) * u + A1) * u + A0) * u


@njit(**STEP)
def assess(whole, real):
    """Leave out pixels that are not lit, not seen, too steep or hidden, and flag why; the number that is left."""
    total = np.int32(0)
    for j in range(CHUNK):
        f = whole[MARKS + j]
        cos_i, cos_r = real[COS_I + j], real[COS_R + j]
        least = min(cos_r, cos_i)
        most = max(cos_i, cos_r)
        wanted = whole[ASSESS + j] != 0
        lit, seen = cos_i > ZERO, cos_r > ZERO
        steep = (least >= real[COS_MIN + j]) & (most <= real[COS_MAX + j])
        free = lit & seen & steep & ((f & HIDDEN) == 0)
        f |= NO_FLAG if lit else SELF_SHADOW
        f |= NO_FLAG if seen else NOT_VIEWED
        f |= GRAZING if lit & seen & (not steep) else NO_FLAG
        whole[MARKS + j] = f if wanted else whole[MARKS + j]
        whole[STATE + j] = REFUSED_STATE if wanted & (not free) else whole[STATE + j]
        whole[ASSESS + j] = np.int32(wanted & free)
        total = np.int32(total + np.int32(wanted & free))
    return total
