"""Loops over pixels that numpy is slow at: towards a camera, when a scanner passed, vectors between raster pixels.

Each result depends on its own pixel only, so it is the same however a scene is cut into blocks. Nothing is
allocated in compiled code, results and scratch memory are given to it: that halves what there is to compile.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from tscorr.loops import LOOP, PART

ONE = np.float32(1)
SPAN = 64
"""pixels of a row for which it is told at once whether any is wanted"""
EVERYWHERE = np.ones((1, 1), np.bool_)
TILE = 16
"""pixels of a side of the tiles for which the possible samples are listed"""


@njit(**LOOP)
def towards(position, heights, transform, first_row, first_col, wanted, vectors):
    """Unit vectors (3, rows, cols) from the pixels of a block to one position, into `vectors`.

    position  : (3,). heights : (rows, cols), or (1, 1) where constant. [m]
    transform : (6,), of the grid: x = t[0] (col + 1/2) + t[1] (row + 1/2) + t[2], y with t[3:].
    wanted    : bool (rows, cols), or (1, 1) for everywhere; what is far from any is left as it is.
    The first pixel is (first_row, first_col) of the grid.
    """
    rows, cols = vectors.shape[1:]
    for i in range(rows):
        below = heights[i if heights.size > 1 else 0]
        x, y = position[0] - transform[1] * (first_row + i + 0.5), position[1] - transform[4] * (first_row + i + 0.5)
        for start in range(0, cols, SPAN):
            stop = min(start + SPAN, cols)
            if wanted.size > 1 and not _any(wanted[i, start:stop]):
                continue
            east, north, up = vectors[0, i, start:stop], vectors[1, i, start:stop], vectors[2, i, start:stop]
            if heights.size > 1:
                _set_difference(up, position[2], below[start:stop])
            else:
                for j in range(stop - start):
                    up[j] = position[2] - below[0]
            first = first_col + start + 0.5
            _set_towards(east, north, up, x - transform[2], y - transform[5], transform[0], transform[3], first)


@njit(**PART)
def _any(line):
    """Whether anything is true."""
    found = False
    for j in range(line.size):
        found |= line[j]
    return found


@njit(**PART)
def _set_difference(line, value, other):
    """A value less those of another line."""
    for j in range(line.size):
        line[j] = value - other[j]


@njit(**PART)
def _set_towards(east, north, up, x, y, per_col_x, per_col_y, first):
    """Unit vectors of a span of a row, of which `up` is known already but for their length.

    The inverse of that is a float32 and two steps of Newton, at a fraction of the time of a float64 root and quotient.
    """
    for j in range(up.size):
        col = first + j
        east[j] = x - per_col_x * col
        north[j] = y - per_col_y * col
    for j in range(up.size):
        square = east[j] * east[j] + north[j] * north[j] + up[j] * up[j]
        inverse = np.float64(ONE / np.sqrt(np.float32(square)))
        inverse *= 1.5 - 0.5 * square * inverse * inverse
        inverse *= 1.5 - 0.5 * square * inverse * inverse
        east[j] *= inverse
        north[j] *= inverse
        up[j] *= inverse


def passes(points: Any, seconds: Any, table: Any, candidates: Any, wanted: Any) -> tuple[Any, Any]:
    """When the scan plane of a trajectory went over each point, and where the sensor was: the nearest pass.

    points     : float64 (3, rows, cols), on the ground. [m]
    seconds    : (samples,), ascending.
    table      : (samples, 6), position and forward vector at each sample; linear in between.
    candidates : int64, ascending: samples k such that the plane may pass a point between k and k + 1.
    wanted     : bool (rows, cols), or (1, 1) for everywhere; a tile without any is told to be passed at 0 s.

    A plane passes a point when the point, ahead of it at sample k, is behind it or on it at k + 1.
    Returns seconds (rows, cols), nan where no plane passes, and unit vectors (3, rows, cols), there up.
    """
    when, vectors, near = np.empty(points.shape[1:]), np.empty(points.shape), np.empty(candidates.size, np.int64)
    tile, ahead, counts = np.empty((3, TILE**2)), np.empty((2, TILE**2)), np.empty((2, TILE**2), np.int64)
    pass_tiles(points, seconds, table, candidates, wanted, when, vectors, near, tile, ahead, counts)
    return when, vectors


@njit(**LOOP)
def pass_tiles(points, seconds, table, candidates, wanted, when, vectors, near, tile, ahead, counts):
    """`passes` into `when` and `vectors`, tile by tile; the rest is scratch."""
    rows, cols = when.shape
    count, passed = counts[0], counts[1]
    for top in range(0, rows, TILE):
        for left in range(0, cols, TILE):
            bottom, right = min(top + TILE, rows), min(left + TILE, cols)
            if wanted.size > 1 and not _any_of(wanted, top, left, bottom, right):
                for i in range(top, bottom):
                    for j in range(left, right):
                        when[i, j] = 0.0
                        vectors[0, i, j], vectors[1, i, j], vectors[2, i, j] = 0.0, 0.0, 1.0
                continue
            p, size = 0, (bottom - top) * (right - left)
            for i in range(top, bottom):
                for j in range(left, right):
                    for c in range(3):
                        tile[c, p] = points[c, i, j]
                    p += 1
            nears = _near_samples(tile, size, table, candidates, near)
            _count_passes(tile, size, table, near, nears, ahead, counts)
            p = 0
            for i in range(top, bottom):
                for j in range(left, right):
                    found = (math.nan, 0.0, 0.0, 1.0)
                    point = (tile[0, p], tile[1, p], tile[2, p])
                    if count[p] == 1:
                        found = _seen(point, seconds, table, passed[p])[:4]
                    elif count[p] > 1:
                        found = _nearest_pass(point, seconds, table, near, nears)
                    when[i, j] = found[0]
                    vectors[0, i, j], vectors[1, i, j], vectors[2, i, j] = found[1], found[2], found[3]
                    p += 1


@njit(**PART)
def _any_of(mask, top, left, bottom, right):
    """Whether a mask is true anywhere in a window."""
    found = False
    for i in range(top, bottom):
        found |= _any(mask[i, left:right])
    return found


@njit(**PART)
def _near_samples(points, size, table, candidates, near):
    """The candidates whose planes may pass the box around the first points of a tile, into `near`; how many."""
    (x, east), (y, north), (z, up) = _box(points[0], size), _box(points[1], size), _box(points[2], size)
    middle, half = (x, y, z), (east, north, up)
    count = 0
    for k in candidates:
        if _ahead(middle, table, k) + _reach(half, table, k) <= 0:
            continue
        if _ahead(middle, table, k + 1) - _reach(half, table, k + 1) > 0:
            continue
        near[count] = k
        count += 1
    return count


@njit(**PART)
def _box(values, size):
    """Middle of the first values, and half of their range and a little more."""
    low, high = values[0], values[0]
    for p in range(size):
        value = values[p]
        low = value if value < low else low
        high = value if value > high else high
    return (low + high) / 2, (high - low) / 2 + 1e-6


@njit(**PART)
def _count_passes(points, size, table, near, nears, ahead, counts):
    """How often each point of a tile is passed, and after which sample the last time, into `counts`."""
    before, now, count, passed = ahead[0], ahead[1], counts[0], counts[1]
    for p in range(size):
        count[p] = 0
    last = -1
    for n in range(nears):
        k = near[n]
        if k != last:
            _ahead_of_all(points, size, table, k, before)
        last = k + 1
        _ahead_of_all(points, size, table, last, now)
        for p in range(size):
            passes_now = (before[p] > 0) & (now[p] <= 0)
            count[p] += passes_now
            passed[p] = k if passes_now else passed[p]
            before[p] = now[p]


@njit(**PART)
def _ahead_of_all(points, size, table, k, ahead):
    """`_ahead` of the first points of a tile, in the same order of arithmetic."""
    x, y, z = table[k, 0], table[k, 1], table[k, 2]
    east, north, up = table[k, 3], table[k, 4], table[k, 5]
    for p in range(size):
        ahead[p] = (points[0, p] - x) * east + (points[1, p] - y) * north + (points[2, p] - z) * up


@njit(**PART)
def _ahead(point, table, k):
    """How far a point lies ahead of the scan plane of sample k. [m]"""
    return (
        (point[0] - table[k, 0]) * table[k, 3]
        + (point[1] - table[k, 1]) * table[k, 4]
        + (point[2] - table[k, 2]) * table[k, 5]
    )


@njit(**PART)
def _reach(half, table, k):
    """How much farther ahead than its middle a box of these half sides reaches. [m]"""
    return half[0] * abs(table[k, 3]) + half[1] * abs(table[k, 4]) + half[2] * abs(table[k, 5])


@njit(**PART)
def _nearest_pass(point, seconds, table, near, nears):
    """`_seen` of the pass over a point that was nearest; of the earliest, where two were equally near."""
    found, least = (math.nan, 0.0, 0.0, 1.0), math.inf
    for n in range(nears):
        k = near[n]
        if _ahead(point, table, k) > 0 and _ahead(point, table, k + 1) <= 0:
            time, east, north, up, distance = _seen(point, seconds, table, k)
            if distance < least:
                found, least = (time, east, north, up), distance
    return found


@njit(**PART)
def _seen(point, seconds, table, k):
    """When a point was passed between samples k and k + 1, the unit vector to the sensor then, and its distance.

    In between, (point - position) . forward is a parabola ahead + slope s + bend s^2 with one root of falling sign.
    """
    ahead, behind = _ahead(point, table, k), _ahead(point, table, k + 1)
    bend = 0.0
    for c in range(3):
        bend -= (table[k + 1, c] - table[k, c]) * (table[k + 1, c + 3] - table[k, c + 3])
    slope = behind - ahead - bend
    root = math.sqrt(max(slope * slope - 4 * bend * ahead, 0.0))
    s = min(2 * ahead / (root - slope), 1.0)
    east = table[k, 0] + s * (table[k + 1, 0] - table[k, 0]) - point[0]
    north = table[k, 1] + s * (table[k + 1, 1] - table[k, 1]) - point[1]
    up = table[k, 2] + s * (table[k + 1, 2] - table[k, 2]) - point[2]
    distance = math.sqrt(east * east + north * north + up * up)
    time = seconds[k] + s * (seconds[k + 1] - seconds[k])
    return time, east / distance, north / distance, up / distance, distance


@njit(**LOOP)
def bilinear_unit(source, rows, cols, turn, result):
    """Unit vectors between the pixels of a raster of vectors, turned from true north to the grid's axes.

    source     : float64 (3, rows, cols), unit vectors east, north, up; of length 0 where there is none.
    rows, cols : (height, width), fractional places in `source`; the centre of its first pixel is (0, 0).
    turn       : (2, height, width), sine and cosine of the meridian convergence.

    result     : (3, height, width), zeros on entry, which stay where no vector is near: where less than a quarter
                 of the weight falls on pixels that have one. Up to half a pixel outside, the outer pixel holds.
    """
    last_row, last_col = source.shape[1] - 1, source.shape[2] - 1
    height, width = rows.shape
    for i in range(height):
        for j in range(width):
            row, col = rows[i, j], cols[i, j]
            if not (-0.501 <= row <= last_row + 0.501 and -0.501 <= col <= last_col + 0.501):
                continue
            row, col = min(max(row, 0.0), last_row), min(max(col, 0.0), last_col)
            top, left = int(row), int(col)
            bottom, right = min(top + 1, last_row), min(left + 1, last_col)
            down, across = row - top, col - left
            nw, ne = (1 - down) * (1 - across), (1 - down) * across
            sw, se = down * (1 - across), down * across
            east, north, up = 0.0, 0.0, 0.0
            for weight, r, c in ((nw, top, left), (ne, top, right), (sw, bottom, left), (se, bottom, right)):
                east += weight * source[0, r, c]
                north += weight * source[1, r, c]
                up += weight * source[2, r, c]
            length = math.sqrt(east * east + north * north + up * up)
            if length < 0.2499:
                continue
            sine, cosine = turn[0, i, j], turn[1, i, j]
            result[0, i, j] = (east * cosine - north * sine) / length
            result[1, i, j] = (east * sine + north * cosine) / length
            result[2, i, j] = up / length
