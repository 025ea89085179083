"""How far a lobe reaches: facet tilts and whole blocks of geometry where it is negligible for certain."""

import numpy as np
from numpy.typing import ArrayLike

from tscorr import reference
from tscorr.width.lobe import Array, Lobe, is_simplified, lobe_shape

Range = tuple[ArrayLike, ArrayLike]

ROUNDING = 64 * np.finfo(float).eps
"""Relative rounding of f_spec, per unit of 1 + (w alpha)^2; four times the contract of `reference`."""


def cutoff_tilt(
    m: Lobe,
    incidence_deg: ArrayLike,
    exitance_deg: ArrayLike,
    negligible_reflectance: float,
    form: str = "full",
    *,
    direct_fraction: float = 1.0,
    wavelength_um: float | None = None,
) -> Array:
    """Facet tilt from which on the specular part is negligible, at any relative azimuth. [deg]

    pi direct_fraction t1 f_spec < negligible_reflectance for certain at larger tilts; on a tilted facet
    divide the latter by cos(incidence) / cos(solar zenith) if it refers to the horizontal plane.
    (1/w) sqrt(ln(peak / negligible)) with an upper bound of the peak over all azimuths. 0 where nothing
    matters, 90 where everything does, nan where an angle is not in [0, 90).
    """
    shape, simplified = lobe_shape(m, wavelength_um), is_simplified(form)
    incidence, exitance = np.broadcast_arrays(
        np.asarray(incidence_deg, dtype=float), np.asarray(exitance_deg, dtype=float)
    )
    without_exponential = 0.0  # w
    all_azimuths = (0, 180)
    flat = f_spec_bound(
        (incidence, incidence),
        (exitance, exitance),
        all_azimuths,
        without_exponential,
        shape.n,
        shape.k,
        simplified=simplified,
    )
    peak = np.pi * direct_fraction * shape.t1 * flat
    if negligible_reflectance <= 0:
        tilt = np.where(peak > 0, 90.0, 0.0)
    else:
        ratio = np.maximum(peak / negligible_reflectance, 1)
        tilt = np.minimum(np.sqrt(np.log(ratio)) / shape.w, 90)
    return np.where(np.isfinite(flat), tilt, np.nan)[()]


