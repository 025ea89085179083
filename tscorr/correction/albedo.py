"""How much light a surface reflects in all: directional-hemispherical reflectance.

The integral of the lobe over the hemisphere is taken over facets instead of directions. A facet of tilt alpha
and azimuth psi mirrors the source into the viewer, and d(omega_r) = 4 cos(theta_l) d(omega_facet), so

    integral of f_spec cos theta_r d(omega_r) = 4 / cos theta_i  integral F G P cos theta_l d(omega_facet)

over the facets that mirror to above the horizon. On a ring of one tilt, F, G and the horizon depend on
x = cos theta_l alone, which is linear in cos psi. So the kinks of the integrand are known in closed form, and
Gauss-Legendre quadrature between them converges fast.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr import reference
from tscorr.errors import ConfigError
from tscorr.materials import Material, material

Array = NDArray[Any]

RING_NODES, TILT_NODES = 20, 24
"""nodes between two kinks: on a ring of facets of one tilt, and over the tilts"""
NO_SWING = 1e-12
"""a quantity that swings by less over a ring has no kink on it"""
REACH = 6.5
"""w alpha beyond which the exponential, below 5e-19, is left out"""


def albedo(
    surface: Material | str,
    incidence_deg: ArrayLike,
    form: Literal["full", "simplified"] = "full",
    wavelength_um: float | None = None,
) -> Array:
    """Directional-hemispherical reflectance of a material: pi t0 + t1 times the integral of the lobe. [1]

    surface       : a `Material`, or the name of one of the built-in library.
    incidence_deg : from the surface normal, 0 to below 90; nan beyond. By reciprocity also the reflectance,
                    towards that exitance, of light that comes evenly from the whole sky.
    Raises ConfigError for the simplified form, whose lobe grows like 1 / cos theta at grazing angles:
    at 89 degrees four of the five surfaces of the paper would reflect more light than they receive.

    >>> float(round(albedo("roof_tile", 50)[()], 4))
    0.1223
    """
    if form != "full":
        raise ConfigError(
            f"albedo of the form {form!r}; allowed is 'full': without the geometric attenuation factor the lobe "
            f"grows like 1/cos at zenith angles beyond 70 degrees, which an albedo cannot leave out "
            f"(Meister et al. 2000, end of section 5)"
        )
    known = material(surface) if isinstance(surface, str) else surface
    parameters = known.at(None if wavelength_um is None else [wavelength_um])
    t0, t1, w, n, k = (float(getattr(parameters, name)[0]) for name in ("t0", "t1", "w", "n", "k"))
    return np.pi * t0 + t1 * specular_albedo(incidence_deg, w=w, n=n, k=k)


def specular_albedo(incidence_deg: ArrayLike, *, w: float, n: float, k: float) -> Array:
    """Integral of f_spec cos theta_r over the hemisphere, of the full form: the albedo of the lobe for t1 = 1. [1]

    incidence_deg : any shape, in [0, 90); nan elsewhere. w in 1/degree.
    Relative error below 1e-9 up to 45 degrees, 3e-6 up to 85, 2e-5 up to 89.9 (against 100 x 120 nodes).
    """
    incidence = np.asarray(incidence_deg, dtype=float)
    result = np.full(incidence.shape, np.nan)
    for place in np.ndindex(incidence.shape):
        if 0 <= incidence[place] < 90:
            result[place] = _lobe_integral(float(incidence[place]), w, n, k)
    return result


def _lobe_integral(incidence_deg: float, w: float, n: float, k: float) -> float:
    """`specular_albedo` of one angle."""
    cos_i, sin_i = np.sin(np.deg2rad(90 - incidence_deg)), np.sin(np.deg2rad(incidence_deg))
    alpha, tilt_weight = _pieces(_tilt_kinks(incidence_deg, w)[:, None], TILT_NODES)
    alpha, tilt_weight = alpha.ravel(), tilt_weight.ravel()
    cos_a, sin_a = np.cos(alpha), np.sin(alpha)
    middle, swing = cos_a * cos_i, sin_a * sin_i  # x = middle + swing cos psi
    psi, ring_weight = _pieces(_ring_kinks(cos_i, cos_a, middle, swing), RING_NODES)
    x = middle + swing * np.cos(psi)
    cos_r = 2 * x * cos_a - cos_i
    seen = (x > 0) & (cos_r > 0)
    x, cos_r = np.where(seen, x, 1), np.where(seen, cos_r, 0)
    value = reference.fresnel(x, np.asarray(n), np.asarray(k)) * x * reference.attenuation(cos_i, cos_r, x)
    ring = 2 * (ring_weight * value).sum(axis=(0, 1))  # psi and -psi
    return float(4 / cos_i * (tilt_weight * sin_a * reference.facet_distribution(alpha, np.asarray(w)) * ring).sum())


def _tilt_kinks(incidence_deg: float, w: float) -> Array:
    """Facet tilts between which the integral over a ring is smooth, ascending. [rad]

    Where the horizon or G < 1 enters a ring, which happens in the principal plane: 3 max +- min = 180 for the
    angles of incidence and exitance. Multiples of 1/w resolve the exponential.
    """
    steepest = min((90 + incidence_deg) / 2, REACH / w)
    kinks = [
        0,
        30 - incidence_deg / 3,
        30 + incidence_deg / 3,
        90 - incidence_deg,
        (90 - incidence_deg) / 2,
        steepest,
        *(np.arange(1, REACH) / w),
    ]
    return np.deg2rad(np.unique(np.clip(kinks, 0, steepest)))


def _ring_kinks(cos_i: float, cos_a: Array, middle: Array, swing: Array) -> Array:
    """Azimuths (5, rings) in [0, pi] between which F, G and the horizon are smooth, ascending. [rad]"""
    horizon = cos_i / (2 * cos_a)
    shadowing = 2 * cos_a * cos_i
    curvature = 4 * cos_a**2 - 1
    masking = np.where(curvature > 0, shadowing / np.where(curvature > 0, curvature, 1), 2.0)
    x = np.stack([horizon, shadowing, masking])
    cosine = np.clip((x - middle) / np.where(swing > NO_SWING, swing, 1), -1, 1)
    ends = np.zeros((1, *cos_a.shape))
    return np.sort(np.concatenate([ends, np.arccos(cosine), ends + np.pi]), axis=0)


def _pieces(kinks: Array, nodes: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights (nodes, pieces, ...) between ascending kinks (pieces + 1, ...)."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    shape = (nodes,) + (1,) * kinks.ndim
    half = np.diff(kinks, axis=0) / 2
    return kinks[:-1] + half * (1 + x.reshape(shape)), half * weight.reshape(shape)
