"""Cast shadow of the sun and occlusion of the view: what stands between a pixel and a source.

The source is the sun or a sensor. Two ways to the same answer:

- Sweeps (`DirectionSweep`, `LineSweep`, `FrameSweep`) go over the DSM in strips that start at the
  source, at a cost a pixel that does not depend on relief or elevation. Rays lie on the map a pixel
  apart; each carries one number, the height below which it has no sight of the source, and takes in
  the surface wherever it crosses a line of pixels. A pixel is judged between its two nearest rays.
- `march` goes from each pixel towards its own source, for any field of directions.

    sweep = DirectionSweep(shape, sun, cell_x_m=0.5, cell_y_m=0.5)
    lit = np.ones(shape, bool)
    for strip in sweep.strips(512):
        lit[strip.slices] &= sweep(strip, heights[strip.slices])

Neither answer depends on how the scene was cut. The surface between two samples is a straight line,
or, where that is steeper than `sightlines.WALL_SLOPE`, a wall midway: a DSM of pixel centres says no
more of where a wall is, and a ramp from eave to ground would shorten every shadow by half a pixel.

Heights are (rows, cols) float32, row 0 in the north, columns from west to east; a void (nan) hides
nothing and is seen by all. Vectors are east, north, up. Positions are relative to the centre of
pixel (0, 0), up in the heights' own datum. Nothing beyond the scene's edge casts a shadow. A facet
that faces away from the source is not the matter of this module, though its ridge may well hide it.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr.errors import InputError
from tscorr.terrain import sightlines
from tscorr.terrain.legs import Axes, FanLeg, Heights, Leg, Mask, ParallelLeg, Triple, axes_away

TOLERANCE_M = 0.05  # a pixel this far below the line of sight counts as seen: noise casts no shadow
SOLAR_RADIUS_DEG = 0.267
COLUMNS_AT_A_TIME = 32  # so that they stay in the cache while they are passed one by one
HIGHEST_SUN_DEG = 89.99  # a slice needs an azimuth


class Strip(NamedTuple):
    """A window of the scene that a sweep asks for; `leg` and `line` are the sweep's own."""

    row: int
    col: int
    height: int
    width: int
    leg: int
    line: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the strip in an array of the whole scene."""
        return slice(self.row, self.row + self.height), slice(self.col, self.col + self.width)


class Sweep:
    """What a source sees of a scene: ask for the `strips`, answer each with its heights.

    The strips come in a fixed order, away from the source, and may overlap: a pixel is visible if no
    strip that holds it says otherwise. Between strips a sweep keeps two numbers a ray.
    """

    def __init__(self, legs: list[Leg], tolerance_m: float) -> None:
        self._tolerance_m = tolerance_m
        self._begin(legs, None)

    def _begin(self, legs: list[Leg], rows: tuple[int, int] | None) -> None:
        """Set out on the legs that judge some of these rows."""
        ends = [leg.axes.end(rows) for leg in legs]
        self._legs = [leg for leg, end in zip(legs, ends, strict=True) if leg.first < end]
        self._ends = [end for leg, end in zip(legs, ends, strict=True) if leg.first < end]
        self._next = (0, self._legs[0].first) if self._legs else None

    def parts(self) -> "list[Sweep]":
        """One sweep for each leg, instead of this one, which may go on at the same time: visible is what all say."""
        return [Sweep([leg], self._tolerance_m) for leg in self._legs]

    def strips(self, lines: int, rows: tuple[int, int] | None = None) -> Iterator[Strip]:
        """The windows to read; none where nothing can be hidden.

        Each is `lines` rows or columns deep and lies between multiples of that, as the file's tiles do.
        rows : first and last + 1 of those that are to be judged: a pass along columns ends behind them, for nothing
               there hides them. All if not given.
        """
        self._begin(self._legs, rows)
        for index, (leg, end) in enumerate(zip(self._legs, self._ends, strict=True)):
            first = leg.first
            while first < end:
                stop = min(leg.axes.next_multiple(first, lines), end)
                low, high = leg.span(stop - 1)
                line = leg.axes.lines - stop if leg.axes.backwards else first
                if leg.axes.transposed:
                    yield Strip(low, line, high - low, stop - first, index, first)
                else:
                    yield Strip(line, low, stop - first, high - low, index, first)
                first = stop

    def __call__(self, strip: Strip, heights: Heights) -> Mask:
        """Which pixels of the strip are visible, (rows, cols); true where another strip decides.

        Raises InputError if the strip is not the next one or the heights are not of its shape.
        """
        if heights.shape != (strip.height, strip.width):
            raise InputError(f"heights have shape {heights.shape}, their strip {(strip.height, strip.width)}")
        if (strip.leg, strip.line) != self._next:
            raise InputError(
                f"the strip at leg, line {(strip.leg, strip.line)} came out of turn: {self._next} is next"
            )
        leg = self._legs[strip.leg]
        transposed, backwards = leg.axes.transposed, leg.axes.backwards
        low, count = (strip.row, strip.width) if transposed else (strip.col, strip.height)
        step = COLUMNS_AT_A_TIME if transposed else count
        visible = np.ones(heights.shape, np.bool_)
        for done in range(0, count, step):
            stop = min(done + step, count)
            part = slice(count - stop, count - done) if backwards else slice(done, stop)
            window = (slice(None), part) if transposed else (part, slice(None))
            lines, seen = (
                np.ascontiguousarray(heights[window], np.float32),
                np.ones_like(visible[window], order="C"),
            )
            leg.judge(lines, seen, strip.line + done, low, self._tolerance_m)
            visible[window] = seen
        self._next = self._after(strip.leg, strip.line + count)
        return visible

    def _after(self, leg: int, line: int) -> tuple[int, int] | None:
        """Leg and line that follow, or None at the end."""
        if line < self._ends[leg]:
            return leg, line
        return (leg + 1, self._legs[leg + 1].first) if leg + 1 < len(self._legs) else None


class DirectionSweep(Sweep):
    """What the sun, or a sensor in a constant direction, sees of the scene: one pass.

    direction : vector (3,) of any length from the surface to the source, above the horizon.

    In the zenith nothing is hidden: there are no strips. Raises InputError for a source at or below
    the horizon and for impossible cells.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        direction: ArrayLike,
        *,
        cell_x_m: float,
        cell_y_m: float,
        tolerance_m: float = TOLERANCE_M,
    ) -> None:
        _check_scene(shape, cell_x_m, cell_y_m, tolerance_m)
        east, north, up = _vector("direction", direction)
        if not up > 0:
            raise InputError(f"the direction {[east, north, up]} does not point above the horizon")
        axes = axes_away(shape, (-east, -north), cell_x_m, cell_y_m)
        lines, pixels = axes.vector(-east, -north)
        is_sheer = not lines * sightlines.SHEER_M > up
        super().__init__([] if is_sheer else [ParallelLeg(axes, pixels / lines, drop_m=up / lines)], tolerance_m)


