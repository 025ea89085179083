"""Where the sensor is, seen from each pixel: unit vectors surface→sensor, in the axes of the grid."""

import csv
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import grid_azimuth, unit_vector
from tscorr.errors import InputError
from tscorr.grid import Block, Grid, convergence_deg

Array = NDArray[Any]


class View(Protocol):
    """How a scene was seen."""

    def vectors(self, grid: Grid, block: Block, heights: Array) -> Array:
        """Unit vectors to the sensor for a block of a grid: (3, rows, cols), or (3, 1, 1) where constant.

        heights : (rows, cols), or (1, 1) where constant. [m]
        """

    def check(self, grid: Grid, highest_m: float) -> None:
        """Raise InputError where the sensor cannot have seen this grid, whose highest point is given."""


@dataclass(frozen=True)
class ConstantView:
    """One direction for the whole scene; zenith angle from the vertical, azimuth from true north."""

    zenith_deg: float
    azimuth_deg: float

    def vectors(self, grid: Grid, block: Block, heights: Array) -> Array:
        """Unit vector (3, 1, 1)."""
        del block, heights
        convergence = convergence_deg(grid, *grid.center) if grid.crs is not None else 0.0
        return unit_vector(self.zenith_deg, grid_azimuth(self.azimuth_deg, convergence)).reshape(3, 1, 1)

    def check(self, grid: Grid, highest_m: float) -> None:
        """A constant view sees any grid."""


@dataclass(frozen=True)
class FrameView:
    """A frame camera: all pixels are seen from one projection centre, in coordinates of the grid. [m]"""

    position: tuple[float, float, float]

    def vectors(self, grid: Grid, block: Block, heights: Array) -> Array:
        """Unit vectors (3, rows, cols) from the surface to the projection centre."""
        x, y = ground(grid, block)
        return _unit(self.position[0] - x, self.position[1] - y, self.position[2] - heights)

    def check(self, grid: Grid, highest_m: float) -> None:
        """The camera must be above the highest point of the scene."""
        del grid
        if not self.position[2] > highest_m:
            raise InputError(
                f"the camera at height {self.position[2]:.1f} m is not above the surface, whose highest point "
                f"is at {highest_m:.1f} m"
            )


@dataclass(frozen=True)
class Trajectory:
    """A flight line: where the sensor was, and which way it looked; arrays (samples,), times ascending.

    seconds : since the first sample.
    x, y, z : map coordinates of the grid. [m]
    forward : (3, samples), unit vectors along the body's axis to the nose; the scan plane is across it.
    """

    start: datetime
    seconds: Array
    x: Array
    y: Array
    z: Array
    forward: Array
    file: str

    @cached_property
    def table(self) -> Array:
        """Rows x, y, z, forward east, north, up: what is interpolated in time."""
        return np.vstack([self.x, self.y, self.z, self.forward])

    def at(self, seconds: Array) -> tuple[Array, Array]:
        """Position and forward vector (3, ...) at times, linear between samples."""
        values = np.stack([np.interp(seconds, self.seconds, row) for row in self.table])
        return values[:3], values[3:]


@dataclass(frozen=True)
class LineView:
    """A line scanner: a pixel is seen from the point of the trajectory whose scan plane holds it.

    With no attitude the scan plane is upright and across the track: the pixel is seen from the point abeam.
    Heading turns it about the vertical and pitch tilts it; roll moves the swath within it and changes no
    vector. Roll is positive with the right wing down, pitch with the nose up, heading clockwise from north.
    """

    trajectory: Trajectory

    def vectors(self, grid: Grid, block: Block, heights: Array) -> Array:
        """Unit vectors (3, rows, cols) from the surface to the sensor as it passed."""
        x, y = ground(grid, block)
        x, y, z = np.broadcast_arrays(x, y, heights)
        position, _ = self.trajectory.at(self.seconds(x, y, z))
        return _unit(position[0] - x, position[1] - y, position[2] - z)

    def seconds(self, x: Array, y: Array, z: Array) -> Array:
        """When each ground point was seen, in seconds since the trajectory's first sample.

        The root of (ground - position) . forward, by steps at the mean speed, from the straight line between
        the ends of the trajectory. Outside the trajectory the result lies outside its times.
        """
        path = self.trajectory
        first, last = path.table[:3, 0], path.table[:3, -1]
        along = last - first
        duration = path.seconds[-1] - path.seconds[0]
        speed = float(np.hypot(along[0], along[1])) / duration
        scale = duration / float(along[0] ** 2 + along[1] ** 2)
        time = ((x - first[0]) * along[0] + (y - first[1]) * along[1]) * scale
        for _ in range(50):
            inside = np.clip(time, 0, duration)
            position, forward = path.at(inside)
            ahead = (x - position[0]) * forward[0] + (y - position[1]) * forward[1]
            ahead = ahead + (z - position[2]) * forward[2]
            step = ahead / speed
            new = inside + step
            if np.all(np.abs(new - time) < 1e-6):
                return new
            time = new
        return time

    def straight(self, grid: Grid) -> tuple[Array, Array] | None:
        """Two points (3,) of the trajectory if it is straight and its scan planes are upright across it.

        Straight to a quarter of a pixel, and to 0.2 degrees of heading and pitch: then what is hidden from
        the sensor can be found in one sweep. Otherwise None.
        """
        path = self.trajectory
        start, end = path.table[:3, 0], path.table[:3, -1]
        along = (end - start) / np.linalg.norm(end - start)
        offset = path.table[:3].T - start
        aside = np.linalg.norm(offset - (offset @ along)[:, None] * along, axis=1)
        turned = np.rad2deg(np.linalg.norm(path.forward.T - along, axis=1))
        is_straight = aside.max() < 0.25 * min(grid.cell_size) and turned.max() < 0.2
        return (start, end) if is_straight else None

    def check(self, grid: Grid, highest_m: float) -> None:
        """The trajectory must pass the whole grid, above it."""
        path = self.trajectory
        if not path.z.min() > highest_m:
            raise InputError(
                f"the trajectory {path.file} goes down to {path.z.min():.1f} m; the highest point of the surface "
                f"is at {highest_m:.1f} m"
            )
        x, y = grid.corners()
        seconds = self.seconds(x, y, np.full(4, min(highest_m, float(path.z.min()))))
        early, late = -seconds.min(), seconds.max() - path.seconds[-1]
        if max(early, late) > 0.5 * float(np.diff(path.seconds).max()):
            side = f"{early:.2f} s before its first sample" if early > late else f"{late:.2f} s after its last"
            raise InputError(f"the trajectory {path.file} does not cover the scene: a corner is seen {side}")


