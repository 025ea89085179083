"""One pass of a sweep: the lines of a scene, rows or columns, in the order away from the source.

Rays lie on the map and cross the lines; what each carries from line to line is in `sightlines`.
"""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.terrain import sightlines

Heights = NDArray[np.float32]
Mask = NDArray[np.bool_]
Triple = tuple[float, float, float]

HALO_PX = 3  # what a leg reads beside the pixels that it judges


class Axes(NamedTuple):
    """How a leg sees the scene: `lines` of `width` pixels, passed in the order away from the source.

    Lines are columns if `transposed`, and counted from the last if `backwards`; pixels along a line
    are counted as rows or columns are.
    """

    lines: int
    width: int
    line_m: float
    pixel_m: float
    transposed: bool
    backwards: bool

    def vector(self, east: float, north: float) -> tuple[float, float]:
        """A vector [m] in lines and pixels."""
        line, pixel = (east, -north) if self.transposed else (-north, east)
        return (-line if self.backwards else line) / self.line_m, pixel / self.pixel_m

    def point(self, east: float, north: float) -> tuple[float, float]:
        """A position [m] in lines and pixels, both 0 at the centre of the first."""
        line, pixel = self.vector(east, north)
        return (line + self.lines - 1 if self.backwards else line), pixel

    def end(self, rows: tuple[int, int] | None) -> int:
        """The line behind which none of these rows, first and last + 1, lies; all lines if not given."""
        if rows is None or self.transposed:
            return self.lines
        first, last = rows
        return min(max(self.lines - first if self.backwards else last, 0), self.lines)

    def next_multiple(self, line: int, step: int) -> int:
        """The next line after `line` at which a row or column number is a multiple of `step`, or the end."""
        if self.backwards:
            return self.lines - (self.lines - 1 - line) // step * step
        return min((line // step + 1) * step, self.lines)


def axes_away(shape: tuple[int, int], away: tuple[float, float], cell_x_m: float, cell_y_m: float) -> Axes:
    """Rows or columns, whichever are crossed more often on the way `away` (east, north)."""
    rows, cols = shape
    east, north = away
    if abs(east) / cell_x_m > abs(north) / cell_y_m:
        return Axes(cols, rows, cell_x_m, cell_y_m, transposed=True, backwards=east < 0)
    return Axes(rows, cols, cell_y_m, cell_x_m, transposed=False, backwards=north > 0)


class Leg(ABC):
    """One pass of a sweep; lines before `first` have no pixel to judge."""

    axes: Axes
    first: int

    @abstractmethod
    def span(self, line: int) -> tuple[int, int]:
        """First and last + 1 of the pixels that the lines up to `line` need."""

    @abstractmethod
    def judge(self, heights: Heights, visible: Mask, first: int, low: int, tolerance_m: float) -> None:
        """Write what is visible of the pixels from line `first` and pixel `low` on."""


class ParallelLeg(Leg):
    """A pass along parallel rays, which move `slant` pixels a line.

    Towards a direction, the line of sight falls by `drop_m` a line. Abeam of a straight trajectory
    it falls from an apex there: `depth` and `apex` are planes (value at the origin, per line, per
    pixel) of the distance from the trajectory, counted in lines, and of the apex' height.
    """

    def __init__(
        self,
        axes: Axes,
        slant: float,
        *,
        drop_m: float = 0.0,
        depth: Triple | None = None,
        apex: Triple = (0.0, 0.0, 0.0),
    ) -> None:
        self.axes = axes
        self._slant, self._drop_m, self._depth = slant, drop_m, depth
        self._origin_m = None if depth is None else apex[0]
        self._apex = (0.0, *apex[1:])
        steps_m = math.hypot(axes.line_m, slant * axes.pixel_m), axes.pixel_m
        self._walls_m = sightlines.WALL_SLOPE * steps_m[0], sightlines.WALL_SLOPE * steps_m[1]
        shift = math.floor(slant * (axes.lines - 1))
        self._ray0 = 1 + max(shift, 0)
        self._rays = np.full((2, axes.width + 1 + abs(shift)), sightlines.VOID)
        self.first = next((j for j in range(axes.lines) if range(*self._judged(j))), axes.lines)

    def _judged(self, line: int) -> tuple[int, int]:
        """First and last + 1 of the pixels that lie beyond the trajectory."""
        width = self.axes.width
        if self._depth is None:
            return 0, width
        at_origin, per_line, per_pixel = self._depth
        depth = at_origin + per_line * line
        if abs(per_pixel) * width < 1e-9:  # the line runs along the trajectory
            return 0, width if depth > 0 else 0
        edge = min(max(-depth / per_pixel, -1.0), float(width))
        return (math.floor(edge) + 1, width) if per_pixel > 0 else (0, math.ceil(edge))

    def span(self, line: int) -> tuple[int, int]:
        """What lies beyond the trajectory, which grows from line to line."""
        low, high = self._judged(line)
        return max(low - HALO_PX, 0), min(high + HALO_PX, self.axes.width)

    def judge(self, heights: Heights, visible: Mask, first: int, low: int, tolerance_m: float) -> None:
        """Write what is visible; see `sightlines.judge_parallel`."""
        if self._origin_m is None:
            self._origin_m = _first_height(self.axes, heights)
        sightlines.judge_parallel(
            heights,
            visible,
            self._rays,
            *_scratch(self.axes, heights),
            transposed=self.axes.transposed,
            backwards=self.axes.backwards,
            first=first,
            low=low,
            ray0=self._ray0,
            slant=self._slant,
            drop=self._drop_m,
            central=self._depth is not None,
            depth=self._depth or (0.0, 0.0, 0.0),
            apex=self._apex,
            origin=self._origin_m or 0.0,
            walls=self._walls_m,
            tolerance=tolerance_m,
        )


class FanLeg(Leg):
    """A pass over one quadrant around the nadir of a frame camera; rays fan out from there.

    The rays are a pixel apart on the last line, closer before. `nadir` is in lines and pixels.
    """

    def __init__(self, axes: Axes, nadir: tuple[float, float], height_m: float) -> None:
        self.axes = axes
        self._nadir, self._height_m = nadir, height_m
        aside = max(-nadir[1], nadir[1] - (axes.width - 1), 0.0)  # lines on which rays have not come so far
        self.first = min(max(math.floor(nadir[0] + max(aside, 1.0)), 0), axes.lines)
        self._tangents = _tangents(axes, nadir, self.first)
        self._rays = np.full((2, self._tangents.size), sightlines.VOID)
        steps_m = np.hypot(axes.line_m, self._tangents * axes.pixel_m)
        self._walls_m = (sightlines.WALL_SLOPE * steps_m).astype(np.float32)

    def span(self, line: int) -> tuple[int, int]:
        """The quadrant, which grows from line to line."""
        (nadir_line, nadir_pixel), width = self._nadir, self.axes.width
        low = math.floor(nadir_pixel - (line - nadir_line)) - HALO_PX
        high = math.ceil(nadir_pixel + (line - nadir_line)) + HALO_PX + 1
        return min(max(low, 0), width), min(max(high, 0), width)

    def judge(self, heights: Heights, visible: Mask, first: int, low: int, tolerance_m: float) -> None:
        """Write what is visible; see `sightlines.judge_fan`."""
        sightlines.judge_fan(
            heights,
            visible,
            self._rays,
            *_scratch(self.axes, heights),
            self._tangents,
            self._walls_m,
            transposed=self.axes.transposed,
            backwards=self.axes.backwards,
            first=first,
            low=low,
            scene_width=self.axes.width,
            nadir=self._nadir,
            origin=self._height_m,
            wall_across=sightlines.WALL_SLOPE * self.axes.pixel_m,
            tolerance=tolerance_m,
        )


def _scratch(axes: Axes, heights: Heights) -> tuple[NDArray[np.float32], Mask]:
    """Memory for one line of heights, and for what is seen of it."""
    width = heights.shape[0 if axes.transposed else 1]
    return np.empty(width + 2, np.float32), np.ones(width, np.bool_)


def _tangents(axes: Axes, nadir: tuple[float, float], first: int) -> NDArray[np.float64]:
    """Pixels a line of the rays that meet the scene from line `first` on, one more on either side."""
    if first >= axes.lines:
        return np.empty(0)
    near, far = first - nadir[0], axes.lines - 1 - nadir[0]
    left, right = -nadir[1], axes.width - 1 - nadir[1]
    lowest = min(max(left / (far if left > 0 else near), -1.0), 1.0)
    highest = max(min(right / (near if right > 0 else far), 1.0), -1.0)
    rays = math.ceil((highest - lowest) * far) + 3
    return lowest + (np.arange(rays) - 1) / far


def _first_height(axes: Axes, heights: Heights) -> float | None:
    """The first height on the way that is no void, or None: the same however the scene is cut."""
    lines = heights.T if axes.transposed else heights
    for line in lines[::-1] if axes.backwards else lines:
        finite = line[np.isfinite(line)]
        if finite.size:
            return float(finite[0])
    return None
