"""What images show of one material: samples for a fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.errors import InputError

Array = NDArray[np.float64]

ARRAYS = (
    "incidence_deg",
    "exitance_deg",
    "relative_azimuth_deg",
    "reflectance_factor",
    "direct",
    "diffuse",
    "roof",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageSamples:
    """Pixels of one material, lit and seen.

    Angles (samples,) about the facet; 180 of relative azimuth is forward.
    """

    name: str
    """of the material"""
    incidence_deg: Array
    exitance_deg: Array
    relative_azimuth_deg: Array
    reflectance_factor: Array
    """(bands, samples)"""
    direct: Array
    """(bands, samples) beta c: sunlight on the facet as a part of the irradiance that R refers to"""
    diffuse: Array
    """(bands, samples) beta c + (1 - beta) V: all light on the facet as such a part"""
    roof: Array
    """(samples,) samples of one number share errors, of normals and of the facet's own brightness"""
    wavelength_um: tuple[float, ...] = ()
    source: str = "samples"

    def __post_init__(self) -> None:
        count, bands = len(self.incidence_deg), len(self.reflectance_factor)
        for name in ARRAYS:
            shape = np.shape(getattr(self, name))
            allowed = (bands, count) if name in {"reflectance_factor", "direct", "diffuse"} else (count,)
            if shape != allowed:
                raise InputError(f"{self.source}, {self.name}: {name} has the shape {shape}; allowed is {allowed}")
        if len(self.wavelength_um) not in {0, bands} or (bands > 1 and not self.wavelength_um):
            raise InputError(
                f"{self.source}, {self.name}: {bands} bands and {len(self.wavelength_um)} wavelengths; allowed is "
                f"one wavelength a band"
            )

    def __len__(self) -> int:
        return len(self.incidence_deg)

    @property
    def geometry(self) -> reference.Geometry:
        """What the model needs of the angles; arrays (samples,)."""
        return reference.geometry_from_angles(self.incidence_deg, self.exitance_deg, self.relative_azimuth_deg)

    @property
    def zenith_deg(self) -> Array:
        """The larger of incidence and exitance. [deg]"""
        return np.maximum(self.incidence_deg, self.exitance_deg)

    @property
    def roofs(self) -> int:
        """How many roofs the samples are of."""
        return len(np.unique(self.roof))

    def at(self, places: NDArray[np.intp]) -> "ImageSamples":
        """Some of the samples, in this order."""
        return replace(self, **{name: getattr(self, name)[..., places] for name in ARRAYS})


def merged(parts: Sequence[ImageSamples]) -> ImageSamples:
    """Samples of one material from several images, which have the same bands."""
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in ARRAYS
    }
    return replace(parts[0], **joined, source=", ".join(part.source for part in parts))
