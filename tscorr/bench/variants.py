"""The ways in which the program evaluates the lobe, and the judge of their errors."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from tscorr import reference
from tscorr.bench.directions import Array, Directions
from tscorr.correction import BlockInputs, Corrector, Rules, SpecularState, Stored, specular_state
from tscorr.materials import Material, builtin_materials

Form = Literal["full", "simplified"]
MAX_ZENITH_DEG = {"full": 85.0, "simplified": 70.0}
LONG = np.longdouble
TALLY_STRIDE = 16
"""every so many rows go into the histograms of a report, as in a scene of a few megapixels"""
LOWEST_SUN_DEG = 2.0
"""elevation of the sun below which nobody flies"""
FAR_FROM_ZERO = 1e6
"""reflectance of the images that errors are measured on: nothing is clipped or uncorrectable there"""


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to evaluate the lobe.

    precision : of `Rules`; or "angles", as `tscorr.brdf` does it, in the float type `real`.
    negligible_reflectance : below it nothing is removed; with `skip`, nor computed where that is provable.
    """

    name: str
    form: Form
    precision: Literal["reference", "exact", "fast", "angles"]
    negligible_reflectance: float = 0.0
    skip: bool = True
    real: type[np.floating[Any]] = np.float64

    @property
    def max_zenith_deg(self) -> float:
        """Up to which incidence and exitance the form is meant."""
        return MAX_ZENITH_DEG[self.form]

    def removed(self, surface: Material, directions: Directions) -> Array:
        """Reflectance factor that the variant takes for the specular part; nan where it does not assess it."""
        if self.precision == "angles":
            return self._from_angles(surface, directions)
        # Stored zeros of a very bright image: what is removed keeps the digits of the arithmetic.
        dtype = np.dtype(np.float32 if self.precision == "fast" else np.float64)
        stored = Stored(dtype=dtype, scale=(1.0,), offset=(FAR_FROM_ZERO,))
        count = directions.incidence.size
        block = BlockInputs(
            image=np.zeros((1, 1, count), dtype),
            material=np.ones((1, count), np.uint8),
            **dict(zip(("sun", "view", "normal"), (v[:, None] for v in directions.vectors()), strict=True)),
        )
        result = self.corrector([surface], stored)(block)
        assert result.removed is not None
        assessed = specular_state(result.flags[0]) != SpecularState.NOT_ASSESSED
        return np.where(assessed, result.removed[0, 0].astype(float), np.nan)

    def corrector(self, materials: list[Material], stored: Stored) -> Corrector:
        """The program's own corrector, for this variant."""
        assert self.precision != "angles"
        rules = Rules(
            form=self.form,
            precision=self.precision,
            negligible_reflectance=self.negligible_reflectance,
            max_zenith_deg=self.max_zenith_deg,
        )
        bands = len(stored.scale)
        return Corrector(
            [(m, m.at(bands=bands), rules) for m in materials], stored, skip=self.skip, tally_stride=TALLY_STRIDE
        )

    def _from_angles(self, surface: Material, directions: Directions) -> Array:
        angles = (angle.astype(self.real) for angle in directions[:3])
        geometry = reference.geometry_from_angles(*angles)
        t1, w, n, k = (np.asarray(getattr(surface, name)[0], self.real) for name in ("t1", "w", "n", "k"))
        f_spec = reference.specular(geometry, w, n, k, simplified=self.form == "simplified")
        return self.real(np.pi) * t1 * f_spec


VARIANTS = tuple(
    variant
    for form in ("full", "simplified")
    for variant in (
        Variant(f"reference {form}", form, "reference"),
        Variant(f"exact {form}", form, "exact"),
        Variant(f"fast {form}", form, "fast"),
        Variant(f"angles {form}", form, "angles"),
        Variant(f"angles float32 {form}", form, "angles", real=np.float32),
    )
) + tuple(
    Variant(f"fast full, negligible {threshold:g}", "full", "fast", negligible_reflectance=threshold)
    for threshold in (5e-5, 5e-4, 5e-3)
)


@dataclass(frozen=True, slots=True)
class Truth:
    """What is to be removed, in longdouble, and what limits the digits of those who try."""

    removed: Array
    """reflectance factor"""
    exponent: Array
    """w alpha; its square is the exponent of the lobe"""
    cos_l: Array


def truth(variant: Variant, surface: Material, directions: Directions) -> Truth:
    """The specular part in longdouble, from the inputs that the variant is given.

    From vectors by atan2(|n x h|, n.h) and |s + v| / 2, whose 64 bits hold enough; so it judges
    `reference.geometry` too. nan where the sun is below `LOWEST_SUN_DEG`.
    """
    real = variant.real if variant.precision == "angles" else np.float64
    t1, w, n, k = (np.asarray(real(getattr(surface, name)[0]), LONG) for name in ("t1", "w", "n", "k"))
    if variant.precision == "angles":
        geometry = reference.geometry_from_angles(*(angle.astype(real).astype(LONG) for angle in directions[:3]))
        plane = np.ones((), LONG)
    else:
        sun, view, normal = (v.astype(LONG) for v in directions.vectors())
        geometry = _geometry(*(v / _length(v) for v in (sun, view, normal)))
        up = sun[2] > np.sin(np.deg2rad(LOWEST_SUN_DEG))
        plane = np.where(up, geometry.cos_i / np.where(up, sun[2], 1), np.nan)
    f_spec = reference.specular(geometry, w, n, k, simplified=variant.form == "simplified")
    removed = np.arctan(LONG(1)) * 4 * t1 * f_spec * plane
    return Truth(removed, w * np.rad2deg(geometry.alpha), geometry.cos_l)


def _geometry(sun: Array, view: Array, normal: Array) -> reference.Geometry:
    half = sun + view
    twice_cos_l = _length(half)
    half = half / twice_cos_l
    tilt = np.arctan2(_length(np.cross(normal, half, axis=0)), (normal * half).sum(axis=0))
    return reference.Geometry((normal * sun).sum(axis=0), (normal * view).sum(axis=0), twice_cos_l / 2, tilt)


def _length(vector: Array) -> Array:
    return np.sqrt((vector * vector).sum(axis=0))


def surfaces() -> list[Material]:
    """Materials to try: those of the paper's table 1, and some that are hard; all for the whole hemisphere."""
    table_1 = [replace(m, zenith_range_deg=(0.0, 90.0)) for m in builtin_materials().values() if m.has_peak]
    hard = [
        ("dielectric", 0.5, 0.06, 1.5, 0.0),
        ("index_near_one", 0.5, 0.06, 1.0001, 1e-6),
        ("metal", 2.0, 0.1, 0.2, 3.4),
        ("high_index", 1.0, 0.05, 4.0, 0.5),
        ("very_rough", 0.1, 0.01, 1.6, 0.1),
        ("very_smooth", 50.0, 5.0, 1.5, 0.25),
        ("mirror", 50.0, 50.0, 1.5, 0.25),
    ]
    return table_1 + [Material(name, t0=(0.02,), t1=(t1,), w=(w,), n=(n,), k=(k,)) for name, t1, w, n, k in hard]
