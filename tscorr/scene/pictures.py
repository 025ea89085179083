"""Pictures of images: before and after the correction, and of one image alone."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from tscorr import quicklook, rasters
from tscorr.errors import InputError
from tscorr.grid import Block

if TYPE_CHECKING:
    from tscorr.scene.plan import Scene

Array = NDArray[Any]

PICTURE_PX = 768
"""the longer side of a panel"""
PREVIEW_PX = 2048
"""the longer side of a picture of one image, unless asked for otherwise"""
MOST_GATHERED = 8
"""bands of which before and after are kept beside the work: 5 MB each"""
BANDS_AT_ONCE = 8
"""bands of one file are read together: where they are stored together, each piece is then decoded once"""


class Lights:
    """Before and after of a scene, made small, gathered from its blocks: no file need be decoded for them again.

    Of a large image every so many rows count. Any thread may ask and add.
    """

    def __init__(self, scene: "Scene") -> None:
        self._stored = scene.stored
        self._bands = _shown(scene)
        shape, step = rasters.decimated(scene.image.shape, PICTURE_PX)
        self._stride = max(1, int(step) // rasters.LEAST_STEP)
        thinned = -(-scene.image.shape[0] // self._stride), scene.image.shape[1]
        self._before, self._after = (rasters.Means(thinned, shape, len(self._bands), counted=1) for _ in range(2))

    @classmethod
    def of(cls, scene: "Scene") -> Self | None:
        """None where no picture is asked for, the files are small and soon read again, or too many bands are shown."""
        return cls(scene) if _are_gathered(scene) else None

    def of_block(self, block: Block, image: Array) -> tuple[Array, Array]:
        """Sums over cells of the stored values of a block (bands, rows, cols), and of how many pixels they are."""
        thin, cells = self._thinned(block), self._before.cells
        rows = slice(-block.row % self._stride, None, self._stride)
        values = np.stack([image[band, rows] for band in self._bands])
        valid = self._stored.has_data(values)
        if valid.all():
            return cells.sums(thin, values), cells.sizes(thin)
        values[:, ~valid] = 0
        return cells.sums(thin, values), cells.sums(thin, valid[None])

    def add(self, block: Block, before: tuple[Array, Array], after: tuple[Array, Array]) -> None:
        """Add a block, as `of_block` saw it before and after the correction."""
        thin = self._thinned(block)
        self._before.add(thin, *before)
        self._after.add(thin, *after)

    def images(self, matrix: Array) -> tuple[Array, Array]:
        """Before and after in linear light (rows, cols, 3), nan without data; by a matrix of `rgb_matrix`."""
        scale, offset = np.array([self._stored.scale, self._stored.offset], np.float32)[:, self._bands]

        def light(means: rasters.Means) -> Array:
            layers = zip(means.values(), scale, offset, strict=True)
            return quicklook.linear_rgb((values * s + o for values, s, o in layers), matrix[self._bands])

        return light(self._before), light(self._after)

    def _thinned(self, block: Block) -> Block:
        """A block among the rows that count."""
        first, end = (-(-row // self._stride) for row in (block.row, block.row + block.height))
        return Block(first, block.col, end - first, block.width)


def lights_mb(scene: "Scene") -> float:
    """Memory that the lights of a scene take: sums of before and after, and counts."""
    (rows, cols), _ = rasters.decimated(scene.image.shape, PICTURE_PX)
    return 2 * (len(_shown(scene)) + 1) * 4 * rows * cols / 1e6 if _are_gathered(scene) else 0.0


def _are_gathered(scene: "Scene") -> bool:
    _, step = rasters.decimated(scene.image.shape, PICTURE_PX)
    wanted = scene.config.output.quicklook and step >= rasters.LEAST_STEP
    return wanted and len(_shown(scene)) <= MOST_GATHERED


def prepare_quicklook(scene: "Scene") -> None:
    """Have what the picture of a scene will need fetched while the scene is computed."""
    if scene.config.output.quicklook:
        quicklook.prepare(_good(scene.wavelengths_um, scene.image))


def draw_quicklook(
    scene: "Scene",
    folder: Path,
    results: Mapping[str, rasters.RasterInfo],
    lights: Lights | None = None,
    threads: int = 1,
) -> Path:
    """The picture of before, after and flags, of a scene that is being published.

    results : by product. lights : before and after, if they were gathered. threads : that may read them else.
    """
    wavelengths, matrix = _colours(scene)
    before, after = _read_lights(scene, matrix, results, threads) if lights is None else lights.images(matrix)
    path = folder / "quicklook.png"
    flag_file = results.get("flags")
    flags = np.zeros(before.shape[:2], np.uint16)
    if flag_file is not None:
        flags = rasters.read_decimated_flags(flag_file, PICTURE_PX)
    note = quicklook.rendering_note(wavelengths, matrix)
    quicklook.before_after(before, after, flags, path, title=scene.name, note=note)
    return path


def _shown(scene: "Scene") -> list[int]:
    """Bands that the picture of a scene shows."""
    return quicklook.shown_bands(_good(scene.wavelengths_um, scene.image))


def _colours(scene: "Scene") -> tuple[tuple[float, ...], Array]:
    """Wavelengths of the bands that can be shown, and what each adds to red, green and blue."""
    wavelengths = _good(scene.wavelengths_um, scene.image)
    return wavelengths, quicklook.rgb_matrix(wavelengths, scene.image.fwhm_um)


def _read_lights(
    scene: "Scene", matrix: Array, results: Mapping[str, rasters.RasterInfo], threads: int
) -> tuple[Array, Array]:
    """Before and after, from the files."""
    with ThreadPoolExecutor(threads) as readers:  # to decode them is most of the work
        images = scene.image, results.get("corrected", scene.image)
        before, after = readers.map(partial(_light, scene, matrix), images)
    return before, after


def _light(scene: "Scene", matrix: Array, info: rasters.RasterInfo) -> Array:
    """One image of a scene, made small, in linear light (rows, cols, 3)."""
    used = quicklook.used_bands(matrix)
    scale, offset = scene.stored.scale, scene.stored.offset
    return quicklook.linear_rgb(_reflectance(info, used, scale, offset, PICTURE_PX), matrix[used])


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
    if exposure is not None and not 0 < exposure < float("inf"):
        raise InputError(f"exposure = {exposure}; allowed is a number above 0")
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
