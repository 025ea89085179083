"""How the peak of a material is taken out, and what the stored values of an image mean."""

from dataclasses import dataclass, fields
from numbers import Real
from typing import Any, Literal, NamedTuple, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import ConfigError, Limits, check_values, nearest

NEGLIGIBLE_REFLECTANCE = 5e-5
"""threshold for images of floating point, which have no stored step"""


class ReferenceDirections(NamedTuple):
    """Directions about the surface's own normal that method = "reference" normalises to. [deg]"""

    solar_zenith_deg: float = 45.0
    view_zenith_deg: float = 0.0
    relative_azimuth_deg: float = 0.0


REFERENCE = ReferenceDirections()


SHARES = "a share from 0 to 1, or a list of shares, one a band"


def _are_shares(values: Any) -> bool:
    return len(values) > 0 and all(0 <= value <= 1 for value in values)


LIMITS: Limits = {
    "negligible_reflectance": (lambda value: value >= 0, "a number from 0"),
    "uncorrectable_share": (lambda value: 0 < value <= 1, "a share above 0, up to 1"),
    "max_zenith_deg": (lambda value: value is None or 0 < value <= 90, "an angle above 0, up to 90"),
    "direct_fraction": (_are_shares, SHARES),
    "direct_fraction_sigma": (_are_shares, SHARES),
    "reference": (
        lambda value: len(value) == 3 and max(value[:2]) <= 75 and value[2] <= 180 and min(value) >= 0,
        "two zenith angles from 0 to 75 and a relative azimuth from 0 to 180",
    ),
    "normal_sigma_deg": (lambda value: value is None or 0 <= value <= 45, "an angle from 0 to 45"),
}
"""what the numbers of `Rules` may be"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """How the peak of one material is taken out; the settings [model] and [correction] of a configuration.

    Raises ConfigError where a value is none of those allowed.
    """

    form: Literal["full", "simplified"] = "full"
    precision: Literal["fast", "exact", "reference"] = "fast"
    negligible_reflectance: float = NEGLIGIBLE_REFLECTANCE
    uncorrectable: Literal["best", "keep", "nodata"] = "best"
    uncorrectable_share: float = 0.9
    max_zenith_deg: float | None = None
    irradiance_plane: Literal["horizontal", "facet"] = "horizontal"
    direct_fraction: tuple[float, ...] = (1.0,)
    direct_fraction_sigma: tuple[float, ...] = (0.0,)
    method: Literal["subtract", "ratio", "reference"] = "subtract"
    reference: ReferenceDirections = REFERENCE
    sky_specular: bool = False
    normal_sigma_deg: float | None = None
    """None: what the surface knows of its normals"""
    average_normals: bool = False
    material_covariance: Literal["synthetic", "independent"] = "synthetic"
    enabled: bool = True

    def __post_init__(self) -> None:
        for name in ("direct_fraction", "direct_fraction_sigma"):
            if isinstance(getattr(self, name), Real):  # one number for all bands
                object.__setattr__(self, name, (getattr(self, name),))
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for field in fields(self):
            choices = (True, False) if field.type is bool else ()
            choices = get_args(field.type) if get_origin(field.type) is Literal else choices
            if choices and values[field.name] not in choices:
                words = map(str, choices)
                allowed = f"{', '.join(map(repr, choices))}{nearest(str(values[field.name]), words)}"
                raise ConfigError(f"{field.name} = {values[field.name]!r}; allowed are {allowed}")
        check_values(values, LIMITS, ConfigError)
        object.__setattr__(self, "reference", ReferenceDirections(*self.reference))


@dataclass(frozen=True, slots=True, kw_only=True)
class Stored:
    """What the stored values of an image mean: reflectance factor = scale * stored + offset, band by band."""

    dtype: np.dtype[Any]
    scale: tuple[float, ...]
    offset: tuple[float, ...]
    nodata: float | None = None
    saturation: tuple[float, ...] | None = None
    noise: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    """a, b of the image's 1 sigma a + b R in reflectance factor: for all bands, or for each"""
    direction_sigma_deg: float = 0.0
    """1 sigma of the direction to the sensor, along each of two axes"""

    @property
    def step(self) -> float | None:
        """The finest step of reflectance that can be stored, or None for floating point."""
        return min(map(abs, self.scale)) if self.dtype.kind in "iu" else None

    @property
    def has_nodata(self) -> bool:
        """Whether a nodata value is given that the type can hold: -1 of an unsigned type stands nowhere."""
        if self.nodata is None:
            return False
        if self.dtype.kind == "f":
            return not np.isfinite(self.nodata) or abs(self.nodata) <= float(np.finfo(self.dtype).max)
        limits = np.iinfo(self.dtype)
        return float(self.nodata).is_integer() and limits.min <= self.nodata <= limits.max

    def has_data(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Where all bands of stored values (bands, rows, cols) are numbers and not nodata: (rows, cols)."""
        floating = self.dtype.kind == "f"
        found = np.isfinite(values).all(axis=0) if floating else np.ones(values.shape[1:], np.bool_)
        return found & (values != self.nodata).all(axis=0) if self.has_nodata else found
