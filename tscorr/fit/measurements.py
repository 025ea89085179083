"""Goniometer measurements of one surface, checked at the door, and the choice of those a fit may use."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr import angles, reference
from tscorr.errors import InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WHITE = 1 / np.pi
"""f_r of a white Lambertian surface [sr^-1]"""


@dataclass(frozen=True, slots=True)
class Measurements:
    """f_r of one surface at many geometries; made by `Measurements.of`, which checks.

    One row of f_r and of sigma for each wavelength: (bands, samples). Angles (samples,) from the surface
    normal; relative azimuth in [0, 180], 180 forward.
    """

    incidence_deg: Array
    exitance_deg: Array
    relative_azimuth_deg: Array
    f_r: Array
    """sr^-1; nan where a wavelength was not measured"""
    sigma: Array | None = None
    """1 sigma of f_r, sr^-1; None where the source gives none"""
    wavelength_um: tuple[float, ...] = ()
    source: str = "measurements"
    mirror_deg: float = 0.0
    """facet tilt below which the source itself says not to trust a value"""

    @classmethod
    def of(
        cls,
        incidence_deg: ArrayLike,
        exitance_deg: ArrayLike,
        relative_azimuth_deg: ArrayLike,
        f_r: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        wavelength_um: ArrayLike = (),
        source: str = "measurements",
        mirror_deg: float = 0.0,
    ) -> "Measurements":
        """Measurements from arrays: angles (samples,), f_r (samples,) or (bands, samples), sigma alike.

        Raises InputError where shapes, ranges or units cannot be right.
        """
        theta_i, theta_r, phi = (
            _vector(values, name, source)
            for name, values in (
                ("theta_i", incidence_deg),
                ("theta_r", exitance_deg),
                ("phi", relative_azimuth_deg),
            )
        )
        brdf = np.atleast_2d(np.asarray(f_r, dtype=float))
        wavelengths, samples = np.asarray(wavelength_um, dtype=float), len(theta_i)
        if not (len(theta_i) == len(theta_r) == len(phi)) or brdf.shape[1:] != (samples,):
            raise InputError(
                f"{source}: theta_i, theta_r, phi and f_r have {len(theta_i)}, {len(theta_r)}, {len(phi)} "
                f"and {brdf.shape[-1]} samples; allowed is one number of samples"
            )
        if wavelengths.size not in {0, len(brdf)} or (len(brdf) > 1 and not wavelengths.size):
            raise InputError(
                f"{source}: f_r has {len(brdf)} rows and {wavelengths.size} wavelengths; "
                f"allowed is one row a wavelength"
            )
        _check_angles(theta_i, theta_r, phi, source)
        _check_level(brdf, source)
        errors = None if sigma is None else _checked_sigma(sigma, brdf, source)
        ascending = np.argsort(wavelengths) if wavelengths.size else np.array([0])
        return cls(
            incidence_deg=theta_i,
            exitance_deg=theta_r,
            relative_azimuth_deg=angles.relative_azimuth(phi, 0.0).astype(np.float64),
            f_r=brdf[ascending],
            sigma=None if errors is None else errors[ascending],
            wavelength_um=tuple(np.sort(wavelengths).tolist()),
            source=source,
            mirror_deg=mirror_deg,
        )

    @property
    def geometry(self) -> reference.Geometry:
        """What the model needs of the angles; arrays (samples,)."""
        return reference.geometry_from_angles(self.incidence_deg, self.exitance_deg, self.relative_azimuth_deg)

    @property
    def facet_tilt_deg(self) -> Array:
        """Tilt of the facet that mirrors source into viewer, alpha. [deg]"""
        return np.rad2deg(self.geometry.alpha)

    @property
    def zenith_deg(self) -> Array:
        """The larger of incidence and exitance. [deg]"""
        return np.maximum(self.incidence_deg, self.exitance_deg)

    def samples(self, keep: Mask) -> "Measurements":
        """The samples where `keep` is true."""
        return replace(
            self,
            incidence_deg=self.incidence_deg[keep],
            exitance_deg=self.exitance_deg[keep],
            relative_azimuth_deg=self.relative_azimuth_deg[keep],
            f_r=self.f_r[:, keep],
            sigma=None if self.sigma is None else self.sigma[:, keep],
        )

    def at(self, wavelengths_um: Sequence[float]) -> "Measurements":
        """The named wavelengths only; each must have been measured, to the nanometre."""
        known = np.asarray(self.wavelength_um)
        rows = []
        for wanted in wavelengths_um:
            hits = np.flatnonzero(np.abs(known - wanted) < 1e-3)
            if not hits.size:
                listed = ", ".join(f"{value:g}" for value in known) or "none"
                raise InputError(f"{self.source} has no wavelength {wanted:g} um; it has {listed}")
            rows.append(int(hits[0]))
        rows.sort()
        return replace(
            self,
            f_r=self.f_r[rows],
            sigma=None if self.sigma is None else self.sigma[rows],
            wavelength_um=tuple(self.wavelength_um[row] for row in rows),
        )


def merge(parts: Sequence[Measurements]) -> Measurements:
    """Several files of one surface as one set of samples; wavelengths must agree."""
    first = parts[0]
    for part in parts[1:]:
        if part.wavelength_um != first.wavelength_um or (part.sigma is None) != (first.sigma is None):
            raise InputError(
                f"{part.source} and {first.source} differ in wavelengths or in having sigma; files of one "
                f"material must agree: fit them one by one"
            )
    given = [part.sigma for part in parts if part.sigma is not None]
    return Measurements(
        incidence_deg=np.concatenate([part.incidence_deg for part in parts]),
        exitance_deg=np.concatenate([part.exitance_deg for part in parts]),
        relative_azimuth_deg=np.concatenate([part.relative_azimuth_deg for part in parts]),
        f_r=np.concatenate([part.f_r for part in parts], axis=1),
        sigma=np.concatenate(given, axis=1) if given else None,
        wavelength_um=first.wavelength_um,
        source=", ".join(part.source for part in parts),
        mirror_deg=max(part.mirror_deg for part in parts),
    )


@dataclass(frozen=True, slots=True)
class Selection:
    """Which samples a fit uses. The defaults are the paper's: the forward half, zenith angles to 75."""

    min_relative_azimuth_deg: float = 90.0
    max_zenith_deg: float = 75.0
    """of incidence and of exitance"""
    mirror_deg: float | None = None
    """samples of smaller facet tilt are left out; None: as the source advises"""

    def __str__(self) -> str:
        return f"phi >= {self.min_relative_azimuth_deg:g}, zenith <= {self.max_zenith_deg:g}"

    def _mirror_deg(self, measured: Measurements) -> float:
        return measured.mirror_deg if self.mirror_deg is None else self.mirror_deg

    def _inside(self, measured: Measurements) -> Mask:
        """Ranges of zenith and azimuth; azimuth means nothing where one direction is the normal."""
        forward = measured.relative_azimuth_deg >= self.min_relative_azimuth_deg
        vertical = np.minimum(measured.incidence_deg, measured.exitance_deg) == 0
        return (forward | vertical) & (measured.zenith_deg <= self.max_zenith_deg)

    def used(self, measured: Measurements) -> Measurements:
        """The samples to fit."""
        mirror = measured.facet_tilt_deg < self._mirror_deg(measured)
        return measured.samples(self._inside(measured) & ~mirror)

    def left_out_mirror(self, measured: Measurements) -> Measurements:
        """The samples in range that are left out only because they look into the mirror direction."""
        mirror = measured.facet_tilt_deg < self._mirror_deg(measured)
        return measured.samples(self._inside(measured) & mirror)


