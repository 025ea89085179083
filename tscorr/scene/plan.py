"""What is known of a scene before its pixels are read: every input opened, checked and understood."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS

from tscorr import config, rasters
from tscorr.correction import NEGLIGIBLE_REFLECTANCE, Rules, Stored
from tscorr.errors import ConfigError, InputError, MaterialError
from tscorr.grid import Grid, reproject
from tscorr.materials import BandParameters, Material, find
from tscorr.sensor import ConstantView, FrameView, LineView, View, read_trajectory
from tscorr.sun import SunField, given_sun, sun_at

Array = NDArray[Any]

TALLY_PIXELS = 4e6
"""histograms are of every n-th row where an image has more pixels than this; counts are always of all"""


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything that is known of a scene before its pixels are read; made by `plan_scene`."""

    name: str
    settings: config.Scene
    config: config.Config
    image: rasters.RasterInfo
    class_map: rasters.RasterInfo
    materials: tuple[tuple[Material, BandParameters, Rules], ...]
    rows: dict[int, int]
    """row of the corrector for each class of the class map"""
    stored: Stored
    sun: SunField
    view: View
    surface_files: tuple[rasters.RasterInfo, ...]
    wavelengths_um: tuple[float, ...] | None
    ground_level_m: float
    """middle height of the surface, from a coarse look"""

    @property
    def grid(self) -> Grid:
        """The grid of the image, which everything is laid over."""
        return self.image.grid

    @property
    def inputs(self) -> list[Path]:
        """Every file that the result depends on."""
        files = [self.image.path, self.class_map.path, *(info.path for info in self.surface_files)]
        if isinstance(self.settings.view, config.LineViewSettings):
            files.append(Path(self.settings.view.trajectory))
        return [*files, *map(Path, self.config.materials.library)]

    @property
    def heights_file(self) -> rasters.RasterInfo | None:
        """The raster of heights, if the surface has one."""
        return next((info for info in self.surface_files if info.bands == 1), None)

    @property
    def tally_stride(self) -> int:
        """Histograms are of every so many rows."""
        rows, cols = self.image.shape
        return max(1, round(rows * cols / TALLY_PIXELS))


def plan_scene(
    settings: config.Scene, whole: config.Config, library: dict[str, Material], only: Sequence[str] = ()
) -> Scene:
    """Check every input of a scene and compute what does not depend on pixels.

    library : materials by name.
    only    : if given, the materials to correct; the others are treated as not enabled.
    Raises ConfigError or InputError with the first thing that is wrong.
    """
    image = rasters.describe(settings.image)
    if image.dtype.name not in rasters.IMAGE_TYPES:
        allowed = ", ".join(rasters.IMAGE_TYPES)
        raise InputError(f"the image {image.path} holds {image.dtype} values; allowed are {allowed}")
    class_map = _class_map(settings, image)
    stored = _stored(settings, image)
    names = list(dict.fromkeys(whole.materials.classes.values()))
    wavelengths = _wavelengths(settings, image)
    materials = tuple(
        (
            find(name, library),
            _at_bands(find(name, library), wavelengths, image),
            rules_of(name, settings, whole, stored, image, only),
        )
        for name in names
    )
    sun = _sun(settings, image)
    view = _view(settings.view, image.grid)
    surface_files = tuple(_surface_files(settings.surface, image))
    ground_level, highest = _heights(settings.surface, surface_files)
    view.check(image.grid, highest)
    return Scene(
        name=settings.name or image.path.stem,
        settings=settings,
        config=whole,
        image=image,
        class_map=class_map,
        materials=materials,
        rows={value: names.index(name) + 1 for value, name in whole.materials.classes.items()},
        stored=stored,
        sun=sun,
        view=view,
        surface_files=surface_files,
        wavelengths_um=wavelengths,
        ground_level_m=ground_level,
    )


def _class_map(settings: config.Scene, image: rasters.RasterInfo) -> rasters.RasterInfo:
    class_map = rasters.describe(settings.class_map)
    if class_map.dtype.kind not in "iu":
        raise InputError(f"the class map {class_map.path} holds {class_map.dtype} values; allowed are integers")
    if class_map.grid != image.grid:
        rasters.check_overlap(class_map, image, "the class map")
    return class_map


def _at_bands(surface: Material, wavelengths: tuple[float, ...] | None, image: rasters.RasterInfo) -> BandParameters:
    try:
        return surface.at(wavelengths, image.bands)
    except MaterialError as error:
        raise MaterialError(f"{error}; image {image.path}") from None


