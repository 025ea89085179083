"""What can be and is hardly meant: warnings before work starts."""

import logging
from collections.abc import Sequence

from tscorr import config, rasters
from tscorr.errors import TscorrError
from tscorr.scene.plan import Scene

log = logging.getLogger("tscorr")

TOO_BRIGHT = 1.5
"""a reflectance factor that half of an image does not exceed, whatever it shows"""
COVERED = 0.98
SAMPLE_PX = 256
"""side of what is looked at in the middle of an image"""
YEARS = 1900, 2100
"""in which images are taken from the air, or will be"""


def warn(planned: Sequence[Scene]) -> None:
    """Say what is doubtful about scenes."""
    _of_missing_scales(planned)
    kinds = {(s.image.dtype, s.stored.scale, s.stored.offset, s.stored.saturation): s for s in reversed(planned)}
    for scene in kinds.values():
        _of_values(scene)  # one image of each kind: what is wrong with it mostly is with all
    for scene in planned:
        _of_time(scene)
        _of_coverage(scene)
        _of_heights(scene)
    _of_normals(planned)


def _of_missing_scales(planned: Sequence[Scene]) -> None:
    """Of whole numbers without a scale, as many images hold them, next to nothing would be removed."""
    doubtful = [scene.image for scene in planned if _lacks_scale(scene)]
    if doubtful:
        log.warning(
            "the image %s%s holds %s values and no scale, so that the least above 0 is 1: give scale = ..., %s "
            "stands for 1, or scale = 1.0 where that is right",
            doubtful[0].path,
            f", like {len(doubtful) - 1} more," if len(doubtful) > 1 else "",
            doubtful[0].dtype,
            "0.004 where 250" if doubtful[0].dtype.itemsize == 1 else "0.0001 where 10000",
        )


def _lacks_scale(scene: Scene) -> bool:
    """Whether nobody says what the whole numbers of the image stand for."""
    return scene.image.dtype.kind in "iu" and scene.settings.scale is None and set(scene.image.scales) == {1.0}


def _of_time(scene: Scene) -> None:
    """A year with a digit too few."""
    time = scene.sun.time
    if time is not None and not YEARS[0] <= time.year <= YEARS[1]:
        log.warning("scene '%s': the sun is that of the year %d; is that meant?", scene.name, time.year)


def _of_values(scene: Scene) -> None:
    """Per cent, radiances or counts in place of reflectance factors; `saturation` in place of a stored value."""
    image, stored = scene.image, scene.stored
    as_vrt = scene.config.output.corrected == "vrt"  # then the image is read only where it must be
    if as_vrt or (image.bad_bands and image.bad_bands[0]):
        return
    try:
        middle = rasters.middle_value(image, SAMPLE_PX, stored.nodata)
    except (TscorrError, OSError):  # its scene will tell
        return
    if stored.saturation is not None and middle >= stored.saturation[0]:
        log.warning(
            "half of the middle of the image %s is saturated, with stored values of %g and more: saturation is one of "
            "them, not a reflectance factor",
            image.path,
            stored.saturation[0],
        )
    factor = middle * stored.scale[0] + stored.offset[0]
    if factor > TOO_BRIGHT and not _lacks_scale(scene):
        log.warning(
            "the image %s shows reflectance factors about %.3g, and 1 is white: if these are per cent or counts, give "
            "scale = ...; radiances have to be made reflectances first",
            image.path,
            factor,
        )


def _of_heights(scene: Scene) -> None:
    """Normals without the heights that cast shadows."""
    surface = scene.settings.surface
    if scene.settings.shadows and isinstance(surface, config.NormalsSettings) and surface.heights is None:
        log.warning("scene '%s': normals without heights show no cast shadows: give heights = ...", scene.name)


def _of_normals(planned: Sequence[Scene]) -> None:
    """Normals into the ground."""
    given = [scene for scene in planned if isinstance(scene.settings.surface, config.NormalsSettings)]
    files = {scene.surface_files[-1].path: scene.surface_files[-1] for scene in given}
    for path, normals in files.items():
        try:
            up = rasters.middle_value(normals, SAMPLE_PX, normals.nodata, band=3)
        except (TscorrError, OSError):  # its scene will tell
            continue
        if up < 0:
            log.warning(
                "half of the middle of the normals %s points down, where no light comes from: the bands are east, "
                "north, up, away from the ground",
                path,
            )


def _of_coverage(scene: Scene) -> None:
    """A surface model or a class map of a part of the image."""
    found_here = isinstance(scene.settings.surface, config.DsmSettings)  # the normals
    level = "is taken to be level, and flagged NORMAL_UNRELIABLE" if found_here else "shows no cast shadows"
    for raster, name, rest in (
        (scene.heights_file, "surface model", level),
        (scene.class_map, "class map", "has no material"),
    ):
        share = 1.0 if raster is None else rasters.covered_share(raster, scene.image)
        if raster is not None and share < COVERED:
            log.warning(
                "the %s %s covers %.0f %% of the image %s: the rest %s",
                name,
                raster.path,
                100 * share,
                scene.image.path,
                rest,
            )
