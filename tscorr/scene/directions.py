"""Where the sensor and the sun of a scene are, from the settings: every file opened and checked."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS

from tscorr import config, rasters
from tscorr.errors import ConfigError, InputError
from tscorr.grid import Grid, reproject
from tscorr.scene.laid import Band, LaidNumbers, LaidVectors
from tscorr.sensor import (
    OBS_BANDS,
    ConstantView,
    FrameView,
    LineView,
    MosaicView,
    Obs,
    RasterView,
    View,
    angle_vectors,
    check_angles,
    check_obs,
    check_obs_slope,
    read_cameras,
    read_trajectory,
)
from tscorr.sun import Sun, given_sun, sun_along, sun_at, sun_of_rasters

Array = NDArray[Any]

SAMPLES = 24
"""rasters of angles are looked at in SAMPLES x SAMPLES pixels before work starts"""


class Seen(NamedTuple):
    """A view and what it is read from.

    sun    : the sun's direction in the same files, if they hold it.
    layers : open rasters, to be closed after use.
    """

    view: View
    files: tuple[Path, ...] = ()
    layers: tuple[LaidVectors | LaidNumbers, ...] = ()
    sun: LaidVectors | None = None


def view_of(settings: Any, image: rasters.RasterInfo) -> Seen:
    """The view of a scene; raises ConfigError or InputError with the first thing that is wrong."""
    grid = image.grid
    with_positions = config.FrameViewSettings | config.LineViewSettings | config.MosaicViewSettings
    if isinstance(settings, with_positions) and grid.crs is not None:
        rasters.check_true_lengths(image, "seen from positions,")
    if isinstance(settings, config.ConstantViewSettings):
        return Seen(ConstantView(settings.zenith_deg, settings.azimuth_deg))
    if isinstance(settings, config.FrameViewSettings):
        x, y, z = settings.position
        if settings.crs is not None:
            x, y = map(float, _to_grid(settings.crs, grid)(x, y))
        return Seen(FrameView((x, y, z + settings.height_offset_m)))
    if isinstance(settings, config.AnglesViewSettings):
        return _angles(settings, image)
    if isinstance(settings, config.ObsViewSettings):
        return _obs(settings, image)
    to_grid = None if settings.crs is None else _to_grid(settings.crs, grid)
    if isinstance(settings, config.MosaicViewSettings):
        return _mosaic(settings, image, to_grid)
    path = Path(settings.trajectory)
    trajectory = read_trajectory(path, grid, to_grid, settings.height_offset_m)
    return Seen(LineView(trajectory.between(settings.start, settings.end)), (path,))


def sun_of(settings: config.Sun | None, seen: Seen, image: rasters.RasterInfo, ground_level_m: float) -> Sun:
    """The sun of a scene: as given, else from the OBS file, else at the times of the trajectory."""
    if settings is not None and settings.time is not None:
        return sun_at(image.grid, settings.time)
    if settings is not None:
        assert settings.zenith_deg is not None
        assert settings.azimuth_deg is not None
        return given_sun(image.grid, settings.zenith_deg, settings.azimuth_deg)
    if seen.sun is not None:
        return sun_of_rasters(image.grid, partial(seen.sun, image.grid))
    if isinstance(seen.view, LineView):
        first, middle, last = seen.view.span(image.grid, ground_level_m)
        start = seen.view.trajectory.start
        return sun_along(image.grid, start, first_s=first, last_s=last, middle_s=middle)
    raise ConfigError(f"the image {image.path} has no sun: give sun = {{ time = ... }} or its angles")


def obs_normals(info: rasters.RasterInfo) -> LaidVectors:
    """Surface normals from slope and aspect of an OBS file."""
    return LaidVectors(_bands(info, "slope", "aspect"), _vectors_of)


def obs_file(path: str, image: rasters.RasterInfo, *, with_slope: bool = False) -> rasters.RasterInfo:
    """An OBS file, checked: its bands, and that its angles are consistent."""
    info = rasters.describe(path)
    if info.bands < len(OBS_BANDS) - 1:
        raise InputError(
            f"the OBS file {info.path} has {info.bands} bands; allowed are {len(OBS_BANDS)} or more: "
            f"{', '.join(OBS_BANDS)}"
        )
    _check_place(info, image, "the OBS file")
    values = LaidVectors([Band(info, index) for index in range(1, len(OBS_BANDS))], _vectors_of)
    obs = Obs.of(np.array(values.sample(SAMPLES)))
    values.close()
    check_obs(obs, str(info.path))
    if with_slope:
        check_obs_slope(obs, str(info.path))
    return info


def _obs(settings: config.ObsViewSettings, image: rasters.RasterInfo) -> Seen:
    info = obs_file(settings.path, image)
    view = LaidVectors(_bands(info, "to-sensor zenith", "to-sensor azimuth"), _vectors_of)
    sun = LaidVectors(_bands(info, "to-sun zenith", "to-sun azimuth"), _vectors_of)
    return Seen(RasterView(view), (info.path,), (view, sun), sun)


def _bands(info: rasters.RasterInfo, *names: str) -> list[Band]:
    return [Band(info, OBS_BANDS.index(name) + 1) for name in names]


def _vectors_of(zenith_deg: Array, azimuth_deg: Array) -> Array:
    return angle_vectors(zenith_deg, azimuth_deg)


def _angles(settings: config.AnglesViewSettings, image: rasters.RasterInfo) -> Seen:
    infos = [rasters.describe(path) for path in (settings.zenith, settings.azimuth)]
    for info in infos:
        if info.bands != 1:
            raise InputError(f"the angles {info.path} have {info.bands} bands; allowed is one")
        _check_place(info, image, "the angles")
    zenith, azimuth = infos
    if zenith.grid != azimuth.grid:
        raise InputError(f"{zenith.path} and {azimuth.path} have different grids; allowed is one for both")
    bands = [
        Band(info, 1, info.scales[0], info.offsets[0]) if settings.scale is None else Band(info, 1, settings.scale)
        for info in infos
    ]
    view = LaidVectors(bands, _vectors_of)
    where = f"{zenith.path} and {azimuth.path}"
    zenith_deg, azimuth_deg = view.sample(SAMPLES)
    check_angles(zenith_deg, azimuth_deg, where, sure_of_unit=settings.scale is not None)
    return Seen(RasterView(view), (zenith.path, azimuth.path), (view,))


def _mosaic(
    settings: config.MosaicViewSettings,
    image: rasters.RasterInfo,
    to_grid: Callable[[Any, Any], tuple[Array, Array]] | None,
) -> Seen:
    path = Path(settings.cameras)
    cameras = read_cameras(path, to_grid, settings.height_offset_m)
    info = rasters.describe(settings.index)
    if info.bands != 1 or info.dtype.kind not in "iu":
        raise InputError(f"the index {info.path} has {info.bands} bands of {info.dtype}; allowed is one of integers")
    _check_place(info, image, "the index")
    index = LaidNumbers(info, none=int(cameras.ids[0]) - 1)
    unknown = set(index.sample(SAMPLES).tolist()) - set(cameras.ids.tolist()) - {0}
    if unknown:
        raise InputError(
            f"the index {info.path} holds camera {min(unknown)}; {path} has {cameras.ids.size} cameras, from "
            f"{cameras.ids[0]} to {cameras.ids[-1]}"
        )
    return Seen(MosaicView(cameras, index), (info.path, path), (index,))


def _check_place(info: rasters.RasterInfo, image: rasters.RasterInfo, what: str) -> None:
    if info.grid != image.grid:
        rasters.check_overlap(info, image, what)


def _to_grid(crs: str, grid: Grid) -> Callable[[Any, Any], tuple[Array, Array]]:
    try:
        with rasterio.Env():  # PROJ's own message goes to the log, not to the terminal
            source = CRS.from_user_input(crs)
    except Exception as error:  # noqa: BLE001 - rasterio raises many kinds
        raise ConfigError(f"crs = '{crs}' of a view is not known: {error}") from None
    if grid.crs is None:
        raise InputError(f"the image has no CRS; positions in {crs} cannot be laid over it")
    return lambda x, y: reproject(source, grid.crs, x, y)


def close_all(layers: Iterable[LaidVectors | LaidNumbers]) -> None:
    """Close the files of views."""
    for layer in layers:
        layer.close()
