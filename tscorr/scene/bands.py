"""What a configuration says of an image's bands: wavelengths, how values are stored, what is done to materials."""

from collections.abc import Sequence

import numpy as np

from tscorr import config, rasters
from tscorr.correction import NEGLIGIBLE_REFLECTANCE, ReferenceDirections, Rules, Stored
from tscorr.errors import ConfigError, InputError, MaterialError
from tscorr.materials import ALLOWED_WAVELENGTHS, BandParameters, Material, is_wavelength
from tscorr.scene.bad_bands import parameters_of


def at_bands(surface: Material, wavelengths: tuple[float, ...] | None, image: rasters.RasterInfo) -> BandParameters:
    """The parameters of a material in each band."""
    try:
        return parameters_of(surface, wavelengths, image.bad_bands, image.bands)
    except MaterialError as error:
        raise MaterialError(f"{error}; image {image.path}") from None


def wavelengths_of(settings: config.Scene, image: rasters.RasterInfo) -> tuple[float, ...] | None:
    """Those given, else those of the file; None where nobody says. [um]"""
    given = settings.wavelength_um
    if given is None:
        return image.wavelengths_um
    wavelengths = _per_band(given, image, "wavelength_um")
    for um in wavelengths:
        if not is_wavelength(um):
            raise ConfigError(f"wavelength_um = {um:g} of the image {image.path}; allowed is {ALLOWED_WAVELENGTHS}")
    return wavelengths


def _per_band(value: float | Sequence[float], image: rasters.RasterInfo, what: str) -> tuple[float, ...]:
    """One value a band from one value or a list."""
    if isinstance(value, int | float):
        return (float(value),) * image.bands
    if len(value) != image.bands:
        raise ConfigError(
            f"{what} has {len(value)} values; the image {image.path} has {image.bands} bands: allowed are one "
            f"value, or one a band"
        )
    return tuple(value)


def stored_of(settings: config.Scene, correction: config.Correction, image: rasters.RasterInfo) -> Stored:
    """What stored values stand for."""
    scale = image.scales if settings.scale is None else _per_band(settings.scale, image, "scale")
    offset = image.offsets if settings.offset is None else _per_band(settings.offset, image, "offset")
    for name, values in (("scale", scale), ("offset", offset)):
        for value in values:
            if not np.isfinite(value) or (name == "scale" and value <= 0):
                allowed = "a number above 0" if name == "scale" else "any number"
                raise InputError(
                    f"the image {image.path} has the {name} {value:g}; allowed is {allowed}: give {name} = ..."
                )
    to_factor = np.pi if settings.quantity == "brdf" else 1.0
    if settings.nodata is not None and not rasters.can_hold(image.dtype, settings.nodata):
        raise ConfigError(f"nodata = {settings.nodata:g}, which no {image.dtype} pixel of {image.path} can be")
    saturation = None if settings.saturation is None else _per_band(settings.saturation, image, "saturation")
    if saturation is not None and image.bad_bands:
        saturation = tuple(np.where(image.bad_bands, np.inf, saturation).tolist())
    return Stored(
        dtype=image.dtype,
        scale=tuple(value * to_factor for value in scale),
        offset=tuple(value * to_factor for value in offset),
        nodata=image.nodata if settings.nodata is None else settings.nodata,
        saturation=saturation,
        noise=_noise(correction, image),
        direction_sigma_deg=correction.direction_sigma_deg,
    )


def _noise(correction: config.Correction, image: rasters.RasterInfo) -> tuple[tuple[float, float], ...]:
    """a, b of the image's noise for each band."""
    noise = correction.image_noise
    pairs = noise if isinstance(noise, list) else [noise] * image.bands
    if len(pairs) != image.bands:
        raise ConfigError(
            f"image_noise has {len(pairs)} pairs; the image {image.path} has {image.bands} bands: allowed are one "
            f"pair, or one a band"
        )
    return tuple(pairs)


def rules_of(
    name: str,
    settings: config.Scene,
    whole: config.Config,
    stored: Stored,
    image: rasters.RasterInfo,
    only: Sequence[str] = (),
) -> Rules:
    """How one material is corrected: [model] and [correction], then the scene, then the material's own."""
    own = whole.materials.settings.get(name, config.MaterialSettings())
    values = {
        **whole.model.model_dump(),
        **whole.correction.model_dump(),
        **({} if settings.direct_fraction is None else {"direct_fraction": settings.direct_fraction}),
        **own.model_dump(exclude_none=True),
    }
    fractions = _per_band(values["direct_fraction"], image, "direct_fraction")
    fraction_sigma = _per_band(values["direct_fraction_sigma"], image, "direct_fraction_sigma")
    negligible = values["negligible_reflectance"]
    if negligible is None:
        negligible = stored.step / 2 if stored.step is not None else NEGLIGIBLE_REFLECTANCE
    if values["uncorrectable"] == "nodata" and stored.nodata is None:
        raise ConfigError(
            f"uncorrectable = 'nodata', but the image {image.path} has no nodata value: give nodata = ..."
        )
    return Rules(
        form=values["form"],
        precision=values["precision"],
        negligible_reflectance=negligible,
        uncorrectable=values["uncorrectable"],
        uncorrectable_share=values["uncorrectable_share"],
        max_zenith_deg=values["max_zenith_deg"],
        irradiance_plane=values["irradiance_plane"],
        direct_fraction=fractions,
        direct_fraction_sigma=fraction_sigma,
        method=values["method"],
        reference=ReferenceDirections(**values["reference"]),
        sky_specular=values["sky_specular"],
        normal_sigma_deg=values["normal_sigma_deg"],
        average_normals=values["average_normals"],
        material_covariance=values["material_covariance"],
        enabled=values["enabled"] and (not only or name in only),
    )
