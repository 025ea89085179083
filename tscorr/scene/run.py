"""A scene from files to files: read, correct, write, in blocks, by several workers."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from tscorr import __version__, rasters
from tscorr.angles import angle_between, facet_angles, true_azimuth, zenith_azimuth
from tscorr.correction import (
    SINGLE_FLAGS,
    BlockInputs,
    BlockResult,
    Corrector,
    add_tally,
    class_rows,
    new_tally,
)
from tscorr.correction.covariance import ORIGINS, origin
from tscorr.correction.edges import ShadowByBrightness
from tscorr.correction.sigmas import SigmaTally
from tscorr.grid import Block, blocks, north_of
from tscorr.quicklook import flag_palette
from tscorr.scene.bad_bands import BadBands
from tscorr.scene.ground import Ground
from tscorr.scene.plan import Scene
from tscorr.width import lobe_shapes, width_table

Array = NDArray[Any]
Progress = Callable[[int], None]
"""told the number of pixels done since the last call"""


def silent(pixels: int) -> None:
    """Progress that nobody watches."""
    del pixels


UNIT_COLUMNS = 2048
STRIPE_COLUMNS = 8192
BASE_MB = 220
"""memory of the process before the first block, and of what does not grow with blocks"""
COPIES = 5
"""an image block and what is made of it, at most, in blocks of the image's own size"""
GEOMETRY_BYTES = 60
"""vectors, angles and masks of a pixel"""
MOST_WORKERS = 4
LEAST_CONFIDENCE = 0.5
ANGLE_NAMES = (
    "incidence",
    "exitance",
    "relative_azimuth",
    "facet_tilt",
    "local_angle",
    "solar_zenith",
    "solar_azimuth",
    "view_zenith",
    "view_azimuth",
)


ANGLES_OF_SUN = {"incidence", "solar_zenith", "solar_azimuth"}


class Sums:
    """What the blocks of a scene add up to; integers and extremes, so that their order cannot matter."""

    def __init__(self, materials: int, bands: int) -> None:
        self.tally = new_tally(materials + 1, bands)
        self.flags = np.zeros(1 << 16, np.int64)
        self.sigmas = SigmaTally(materials + 1)
        self.skipped = dict.fromkeys(
            ("blocks", "blocks_no_specular_material", "blocks_out_of_reach", "blocks_shadow_or_nodata"), 0
        )
        self.seconds = dict.fromkeys(("read", "geometry", "kernel", "write"), 0.0)
        self.peak_rss_mb = 0.0
        """of other processes that worked on the scene"""
        self._lock = threading.Lock()

    def add(self, result: BlockResult, rows: Array, kind: str | None) -> None:
        """Add a block of these rows of the corrector; `kind` says why most of its work was skipped, if it was."""
        from tscorr.scene.compiled import counts_of

        counts = counts_of(result.flags)
        with self._lock:
            add_tally(self.tally, result.tally)
            self.flags += counts
            if result.sigma is not None:
                self.sigmas.add(result.sigma, result.flags, rows)
            self.skipped["blocks"] += 1
            if kind is not None:
                self.skipped[kind] += 1

    def flag_counts(self) -> dict[str, int]:
        """Pixels with each flag, by name."""
        values = np.arange(1 << 16)
        return {str(flag.name): int(self.flags[(values & flag) != 0].sum()) for flag in SINGLE_FLAGS}

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add the time of a block of code to one part of the work; summed over the workers."""
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds[part] += time.perf_counter() - start


def pixel_bytes(image: rasters.RasterInfo) -> int:
    """Bytes of a pixel of the image, all bands."""
    return image.bands * image.dtype.itemsize


def work_bytes(image: rasters.RasterInfo) -> int:
    """Memory that the work on a pixel takes at most."""
    return COPIES * pixel_bytes(image) + GEOMETRY_BYTES


def units(image: rasters.RasterInfo, memory_limit_mb: int, workers: int) -> list[Block]:
    """Blocks that the work is cut into: whole tiles of the rasters that are written, stripe by stripe.

    Results do not depend on the cut; memory and speed do. A block is never less than a tile, whatever the limit.
    """
    rows, cols = image.shape
    tile_rows, tile_cols = image.written_tile
    room = (memory_limit_mb - BASE_MB) * 1e6 / workers / work_bytes(image)  # pixels
    widest = cols if tile_cols >= cols else max(1, UNIT_COLUMNS // tile_cols) * tile_cols
    width = min(widest, max(1, int(room / tile_rows / tile_cols)) * tile_cols)
    height = max(1, min(int(room / min(width, cols)), 512) // tile_rows) * tile_rows
    stripe = max(width, STRIPE_COLUMNS // width * width)
    return [
        Block(block.row, first + block.col, block.height, block.width)
        for first in range(0, cols, stripe)
        for block in blocks((rows, min(stripe, cols - first)), (height, width))
    ]


def units_of(scene: Scene, strip: Block | None = None) -> list[Block]:
    """The blocks of a scene, or of a strip of it, under its configuration's memory limit."""
    limit, workers = scene.config.run.memory_limit_mb, workers_of(scene)
    if strip is None:
        return units(scene.image, limit, workers)
    return [block.below(strip.row) for block in units(scene.image.crop(strip), limit, workers)]


