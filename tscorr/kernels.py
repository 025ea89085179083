"""The fast arithmetic: twins of `reference.py`, and the one loop that a run spends its time in.

The small functions take scalars and unit vectors as tuples of three, and are float64 where their arguments
are. `correct_block` works on chunks of a row, all materials at once, in place, as a list of steps: each a small
function with one loop. Their rules: unit-stride loops over the chunk's scratch memory, which LLVM vectorises since
it sees that lines of one array do not overlap; no index whose sign LLVM cannot tell (`line[start + j]`: pass a slice
instead); constants of the width of the data; no fastmath, so nan keeps its meaning and every instruction set gives
the same bits; polynomials instead of library calls. A step allocates nothing and is called from compiled code only,
which spares half of its compilation.

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

ENDLESS = np.float32(math.inf)
ZERO, HALF, ONE, TWO, FOUR = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2), np.float32(4)
DEG_PER_RAD = 180 / math.pi

# Bits of PixelFlag, which correction.py documents.
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
# alpha / sin alpha - 1 over alpha^2
T1, T2, T3 = np.float32(1 / 6), np.float32(7 / 360), np.float32(31 / 15120)
T4, T5 = np.float32(127 / 604800), np.float32(73 / 3421440 * 1.25)
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
    WEIGHT, SCATTER2, FACTOR, TURNS_W4, TURNS_W2, TURNS, BY_R, STRETCH, OF_MATERIAL, SPREAD, CROSS, BACK_VARIANCE,
    SKY, ALBEDO, BACK, BACK_SKY, DIFFUSE, BETA_RATE, BETA_SIGMA, SKY_SIGMA, HOLE,
) = range(0, 38 * CHUNK, CHUNK)  # fmt: skip
(
    KIND, MISSING, SATURATES, ASSESS, HIT, OVER, CLIPS, MARKS, STATE, WAYS, TAKE, POWER, INCIDENCE_BIN, TILT_BIN,
    METHOD, AVERAGED, SKIES, UNSURE,
) = range(0, 18 * CHUNK, CHUNK)  # fmt: skip
# How a pixel is assessed.
LIT, SHADED = 1, 2

BLOCK: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
STEP: dict[str, Any] = {**BLOCK, "no_cpython_wrapper": True}
"""how `correct_block` and its steps are compiled: without reference counts, since nothing is allocated"""
BAND: dict[str, Any] = {**STEP, "forceinline": True}
"""and the steps of each band: a fifth of the time of a band went into calling them"""


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
    ways: Any
    """int64 (m,): SIMPLIFIED | LEVEL | KEEP | BLANK"""
    cos_min: Any
    cos_max: Any
    """(m,): cosines of incidence and exitance that are not grazing"""
    negligible: Any
    """(m,): reflectance factor below which nothing is removed"""
    share: Any
    """(m,): share of the signal above which a pixel is uncorrectable"""


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
    integer: Any
    """True, or None where the image is of floating point"""


class Scratch(NamedTuple):
    """Memory of one thread, a line of CHUNK values for each quantity of a chunk: see `new_scratch`.

    One flat array holds the lines of a type, at the places that are named below: so LLVM knows that they do not
    overlap, which separate arrays would have to prove at run time, loop by loop.
    """

    aims: Any
    """float64: three vectors"""
    real: Any
    """float32 or float64"""
    whole: Any
    """int32"""
    power: Any
    """whole[POWER:] read as float32"""
    amounts: Any
    """(bands, CHUNK): reflectance factor to remove"""
    direct: Any
    """(bands, CHUNK): the sun's part of it"""
    present: Any
    """(256,): materials of a chunk"""


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


# For `Extras`.
UNCERTAIN = np.uint16(1024)
SUBTRACT, RATIO, REFERENCE = 0, 1, 2
SKY_DEGREE, VARIANCE_DEGREE = 12, 5


