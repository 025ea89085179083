"""The compiled loops of `shadows`: lines of sight over a DSM, pixel by pixel and ray by ray.

Between two samples the surface is a straight line, or, where that is steeper than `WALL_SLOPE`, a
wall midway. Ray states are float32 heights above an origin; positions are float64 until what is left
is a fraction of a pixel. Nothing is allocated in the sweeps, results and scratch memory are given to them: that halves
what there is to compile. Calls nothing of other files: numba's cache does not see edits there.
"""

import math

import numpy as np
from numba import njit

from tscorr.loops import LOOP, PART

WALL_SLOPE = 2.0  # 63 degrees: steeper than roofs, less steep than any wall of more than a pixel
SHEER_M = 1e5  # a line of sight that rises by so much in a pixel is above everything
TILE_PX = 16  # a march skips such squares where it is above their highest point
VOID = np.float32(-1e9)  # a surface so low that it hides nothing


@njit(**PART)
def _between(a, b, fraction, wall):
    """The surface a `fraction` of the way from `a` to `b`: a straight line, or a wall midway."""
    nearest = b if fraction >= np.float32(0.5) else a
    return nearest if abs(b - a) > wall else a + fraction * (b - a)


@njit(**PART)
def _load(line, heights, i, transposed, origin):
    """Line `i` of the heights above the origin, voids sunk, and the pixel at each end once more."""
    width = line.size - 2
    if transposed:
        for m in range(width):
            line[m + 1] = heights[m, i]
    else:
        for m in range(width):
            line[m + 1] = heights[i, m]
    for m in range(1, width + 1):
        height = line[m] - origin
        line[m] = VOID if np.isnan(height) else height
    line[0], line[width + 1] = line[1], line[width]


@njit(**PART)
def _store(visible, i, transposed, seen):
    """Put what is seen of line `i` in its place."""
    if transposed:
        for m in range(seen.size):
            visible[m, i] = seen[m]
    else:
        for m in range(seen.size):
            visible[i, m] = seen[m]


@njit(**LOOP)
def judge_parallel(
    heights, visible, rays, line, seen, transposed, backwards, first, low, ray0, slant, drop, central, depth, apex,
    origin, walls, tolerance,
):  # fmt: skip
    """Lines of heights and what is visible of them, from line `first` and pixel `low` of the scene on.

    Ray k crosses line j at the pixel k + slant j; `rays` (2, rays) carry, from ray -ray0 on, the height
    below which nothing is seen and the surface on the line before. To the next line the line of sight
    falls by `drop` or, if `central`, away from an apex: `depth` and `apex` are planes (value at the
    origin, per line, per pixel) of the distance from there, in lines, and of its height. `line` (width + 2,)
    and `seen` (width,) are scratch.
    """
    lines, width = heights.shape[::-1] if transposed else heights.shape
    one, half, fall = np.float32(1.0), np.float32(0.5), np.float32(drop)
    wall_along, wall_across = np.float32(walls[0]), np.float32(walls[1])
    slack, origin = np.float32(tolerance), np.float32(origin)
    depth_per_pixel, apex_per_pixel = np.float32(depth[2]), np.float32(apex[2])
    for n in range(lines):
        i = lines - 1 - n if backwards else n
        _load(line, heights, i, transposed, origin)
        j = first + n
        shift = slant * j
        whole = math.floor(shift)
        left = shift - whole
        fraction = np.float32(left)
        start = ray0 + low - 1 - whole
        hidden_below, behind = rays[0, start : start + width + 1], rays[1, start : start + width + 1]
        if central:
            depth_line = np.float32(depth[0] + depth[1] * j + depth[2] * left)
            apex_line = np.float32(apex[0] + apex[1] * j + apex[2] * left)
            for q in range(width + 1):
                pixel = np.float32(low + q - 1)
                distance = depth_line + depth_per_pixel * pixel
                top = apex_line + apex_per_pixel * pixel
                surface, before = _between(line[q], line[q + 1], fraction, wall_across), behind[q]
                gain = distance / (distance - one)
                edge_gain = distance / (distance - half) if before - surface > wall_along else gain
                limit = top + max((hidden_below[q] - top) * gain, (before - top) * edge_gain)
                hidden_below[q] = limit if distance > one else VOID
                behind[q] = surface
        else:
            for q in range(width + 1):
                surface, before = _between(line[q], line[q + 1], fraction, wall_across), behind[q]
                edge_fall = half * fall if before - surface > wall_along else fall
                hidden_below[q] = max(hidden_below[q] - fall, before - edge_fall)
                behind[q] = surface
        for m in range(width):
            limit = _between(hidden_below[m + 1], hidden_below[m], fraction, wall_across)
            seen[m] = (line[m + 1] + slack >= limit) | (line[m + 1] == VOID)
        _store(visible, i, transposed, seen)


