"""A line scanner: each pixel is seen from the point of the trajectory whose scan plane goes over it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import angle_between
from tscorr.errors import InputError
from tscorr.grid import Block, Grid
from tscorr.sensor.trajectory import Trajectory
from tscorr.sensor.views import Fan, Look, View, ground, place, unit

Array = NDArray[Any]

SWATH_ZENITH_DEG = 60.0
"""a pass that sees a point farther from the vertical than this is no second pass over the scene"""
SAME_DIRECTION_DEG = 1.0
SAME_TIME_S = 60.0
"""two passes that agree to these are one: a scanner that yaws goes over a point several times"""
ASIDE_CELLS, TURNED_DEG = 0.25, 0.2
"""a trajectory whose samples lie no farther aside, and whose scan planes are turned no more, is straight"""
LEAST_SEEN = 0.7
"""share of the scene that a trajectory must pass; image corners beyond a line's end hold no data"""
SAMPLES = 9
"""a scene is looked at in SAMPLES x SAMPLES points before work starts"""
NEARLY_M = 1e-6
"""more than a distance along the track errs by, in coordinates of maps"""
SAMPLES_AT_ONCE = 4096
"""of a trajectory, for each of those points"""


@dataclass(frozen=True)
class LineView(View):
    """A line scanner: a pixel is seen from the point of the trajectory whose scan plane holds it.

    With no attitude the scan plane is upright and across the track: the pixel is seen from the point abeam.
    Heading turns it about the vertical and pitch tilts it; roll moves the swath within it and changes no
    vector. Roll is positive with the right wing down, pitch with the nose up, heading clockwise from north.

    A point that several planes go over is seen in the nearest pass; `check` refuses a trajectory with two passes
    over the scene that differ. Turns outside of it do no harm. A point that no plane goes over is unseen.
    """

    trajectory: Trajectory

    @cached_property
    def path(self) -> Trajectory:
        """The trajectory, half of its longest step longer at either end."""
        return self.trajectory.longer(0.5 * float(np.diff(self.trajectory.seconds).max()))

    @cached_property
    def _samples(self) -> Array:
        """(samples, 6), position and forward vector."""
        return np.ascontiguousarray(self.path.table.T)

    def look(self, grid: Grid, block: Block, heights: Array, wanted: Array | None = None) -> Look:
        """Vectors (3, rows, cols) from the surface to the sensor as it passed, and when that was."""
        x, y = ground(grid, block)
        seconds, vectors = self._passes(x, y, heights, wanted)
        unseen = np.isnan(seconds)
        if not unseen.any():
            return Look(vectors, seconds)
        return Look(vectors, np.where(unseen, 0.0, seconds), unseen)

    def _passes(self, x: Array, y: Array, z: Array, wanted: Array | None = None) -> tuple[Array, Array]:
        """Times (rows, cols) and vectors (3, rows, cols) of points that broadcast to (rows, cols)."""
        from tscorr.sensor.compiled import EVERYWHERE, passes

        shape = np.broadcast_shapes(x.shape, y.shape, z.shape)
        points = np.stack([np.broadcast_to(values, shape).astype(np.float64) for values in (x, y, z)])
        candidates, wanted = self._candidates(*points), EVERYWHERE if wanted is None else wanted
        return passes(points, self.path.seconds, self._samples, candidates, wanted)

    def _candidates(self, x: Array, y: Array, z: Array) -> Array:
        """Samples k such that the scan plane may go over one of the points between k and k + 1."""
        low, high = np.array([[values.min(), values.max()] for values in (x, y, z)]).T
        position, forward = self.path.table[:3], self.path.table[3:]
        ahead = (((low + high) / 2)[:, None] - position) * forward
        reach = ((high - low) / 2 + 1e-6)[:, None] * np.abs(forward)
        ahead, reach = ahead.sum(axis=0), reach.sum(axis=0)
        return np.flatnonzero((ahead[:-1] + reach[:-1] > 0) & (ahead[1:] - reach[1:] <= 0))

    def _passes_of(self, point: Array, candidates: Array) -> tuple[Array, Array]:
        """All passes over one point (3,): times (passes,) and unit vectors (3, passes), the nearest first."""
        path = self.path
        before, after = (
            ((point[:, None] - path.table[:3, k]) * path.table[3:, k]).sum(axis=0)
            for k in (candidates, candidates + 1)
        )
        passed = (before > 0) & (after <= 0)
        k, part = candidates[passed], (before / np.where(passed, before - after, 1.0))[passed]
        seconds = path.seconds[k] + part * (path.seconds[k + 1] - path.seconds[k])
        away = path.at(seconds)[0] - point[:, None]
        order = np.argsort((away**2).sum(axis=0), kind="stable")
        return seconds[order], unit(*away[:, order])

    def _passes_of_each(self, points: Array) -> list[tuple[Array, Array]]:
        """`_passes_of` for each of some points (3, ...)."""
        candidates, points = self._candidates(*points), points.reshape(3, -1)
        position, forward = self.path.table[:3], self.path.table[3:]
        offset = (position * forward).sum(axis=0)[:, None]
        passed = [np.zeros((0, points.shape[1]), np.bool_)]
        for k in np.array_split(candidates, candidates.size // SAMPLES_AT_ONCE + 1):
            before, after = (forward[:, sample].T @ points - offset[sample] for sample in (k, k + 1))
            passed.append((before > -NEARLY_M) & (after <= NEARLY_M))
        maybe = np.concatenate(passed)
        return [self._passes_of(point, candidates[maybe[:, i]]) for i, point in enumerate(points.T)]

    def straight(self, grid: Grid) -> tuple[Array, Array] | None:
        """Two points (3,) of the trajectory if it is straight over the grid, its scan planes upright across it.

        Straight to a quarter of a pixel, and to 0.2 degrees of heading and pitch: then what is hidden from
        the sensor can be found in one sweep. Otherwise None.
        """
        path = self._over(grid)
        start, end = path.table[:3, 0], path.table[:3, -1]
        along = (end - start) / np.linalg.norm(end - start)
        offset = path.table[:3].T - start
        aside = np.linalg.norm(offset - (offset @ along)[:, None] * along, axis=1)
        turned = np.rad2deg(np.linalg.norm(path.forward.T - along, axis=1))
        is_straight = aside.max() < ASIDE_CELLS * min(grid.cell_size) and turned.max() < TURNED_DEG
        return (start, end) if is_straight else None

    def fan(self, grid: Grid) -> Fan | None:
        """Where the trajectory is straight over the grid, the perpendiculars to it, and how far off they may be.

        With scan planes turned by at most d and samples s apart, a perpendicular of length u is d (1 + s / u) off,
        and asin(a / u) for samples that lie up to a aside. Patches that another part of the trajectory may pass, or
        that reach beyond its ends, are not certain.
        """
        ends = self.straight(grid)
        if ends is None:
            return None
        start, end = ends
        along = (end - start) / np.linalg.norm(end - start)
        path, over = self.path, self._over(grid)
        step_m = float(np.linalg.norm(np.diff(over.table[:3]), axis=0).max())
        aside_m = ASIDE_CELLS * min(grid.cell_size)

        def bounds(x: Array, y: Array, height_m: float) -> tuple[Array, Array]:
            points = np.stack([x, y, np.full_like(x, height_m)])
            beside = start[:, None, None] - points
            vectors = beside - along[:, None, None] * np.tensordot(along, beside, 1)
            length = np.sqrt((vectors**2).sum(axis=0)).min(axis=0)
            off_deg = TURNED_DEG * (1 + step_m / length) + np.rad2deg(np.arcsin(np.minimum(1, aside_m / length)))
            candidates = path.seconds[self._candidates(*points)]
            elsewhere = (candidates < over.seconds[0]) | (candidates >= over.seconds[-1])
            first, last = (np.tensordot(over.table[3:, k], points - over.table[:3, k, None, None], 1) for k in (0, -1))
            seen = ((first > 0) & (last <= 0)).all(axis=0) & ~elsewhere.any()
            return vectors, np.where(seen, off_deg, np.nan)

        return bounds

    def span(self, grid: Grid, height_m: float) -> tuple[float, float, float]:
        """When the first, the middle and the last point of a level grid were seen, in seconds of the trajectory.

        To a small part of a step: as if scan planes turned evenly between samples, and nothing is compiled for it.
        Points that no scan plane goes over are left out. Raises InputError where that is all of them.
        """
        passes = self._passes_of_each(np.stack([*_lattice(grid), np.full((SAMPLES, SAMPLES), height_m)]))
        seconds = np.array([next(iter(times), np.nan) for times, _ in passes]).reshape(SAMPLES, SAMPLES)
        seen = seconds[np.isfinite(seconds)]
        if not seen.size:
            raise InputError(
                f"the trajectory {self.trajectory.file} does not cover the scene: it passes over none of it"
            )
        middle = seconds[SAMPLES // 2, SAMPLES // 2]
        return float(seen.min()), float(middle if np.isfinite(middle) else np.median(seen)), float(seen.max())

    def _over(self, grid: Grid) -> Trajectory:
        """The part of the trajectory that passes the grid."""
        path = self.path
        first_s, _, last_s = self.span(grid, float(path.z.min()) - 1)
        first = int(np.searchsorted(path.seconds, first_s, side="right")) - 1
        last = int(np.searchsorted(path.seconds, last_s, side="left"))
        return path.part(slice(first, max(last, first + 1) + 1))

    def check(self, grid: Grid, highest_m: float) -> None:
        """The trajectory must pass the grid, above it, and only once."""
        path = self.trajectory
        x, y = _lattice(grid)
        passes = self._passes_of_each(np.stack([x, y, np.full_like(x, min(highest_m, float(path.z.min()) - 1))]))
        seen = sum(seconds.size > 0 for seconds, _ in passes) / len(passes)
        if seen < LEAST_SEEN:
            raise InputError(
                f"the trajectory {path.file} does not cover the scene: it passes over {seen:.0%} of it between its "
                f"first sample and its last; allowed is {LEAST_SEEN:.0%} or more"
            )
        for seconds, vectors in passes:
            self._require_one_pass(seconds, vectors)
        over = self._over(grid)
        if not over.z.min() > highest_m:
            raise InputError(
                f"the trajectory {path.file} goes down to {over.z.min():.1f} m; the highest point of the surface "
                f"is at {highest_m:.1f} m"
            )

    def _require_one_pass(self, seconds: Array, vectors: Array) -> None:
        """Raise InputError where a point is seen in two passes that differ, neither of them from far aside."""
        near = vectors[2] > np.cos(np.deg2rad(SWATH_ZENITH_DEG))
        for other in np.flatnonzero(near[1:]) + 1:
            apart = float(angle_between(vectors[:, 0], vectors[:, other]))
            if apart > SAME_DIRECTION_DEG or abs(seconds[other] - seconds[0]) > SAME_TIME_S:
                times = sorted(self.trajectory.time(seconds[i]) for i in (0, other))
                raise InputError(
                    f"the trajectory {self.trajectory.file} passes the scene twice, at {times[0]:%H:%M:%S} and at "
                    f"{times[1]:%H:%M:%S}; give the view start = ... and end = ... to say which line the image is of"
                )

    def describe(self, grid: Grid, block: Block, heights: Array) -> dict[str, str]:
        """When one pixel was seen, and from where."""
        look = self.look(grid, block, heights)
        assert look.seconds is not None
        if look.unseen is not None:
            return {"seen at": "never: no scan plane of the trajectory goes over the pixel"}
        seconds = look.seconds[0, 0]
        time = self.trajectory.time(seconds)
        return {
            "seen at": f"{time.isoformat(timespec='milliseconds')}, {seconds:.3f} s after {self.trajectory.start}",
            "seen from": place(self.path.at(seconds)[0]),
        }


def _lattice(grid: Grid) -> tuple[Array, Array]:
    """Map coordinates (SAMPLES, SAMPLES) of pixels spread evenly over a grid, from edge to edge."""
    rows, cols = grid.shape
    x, y = grid.xy(np.linspace(0, rows - 1, SAMPLES)[:, None], np.linspace(0, cols - 1, SAMPLES)[None, :])
    x, y = np.broadcast_arrays(x, y)
    return x, y
