"""What is known of a scene before its pixels are read: every input opened, checked and understood."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from tscorr import config, publish, rasters
from tscorr.correction import Rules, Stored, check_ratio
from tscorr.errors import ConfigError, InputError, TscorrError
from tscorr.grid import Grid
from tscorr.materials import BandParameters, Material, find
from tscorr.scene.bands import at_bands, rules_of, stored_of, wavelengths_of
from tscorr.scene.directions import Seen, close_all, obs_file, sun_of, view_of
from tscorr.sensor import View
from tscorr.sun import Sun

Array = NDArray[Any]
P = ParamSpec("P")
T = TypeVar("T")

Describe = Callable[[str | Path], rasters.RasterInfo]
"""the header of a raster: `rasters.describe`, or one that describes once what the scenes of a batch share"""

LOWEST_M, HIGHEST_M = -1000.0, 10000.0
"""no ground is, and no roof"""
HEIGHT_WINDOWS, HEIGHT_WINDOW_PX = 6, 256
"""the coarse look at a large surface model: windows a side, and their side"""
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
    confidence: rasters.RasterInfo | None
    """how sure the class of each pixel is"""
    materials: tuple[tuple[Material, BandParameters, Rules], ...]
    rows: dict[int, int]
    """row of the corrector for each class of the class map"""
    stored: Stored
    sun: Sun
    seen: Seen
    """the view, and the files that it is read from"""
    surface_files: tuple[rasters.RasterInfo, ...]
    wavelengths_um: tuple[float, ...] | None
    ground_level_m: float
    """middle height of the surface, from a coarse look"""
    only: tuple[str, ...] = ()
    """the materials that a run is restricted to; empty for all"""
    identities: Mapping[str, Any] = field(default_factory=dict)
    """size and time of each of the files watched, when the scene was planned"""

    @property
    def grid(self) -> Grid:
        """The grid of the image, which everything is laid over."""
        return self.image.grid

    @property
    def view(self) -> View:
        """How the scene was seen."""
        return self.seen.view

    def close(self) -> None:
        """Close the files of the view; they are opened again when they are needed."""
        close_all(self.seen.layers)

    @property
    def _rasters(self) -> list[rasters.RasterInfo]:
        infos = [self.image, self.class_map, *self.surface_files]
        return infos if self.confidence is None else [*infos, self.confidence]

    @property
    def headers(self) -> list[tuple[Any, ...]]:
        """What the headers of the rasters say of their values and their place, in whatever file they say it."""
        return [
            (info.grid, info.dtype, info.nodata, info.scales, info.offsets, info.names, info.wavelengths_um)
            for info in self._rasters
        ]

    @property
    def watched(self) -> list[Path]:
        """Every file that the result's values depend on.

        Not the libraries, of which the materials are known, nor what other programs write beside a raster when they
        show it: the headers hold what matters of that.
        """
        shown = (".aux.xml", ".ovr")
        libraries = {Path(path) for path in self.config.materials.library}
        return [path for path in self.inputs if path not in libraries and not path.name.endswith(shown)]

    @property
    def inputs(self) -> list[Path]:
        """Every file that the result depends on."""
        files = [file for info in self._rasters for file in info.files]
        if self.settings.truth is not None:
            files += [Path(self.settings.truth.diffuse), Path(self.settings.truth.sunlit)]
        return [*files, *self.seen.files, *map(Path, self.config.materials.library)]

    @property
    def good_bands(self) -> list[int]:
        """Places of the bands that the image does not mark as bad."""
        bad = self.image.bad_bands or (False,) * self.image.bands
        return [band for band, is_bad in enumerate(bad) if not is_bad]

    @property
    def bad_names(self) -> list[str]:
        """Names of the bands that the image marks as bad: they are left as they are."""
        return [name for band, name in enumerate(self.image.names) if band not in self.good_bands]

    @property
    def heights_file(self) -> rasters.RasterInfo | None:
        """The raster of heights, if the surface has one."""
        return next((info for info in self.surface_files if info.bands == 1), None)

    def heights(self, margin: int) -> rasters.Reader | None:
        """The heights on the image's grid and so many pixels beyond, nan where void, if the surface has any. [m]"""
        info = self.heights_file
        if info is None:
            return None
        return rasters.Reader(
            info, self.grid, resampling=Resampling.bilinear, fill=float("nan"), margin=margin, scaled=True
        )

    def classes(self) -> rasters.Reader:
        """The class map on the image's grid; a value that no material has where it does not reach."""
        limits = np.iinfo(self.class_map.dtype)
        unused = next(value for value in range(limits.max, limits.min - 1, -1) if value not in self.rows)
        return rasters.Reader(self.class_map, self.grid, fill=unused)

    @property
    def tally_stride(self) -> int:
        """Histograms are of every so many rows."""
        rows, cols = self.image.shape
        return max(1, round(rows * cols / TALLY_PIXELS))


