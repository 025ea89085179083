"""What of a scene need not be computed, told before it is: from the class map, from nodata and shadow, from angles.

Nothing that is skipped may change a value: what cannot be proven is computed. `skip = false` skips nothing.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr import rasters
from tscorr.correction import class_rows
from tscorr.grid import Block, blocks
from tscorr.scene.plan import Scene
from tscorr.scene.reach import Reach
from tscorr.scene.sums import counted

Array = NDArray[Any]

NO_SPECULAR_MATERIAL = "blocks_no_specular_material"
OUT_OF_REACH = "blocks_out_of_reach"
SHADOW_OR_NODATA = "blocks_shadow_or_nodata"
SCAN_PX = 512, 2048


class Idle(NamedTuple):
    """Why nothing of a block is to be removed: its key in report.json.

    attenuated : whether G is below 1 in the pixels that are out of reach of every lobe; None where none was assessed.
    """

    reason: str
    attenuated: bool | None = None


class Skipping:
    """The decisions of one scene.

    peaks : which rows of the corrector have a lobe.
    """

    def __init__(self, scene: Scene, peaks: Array) -> None:
        self._scene = scene
        self._peaks = peaks
        self._on = scene.config.run.skip
        products = set(scene.config.output.products)
        self._wants_angles = "angles" in products
        self._wants_geometry = bool(products & {"angles", "azimuthal_width", "uncertainty"})
        self._dark_is_idle = not any(rules.enabled and rules.sky_specular for *_, rules in scene.materials)
        stored = scene.stored
        self.flags_need_image = (
            not self._on
            or stored.dtype.kind == "f"
            or stored.has_nodata
            or stored.saturation is not None
            or "uncertainty" in products
        )
        """whether flags, or how sure a value is, depend on the image where no material with a peak is"""
        wanted = self._on and peaks.any() and not self._wants_geometry
        self._reach = Reach.of(scene) if wanted else None

    def idle(self, block: Block, rows: Array, needed: Array, image: Array | None) -> Idle | None:
        """Why a block is to be passed through without a look at directions, or None where it is not.

        rows   : of the corrector (rows, cols). needed : where they have a lobe. image : None where it was not read.
        """
        if not self._on or self._wants_angles:
            return None
        if not needed.any():
            return Idle(NO_SPECULAR_MATERIAL)
        if self._wants_geometry:
            return None
        if image is not None and not self._has_data(image, needed):
            return Idle(SHADOW_OR_NODATA)
        if self._reach is not None:
            present = (int(row) for row in np.flatnonzero(self._peaks) if (rows == row).any())
            attenuated = self._reach.attenuated(block, present)
            if attenuated is not None:
                return Idle(OUT_OF_REACH, attenuated)
        return None

    def idle_pixels(self, classes: Array) -> Array | None:
        """Pixels of each row of the corrector in a block of a class map of uint8, if no more has to be known of it.

        None where it has a material with a peak, where the image decides flags, and of other types.
        """
        if not self._on or self._wants_angles or self.flags_need_image or classes.dtype != np.uint8:
            return None
        found, counts = counted(classes, 256), np.zeros(len(self._peaks), np.int64)
        for value, row in self._scene.rows.items():
            counts[row] += found[value] if 0 <= value < len(found) else 0
        counts[0] += found.sum() - counts.sum()
        return None if counts[self._peaks].any() else counts

    def is_dark(self, needed: Array, shade: tuple[Array, Array] | None) -> bool:
        """Whether the needed pixels lie in cast shadow, all of them and for certain: then no lobe is evaluated."""
        if not (self._on and self._dark_is_idle) or shade is None or not needed.any():
            return False
        shadowed, unsure = shade
        return bool(np.all((shadowed & ~unsure)[needed]))

    def _has_data(self, image: Array, needed: Array) -> bool:
        """Whether any of the needed pixels has data in all bands; the first one mostly tells."""
        if not self.flags_need_image:
            return True
        row, col = divmod(int(needed.argmax()), needed.shape[1])
        if self._scene.stored.has_data(image[:, row : row + 1, col : col + 1]).all():
            return True
        return bool(self._scene.stored.has_data(image)[needed].any())

    def specular_rows(self, classes: rasters.Reader) -> tuple[int, int] | None:
        """First and last + 1 of the rows that have a material with a peak, to whole strips; None without any.

        Read from both ends of the class map, so that where there are many of them little is read.
        """
        rows, cols = self._scene.image.shape
        if not self._on:
            return 0, rows
        strips = [Block(strip.row, 0, strip.height, cols) for strip in blocks((rows, 1), (SCAN_PX[0], 1))]
        first = next((strip.row for strip in strips if self._is_specular(strip, classes)), None)
        if first is None:
            return None
        last = next(strip for strip in reversed(strips) if strip.row == first or self._is_specular(strip, classes))
        return first, last.row + last.height

    def _is_specular(self, strip: Block, classes: rasters.Reader) -> bool:
        parts = (
            Block(strip.row, part.col, strip.height, part.width) for part in blocks((1, strip.width), (1, SCAN_PX[1]))
        )
        return any(self._peaks[class_rows(classes.read(part, 1), self._scene.rows)].any() for part in parts)


def tallied(block: Block, stride: int) -> list[Block]:
    """The rows of a block whose angles are counted: every so many of the image."""
    if stride == 1:
        return [block]
    first = -block.row % stride
    return [Block(block.row + row, block.col, 1, block.width) for row in range(first, block.height, stride)]
