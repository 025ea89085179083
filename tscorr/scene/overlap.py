"""How much two scenes of the same ground differ, before and after the correction.

The accepted measure on real data, where no truth is known. Looked at in windows spread over the overlap, so that
the cost is bounded whatever the size of the images.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr import rasters
from tscorr.correction import PixelFlag, SpecularState, class_rows, specular_state
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, reproject, require_crs
from tscorr.report import Difference, Overlap
from tscorr.scene.plan import Scene

Array = NDArray[Any]

MOST_PAIRS = 24
"""overlaps that are looked at: those with the most pixels"""
WINDOWS = 4
"""windows along each side of an overlap"""
WINDOW_PX = 128
UNKNOWN = int(SpecularState.NOT_ASSESSED) << 6
"""flags where a scene does not reach"""


def overlaps(results: Sequence[tuple[Scene, Path]]) -> list[Overlap]:
    """The differences of scenes that share ground, each given with the folder of its result.

    Scenes of other bands, or whose results lack the image or the flags, are not compared.
    """
    scenes = {folder: scene for scene, folder in results}
    result = cache(lambda folder: _result(scenes[folder], folder))  # a scene meets several others
    shared = [
        (region, one, two)
        for one, two in _neighbours(results)
        if one[0].wavelengths_um == two[0].wavelengths_um
        and one[0].good_bands == two[0].good_bands
        and (region := common_region(one[0].grid, two[0].grid)) is not None
    ]
    shared.sort(key=lambda pair: -pair[0].height * pair[0].width)
    pairs = ((result(one[1]), result(two[1]), region) for region, one, two in shared)
    whole = ((one, two, region) for one, two, region in pairs if one is not None and two is not None)
    return [difference(one, two, region) for one, two, region in islice(whole, MOST_PAIRS)]


class Result(NamedTuple):
    """A scene, and the rasters of its result that are compared."""

    scene: Scene
    corrected: rasters.RasterInfo
    flags: rasters.RasterInfo


def _result(scene: Scene, folder: Path) -> Result | None:
    """The result of a scene, or None where it lacks the image or the flags."""
    corrected, flags = (rasters.result(folder, product, scene.image) for product in ("corrected", "flags"))
    return None if corrected is None or flags is None else Result(scene, corrected, flags)


def _neighbours(results: Sequence[tuple[Scene, Path]]) -> Iterator[tuple[tuple[Scene, Path], tuple[Scene, Path]]]:
    """Pairs of scenes whose boxes meet in the CRS of the first scene: few of all pairs, and all that share ground."""
    boxes = np.array([_box(scene.grid, results[0][0].grid) for scene, _ in results]).reshape(-1, 4)
    for first, (west, south, east, north) in enumerate(boxes):
        rest = boxes[first + 1 :]
        apart = (rest[:, 0] > east) | (rest[:, 2] < west) | (rest[:, 1] > north) | (rest[:, 3] < south)
        for second in np.flatnonzero(~apart).tolist():
            yield results[first], results[first + 1 + second]


def _box(grid: Grid, common: Grid) -> tuple[float, float, float, float]:
    """Least and largest coordinates of a grid in the CRS of another, a little wide; nan where it has none."""
    try:
        same = grid.crs == common.crs
        x, y = grid.corners() if same else reproject(require_crs(grid), require_crs(common), *grid.corners())
    except InputError:
        return (np.nan,) * 4
    wide, high = 0.05 * np.ptp(x), 0.05 * np.ptp(y)  # sides bend between CRSs
    return float(x.min() - wide), float(y.min() - high), float(x.max() + wide), float(y.max() + high)


def common_region(grid: Grid, other: Grid) -> Block | None:
    """The block of a grid that bounds what another covers; None where they share nothing, or have no common CRS."""
    if grid.crs != other.crs and (grid.crs is None or other.crs is None):
        return None
    x, y = other.corners() if grid.crs == other.crs else reproject(other.crs, grid.crs, *other.corners())
    rows, cols = grid.rowcol(x, y)
    if not np.isfinite([rows, cols]).all():
        return None
    top, left = max(0, int(np.ceil(rows.min()))), max(0, int(np.ceil(cols.min())))
    bottom, right = min(grid.shape[0], int(rows.max()) + 1), min(grid.shape[1], int(cols.max()) + 1)
    return Block(top, left, bottom - top, right - left) if top < bottom and left < right else None


def windows(region: Block) -> Iterator[Block]:
    """At most `WINDOWS` x `WINDOWS` windows, spread over a region; all of a small one."""
    down, right = (max(WINDOW_PX, -(-size // WINDOWS)) for size in region.shape)
    for row in range(0, region.height, down):
        for col in range(0, region.width, right):
            height, width = min(WINDOW_PX, region.height - row), min(WINDOW_PX, region.width - col)
            yield Block(region.row + row, region.col + col, height, width)


def difference(one: Result, two: Result, region: Block) -> Overlap:
    """The differences of two scenes in a region of the first one's grid, material by material as it knows them.

    Over pixels assessed in both and corrected in at least one, neither saturated nor beyond correction.
    """
    first = one.scene
    size = len(first.materials) + 1
    count, before, after = np.zeros(size, np.int64), np.zeros(size), np.zeros(size)
    with ExitStack() as files:
        classes = files.enter_context(first.classes())
        seen = [_Seen(result, first.grid, files) for result in (one, two)]
        for window in windows(region):
            rows = class_rows(classes.read(window, 1), first.rows)
            flags = [scene.flags(window) for scene in seen]
            use = comparable(*flags) & (rows > 0)
            if not use.any():
                continue
            mine = rows[use]
            count += np.bincount(mine, minlength=size)
            before += np.bincount(mine, _squares(seen, "image", window, use), size)
            after += np.bincount(mine, _squares(seen, "corrected", window, use), size)
    return Overlap(
        first.name,
        two.scene.name,
        {
            material.name: Difference(
                int(count[row]), float(np.sqrt(before[row] / count[row])), float(np.sqrt(after[row] / count[row]))
            )
            for row, (material, *_) in enumerate(first.materials, start=1)
            if count[row]
        },
    )


def _squares(seen: Sequence["_Seen"], layer: str, window: Block, use: Array) -> Array:
    """Squared difference of two scenes, mean over the bands, at the pixels to use: (pixels,)."""
    one, two = (scene.reflectance(layer, window)[:, use] for scene in seen)
    return ((one - two) ** 2).mean(axis=0)


def comparable(one: Array, two: Array) -> Array:
    """Pixels whose flags allow a comparison."""
    use = np.zeros(one.shape, np.bool_)
    for flags in (one, two):
        use |= specular_state(flags) == SpecularState.CORRECTED
    for flags in (one, two):
        state = specular_state(flags)
        use &= (state == SpecularState.NEGLIGIBLE) | (state == SpecularState.CORRECTED)
        use &= flags & PixelFlag.SATURATED == 0
    return use


class _Seen:
    """The layers of one scene, laid over a grid."""

    def __init__(self, result: Result, grid: Grid, files: ExitStack) -> None:
        scene = result.scene
        self._layers = {
            "image": files.enter_context(rasters.Reader(scene.image, grid)),
            "corrected": files.enter_context(rasters.Reader(result.corrected, grid)),
        }
        self._flags = files.enter_context(rasters.Reader(result.flags, grid, fill=UNKNOWN))
        self._good = scene.good_bands
        self._scale, self._offset = (
            np.array(values)[self._good, None, None] for values in (scene.stored.scale, scene.stored.offset)
        )

    def flags(self, block: Block) -> Array:
        """Flags (rows, cols)."""
        return self._flags.read(block, 1)

    def reflectance(self, layer: str, block: Block) -> Array:
        """Reflectance factor (bands, rows, cols) of "image" or "corrected", without bands that are marked as bad."""
        return self._layers[layer].read(block)[self._good] * self._scale + self._offset