class Extras(NamedTuple):
    """What only some runs ask of `correct_block`. Arrays (materials, bands) unless said otherwise."""

    sigma: Any
    """float32 (bands, rows, cols): 1 sigma of the corrected reflectance factor is left here; of no rows: not wanted"""
    weight: Any
    """float32 (rows, cols), or (1, 1): the part of a pixel that is its material"""
    scatter: Any
    """float32 (rows, cols), or (1, 1): 1 sigma of the normal along each of two axes [deg]"""
    own_scatter: Any
    """(m,): the same for a whole material; nan: as `scatter` says"""
    simple: bool
    """no material has a method, a sky, an average or a scatter of its own"""
    averaged: Any
    """bool (m,): the lobe is averaged over the scatter of the normals"""
    method: Any
    """int64 (m,): SUBTRACT, RATIO or REFERENCE"""
    noise: Any
    """(bands, 2): 1 sigma of the image is a + b R"""
    view_variance: Any
    """(1,): of the direction to the sensor, along each of two axes [rad^2]"""
    t0: Any
    t1: Any
    beta: Any
    """direct fraction"""
    beta_sigma: Any
    covariance: Any
    """(m, bands, 5, 5): of t0, t1, w, n, k"""
    variance: Any
    """(m, bands, 2 VARIANCE_DEGREE + 5): relative variance of the lobe, for `ratio` of the lobe over t0, from the
    covariance: c0(x) + c1(x) alpha^2 + c2 alpha^4 with polynomials c0, c1 in x = cos_l * scale + shift; then c2,
    scale, shift"""
    same_variance: Any
    """bool: w and `variance` are those of the band before"""
    sky: Any
    """(m, bands, SKY_DEGREE + 3): polynomial of t1 times the albedo of the lobe in x = cos_r * scale + shift,
    lowest power first, then scale and shift; 0 where the sky's part is left in"""
    has_sky: Any
    """bool (m,): the sky's part is taken away too, also in shadow"""
    sky_bound: Any
    """(m,): no band's sky part is larger"""
    sky_sigma: Any
    """relative 1 sigma of the albedo of the lobe"""
    reference: Any
    reference_sky: Any
    """the specular reflectance factor from sun and sky at the reference geometry, which `REFERENCE` adds back"""
    reference_gradient: Any
    """(m, bands, 5): derivatives of ln(t1 f_spec) there by t0, t1, w, n, k"""
    parts: Any
    """(m, bands, 8): 1 - beta, pi t0 beta, pi t0 (1 - beta), `reference`, `reference_sky`, beta_sigma / beta and
    beta_sigma where the variance does not hold it already, `sky_sigma`"""
    cross: Any
    """(m, bands, VARIANCE_DEGREE + 3): relative covariance of the lobe and the one at the reference geometry:
    c0(x) + c1 alpha^2; then c1, and the relative variance of the latter"""
    highest: Any
    """(1,): largest stored value that a correction may reach"""


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


def new_scratch(bands: int, real: type[np.floating[Any]]) -> Scratch:
    """Memory for one thread."""
    whole, lines = np.zeros(18 * CHUNK, np.int32), np.zeros(38 * CHUNK, real)
    lines[FACTOR : FACTOR + CHUNK] = 1
    return Scratch(
        aims=np.zeros(9 * CHUNK),
        real=lines,
        whole=whole,
        power=whole[POWER : POWER + CHUNK].view(np.float32),
        amounts=np.zeros((bands, CHUNK), real),
        direct=np.zeros((bands, CHUNK), real),
        present=np.zeros(256, np.int64),
    )