class LineSweep(Sweep):
    """What a line scanner on a straight trajectory sees, each pixel from the point abeam: two passes.

    start, end : two positions (3,) on the trajectory [m], which goes on straight beyond them, and
                 up or down where they differ in height.

    Raises InputError if one is above the other, and for impossible cells.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        start: ArrayLike,
        end: ArrayLike,
        *,
        cell_x_m: float,
        cell_y_m: float,
        tolerance_m: float = TOLERANCE_M,
    ) -> None:
        _check_scene(shape, cell_x_m, cell_y_m, tolerance_m)
        point = _vector("start", start)
        east, north, up = (b - a for a, b in zip(point, _vector("end", end), strict=True))
        run = math.hypot(east, north)
        if not run > 0:
            raise InputError(f"the trajectory starts at {point} and ends above or below it: it has no heading")
        heading = (east / run, north / run, up / run)
        sides = ((heading[1], -heading[0]), (-heading[1], heading[0]))
        super().__init__(
            [_abeam(axes_away(shape, away, cell_x_m, cell_y_m), point, heading, away) for away in sides],
            tolerance_m,
        )


def _abeam(axes: Axes, point: Triple, heading: Triple, away: tuple[float, float]) -> Leg:
    """The pass that goes `away` (unit vector, east and north) from a trajectory through a point. [m]"""
    origin = np.array(axes.point(point[0], point[1]))
    cell_m2 = np.square([axes.line_m, axes.pixel_m])
    across = np.array(axes.vector(*away))  # lines and pixels a metre
    depth = across * cell_m2 * across[0]
    climb = np.array(axes.vector(heading[0], heading[1])) * cell_m2 * heading[2]
    return ParallelLeg(
        axes,
        float(across[1] / across[0]),
        depth=(-float(depth @ origin), float(depth[0]), float(depth[1])),
        apex=(point[2] - float(climb @ origin), float(climb[0]), float(climb[1])),
    )


class FrameSweep(Sweep):
    """What a frame camera sees: four passes, over the quadrants around its nadir.

    position : projection centre (3,), above the relief. [m]  Heights count from there in float32:
               beyond some 100 km let a `DirectionSweep` or `march` do it.

    Raises InputError for impossible positions and cells.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        position: ArrayLike,
        *,
        cell_x_m: float,
        cell_y_m: float,
        tolerance_m: float = TOLERANCE_M,
    ) -> None:
        _check_scene(shape, cell_x_m, cell_y_m, tolerance_m)
        east, north, up = _vector("position", position)
        quadrants = (
            axes_away(shape, away, cell_x_m, cell_y_m) for away in ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0))
        )
        super().__init__([FanLeg(axes, axes.point(east, north), up) for axes in quadrants], tolerance_m)