class Pipeline:
    """The work on one scene: open files, one method a block, and the rasters being written.

    strip : rows of the scene to do, all columns of them; all if None.
    masks : what `Ground.save` wrote of the whole scene; found by this pipeline itself if None.
    """

    def __init__(self, scene: Scene, folder: Path, strip: Block | None = None, masks: Path | None = None) -> None:
        self.scene = scene
        self.folder = folder
        self._strip = strip
        self._masks = masks
        self._products = set(scene.config.output.products)
        self._weighted = scene.confidence is not None and scene.config.correction.weigh_by_confidence
        self.corrector = Corrector(
            scene.materials,
            scene.stored,
            skip=scene.config.run.skip,
            tally_stride=scene.tally_stride,
            uncertainty="uncertainty" in self._products,
            weighted=self._weighted,
        )
        self.bad_bands = BadBands(scene.image.bad_bands)
        self._by_brightness = ShadowByBrightness.of(scene.materials, scene.stored, scene.wavelengths_um)
        self.sums = Sums(len(scene.materials), scene.image.bands)
        self._north = north_of(scene.grid)
        self._tables = [
            width_table(shapes[len(shapes) // 2], rules.form) if peak else None
            for (_, parameters, rules), peak in zip(scene.materials, self.corrector.peaks[1:], strict=True)
            for shapes in [lobe_shapes(parameters)]
        ]

    def open(self, files: ExitStack) -> None:
        """Open the rasters of the scene; `files` closes them."""
        scene = self.scene
        self.image = files.enter_context(rasters.Reader(scene.image))
        self.classes = files.enter_context(scene.classes())
        self.ground = files.enter_context(Ground(scene))
        self._confidence = None
        if scene.confidence is not None:
            self._confidence = files.enter_context(rasters.Reader(scene.confidence, scene.grid, fill=float("nan")))

    def run(self, progress: Progress) -> None:
        """All blocks, by the workers of the configuration; the first error stops the rest."""
        scene = self.scene
        with ExitStack() as files:
            self.open(files)
            if self.corrector.peaks.any():
                with self.sums.timed("geometry"):
                    self.ground.prepare(self._masks)
            self.writers = {name: self._writer(name) for name in sorted(self._products)}
            try:
                run_all(self.block, units_of(scene, self._strip), workers_of(scene), progress)
            except BaseException:
                for writer in self.writers.values():
                    writer.abandon()
                raise
            with self.sums.timed("write"), ThreadPoolExecutor(workers_of(scene)) as pool:
                list(pool.map(self._close, self.writers.items()))

    def _close(self, product: tuple[str, rasters.Writer]) -> None:
        """Close and check one raster; make it what was asked for."""
        name, writer = product
        writer.close()
        if self.scene.config.output.format == "cog":
            rasters.make_cog(writer.path, Resampling.nearest if name == "flags" else Resampling.average)

    def block(self, block: Block) -> int:
        """Read, correct and write one block; the number of its pixels."""
        with self.sums.timed("read"):
            rows = class_rows(self.classes.read(block, 1), self.scene.rows)
            image = self.image.read(block)
            bad = self.bad_bands.set_aside(image)
        needed = self.corrector.peaks[rows]
        skipped = None if needed.any() else "blocks_no_specular_material"
        with self.sums.timed("geometry"):
            inputs, unseen = self.inputs(block, image, rows, needed)
        layers = self._angle_layers(block, inputs, unseen)
        with self.sums.timed("kernel"):
            result = self.corrector(inputs, first_row=block.row, want_removed="removed" in self._products)
        self.bad_bands.put_back(result.corrected, bad)
        layers |= {"corrected": result.corrected, "flags": result.flags[None]}
        if result.removed is not None:
            layers["removed"] = result.removed
        if result.sigma is not None:
            layers["uncertainty"] = result.sigma
            if self.scene.image.bad_bands:
                result.sigma[np.array(self.scene.image.bad_bands)] = np.nan
        with self.sums.timed("write"):
            for name, writer in self.writers.items():
                writer.write(block if self._strip is None else block.below(-self._strip.row), layers[name])
        self.sums.add(result, rows, skipped)
        return rows.size

    def inputs(self, block: Block, image: Array, rows: Array, needed: Array) -> tuple[BlockInputs, Array | None]:
        """Directions and masks of a block; nothing of it is computed where no material has a peak.

        And where no sensor is known to have looked: bool (rows, cols), or None where that is nowhere.
        """
        scene = self.scene
        confidence = self._class_confidence(block)
        doubtful = None if confidence is None else ~(confidence >= LEAST_CONFIDENCE)
        if not needed.any() and "angles" not in self._products:
            up = np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1)
            inputs = BlockInputs(image=image, material=rows, sun=up, view=up, normal=up, low_confidence=doubtful)
            return inputs, None
        view, seconds, unseen = scene.view.look(scene.grid, block, self.ground.surface.heights(block))
        sun = scene.sun.vectors(block, seconds)
        normal, unreliable = self.ground.surface.normals(block)
        hidden = self.ground.hidden(block, needed) if needed.any() else None
        inputs = BlockInputs(
            image=image,
            material=rows,
            sun=sun,
            view=view,
            normal=normal,
            shadowed=self._shadowed(block, image, rows, needed, sun, normal),
            hidden=unseen if hidden is None else hidden if unseen is None else hidden | unseen,
            unreliable=unreliable,
            low_confidence=doubtful,
            weight=_weight(confidence) if self._weighted and confidence is not None else None,
            normal_sigma_deg=self.ground.surface.normal_sigma_deg(block) if self._scatters else None,
        )
        return inputs, unseen

    @property
    def _scatters(self) -> bool:
        """Whether anybody asks for the errors of the normals."""
        return self.corrector.uncertainty or any(rules.average_normals for *_, rules in self.scene.materials)

    def _class_confidence(self, block: Block) -> Array | None:
        """How sure the class is, nan where that is not known, or None where nobody says."""
        if self._confidence is None:
            return None
        info = self._confidence.info
        confidence: Array = self._confidence.read(block, 1) * info.scales[0] + info.offsets[0]
        return confidence

    def _shadowed(
        self, block: Block, image: Array, rows: Array, needed: Array, sun: Array, normal: Array
    ) -> Array | None:
        """Where the sun is hidden: as the surface model says, and at the rim of a shadow as the image says."""
        found = self.ground.shadowed(block) if needed.any() else None
        if found is None:
            return None
        shadowed, unsure = found
        return self._by_brightness.settle(shadowed, unsure & needed, image, rows, sun, normal)

    def _angle_layers(self, block: Block, inputs: BlockInputs, unseen: Array | None) -> dict[str, Array]:
        """The layers of angles and widths that are asked for, float32; nan where they need a view and are unseen."""
        layers: dict[str, Array] = {}
        if "azimuthal_width" in self._products:
            layers["azimuthal_width"] = self._azimuthal_width(inputs)[None]
        if "angles" in self._products:
            angles = facet_angles(inputs.sun, inputs.view, inputs.normal)
            for name, vectors in (("solar", inputs.sun), ("view", inputs.view)):
                zenith, azimuth = zenith_azimuth(vectors)
                constant = vectors.shape[1:] == (1, 1)  # then the direction was given for the centre
                convergence = self.scene.sun.convergence_deg if constant else self._north.convergence_deg(block)
                angles |= {f"{name}_zenith": zenith, f"{name}_azimuth": true_azimuth(azimuth, convergence)}
            layers["angles"] = np.stack(
                [np.broadcast_to(angles[name], block.shape).astype(np.float32) for name in ANGLE_NAMES]
            )
            if unseen is not None:
                of_view = [i for i, name in enumerate(ANGLE_NAMES) if name not in ANGLES_OF_SUN]
                layers["angles"][of_view] = np.where(unseen, np.float32(np.nan), layers["angles"][of_view])
        return layers

    def _azimuthal_width(self, inputs: BlockInputs) -> Array:
        """Azimuthal width of the peak for the material and incidence of each pixel, nan where none. [deg]"""
        rows = inputs.material
        widths = np.full(rows.shape, np.nan, np.float32)
        if self.corrector.peaks[rows].any():
            incidence = np.broadcast_to(angle_between(inputs.sun, inputs.normal), rows.shape)
            for row, table in enumerate(self._tables, start=1):
                mine = rows == row
                if table is not None and mine.any():
                    widths[mine] = table.at(incidence[mine])
        return widths

    def _writer(self, name: str) -> rasters.Writer | rasters.EnviWriter:
        image, stored = self.scene.image, self.scene.stored
        tags = {"TSCORR_VERSION": __version__, "TSCORR_SCENE": self.scene.name, "TSCORR_PRODUCT": name}
        profile = dict(image.profile)
        if (codec := self.scene.config.output.compression) is not None:
            profile["compress"] = codec
        like_image = rasters.Layer(
            names=image.names,
            dtype=image.dtype.name,
            nodata=stored.nodata,
            scales=image.scales,
            offsets=image.offsets,
            of_image=True,
            tags=tags,
        )
        angles = rasters.Layer(
            names=ANGLE_NAMES, dtype="float32", nodata=float("nan"), units=("degree",) * 9, tags=tags
        )
        origins = "; ".join(
            f"{surface.name}: {ORIGINS[origin(surface, rules.material_covariance)]}"
            for surface, _, rules in self.scene.materials
            if surface.has_peak
        )
        layers = {
            "corrected": like_image,
            "removed": replace(
                like_image, dtype=self.corrector.removed_type.name, nodata=None, offsets=(0.0,) * image.bands
            ),
            "uncertainty": replace(
                like_image,
                dtype="float32",
                nodata=float("nan"),
                scales=None,
                tags={**tags, "QUANTITY": "1 sigma of the corrected reflectance factor", "TSCORR_COVARIANCE": origins},
            ),
            "flags": rasters.Layer(
                names=("flags",), dtype="uint16", tags={**tags, **FLAG_TAGS}, palette=flag_palette()
            ),
            "azimuthal_width": replace(angles, names=("azimuthal width",), units=("degree",)),
            "angles": angles,
        }
        if not layers[name].of_image:
            profile |= FASTER_CODEC.get(profile["compress"], {})
        like = image if self._strip is None else image.crop(self._strip)
        if self.scene.config.output.format == "envi":
            return rasters.EnviWriter(self.folder / f"{name}{rasters.ENVI_SUFFIX}", like, layers[name])
        return rasters.Writer(self.folder / f"{name}.tif", profile, like, layers[name])


def _weight(confidence: Array) -> Array:
    """The part of a pixel that is its material: as sure as its class is; all of it where that is not known."""
    return np.where(np.isnan(confidence), 1, np.clip(confidence, 0, 1)).astype(np.float32)


FASTER_CODEC: dict[str, dict[str, Any]] = {"none": {"compress": "zstd"}, "deflate": {"zlevel": 1}}
"""for layers that no image set an example for, by the image's codec: flags become small by any, and fast by these"""

FLAG_TAGS = {f"FLAG_BIT_{flag.value.bit_length() - 1}": str(flag.name) for flag in SINGLE_FLAGS} | {
    "FLAG_BITS_6_7": "SPECULAR_STATE: 0 negligible, 1 corrected, 2 uncorrectable, 3 not assessed"
}


def workers_of(scene: Scene) -> int:
    """Threads that work on blocks: as configured, or all cores up to a few; no more than the memory limit feeds."""
    run = scene.config.run
    wanted = run.workers or min(MOST_WORKERS, len(os.sched_getaffinity(0)))
    rows, cols = map(min, scene.image.tile, scene.image.shape)
    tile_mb = rows * cols * work_bytes(scene.image) / 1e6
    return max(1, min(wanted, int((run.memory_limit_mb - BASE_MB) / tile_mb)))


def run_all(work: Callable[[Block], int], todo: list[Block], workers: int, progress: Progress) -> None:
    """Call `work` for every block in a bounded queue; the first exception is raised once the rest stopped."""
    waiting = iter(todo)
    with ThreadPoolExecutor(workers) as pool:
        running: set[Future[int]] = set()
        try:
            for block in waiting:
                running.add(pool.submit(work, block))
                if len(running) > workers:
                    running = _finish_some(running, progress)
            while running:
                running = _finish_some(running, progress)
        except BaseException:
            for future in running:
                future.cancel()
            raise


def _finish_some(running: set[Future[int]], progress: Progress) -> set[Future[int]]:
    done, rest = wait(running, return_when=FIRST_COMPLETED)
    for future in done:
        progress(future.result())
    return rest
