"""The specular part of the sky's light: the albedo of the lobe as a polynomial in the cosine of exitance.

An even sky that gives (1 - beta) of the irradiance adds (1 - beta) a(theta_r) to the reflectance factor, with
a = t1 times the integral of f_spec cos theta_i over the hemisphere, by reciprocity the albedo. The integral takes
milliseconds an angle, so it is tabulated once for each lobe. It is always that of the full form: without G it grows
without bound towards the horizon, from where an even sky shines as well.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from tscorr import kernels
from tscorr.correction.albedo import specular_albedo

Array = NDArray[Any]

NODES = kernels.SKY_DEGREE + 5
SKY_ERROR = 2e-4
"""relative error of the polynomial up to 85 degrees: the surfaces of the paper, a metal, lobes of w = .01 to 1"""
STEP = 1e-3
"""relative step of the differences that give the derivatives"""


@cache
def sky_polynomial(w: float, n: float, k: float, max_zenith_deg: float) -> tuple[float, ...]:
    """Albedo of the lobe for t1 = 1 against cos theta_r, as a row of kernels.Extras.sky.

    Up to `max_zenith_deg`. Fitted at Chebyshev nodes with weights of one over the albedo.
    """
    x, exitance_deg, scale, shift = _nodes(max_zenith_deg)
    values = specular_albedo(exitance_deg, w=w, n=n, k=k)
    if not np.all(values > 0):
        return (*(0.0,) * (kernels.SKY_DEGREE + 1), scale, shift)
    series = chebyshev.chebfit(x, values, kernels.SKY_DEGREE, w=1 / values)
    powers = np.zeros(kernels.SKY_DEGREE + 1)
    found = chebyshev.cheb2poly(series)
    powers[: len(found)] = found
    return (*powers.tolist(), scale, shift)


@cache
def sky_log_gradient(w: float, n: float, k: float, max_zenith_deg: float) -> Array:
    """Derivatives of ln(albedo of the lobe) by w, n, k at some angles: (3, angles)."""
    exitance_deg = np.linspace(0, max_zenith_deg, 5)

    def logarithm(w: float, n: float, k: float) -> Array:
        return np.log(np.maximum(specular_albedo(exitance_deg, w=w, n=n, k=k), np.finfo(float).tiny))

    rows = []
    for place, value in enumerate((w, n, k)):
        step = STEP * max(value, 0.1 * STEP)
        up, down = ([*(w, n, k)] for _ in range(2))
        up[place], down[place] = value + step, max(value - step, 0.0)
        rows.append((logarithm(*up) - logarithm(*down)) / (up[place] - down[place]))
    return np.stack(rows)


def sky_relative_sigma(t1: float, w: float, n: float, k: float, covariance: Array, max_zenith_deg: float) -> float:
    """The largest relative 1 sigma of t1 times the albedo over the angles, from the covariance (5, 5) of t0 to k."""
    if t1 <= 0 or not covariance.any():
        return 0.0
    by_shape = sky_log_gradient(w, n, k, max_zenith_deg)
    gradient = np.concatenate([np.zeros((1, by_shape.shape[1])), np.full((1, by_shape.shape[1]), 1 / t1), by_shape])
    return float(np.sqrt(max(0.0, np.einsum("ia,ij,ja->a", gradient, covariance, gradient).max())))


def _nodes(max_zenith_deg: float) -> tuple[Array, Array, float, float]:
    """Chebyshev nodes x in [-1, 1], the angles [deg] they stand for, and x = cos * scale + shift."""
    cos_min = float(np.sin(np.deg2rad(90 - max_zenith_deg)))
    x = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    cosine = (1 - cos_min) / 2 * x + (1 + cos_min) / 2
    exitance_deg = 90 - np.rad2deg(np.arcsin(cosine))
    return x, exitance_deg, 2 / (1 - cos_min), -(1 + cos_min) / (1 - cos_min)
