"""Width of the peak in azimuth, and across the principal plane, about the facet normal.

With S = (theta_i + theta_r) / 2, D = (theta_i - theta_r) / 2, psi = 180 - phi and u = sin^2(psi/2), the
lobe on the ring of one incidence and one exitance depends on u alone:

    tan^2 alpha   = tan^2 D + K u            K = sin theta_i sin theta_r / (cos S cos D)^2
    cos^2 theta_l = cos^2 S + sin theta_i sin theta_r u

so the half maximum is one root in u, and the full width at half maximum is 2 psi = 4 asin(sqrt(u)).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr import reference
from tscorr.width.lobe import LN2, Array, Lobe, LobeShape, bisect, is_simplified, lobe_shape


def azimuthal_width(
    m: Lobe,
    incidence_deg: ArrayLike,
    exitance_deg: ArrayLike | None = None,
    form: str = "full",
    lobe: bool = True,
    *,
    wavelength_um: float | None = None,
) -> Array:
    """Full width at half maximum of the peak in degrees of azimuth, in (0, 360].

    m      : a material, or the name of one of the built-in library.
    incidence_deg, exitance_deg : from the facet normal; shapes broadcast; exitance = incidence by default.
    form   : "full", or "simplified" without the geometric attenuation factor.
    lobe   : True for f_spec as a whole; False for its exponential alone, in closed form.
    nan where the lobe stays above half of its value at phi = 180 all around, where an angle is not in
    (0, 90), and for a material without a peak: `why_no_width` says which. A very broad lobe of an index
    with a normal reflectance above 1/3 might cross the half more than once; then one crossing is found.
    Error: relative 1e-14 (1 + (w D)^2), D half the difference of the angles; more where a width nears 360.

    >>> import tscorr
    >>> tscorr.azimuthal_width("roof_tile", [30, 50, 65]).round(1)
    array([185.6,  78.7,  42.3])
    """
    shape, simplified = lobe_shape(m, wavelength_um), is_simplified(form)
    incidence, exitance = _pair(incidence_deg, exitance_deg)
    u = np.full(incidence.shape, np.nan)
    seen = (incidence > 0) & (incidence < 90) & (exitance > 0) & (exitance < 90) & shape.has_peak
    ring = _ring(incidence[seen], exitance[seen])
    u[seen] = _half_of_lobe(ring, shape, simplified) if lobe else _half_of_exponential(ring, shape)
    return np.rad2deg(4 * np.arcsin(np.sqrt(u)))[()]


def azimuthal_arc(
    m: Lobe,
    incidence_deg: ArrayLike,
    exitance_deg: ArrayLike | None = None,
    form: str = "full",
    lobe: bool = True,
    *,
    wavelength_um: float | None = None,
) -> Array:
    """`azimuthal_width` as an arc on the sphere of directions: times sin(exitance). [deg]"""
    _, exitance = _pair(incidence_deg, exitance_deg)
    width = azimuthal_width(m, incidence_deg, exitance_deg, form, lobe, wavelength_um=wavelength_um)
    return width * np.sin(np.deg2rad(exitance))


def width_across(m: Lobe, incidence_deg: ArrayLike, *, wavelength_um: float | None = None) -> Array:
    """Full width at half maximum of the exponential across the principal plane. [deg]

    Along the great circle through the mirror direction, at a right angle to the plane: with half of it
    beta / 2 and t = tan(beta/2), tan^2(half_tilt) cos^2 theta = t^2 + sin^2 theta t^4. About 4 half_tilt
    cos theta (Meister et al., Appl. Opt. 40, 6072, 2001). nan where the horizon comes first.
    """
    shape = lobe_shape(m, wavelength_um)
    incidence = np.asarray(incidence_deg, dtype=float)
    exists = (incidence >= 0) & (incidence < 90) & shape.has_peak & (shape.half_tilt_deg < 90)
    theta = np.deg2rad(np.where(exists, incidence, np.nan))
    goal = (np.tan(np.deg2rad(shape.half_tilt_deg)) * np.cos(theta)) ** 2
    t2 = 2 * goal / (1 + np.sqrt(1 + 4 * np.sin(theta) ** 2 * goal))
    above_horizon = t2 < 1  # beta < 90
    return np.rad2deg(4 * np.arctan(np.sqrt(np.where(above_horizon, t2, np.nan))))[()]


def why_no_width(
    m: Lobe,
    incidence_deg: float,
    exitance_deg: float | None = None,
    form: str = "full",
    lobe: bool = True,
    *,
    wavelength_um: float | None = None,
) -> str:
    """In words, why `azimuthal_width` is nan there; empty where it is not."""
    shape, simplified = lobe_shape(m, wavelength_um), is_simplified(form)
    exitance = incidence_deg if exitance_deg is None else exitance_deg
    if not shape.has_peak:
        return "the material has no specular part"
    if not (0 <= incidence_deg < 90 and 0 <= exitance < 90):
        return "the angles of incidence and exitance must be from 0 to below 90 degrees"
    if 0 in (incidence_deg, exitance):
        return "along the normal there is no azimuth"
    ring = _ring(np.asarray(incidence_deg, dtype=float), np.asarray(exitance, dtype=float))
    around = np.ones(())
    fall = _log_lobe(ring, around, shape, simplified) if lobe else _log_exponential(ring, around, shape)
    if fall <= -LN2:
        return ""
    left = 100 * float(np.exp(fall))
    return f"too broad: at relative azimuth 0 still {left:.0f} % of the value at 180, so never below half"


def smallest_incidence(m: Lobe, form: str = "full", *, wavelength_um: float | None = None) -> float:
    """Incidence, = exitance, from which on the whole lobe has an azimuthal width; 360 degrees there. [deg]

    nan where it never has: no specular part, or as broad as the hemisphere.
    """
    shape, simplified = lobe_shape(m, wavelength_um), is_simplified(form)

    def excess(theta: Array) -> Array:
        return _log_lobe(_ring(theta, theta), np.ones_like(theta), shape, simplified) + LN2

    grazing = np.nextafter(90.0, 0.0)
    if not shape.has_peak or excess(np.asarray(grazing)) >= 0:
        return float("nan")
    return float(bisect(excess, np.zeros(()), np.asarray(grazing)))


class WidthTable:
    """`azimuthal_width` of the whole lobe at exitance = incidence, for many pixels.

    Linear between 1025 nodes, crowded towards both ends, on the curve of a constant facet tilt,
    tan(half_tilt) = tan(theta) sin(width/4). So the error stays below MAX_ERROR_DEG for lobes of
    w >= 0.02 per degree, however narrow; for lobes twice as broad, which are no peaks any more, below 0.1.
    Between the edge, `smallest_incidence`, and 90 degrees there is a width; elsewhere nan.
    """

    MAX_ERROR_DEG = 1e-3
    INTERVALS = 1024

    def __init__(self, m: Lobe, form: str = "full", *, wavelength_um: float | None = None) -> None:
        shape = lobe_shape(m, wavelength_um)
        self.edge_deg = smallest_incidence(shape, form)
        """incidence below which there is no width; nan where there is none at all"""
        if np.isnan(self.edge_deg):
            self._nodes, self._widths = np.array([0.0]), np.array([np.nan])
            return
        quarter_width = np.pi / 4 * (1 + np.cos(np.linspace(0, np.pi, self.INTERVALS + 1)[1:-1]))
        inner = np.rad2deg(np.arctan(np.tan(np.deg2rad(self.edge_deg)) / np.sin(quarter_width)))
        self._nodes = np.concatenate([[self.edge_deg], inner, [90.0]])
        self._widths = np.concatenate([[360.0], azimuthal_width(shape, inner, form=form), [0.0]])

    def at(self, incidence_deg: ArrayLike) -> NDArray[np.float32]:
        """Width at angles of incidence of any shape, float32 [deg]; nan gives nan."""
        incidence = np.asarray(incidence_deg)
        width = np.interp(incidence, self._nodes, self._widths, left=np.nan, right=np.nan)
        return np.asarray(np.where(incidence < 90, width, np.nan), dtype=np.float32)


@lru_cache(maxsize=256)
def width_table(shape: LobeShape, form: str = "full") -> WidthTable:
    """The table of a lobe, remembered: a batch asks for the same materials scene by scene."""
    return WidthTable(shape, form)


class _Ring(NamedTuple):
    """What the directions of one incidence and one exitance have in common; see the head of the file."""

    cos_i: Array
    cos_r: Array
    d: Array
    """half the difference of the angles [rad], positive"""
    cos_s: Array
    sines: Array
    """sin theta_i sin theta_r"""

    @property
    def stretch(self) -> Array:
        """K, d(tan^2 alpha) / du"""
        return self.sines / (self.cos_s * np.cos(self.d)) ** 2

    def alpha(self, u: Array) -> Array:
        """Facet tilt [rad]."""
        return np.arctan(np.sqrt(np.tan(self.d) ** 2 + self.stretch * u))

    def cos_l(self, u: Array) -> Array:
        """Cosine of the local angle."""
        return np.sqrt(self.cos_s**2 + self.sines * u)


def _ring(incidence_deg: Array, exitance_deg: Array) -> _Ring:
    elevation_i, elevation_r = np.deg2rad(90 - incidence_deg), np.deg2rad(90 - exitance_deg)
    return _Ring(
        cos_i=np.sin(elevation_i),
        cos_r=np.sin(elevation_r),
        d=np.deg2rad(np.abs(incidence_deg - exitance_deg) / 2),
        cos_s=np.sin((elevation_i + elevation_r) / 2),
        sines=np.sin(np.deg2rad(incidence_deg)) * np.sin(np.deg2rad(exitance_deg)),
    )


def _pair(incidence_deg: ArrayLike, exitance_deg: ArrayLike | None) -> tuple[Array, Array]:
    exitance = incidence_deg if exitance_deg is None else exitance_deg
    incidence, exitance = np.broadcast_arrays(
        np.asarray(incidence_deg, dtype=float), np.asarray(exitance, dtype=float)
    )
    return incidence, exitance


def _log_exponential(ring: _Ring, u: Array, shape: LobeShape) -> Array:
    """Logarithm of the exponential, less its value at u = 0."""
    return -(shape.w_rad**2) * (ring.alpha(u) ** 2 - ring.d**2)


def _log_lobe(ring: _Ring, u: Array, shape: LobeShape, simplified: bool) -> Array:
    """Logarithm of f_spec, less its value at u = 0 (phi = 180)."""
    cos_l = ring.cos_l(u)
    factor = shape.fresnel(cos_l) / shape.fresnel(ring.cos_s)
    if not simplified:
        factor = factor * reference.attenuation(ring.cos_i, ring.cos_r, cos_l)
        factor = factor / reference.attenuation(ring.cos_i, ring.cos_r, ring.cos_s)
    return np.log(factor) + _log_exponential(ring, u, shape)


def _log_lobe_slope(ring: _Ring, u: Array, shape: LobeShape, simplified: bool) -> Array:
    """d(`_log_lobe`) / du."""
    alpha, cos_l = ring.alpha(u), ring.cos_l(u)
    facets = -(shape.w_rad**2) * ring.stretch * np.cos(alpha) ** 2 / np.sinc(alpha / np.pi) * np.cos(alpha)
    by_cos_l = _fresnel_slope(cos_l, shape) / shape.fresnel(cos_l)
    if not simplified:
        masked = reference.attenuation(ring.cos_i, ring.cos_r, cos_l) < 1
        by_cos_l = by_cos_l - np.where(masked, 2 / cos_l, 0)
    return facets + by_cos_l * ring.sines / (2 * cos_l)


def _fresnel_slope(cos_l: Array, shape: LobeShape) -> Array:
    """Derivative of `reference.fresnel` by cos_l.

    Re(conj(r_s) r_s' + conj(r_p) r_p') with E = N^2 - 1, r_s' = 2 E / (q (c + q)^2) and
    r_p' = 2 N^2 E / (q (N^2 c + q)^2).
    """
    n2 = (shape.n - 1j * shape.k) ** 2
    e = n2 - 1
    q = np.sqrt(e + cos_l * cos_l)
    r_s = (cos_l - q) / (cos_l + q)
    r_p = (n2 * cos_l - q) / (n2 * cos_l + q)
    slope_s = 2 * e / (q * (cos_l + q) ** 2)
    slope_p = 2 * n2 * e / (q * (n2 * cos_l + q) ** 2)
    return (np.conj(r_s) * slope_s + np.conj(r_p) * slope_p).real


def _half_of_exponential(ring: _Ring, shape: LobeShape) -> Array:
    """The u at which the exponential is half of its value at u = 0; nan where that is not in (0, 1].

    The tilt there is a with a^2 = d^2 + half_tilt^2, and tan^2 a - tan^2 d is written as a product.
    """
    half_tilt = np.deg2rad(shape.half_tilt_deg)
    a = np.hypot(ring.d, half_tilt)
    rise = half_tilt**2 / (a + ring.d)  # a - d
    with np.errstate(over="ignore", divide="ignore"):  # along the normal u is infinite: no half there
        u = np.sin(rise) * np.sin(a + ring.d) * ring.cos_s**2 / (np.cos(a) ** 2 * ring.sines)
    return np.where((a < np.pi / 2) & (u <= 1), u, np.nan)


def _half_of_lobe(ring: _Ring, shape: LobeShape, simplified: bool) -> Array:
    """The u at which f_spec is half of its value at u = 0; nan where that is not in (0, 1].

    Newton's method from the exponential's half, held in a bracket that shrinks with every step.
    """
    exists = _log_lobe(ring, np.ones_like(ring.d), shape, simplified) <= -LN2
    inner = _Ring(*(part[exists] for part in ring))
    start = _half_of_exponential(inner, shape)
    u = np.where(np.isnan(start), 1, start)
    low, high = np.zeros_like(u), np.ones_like(u)
    tolerance = 1e-14 * (1 + (shape.w_rad * inner.d) ** 2)  # the logarithms round by as much
    for _ in range(60):
        excess = _log_lobe(inner, u, shape, simplified) + LN2
        above = excess > 0
        low, high = np.where(above, u, low), np.where(above, high, u)
        newton = u - excess / _log_lobe_slope(inner, u, shape, simplified)
        inside = (newton >= low) & (newton <= high)
        previous, u = u, np.where(inside, newton, (low + high) / 2)
        if np.all(np.abs(u - previous) <= tolerance * u):
            break
    root = np.full(ring.d.shape, np.nan)
    root[exists] = u
    return root