def plan_scene(
    settings: config.Scene,
    whole: config.Config,
    library: dict[str, Material],
    only: Sequence[str] = (),
    describe: Describe = rasters.describe,
) -> Scene:
    """Check every input of a scene and compute what does not depend on pixels.

    library  : materials by name.
    only     : if given, the materials to correct; the others are treated as not enabled.
    describe : of class map, confidence and surface.
    Raises ConfigError, MaterialError or InputError with all that is wrong, one thing a line.
    """
    checks = Checks()
    image = checks(_image, settings)
    if image is None:  # the others cannot be laid over it, but some may be missing, too
        for path in config.paths_of(settings):
            checks(_check_exists, path)
        checks.settle()
    class_map = checks(_class_map, settings, whole, image, describe)
    confidence = checks(_confidence, settings, image, describe)
    checks(_check_truth, settings.truth, image)
    stored = checks(stored_of, settings, whole.correction, image)
    wavelengths = checks(wavelengths_of, settings, image)
    seen = checks(view_of, settings.view, image)
    surface_files = checks(_surface_files, settings.surface, image, describe)
    checks.settle()
    checks(_check_difference, whole, image, stored)
    names = list(dict.fromkeys(whole.materials.classes.values()))
    materials = tuple(
        (
            find(name, library),
            checks(at_bands, find(name, library), wavelengths, image),
            checks(rules_of, name, settings, whole, stored, image, only),
        )
        for name in names
    )
    for surface, _, rules in materials:
        if rules is not None and rules.method == "ratio" and rules.enabled and surface.has_peak:
            checks(check_ratio, surface, wavelengths, image.bands)
    ground_level, highest = checks(_heights, settings.surface, surface_files) or (0.0, 0.0)
    checks(seen.view.check, image.grid, highest)
    sun = checks(sun_of, settings.sun, seen, image, ground_level)
    checks.settle()
    scene = Scene(
        name=settings.name or image.path.stem,
        settings=settings,
        config=whole,
        image=image,
        class_map=class_map,
        confidence=confidence,
        materials=materials,
        rows={value: names.index(name) + 1 for value, name in whole.materials.classes.items()},
        stored=stored,
        sun=sun,
        seen=seen,
        surface_files=surface_files,
        wavelengths_um=wavelengths,
        ground_level_m=ground_level,
        only=tuple(only),
    )
    return replace(scene, identities=publish.identities(scene.watched))


