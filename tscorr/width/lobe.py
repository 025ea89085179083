"""The lobe of one material at one wavelength, and the searches that measure it."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.errors import ConfigError, MaterialError
from tscorr.materials import ALLOWED_WAVELENGTHS, BandParameters, Material, is_wavelength, material

Array = NDArray[np.float64]

LN2 = math.log(2)
GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class LobeShape:
    """What a width depends on: w [1/degree] and the refractive index n - ik, at one wavelength."""

    w: float
    n: float
    k: float
    t1: float = 1.0
    """strength [sr^-1]: of no influence on a width, except that without it there is none"""

    @property
    def has_peak(self) -> bool:
        """Whether there is a specular part at all."""
        return self.t1 > 0 and not (self.n == 1 and self.k == 0)

    @property
    def half_tilt_deg(self) -> float:
        """Facet tilt at which the exponential has fallen to half: sqrt(ln 2) / w. [deg]"""
        return math.sqrt(LN2) / self.w

    @property
    def w_rad(self) -> float:
        """The parameter w in 1/radian."""
        return math.degrees(self.w)

    def fresnel(self, cos_l: Array) -> Array:
        """Fresnel reflectance of a facet."""
        return reference.fresnel(cos_l, np.asarray(self.n), np.asarray(self.k))


Lobe = Material | LobeShape | str
"""whose width is asked for: a material, the name of a built-in one, or a lobe by itself"""


def lobe_shape(m: Lobe, wavelength_um: float | None = None) -> LobeShape:
    """The lobe of a material at a wavelength [um], by default the middle one of its own.

    A LobeShape is handed through. Raises MaterialError where no built-in material has the name, or where the
    material does not cover the wavelength.
    """
    if wavelength_um is not None and not is_wavelength(wavelength_um):
        raise MaterialError(f"wavelength_um = {wavelength_um!r}; allowed is {ALLOWED_WAVELENGTHS}")
    if isinstance(m, LobeShape):
        return m
    if not isinstance(m, Material):
        m = material(m)
    own = m.wavelength_um
    if wavelength_um is None and own:
        wavelength_um = own[len(own) // 2]
    (shape,) = lobe_shapes(m.at(None if wavelength_um is None else [wavelength_um]))
    return shape


def lobe_shapes(parameters: BandParameters) -> tuple[LobeShape, ...]:
    """The lobe in each band."""
    columns = (parameters.w, parameters.n, parameters.k, parameters.t1)
    return tuple(
        LobeShape(w=float(w), n=float(n), k=float(k), t1=float(t1)) for w, n, k, t1 in zip(*columns, strict=True)
    )


def typical_lobe(parameters: BandParameters) -> LobeShape:
    """The lobe that stands for a material in widths and plots: that of the middle one of the bands that have it."""
    shapes = lobe_shapes(parameters)
    strong = [shape for shape in shapes if shape.t1 > 0] or shapes
    return strong[len(strong) // 2]


def is_simplified(form: str) -> bool:
    """Whether `form` drops the geometric attenuation factor; ConfigError where it is no form."""
    if form not in {"full", "simplified"}:
        raise ConfigError(f"form = {form!r}; allowed are 'full' and 'simplified'")
    return form == "simplified"


def bisect(function: Callable[[Array], Array], above: Array, below: Array, tolerance: float = 0.0) -> Array:
    """Roots of a function, positive at `above` and negative at `below`; by default to the last bits."""
    for _ in range(64):
        middle = (above + below) / 2
        positive = function(middle) > 0
        above, below = np.where(positive, middle, above), np.where(positive, below, middle)
        if np.all(np.abs(above - below) <= tolerance):
            break
    return (above + below) / 2


def highest(function: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Where a function with one maximum in [low, high] has it, by golden section.

    Good to about 1e-6 of the width of the maximum: flatter than rounding it cannot be seen.
    """
    for _ in range(50):
        left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        rises = function(left) < function(right)
        low, high = np.where(rises, left, low), np.where(rises, high, right)
    return (low + high) / 2
