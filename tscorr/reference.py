"""The equations of Meister et al. (2000), one function an equation, in plain numpy.

This is the text to read beside the paper; `kernels` holds the fast twins. Any float type goes in and
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


class DirectionVariance(NamedTuple):
    """Relative variance of the lobe from unsure directions: w^4 of_w4 + w^2 of_w2 + of_1, with w in 1/rad."""

    of_w4: Array
    of_w2: Array
    of_1: Array

    def at(self, w: Array) -> Array:
        """The variance for a lobe of this w [1/degree]. [1]"""
        w2 = np.rad2deg(w) ** 2
        return np.maximum(0, (self.of_w4 * w2 + self.of_w2) * w2 + self.of_1)


def direction_variance(
    geometry: Geometry, normal_sigma: Array, view_sigma: Array, *, simplified: bool = False, horizontal: bool = True
) -> DirectionVariance:
    """Variance of ln(c f_spec), c = cos_i / cos_sun on the `horizontal` plane or 1, from unsure normal and view.

    normal_sigma, view_sigma : 1 sigma along each of two axes across the direction. [rad]

    ln(c f_spec) = -w^2 alpha^2 + ln F + ln shape(cos_i, cos_r). With a, b the derivatives of ln shape by cos_i and
    cos_r, d = cos alpha, and the gradients of alpha, cos_i, cos_r by the normal (unit length; sin_i; sin_r long),

        |grad|^2 = 4 w^4 alpha^2 + 4 w^2 alpha / sin alpha (a (cos_l - d cos_i) + b (cos_l - d cos_r))
                   + a^2 sin_i^2 + b^2 sin_r^2 + 2 a b (2 cos_l^2 - 1 - cos_i cos_r)

    and likewise by the view, which turns the half vector by half its own error. 4 w^4 sigma^2 is added to
    4 w^4 alpha^2, so that the exponential's part is right for errors of any size, and at the top of the lobe, where
    the first order vanishes. F and cos_l, which change slowly with the view, are left out there.
    """
    cos_i, cos_r, cos_l, alpha = geometry
    by_i, by_r = _shape_slopes(cos_i, cos_r, cos_l, simplified=simplified, horizontal=horizontal)
    cos_a, sin_a = np.cos(alpha), np.sin(alpha)
    stretch = np.where(alpha > 0, alpha / np.where(alpha > 0, sin_a, 1), 1)
    n2, v2 = np.square(normal_sigma), np.square(view_sigma)
    alpha2, lean = alpha * alpha, (cos_r - cos_i) / 2
    normal_w2 = 4 * stretch * (by_i * (cos_l - cos_a * cos_i) + by_r * (cos_l - cos_a * cos_r))
    normal_1 = (
        by_i**2 * (1 - cos_i**2) + by_r**2 * (1 - cos_r**2) + 2 * by_i * by_r * (2 * cos_l**2 - 1 - cos_i * cos_r)
    )
    view_w4 = (alpha2 - (stretch * lean) ** 2) / cos_l**2
    view_w2 = 2 * by_r * (alpha * sin_a - stretch * cos_r * lean) / cos_l
    return DirectionVariance(
        of_w4=n2 * 4 * (alpha2 + n2) + v2 * view_w4,
        of_w2=n2 * normal_w2 + v2 * view_w2,
        of_1=n2 * normal_1 + v2 * by_r**2 * (1 - cos_r**2),
    )


def _shape_slopes(
    cos_i: Array, cos_r: Array, cos_l: Array, *, simplified: bool, horizontal: bool
) -> tuple[Array, Array]:
    """Derivatives of ln(G / (cos_i cos_r)), on the horizontal plane of ln(G / cos_r), by cos_i and by cos_r."""
    total = cos_i + cos_r
    whole = simplified | (np.minimum(cos_i, cos_r) * total >= cos_l**2)
    by_i = np.where(whole, -1 / cos_i, 1 / total - np.where(cos_i > cos_r, 1 / cos_i, 0))
    by_r = np.where(whole, -1 / cos_r, 1 / total - np.where(cos_i > cos_r, 0, 1 / cos_r))
    return (by_i + 1 / cos_i if horizontal else by_i), by_r


def log_gradient(geometry: Geometry, t1: Array, w: Array, n: Array, k: Array) -> Array:
    """Derivatives of ln(t1 f_spec) by t0, t1, w, n, k: (5, ...). It does not depend on G."""
    by_n, by_k = fresnel_gradient(geometry.cos_l, n, k)
    f = fresnel(geometry.cos_l, n, k)
    by_w = -2 * w * np.rad2deg(geometry.alpha) ** 2
    return np.stack(np.broadcast_arrays(np.zeros_like(by_w), 1 / t1, by_w, by_n / f, by_k / f))


def broadened(w: Array, normal_sigma_deg: Array) -> tuple[Array, Array]:
    """The lobe averaged over a Gaussian scatter of normals, sigma along each of two axes: its w, and a factor.

    In the small-angle limit alpha is the length of a vector a in the plane, and the scatter adds a vector e of density
    exp(-e^2 / 2 sigma^2) / (2 pi sigma^2). Completing the square in each of the two dimensions,

        E exp(-w^2 |a + e|^2) = (w_eff / w)^2 exp(-w_eff^2 |a|^2),   1 / w_eff^2 = 1 / w^2 + 2 sigma^2

    The volume under the lobe is kept: what is taken off the top appears on its sides. All in degrees.
    """
    factor = 1 / (1 + 2 * np.square(w * normal_sigma_deg))
    return w * np.sqrt(factor), factor


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Array, b: Array) -> Array:
    x, y, z = np.broadcast_arrays(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return np.stack([x, y, z])


def _angle_between(a: Array, b: Array) -> Array:
    """Angle between two vectors [rad], without the arccos that fails near 0 and 180."""
    across = _cross(a, b)
    return np.arctan2(np.sqrt(_dot(across, across)), _dot(a, b))