@njit(cache=True, **BLOCK)
def correct_block(
    image, removed, flags, material, sun, view, normal, table, rules, tally, scratch, equations, options, extras=None
):
    """Take the specular part out of a block of an image, in place. Twin of reference.correct_block.

    image    : (bands, rows, cols), stored values; changed in place.
    removed  : the same shape and type, zeros on entry: what was taken away. Or of no rows: not wanted.
    flags    : uint16 (rows, cols). On entry CAST_SHADOW, NOT_VIEWED, NORMAL_UNRELIABLE, LOW_CONFIDENCE where
               they hold; on exit all bits of PixelFlag. Those of the geometry are cleared where no material has a
               peak and where there are no data, since there nobody looks.
    material : uint8 (rows, cols), rows of `table`; 0 is no material.
    sun, view, normal : unit vectors, float64 (3, rows, cols), or (3, 1, 1) where constant; `normal` also float32.
    equations : True: the equations themselves at each pixel, in float64; or None: polynomials stand in for them, and
               the equations are not even compiled.
    options  : int64 (3,): skip, first row of the block in the image, tally every so many rows.
    extras   : Extras; or None: plain subtraction of the sun's part, and nothing more is compiled.
    """
    bands, rows, cols = image.shape
    skip, first_row, stride = options[0] != 0, options[1], options[2]
    aims, real, whole, amounts, present = scratch.aims, scratch.real, scratch.whole, scratch.amounts, scratch.present
    nodata = rules.nodata[0]
    for row in range(rows):
        tallied = (first_row + row) % stride == 0
        for start in range(0, cols, CHUNK):
            stop = min(start + CHUNK, cols)
            count, marks = stop - start, flags[row, start:stop]

            # Which materials there are, and whether the geometry lets them be assessed.
            _load(material[row, start:stop], marks, whole)
            for b in range(bands):
                _look(image[b, row, start:stop], rules, b, nodata, whole)
            kinds, peaks = _list_kinds(whole, count, table.peak, present)
            for place in range(peaks):
                _set_rules(whole, real, table, present[place])
            _mark_known(whole)
            assessed, hits, blanks = 0, 0, 0
            if peaks > 0:
                _aim(sun, row, start, stop, aims[SUN:VIEW])
                _aim(view, row, start, stop, aims[VIEW:NORMAL])
                _aim(normal, row, start, stop, aims[NORMAL:])
                _set_cosines(aims, real)
                assessed = _assess(whole, real)
            plain = True
            if extras is not None:
                plain = _set_extras(scratch, extras, peaks, row, start, stop)
                assessed += 0 if plain else _assess_shaded(whole, real)

            # What is to be removed, and what becomes of each pixel.
            inside = assessed > 0
            if inside:
                tally.attenuated[0] += _set_shape(whole, real)
                inside = _set_amounts(scratch, table, peaks, skip, equations, extras)
                tally.out_of_lobe[0] += 0 if inside else assessed
            if inside:
                _clear(whole, real)
                if plain:
                    for b in range(bands):
                        _weigh(amounts[b], image[b, row, start:stop], rules.scale[b], rules.offset[b], whole, real)
                if extras is not None:
                    for b in range(0 if plain else bands):
                        _weigh_any(scratch, extras, peaks, image[b, row, start:stop], rules, b)
                hits, blanks = _settle(whole)
            if extras is not None and extras.sigma.shape[1] > 0:
                _set_sigma(scratch, table, extras, peaks, hits, plain, image, row, start, stop, rules)
            for b in range(bands if hits > 0 else 0):
                line = image[b, row, start:stop]
                if tallied and plain:
                    _set_share(amounts[b], line, rules.scale[b], rules.offset[b], real)
                if plain:
                    _subtract(amounts[b], line, rules, b, whole, real)
                elif extras is not None:
                    _exchange(amounts[b], line, rules, b, extras.highest[0], whole, real)
                if removed.shape[1] > 0:
                    _keep(amounts[b], removed[b, row, start:stop], whole)
            for b in range(bands if blanks > 0 else 0):
                _blank(image[b, row, start:stop], nodata, whole)
                if extras is not None and extras.sigma.shape[1] > 0:
                    _blank(extras.sigma[b, row, start:stop], np.float32(np.nan), whole)

            _store(marks, whole)
            for place in range(kinds):
                _count_states(whole, np.int32(present[place]), count, tally.states)
            if tallied and assessed > 0:
                _tally_geometry(whole, real, count, tally)
            if tallied and hits > 0:
                _tally_removed(whole, real, amounts, count, rules.scale, tally)


@njit(**STEP)
def _load(kinds, marks, whole):
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
def _look(line, rules, b, nodata, whole):
    """Which pixels have no data in a band, and which are saturated in it; integers always have a value."""
    saturation = rules.saturation[b]
    if rules.integer is None:
        for j in range(line.size):
            value = np.float32(line[j])
            whole[MISSING + j] |= np.int32(value - value != ZERO)
    if saturation < ENDLESS:
        for j in range(line.size):
            whole[SATURATES + j] |= np.int32(np.float32(line[j]) >= saturation)
    if rules.has_nodata:
        for j in range(line.size):
            whole[MISSING + j] |= np.int32(line[j] == nodata)


@njit(**STEP)
def _list_kinds(whole, count, peak, present):
    """List the materials of a chunk in `present`, those with a peak first; how many, and how many have one."""
    kinds, peaks, last = 0, 0, np.int32(-1)
    while True:
        least = NO_KIND
        for j in range(count):
            q = whole[KIND + j] if whole[KIND + j] > last else NO_KIND
            least = q if q < least else least
        if least == NO_KIND:
            return kinds, peaks
        last = least
        present[kinds] = last
        kinds += 1
        if peak[last]:
            present[kinds - 1], present[peaks] = present[peaks], last
            peaks += 1


