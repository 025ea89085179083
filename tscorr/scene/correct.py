"""Correct a scene and publish its folder: rasters, picture, report, settings, manifest."""

import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import tomli_w
from affine import Affine
from numpy.typing import NDArray

from tscorr import __version__, publish, rasters, stac
from tscorr.angles import relative_azimuth, true_azimuth, zenith_azimuth
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, longitude_latitude
from tscorr.report import SceneFacts, page, summary, write_json
from tscorr.scene.cutting import threads_of
from tscorr.scene.memory import give_back, peak_rss_mb
from tscorr.scene.pictures import PICTURE_PX, Lights, draw_quicklook, prepare_quicklook
from tscorr.scene.plan import Scene
from tscorr.scene.products import written_products
from tscorr.scene.run import Pipeline, Progress, silent
from tscorr.scene.styles import flag_style
from tscorr.scene.sums import Sums
from tscorr.scene.truth import coverage, residual_glare
from tscorr.sensor import FrameView
from tscorr.sun import solar_path

Array = NDArray[Any]

VIEW_SAMPLES = 48
"""the report samples the view directions on a grid of at most this many points a side"""
RASTER_SAMPLES = 20


def settings_of(scene: Scene) -> dict[str, Any]:
    """The settings of one scene, defaults filled in: what settings.toml holds."""
    values = scene.config.model_dump(mode="json", exclude_none=True, exclude={"scenes"})
    values["scenes"] = [scene.settings.model_dump(mode="json", exclude_none=True)]
    values["output"].pop("directory")
    return values


def resume_key(scene: Scene) -> str:
    """Digest of all that a scene's folder depends on: settings, inputs, materials and version, not the machine.

    Which of the products were written is not in it: the manifest lists them.
    """
    settings = settings_of(scene)
    for name in ("run", "title"):
        settings.pop(name)
    for name in ("products", "quicklook"):
        settings["output"].pop(name)
    settings["materials"].pop("library")  # what is used of it stands in the materials
    materials = [repr((replace(surface, file=""), rules)) for surface, _, rules in scene.materials]
    headers = [repr(header) for header in scene.headers]
    content = {"settings": settings, "materials": materials, "headers": headers}
    return publish.key(content, scene.identities, __version__)


def products_of(scene: Scene) -> list[str]:
    """What a scene's result holds beside its report."""
    output = scene.config.output
    return [*output.products, *(["quicklook"] if output.quicklook else [])]


def is_current(scene: Scene) -> bool:
    """Whether the published result of a scene is what would be computed, or more."""
    return publish.is_current(target_of(scene), resume_key(scene), products_of(scene))


def check_unchanged(scene: Scene) -> None:
    """Raise InputError where an input is another file than when the scene was planned."""
    now = publish.identities(scene.watched)
    for path, identity in scene.identities.items():
        if now.get(path) != identity:
            raise InputError(f"the input {path} has changed while the scene was computed; run again once it is whole")


def target_of(scene: Scene) -> Path:
    """The folder that a scene is published in."""
    return Path(scene.config.output.directory) / scene.name


def correct_scene(scene: Scene, progress: Progress = silent) -> dict[str, Any]:
    """Correct a scene and publish its folder; the content of its report.json."""
    started, algorithm = time.perf_counter(), scene.config.output.hash
    with (
        closing(scene),
        publish.EarlyHashes(scene.inputs, algorithm) as hashes,
        publish.Publication(target_of(scene), algorithm=algorithm, early=threads_of(scene) > 1) as publication,
    ):
        prepare_quicklook(scene)
        pipeline = Pipeline(scene, publication.folder, final=publication.hash_early)
        sums, lights, written = pipeline.run(progress), pipeline.lights, pipeline.written
        del pipeline  # and the heights that it keeps
        give_back()
        return finish(scene, publication, hashes, sums, time.perf_counter() - started, lights, written)


def finish(
    scene: Scene,
    publication: publish.Publication,
    hashes: publish.EarlyHashes,
    sums: Sums,
    wall_s: float,
    lights: Lights | None = None,
    written: Mapping[str, rasters.RasterInfo] = MappingProxyType({}),
) -> dict[str, Any]:
    """Write what stands beside the rasters of a scene, and publish; the content of its report.json.

    hashes  : of the scene's inputs. lights : of before and after, if they were gathered.
    written : rasters by product whose headers need not be read.
    """
    folder = publication.folder
    for path in sorted(folder.iterdir()):
        publication.hash_early(path)
    facts = facts_of(scene, sums, wall_s)
    report = summary(facts)
    if "flags" in scene.config.output.products:
        style = flag_style(np.flatnonzero(sums.flags).tolist())
        (folder / "flags.qml").write_text(style, encoding="utf-8")
    results = _results(scene, folder, written)
    corrected = results.get("corrected")
    if corrected is not None and (residual := residual_glare(scene, corrected)) is not None:
        report["residual_glare"] = residual
    if scene.bad_names:
        report["bad_bands"] = scene.bad_names
    if (covered := coverage(scene, folder)) is not None:
        report["coverage"] = covered
    wanted = scene.config.output.quicklook
    picture = draw_quicklook(scene, folder, results, lights, threads_of(scene)) if wanted else None
    write_json(report, folder / "report.json")
    widths = _decimated_widths(results)
    (folder / "report.html").write_text(page(report, facts, picture, widths), encoding="utf-8")
    write_json(stac_item(scene, folder, results, facts, report), folder / "item.json")
    (folder / "settings.toml").write_text(tomli_w.dumps(settings_of(scene)), encoding="utf-8")
    inputs = hashes.entries()
    check_unchanged(scene)
    publication.commit(
        {
            "scene": scene.name,
            "tscorr": __version__,
            "key": resume_key(scene),
            "materials": list(scene.only),
            "products": products_of(scene),
            "inputs": inputs,
        }
    )
    return report


