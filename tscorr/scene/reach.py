"""Blocks of level ground that are out of reach of every lobe, for certain (`width.f_spec_bound`).

The ground is cut into patches. Sun and view of a patch lie within small cones, so its angles lie in a box, for which
there is a number that f_spec does not exceed. What a block out of reach is flagged with must be as certain: every
pixel lit, seen and not too steep, and G below 1 in all of them or in none, since the report counts them.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
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
REGION_COLUMNS = 3072
"""as many blocks as fit make a region: little enough memory for hundreds of bands"""
KEPT_REGIONS = 8
FAN_PATCHES = 8
"""columns of patches that a line scanner is asked for at a time: what else may pass one of them counts for all"""
ROUNDING_DEG = 1e-3
"""more than directions and cosines of the correction err by"""
ROUNDING = 1e-4
"""part of the threshold that is left to the rounding of the correction"""


class Cones(NamedTuple):
    """Directions that lie within an angle of an axis.

    axis       : unit vectors (3, rows, cols) of patches.
    spread_deg : (rows, cols).
    """

    axis: Array
    spread_deg: Array

    @property
    def zenith_deg(self) -> tuple[Array, Array]:
        """Lowest and highest zenith angle, each (rows, cols)."""
        zenith, _ = zenith_azimuth(self.axis)
        return np.maximum(zenith - self.spread_deg, 0), zenith + self.spread_deg

    @property
    def azimuth_spread_deg(self) -> Array:
        """Largest difference of azimuth from that of the axis; 180 where the zenith lies within. (rows, cols)"""
        zenith, _ = zenith_azimuth(self.axis)
        inside = self.spread_deg >= zenith
        sine = np.sin(np.deg2rad(self.spread_deg)) / np.where(inside, 1, np.sin(np.deg2rad(zenith)))
        return np.where(inside, 180.0, np.rad2deg(np.arcsin(np.minimum(sine, 1))))


@dataclass(frozen=True)
class Reach:
    """What of a scene of level ground the lobes can reach; any thread may ask."""

    scene: Scene
    fan: Fan
    height_m: float
    _regions: "OrderedDict[Block, Region]" = field(default_factory=OrderedDict, repr=False, compare=False)
    _lock: Any = field(default_factory=threading.Lock, repr=False, compare=False)

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
        with self._lock:
            region = self._region(block)
        patches = region.patches(block)
        if region.unknown[:, patches].any():
            return None
        for row in rows:
            with self._lock:
                if row not in region.may_reach:
                    region.may_reach[row] = self._may_reach(region, row)
            if region.may_reach[row][:, patches].any():
                return None
        return next((state for state, certain in region.attenuated.items() if certain[:, patches].all()), None)

    def _region(self, block: Block) -> "Region":
        """The region that holds a block; the last ones are kept."""
        columns = max(1, REGION_COLUMNS // block.width) * block.width
        first = block.col // columns * columns
        last = min(-(-(block.col + block.width) // columns) * columns, self.scene.grid.shape[1])
        place = Block(block.row, first, block.height, last - first)
        region = self._regions.pop(place, None) or Region(place, *self._cones(place))
        self._regions[place] = region
        if len(self._regions) > KEPT_REGIONS:
            self._regions.popitem(last=False)
        return region

    def _cones(self, block: Block) -> tuple[Cones, Cones]:
        """Sun and view of the patches of a block, (rows, cols) of them."""
        edges = [
            np.append(np.arange(first, first + size - 1, PATCH_PX), first + size - 1)
            if size > 1
            else np.array([first, first])
            for first, size in ((block.row, block.height), (block.col, block.width))
        ]
        (top, left), (bottom, right) = (
            np.meshgrid(edges[0][part], edges[1][part], indexing="ij") for part in (np.s_[:-1], np.s_[1:])
        )
        corner_rows, corner_cols = np.stack([top, top, bottom, bottom]), np.stack([left, right, right, left])
        vectors, off_deg = np.empty((3, *corner_rows.shape)), np.empty(top.shape)
        for start in range(0, top.shape[1], FAN_PATCHES):
            part = np.s_[..., start : start + FAN_PATCHES]
            x, y = self.scene.grid.xy(corner_rows[part].reshape(4, -1), corner_cols[part].reshape(4, -1))
            found, off = self.fan(x, y, self.height_m)
            vectors[part], off_deg[part] = found.reshape(vectors[part].shape), off.reshape(off_deg[part].shape)
        vectors = vectors / np.sqrt((vectors**2).sum(axis=0))
        axis = vectors.sum(axis=1)
        axis = axis / np.sqrt((axis**2).sum(axis=0))
        spread = angle_between(vectors, axis[:, None]).max(axis=0) + off_deg + ROUNDING_DEG
        of_sun = np.full(spread.shape, self.scene.sun.spread_deg + ROUNDING_DEG)
        center = self.scene.sun.center.reshape(3, 1, 1)
        return Cones(np.broadcast_to(center, axis.shape), of_sun), Cones(axis, spread)

    def _may_reach(self, region: "Region", row: int) -> Array:
        """The patches that the lobe of a material may reach, or in which it may not be assessed: bool."""
        surface, parameters, rules = self.scene.materials[row - 1]
        low, high = surface.zenith_range_deg[0], steepest_deg(surface, rules)
        uncertain = np.maximum(region.zenith_i[1], region.zenith_r[1]) >= high - ROUNDING_DEG
        if low > 0:
            lowest = np.minimum(region.zenith_i[0], region.zenith_r[0])
            uncertain |= np.cos(np.deg2rad(lowest)) > np.cos(np.deg2rad(low)) * (1 - ROUNDING)
        gain = np.pi * np.asarray(rules.direct_fraction) * parameters.t1
        bands = np.unique(np.stack([gain, parameters.w, parameters.n, parameters.k]), axis=1)
        gain, w, n, k = bands[:, bands[0] > 0, None, None]
        bound = f_spec_bound(
            region.zenith_i, region.zenith_r, region.phi, w, n, k, simplified=rules.form == "simplified"
        )
        return uncertain | np.any(gain * bound >= rules.negligible_reflectance * (1 - ROUNDING), axis=0)


class Region:
    """Patches of several blocks, whose bounds are worked out together: for one alone most of the time is overhead.

    All arrays are of patches, (rows, cols).
    """

    def __init__(self, place: Block, sun: Cones, view: Cones) -> None:
        self._place = place
        self.unknown = np.isnan(view.spread_deg)
        self.zenith_i, self.zenith_r = sun.zenith_deg, view.zenith_deg
        """lowest and highest of each"""
        phi = relative_azimuth(zenith_azimuth(view.axis)[1], zenith_azimuth(sun.axis)[1])
        turn = sun.azimuth_spread_deg + view.azimuth_spread_deg
        self.phi = np.maximum(phi - turn, 0), np.minimum(phi + turn, 180)
        """lowest and highest relative azimuth"""
        apart, unsure = angle_between(sun.axis, view.axis), sun.spread_deg + view.spread_deg
        self.attenuated = _attenuated(self.zenith_i, self.zenith_r, apart - unsure, apart + unsure)
        """where G is certainly 1 (False), and where it certainly is less (True)"""
        self.may_reach: dict[int, Array] = {}
        """by row of the corrector"""

    def patches(self, block: Block) -> slice:
        """The columns of patches that a block is covered by."""
        first, last = block.col - self._place.col, block.col + block.width - 1 - self._place.col
        return slice(min(first // PATCH_PX, self.unknown.shape[1] - 1), last // PATCH_PX + 1)


def _attenuated(
    zenith_i: tuple[Array, Array], zenith_r: tuple[Array, Array], nearest_deg: Array, farthest_deg: Array
) -> dict[bool, Array]:
    """Where G is certainly 1 (False), and where it certainly is less (True).

    G is 1 where min(ci, cr) (ci + cr) >= cos^2 of half the angle between sun and view, which lies between two limits.
    """
    (low_i, high_i), (low_r, high_r) = zenith_i, zenith_r
    least = _lesser_times_sum(high_i, high_r)
    most = _lesser_times_sum(low_i, low_r)
    return {
        False: least > _cos2_half(np.maximum(nearest_deg, 0)) * (1 + ROUNDING),
        True: most < _cos2_half(np.minimum(farthest_deg, 180)) * (1 - ROUNDING),
    }


def _lesser_times_sum(incidence_deg: Array, exitance_deg: Array) -> Array:
    cos_i, cos_r = np.cos(np.deg2rad(incidence_deg)), np.cos(np.deg2rad(exitance_deg))
    return np.minimum(cos_i, cos_r) * (cos_i + cos_r)


def _cos2_half(angle_deg: Array) -> Array:
    return np.cos(np.deg2rad(angle_deg / 2)) ** 2