@njit(**STEP)
def _set_rules(whole, real, table, q):
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
def _mark_known(whole):
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
def _aim(field, row, start, stop, aims):
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
def _set_cosines(aims, real):
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
        real[ALPHA2 + j] = _arccos2(real[ALPHA2 + j])


@njit(**STEP, inline="always")
def _arccos2(u):
    """arccos(1 - u)^2."""
    high = (((A8 * u + A7) * u + A6) * u + A5) * u + A4
    return ((((high * u + A3) * u + A2) * u + A1) * u + A0) * u


@njit(**STEP)
def _assess(whole, real):
    """Leave out pixels that are not lit, not seen, too steep or hidden, and flag why; the number that is left."""
    total = np.int32(0)
    for j in range(CHUNK):
        f = whole[MARKS + j]
        cos_i, cos_r = real[COS_I + j], real[COS_R + j]
        least = cos_i if cos_i < cos_r else cos_r
        most = cos_r if cos_i < cos_r else cos_i
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


@njit(**STEP)
def _set_shape(whole, real):
    """G / (cos_i cos_r), on the plane that R refers to; finite at grazing angles. The number of pixels with G < 1."""
    attenuated = np.int32(0)
    for j in range(CHUNK):
        good = whole[ASSESS + j] == LIT
        cos_i, cos_r, cos_l = real[COS_I + j], real[COS_R + j], real[COS_L + j]
        least = cos_i if cos_i < cos_r else cos_r
        most = cos_r if cos_i < cos_r else cos_i
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


@njit(**STEP)
def _set_amounts(scratch, table, peaks, skip, equations, extras):
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
                if extras is not None:
                    _set_factors(scratch, table.w2[:, b], peaks, scattered)
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
                if extras is not None:
                    _set_factors(scratch, table.w2[:, b], peaks, scattered)
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


@njit(**STEP)
def _clear(whole, real):
    """Nothing weighed so far; a pixel that is not assessed has a threshold that nothing reaches."""
    for j in range(CHUNK):
        real[THRESHOLD + j] = real[NEGLIGIBLE + j] if whole[ASSESS + j] != 0 else ENDLESS
        real[SHARE + j] = ZERO
        whole[HIT + j] = 0
        whole[OVER + j] = 0


@njit(**BAND)
def _weigh(amounts, line, scale, offset, whole, real):
    """One band's amounts against threshold and signal; amounts below the threshold become 0."""
    for j in range(line.size):
        a = amounts[j]
        above = a >= real[THRESHOLD + j]
        r = real.dtype.type(line[j]) * scale + offset
        amounts[j] = a if above else ZERO
        whole[HIT + j] |= np.int32(above)
        whole[OVER + j] |= np.int32(above & ((a > real[LIMIT + j] * r) | (r <= ZERO)))


@njit(**STEP)
def _set_share(amounts, line, scale, offset, real):
    """The largest share of the signal so far; 2 where there is something to take and no signal."""
    for j in range(line.size):
        a = amounts[j]
        r = real.dtype.type(line[j]) * scale + offset
        bright = r > ZERO
        part = (a if bright else TWO) / (r if bright else ONE)
        part = part if a > ZERO else ZERO
        real[SHARE + j] = part if part > real[SHARE + j] else real[SHARE + j]


@njit(**STEP)
def _settle(whole):
    """SPECULAR_STATE from what `_weigh` found in all bands; how many pixels to correct, and of them to blank."""
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
def _subtract(amounts, line, rules, b, whole, real):
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
            part = real.dtype.type(np.int32(part if part < MOST_STEPS else MOST_STEPS))
        new = value - part
        low = new < least
        floor = least if least < value else value
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
def _keep(amounts, taken, whole):
    """Write down what was taken from one band."""
    for j in range(taken.size):
        taken[j] = amounts[j] if whole[HIT + j] != 0 else taken[j]


@njit(**STEP)
def _blank(line, nodata, whole):
    """Nodata where a pixel is uncorrectable and its material wants it so."""
    for j in range(line.size):
        if whole[STATE + j] == UNCORRECTABLE_STATE and (whole[WAYS + j] & BLANK) != 0:
            line[j] = nodata