def _wavelengths(settings: config.Scene, image: rasters.RasterInfo) -> tuple[float, ...] | None:
    given = settings.wavelength_um
    if given is None:
        return image.wavelengths_um
    return _per_band(given, image, "wavelength_um")


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


def _stored(settings: config.Scene, image: rasters.RasterInfo) -> Stored:
    scale = image.scales if settings.scale is None else _per_band(settings.scale, image, "scale")
    offset = image.offsets if settings.offset is None else _per_band(settings.offset, image, "offset")
    if any(value == 0 for value in scale):
        raise InputError(f"the image {image.path} has the scale 0; allowed is any other: give scale = ...")
    to_factor = np.pi if settings.quantity == "brdf" else 1.0
    saturation = settings.saturation
    return Stored(
        dtype=image.dtype,
        scale=tuple(value * to_factor for value in scale),
        offset=tuple(value * to_factor for value in offset),
        nodata=image.nodata if settings.nodata is None else settings.nodata,
        saturation=None if saturation is None else _per_band(saturation, image, "saturation"),
    )


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
    if any(not 0 <= fraction <= 1 for fraction in fractions):
        raise ConfigError(f"direct_fraction = {list(fractions)}; allowed are shares from 0 to 1")
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
        enabled=values["enabled"] and (not only or name in only),
    )


def _sun(settings: config.Scene, image: rasters.RasterInfo) -> SunField:
    sun = settings.sun
    if sun is None:
        raise ConfigError(f"the image {image.path} has no sun: give sun = {{ time = ... }} or its angles")
    if sun.time is not None:
        return sun_at(image.grid, sun.time)
    assert sun.zenith_deg is not None
    assert sun.azimuth_deg is not None
    return given_sun(image.grid, sun.zenith_deg, sun.azimuth_deg)


def _view(settings: Any, grid: Grid) -> View:
    if isinstance(settings, config.ConstantViewSettings):
        return ConstantView(settings.zenith_deg, settings.azimuth_deg)
    if isinstance(settings, config.FrameViewSettings):
        x, y, z = settings.position
        if settings.crs is not None:
            x, y = map(float, _to_grid(settings.crs, grid)(x, y))
        return FrameView((x, y, z + settings.height_offset_m))
    to_grid = None if settings.crs is None else _to_grid(settings.crs, grid)
    return LineView(read_trajectory(Path(settings.trajectory), grid, to_grid, settings.height_offset_m))


def _to_grid(crs: str, grid: Grid) -> Callable[[Any, Any], tuple[Array, Array]]:
    try:
        source = CRS.from_user_input(crs)
    except Exception as error:  # noqa: BLE001 - rasterio raises many kinds
        raise ConfigError(f"crs = '{crs}' of a view is not known: {error}") from None
    if grid.crs is None:
        raise InputError(f"the image has no CRS; positions in {crs} cannot be laid over it")
    return lambda x, y: reproject(source, grid.crs, x, y)


def _surface_files(settings: Any, image: rasters.RasterInfo) -> Iterator[rasters.RasterInfo]:
    """The rasters of a surface, checked: heights first if there are any."""
    if isinstance(settings, config.FlatSettings):
        return
    heights = settings.path if isinstance(settings, config.DsmSettings) else settings.heights
    if heights is not None:
        dsm = rasters.describe(heights)
        if dsm.bands != 1:
            raise InputError(f"the surface model {dsm.path} has {dsm.bands} bands; allowed is one")
        rasters.check_metric(dsm, "the surface model")
        rasters.check_metric(image, "the image")
        rasters.check_overlap(dsm, image, "the surface model")
        if not image.grid.is_north_up:
            raise InputError(f"the image {image.path} is turned on its grid; with a surface model, north must be up")
        yield dsm
    if isinstance(settings, config.NormalsSettings):
        normals = rasters.describe(settings.path)
        if normals.bands != 3:
            raise InputError(f"the normals {normals.path} have {normals.bands} bands; allowed are east, north, up")
        rasters.check_overlap(normals, image, "the normals")
        yield normals


def _heights(settings: Any, files: tuple[rasters.RasterInfo, ...]) -> tuple[float, float]:
    """Middle and highest height of the surface, as a coarse look shows them. [m]"""
    if isinstance(settings, config.FlatSettings):
        return settings.height_m, settings.height_m
    dsm = next((info for info in files if info.bands == 1), None)
    if dsm is None:
        return 0.0, 0.0
    heights = rasters.read_decimated(dsm, 256)
    heights = heights[np.isfinite(heights)]
    if not heights.size:
        raise InputError(f"the surface model {dsm.path} holds no heights at all")
    return float(np.median(heights)), float(heights.max())
