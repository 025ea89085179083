"""The equations of Meister et al. (2000), one function an equation, in plain numpy.

This is the text to read beside the paper; `kernels.py` holds the fast twins. Any float type goes in and
comes out (float32, float64, longdouble), shapes broadcast, nan gives nan.

Conventions. theta_i and theta_r are measured from the surface normal. phi is the difference of the
azimuths of the directions surface→source and surface→viewer: 0 is back-scatter, 180 forward scatter,
where the peak is. alpha is the tilt of the facet that mirrors the source into the viewer, theta_l its local
angle of incidence. w is in 1/degree, as in the paper. The refractive index is n - ik.

Sources: G. Meister, A. Rothkirch, H. Spitzer, J. Bienlein, The shape of the specular peak of rough surfaces,
ISPRS 2000 ("paper"). K. Torrance, E. Sparrow, JOSA 57, 1105 (1967). J. Blinn, SIGGRAPH 1977.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Geometry(NamedTuple):
    """What the model needs to know of source, viewer and surface; arrays of one shape."""

    cos_i: Array
    """cosine of the angle of incidence"""
    cos_r: Array
    """cosine of the angle of exitance"""
    cos_l: Array
    """cosine of the local angle: half the angle between source and viewer"""
    alpha: Array
    """facet tilt [rad]"""


def geometry_from_angles(theta_i: Array, theta_r: Array, phi: Array) -> Geometry:
    """Geometry from theta_i, theta_r, phi in degrees; equation 3 of the paper.

    Written with half angles, S = (theta_i + theta_r) / 2, D = (theta_i - theta_r) / 2, psi = 180 - phi,
    so that every term has one sign and no digit is lost near the peak or near grazing:

        tan^2 alpha   = tan^2 D + sin theta_i sin theta_r sin^2(psi/2) / (cos S cos D)^2
        cos^2 theta_l = cos^2 S + sin theta_i sin theta_r sin^2(psi/2)

    Equal to the paper's equation 3, whose arccos loses all digits as alpha → 0. At theta_i = theta_r = 90,
    phi = 180 the facet is undefined: nan.
    """
    elevation_i, elevation_r = 90 - theta_i, 90 - theta_r
    cos_s = np.sin(np.deg2rad((elevation_i + elevation_r) / 2))
    half_difference = np.deg2rad((theta_i - theta_r) / 2)
    out_of_plane = np.sin(np.deg2rad(theta_i)) * np.sin(np.deg2rad(theta_r)) * np.sin(np.deg2rad((180 - phi) / 2)) ** 2
    cos_l = np.sqrt(cos_s**2 + out_of_plane)
    facet_exists = cos_l > 0
    denominator = np.where(facet_exists, cos_s * np.cos(half_difference), np.nan)
    horizontal = denominator == 0  # the facet stands upright: alpha = 90
    ratio = out_of_plane / np.where(horizontal, 1, denominator) ** 2
    tan2_alpha = np.where(horizontal, np.inf, np.tan(half_difference) ** 2 + ratio)
    return Geometry(
        cos_i=np.sin(np.deg2rad(elevation_i)),
        cos_r=np.sin(np.deg2rad(elevation_r)),
        cos_l=cos_l,
        alpha=np.arctan(np.sqrt(tan2_alpha)),
    )


def geometry(sun: Array, view: Array, normal: Array) -> Geometry:
    """Geometry from unit vectors (3, ...) surface→source, surface→viewer and the surface normal.

    Goes through the paper's angles; its digits are those of the vectors.
    """
    theta_i, theta_r = _angle_between(sun, normal), _angle_between(view, normal)
    beside_sun, beside_view = _cross(normal, sun), _cross(normal, view)
    across, along = _dot(normal, _cross(beside_sun, beside_view)), _dot(beside_sun, beside_view)
    phi = np.rad2deg(np.abs(np.arctan2(across, along)))
    return geometry_from_angles(np.rad2deg(theta_i), np.rad2deg(theta_r), phi)


def facet_distribution(alpha: Array, w: Array) -> Array:
    """P(alpha), equation 2: how common facets of tilt alpha [rad] are, 1 at alpha = 0; w in 1/degree."""
    return np.exp(-((w * np.rad2deg(alpha)) ** 2))


def fresnel(cos_l: Array, n: Array, k: Array) -> Array:
    """Unpolarised Fresnel reflectance F of a facet, in [0, 1]; F of equation 1.

    With N = n - ik, c = cos_l, s^2 = 1 - c^2, q = sqrt(N^2 - s^2) = a - ib and E = N^2 - 1,

        F = |E|^2 / 2 [ 1 / |c + q|^4 + |N^2 c^2 - s^2|^2 / |N^2 c + q|^4 ]

    which is (|r_s|^2 + |r_p|^2) / 2 without the subtraction of nearly equal numbers as n → 1.
    cos_l = 0 gives 1, the index of the surroundings (n = 1, k = 0) gives 0.
    """
    c2 = cos_l * cos_l
    s2 = (1 - cos_l) * (1 + cos_l)
    e = (n - 1) * (n + 1) - k * k
    nk2 = 2 * n * k
    big_a = e + c2
    root = np.sqrt((np.hypot(big_a, nk2) + np.abs(big_a)) / 2)
    other = nk2 / 2 / np.where(root > 0, root, 1)
    a, b = np.where(big_a >= 0, root, other), np.where(big_a >= 0, other, root)
    n2 = e + 1  # the real part of N^2
    e2 = e * e + nk2 * nk2
    s_wave = (cos_l + a) ** 2 + b * b
    p_wave = (n2 * cos_l + a) ** 2 + (nk2 * cos_l + b) ** 2
    numerator = (n2 * c2 - s2) ** 2 + (nk2 * c2) ** 2
    matched = e2 == 0
    s_wave, p_wave = np.where(matched, 1, s_wave), np.where(matched, 1, p_wave)
    return e2 / 2 * (1 / s_wave**2 + numerator / p_wave**2)


def fresnel_gradient(cos_l: Array, n: Array, k: Array) -> tuple[Array, Array]:
    """Partial derivatives of `fresnel` by n and by k, at a fixed facet. [1]

    With r_s = (c - q) / (c + q) and r_p = (N^2 c - q) / (N^2 c + q), dF/dn = Re Z and dF/dk = Im Z of
    Z = conj(r_s) r_s' + conj(r_p) r_p', the dash for the derivative by N.
    """
    index = n - 1j * np.asarray(k)
    n2 = index * index
    s2 = (1 - cos_l) * (1 + cos_l)
    q = np.sqrt(n2 - s2)
    q = np.where(q.imag > 0, -q, q)
    r_s = (cos_l - q) / (cos_l + q)
    r_p = (n2 * cos_l - q) / (n2 * cos_l + q)
    slope_s = -2 * cos_l * index / (q * (cos_l + q) ** 2)
    slope_p = 2 * index * cos_l * (n2 - 2 * s2) / (q * (n2 * cos_l + q) ** 2)
    z = np.conj(r_s) * slope_s + np.conj(r_p) * slope_p
    return z.real, z.imag


def attenuation(cos_i: Array, cos_r: Array, cos_l: Array) -> Array:
    """Geometric attenuation factor G of equation 1: masking and shadowing in V-cavities, in [0, 1].

    Blinn's closed form, min(1, 2 (n.h)(n.v)/(v.h), 2 (n.h)(n.s)/(s.h)), with 2 n.h = (cos_i + cos_r) / cos_l.
    It equals the case table of Torrance and Sparrow (1967) in and out of the principal plane.
    """
    return np.minimum(1, np.minimum(cos_i, cos_r) * (cos_i + cos_r) / cos_l**2)


def specular(geometry: Geometry, w: Array, n: Array, k: Array, *, simplified: bool = False) -> Array:
    """f_spec of equation 1: the specular lobe for t1 = 1. [1]

    `simplified` drops G (section 5 of the paper). nan where the surface is not lit or not seen.
    """
    cos_i, cos_r, cos_l, alpha = geometry
    above = (cos_i > 0) & (cos_r > 0)
    cos_i, cos_r, cos_l = (np.where(above, cosine, np.nan) for cosine in (cos_i, cos_r, cos_l))
    g = 1 if simplified else attenuation(cos_i, cos_r, cos_l)
    return fresnel(cos_l, n, k) / (cos_i * cos_r) * g * facet_distribution(alpha, w)


def brdf(f_spec: Array, t0: Array, t1: Array) -> Array:
    """f_r of equation 1 [sr^-1]: the Lambertian part t0 plus t1 times the lobe `f_spec`."""
    return t0 + t1 * f_spec


class Gradient(NamedTuple):
    """Partial derivatives of f_r by the five parameters, at a fixed geometry."""

    t0: Array
    t1: Array
    w: Array
    n: Array
    k: Array


def brdf_gradient(
    geometry: Geometry, t1: Array, w: Array, n: Array, k: Array, *, simplified: bool = False
) -> Gradient:
    """Partial derivatives of `brdf` by t0, t1, w, n, k: of equation 1, term by term."""
    f_spec = specular(geometry, w, n, k, simplified=simplified)
    relative = t1 * f_spec / fresnel(geometry.cos_l, n, k)
    by_n, by_k = fresnel_gradient(geometry.cos_l, n, k)
    by_w = -2 * w * np.rad2deg(geometry.alpha) ** 2 * t1 * f_spec
    return Gradient(t0=np.ones_like(f_spec), t1=f_spec, w=by_w, n=relative * by_n, k=relative * by_k)


def correct_block(
    image: Array,
    removed: Array,
    flags: Array,
    material: Array,
    sun: Array,
    view: Array,
    normal: Array,
    table: Any,
    rules: Any,
    tally: Any,
    options: Array,
) -> None:
    """Take the specular part out of a block of an image, in place; slow, as the equations stand, in float64.

    Arguments as in kernels.correct_block. `skip` of the options means nothing here.
    """
    from tscorr import kernels as bits  # flag values; numba is not imported before it is needed

    stored = image.astype(np.float64)
    missing = ~np.isfinite(stored).all(axis=0)
    if rules.has_nodata:
        missing |= (image == rules.nodata[0]).any(axis=0)
    full = stored >= rules.saturation[:, None, None]

    flags &= np.where(missing | ~table.peak[material], bits.QUALITY, bits.ON_ENTRY)
    flags[missing] |= bits.NODATA | bits.NOT_ASSESSED
    flags[~missing & (material == 0)] |= bits.NO_MATERIAL | bits.NOT_ASSESSED
    flags[~missing & full.any(axis=0)] |= bits.SATURATED

    _, first_row, stride = options
    for q in range(table.peak.size):
        where = np.nonzero((material == q) & ~missing)
        tally.states[q, 3] += np.count_nonzero((material == q) & missing)
        if not table.peak[q]:
            tally.states[q, 0 if q else 3] += where[0].size
            continue
        all_bands: Any = (slice(None), *where)
        vectors = [np.broadcast_to(v, (3, *material.shape))[all_bands].astype(float) for v in (sun, view, normal)]
        angles = geometry(*vectors)
        f = flags[where]
        blocked = _not_assessable(angles, f, table, q, bits)
        amount = np.where(blocked, 0, _specular_reflectance(angles, vectors[0][2], table, q, bits))
        amount[~(amount >= table.negligible[q])] = 0

        values, saturated = stored[all_bands], full[all_bands]
        share = _share(amount, values * rules.scale[:, None] + rules.offset[:, None])
        hit = (amount > 0).any(axis=0)
        over = hit & (saturated.any(axis=0) | (share > table.share[q]))
        f[hit & ~over] |= bits.CORRECTED
        f[over] |= bits.UNCORRECTABLE

        take = (amount > 0) & ~saturated & (~over | (not table.ways[q] & (bits.KEEP | bits.BLANK)))
        new, clipped = _subtract(values, amount, rules)
        f[(take & clipped).any(axis=0)] |= bits.CLIPPED
        new = np.where(take, new, values).astype(image.dtype)
        image[all_bands] = new
        if removed.shape[1]:
            removed[all_bands] = values - new
        if table.ways[q] & bits.BLANK:
            image[:, where[0][over], where[1][over]] = rules.nodata[0]
        flags[where] = f

        tally.states[q] += np.bincount((f >> 6) & 3, minlength=4)
        tallied = (first_row + where[0]) % stride == 0
        taken = (values - new) * rules.scale[:, None]
        _tally(
            tally,
            q,
            angles,
            np.logical_not(blocked),
            np.asarray(hit),
            tallied,
            share,
            taken,
            bool(table.ways[q] & bits.SIMPLIFIED),
        )


def _not_assessable(angles: Geometry, flags: Array, table: Any, q: int, bits: Any) -> Array:
    """Which pixels are not lit, not seen, too steep or hidden; the reasons are set in `flags`."""
    self_shadow, behind = ~(angles.cos_i > 0), ~(angles.cos_r > 0)
    least, most = np.minimum(angles.cos_i, angles.cos_r), np.maximum(angles.cos_i, angles.cos_r)
    grazing = ~((least >= table.cos_min[q]) & (most <= table.cos_max[q])) & ~self_shadow & ~behind
    blocked = self_shadow | behind | grazing | (flags & bits.HIDDEN != 0)
    flags[self_shadow] |= bits.SELF_SHADOW
    flags[behind] |= bits.NOT_VIEWED
    flags[grazing] |= bits.GRAZING
    flags[blocked] |= bits.NOT_ASSESSED
    return blocked


def _specular_reflectance(angles: Geometry, sun_up: Array, table: Any, q: int, bits: Any) -> Array:
    """B = pi beta c t1 f_spec for each band; c refers it to the horizontal plane. (bands, pixels)"""
    w, n, k = (getattr(table, name)[q, :, None] for name in ("w", "n", "k"))
    f_spec = specular(angles, w, n, k, simplified=bool(table.ways[q] & bits.SIMPLIFIED))
    c = angles.cos_i / sun_up if table.ways[q] & bits.LEVEL else 1.0
    return table.gain[q, :, None] * c * f_spec


def _share(amount: Array, reflectance: Array) -> Array:
    """The largest share of the signal over the bands; 2 where there is something to take and no signal."""
    lit = reflectance > 0
    return np.where(amount > 0, np.where(lit, amount / np.where(lit, reflectance, 1), 2.0), 0).max(axis=0)


def _subtract(values: Array, amount: Array, rules: Any) -> tuple[Array, Array]:
    """Stored values less the amount, rounded to stored steps and held above 0; and where they were held."""
    steps = amount * rules.steps[:, None]
    new = values - (np.floor(steps + 0.5) if rules.integer else steps.astype(rules.nodata.dtype))
    lowest = rules.lowest[:, None]
    low = new < lowest
    new = np.where(low, np.minimum(values, lowest), new)
    dodge = rules.dodge & (new == rules.nodata[0])
    return np.where(dodge, new + 1, new), low | dodge


def _tally(
    tally: Any,
    q: int,
    angles: Geometry,
    assessed: Array,
    hit: Array,
    tallied: Array,
    share: Array,
    taken: Array,
    simplified: bool,
) -> None:
    """The sums for the report, as kernels.Tally describes them."""
    g = attenuation(angles.cos_i, angles.cos_r, angles.cos_l)
    tally.attenuated[0] += np.count_nonzero((g < 1) & assessed)
    of = assessed & tallied
    incidence, tilt = (
        np.rad2deg(np.arctan2(np.sqrt(1 - angles.cos_i[of] ** 2), angles.cos_i[of])),
        np.rad2deg(angles.alpha[of]),
    )
    np.add.at(tally.incidence[q], np.minimum(359, incidence * 4).astype(int), 1)
    np.add.at(tally.tilt[q], np.minimum(899, tilt * 10).astype(int), 1)
    tally.extremes[q, 0] = min(tally.extremes[q, 0], tilt.min(initial=np.inf))
    of = hit & tallied
    part = np.minimum(1, share[of])
    np.add.at(tally.share[q], (part * 200).astype(int), 1)
    tally.extremes[q, 1] = max(tally.extremes[q, 1], part.max(initial=0))
    tally.removed[q] += np.floor(taken[:, of] * 2.0**32 + 0.5).astype(np.int64).sum(axis=1)
    change = 1 - g[of] if simplified else 1 / g[of] - 1
    tally.attenuated[1] = max(tally.attenuated[1], (part * change).max(initial=0))


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Array, b: Array) -> Array:
    x, y, z = np.broadcast_arrays(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return np.stack([x, y, z])


def _angle_between(a: Array, b: Array) -> Array:
    """Angle between two vectors [rad], without the arccos that fails near 0 and 180."""
    across = _cross(a, b)
    return np.arctan2(np.sqrt(_dot(across, across)), _dot(a, b))