@njit(**LOOP)
def judge_fan(
    heights, visible, rays, line, seen, tangents, walls, transposed, backwards, first, low, scene_width, nadir,
    origin, wall_across, tolerance,
):  # fmt: skip
    """Lines of heights and what is visible of them, from line `first` and pixel `low` of the scene on.

    Ray k crosses line j at the pixel nadir[1] + tangents[k] (j - nadir[0]); `rays`, `line` and `seen` as in
    `judge_parallel`. Judged are the pixels no further from the nadir along the line than across.
    """
    lines, width = heights.shape[::-1] if transposed else heights.shape
    slack, wall_across, origin = np.float32(tolerance), np.float32(wall_across), np.float32(origin)
    first_tangent, spacing = tangents[0], tangents[1] - tangents[0]
    last_ray = tangents.size - 1
    hidden_below, behind = rays[0], rays[1]
    for n in range(lines):
        i = lines - 1 - n if backwards else n
        _load(line, heights, i, transposed, origin)
        distance = first + n - nadir[0]
        is_first = distance <= 1.0  # the line before is on the other side of the nadir
        gain = np.float32(1.0 if is_first else distance / (distance - 1.0))
        edge_gain = np.float32(1.0 if is_first else distance / (distance - 0.5))
        leftmost = math.ceil(((-1.0 - nadir[1]) / distance - first_tangent) / spacing)
        rightmost = math.floor(((scene_width - nadir[1]) / distance - first_tangent) / spacing)
        for k in range(max(leftmost, 0), min(rightmost, last_ray) + 1):
            position = nadir[1] + tangents[k] * distance
            pixel = math.floor(position)
            q = min(max(pixel - low + 1, 0), width)
            surface, before = (
                _between(line[q], line[q + 1], np.float32(position - pixel), wall_across),
                behind[k],
            )
            before_gain = edge_gain if before - surface > walls[k] else gain
            hidden_below[k] = max(hidden_below[k] * gain, before * before_gain)
            behind[k] = surface
        seen[:] = True
        leftmost = math.ceil(nadir[1] - distance)
        rightmost = math.floor(nadir[1] + distance)
        for m in range(max(leftmost - low, 0), min(rightmost - low, width - 1) + 1):
            ray = ((low + m - nadir[1]) / distance - first_tangent) / spacing
            k = min(max(int(ray), 0), last_ray - 1)
            limit = _between(hidden_below[k], hidden_below[k + 1], np.float32(ray - k), wall_across)
            seen[m] = (line[m + 1] + slack >= limit) | (line[m + 1] == VOID)
        _store(visible, i, transposed, seen)


@njit(**LOOP)
def set_peaks(heights, highest):
    """Raise `highest` to the highest point of each tile of `TILE_PX` and of the pixels that touch it."""
    rows, cols = heights.shape
    for i in range(highest.shape[0]):
        for row in range(max(i * TILE_PX - 1, 0), min((i + 1) * TILE_PX + 1, rows)):
            for j in range(highest.shape[1]):
                peak = highest[i, j]
                for col in range(max(j * TILE_PX - 1, 0), min((j + 1) * TILE_PX + 1, cols)):
                    height = heights[row, col]
                    peak = height if height > peak else peak  # noqa: FURB136 - max() and nan: who knows
                highest[i, j] = peak


