"""How sure the parameters of a material are: covariance matrices of t0, t1, w, n, k for each band.

Correlations decide. The errors of table 1 of the paper are those of a fit with k free, in which t1, n and k can
hardly be told apart (t1-n +.97, t1-k -.98); taken as independent they make the lobe of roof tile unsure by 46 %,
though its points lie within some per cent of the fit. What the table does not print is computed here from the
model: the covariance that a fit with k held gives for 4 % noise on the paper's grid of directions, times chi2/df
where that exceeds 1. That is 2 to 10 % of the lobe. Both are to be had; the independent errors are an upper bound.
"""

from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.materials import FITTED, PARAMETERS, BandParameters, Material

Array = NDArray[Any]
Choice = Literal["synthetic", "independent"]

NOISE = 0.04
"""of the measured f_r: the lowest average error that the paper gives"""

ORIGINS = {
    "covariance": "full covariance of the material file",
    "synthetic": "errors of a fit with k held for 4 % noise on the paper's directions, times chi2/df if above 1",
    "independent": "errors of the material file taken as independent: an upper bound",
    "none": "no errors given: the parameters are taken as exact",
}
"""what is said of a material's errors in reports and tags"""


def origin(surface: Material, choice: Choice) -> str:
    """Where the errors of a material come from: a key of ORIGINS."""
    if surface.covariance:
        return "covariance"
    return choice if surface.sigma else "none"


def covariances(surface: Material, parameters: BandParameters, choice: Choice = "synthetic") -> Array:
    """Covariance of t0, t1, w, n, k in each band: (bands, 5, 5).

    parameters : of the material in each band.
    choice     : for a material that comes with errors but without a covariance.
    A full covariance is that of the material's middle wavelength; elsewhere the relative errors are the same.
    """
    kind = origin(surface, choice)
    values = np.stack([getattr(parameters, name) for name in PARAMETERS], axis=1)
    result = np.zeros((len(values), 5, 5))
    if kind == "covariance":
        middle = max(1, len(surface.wavelength_um)) // 2
        of_middle = np.array([_at(getattr(surface, name), middle) for name in PARAMETERS])
        relative = np.where(of_middle > 0, values / np.where(of_middle > 0, of_middle, 1), 1.0)[:, : len(FITTED)]
        result[:, :4, :4] = np.array(surface.covariance) * relative[:, :, None] * relative[:, None, :]
    elif kind == "independent":
        result[:] = np.diag([surface.sigma.get(name, 0.0) ** 2 for name in PARAMETERS])
    elif kind == "synthetic":
        scale = max(1.0, surface.chi2_dof) if np.isfinite(surface.chi2_dof) else 1.0
        for band, row in enumerate(values.tolist()):
            result[band, :4, :4] = scale * synthetic_covariance(*row)
    return result


@cache
def synthetic_covariance(t0: float, t1: float, w: float, n: float, k: float) -> Array:
    """Covariance (4, 4) of t0, t1, w, n that a fit with k held would have on the paper's directions.

    (J^T W J)^-1 with the Jacobian J of f_r at these parameters and weights W of 4 % noise. 0 for a material without a
    peak, or where the directions do not determine the parameters.
    """
    if t1 <= 0:
        return np.zeros((4, 4))
    geometry = reference.geometry_from_angles(*paper_directions())
    t1_, w_, n_, k_ = (np.asarray(value) for value in (t1, w, n, k))
    by = reference.brdf_gradient(geometry, t1_, w_, n_, k_)
    f_r = reference.brdf(by.t1, np.asarray(t0), t1_)
    jacobian = np.stack([by.t0, by.t1, by.w, by.n], axis=1) / (NOISE * f_r)[:, None]
    scale = np.sqrt((jacobian**2).sum(axis=0))
    if not (scale > 0).all():
        return np.zeros((4, 4))
    scaled = jacobian / scale
    try:
        inverse = np.linalg.inv(scaled.T @ scaled)
    except np.linalg.LinAlgError:
        return np.zeros((4, 4))
    result: Array = inverse / np.outer(scale, scale)
    return result


def paper_directions() -> tuple[Array, Array, Array]:
    """theta_i, theta_r, phi [deg] of 122 of the paper's measurements: (122,) each.

    The principal plane at four angles of incidence, the azimuth at three pairs of zenith angles, and across the plane.
    """
    plane = [(i, r, 180.0) for i in (10, 30, 50, 65) for r in range(0, 80, 5)]
    around = [(i, r, phi) for i, r in ((30, 30), (50, 50), (65, 70)) for phi in np.linspace(90, 177.5, 15)]
    across = [(50, r, 90.0) for r in range(10, 75, 5)]
    theta_i, theta_r, phi = np.array([*plane, *around, *across], dtype=float).T
    return theta_i, theta_r, phi


def _at(values: tuple[float, ...], place: int) -> float:
    return values[place] if len(values) > 1 else values[0]
