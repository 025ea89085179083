"""Blocks of level ground that are out of reach of every lobe, for certain (`width.f_spec_bound`).

A block is cut into patches. Sun and view of a patch lie within small cones, so its angles lie in a box, for which
there is a number that f_spec does not exceed. What a block out of reach is flagged with must be as certain: every
pixel lit, seen and not too steep, and G below 1 in all of them or in none, since the report counts them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr import config
from tscorr.angles import angle_between, relative_azimuth, zenith_azimuth
from tscorr.correction import is_extra, steepest_deg
from tscorr.grid import Block
from tscorr.scene.plan import Scene
from tscorr.sensor import Fan
from tscorr.width import f_spec_bound

Array = NDArray[Any]

PATCH_PX = 64
ROUNDING_DEG = 1e-3
"""more than directions and cosines of the correction err by"""
ROUNDING = 1e-4
"""part of the threshold that is left to the rounding of the correction"""


class Cones(NamedTuple):
    """Directions that lie within an angle of an axis.

    axis       : unit vectors (3, patches).
    spread_deg : (patches,).
    """

    axis: Array
    spread_deg: Array

    @property
    def zenith_deg(self) -> tuple[Array, Array]:
        """Lowest and highest zenith angle, each (patches,)."""
        zenith, _ = zenith_azimuth(self.axis)
        return np.maximum(zenith - self.spread_deg, 0), zenith + self.spread_deg

    @property
    def azimuth_spread_deg(self) -> Array:
        """Largest difference of azimuth from that of the axis; 180 where the zenith lies within. (patches,)"""
        zenith, _ = zenith_azimuth(self.axis)
        inside = self.spread_deg >= zenith
        sine = np.sin(np.deg2rad(self.spread_deg)) / np.where(inside, 1, np.sin(np.deg2rad(zenith)))
        return np.where(inside, 180.0, np.rad2deg(np.arcsin(np.minimum(sine, 1))))


@dataclass(frozen=True)
class Reach:
    """What of a scene of level ground the lobes can reach."""

    scene: Scene
    fan: Fan
    height_m: float

    @classmethod
    def of(cls, scene: Scene) -> "Reach | None":
        """None where nothing can be said: on a surface model, or where directions come from rasters.

        Or where more than the sun's part is subtracted: the sky shines from everywhere.
        """
        surface = scene.settings.surface
        if not isinstance(surface, config.FlatSettings) or not np.isfinite(scene.sun.spread_deg):
            return None
        if any(rules.enabled and is_extra(rules) for *_, rules in scene.materials):
            return None
        fan = scene.view.fan(scene.grid)
        return None if fan is None else cls(scene, fan, surface.height_m)

    def attenuated(self, block: Block, rows: Iterable[int]) -> bool | None:
        """Whether G is below 1 in a block out of reach of the materials of these rows; None where it may be reached.

        rows : of the corrector, from 1; no more of them are asked for than up to the first that may be reached.
        """
        sun, view = self._cones(block)
        if np.isnan(view.spread_deg).any():
            return None
        zenith_i, zenith_r = sun.zenith_deg, view.zenith_deg
        phi = relative_azimuth(zenith_azimuth(view.axis)[1], zenith_azimuth(sun.axis)[1])
        turn = sun.azimuth_spread_deg + view.azimuth_spread_deg
        phis = np.maximum(phi - turn, 0), np.minimum(phi + turn, 180)
        for row in rows:
            if not self._assessed(row, zenith_i, zenith_r) or self._may_reach(row, zenith_i, zenith_r, phis):
                return None
        return _attenuated(sun, view)

    def _cones(self, block: Block) -> tuple[Cones, Cones]:
        """Sun and view of the patches of a block."""
        edges = [
            np.append(np.arange(first, first + size - 1, PATCH_PX), first + size - 1)
            if size > 1
            else np.array([first, first])
            for first, size in ((block.row, block.height), (block.col, block.width))
        ]
        (top, left), (bottom, right) = (
            np.meshgrid(edges[0][part], edges[1][part]) for part in (np.s_[:-1], np.s_[1:])
        )
        corner_rows, corner_cols = np.stack([top, top, bottom, bottom]), np.stack([left, right, right, left])
        x, y = self.scene.grid.xy(corner_rows.reshape(4, -1), corner_cols.reshape(4, -1))
        vectors, off_deg = self.fan(x, y, self.height_m)
        vectors = vectors / np.sqrt((vectors**2).sum(axis=0))
        axis = vectors.sum(axis=1)
        axis = axis / np.sqrt((axis**2).sum(axis=0))
        spread = angle_between(vectors, axis[:, None]).max(axis=0) + off_deg + ROUNDING_DEG
        of_sun = np.full(spread.shape, self.scene.sun.spread_deg + ROUNDING_DEG)
        return Cones(np.broadcast_to(self.scene.sun.center[:, None], axis.shape), of_sun), Cones(axis, spread)

    def _assessed(self, row: int, *zeniths: tuple[Array, Array]) -> bool:
        """Whether incidence and exitance are certainly within what a material allows."""
        surface, _, rules = self.scene.materials[row - 1]
        low, high = surface.zenith_range_deg[0], steepest_deg(surface, rules)
        steep = max(float(highest.max()) for _, highest in zeniths) >= high - ROUNDING_DEG
        level = low > 0 and np.cos(min(np.deg2rad(lowest).min() for lowest, _ in zeniths)) > np.cos(
            np.deg2rad(low)
        ) * (1 - ROUNDING)
        return not (steep or level)

    def _may_reach(
        self, row: int, zenith_i: tuple[Array, Array], zenith_r: tuple[Array, Array], phi: tuple[Array, Array]
    ) -> bool:
        """Whether a material may have as much as its threshold to remove in any patch and band."""
        _, parameters, rules = self.scene.materials[row - 1]
        gain = np.pi * np.asarray(rules.direct_fraction) * parameters.t1
        bands = np.unique(np.stack([gain, parameters.w, parameters.n, parameters.k]), axis=1)
        gain, w, n, k = bands[..., None]
        bound = f_spec_bound(zenith_i, zenith_r, phi, w, n, k, simplified=rules.form == "simplified")
        bound = np.where(gain > 0, gain * bound, 0)  # and not 0 times inf
        return bool(np.any(bound >= rules.negligible_reflectance * (1 - ROUNDING)))


def _attenuated(sun: Cones, view: Cones) -> bool | None:
    """Whether G is below 1 in all patches (True) or in none (False); None where that is not certain.

    G is 1 where min(ci, cr) (ci + cr) >= cos^2 of half the angle between sun and view.
    """
    apart = angle_between(sun.axis, view.axis)
    unsure = sun.spread_deg + view.spread_deg
    (low_i, high_i), (low_r, high_r) = sun.zenith_deg, view.zenith_deg
    least = _lesser_times_sum(high_i, high_r)
    most = _lesser_times_sum(low_i, low_r)
    if np.all(least > _cos2_half(np.maximum(apart - unsure, 0)) * (1 + ROUNDING)):
        return False
    if np.all(most < _cos2_half(np.minimum(apart + unsure, 180)) * (1 - ROUNDING)):
        return True
    return None


def _lesser_times_sum(incidence_deg: Array, exitance_deg: Array) -> Array:
    cos_i, cos_r = np.cos(np.deg2rad(incidence_deg)), np.cos(np.deg2rad(exitance_deg))
    return np.minimum(cos_i, cos_r) * (cos_i + cos_r)


def _cos2_half(angle_deg: Array) -> Array:
    return np.cos(np.deg2rad(angle_deg / 2)) ** 2
