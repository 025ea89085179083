"""The ground of a scene: its surface, and what is in shadow or hidden, over the pixels of the image."""

import math
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from tscorr import config, rasters
from tscorr.correction.edges import dilated, rim
from tscorr.errors import OutputError
from tscorr.grid import Block, blocks
from tscorr.scene.cutting import threads_of
from tscorr.scene.directions import obs_normals
from tscorr.scene.plan import Scene
from tscorr.scene.survey import HeightSurvey
from tscorr.scene.threads import together
from tscorr.sensor import ConstantView, FrameView, LineView
from tscorr.terrain import shadows
from tscorr.terrain.bitmask import BitMask
from tscorr.terrain.surface import DsmSurface, FlatSurface, GivenNormals, RoofPlaneSurface, Surface

Array = NDArray[Any]

STRIP_ROWS = 512, 256, 128, 64
"""rows or columns that a sweep reads at once: the most of these with which all sweeps together read no more than
STRIP_PIXELS, which take ten bytes each; as many as a tile has where that can be, since each is decoded once then"""
STRIP_PIXELS = 20e6
RELIEF_PX = 512, 2048
"""rows and columns that are looked at at once for the lowest and the highest point"""
MARGIN_PX = 512
"""pixels around the image that are looked at for what they hide; farther things cast no shadow"""
TALLEST_M = 300.0
"""above the ground around it: what stands beyond the image is taken to be no taller, whatever it is"""
STEEPEST_DEG = 80.0
"""beyond it what hides a pixel is further than MARGIN_PX anyway"""
LIT, SEEN, RELIEF = "lit.bits", "seen.bits", "relief.txt"


class _Pass(NamedTuple):
    """A part of a sweep, which starts so many pixels beyond the image."""

    margin: int
    sweep: shadows.Sweep


