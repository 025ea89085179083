"""What the block loop is given: materials, rules, scratch memory, sums, and what only some runs ask for."""

from typing import Any, NamedTuple

import numpy as np

from tscorr.kernels.layout import CHUNK, FACTOR, POWER


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
    """(m, bands, VARIANCE_DEGREE + LEAN_DEGREE + 3): relative variance of the lobe, for `ratio` of the lobe over t0,
    from the covariance: c + (d - e alpha^2)^2 with polynomials c, d in cos_l, lowest powers first; then e"""
    same_variance: Any
    """bool: w and `variance` are those of the band before"""
    sky: Any
    """(m, bands, SKY_DEGREE + 3): polynomial of t1 times the albedo of the lobe in x = cos_r * scale + shift,
    lowest power first, then scale and shift; 0 where the sky's part is left in"""
    has_sky: Any
    """bool (m,): the sky's part is taken away too, also in shadow"""
    sky_sigma: Any
    """relative 1 sigma of the albedo of the lobe"""
    reference: Any
    reference_sky: Any
    """the specular reflectance factor from sun and sky at the reference geometry, which `REFERENCE` adds back"""
    reference_gradient: Any
    """(m, bands, 5): derivatives of ln(t1 f_spec) there by t0, t1, w, n, k"""
    parts: Any
    """(m, bands, 9): 1 - beta, pi t0 beta, pi t0 (1 - beta), `reference`, `reference_sky`, beta_sigma / beta and
    beta_sigma where the variance does not hold it already, `sky_sigma`, pi t0 beta_sigma"""
    cross: Any
    """(m, bands, VARIANCE_DEGREE + 3): relative covariance of the lobe and the one at the reference geometry:
    c0 + c1 alpha^2 with a polynomial c0 in cos_l; then c1, and the relative variance of the latter"""
    highest: Any
    """(1,): largest stored value that a correction may reach"""


def new_scratch(bands: int, real: type[np.floating[Any]]) -> Scratch:
    """Memory for one thread."""
    whole, lines = np.zeros(17 * CHUNK, np.int32), np.zeros(40 * CHUNK, real)
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