def ground(grid: Grid, block: Block) -> tuple[Array, Array]:
    """Map coordinates of the pixel centres of a block, ready to broadcast to (rows, cols)."""
    rows = np.arange(block.row, block.row + block.height)[:, None]
    cols = np.arange(block.col, block.col + block.width)[None, :]
    x, y = grid.xy(rows, cols)
    return x, y


def _unit(east: Any, north: Any, up: Any) -> Array:
    vectors = np.stack(np.broadcast_arrays(east, north, up))
    vectors /= np.sqrt(np.einsum("i...,i...->...", vectors, vectors))
    return vectors


COLUMNS = ("utc", "x", "y", "z")
ATTITUDE = ("roll_deg", "pitch_deg", "heading_deg")


def read_trajectory(path: Path, grid: Grid, to_grid: Any = None, height_offset_m: float = 0.0) -> Trajectory:
    """A trajectory from CSV with the columns utc, x, y, z [, roll_deg, pitch_deg, heading_deg].

    to_grid : function (x, y) → (x, y) where the file is in another CRS than the grid.
    Raises InputError naming file, line and value of what is wrong.
    """
    rows, names = _read_columns(path)
    times = [_time(row["utc"], path, line) for line, row in rows]
    seconds = np.array([(time - times[0]).total_seconds() for time in times])
    if len(seconds) < 2 or np.any(np.diff(seconds) <= 0):
        raise InputError(f"{path}: the column utc must hold at least two ascending times")
    number = {
        key: np.array([_number(row[key], key, path, line) for line, row in rows])
        for key in (*COLUMNS[1:], *(key for key in ATTITUDE if key in names))
    }
    x, y = number["x"], number["y"]
    if to_grid is not None:
        x, y = to_grid(x, y)
    z = number["z"] + height_offset_m
    if np.hypot(x[-1] - x[0], y[-1] - y[0]) < 1:
        raise InputError(f"{path}: first and last sample are less than 1 m apart; a flight line goes somewhere")
    if "heading_deg" in number:
        convergence = convergence_deg(grid, *grid.center)
        azimuth = grid_azimuth(number["heading_deg"], convergence)
    else:
        azimuth = np.rad2deg(np.arctan2(np.gradient(x, seconds), np.gradient(y, seconds)))
    pitch = number.get("pitch_deg", np.zeros_like(seconds))
    return Trajectory(times[0], seconds, x, y, z, unit_vector(90 - pitch, azimuth), str(path))


def _read_columns(path: Path) -> tuple[list[tuple[int, dict[str, str]]], list[str]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            names = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = names
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"the trajectory {path} cannot be read: {error}") from None
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputError(f"{path} lacks the column {missing[0]}; it has {', '.join(names)}")
    return rows, names


def _time(text: str | None, path: Path, line: int) -> datetime:
    try:
        time = datetime.fromisoformat((text or "").strip())
    except ValueError:
        raise InputError(f"{path} line {line}: utc = {text!r}; allowed is ISO 8601") from None
    if time.tzinfo is None:
        raise InputError(f"{path} line {line}: utc = {text!r} names no time zone; append Z for UTC")
    return time


def _number(text: str | None, key: str, path: Path, line: int) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{path} line {line}: {key} = {text!r}; allowed is a number")
    return value