class Ground:
    """Surface, shadows and occlusion of a scene; close it to close its files.

    folder : on whose disk the masks of what is in shadow or hidden are kept, two bits a pixel in nameless files.
    """

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._scene = scene
        self._folder = folder
        self._files = ExitStack()
        self._heights = scene.heights(MARGIN_PX)
        self._shared_heights: Callable[[Block], Array] | None = None
        """heights of a block whose surroundings are read for other blocks too; no method of this object: the surface
        holds on to it, and a ring of references keeps its blocks in memory for many scenes more"""
        if self._heights is not None:
            self._shared_heights = rasters.KeptReader(self._files.enter_context(self._heights)).read
        self._lock = threading.Lock()
        self._known_surface: Surface | None = None
        self._relief_m = 0.0
        self._rows: tuple[int, int] | None = None
        self._lit: BitMask | None = None
        self._seen: BitMask | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def _read_heights(self, block: Block) -> Array:
        """Heights of a block that is read once, whatever its size."""
        assert self._heights is not None
        return self._heights.read(block, 1)

    @property
    def normal_type(self) -> type[np.floating[Any]]:
        """Of the surface's normals, of which nothing need be read."""
        found_here = isinstance(self._scene.settings.surface, config.FlatSettings | config.DsmSettings)
        return np.float32 if found_here else np.float64

    @property
    def surface(self) -> Surface:
        """The surface; its files are opened when it is first asked for."""
        with self._lock:
            if self._known_surface is None:
                self._known_surface = self._surface()
            return self._known_surface

    def _surface(self) -> Surface:
        settings = self._scene.settings.surface
        if isinstance(settings, config.FlatSettings):
            return FlatSurface(settings.height_m)
        dsm: Surface = FlatSurface(0.0)
        if self._heights is not None and self._shared_heights is not None:
            cell_x_m, cell_y_m = self._scene.grid.cell_size
            by_planes = isinstance(settings, config.DsmSettings) and settings.kind == "roof_planes"
            survey = HeightSurvey(self._heights, self._scene.image.shape, self._scene.ground_level_m)
            kind = RoofPlaneSurface if by_planes else DsmSurface
            dsm = kind(self._shared_heights, survey, cell_x_m=cell_x_m, cell_y_m=cell_y_m)
        if isinstance(settings, config.DsmSettings):
            return dsm
        info = self._scene.surface_files[-1]
        if isinstance(settings, config.ObsSurfaceSettings):
            slopes = self._files.enter_context(closing(obs_normals(info)))
            return GivenNormals(partial(slopes, self._scene.grid), dsm)
        normals = self._files.enter_context(
            rasters.Reader(info, self._scene.grid, resampling=Resampling.nearest, fill=float("nan"))
        )
        return GivenNormals(normals.read, dsm)

    @property
    def is_swept(self) -> bool:
        """Whether there is a surface model to find shadows in, and they are wanted."""
        return self._heights is not None and self._scene.settings.shadows

    def prepare(self, masks: Path | None = None, rows: tuple[int, int] | None = None) -> None:
        """Find what is in shadow and what is hidden, once, before the first block is asked for.

        masks : a folder that `save` wrote to; what it wrote is taken from there.
        rows  : first and last + 1 of those that will be asked for; all if not given. A sweep starts where the light
                comes from, whatever is asked for, since a tower there may shade it, and goes on as far as needed.
        """
        if not self.is_swept:
            return
        if masks is not None:
            if not masks.is_dir():
                raise OutputError(f"the masks of shadows in {masks} are gone; run again")
            self._lit, self._seen = (self._loaded(masks / name) for name in (LIT, SEEN))
            if (masks / RELIEF).exists():
                self._relief_m = float((masks / RELIEF).read_text(encoding="ascii"))
            return
        self._rows = rows
        of_sun, of_view = self._passes_of_sun(), self._passes_of_view()
        self._lit = self._new_mask()
        todo = [(self._lit, each) for each in of_sun]
        if of_view is None:
            self._relief_m = self._relief()
        else:
            self._seen = self._new_mask()
            todo += [(self._seen, each) for each in of_view]
        threads = max(1, min(threads_of(self._scene), len(todo)))
        together([partial(self._narrow, mask, each, STRIP_PIXELS / threads) for mask, each in todo], threads)

    def _loaded(self, path: Path) -> BitMask | None:
        """A mask that was saved, or None where there is none."""
        if not path.exists():
            return None
        return self._files.enter_context(closing(BitMask.load(path, self._scene.image.shape)))

    def save(self, folder: Path) -> None:
        """Write what `prepare` found, where it found anything."""
        for name, mask in ((LIT, self._lit), (SEEN, self._seen)):
            if mask is not None:
                mask.save(folder / name)
        (folder / RELIEF).write_text(repr(self._relief_m), encoding="ascii")

    def _passes_of_sun(self) -> list[_Pass]:
        sun = self._scene.sun.center
        return self._passes(lambda _, **scene: shadows.DirectionSweep(direction=sun, **scene), _zenith_deg(sun))

    def _passes_of_view(self) -> list[_Pass] | None:
        """Where one sweep can tell what the sensor sees; otherwise it is found block by block."""
        view, grid = self._scene.view, self._scene.grid
        if isinstance(view, ConstantView):
            direction = view.vectors(grid, Block(0, 0, 1, 1), np.zeros((1, 1)))[:, 0, 0]
            return self._passes(
                lambda _, **scene: shadows.DirectionSweep(direction=direction, **scene), _zenith_deg(direction)
            )
        if isinstance(view, FrameView):
            position = view.position
            return self._passes(
                lambda local, **scene: shadows.FrameSweep(position=local(position), **scene), self._steepest_deg()
            )
        if isinstance(view, LineView) and (ends := view.straight(grid)) is not None:
            return self._passes(
                lambda local, **scene: shadows.LineSweep(start=local(ends[0]), end=local(ends[1]), **scene),
                self._steepest_deg(),
            )
        return None

    def _steepest_deg(self) -> float:
        """The largest zenith angle of the view, at the corners of the image and between them."""
        rows, cols = self._scene.image.shape
        places = {(row, col) for row in (0, rows // 2, rows - 1) for col in (0, cols // 2, cols - 1)}
        zeniths = [
            _zenith_deg(self._scene.view.vectors(self._scene.grid, block, self.surface.heights(block))[:, 0, 0])
            for block in (Block(row, col, 1, 1) for row, col in places)
        ]
        return max((zenith for zenith in zeniths if np.isfinite(zenith)), default=0.0)

    def _passes(self, sweep_of: Callable[..., shadows.Sweep], zenith_deg: float) -> list[_Pass]:
        """The parts of a sweep over the image, and over what lies around it and may hide something in it.

        sweep_of   : given a function that puts a position into the place of what is swept, and its shape and cells.
        zenith_deg : of the source, at most.
        """
        rows, cols = self._scene.image.shape
        cell_x_m, cell_y_m = self._scene.grid.cell_size
        margin = self._margin(zenith_deg)
        x0, y0 = self._scene.grid.xy(-margin, -margin)

        def local(position: Any) -> tuple[float, float, float]:
            """Relative to the centre of the first pixel: metres east, north, and up."""
            return float(position[0] - x0), float(position[1] - y0), float(position[2])

        shape = rows + 2 * margin, cols + 2 * margin
        sweep = sweep_of(local, shape=shape, cell_x_m=cell_x_m, cell_y_m=cell_y_m)
        return [_Pass(margin, part) for part in sweep.parts()]

    def _new_mask(self) -> BitMask:
        """Where nothing is hidden so far. OutputError where the disk has no room for it."""
        try:
            return self._files.enter_context(closing(BitMask.new(self._scene.image.shape, self._folder)))
        except OSError as error:
            raise self._no_room(error) from None

    def _narrow(self, mask: BitMask, each: _Pass, pixels: float, stopped: threading.Event) -> None:
        """Take out of a mask what a pass finds hidden.

        pixels : that are read at a time, at most. OutputError where the disk has no room.
        """
        margin, sweep = each
        rows, cols = self._scene.image.shape
        longest = max(rows, cols) + 2 * margin
        lines = next((lines for lines in STRIP_ROWS if lines * longest <= pixels), STRIP_ROWS[-1])
        first, last = self._rows or (0, rows)
        for strip in sweep.strips(lines, (first + margin - 1, last + margin + 1)):
            if stopped.is_set():
                return
            block = Block(strip.row - margin, strip.col - margin, strip.height, strip.width)
            visible = sweep(strip, self._read_heights(block))
            try:
                mask.narrow(block, visible)
            except OSError as error:
                raise self._no_room(error) from None

    def _no_room(self, error: OSError) -> OutputError:
        return OutputError(f"the mask of shadows cannot be written to {self._folder}: {error}")

    def _margin(self, zenith_deg: float) -> int:
        """Pixels around the image that can hide something in it from a source at this zenith angle."""
        return self._reach_px(TALLEST_M, zenith_deg) if self._reaches_beyond else 0

    def _reach_px(self, relief_m: float, zenith_deg: float) -> int:
        """How far something may be that hides a pixel."""
        reach = shadows.reach_m(relief_m, min(zenith_deg, STEEPEST_DEG)) / min(self._scene.grid.cell_size)
        return min(MARGIN_PX, math.ceil(reach) + 1)

    def _relief(self) -> float:
        """From the lowest to the highest point of the surface model, about the rows that will be asked for. [m]"""
        rows, cols = self._scene.image.shape
        first, last = self._rows or (0, rows)
        beyond = MARGIN_PX if self._reaches_beyond else 0
        first, last = max(first - MARGIN_PX, -beyond), min(last + MARGIN_PX, rows + beyond)
        lowest, highest = np.inf, -np.inf
        for block in blocks((last - first, cols + 2 * beyond), RELIEF_PX):
            heights = self._read_heights(Block(block.row + first, block.col - beyond, block.height, block.width))
            known = heights[np.isfinite(heights)]
            lowest, highest = known.min(initial=lowest), known.max(initial=highest)
        return float(max(highest - lowest, 0.0))

    @cached_property
    def _reaches_beyond(self) -> bool:
        """Whether the surface model covers more than the image."""
        assert self._heights is not None
        rows, cols = self._scene.image.shape
        ring = (
            Block(-1, 0, 1, cols),
            Block(rows, 0, 1, cols),
            Block(0, -1, rows, 1),
            Block(0, cols, rows, 1),
        )
        return any(np.isfinite(self._read_heights(block)).any() for block in ring)

    def shadowed(self, block: Block) -> tuple[Array, Array] | None:
        """Where something stands between the block and the sun, and where that is unsure by a pixel.

        None where nothing was looked for.
        """
        if self._lit is None:
            return None
        lit = self._lit.read(block.padded(1))
        return ~lit[1:-1, 1:-1], rim(lit)

    def hidden(self, block: Block, needed: Array) -> Array | None:
        """Where something stands between the block and the sensor, or None where nothing was looked for.

        A pixel beside a visible one counts as seen: the surface model is unsure by a pixel, and the image has a
        value there. Only the `needed` pixels are asked for where every pixel costs a ray.
        """
        if not self.is_swept:
            return None
        around = block.padded(1)
        seen = (
            self._seen.read(around)
            if self._seen is not None
            else self._marched(around, np.pad(needed, 1, mode="edge"))
        )
        return ~dilated(seen)

    def _marched(self, block: Block, needed: Array) -> Array:
        """Which pixels of a block the sensor sees, ray by ray."""
        grid = self._scene.grid
        view = self._scene.view.vectors(grid, block, self.surface.heights(block))
        zenith = float(np.nanmax(np.rad2deg(np.arctan2(np.hypot(view[0], view[1]), view[2])), initial=0.0))
        halo = self._reach_px(self._relief_m, zenith)
        window = slice(halo, halo + block.height), slice(halo, halo + block.width)
        cell_x_m, cell_y_m = grid.cell_size
        assert self._shared_heights is not None
        heights = self._shared_heights(block.padded(halo))
        return shadows.march(
            heights, view, cell_x_m=cell_x_m, cell_y_m=cell_y_m, window=window, needed=needed, reach_px=halo
        )


def _zenith_deg(direction: Array) -> float:
    """Of a vector east, north, up."""
    return float(np.rad2deg(np.arctan2(np.hypot(direction[0], direction[1]), direction[2])))