def _vector(values: ArrayLike, name: str, source: str) -> Array:
    array = np.asarray(values, dtype=float)
    if array.ndim != 1 or not array.size:
        raise InputError(f"{source}: {name} has shape {array.shape}; allowed is (samples,)")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array))[0])
        raise InputError(f"{source}: {name} of sample {row + 1} is {array[row]}; allowed are numbers")
    return array


def _check_angles(theta_i: Array, theta_r: Array, phi: Array, source: str) -> None:
    for name, theta in (("theta_i", theta_i), ("theta_r", theta_r)):
        wrong = np.flatnonzero(~((theta >= 0) & (theta < 90)))
        if wrong.size:
            raise InputError(
                f"{source}: {name} = {theta[wrong[0]]:g} in sample {wrong[0] + 1}; allowed is 0 to below 90 "
                f"degrees (write a negative zenith as a positive one with phi + 180)"
            )
    if max(theta_i.max(), theta_r.max()) < np.pi / 2 and np.abs(phi).max() <= 2 * np.pi + 1e-3:
        raise InputError(
            f"{source}: no zenith angle exceeds {max(theta_i.max(), theta_r.max()):.3f}, no phi "
            f"{np.abs(phi).max():.3f}: these look like radians; allowed are degrees"
        )


def _check_level(f_r: Array, source: str) -> None:
    """Refuse values that no surface has away from its peak: percent, or reflectance factors as f_r."""
    finite = f_r[np.isfinite(f_r)]
    if not finite.size:
        raise InputError(f"{source}: f_r holds no number")
    low = float(np.quantile(finite, 0.1))
    if low > 1.25 * WHITE:
        raise InputError(
            f"{source}: nine in ten values of f_r exceed {low:.3g}; a white Lambertian surface has 0.318 "
            f"sr^-1. Are these reflectance factors (name the column reflectance_factor) or percent?"
        )


def _checked_sigma(sigma: ArrayLike, f_r: Array, source: str) -> Array:
    try:
        full: Array = np.broadcast_to(np.asarray(sigma, dtype=float), f_r.shape).copy()
    except ValueError:
        raise InputError(
            f"{source}: sigma has shape {np.shape(sigma)}; allowed is one number or f_r's shape, {f_r.shape}"
        ) from None
    wrong = np.isfinite(f_r) & ~(np.isfinite(full) & (full > 0))
    if wrong.any():
        band, sample = (int(index) for index in np.argwhere(wrong)[0])
        value: Any = full[band, sample]
        raise InputError(f"{source}: sigma = {value:g} in sample {sample + 1}; allowed is above 0")
    return full
