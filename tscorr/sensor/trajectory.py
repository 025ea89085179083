"""The flight line of a scanner, from a table of times, positions and attitude."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.angles import grid_azimuth, unit_vector
from tscorr.errors import InputError
from tscorr.grid import Grid, convergences_deg
from tscorr.sensor.tables import number, read_columns

Array = NDArray[Any]

COLUMNS = ("utc", "x", "y", "z")
ATTITUDE = ("roll_deg", "pitch_deg", "heading_deg")
SLOWEST_M_PER_S = 0.01
"""below this the track has no direction that could stand for the heading"""


@dataclass(frozen=True)
class Trajectory:
    """A flight line: where the sensor was, and which way it looked; arrays (samples,), times ascending.

    seconds : since `start`.
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

    def time(self, seconds: float) -> datetime:
        """The instant that lies so many seconds after `start`."""
        return self.start + timedelta(seconds=float(seconds))

    def between(self, first: datetime | None, last: datetime | None) -> "Trajectory":
        """The part between two times, and one sample more on either side; raises InputError where there is none."""
        low = -np.inf if first is None else (first - self.start).total_seconds()
        high = np.inf if last is None else (last - self.start).total_seconds()
        inside = np.flatnonzero((self.seconds >= low) & (self.seconds <= high))
        if not inside.size:
            raise InputError(
                f"the trajectory {self.file} has no sample from {first} to {last}; it has samples from "
                f"{self.time(self.seconds[0]).isoformat()} to {self.time(self.seconds[-1]).isoformat()}"
            )
        return self.part(slice(max(inside[0] - 1, 0), inside[-1] + 2))

    def part(self, samples: slice) -> "Trajectory":
        """Some of the samples; times are still counted from `start`."""
        return replace(
            self,
            seconds=self.seconds[samples],
            x=self.x[samples],
            y=self.y[samples],
            z=self.z[samples],
            forward=self.forward[:, samples],
        )

    def longer(self, seconds: float) -> "Trajectory":
        """With one sample more at each end, where it would have been at its first and its last speed."""
        times = np.concatenate([[self.seconds[0] - seconds], self.seconds, [self.seconds[-1] + seconds]])
        first, last = self.table[:, 0], self.table[:, -1]
        first_rate = (self.table[:, 1] - first) / (self.seconds[1] - self.seconds[0])
        last_rate = (last - self.table[:, -2]) / (self.seconds[-1] - self.seconds[-2])
        table = np.column_stack([first - first_rate * seconds, self.table, last + last_rate * seconds])
        return replace(self, seconds=times, x=table[0], y=table[1], z=table[2], forward=table[3:])


def read_trajectory(
    path: Path,
    grid: Grid,
    to_grid: Callable[[Any, Any], tuple[Array, Array]] | None = None,
    height_offset_m: float = 0.0,
) -> Trajectory:
    """A trajectory from CSV with the columns utc, x, y, z [, roll_deg, pitch_deg, heading_deg].

    Attitude is that of the airframe, turned heading first, then pitch, then roll: heading clockwise from true north
    (at each sample's own place), pitch positive with the nose up, roll positive with the right wing down.
    Without a heading the nose points along the track.

    to_grid : function (x, y) → (x, y) where the file is in another CRS than the grid.
    Raises InputError naming file, line and value of what is wrong.
    """
    rows, names = read_columns(path, COLUMNS, "trajectory")
    times = [_time(row["utc"], path, line) for line, row in rows]
    seconds = np.array([(time - times[0]).total_seconds() for time in times])
    if len(seconds) < 2:
        raise InputError(f"{path}: the column utc must hold at least two ascending times; it holds {len(seconds)}")
    if (backwards := np.flatnonzero(np.diff(seconds) <= 0)).size:
        line, row = rows[backwards[0] + 1]
        raise InputError(f"{path} line {line}: utc = {row['utc']!r}; utc must hold at least two ascending times")
    column = {
        key: np.array([number(row[key], key, path, line) for line, row in rows])
        for key in (*COLUMNS[1:], *(key for key in ATTITUDE if key in names))
    }
    x, y = column["x"], column["y"]
    if to_grid is not None:
        x, y = to_grid(x, y)
        if (lost := np.flatnonzero(~np.isfinite(x + y))).size:
            line, row = rows[lost[0]]
            raise InputError(f"{path} line {line}: x = {row['x']}, y = {row['y']} is nowhere in the image's CRS")
    z = column["z"] + height_offset_m
    if np.hypot(np.ptp(x), np.ptp(y)) < 1:
        raise InputError(f"{path}: all samples lie within 1 m; a flight line goes somewhere")
    if "heading_deg" in column:
        azimuth = grid_azimuth(column["heading_deg"], convergences_deg(grid, x, y))
    else:
        azimuth = _track(x, y, seconds, path, rows)
    forward = unit_vector(90 - column.get("pitch_deg", np.zeros_like(seconds)), azimuth)
    return Trajectory(times[0], seconds, x, y, z, forward, str(path))


def _track(x: Array, y: Array, seconds: Array, path: Path, rows: Any) -> Array:
    """Direction of flight from grid north. [deg]"""
    east, north = np.gradient(x, seconds), np.gradient(y, seconds)
    if (still := np.flatnonzero(np.hypot(east, north) < SLOWEST_M_PER_S)).size:
        raise InputError(
            f"{path} line {rows[still[0]][0]}: the sensor stands still, so its track has no direction; give the "
            f"column heading_deg"
        )
    return np.rad2deg(np.arctan2(east, north))


def _time(text: str | None, path: Path, line: int) -> datetime:
    try:
        time = datetime.fromisoformat((text or "").strip())
    except ValueError:
        raise InputError(f"{path} line {line}: utc = {text!r}; allowed is ISO 8601") from None
    if time.tzinfo is None:
        raise InputError(f"{path} line {line}: utc = {text!r} names no time zone; append Z for UTC")
    return time