def facts_of(scene: Scene, sums: Sums, wall_s: float) -> SceneFacts:
    """What the report needs to know of a finished scene."""
    zenith, azimuth = view_samples(scene)
    sun = scene.sun
    middle = zenith.shape[0] // 2, zenith.shape[1] // 2
    centre = float(zenith[middle]), float(azimuth[middle])
    return SceneFacts(
        scene=scene.name,
        image=scene.image.path.name,
        bands=scene.image.names,
        wavelengths_um=scene.wavelengths_um or (float("nan"),) * scene.image.bands,
        materials=scene.materials,
        tally=sums.tally,
        tally_stride=scene.tally_stride,
        flag_counts=sums.flag_counts(),
        skipped=sums.skipped,
        uncertainty_evaluated="uncertainty" in scene.config.output.products,
        sigmas=sums.sigmas if "uncertainty" in scene.config.output.products else None,
        solar_zenith_deg=sun.zenith_deg,
        solar_azimuth_deg=sun.azimuth_deg,
        convergence_deg=sun.convergence_deg,
        sun_at=_sun_later(scene),
        view_zenith_deg=zenith,
        view_azimuth_deg=azimuth,
        relative_azimuth_deg=relative_azimuth(azimuth, sun.azimuth_deg),
        centre_view_deg=centre if np.isfinite(centre).all() else None,
        camera_height_m=scene.view.position[2] - scene.ground_level_m if isinstance(scene.view, FrameView) else None,
        seconds={"wall": wall_s, **sums.seconds},
        peak_rss_mb=max(sums.peak_rss_mb, peak_rss_mb()),
        version=__version__,
    )


def view_samples(scene: Scene) -> tuple[Array, Array]:
    """View zenith angle and azimuth from true north on a coarse grid over the scene; nan where unseen. [deg]"""
    rows, cols = scene.image.shape
    if scene.seen.layers:
        return _view_pixels(scene)
    count_rows, count_cols = min(rows, VIEW_SAMPLES), min(cols, VIEW_SAMPLES)
    t, wide, high = scene.grid.transform, cols / count_cols, rows / count_rows
    coarser = Affine(t.a * wide, t.b * high, t.c, t.d * wide, t.e * high, t.f)
    coarse = Grid(scene.grid.crs, coarser, (count_rows, count_cols))
    block = Block(0, 0, count_rows, count_cols)
    look = scene.view.look(coarse, block, np.full((1, 1), scene.ground_level_m))
    vectors = np.broadcast_to(look.vectors, (3, count_rows, count_cols))
    if look.unseen is not None:
        vectors = np.where(look.unseen, np.nan, vectors)
    zenith, azimuth = zenith_azimuth(vectors)
    return zenith, true_azimuth(azimuth, scene.sun.convergence_deg)


def _view_pixels(scene: Scene) -> tuple[Array, Array]:
    """The same where directions are read from rasters: of single pixels, since each costs a tile to be read."""
    rows, cols = (np.unique(np.linspace(0, size - 1, RASTER_SAMPLES).astype(int)) for size in scene.image.shape)
    vectors = np.full((3, rows.size, cols.size), np.nan)
    heights = np.full((1, 1), scene.ground_level_m)
    for i, j in np.ndindex(rows.size, cols.size):
        look = scene.view.look(scene.grid, Block(int(rows[i]), int(cols[j]), 1, 1), heights)
        if look.unseen is None:
            vectors[:, i, j] = look.vectors[:, 0, 0]
    zenith, azimuth = zenith_azimuth(vectors)
    return zenith, true_azimuth(azimuth, scene.sun.convergence_deg)


def _sun_later(scene: Scene) -> Any:
    """Function of minutes to solar zenith angle and azimuth, where the time is known."""
    start = scene.sun.time
    if start is None:
        return None
    longitude, latitude = map(float, longitude_latitude(scene.grid, *scene.grid.center))
    return lambda minutes: solar_path(start, minutes, latitude, longitude)


def stac_item(
    scene: Scene,
    folder: Path,
    results: Mapping[str, rasters.RasterInfo],
    facts: SceneFacts,
    report: Mapping[str, Any],
) -> dict[str, Any]:
    """The STAC item of a scene that is being published; `results` by product."""
    zenith, azimuth = facts.centre_view_deg or (float("nan"), float("nan"))
    return stac.item(
        name=scene.name,
        grid=scene.grid,
        datetime=scene.sun.time,
        files=results,
        cloud_optimised=scene.config.output.format == "cog",
        strips=sorted(path.name for path in folder.glob("*.*.tif")),
        inputs=scene.inputs,
        solar_zenith_deg=facts.solar_zenith_deg,
        solar_azimuth_deg=facts.solar_azimuth_deg,
        view_zenith_deg=zenith,
        view_azimuth_deg=azimuth,
        bands=(scene.image.names, scene.wavelengths_um, scene.image.fwhm_um),
        report=report,
        version=__version__,
        quicklook=scene.config.output.quicklook,
    )


def _results(scene: Scene, folder: Path, written: Mapping[str, rasters.RasterInfo]) -> dict[str, rasters.RasterInfo]:
    """The rasters in a folder of results, by product; those `written` as they are."""
    products = sorted({*scene.config.output.products, *written_products(scene)})
    found = {product: written.get(product) or rasters.result(folder, product, scene.image) for product in products}
    return {product: info for product, info in found.items() if info is not None}


def _decimated_widths(results: Mapping[str, rasters.RasterInfo]) -> Array | None:
    info = results.get("azimuthal_width")
    return None if info is None else rasters.read_decimated(info, PICTURE_PX)[0]
