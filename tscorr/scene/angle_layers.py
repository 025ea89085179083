"""The layers of angles and of azimuthal widths, where they are asked for."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import angle_between, facet_angles, true_azimuth, zenith_azimuth
from tscorr.correction import BlockInputs
from tscorr.grid import Block, north_of
from tscorr.scene.plan import Scene
from tscorr.scene.products import ANGLE_NAMES
from tscorr.width import typical_lobe, width_table

Array = NDArray[Any]

ROWS = 64
"""rows whose angles are found at once: they are float64 meanwhile"""
OF_EVERY_PIXEL = {"angles", "azimuthal_width"}
"""products that need directions where no material with a peak is"""
OF_SUN = {"incidence", "solar_zenith", "solar_azimuth"}
"""angles that need no view"""


class AngleLayers:
    """The layers of one scene.

    products : those that are written. peaks : which rows of the corrector have a lobe.
    """

    def __init__(self, scene: Scene, products: set[str], peaks: Array) -> None:
        self._scene = scene
        self._products = products & OF_EVERY_PIXEL
        self._peaks = peaks
        self._north = north_of(scene.grid)
        wanted = "azimuthal_width" in products
        self._tables = [
            width_table(typical_lobe(parameters), rules.form) if peak and wanted else None
            for (_, parameters, rules), peak in zip(scene.materials, peaks[1:], strict=True)
        ]

    def __bool__(self) -> bool:
        """Whether any is asked for."""
        return bool(self._products)

    def of_block(self, block: Block, inputs: BlockInputs, unseen: Array | None) -> dict[str, Array]:
        """The layers of angles and widths that are asked for, float32; nan where they need a view and are unseen."""
        layers: dict[str, Array] = {}
        if "azimuthal_width" in self._products:
            layers["azimuthal_width"] = self._azimuthal_width(inputs)[None]
        if "angles" in self._products:
            layers["angles"] = np.empty((len(ANGLE_NAMES), *block.shape), np.float32)
            for first in range(0, block.height, ROWS):
                rows = slice(first, min(first + ROWS, block.height))
                part = Block(block.row + first, block.col, rows.stop - first, block.width)
                layers["angles"][:, rows] = self._angles(
                    part, *(_rows_of(v, rows) for v in (inputs.sun, inputs.view, inputs.normal))
                )
            if unseen is not None:
                of_view = [i for i, name in enumerate(ANGLE_NAMES) if name not in OF_SUN]
                layers["angles"][of_view] = np.where(unseen, np.float32(np.nan), layers["angles"][of_view])
        return layers

    def _angles(self, block: Block, sun: Array, view: Array, normal: Array) -> Array:
        """The angles of a block from its vectors, in the order of ANGLE_NAMES."""
        angles = facet_angles(sun, view, normal)
        for name, vectors in (("solar", sun), ("view", view)):
            zenith, azimuth = zenith_azimuth(vectors)
            constant = vectors.shape[1:] == (1, 1)  # then the direction was given for the centre
            convergence = self._scene.sun.convergence_deg if constant else self._north.convergence_deg(block)
            angles |= {f"{name}_zenith": zenith, f"{name}_azimuth": true_azimuth(azimuth, convergence)}
        return np.stack([np.broadcast_to(angles[name], block.shape).astype(np.float32) for name in ANGLE_NAMES])

    def _azimuthal_width(self, inputs: BlockInputs) -> Array:
        """Azimuthal width of the peak for the material and incidence of each pixel, nan where none. [deg]"""
        rows = inputs.material
        widths = np.full(rows.shape, np.nan, np.float32)
        if self._peaks[rows].any():
            incidence = np.broadcast_to(angle_between(inputs.sun, inputs.normal), rows.shape)
            for row, table in enumerate(self._tables, start=1):
                mine = rows == row
                if table is not None and mine.any():
                    widths[mine] = table.at(incidence[mine])
        return widths


def _rows_of(vectors: Array, rows: slice) -> Array:
    """Some rows of vectors (3, rows, cols), either of which may be one for all."""
    return vectors if vectors.shape[1] == 1 else vectors[:, rows]
