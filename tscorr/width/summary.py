"""Numbers about the peak for reports: rows of widths, headings to fly, roofs that dazzle."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr import reference
from tscorr.angles import relative_azimuth, unit_vector, zenith_azimuth
from tscorr.errors import InputError
from tscorr.materials import BandParameters
from tscorr.width.azimuthal import azimuthal_arc, azimuthal_width
from tscorr.width.lobe import Array, Lobe, LobeShape, is_simplified, lobe_shape
from tscorr.width.zenithal import peak_exitance, zenithal_width

ROW_INCIDENCES_DEG = tuple(range(10, 75, 5))
HEADINGS_DEG = tuple(range(0, 360, 10))
SCAN_STEP_DEG = 0.25


def width_rows(
    m: Lobe,
    incidences_deg: Sequence[float] = ROW_INCIDENCES_DEG,
    form: str = "full",
    *,
    wavelength_um: float | None = None,
) -> list[dict[str, float | None]]:
    """Widths against incidence, ready for JSON: None where there is none. [deg]

    Azimuthal width and arc are of the whole lobe at exitance = incidence, the zenithal width of the
    exponential alone, cut at the horizon.
    """
    rows = _rows(lobe_shape(m, wavelength_um), tuple(incidences_deg), form)
    return [dict(row) for row in rows]


@lru_cache(maxsize=256)  # a batch asks for the same materials scene by scene
def _rows(shape: LobeShape, incidences_deg: tuple[float, ...], form: str) -> list[dict[str, float | None]]:
    incidence = np.asarray(incidences_deg, dtype=float)
    columns = {
        "incidence_deg": incidence,
        "azimuthal_width_deg": azimuthal_width(shape, incidence, form=form),
        "azimuthal_arc_deg": azimuthal_arc(shape, incidence, form=form),
        "zenithal_width_deg": zenithal_width(shape, incidence, form),
        "peak_exitance_deg": peak_exitance(shape, incidence, form),
    }
    return [{key: _or_none(values[row]) for key, values in columns.items()} for row in range(len(incidence))]


def flank_slope(m: Lobe, *, wavelength_um: float | None = None) -> float:
    """How fast the exponential falls where it is half of its peak: relative change per degree of facet tilt.

    |d ln exp(-(w alpha)^2) / d alpha| = 2 w^2 alpha at alpha = sqrt(ln 2) / w. A surface normal that errs by a
    degree in the principal plane changes the tilt by a degree; a direction of view or sun, by half of it.
    """
    return 2 * math.sqrt(math.log(2)) * lobe_shape(m, wavelength_um).w


class Roof(NamedTuple):
    """Orientation of a plane: slope from the horizontal, and the azimuth it faces."""

    slope_deg: NDArray[Any]
    aspect_deg: NDArray[Any]


def critical_roof(sun: ArrayLike, view: ArrayLike) -> Roof:
    """The roof that mirrors the sun into the camera: its normal is the half vector.

    sun, view : unit vectors (3, ...) from the surface, east north up. The aspect is clockwise from the
    north of these vectors, in [0, 360).
    """
    slope, aspect = zenith_azimuth(np.asarray(sun, dtype=float) + np.asarray(view, dtype=float))
    return Roof(slope_deg=slope, aspect_deg=aspect)


def heading_table(
    solar_zenith_deg: float,
    solar_azimuth_deg: float,
    half_field_of_view_deg: float,
    materials: Mapping[str, BandParameters],
    form: str = "full",
    *,
    direct_fraction: ArrayLike = 1.0,
) -> list[dict[str, Any]]:
    """How much glare a line scanner sees over a horizontal surface, for headings every 10 degrees.

    direct_fraction : of the irradiance, scalar or one a band.
    Rows {"heading_deg", "min_facet_tilt_deg", "max_specular_share": {material: share}}, the extremes over
    the scan line, which lies across the heading. The share, specular / (specular + diffuse), is the largest
    over the bands. The line is sampled every 0.25 degrees and where it comes nearest to the mirror
    direction: the least tilt is at most 0.1 too large.
    Raises InputError where the sun is not above the horizon or the field of view not in (0, 90).
    """
    simplified = is_simplified(form)
    if not 0 <= solar_zenith_deg < 90:
        raise InputError(f"solar zenith = {solar_zenith_deg} degrees; allowed is from 0 to below 90")
    if not 0 < half_field_of_view_deg < 90:
        raise InputError(f"half field of view = {half_field_of_view_deg} degrees; allowed is 0 to 90")
    headings = np.array(HEADINGS_DEG, dtype=float)[:, np.newaxis]
    scan_angle = _scan_angles(solar_zenith_deg, solar_azimuth_deg, half_field_of_view_deg, headings)
    view_azimuth = headings + np.where(scan_angle < 0, -90.0, 90.0)
    geometry = reference.geometry_from_angles(
        np.full_like(scan_angle, solar_zenith_deg),
        np.abs(scan_angle),
        relative_azimuth(view_azimuth, solar_azimuth_deg),
    )
    least_tilt = np.rad2deg(geometry.alpha.min(axis=1)).tolist()
    shares = {
        name: _max_share(geometry, bands, direct_fraction, simplified=simplified).tolist()
        for name, bands in materials.items()
    }
    return [
        {
            "heading_deg": heading,
            "min_facet_tilt_deg": least_tilt[place],
            "max_specular_share": {name: share[place] for name, share in shares.items()},
        }
        for place, heading in enumerate(HEADINGS_DEG)
    ]


def _scan_angles(
    solar_zenith_deg: float, solar_azimuth_deg: float, half_field_of_view_deg: float, headings_deg: Array
) -> Array:
    """View zeniths along scan lines, negative to the left of the heading: (headings, n) of (headings, 1). [deg]"""
    steps = math.ceil(2 * half_field_of_view_deg / SCAN_STEP_DEG)
    regular = np.linspace(-half_field_of_view_deg, half_field_of_view_deg, steps + 1)
    mirror = unit_vector(solar_zenith_deg, solar_azimuth_deg + 180)
    to_the_right = np.tensordot(mirror, unit_vector(90, headings_deg + 90), 1)
    nearest = np.clip(np.rad2deg(np.arctan2(to_the_right, mirror[2])), -half_field_of_view_deg, half_field_of_view_deg)
    return np.hstack([np.broadcast_to(regular, (len(headings_deg), regular.size)), nearest])


def _max_share(
    geometry: reference.Geometry, bands: BandParameters, direct_fraction: ArrayLike, *, simplified: bool
) -> Array:
    """Largest specular share over the bands and the directions of a geometry (lines, n): (lines,)."""
    lobes, lobe_of_band = np.unique(np.stack([bands.w, bands.n, bands.k]), axis=1, return_inverse=True)
    w, n, k = lobes[..., np.newaxis, np.newaxis]
    f_spec = reference.specular(geometry, w, n, k, simplified=simplified).max(axis=2)
    peak = (np.asarray(direct_fraction) * bands.t1 * f_spec[lobe_of_band].T).T
    total = peak + bands.t0[:, np.newaxis]
    share: Array = (peak / np.where(total > 0, total, 1)).max(axis=0)
    return share


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
