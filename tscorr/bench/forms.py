"""How far the simplified form is from the full one: section 5 of the paper, for every relative azimuth."""

from typing import Any

import numpy as np

from tscorr import reference
from tscorr.materials import Material, builtin_materials

ZENITH_LIMITS_DEG = (45, 50, 60, 65, 70, 75)
AZIMUTH_RANGES_DEG = {"180": 180.0, "90 to 180": 90.0, "0 to 180": 0.0}


def simplified_errors(step_deg: float = 1.0) -> list[dict[str, Any]]:
    """Largest difference of the forms by material, limit of both zenith angles and range of relative azimuth.

    Relative to f_r of the full form, and absolute in reflectance factor, on a grid of `step_deg` (in azimuth 5
    times as wide).
    """
    zenith = np.arange(0, ZENITH_LIMITS_DEG[-1] + step_deg / 2, step_deg)
    phi = np.arange(0, 180 + step_deg, 5 * step_deg)
    incidence, exitance, azimuth = (
        angle.ravel() for angle in np.meshgrid(zenith, zenith, np.union1d(phi, [90.0, 180.0]), indexing="ij")
    )
    once = incidence <= exitance  # reciprocity
    incidence, exitance, azimuth = incidence[once], exitance[once], azimuth[once]
    geometry = reference.geometry_from_angles(incidence, exitance, azimuth)
    rows = []
    for surface in (m for m in builtin_materials().values() if m.has_peak):
        full, simplified = (f_r(surface, geometry, simplified=dropped) for dropped in (False, True))
        relative, absolute = simplified / full - 1, np.pi * (simplified - full)
        for limit in ZENITH_LIMITS_DEG:
            for words, least in AZIMUTH_RANGES_DEG.items():
                inside = (exitance <= limit) & (azimuth >= least)
                place = np.flatnonzero(inside)[relative[inside].argmax()]
                rows.append(
                    {
                        "material": surface.name,
                        "max_zenith_deg": limit,
                        "relative_azimuth_deg": words,
                        "max_relative_difference": float(relative[place]),
                        "at": [float(angle[place]) for angle in (incidence, exitance, azimuth)],
                        "max_absolute_reflectance_difference": float(absolute[inside].max()),
                    }
                )
    return rows


def f_r(surface: Material, geometry: reference.Geometry, *, simplified: bool = False) -> Any:
    """f_r of a material of one wavelength. [sr^-1]"""
    t0, t1, w, n, k = (np.asarray(getattr(surface, name)[0]) for name in ("t0", "t1", "w", "n", "k"))
    return reference.brdf(reference.specular(geometry, w, n, k, simplified=simplified), t0, t1)
