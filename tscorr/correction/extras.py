"""What only some runs ask of the kernel, as it reads it: uncertainty, other methods, the sky, scattered normals."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from tscorr import kernels, reference
from tscorr.correction.covariance import covariances
from tscorr.correction.edges import SAME_BAND_UM
from tscorr.correction.rules import ReferenceDirections, Rules, Stored
from tscorr.correction.sky import sky_polynomial, sky_relative_sigma
from tscorr.correction.tables import Entry, steepest_deg
from tscorr.errors import InputError
from tscorr.materials import BandParameters, Material, material

Array = NDArray[Any]

METHODS = {"subtract": kernels.SUBTRACT, "ratio": kernels.RATIO, "reference": kernels.REFERENCE}
DEGREE, LEAN_DEGREE = kernels.VARIANCE_DEGREE, kernels.LEAN_DEGREE
NODES = 60


def is_extra(rules: Rules) -> bool:
    """Whether the rules of a material ask for more than the plain subtraction of the sun's part."""
    return rules.method != "subtract" or rules.sky_specular or rules.average_normals


def signed(dtype: np.dtype[Any], materials: Sequence[Entry]) -> np.dtype[Any]:
    """The type of what is removed: that of the image, but able to be negative where a method adds as well."""
    adds = any(rules.method == "reference" and rules.enabled for *_, rules in materials)
    wider = {"uint8": np.int16, "uint16": np.int32}
    return np.dtype(wider.get(dtype.name, dtype)) if adds else dtype


def extras_table(materials: Sequence[Entry], stored: Stored, real: type[np.floating[Any]]) -> kernels.Extras:
    """The extras of all materials in one float type; row 0 is "no material". Fields are set for each block."""
    bands = len(stored.scale)
    nothing = material("lambertian")
    entries = [(nothing, nothing.at(bands=bands), Rules(enabled=False)), *materials]
    rows = [_row(*entry, bands) for entry in entries]
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    columns |= {
        "noise": np.array(np.broadcast_to(stored.noise, (bands, 2)), dtype=float),
        "view_variance": np.array([np.deg2rad(stored.direction_sigma_deg) ** 2]),
        "highest": np.array([_highest(stored)]),
    }
    for key, column in columns.items():
        if column.dtype.kind == "f":
            columns[key] = column.astype(real)
    simple = not any(is_extra(rules) or rules.normal_sigma_deg is not None for *_, rules in materials)
    field = np.zeros((1, 1), np.float32)
    return kernels.Extras(
        sigma=np.zeros((bands, 0, 0), np.float32), weight=field + 1, scatter=field, simple=simple, **columns
    )


def _highest(stored: Stored) -> float:
    """The largest stored value that a correction may reach: below nodata, where that stands at the end of the type."""
    if stored.dtype.kind == "f":
        return np.inf
    most = np.iinfo(stored.dtype).max
    return float(most - 1 if stored.nodata == most else most)


def _row(surface: Material, parameters: BandParameters, rules: Rules, bands: int) -> dict[str, Any]:
    beta, beta_sigma = (
        np.broadcast_to(np.array(values, dtype=float), bands)
        for values in (rules.direct_fraction, rules.direct_fraction_sigma)
    )
    steepest = steepest_deg(surface, rules)
    covariance = covariances(surface, parameters, rules.material_covariance)
    by_band = list(zip(parameters.t0, parameters.t1, parameters.w, parameters.n, parameters.k, strict=True))
    has_sky = rules.sky_specular and rules.enabled and bool(np.any((beta < 1) & (parameters.t1 > 0)))
    sky = np.zeros((bands, kernels.SKY_DEGREE + 3))
    sky_sigma = np.zeros(bands)
    if has_sky:
        for b, (_, t1, w, n, k) in enumerate(by_band):
            sky[b] = sky_polynomial(w, n, k, steepest)
            sky[b, :-2] *= t1
            sky_sigma[b] = sky_relative_sigma(t1, w, n, k, covariance[b], steepest)
    angles = _reference_geometry(rules.reference)
    adds = rules.method == "reference"
    lobes = [
        reference.specular(angles, *map(np.asarray, row[2:]), simplified=rules.form == "simplified") for row in by_band
    ]
    direct = np.pi * beta * parameters.t1 * np.array(lobes, dtype=float)
    gradients = np.stack([_log_gradient(angles, row, ratio=False) for row in by_band])
    variance, cross = _variance_rows(by_band, covariance, gradients, steepest, ratio=rules.method == "ratio")
    rate = beta_sigma / np.where(beta > 0, beta, 1)
    apart = rules.method != "subtract" or has_sky  # then the direct fraction changes more than the lobe
    if not apart:
        variance[:, 0] += rate**2
    back_albedo = _albedo_at(sky, angles.cos_r) if adds else np.zeros(bands)
    same = np.zeros(bands, bool)
    same[1:] = (variance[1:] == variance[:-1]).all(axis=1) & (parameters.w[1:] == parameters.w[:-1])
    return {
        "own_scatter": np.nan if rules.normal_sigma_deg is None else rules.normal_sigma_deg,
        "averaged": rules.average_normals,
        "method": METHODS[rules.method],
        "t0": parameters.t0,
        "t1": parameters.t1,
        "beta": beta,
        "beta_sigma": beta_sigma,
        "covariance": covariance,
        "variance": variance,
        "same_variance": same,
        "sky": sky,
        "has_sky": has_sky,
        "sky_sigma": sky_sigma,
        "reference": direct if adds else np.zeros(bands),
        "reference_sky": back_albedo,
        "reference_gradient": gradients,
        "parts": np.stack(
            [
                1 - beta,
                np.pi * parameters.t0 * beta,
                np.pi * parameters.t0 * (1 - beta),
                direct if adds else np.zeros(bands),
                back_albedo,
                rate * apart,
                beta_sigma * apart,
                sky_sigma,
                np.pi * parameters.t0 * beta_sigma,
            ],
            axis=1,
        ),
        "cross": cross if adds else np.zeros_like(cross),
    }


