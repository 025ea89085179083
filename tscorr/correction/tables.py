"""Materials, rules and stored values as the kernel reads them."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from tscorr import kernels, reference
from tscorr.correction.rules import Rules, Stored
from tscorr.errors import InputError
from tscorr.materials import BandParameters, Material, material

Array = NDArray[Any]
Entry = tuple[Material, BandParameters, Rules]
"""a material, its parameters for each band, and how it is corrected"""

MAX_ZENITH_DEG = {"full": 85.0, "simplified": 70.0}
BESIDE_NODATA = 1e-5
"""reflectance that a clipped value of a floating-point image keeps where 0 means nodata; not lost beside a 100"""
FRESNEL_ERROR = 3e-6
"""relative error up to which a polynomial stands in for the Fresnel equations"""


def pixel_rules(stored: Stored) -> dict[np.dtype[Any], kernels.PixelRules]:
    """What stored values mean, in both widths of float, as the kernel reads it."""
    bands, dtype = len(stored.scale), stored.dtype
    integer = dtype.kind in "iu"
    scale, offset = np.array(stored.scale), np.array(stored.offset)
    black = -offset / scale
    lowest = np.maximum(np.ceil(black - 1e-9), np.iinfo(dtype).min) if integer else black
    if not integer and stored.nodata == 0:
        lowest = np.where(lowest == 0, BESIDE_NODATA / scale, lowest)
    saturation = np.full(bands, np.inf) if stored.saturation is None else np.array(stored.saturation)
    nodata = stored.nodata if stored.nodata is not None and stored.has_nodata else 0
    has_nodata = stored.has_nodata and not np.isnan(nodata)
    return {
        np.dtype(real): kernels.PixelRules(
            scale=scale.astype(real),
            offset=offset.astype(real),
            steps=(1 / scale).astype(real),
            saturation=saturation.astype(real),
            lowest=lowest.astype(real),
            nodata=np.array([nodata]).astype(dtype),
            has_nodata=has_nodata,
            dodge=has_nodata and integer,
            integer=True if integer else None,
        )
        for real in (np.float32, np.float64)
    }


def computed_precision(parameters: BandParameters, rules: Rules) -> str:
    """The precision of the rules, but "exact" where float32 cannot keep the promise of "fast".

    Where all light is reflected beyond a critical angle (n < 1, hardly absorbing), F has a kink there, which
    a cosine in float32 misses. The limits are searched: see `tscorr bench`, which fails where "fast" errs by more
    than it says.
    """
    if rules.precision != "fast":
        return rules.precision
    kinked = (parameters.t1 > 0) & (parameters.n < 1) & (parameters.k < 0.05)
    return "exact" if np.any(kinked) else "fast"


def material_table(materials: Sequence[Entry], bands: int, real: type[np.floating[Any]]) -> kernels.MaterialTable:
    """Materials and their rules as arrays of one float type; row 0 is "no material"."""
    rows = [_material_row(*entry, bands) for entry in materials]
    empty = _material_row(material("lambertian"), material("lambertian").at(bands=bands), Rules(enabled=False), bands)
    columns: dict[str, Any] = {key: np.array([row[key] for row in (empty, *rows)]) for key in empty}
    precise = {"w", "n", "k"}  # exact equations are evaluated in float64
    for key, column in columns.items():
        if column.dtype.kind == "f" and key not in precise:
            columns[key] = column.astype(real)
    return kernels.MaterialTable(**columns)


def _material_row(surface: Material, parameters: BandParameters, rules: Rules, bands: int) -> dict[str, Any]:
    if len(parameters.t0) != bands or len(rules.direct_fraction) not in {1, bands}:
        raise InputError(
            f"material '{surface.name}' has parameters for {len(parameters.t0)} bands and "
            f"{len(rules.direct_fraction)} direct fractions; the image has {bands} bands"
        )
    beta = np.broadcast_to(np.array(rules.direct_fraction, dtype=float), bands)
    gain = np.pi * beta * parameters.t1
    low, steepest = surface.zenith_range_deg[0], steepest_deg(surface, rules)
    shared = np.zeros(bands, bool)
    for key in ("w", "n", "k"):
        values = getattr(parameters, key)
        shared[1:] |= values[1:] != values[:-1]
    shared = ~shared & (np.arange(bands) > 0)
    fits = [fresnel_polynomial(n, k, steepest) for n, k in zip(parameters.n, parameters.k, strict=True)]
    cos_steepest = _cosine(steepest)
    return {
        "peak": bool(rules.enabled and np.any(gain > 0)),
        "gain": gain,
        "w": parameters.w,
        "w2": np.rad2deg(parameters.w) ** 2,
        "n": parameters.n,
        "k": parameters.k,
        "fresnel": fits,
        "shared": shared,
        "bound": float(np.max(gain * _fresnel_bound(parameters.n, parameters.k, cos_steepest))),
        "one_w": bool(np.all(parameters.w == parameters.w[0])),
        "ways": (kernels.SIMPLIFIED if rules.form == "simplified" else 0)
        | (kernels.LEVEL if rules.irradiance_plane == "horizontal" else 0)
        | {"best": 0, "keep": kernels.KEEP, "nodata": kernels.BLANK}[rules.uncorrectable],
        "cos_min": cos_steepest,
        "cos_max": _cosine(low) if low > 0 else 2.0,
        "negligible": rules.negligible_reflectance,
        "share": rules.uncorrectable_share,
    }


def steepest_deg(surface: Material, rules: Rules) -> float:
    """The largest incidence and exitance that are assessed. [deg]"""
    limit = MAX_ZENITH_DEG[rules.form] if rules.max_zenith_deg is None else rules.max_zenith_deg
    return min(surface.zenith_range_deg[1], limit)


def _cosine(zenith_deg: float) -> float:
    return float(np.sin(np.deg2rad(90.0 - zenith_deg)))


def _fresnel_bound(n: Array, k: Array, cos_min: float) -> Array:
    """No F is larger for cosines of the local angle from `cos_min` to 1.

    For n >= 1 and F(0) <= 1/3, F rises with the local angle all the way; others are bounded by 1.
    """
    normal_incidence = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    rises = (n >= 1) & (normal_incidence <= 1 / 3)
    return np.where(rises, reference.fresnel(np.float64(cos_min), n, k), 1.0)  # type: ignore[arg-type]


@cache
def fresnel_polynomial(n: float, k: float, max_zenith_deg: float) -> tuple[float, ...]:
    """F over local angles from 0 to `max_zenith_deg` as a row of MaterialTable.fresnel.

    The polynomial is in x = cos_l mapped to [-1, 1], lowest power first, fitted with weights 1/F and checked
    as the kernel evaluates it, in float32. The local angle never exceeds the larger of incidence and exitance,
    so the range holds for every pixel that is assessed, however the scene is cut into blocks. Where the relative
    error exceeds FRESNEL_ERROR all is 0, which asks for the equations themselves.
    """
    degree = kernels.FRESNEL_DEGREE
    cos_min = _cosine(max_zenith_deg)
    nodes = np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    values = reference.fresnel((1 - cos_min) / 2 * nodes + (1 + cos_min) / 2, n, k)  # type: ignore[arg-type]
    if not np.all(values > 0):
        return (0.0,) * (degree + 3)
    series = chebyshev.chebfit(nodes, values, degree, w=1 / values)
    powers = np.zeros(degree + 1)
    powers[: len(series)] = chebyshev.cheb2poly(series)
    cosines = np.linspace(cos_min, 1, 5001).astype(np.float32)
    scale, shift = 2 / (1 - cos_min), -(1 + cos_min) / (1 - cos_min)
    x = cosines * np.float32(scale) + np.float32(shift)
    result = np.zeros_like(x)
    for coefficient in powers[::-1].astype(np.float32):
        result = result * x + coefficient
    exact = reference.fresnel(cosines.astype(float), n, k)  # type: ignore[arg-type]
    if np.max(np.abs(result / exact - 1)) > FRESNEL_ERROR:
        return (0.0,) * (degree + 3)
    return (*map(float, powers), scale, shift)


def new_tally(materials: int, bands: int) -> kernels.Tally:
    """Empty sums for `materials` rows (with row 0) and `bands` bands."""
    extremes = np.zeros((materials, 2))
    extremes[:, 0] = np.inf
    return kernels.Tally(
        states=np.zeros((materials, 4), np.int64),
        removed=np.zeros((materials, bands), np.int64),
        incidence=np.zeros((materials, 360), np.int64),
        tilt=np.zeros((materials, 900), np.int64),
        share=np.zeros((materials, 201), np.int64),
        extremes=extremes,
        attenuated=np.zeros(2),
        out_of_lobe=np.zeros(1, np.int64),
    )


def add_tally(total: kernels.Tally, part: kernels.Tally) -> None:
    """Add the sums of a block to those of the scene; integers and extremes, so no order matters."""
    for name in ("states", "removed", "share", "out_of_lobe"):
        sums = getattr(total, name)
        sums += getattr(part, name)
    add_angles(total, part)
    total.extremes[:, 1] = np.maximum(total.extremes[:, 1], part.extremes[:, 1])
    total.attenuated[0] += part.attenuated[0]
    total.attenuated[1] = max(total.attenuated[1], part.attenuated[1])


def add_angles(total: kernels.Tally, part: kernels.Tally) -> None:
    """Add the statistics of incidence and facet tilt, and nothing else."""
    for name in ("incidence", "tilt"):
        sums = getattr(total, name)
        sums += getattr(part, name)
    total.extremes[:, 0] = np.minimum(total.extremes[:, 0], part.extremes[:, 0])