@njit(**STEP)
def _store(marks, whole):
    """Flags of a chunk, complete."""
    for j in range(marks.size):
        f = whole[MARKS + j] | (CLIPPED if whole[CLIPS + j] != 0 else NO_FLAG)
        marks[j] = f | (whole[STATE + j] << STATE_SHIFT)


@njit(**STEP)
def _count_states(whole, kind, count, states):
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
def _tally_geometry(whole, real, count, tally):
    """Histograms of the angle of incidence and of the facet tilt over the assessed pixels of a chunk."""
    for j in range(CHUNK):
        u = ONE - real[COS_I + j]
        incidence = np.sqrt(_arccos2(u if u > ZERO else ZERO)) * QUARTERS_PER_RAD
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
def _tally_removed(whole, real, amounts, count, scale, tally):
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


@njit(**STEP)
def _set_extras(scratch, extras, peaks, row, start, stop):
    """What only some runs have of a chunk; True if all its materials are simply subtracted, without the sky."""
    real, whole, present, plain = scratch.real, scratch.whole, scratch.present, True
    _set_fields(extras.weight, extras.scatter, row, start, stop, whole, real)
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
def _set_factors(scratch, w2, peaks, scattered):
    """Broaden the lobes of materials whose scattered normals are averaged."""
    real, whole, present = scratch.real, scratch.whole, scratch.present
    for place in range(peaks if scattered else 0):
        _set_w2(whole, real, np.int32(present[place]), w2[present[place]])
    if scattered:
        _set_factor(whole, real)
        _scale(real, W2, FACTOR)


@njit(**STEP)
def _weigh_any(scratch, extras, peaks, line, rules, b):
    """`_weigh` for any method, and with the sky's part."""
    for place in range(peaks):
        q = scratch.present[place]
        _set_parts(scratch.whole, scratch.real, scratch.aims, np.int32(q), extras.sky[q, b], extras.parts[q, b])
    _weigh_parts(
        scratch.amounts[b], scratch.direct[b], line, rules.scale[b], rules.offset[b], scratch.whole, scratch.real
    )


@njit(**STEP)
def _set_sigma(scratch, table, extras, peaks, hits, plain, image, row, start, stop, rules):
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
                _set_parts(whole, real, scratch.aims, np.int32(q), extras.sky[q, b], extras.parts[q, b])
                _set_cross(whole, real, np.int32(q), extras.cross[q, b], extras.variance[q, b])
        if plain:
            _spread(sigma, taken, line, scale[b], offset[b], extras.noise[b], saturation[b], whole, real)
        else:
            _spread_parts(sigma, taken, scratch.direct[b], line, scale[b], offset[b], saturation[b], whole, real)
    _mark_unsure(whole)


@njit(**STEP)
def _set_holes(whole, real):
    """1 where there is data, else nan."""
    for j in range(CHUNK):
        real[HOLE + j] = ONE if whole[MISSING + j] == 0 else real.dtype.type(np.nan)


@njit(**STEP)
def _exchange(amounts, line, rules, b, highest, whole, real):
    """`_subtract` for amounts of either sign; the new value is held above 0 and in the range of the type."""
    steps, least, saturation = rules.steps[b], rules.lowest[b], rules.saturation[b]
    dodges, integer, blank = rules.dodge, rules.integer, real.dtype.type(rules.nodata[0])
    for j in range(line.size):
        value = real.dtype.type(line[j])
        part = amounts[j] * steps
        if integer is None:
            part = real.dtype.type(line.dtype.type(part))
        else:
            part = np.floor(part + HALF)
            part = part if part < MOST_STEPS else MOST_STEPS
        new = value - part
        low, most = new < least, highest if highest > value else value
        floor = least if least < value else value
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


@njit(**BAND)
def _set_noise(sigma, line, scale, offset, noise, whole):
    """1 sigma of the image in one band; nan where it has no data."""
    a, b, nothing = np.float32(noise[0]), np.float32(noise[1]), np.float32(np.nan)
    for j in range(line.size):
        r = np.float32(line[j]) * np.float32(scale) + np.float32(offset)
        r = r if r > ZERO else ZERO
        sigma[j] = nothing if whole[MISSING + j] != 0 else a + b * r