def _reference_geometry(directions: ReferenceDirections) -> reference.Geometry:
    return reference.geometry_from_angles(*(np.asarray(float(angle)) for angle in directions))


def _log_gradient(angles: reference.Geometry, row: Sequence[float], *, ratio: bool) -> Array:
    """Derivatives of ln(t1 f_spec), for a ratio of ln(t1 f_spec / t0), by t0 to k: (5, ...)."""
    t0, t1, w, n, k = (np.asarray(value) for value in row)
    gradient = reference.log_gradient(angles, t1 if t1 > 0 else np.asarray(np.inf), w, n, k)
    if ratio and t0 > 0:
        gradient[0] -= 1 / t0
    return gradient


def _variance_rows(
    by_band: Sequence[Sequence[float]], covariance: Array, gradients: Array, steepest: float, *, ratio: bool
) -> tuple[Array, Array]:
    """Rows of Extras.variance and Extras.cross for the bands of one material.

    The gradient is linear in alpha^2 (by w) and depends else on the local angle alone, so the variance is quadratic in
    alpha^2, with coefficients that are smooth in cos_l: the square of what errs with w, and a rest. That is all there
    is where alpha^2 makes the square 0, and so its relative errors are kept small.
    """
    cos_min = float(np.sin(np.deg2rad(90 - steepest)))
    nodes = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    cos_l = (1 - cos_min) / 2 * nodes + (1 + cos_min) / 2
    level = reference.Geometry(cos_l, cos_l, cos_l, np.zeros(NODES))
    variance = np.zeros((len(by_band), DEGREE + LEAN_DEGREE + 3))
    cross = np.zeros((len(by_band), DEGREE + 3))
    for b, row in enumerate(by_band):
        at_top = _log_gradient(level, row, ratio=ratio)
        by_alpha2 = np.zeros((5, 1))
        by_alpha2[2] = -2 * row[2] * np.rad2deg(1) ** 2
        c = covariance[b]
        sigma_w = np.sqrt(c[2, 2])
        with_w = (c[2] @ at_top) / sigma_w if sigma_w > 0 else np.zeros(NODES)
        rest = np.maximum(np.einsum("ia,ij,ja->a", at_top, c, at_top) - with_w**2, 0)
        variance[b, : DEGREE + 1] = _powers(cos_l, rest, DEGREE, 1 / np.maximum(rest, max(1e-3 * rest.max(), 1e-30)))
        variance[b, DEGREE + 1 : -1] = _powers(cos_l, with_w, LEAN_DEGREE)
        variance[b, -1] = -by_alpha2[2, 0] * sigma_w
        of_reference = gradients[b]
        cross[b, : DEGREE + 1] = _powers(cos_l, of_reference @ c @ at_top, DEGREE)
        cross[b, DEGREE + 1 :] = (of_reference @ c @ by_alpha2).item(), of_reference @ c @ of_reference
    return variance, cross


def _powers(x: Array, values: Array, degree: int, weight: Array | None = None) -> Array:
    """Coefficients (degree + 1,) of the polynomial nearest to values at nodes x, lowest power first."""
    found = Polynomial.fit(x, values, degree, w=weight).convert().coef
    return np.pad(found, (0, degree + 1 - len(found)))


def _albedo_at(sky: Array, cosine: Array) -> Array:
    """The polynomials of t1 times the albedo (bands, ...) at a cosine: (bands,)."""
    x = cosine * sky[:, -2] + sky[:, -1]
    return np.array([np.polynomial.polynomial.polyval(at, row[:-2]) for at, row in zip(x, sky, strict=True)])


def check_ratio(surface: Material, wavelengths_um: Sequence[float] | None, bands: int) -> None:
    """Refuse method = "ratio" for a material whose t0 is not known in every band; InputError names it."""
    count = len(surface.wavelength_um)
    if count > 1:
        return
    far = (
        []
        if not count or wavelengths_um is None
        else [band for band in wavelengths_um if not abs(band - surface.wavelength_um[0]) <= SAME_BAND_UM]
    )
    if bands == 1 and not far:
        return
    known = f"known at {surface.wavelength_um[0]:g} um only" if count else "given without a wavelength"
    raise InputError(
        f"method = 'ratio' needs t0 of every band, but that of material '{surface.name}' is {known} and the image has "
        f"{bands} band{'s' * (bands > 1)}: allowed are 'subtract' and 'reference', or a material with one t0 a band"
    )
