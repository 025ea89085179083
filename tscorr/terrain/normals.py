"""Surface normals straight from the heights of a DSM, one small window a pixel.

Heights are (rows, cols), row 0 in the north, columns from west to east, nan = void, in metres as
`cell_x_m` and `cell_y_m` are. Normals are float32 (3, rows, cols): east, north, up, of unit length.

Where the window is not whole (a void, the border of the array), the normal is that of the
least-squares plane through the heights that are there, and straight up where these are less than
three or in one line. So planes come out right up to the border, but a tile gives the pixels of the
whole scene only where its halo (1 for Horn, `radius` for a plane fit) completes the window.

`unreliable` is set where there is a void or a step edge under the window. A step is a second
difference z(-1) - 2 z(0) + z(+1), along rows, columns or diagonals, of more than `step_m`. A plane has
none, a ridge has the sum of its two slopes times the cell, n metres of noise make 2.4 n. The default is
the larger cell size: what a ridge of two slopes of 27 degrees shows, and there the normal of a window
is that of neither face.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tscorr.errors import InputError
from tscorr.loops import LOOP, PART

HORN_HALO_PX = 1
SPAN = 64
"""pixels of a row for which it is told at once whether any is wanted"""
EVERYWHERE = np.ones((1, 1), np.bool_)


class WindowNormals(NamedTuple):
    """Normals float32 (3, rows, cols), and `unreliable` bool (rows, cols): a void or a step below."""

    normals: NDArray[np.float32]
    unreliable: NDArray[np.bool_]


def horn_normals(
    heights: NDArray[np.floating[Any]],
    *,
    cell_x_m: float,
    cell_y_m: float,
    step_m: float | None = None,
    halo: int = 0,
    wanted: NDArray[np.bool_] | None = None,
) -> WindowNormals:
    """Normals by the 3 x 3 weights 1 2 1 of Horn 1981 (Proc. IEEE 69, 14, eq. for p_w and q_w).

    halo   : 1 if the outermost heights are there for the windows of the others only, and get no normals; else 0.
    wanted : where normals are wanted, as they are returned; what stands elsewhere means nothing. Everywhere if None.
    """
    step = max(cell_x_m, cell_y_m) if step_m is None else step_m
    z = np.ascontiguousarray(heights) if halo else np.pad(heights, HORN_HALO_PX, constant_values=np.nan)
    shape = z.shape[0] - 2 * HORN_HALO_PX, z.shape[1] - 2 * HORN_HALO_PX
    normals, unreliable = np.empty((3, *shape), np.float32), np.empty(shape, np.bool_)
    _horn(z, EVERYWHERE if wanted is None else wanted, normals, unreliable, cell_x_m, cell_y_m, step)
    return WindowNormals(normals, unreliable if halo else _unreliable(np.ascontiguousarray(heights), 1, step))


def plane_fit_normals(
    heights: NDArray[np.floating[Any]],
    *,
    cell_x_m: float,
    cell_y_m: float,
    radius: int = 1,
    step_m: float | None = None,
) -> WindowNormals:
    """Normals of the least-squares planes in windows of (2 radius + 1)^2 pixels, radius >= 1."""
    if radius < 1:
        raise InputError(f"radius is {radius}; a window needs a radius of 1 or more")
    z = np.ascontiguousarray(heights)
    normals = np.empty((3, *z.shape), np.float32)
    _plane_fit(z, normals, radius, 1.0 / cell_x_m, 1.0 / cell_y_m)
    unreliable = _unreliable(z, radius, max(cell_x_m, cell_y_m) if step_m is None else step_m)
    _complete(z, normals, _incomplete(normals, radius), radius, cell_x_m, cell_y_m)
    return WindowNormals(normals, unreliable)


@njit(**LOOP)
def _horn(z, wanted, normals, unreliable, cell_x_m, cell_y_m, step):
    """Normals, and where they are unreliable, of the pixels off the border of `z`, span by span of a row.

    wanted : bool (rows, cols), or (1, 1) for everywhere; a span without any is left as it is.
    """
    per_x, per_y = np.float32(1.0 / (8.0 * cell_x_m)), np.float32(1.0 / (8.0 * cell_y_m))
    rows, cols = unreliable.shape
    for i in range(rows):
        for start in range(0, cols, SPAN):
            stop = min(start + SPAN, cols)
            if wanted.size > 1 and not _any(wanted[i, start:stop]):
                continue
            above, here, below = z[i, start : stop + 2], z[i + 1, start : stop + 2], z[i + 2, start : stop + 2]
            east, north, up = normals[0, i, start:stop], normals[1, i, start:stop], normals[2, i, start:stop]
            _set_horn(above, here, below, east, north, up, per_x, per_y)
            _set_bent(above, here, below, unreliable[i, start:stop], step)
            if _any(unreliable[i, start:stop]):  # as all windows with a void are
                for j in range(start, stop):
                    if np.isnan(normals[2, i, j]):
                        slopes = _slopes_of_rest(z, i + 1, j + 1, 1, cell_x_m, cell_y_m)
                        _set_normal(normals, i, j, slopes[0], slopes[1])


@njit(**PART)
def _any(line):
    """Whether anything is true."""
    found = False
    for j in range(line.size):
        found |= line[j]
    return found


@njit(**PART)
def _set_horn(above, here, below, east, north, up, per_x, per_y):
    """Normals of a span; nan where the window has a void."""
    # Three short loops with few arrays in each: only so do they become vector instructions.
    # Differences come first: they are exact where the heights are near each other.
    one = np.float32(1.0)
    for j in range(up.size):
        fall = here[j] - here[j + 2]
        falls = (above[j] - above[j + 2]) + (fall + fall) + (below[j] - below[j + 2])
        east[j] = np.float32(falls) * per_x
    for j in range(up.size):
        fall = below[j + 1] - above[j + 1]
        falls = (below[j] - above[j]) + (fall + fall) + (below[j + 2] - above[j + 2])
        north[j] = np.float32(falls) * per_y
    for j in range(up.size):
        up[j] = one / np.sqrt(one + east[j] * east[j] + north[j] * north[j])
        east[j] *= up[j]
        north[j] *= up[j]


@njit(**LOOP)
def _set_bent(above, here, below, bent, step):
    """Whether the 3 x 3 heights around each pixel of a span have a void or a step."""
    for j in range(bent.size):
        twice = here[j + 1] + here[j + 1]
        bent[j] = not (  # a nan is never flat
            (abs(here[j] - twice + here[j + 2]) <= step)
            & (abs(above[j + 1] - twice + below[j + 1]) <= step)
            & (abs(above[j] - twice + below[j + 2]) <= step)
            & (abs(above[j + 2] - twice + below[j]) <= step)
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _plane_fit(z, normals, radius, per_x, per_y):
    """Normals of all pixels with a full window in the array; nan where it has a void."""
    rows, cols = z.shape
    spread = (2 * radius + 1) ** 2 * radius * (radius + 1) / 3.0  # sum of the squared offsets
    total, tilt = np.empty(cols), np.empty(cols)  # of the window's columns: sum, offset * height
    for i in range(radius, rows - radius):
        total[:] = 0.0
        tilt[:] = 0.0
        for a in range(1, radius + 1):
            for j in range(cols):
                total[j] += z[i + a, j] + z[i - a, j]
                tilt[j] += a * (z[i + a, j] - z[i - a, j])
        for j in range(cols):
            total[j] += z[i, j]
        for j in range(radius, cols - radius):
            by_col, by_row = 0.0, tilt[j]
            for b in range(1, radius + 1):
                by_col += b * (total[j + b] - total[j - b])
                by_row += tilt[j + b] + tilt[j - b]
            _set_normal(normals, i, j, -by_col / spread * per_x, by_row / spread * per_y)


@njit(**PART)
def _set_normal(normals, i, j, east, north):
    """Write the normal of a surface that falls `east` to the east and `north` to the north, per metre."""
    up = 1.0 / math.sqrt(1.0 + east * east + north * north)
    normals[0, i, j] = east * up
    normals[1, i, j] = north * up
    normals[2, i, j] = up


def _incomplete(normals: NDArray[np.float32], radius: int) -> NDArray[np.intp]:
    """Rows and columns (2, pixels) of the pixels whose window is not whole: at the border and at voids."""
    _, rows, cols = normals.shape
    missing = np.ones((rows, cols), np.bool_)
    inner = (slice(radius, -radius), slice(radius, -radius))
    missing[inner] = np.isnan(normals[2][inner])
    return np.stack(np.divmod(np.flatnonzero(missing), cols))  # faster than nonzero


@njit(**LOOP)
def _complete(z, normals, places, radius, cell_x_m, cell_y_m):
    """Normals of the pixels (2, pixels) of which the window is not whole."""
    for place in range(places.shape[1]):
        i, j = places[0, place], places[1, place]
        slopes = _slopes_of_rest(z, i, j, radius, cell_x_m, cell_y_m)
        _set_normal(normals, i, j, slopes[0], slopes[1])


@njit(**PART)
def _slopes_of_rest(z, i, j, radius, cell_x_m, cell_y_m):
    """How far the least-squares plane through the heights that a window has falls to the east and to the north."""
    rows, cols = z.shape
    n, x, y, h, xx, xy, yy, xh, yh = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    datum = 0.0
    for a in range(max(0, i - radius), min(rows, i + radius + 1)):
        for b in range(max(0, j - radius), min(cols, j + radius + 1)):
            if not math.isfinite(z[a, b]):
                continue
            if n == 0:
                datum = z[a, b]
            u, v, d = (b - j) * cell_x_m, (i - a) * cell_y_m, z[a, b] - datum
            n += 1
            x += u
            y += v
            h += d
            xx += u * u
            xy += u * v
            yy += v * v
            xh += u * d
            yh += v * d
    if n >= 3:
        xx, xy, yy = xx - x * x / n, xy - x * y / n, yy - y * y / n
        xh, yh = xh - x * h / n, yh - y * h / n
        determinant = xx * yy - xy * xy
        if determinant > 1e-6 * (xx + yy) ** 2:
            return (yh * xy - xh * yy) / determinant, (xh * xy - yh * xx) / determinant
    return 0.0, 0.0


def _unreliable(z: NDArray[np.floating[Any]], radius: int, step: float) -> NDArray[np.bool_]:
    """Pixels with a void or step in the window; where it reaches over the border, in what is there."""
    rows, cols = z.shape
    if min(rows, cols) < 3:
        return np.ones(z.shape, np.bool_)  # no window shows whether the surface is plane
    bent = np.zeros(z.shape, np.bool_)
    for i in range(1, rows - 1):
        _set_bent(z[i - 1], z[i], z[i + 1], bent[i, 1:-1], step)
    # a border pixel's window lies in that of its inner neighbour
    bent[0], bent[-1] = bent[1], bent[-2]
    bent[:, 0], bent[:, -1] = bent[:, 1], bent[:, -2]
    for axis in (0, 1):
        spread = bent.copy()
        for shift in range(1, min(radius, z.shape[axis])):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(shift, None), slice(None, -shift)
            spread[tuple(ahead)] |= bent[tuple(behind)]
            spread[tuple(behind)] |= bent[tuple(ahead)]
        bent = spread
    return bent
