"""A scene from files to files: read, correct, write, in blocks, by several workers."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr import rasters
from tscorr.correction import BlockInputs, BlockResult, Corrector, add_angles, class_rows, flags_of
from tscorr.correction.edges import ShadowByBrightness
from tscorr.grid import Block
from tscorr.scene import memory
from tscorr.scene.angle_layers import AngleLayers
from tscorr.scene.bad_bands import BadBands
from tscorr.scene.cutting import closing_threads, units_of, workers_of
from tscorr.scene.ground import Ground
from tscorr.scene.pictures import Lights
from tscorr.scene.plan import Scene
from tscorr.scene.products import write_corrected_vrt, writer_of, written_products
from tscorr.scene.skipping import NO_SPECULAR_MATERIAL, SHADOW_OR_NODATA, Idle, Skipping, tallied
from tscorr.scene.sums import Sums
from tscorr.scene.threads import together

Array = NDArray[Any]
Progress = Callable[[int], None]
"""told the number of pixels done since the last call"""


def silent(pixels: int) -> None:
    """Progress that nobody watches."""
    del pixels


LEAST_CONFIDENCE = 0.5


class Pipeline:
    """The work on one scene: open files, one method a block, and the rasters being written.

    strip : rows of the scene to do, all columns of them; all if None.
    masks : what `Ground.save` wrote of the whole scene; found by this pipeline itself if None.
    final : called with the path of each raster that does not change any more, while it is checked.
    """

    def __init__(
        self,
        scene: Scene,
        folder: Path,
        strip: Block | None = None,
        masks: Path | None = None,
        final: Callable[[Path], None] = rasters.unwatched,
    ) -> None:
        self.scene = scene
        self.folder = folder
        self._strip = strip
        self._masks = masks
        self._final = final
        self._products = written_products(scene)
        self._as_difference = scene.config.output.corrected == "vrt"
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
        self.lights = Lights.of(scene) if strip is None else None
        """before and after, gathered for the picture"""
        self.writers: dict[str, rasters.Writer | rasters.EnviWriter] = {}
        self.written: dict[str, rasters.RasterInfo] = {}
        """the rasters by product, once they are whole"""
        self._skipping = Skipping(scene, self.corrector.peaks)
        self._angle_layers = AngleLayers(scene, self._products, self.corrector.peaks)

    def open(self, files: ExitStack) -> None:
        """Open the rasters of the scene; `files` closes them."""
        scene = self.scene
        self.image = files.enter_context(rasters.Reader(scene.image))
        self.classes = files.enter_context(scene.classes())
        self.ground = files.enter_context(Ground(scene, self.folder))
        self._confidence = None
        if scene.confidence is not None:
            confidence = rasters.Reader(scene.confidence, scene.grid, fill=float("nan"), scaled=True)
            self._confidence = files.enter_context(confidence)

    def run(self, progress: Progress) -> Sums:
        """All blocks, by the workers of the configuration, and their sums; the first error stops the rest."""
        scene = self.scene
        memory.share()
        with rasters.environment(), ExitStack() as files:
            self.open(files)
            if workers_of(scene) > 1:
                files.enter_context(self.corrector.compiled_ahead(self._one_pixel))
            with self.sums.timed("geometry"):
                self._prepare()
            try:
                for name in sorted(self._products):
                    self.writers[name] = writer_of(scene, self.folder, name, self._strip)
                self._stored = self._stored_tiles(files)
                run_all(self.block, units_of(scene, self._strip), workers_of(scene), progress)
            except BaseException:
                for writer in self.writers.values():
                    writer.abandon()
                raise
            if scene.config.output.format == "cog":
                memory.give_back()  # GDAL takes as much to make them as the blocks took
            with self.sums.timed("write"), ThreadPoolExecutor(closing_threads(scene)) as pool:
                self.written = dict(zip(self.writers, pool.map(self._close, self.writers.values()), strict=True))
            if self._as_difference and self._strip is None:
                write_corrected_vrt(scene, self.folder)
        return self.sums

    def _stored_tiles(self, files: ExitStack) -> rasters.StoredTiles | None:
        """The image's tiles as they are stored, where the corrected image can hold them; `files` closes them."""
        writer = self.writers.get("corrected")
        if not (isinstance(writer, rasters.Writer) and self.scene.config.run.skip):
            return None
        try:
            tiles = files.enter_context(rasters.StoredTiles(self.scene.image, self.image.read))
        except (OSError, ValueError):  # no TIFF
            return None
        return tiles if writer.copies(tiles) else None

    def _close(self, writer: rasters.Writer | rasters.EnviWriter) -> rasters.RasterInfo:
        """Close and check one raster; make it what was asked for."""
        if self.scene.config.output.format != "cog":
            return writer.close(self._final)
        writer.close()
        rasters.make_cog(writer.path, bits=writer is self.writers.get("flags"))
        return rasters.describe(writer.path, ours=True)

    def _prepare(self) -> None:
        """Sweep the surface for shadows and hidden ground, where a material with a peak is anywhere."""
        if self._masks is not None:
            self.ground.prepare(self._masks)
        elif self.ground.is_swept and self.corrector.peaks.any():
            rows = self._skipping.specular_rows(self.classes)
            if rows is not None:
                self.ground.prepare(rows=rows)

    def block(self, block: Block) -> int:
        """Read, correct and write one block; the number of its pixels."""
        with self.sums.timed("read"):
            classes = self.classes.read(block, 1)
        stored = self._stored if self._stored is not None and self._stored.holds(block) else None
        unread = (self._as_difference or stored is not None) and not self._image_is_needed
        counts = self._skipping.idle_pixels(classes) if unread and self._confidence is None else None
        if counts is not None:
            self._pass_by(block, classes, counts, stored)
        else:
            self._work_on(block, class_rows(classes, self.scene.rows), stored, unread=unread)
        memory.keep_below(self.scene.config.run.memory_limit_mb)
        return classes.size

    def _pass_by(self, block: Block, classes: Array, counts: Array, stored: rasters.StoredTiles | None) -> None:
        """Write a block of which no more need be known than how many pixels have which row of the corrector."""
        layers = self._idle_layers(block)
        if counts[0] > 0:
            layers["flags"] = flags_of(class_rows(classes, self.scene.rows))[None]
        with self.sums.timed("write"):
            self._write(block, layers, stored)
        self.sums.add_idle(self.corrector.tally_of(counts), NO_SPECULAR_MATERIAL)

    def _work_on(self, block: Block, rows: Array, stored: rasters.StoredTiles | None, *, unread: bool) -> None:
        """Look at a block of these rows of the corrector closely: read, correct and write it.

        stored : holds it, unless that is None. unread : the image is read only where that turns out to be needed.
        """
        with self.sums.timed("read"):
            image, bad = (None, None) if unread else self._read_image(block)
        needed = self.corrector.have_peaks(rows)
        with self.sums.timed("geometry"):
            idle = self._skipping.idle(block, rows, needed, image)
            shade = self.ground.shadowed(block) if idle is None and needed.any() else None
            dark = self._skipping.is_dark(needed, shade)
        if image is None and idle is None and not dark:
            with self.sums.timed("read"):
                image, bad = self._read_image(block)
        elif image is None:
            image = np.empty((0, *block.shape), self.scene.image.dtype)
        before = self.lights.of_block(block, image) if self.lights is not None else None
        if idle is None:
            result, layers = self._corrected(block, image, rows, needed, shade)
        else:
            result = self._passed_through(block, image, rows, idle)
            layers = self._idle_layers(block)
        if self.lights is not None and before is not None:
            after = before if dark or idle is not None else self.lights.of_block(block, result.corrected)
            self.lights.add(block, before, after)
        if bad is not None:
            self.bad_bands.put_back(result.corrected, bad)
        layers |= {"flags": result.flags[None]}
        if stored is None or (idle is None and not dark):
            layers["corrected"], stored = result.corrected, None
        if result.removed is not None:
            layers["removed"] = result.removed
        if result.sigma is not None:
            layers["uncertainty"] = result.sigma
            if self.scene.image.bad_bands:
                result.sigma[np.array(self.scene.image.bad_bands)] = np.nan
        with self.sums.timed("write"):
            self._write(block, layers, stored)
        self.sums.add(result, rows, SHADOW_OR_NODATA if dark else None if idle is None else idle.reason)

    @property
    def _image_is_needed(self) -> bool:
        """Whether flags or the picture depend on the image, even where nothing is to be removed from it."""
        return self._skipping.flags_need_image or self.lights is not None

    def _write(self, block: Block, layers: dict[str, Array], stored: rasters.StoredTiles | None) -> None:
        """Write the layers of a block; `stored` holds the corrected image where nothing changed."""
        target = block if self._strip is None else block.below(-self._strip.row)
        for name, writer in self.writers.items():
            if name in layers:
                writer.write(target, layers[name])
            elif name == "corrected" and stored is not None and isinstance(writer, rasters.Writer):
                writer.copy(target, stored, block)

    def _idle_layers(self, block: Block) -> dict[str, Array]:
        """What is written of a block in which nothing was looked for; a sparse raster needs no zeros."""
        layers: dict[str, Array] = {}
        if "azimuthal_width" in self.writers:
            layers["azimuthal_width"] = np.full((1, *block.shape), np.nan, np.float32)
        if isinstance(self.writers.get("removed"), rasters.EnviWriter):
            layers["removed"] = np.zeros((self.scene.image.bands, *block.shape), self.scene.image.dtype)
        return layers

    def _read_image(self, block: Block) -> tuple[Array, Array]:
        """The image of a block, its bad bands set aside, and those."""
        image = self.image.read(block)
        return image, self.bad_bands.set_aside(image)

    def _corrected(
        self, block: Block, image: Array, rows: Array, needed: Array, shade: tuple[Array, Array] | None
    ) -> tuple[BlockResult, dict[str, Array]]:
        """A block without its specular part, and the layers of angles and widths that are asked for."""
        with self.sums.timed("geometry"):
            inputs, unseen = self.inputs(block, image, rows, needed, shade)
        layers = self._angle_layers.of_block(block, inputs, unseen)
        with self.sums.timed("kernel"):
            want_removed = "removed" in self._products and len(image) > 0
            return self.corrector(inputs, first_row=block.row, want_removed=want_removed), layers

    def _passed_through(self, block: Block, image: Array, rows: Array, idle: Idle) -> BlockResult:
        """A block in which nothing is to be removed, as it is; with the statistics of its angles where it has some."""
        with self.sums.timed("kernel"):
            result = self.corrector.passed_through(self._without_geometry(block, image, rows))
        if idle.attenuated is not None:
            assessed = int(result.tally.states[self.corrector.peaks, 0].sum())
            result.tally.out_of_lobe[0] += assessed
            result.tally.attenuated[0] += assessed * idle.attenuated
            for line in tallied(block, self.scene.tally_stride):
                window = slice(line.row - block.row, line.row - block.row + line.height)
                here = rows[window]
                lines = np.ascontiguousarray(image[:, window])  # for another layout numba would compile again
                inputs, _ = self.inputs(line, lines, here, self.corrector.peaks[here])
                tally = self.corrector(inputs, first_row=line.row, want_removed=False).tally
                add_angles(result.tally, tally)
        return result

    def _one_pixel(self) -> BlockInputs:
        """A block of the least size, of the types of all."""
        image = np.zeros((self.scene.image.bands, 1, 1), self.scene.image.dtype)
        return self._without_geometry(Block(0, 0, 1, 1), image, np.zeros((1, 1), np.uint8))

    def _without_geometry(self, block: Block, image: Array, rows: Array) -> BlockInputs:
        up = np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1)
        return BlockInputs(
            image=image,
            material=rows,
            sun=up,
            view=up,
            normal=up.astype(self.ground.normal_type),  # nothing more is compiled
            low_confidence=_doubtful(self._class_confidence(block)),
        )

    def inputs(
        self, block: Block, image: Array, rows: Array, needed: Array, shade: tuple[Array, Array] | None = None
    ) -> tuple[BlockInputs, Array | None]:
        """Directions and masks of a block.

        shade : what the ground says of shadow, and where that is unsure; where not given, it is asked.
        And where no sensor is known to have looked: bool (rows, cols), or None where that is nowhere.
        """
        scene = self.scene
        if shade is None and needed.any():
            shade = self.ground.shadowed(block)
        confidence = self._class_confidence(block)
        sparing = scene.config.run.skip and self.corrector.is_compiled and not self._angle_layers
        wanted = needed if sparing else None
        heights, normal, unreliable = self.ground.surface.relief(block, wanted)
        view, seconds, unseen = scene.view.look(scene.grid, block, heights, wanted)
        sun = scene.sun.vectors(block, seconds)
        hidden = self.ground.hidden(block, needed) if needed.any() else None
        inputs = BlockInputs(
            image=image,
            material=rows,
            sun=sun,
            view=view,
            normal=normal,
            shadowed=self._shadowed(shade, image, rows, needed, sun, normal),
            hidden=unseen if hidden is None else hidden if unseen is None else hidden | unseen,
            unreliable=unreliable,
            low_confidence=_doubtful(confidence),
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
        return None if self._confidence is None else self._confidence.read(block, 1)

    def _shadowed(
        self,
        shade: tuple[Array, Array] | None,
        image: Array,
        rows: Array,
        needed: Array,
        sun: Array,
        normal: Array,
    ) -> Array | None:
        """Where the sun is hidden: as the surface model says, and at the rim of a shadow as the image says."""
        if shade is None:
            return None
        shadowed, unsure = shade
        return self._by_brightness.settle(shadowed, unsure & needed, image, rows, sun, normal)


def _doubtful(confidence: Array | None) -> Array | None:
    """Where the class is not known to be more likely right than wrong, or None where nobody says."""
    return None if confidence is None else ~(confidence >= LEAST_CONFIDENCE)


def _weight(confidence: Array) -> Array:
    """The part of a pixel that is its material: as sure as its class is; all of it where that is not known."""
    return np.where(np.isnan(confidence), 1, np.clip(confidence, 0, 1)).astype(np.float32)


def run_all(work: Callable[[Block], int], todo: list[Block], workers: int, progress: Progress) -> None:
    """Call `work` for every block; a worker takes the next as soon as it is free.

    progress : called by one worker at a time. The first exception is raised once the others have stopped.
    """
    waiting, turn = iter(todo), threading.Lock()

    def one_after_another(stopped: threading.Event) -> None:
        done = 0
        while True:
            with turn:
                progress(done)
                block = None if stopped.is_set() else next(waiting, None)
            if block is None:
                return
            done = work(block)

    together([one_after_another] * workers, workers)