def f_spec_bound(
    incidence_range_deg: Range,
    exitance_range_deg: Range,
    relative_azimuth_range_deg: Range,
    w: ArrayLike,
    n: ArrayLike,
    k: ArrayLike,
    *,
    simplified: bool = False,
) -> Array:
    """A number that f_spec exceeds nowhere in a box of angles. [1]

    Ranges are (low, high) with both ends inside, arrays of boxes broadcast; relative azimuths are in
    [0, 180]. inf where a box leaves [0, 90) or [0, 180]. The half-angle forms of `reference`, each term at
    the end of its range that makes f_spec larger:

        tan^2 alpha   >= tan^2 D_min + (sin sin)_min cos^2(phi_max/2) / (cos S_min cos D_min)^2
        cos^2 theta_l >= cos^2 S_max + (sin sin)_min cos^2(phi_max/2), and likewise its other end
        G / (cos cos) <= min(1 / (cos cos)_min, (1 + lesser / greater cosine) / (cos^2 theta_l)_min)

    Rounded up by more than the arithmetic can err. About 1.1 times the largest value in boxes of 1 degree.
    """
    low_i, high_i = (np.asarray(end, dtype=float) for end in incidence_range_deg)
    low_r, high_r = (np.asarray(end, dtype=float) for end in exitance_range_deg)
    low_phi, high_phi = (np.asarray(end, dtype=float) for end in relative_azimuth_range_deg)
    allowed = (low_i >= 0) & (low_r >= 0) & (high_i < 90) & (high_r < 90)
    allowed = allowed & (low_i <= high_i) & (low_r <= high_r)
    allowed = allowed & (low_phi >= 0) & (low_phi <= high_phi) & (high_phi <= 180)
    low_i, high_i, low_r, high_r, low_phi, high_phi = (
        np.where(allowed, end, 0.0) for end in (low_i, high_i, low_r, high_r, low_phi, high_phi)
    )

    d_min = np.deg2rad(np.maximum(0, np.maximum(low_i - high_r, low_r - high_i)) / 2)
    d_max = np.deg2rad(np.maximum(high_i - low_r, high_r - low_i) / 2)
    cos_s_of_lowest, cos_s_of_highest = _cos((low_i + low_r) / 2), _cos((high_i + high_r) / 2)
    sines_min, sines_max = _sin(low_i) * _sin(low_r), _sin(high_i) * _sin(high_r)
    out_of_plane_min = sines_min * _cos(high_phi / 2) ** 2
    out_of_plane_max = sines_max * _cos(low_phi / 2) ** 2

    tan2_alpha = np.tan(d_min) ** 2 + out_of_plane_min / (cos_s_of_lowest * np.cos(d_min)) ** 2
    exponent = (np.asarray(w) * np.rad2deg(np.arctan(np.sqrt(tan2_alpha)))) ** 2
    cos2_l_min = np.maximum(
        cos_s_of_highest**2 + out_of_plane_min, 1 - np.sin(d_max) ** 2 - sines_max * _sin(high_phi / 2) ** 2
    )
    cos2_l_max = np.minimum(
        cos_s_of_lowest**2 + out_of_plane_max, 1 - np.sin(d_min) ** 2 - sines_min * _sin(low_phi / 2) ** 2
    )

    visible = 1 / (_cos(high_i) * _cos(high_r))
    if not simplified:
        lesser = np.minimum(_cos(low_i), _cos(low_r))
        greater = np.maximum(_cos(high_i), _cos(high_r))
        visible = np.minimum(visible, (1 + np.minimum(1, lesser / greater)) / cos2_l_min)
    fresnel = _fresnel_bound(np.sqrt(cos2_l_min), np.sqrt(np.maximum(cos2_l_max, cos2_l_min)), n, k)
    bound = fresnel * visible * np.exp(-exponent) * (1 + ROUNDING * (1 + exponent))
    return np.where(allowed, bound, np.inf)[()]


def _fresnel_bound(cos_l_min: Array, cos_l_max: Array, n: ArrayLike, k: ArrayLike) -> Array:
    """At least the Fresnel reflectance everywhere between two cosines of the local angle.

    For n >= 1 and a normal reflectance of at most 1/3 it rises with the local angle (transparent media:
    Azzam, JOSA A 32, 1180, 2015; absorbing ones: checked on a grid, see test_20_width.py). For others its
    s part rises and its p part has at most one minimum.
    """
    n, k = np.asarray(n, dtype=float), np.asarray(k, dtype=float)
    at_normal = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    rises = (n >= 1) & (at_normal <= 1 / 3)
    s_steep, p_steep = _polarised(cos_l_min, n, k)
    _, p_flat = _polarised(cos_l_max, n, k)
    by_parts = np.minimum((s_steep + np.maximum(p_steep, p_flat)) / 2, 1)
    return np.where(rises, reference.fresnel(cos_l_min, n, k), by_parts)


def _polarised(cos_l: Array, n: Array, k: Array) -> tuple[Array, Array]:
    """Fresnel reflectances of the two polarisations, s and p."""
    n2 = (n - 1j * k) ** 2
    q = np.sqrt(n2 - 1 + cos_l * cos_l)
    return np.abs((cos_l - q) / (cos_l + q)) ** 2, np.abs((n2 * cos_l - q) / (n2 * cos_l + q)) ** 2


def _cos(angle_deg: Array) -> Array:
    return np.sin(np.deg2rad(90 - angle_deg))  # keeps its digits towards 90


def _sin(angle_deg: Array) -> Array:
    return np.sin(np.deg2rad(angle_deg))