class Checks:
    """Checks that do not need each other: all are made before what they found is raised."""

    def __init__(self) -> None:
        self._errors: list[TscorrError] = []

    def __call__(self, check: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What a check returns; where it fails None, which nobody uses: `settle` comes first."""
        try:
            return check(*args, **kwargs)
        except TscorrError as error:
            self._errors.append(error)
            return cast("T", None)

    def settle(self) -> None:
        """Raise what was found, if anything was."""
        if self._errors:
            kinds = {type(error) for error in self._errors}
            kind = kinds.pop() if len(kinds) == 1 else InputError
            raise kind("\n".join(dict.fromkeys(map(str, self._errors))))


def _check_difference(whole: config.Config, image: rasters.RasterInfo, stored: Stored) -> None:
    """The image less what was removed must hold the same nodata as the image."""
    if whole.output.corrected == "vrt" and not rasters.expressible(image, stored.nodata):
        raise ConfigError(
            f"output.corrected = 'vrt' cannot keep the nodata value {stored.nodata:g} of the floating-point image "
            f"{image.path}: what is removed may have that value too; allowed is 'file'"
        )


def _check_exists(path: Path) -> None:
    if not path.exists():
        raise InputError(f"{path} does not exist")


def _image(settings: config.Scene) -> rasters.RasterInfo:
    image = rasters.describe(settings.image)
    if image.dtype.name not in rasters.IMAGE_TYPES:
        allowed = ", ".join(rasters.IMAGE_TYPES)
        raise InputError(f"the image {image.path} holds {image.dtype} values; allowed are {allowed}")
    if image.bad_bands and all(image.bad_bands):
        raise InputError(f"the image {image.path} marks every band as bad; allowed is bbl = 1 for at least one")
    return image


def _confidence(settings: config.Scene, image: rasters.RasterInfo, describe: Describe) -> rasters.RasterInfo | None:
    """The raster of class confidence, if there is one; a coarse look tells per cent from shares."""
    if settings.class_confidence is None:
        return None
    confidence = _single_band(settings.class_confidence, image, describe, "the class confidence")
    shares = rasters.read_decimated(confidence, 256) * confidence.scales[0] + confidence.offsets[0]
    shares = shares[np.isfinite(shares)]
    if shares.size and not (shares.min() >= 0 and shares.max() <= 1 + 1e-6):
        raise InputError(
            f"the class confidence {confidence.path} holds values from {shares.min():.6g} to {shares.max():.6g}; "
            f"allowed are 0 to 1, after the scale of the file"
        )
    return confidence


def _class_map(
    settings: config.Scene, whole: config.Config, image: rasters.RasterInfo, describe: Describe
) -> rasters.RasterInfo:
    class_map = _single_band(settings.class_map, image, describe, "the class map")
    if class_map.dtype.kind not in "iu":
        raise InputError(f"the class map {class_map.path} holds {class_map.dtype} values; allowed are integers")
    limits = np.iinfo(class_map.dtype)
    for value in whole.materials.classes:
        if not limits.min <= value <= limits.max:
            raise InputError(
                f"[materials.classes] has the class {value}, but the class map {class_map.path} holds "
                f"{class_map.dtype} values; allowed are {limits.min} to {limits.max}"
            )
    if len(whole.materials.classes) > limits.max - limits.min:
        raise ConfigError(
            f"[materials.classes] names every {class_map.dtype} value that the class map {class_map.path} can hold; "
            f"allowed is one less, so that one can stand for no class"
        )
    if class_map.nodata in whole.materials.classes:
        raise InputError(
            f"the class map {class_map.path} has the nodata value {class_map.nodata:g}, which is also a class of "
            f"[materials.classes]; allowed is one of the two"
        )
    return class_map


def _single_band(path: str, image: rasters.RasterInfo, describe: Describe, what: str) -> rasters.RasterInfo:
    """A raster of one band that shares ground with the image."""
    raster = describe(path)
    if raster.bands != 1:
        raise InputError(f"{what} {raster.path} has {raster.bands} bands; allowed is one")
    if raster.grid != image.grid:
        rasters.check_overlap(raster, image, what)
    return raster


def _check_truth(truth: config.Truth | None, image: rasters.RasterInfo) -> None:
    """The rasters of the truth must have the pixels of the image, and its bands."""
    if truth is None:
        return
    for path, bands in ((truth.diffuse, image.bands), (truth.sunlit, 1)):
        info = rasters.describe(path)
        if (info.bands, *info.shape) != (bands, *image.shape):
            raise InputError(
                f"the truth {info.path} has {info.bands} bands of {info.shape}; allowed are {bands} of {image.shape}, "
                f"as the image has them"
            )


def _surface_files(settings: Any, image: rasters.RasterInfo, describe: Describe) -> tuple[rasters.RasterInfo, ...]:
    """The rasters of a surface, checked: heights first if there are any."""
    return tuple(_each_surface_file(settings, image, describe))


def _each_surface_file(settings: Any, image: rasters.RasterInfo, describe: Describe) -> Iterator[rasters.RasterInfo]:
    if isinstance(settings, config.FlatSettings):
        return
    heights = settings.path if isinstance(settings, config.DsmSettings) else settings.heights
    if heights is not None:
        dsm = describe(heights)
        if dsm.bands != 1:
            raise InputError(f"the surface model {dsm.path} has {dsm.bands} bands; allowed is one")
        rasters.check_metric(dsm, "the surface model")
        rasters.check_true_lengths(image, "with a surface model,")
        rasters.check_overlap(dsm, image, "the surface model")
        if not image.grid.is_north_up:
            raise InputError(f"the image {image.path} is turned on its grid; with a surface model, north must be up")
        yield dsm
    if isinstance(settings, config.ObsSurfaceSettings):
        yield obs_file(settings.path, image, with_slope=True)
    if isinstance(settings, config.NormalsSettings):
        normals = describe(settings.path)
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
    status = dsm.path.stat()
    return _coarse_heights(dsm.path, (status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=64)  # a surface model serves all the scenes of a batch
def _coarse_heights(path: Path, version: tuple[int, int]) -> tuple[float, float]:
    """Middle and highest height of one version of a file: its size and time of change. [m]"""
    del version
    heights = rasters.read_samples(rasters.describe(path), HEIGHT_WINDOWS, HEIGHT_WINDOW_PX)
    if not heights.size:
        raise InputError(f"the surface model {path} holds no heights at all")
    lowest, highest = float(heights.min()), float(heights.max())
    for extreme in (lowest, highest):
        if not LOWEST_M <= extreme <= HIGHEST_M:
            raise InputError(
                f"the surface model {path} has a height of {extreme:g} m; allowed are {LOWEST_M:g} to {HIGHEST_M:g}. "
                f"If that stands for no height, the file must say so: nodata = {extreme:g}"
            )
    return float(np.median(heights)), highest
