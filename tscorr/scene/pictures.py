"""Pictures of images: before and after the correction, and of one image alone."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tscorr import quicklook, rasters
from tscorr.errors import InputError

if TYPE_CHECKING:
    from tscorr.scene.plan import Scene

Array = NDArray[Any]

PICTURE_PX = 768
"""the longer side of a panel"""
PREVIEW_PX = 2048
"""the longer side of a picture of one image, unless asked for otherwise"""
BANDS_AT_ONCE = 8
"""bands of one file are read together: where they are stored together, each piece is then decoded once"""


def draw_quicklook(scene: "Scene", folder: Path, results: Mapping[str, rasters.RasterInfo]) -> Path:
    """The picture of before, after and flags, of a scene that is being published; `results` by product."""
    image = scene.image
    wavelengths = _good(scene.wavelengths_um, image)
    matrix = quicklook.rgb_matrix(wavelengths, image.fwhm_um)
    used = quicklook.used_bands(matrix)
    result = results.get("corrected", image)
    scale, offset = scene.stored.scale, scene.stored.offset

    def light(info: rasters.RasterInfo) -> Array:
        return quicklook.linear_rgb(_reflectance(info, used, scale, offset, PICTURE_PX), matrix[used])

    with ThreadPoolExecutor(2) as readers:  # to decode them is most of the work
        before, after = readers.map(light, (image, result))
    path = folder / "quicklook.png"
    flag_file = results.get("flags")
    flags = np.zeros(before.shape[:2], np.uint16)
    if flag_file is not None:
        flags = rasters.read_decimated_flags(flag_file, PICTURE_PX)
    note = quicklook.rendering_note(wavelengths, matrix)
    quicklook.before_after(before, after, flags, path, title=scene.name, note=note)
    return path


def draw_image(
    image: Path,
    output: Path,
    *,
    exposure: float | None = None,
    style: quicklook.Style = "true_colour",
    max_px: int = PREVIEW_PX,
) -> str:
    """Draw an image as .png, or in linear light as .exr; a note of the bands that are shown and the exposure.

    exposure : factor of the light; by default the brightest pixels of a PNG are nearly white, and an EXR is as is.
    max_px   : the longer side of the picture at most; memory is of the picture's size, whatever the image's.
    Raises InputError for a name that ends otherwise and for false colour without the bands, and OutputError.
    """
    kind = output.suffix.lower()
    if kind not in {".png", ".exr"}:
        raise InputError(f"the picture {output} ends in '{output.suffix}'; allowed are .png and .exr")
    if output.resolve() == image.resolve():
        raise InputError(f"the picture {output} is the image itself; name another")
    info = rasters.describe(image)
    wavelengths = _good(info.wavelengths_um, info)
    matrix = quicklook.rgb_matrix(wavelengths, info.fwhm_um, style)
    used = quicklook.used_bands(matrix)
    light = quicklook.linear_rgb(_reflectance(info, used, info.scales, info.offsets, max_px), matrix[used])
    note = quicklook.rendering_note(wavelengths, matrix)
    if kind == ".exr":
        factor = 1.0 if exposure is None else exposure
        quicklook.write_exr(light * np.float32(factor), output)
    else:
        factor = quicklook.exposure_for(light) if exposure is None else exposure
        quicklook.write_png(quicklook.srgb(light, factor), output)
    return f"{note}; exposure {factor:.3g}"


def _good(wavelengths_um: tuple[float, ...] | None, image: rasters.RasterInfo) -> tuple[float, ...]:
    """Wavelengths of the bands; nan where they are unknown, or the band is marked as bad and not to be shown."""
    known = wavelengths_um or (float("nan"),) * image.bands
    bad = image.bad_bands or (False,) * image.bands
    return tuple(float("nan") if is_bad else um for um, is_bad in zip(known, bad, strict=True))


def _reflectance(
    info: rasters.RasterInfo, bands: Sequence[int], scale: Sequence[float], offset: Sequence[float], max_px: int
) -> Iterator[Array]:
    """Reflectance factor of some bands (rows, cols), decimated, one after the other."""
    for group in _groups(bands):
        stored = rasters.read_decimated(info, max_px, [band + 1 for band in group])
        for band, values in zip(group, stored, strict=True):
            yield values * np.float32(scale[band]) + np.float32(offset[band])


def _groups(bands: Sequence[int]) -> Iterable[Sequence[int]]:
    return (bands[first : first + BANDS_AT_ONCE] for first in range(0, len(bands), BANDS_AT_ONCE))