class PenumbraSweep:
    """Which share of the solar disk a pixel sees, in steps of one of its `slices`.

    Takes what `DirectionSweep` takes, the direction being that of the disk's centre. Slices are cut
    level and of equal area, each stands for a sun at its middle; below the horizon it is hidden.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        direction: ArrayLike,
        *,
        cell_x_m: float,
        cell_y_m: float,
        tolerance_m: float = TOLERANCE_M,
        slices: int = 5,
    ) -> None:
        self._slices = slices
        self._sweeps = [
            DirectionSweep(shape, slice_, cell_x_m=cell_x_m, cell_y_m=cell_y_m, tolerance_m=tolerance_m)
            for slice_ in _disk(_vector("direction", direction), slices)
        ]

    def strips(self, lines: int) -> Iterator[Strip]:
        """The windows to read, as those of `DirectionSweep`; they do not overlap."""
        return self._sweeps[0].strips(lines)

    def __call__(self, strip: Strip, heights: Heights) -> NDArray[np.float32]:
        """Visible share of the disk, (rows, cols)."""
        visible = np.sum([sweep(strip, heights) for sweep in self._sweeps], axis=0, dtype=np.float32)
        return np.asarray(visible / self._slices, np.float32)


def _disk(centre: Triple, slices: int) -> list[Triple]:
    """Directions to the slices of the solar disk that are above the horizon, the lowest first."""
    east, north, up = centre
    run = math.hypot(east, north)
    if not up > 0:
        raise InputError(f"the direction {list(centre)} does not point above the horizon")
    heights = np.linspace(-1.0, 1.0, 1001)  # of the disk's radius
    area_below = 0.5 + (heights * np.sqrt(1.0 - heights**2) + np.arcsin(heights)) / math.pi
    middles = np.interp((np.arange(slices) + 0.5) / slices, area_below, heights)
    elevations_deg = math.degrees(math.atan2(up, run)) + SOLAR_RADIUS_DEG * middles
    east, north = (east / run, north / run) if run > 0 else (0.0, 1.0)
    return [
        (east * math.cos(elevation), north * math.cos(elevation), math.sin(elevation))
        for elevation in np.deg2rad(np.minimum(elevations_deg, HIGHEST_SUN_DEG)).tolist()
        if elevation > 0
    ]


def march(
    heights: Heights,
    direction: ArrayLike,
    *,
    cell_x_m: float,
    cell_y_m: float,
    window: tuple[slice, slice] = (slice(None), slice(None)),
    needed: Mask | None = None,
    reach_px: int | None = None,
    tolerance_m: float = TOLERANCE_M,
) -> Mask:
    """Which pixels of the window see their source: a ray from each, until it is above the relief.

    heights   : (rows, cols), the window and a halo around it, as wide as `reach_m` says.
    direction : (3,) or (3, *window shape), from the surface to the source, of any length; towards
                nan, the horizon and below it nothing is seen.
    needed    : which pixels of the window to answer for; the others are given as visible.
    reach_px  : lines of pixels that a ray goes over at most, which is no more than the halo has; None: no end.

    Raises InputError where shapes do not agree and for impossible cells.
    """
    _check_scene(heights.shape, cell_x_m, cell_y_m, tolerance_m)
    rows, cols = (range(*part.indices(size)) for part, size in zip(window, heights.shape, strict=True))
    shape = len(rows), len(cols)
    field = np.asarray(direction)
    asked = np.ones(shape, np.bool_) if needed is None else needed
    if field.shape not in {(3,), (3, *shape)} or asked.shape != shape:
        raise InputError(
            f"direction has shape {field.shape} and needed {asked.shape}; "
            f"allowed are (3,) or {(3, *shape)}, and {shape}"
        )
    field = np.broadcast_to(field.reshape(3, *(field.shape[1:] or (1, 1))), (3, *shape))
    relief = np.ascontiguousarray(heights, np.float32)
    visible: Mask = np.ones(shape, np.bool_)
    tile_peaks = sightlines.peaks(relief)
    sightlines.march(
        relief,
        tile_peaks,
        tile_peaks.max(),
        field,
        asked,
        first=(rows.start, cols.start),
        cell=(float(cell_x_m), float(cell_y_m)),
        tolerance=float(tolerance_m),
        reach=float(sum(heights.shape) if reach_px is None else reach_px),
        visible=visible,
    )
    return visible


def reach_m(relief_m: float, source_zenith_deg: float) -> float:
    """How far on the map a ray runs until it is above the relief: the halo that `march` needs. [m]"""
    return relief_m * math.tan(math.radians(source_zenith_deg))


def _vector(name: str, components: ArrayLike) -> Triple:
    """Three finite numbers, or an error that names them."""
    vector = np.asarray(components, np.float64)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise InputError(f"{name} is {vector.tolist()}; it must be three finite numbers: east, north, up")
    return float(vector[0]), float(vector[1]), float(vector[2])


def _check_scene(shape: tuple[int, ...], cell_x_m: float, cell_y_m: float, tolerance_m: float) -> None:
    """Raise InputError unless a scene can be swept."""
    if len(shape) != 2 or min(shape) < 1:
        raise InputError(f"the heights have shape {shape}; at least one row and one column are needed")
    if not (0 < cell_x_m < math.inf and 0 < cell_y_m < math.inf):
        raise InputError(f"the cells are {cell_x_m} by {cell_y_m} m; both sides must be above 0")
    if not 0 <= tolerance_m < math.inf:
        raise InputError(f"tolerance_m is {tolerance_m}; it must be 0 or more")
