"""The equations, for scalars and unit vectors as tuples of three; float64 where their arguments are."""

import math

from numba import njit

DEG_PER_RAD = 180 / math.pi


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
