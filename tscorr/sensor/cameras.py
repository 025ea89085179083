"""An orthomosaic: which camera each pixel came from, and where the cameras stood."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import InputError
from tscorr.grid import Block, Grid
from tscorr.sensor.tables import number, read_columns
from tscorr.sensor.views import Look, View, ground, place, unit

Array = NDArray[Any]
ReadIds = Callable[[Grid, Block], Array]
"""camera numbers (rows, cols) over a block of a grid; any number that no camera has where there is none"""


@dataclass(frozen=True, slots=True)
class Cameras:
    """Projection centres (3, cameras) by number, in ascending order, in coordinates of the grid. [m]"""

    ids: Array
    positions: Array
    file: str

    def places(self, ids: Array) -> Array:
        """Index of the camera of each number; -1 where there is none."""
        index = np.searchsorted(self.ids, ids).clip(max=self.ids.size - 1)
        return np.where(self.ids[index] == ids, index, -1)


@dataclass(frozen=True)
class MosaicView(View):
    """An orthomosaic: each pixel is seen from the projection centre of the camera it came from."""

    cameras: Cameras
    read: ReadIds

    def look(self, grid: Grid, block: Block, heights: Array, wanted: Array | None = None) -> Look:
        """Vectors (3, rows, cols) to the cameras; unseen where a pixel came from none of them."""
        del wanted
        index = self.cameras.places(self.read(grid, block))
        x, y = ground(grid, block)
        camera = self.cameras.positions[:, index]
        vectors = unit(camera[0] - x, camera[1] - y, camera[2] - heights)
        unseen = index < 0
        if not unseen.any():
            return Look(vectors)
        vectors[:, unseen] = np.array([0.0, 0.0, 1.0])[:, None]
        return Look(vectors, unseen=unseen)

    def check(self, grid: Grid, highest_m: float) -> None:
        """All cameras must be above the highest point of the scene."""
        del grid
        low = int(self.cameras.positions[2].argmin())
        if not self.cameras.positions[2, low] > highest_m:
            raise InputError(
                f"camera {self.cameras.ids[low]} of {self.cameras.file} at height "
                f"{self.cameras.positions[2, low]:.1f} m is not above the surface, whose highest point is at "
                f"{highest_m:.1f} m"
            )

    def describe(self, grid: Grid, block: Block, heights: Array) -> dict[str, str]:
        """The camera of one pixel."""
        del heights
        value = self.read(grid, block)[0, 0]
        index = int(self.cameras.places(value))
        where = "which the table lacks" if index < 0 else place(self.cameras.positions[:, index])
        return {"seen from": f"camera {value}, {where}"}


def read_cameras(
    path: Path,
    to_grid: Callable[[Any, Any], tuple[Array, Array]] | None = None,
    height_offset_m: float = 0.0,
) -> Cameras:
    """A table of cameras from CSV with the columns id, x, y, z.

    to_grid : function (x, y) → (x, y) where the file is in another CRS than the grid.
    Raises InputError naming file, line and value of what is wrong.
    """
    rows, _ = read_columns(path, ("id", "x", "y", "z"), "camera table")
    if not rows:
        raise InputError(f"{path} holds no cameras")
    ids = np.array([_whole_number(row["id"], path, line) for line, row in rows])
    x, y, z = (np.array([number(row[key], key, path, line) for line, row in rows]) for key in "xyz")
    if to_grid is not None:
        x, y = to_grid(x, y)
    order = np.argsort(ids, kind="stable")
    ids = ids[order]
    if (twice := ids[1:][np.diff(ids) == 0]).size:
        raise InputError(f"{path}: id {twice[0]} stands there twice")
    return Cameras(ids, np.stack([x, y, z + height_offset_m])[:, order], str(path))


def _whole_number(text: str | None, path: Path, line: int) -> int:
    try:
        return int(text or "")
    except ValueError:
        raise InputError(f"{path} line {line}: id = {text!r}; allowed is a whole number") from None