@njit(**STEP)
def _set_fields(weight, scatter, row, start, stop, whole, real):
    """Weights and the variance of the normals of a chunk, each of which may be one for all pixels; no more rules."""
    sigma = scatter[0, 0] * RAD_PER_DEG
    for j in range(CHUNK):
        real[WEIGHT + j] = weight[0, 0]
        real[SCATTER2 + j] = sigma * sigma
        whole[UNSURE + j] = 0
        whole[AVERAGED + j] = 0
        whole[SKIES + j] = 0
    if weight.size > 1:
        line = weight[row, start:stop]
        for j in range(line.size):
            real[WEIGHT + j] = line[j]
    if scatter.size > 1:
        line = scatter[row, start:stop]
        for j in range(line.size):
            sigma = line[j] * RAD_PER_DEG
            real[SCATTER2 + j] = sigma * sigma


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
def _assess_shaded(whole, real):
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


@njit(**STEP)
def _scale(real, place, factor):
    """One line times another."""
    for j in range(CHUNK):
        real[place + j] *= real[factor + j]


@njit(**STEP)
def _set_factor(whole, real):
    """(w_eff / w)^2 of the lobe averaged over scattered normals: twin of reference.broadened."""
    for j in range(CHUNK):
        factor = ONE / (ONE + TWO * real[W2 + j] * real[SCATTER2 + j])
        real[FACTOR + j] = factor if whole[AVERAGED + j] != 0 else ONE


@njit(**STEP)
def _set_parts(whole, real, aims, kind, sky, parts):
    """What one band of one material adds and shows besides the sun's lobe: sky, reference geometry, diffuse part."""
    of_sky, diffuse_sun, diffuse_sky, back, back_sky = parts[0], parts[1], parts[2], parts[3], parts[4]
    rate, sigma, sky_sigma = parts[5], parts[6], parts[7]
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
        shown = diffuse_sun * (plane if lit else ZERO) + diffuse_sky * sky_view
        real[SKY + j] = (of_sky * a if good else ZERO) if mine else real[SKY + j]
        real[ALBEDO + j] = a - back_sky if mine else real[ALBEDO + j]
        real[BACK + j] = (back if lit else ZERO) if mine else real[BACK + j]
        real[BACK_SKY + j] = (of_sky * back_sky if good else ZERO) if mine else real[BACK_SKY + j]
        real[DIFFUSE + j] = shown if mine else real[DIFFUSE + j]
        real[BETA_RATE + j] = rate if mine else real[BETA_RATE + j]
        real[BETA_SIGMA + j] = sigma if mine else real[BETA_SIGMA + j]
        real[SKY_SIGMA + j] = sky_sigma if mine else real[SKY_SIGMA + j]


@njit(**STEP)
def _weigh_parts(amounts, direct, line, scale, offset, whole, real):
    """`_weigh` for any method and with the sky's part; the sun's part is kept in `direct`."""
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
        real[SHARE + j] = part if part > real[SHARE + j] else real[SHARE + j]
        amounts[j] = a if above else ZERO
        whole[HIT + j] |= np.int32(above)
        whole[OVER + j] |= np.int32(above & (part > real[LIMIT + j]))


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
        of_material = of_material if of_material > ZERO else ZERO
        turned = (real[TURNS_W4 + j] * w2 + real[TURNS_W2 + j]) * w2 + real[TURNS + j]
        turned = turned if turned > ZERO else ZERO
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
        seen = base + share * (r if r > ZERO else ZERO)
        sigma[j] = np.sqrt(seen * seen + variance) * real[HOLE + j]
        whole[UNSURE + j] |= np.int32(FOUR * variance > left * left)


@njit(**STEP)
def _spread_parts(sigma, amounts, direct, line, scale, offset, saturation, whole, real):
    """`_spread` for any method and with the sky's part: twin of the sigma in reference.correct_block."""
    for j in range(line.size):
        a, value, noise, sun = amounts[j], real.dtype.type(line[j]), real.dtype.type(sigma[j]), direct[j]
        r = value * scale + offset
        seen = r if r > ZERO else ZERO
        left = r - a
        left = left if left > ZERO else ZERO
        back, specular_part = real[BACK + j], sun + real[SKY + j]
        of_material = sun * sun * real[OF_MATERIAL + j] + back * (
            back * real[BACK_VARIANCE + j] - TWO * sun * real[CROSS + j]
        )
        error = np.sqrt(of_material if of_material > ZERO else ZERO)
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