def peaks(heights):
    """The highest point of each tile of `TILE_PX` and of the pixels that touch it."""
    rows, cols = heights.shape
    highest = np.full(((rows - 1) // TILE_PX + 1, (cols - 1) // TILE_PX + 1), VOID)
    set_peaks(heights, highest)
    return highest


@njit(**LOOP)
def march(heights, tile_peaks, highest, direction, needed, first, cell, tolerance, reach, visible):
    """Set in `visible` whether each needed pixel of a window sees its source.

    first : the window's first pixel, in the heights; highest : of `tile_peaks`; reach : of a ray, lines of pixels.
    """
    for r in range(needed.shape[0]):
        for c in range(needed.shape[1]):
            row, col = first[0] + r, first[1] + c
            height = np.float64(heights[row, col])
            if needed[r, c] and not np.isnan(height):
                down = -np.float64(direction[1, r, c]) / cell[1]
                right = np.float64(direction[0, r, c]) / cell[0]
                up = np.float64(direction[2, r, c])
                visible[r, c] = up > 0.0 and _is_free(
                    heights, tile_peaks, row, col, down, right, up, cell, highest, height + tolerance, reach
                )


@njit(**PART)
def _is_free(heights, tile_peaks, row, col, down, right, up, cell, highest, eye, reach):
    """Whether the ray that leaves a pixel at the height `eye` meets nothing; `down`, `right` in pixels."""
    by_rows = abs(down) >= abs(right)
    lines = abs(down) if by_rows else abs(right)
    if not lines * SHEER_M > up:
        return True
    rise, down, right = up / lines, down / lines, right / lines
    wall_along = WALL_SLOPE * math.hypot(down * cell[1], right * cell[0])
    wall_across = WALL_SLOPE * (cell[0] if by_rows else cell[1])
    rows, cols = heights.shape
    last = int(min((highest - eye) / rise + 1.0, reach))
    before = np.float64(heights[row, col])
    n = 1
    while n <= last:
        y, x = row + n * down, col + n * right
        if y <= -1.0 or x <= -1.0 or y >= rows or x >= cols:
            return True
        i, j = max(int(y), 0) // TILE_PX, max(int(x), 0) // TILE_PX
        if tile_peaks[i, j] - rise * (n - 0.5) <= eye:
            n += max(int(min(_steps_left(y, down, i), _steps_left(x, right, j))), 1)
            before = _surface(heights, row, col, (n - 1) * down, (n - 1) * right, by_rows, wall_across)
            continue
        surface = _surface(heights, row, col, n * down, n * right, by_rows, wall_across)
        run = n - 0.5 if surface - before > wall_along else np.float64(n)
        if surface - rise * run > eye:
            return False
        before = surface
        n += 1
    return True


@njit(**PART)
def _steps_left(position, step, tile):
    """How many steps a ray can surely take within the tile."""
    if step > 0.0:
        return ((tile + 1) * TILE_PX - position) / step
    return (position - tile * TILE_PX) / -step if step < 0.0 else np.inf


@njit(**PART)
def _surface(heights, row, col, down, right, by_rows, wall):
    """The surface where a ray from (row, col) crosses a line of pixels; the scene's edge goes on level.

    Fractions come from the offset, not from the position: the same wherever the window starts.
    """
    rows, cols = heights.shape
    across = right if by_rows else down
    whole = math.floor(across)
    if by_rows:
        line = min(max(row + round(down), 0), rows - 1)
        a = heights[line, min(max(col + whole, 0), cols - 1)]
        b = heights[line, min(max(col + whole + 1, 0), cols - 1)]
    else:
        line = min(max(col + round(right), 0), cols - 1)
        a = heights[min(max(row + whole, 0), rows - 1), line]
        b = heights[min(max(row + whole + 1, 0), rows - 1), line]
    return _between(_sunk(a), _sunk(b), across - whole, wall)


@njit(**PART)
def _sunk(height):
    """The height, or a depth where it is void."""
    return np.float64(VOID if np.isnan(height) else height)
