"""Width and place of the peak in the principal plane.

Exitance has a sign here: positive on the side of the mirror direction (phi = 180), negative on the sun's
side (phi = 0), so that the plane is one line from -90 to 90 degrees.
"""

from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from tscorr import reference
from tscorr.width.azimuthal import azimuthal_width
from tscorr.width.lobe import LN2, Array, Lobe, LobeShape, bisect, highest, is_simplified, lobe_shape

HORIZON_DEG = 89.999
"""A lobe that still rises here rises to the horizon: the simplified form is infinite at 90."""

STEPS = 360
"""Steps of a search from the mirror direction, or from the peak, to the horizon."""


def peak_exitance(
    m: Lobe,
    incidence_deg: ArrayLike,
    form: str = "full",
    *,
    wavelength_um: float | None = None,
) -> Array:
    """Exitance at which f_spec is highest, uphill from the mirror direction in the principal plane. [deg]

    It lies beyond the mirror direction (off-specular peak), since 1 / cos(exitance) rises. nan where the
    lobe rises to the horizon. Without the attenuation factor the lobe always turns up again near the
    horizon; the peak is then the maximum before. Error below 1e-4.
    """
    shape, simplified = lobe_shape(m, wavelength_um), is_simplified(form)
    incidence = np.asarray(incidence_deg, dtype=float)
    peak = np.full(incidence.shape, np.nan)
    seen = (incidence >= 0) & (incidence < HORIZON_DEG) & shape.has_peak
    peak[seen] = _peak(incidence[seen], shape, simplified)
    return peak[()]


def zenithal_width(
    m: Lobe,
    incidence_deg: ArrayLike,
    form: str = "full",
    lobe: bool = False,
    *,
    clip: bool = True,
    wavelength_um: float | None = None,
) -> Array:
    """Full width at half maximum of the peak in the principal plane. [deg]

    lobe : False for the exponential alone, 4 half_tilt about the mirror direction, cut at the horizon
           where `clip`; True for f_spec as a whole about its peak, nan where there is no peak or where
           the horizon comes before the half maximum. Error of the latter below 1e-4.
    """
    shape, simplified = lobe_shape(m, wavelength_um), is_simplified(form)
    incidence = np.asarray(incidence_deg, dtype=float)
    width = np.full(incidence.shape, np.nan)
    seen = (incidence >= 0) & (incidence < HORIZON_DEG) & shape.has_peak
    if lobe:
        width[seen] = _lobe_width(incidence[seen], shape, simplified)
    else:
        reach, horizon = 2 * shape.half_tilt_deg, 90 if clip else np.inf
        upper, lower = np.minimum(incidence + reach, horizon), np.maximum(incidence - reach, -horizon)
        width[seen] = (upper - lower)[seen]
    return width[()]


def crossover_incidence(
    m: Lobe, form: str = "full", lobe: bool = False, *, wavelength_um: float | None = None
) -> float:
    """Incidence above which the azimuthal width [deg of azimuth] is smaller than the zenithal one. [deg]

    Of the exponential alone, not cut at the horizon, as the paper counts it: tan theta = 1 / cos(half_tilt).
    With `lobe`, of f_spec as a whole, to 1e-4. nan where there is none.
    """
    shape = lobe_shape(m, wavelength_um)
    if not shape.has_peak:
        return float("nan")
    if not lobe:
        cos_half = np.cos(np.deg2rad(shape.half_tilt_deg))
        return float(np.rad2deg(np.arctan(1 / cos_half))) if shape.half_tilt_deg < 90 else float("nan")

    def excess(theta: Array) -> Array:
        return azimuthal_width(shape, theta, form=form) - zenithal_width(shape, theta, form, lobe=True)

    theta = np.arange(1.0, 90.0)
    difference = excess(theta)
    crossing = np.flatnonzero((difference[:-1] > 0) & (difference[1:] <= 0))
    if not crossing.size:
        return float("nan")
    first = crossing[0]
    return float(bisect(excess, theta[first], theta[first + 1], tolerance=1e-6))


def _log_lobe(exitance: Array, incidence: Array, shape: LobeShape, simplified: bool) -> Array:
    """Logarithm of f_spec in the principal plane."""
    phi = np.where(exitance >= 0, 180.0, 0.0)
    geometry = reference.geometry_from_angles(incidence, np.abs(exitance), phi)
    factor = shape.fresnel(geometry.cos_l) / (geometry.cos_i * geometry.cos_r)
    if not simplified:
        factor = factor * reference.attenuation(geometry.cos_i, geometry.cos_r, geometry.cos_l)
    return np.log(factor) - (shape.w_rad * geometry.alpha) ** 2


def _towards(goal: float, start: Array) -> Array:
    """Angles (start, steps) from each start to the goal."""
    share = np.linspace(0, 1, STEPS + 1)
    return start[:, np.newaxis] * (1 - share) + goal * share


def _peak(incidence: Array, shape: LobeShape, simplified: bool) -> Array:
    """`peak_exitance` of incidence (n,) in [0, HORIZON_DEG)."""
    exitance = _towards(HORIZON_DEG, incidence)
    value = _log_lobe(exitance, incidence[:, np.newaxis], shape, simplified)
    falls = value[:, 1:] < value[:, :-1]
    row, top = np.arange(len(incidence)), falls.argmax(axis=1)
    low, high = exitance[row, np.maximum(top - 1, 0)], exitance[row, top + 1]
    climb = partial(_log_lobe, incidence=incidence, shape=shape, simplified=simplified)
    return np.where(falls.any(axis=1), highest(climb, low, high), np.nan)


def _lobe_width(incidence: Array, shape: LobeShape, simplified: bool) -> Array:
    """`zenithal_width` of the whole lobe of incidence (n,) in [0, HORIZON_DEG)."""
    peak = _peak(incidence, shape, simplified)
    width = np.full(peak.shape, np.nan)
    exists = ~np.isnan(peak)
    upper = _half_maximum(peak[exists], HORIZON_DEG, incidence[exists], shape, simplified)
    lower = _half_maximum(peak[exists], -HORIZON_DEG, incidence[exists], shape, simplified)
    width[exists] = upper - lower
    return width


def _half_maximum(peak: Array, horizon: float, incidence: Array, shape: LobeShape, simplified: bool) -> Array:
    """The first half maximum on the way from the peak to a horizon; nan where there is none."""
    half = _log_lobe(peak, incidence, shape, simplified) - LN2
    exitance = _towards(horizon, peak)
    value = _log_lobe(exitance, incidence[:, np.newaxis], shape, simplified)
    below = value < half[:, np.newaxis]
    row, first = np.arange(len(peak)), np.maximum(below.argmax(axis=1), 1)

    def excess(angle: Array) -> Array:
        return _log_lobe(angle, incidence, shape, simplified) - half

    root = bisect(excess, exitance[row, first - 1], exitance[row, first], tolerance=1e-9)
    return np.where(below.any(axis=1), root, np.nan)
