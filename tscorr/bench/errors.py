"""How far each variant is from the truth, where it is farthest, and how far it may be."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tscorr.bench.directions import Array, Directions, hard_directions
from tscorr.bench.search import climb
from tscorr.bench.variants import Truth, Variant, surfaces, truth
from tscorr.materials import Material

RELEVANT = 1e-6
"""reflectance from which on relative errors are counted"""
FAST_ABSOLUTE, FAST_RELATIVE = 1e-6, 1e-5
ROUNDINGS = 16
"""of f_spec from angles, in eps (1 + (w alpha)^2)"""
VECTOR_ROUNDINGS, TILT_ROUNDINGS = 24, 4
"""the same from unit vectors, and those of the facet tilt in eps / cos theta_l: s + v is short at grazing angles"""
BRIGHTEST = 1.0
"""reflectance up to which absolute errors are counted; brighter glare leaves nothing to correct"""
BOUNDS = {
    "fast": f"max({FAST_ABSOLUTE:g}, {FAST_RELATIVE:g} B)",
    "exact": f"eps ({VECTOR_ROUNDINGS} (1 + x^2) + {TILT_ROUNDINGS} w x / cos theta_l) B, x = w alpha, w in 1/rad",
    "reference": f"eps ({VECTOR_ROUNDINGS} (1 + x^2) + {TILT_ROUNDINGS} w x) / cos theta_l B, x = w alpha, w in 1/rad",
    "angles": f"{ROUNDINGS} eps (1 + x^2) B, x = w alpha",
}
"""what is promised of each precision: the largest error of the reflectance B that is removed"""


@dataclass(frozen=True, slots=True)
class Worst:
    """The input at which a variant's error is largest against its bound."""

    surface: Material
    directions: Directions
    """one"""
    error: float
    removed: float
    """reflectance factor by the truth"""
    excess: float
    """error / bound"""


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of a variant over all that was tried; those of the reflectance factor that is removed."""

    tried: int
    """inputs of which relative errors are counted, without those of the climb"""
    max_relative: float
    """of values of at least `RELEVANT`, and of at least the threshold of the variant"""
    rms_relative: float
    max_absolute: float
    """of values of at most `BRIGHTEST`"""
    worst: Worst


def promise(variant: Variant) -> str:
    """The bound in words."""
    threshold = variant.negligible_reflectance
    return BOUNDS[variant.precision] + (f", or B below {threshold:g}" if threshold else "")


def bound(variant: Variant, surface: Material, true: Truth) -> Array:
    """The error that is promised not to be exceeded, for each input; reflectance factor."""
    if variant.precision == "fast":
        left = np.where(true.removed < variant.negligible_reflectance * 1.0001, variant.negligible_reflectance, 0)
        return np.maximum(FAST_ABSOLUTE, FAST_RELATIVE * true.removed) + left
    info = np.finfo(variant.real)
    if variant.precision == "angles":
        roundings = ROUNDINGS * (1 + true.exponent**2)
    else:
        of_lobe = VECTOR_ROUNDINGS * (1 + true.exponent**2)
        of_lobe = of_lobe / true.cos_l if variant.precision == "reference" else of_lobe  # it goes through degrees
        roundings = of_lobe + TILT_ROUNDINGS * np.rad2deg(surface.w[0]) * true.exponent / true.cos_l
    underflow = 1e5 * info.tiny
    return info.eps * roundings * true.removed + underflow


def measure(variant: Variant, rng: np.random.Generator, *, count: int, rounds: int) -> Errors:
    """Errors at `count` directions of each hard kind for each material, and on a climb of `rounds` from the worst."""
    per_surface = [_measure(variant, surface, rng, count, rounds) for surface in surfaces()]
    tried = sum(errors.tried for errors in per_surface)
    return Errors(
        tried=tried,
        max_relative=max(errors.max_relative for errors in per_surface),
        rms_relative=float(np.sqrt(sum(errors.rms_relative**2 * errors.tried for errors in per_surface) / tried)),
        max_absolute=max(errors.max_absolute for errors in per_surface),
        worst=max((errors.worst for errors in per_surface), key=lambda worst: worst.excess),
    )


def _measure(variant: Variant, surface: Material, rng: np.random.Generator, count: int, rounds: int) -> Errors:
    """`measure` for one material."""

    def excess(directions: Directions) -> Array:
        return judge(variant, surface, directions)[2]

    limit = variant.max_zenith_deg
    start = hard_directions(rng, count, limit)
    error, true, heights = judge(variant, surface, start)
    top, heights = climb(excess, start, heights, rng, max_zenith_deg=limit, rounds=rounds)
    top_error, top_true, _ = judge(variant, surface, top)
    relative, absolute = _counted(variant, error, true.removed)
    top_relative, top_absolute = _counted(variant, top_error, top_true.removed)
    first = int(heights.argmax())
    return Errors(
        tried=relative.size,
        max_relative=max(relative.max(initial=0), top_relative.max(initial=0)),
        rms_relative=float(np.sqrt((relative**2).mean())) if relative.size else 0.0,
        max_absolute=max(absolute.max(initial=0), top_absolute.max(initial=0)),
        worst=Worst(
            surface,
            top.take(np.array([first])),
            float(top_error[first]),
            float(top_true.removed[first]),
            float(heights[first]),
        ),
    )


def _counted(variant: Variant, error: Array, removed: Array) -> tuple[Array, Array]:
    """The relative and the absolute errors that are counted."""
    least = max(RELEVANT, variant.negligible_reflectance * 1.0001)
    assessed = ~np.isnan(error)
    relevant, usual = assessed & (removed >= least), assessed & (removed <= BRIGHTEST)
    return (error[relevant] / removed[relevant]).astype(float), error[usual].astype(float)


def judge(variant: Variant, surface: Material, directions: Directions) -> tuple[Array, Truth, Array]:
    """Error, truth and error / bound at each of the directions; nan where the variant assesses nothing."""
    true = truth(variant, surface, directions)
    error = np.abs(variant.removed(surface, directions) - true.removed)
    return error, true, (error / bound(variant, surface, true)).astype(float)


def repeatable(worst: Worst) -> dict[str, Any]:
    """The worst input so that anyone can compute it again: material, angles and vectors, all digits."""
    sun, view, normal = worst.directions.vectors()
    return {
        "material": {"name": worst.surface.name}
        | {name: getattr(worst.surface, name)[0] for name in ("t1", "w", "n", "k")},
        **{f"{name}_deg": float(angle[0]) for name, angle in worst.directions._asdict().items()},
        "sun": sun[:, 0].tolist(),
        "view": view[:, 0].tolist(),
        "normal": normal[:, 0].tolist(),
        "removed": worst.removed,
        "error": worst.error,
        "error_over_bound": worst.excess,
    }
