"""Observation geometry files (OBS) of JPL, EMIT and NEON: what their bands mean, and whether they do.

Labels of units are not believed (AVIRIS-3 calls its slope "rad" and stores degrees): the phase angle must follow
from the directions to sensor and sun, and cos i from slope, aspect and the direction to the sun.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import angle_between, unit_vector
from tscorr.errors import InputError

Array = NDArray[Any]

OBS_BANDS = (
    "path length",
    "to-sensor azimuth",
    "to-sensor zenith",
    "to-sun azimuth",
    "to-sun zenith",
    "phase",
    "slope",
    "aspect",
    "cosine i",
    "UTC",
)
"""the order of the bands, from 1; an eleventh, the distance of the sun, may follow"""
VOID = -9999.0
PHASE_WITHIN_SHARE = 0.02
INCIDENCE_WITHIN_DEG = 0.5
"""medians of what is recomputed and what is stored must agree to these; real files do to 1e-4 and 0.03 degrees"""


@dataclass(frozen=True, slots=True)
class Obs:
    """Values of an OBS file, arrays of one shape: degrees, and the cosine of the incidence angle. Void is nan."""

    view_azimuth: Array
    view_zenith: Array
    sun_azimuth: Array
    sun_zenith: Array
    phase: Array
    slope: Array
    aspect: Array
    cos_i: Array

    @classmethod
    def of(cls, bands: Array) -> "Obs":
        """From the bands (bands, ...) in their order."""
        values = np.where(np.asarray(bands) == VOID, np.nan, bands)
        return cls(*values[1:9].astype(float))


def check_obs(obs: Obs, where: str) -> None:
    """Raise InputError where the phase angle does not follow from the directions to sensor and sun.

    where : the file, for the message, which says what was found and which other reading would fit.
    """
    view, sun, phase = (obs.view_zenith, obs.view_azimuth), (obs.sun_zenith, obs.sun_azimuth), obs.phase
    known = np.isfinite(np.stack([*view, *sun, phase])).all(axis=0)
    if not known.any():
        raise InputError(f"{where} holds no directions at all")
    view, sun, phase = tuple(a[known] for a in view), tuple(a[known] for a in sun), phase[known]
    if _agrees(angle_between(unit_vector(*view), unit_vector(*sun)), phase) and _are_zeniths(view[0], sun[0]):
        return
    radians = [np.rad2deg(a) for a in (*view, *sun, phase)]
    hint = ""
    if _agrees(_between(*radians[:4]), radians[4]):
        hint = ": they are in radians"
    elif _agrees(_between(view[1], view[0], sun[1], sun[0]), phase):
        hint = ": zenith stands before azimuth"
    i = int(np.argsort(np.abs(_between(*view, *sun) - phase))[phase.size // 2])
    raise InputError(
        f"{where}: to-sensor azimuth {view[1][i]:.4f} and zenith {view[0][i]:.4f}, to-sun azimuth {sun[1][i]:.4f} and "
        f"zenith {sun[0][i]:.4f} (bands 2 to 5) make a phase angle of {_between(*view, *sun)[i]:.4f} degrees; band 6 "
        f"says {phase[i]:.4f}. The bands are not in the order {', '.join(OBS_BANDS)}, or not in degrees{hint}"
    )


def check_obs_slope(obs: Obs, where: str) -> None:
    """Raise InputError where cos i does not follow from slope, aspect and the direction to the sun."""
    stored = np.stack([obs.slope, obs.aspect, obs.cos_i, obs.sun_zenith, obs.sun_azimuth])
    stored = stored[:, np.isfinite(stored).all(axis=0)]
    if not stored.size:
        raise InputError(f"{where} holds no slopes at all")
    slope, aspect, cos_i, *sun = stored
    incidence = np.rad2deg(np.arccos(np.clip(cos_i, -1, 1)))
    found = _between(slope, aspect, *sun)
    error = float(np.median(np.abs(found - incidence)))
    in_radians = min(
        float(np.median(np.abs(_between(np.rad2deg(slope), aspects, *sun) - incidence)))
        for aspects in (aspect, np.rad2deg(aspect))
    )
    fits_radians = in_radians < error / 3 and error > 0.05  # gentle slopes make a small error in either unit
    if error <= INCIDENCE_WITHIN_DEG and not fits_radians:
        return
    i = int(np.argsort(np.abs(found - incidence))[incidence.size // 2])
    raise InputError(
        f"{where}: slope {slope[i]:.4f} and aspect {aspect[i]:.4f} (bands 7 and 8) under a sun at zenith "
        f"{sun[0][i]:.4f}, azimuth {sun[1][i]:.4f} make cos i = {np.cos(np.deg2rad(found[i])):.4f}; band 9 says "
        f"{cos_i[i]:.4f}. Allowed are degrees{': the slope is in radians' if fits_radians else ''}"
    )


def _between(zenith_a: Array, azimuth_a: Array, zenith_b: Array, azimuth_b: Array) -> Array:
    """Angle between two directions. [deg]"""
    return angle_between(unit_vector(zenith_a, azimuth_a), unit_vector(zenith_b, azimuth_b))


def _agrees(found: Array, phase: Array) -> bool:
    return bool(np.median(np.abs(found - phase)) <= PHASE_WITHIN_SHARE * np.median(np.abs(phase)))


def _are_zeniths(*zeniths: Array) -> bool:
    """Whether directions to a sensor and a sun above the ground can have these zenith angles."""
    return all(bool(((zenith >= 0) & (zenith <= 90)).mean() > 0.99) for zenith in zeniths)
