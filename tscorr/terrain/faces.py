"""Faces of a surface model: connected pixels on one plane, by compiled loops over pixels.

The steps are explained, and called in turn, in `tscorr.terrain.roof_planes`. Throughout:

z       : heights (rows, cols), nan = void; `datum` is subtracted so that sums of squares stay small
labels  : int32 (rows, cols), the face of each pixel, 0 = none
planes  : (faces, 5), rise a column, rise a row, and a point: column, row, height above datum
moments : (faces, 10), sums over a face's pixels of 1 x y h xx xy yy xh yh hh, x the column, y the row
sigma   : standard deviation of the heights' noise; `tolerance`, `step` are heights too
fits    : float32 (rows, cols, 3) and (rows, cols), a plane about each pixel (rise a column, rise a row, height above
          datum) and the rms of the heights about it, inf where there is none
border  : flat indices of the pixels beside another face

Nothing is allocated here, results and scratch memory are given: that halves what there is to compile.
"""

import math

import numpy as np
from numba import njit

from tscorr.loops import LOOP, PART

REACH_PX = 32  # a face is cut beyond this distance from its seed, so that the result is local
SEED_RADIUS = 2  # of the windows from which faces grow first
LEAST_PX = 6  # fewer heights make no face: 3 unknowns, and 3 to see whether it is plane
SEED_RMS = 1.5  # sigma: a window that is less plane is no seed
OUTLIER_COST = 8.0  # chi-square / 2, a residual of 4 sigma: dearer than any plane is "no plane"
NEIGHBOUR_COST = 0.5  # of each of the 8 neighbours that has another label; chi-square / 2
MERGE_CHI2 = 16.3  # exceeded by 0.1 % of chi-square with 3 degrees of freedom
CLEAR_MEETING = 0.5  # of 1: how clearly two faces must show a ridge or a valley
SEED_CLASSES = 64  # of rms, in which faces grow one after the other


@njit(**PART)
def _add(moments, x, y, h):
    moments[0] += 1.0
    moments[1] += x
    moments[2] += y
    moments[3] += h
    moments[4] += x * x
    moments[5] += x * y
    moments[6] += y * y
    moments[7] += x * h
    moments[8] += y * h
    moments[9] += h * h


@njit(**PART)
def _centred(moments):
    """Centred second moments: xx, xy, yy, xh, yh, hh."""
    n = moments[0]
    x, y, h = moments[1] / n, moments[2] / n, moments[3] / n
    return (
        moments[4] - n * x * x,
        moments[5] - n * x * y,
        moments[6] - n * y * y,
        moments[7] - n * x * h,
        moments[8] - n * y * h,
        moments[9] - n * h * h,
    )


@njit(**PART)
def _solve(moments, plane):
    """Set the least-squares plane of the pixels; False, and no plane, if they are in a line."""
    xx, xy, yy, xh, yh, _ = _centred(moments)
    determinant = xx * yy - xy * xy
    if not determinant > 1e-6 * (xx + yy) ** 2 or xx + yy <= 0.0:
        return False
    plane[0] = (xh * yy - yh * xy) / determinant
    plane[1] = (yh * xx - xh * xy) / determinant
    plane[2] = moments[1] / moments[0]
    plane[3] = moments[2] / moments[0]
    plane[4] = moments[3] / moments[0]
    return True


@njit(**PART)
def _misfit(moments):
    """Sum of squared residuals from the least-squares plane of the pixels."""
    xx, xy, yy, xh, yh, hh = _centred(moments)
    determinant = xx * yy - xy * xy
    if determinant <= 0.0:
        return 0.0
    return max(hh - (xh * xh * yy - 2.0 * xh * yh * xy + yh * yh * xx) / determinant, 0.0)


@njit(**PART)
def _height(plane, col, row):
    return plane[4] + plane[0] * (col - plane[2]) + plane[1] * (row - plane[3])


@njit(**LOOP)
def window_fits(z, datum, tilts, rms, sums):
    """Least-squares planes of all full windows into fits `tilts`, `rms`; `sums` is (3, cols) of scratch."""
    radius, (rows, cols) = SEED_RADIUS, z.shape
    n = (2 * radius + 1) ** 2
    spread = n * radius * (radius + 1) / 3.0  # sum of squared offsets
    for i in range(radius, rows - radius):
        sums[:] = 0.0  # down each column of the window: height, offset * height, height^2
        for a in range(-radius, radius + 1):
            for j in range(cols):
                d = z[i + a, j] - datum
                sums[0, j] += d
                sums[1, j] += a * d
                sums[2, j] += d * d
        for j in range(radius, cols - radius):
            total, by_col, by_row, squares = 0.0, 0.0, 0.0, 0.0
            for b in range(-radius, radius + 1):
                total += sums[0, j + b]
                by_col += b * sums[0, j + b]
                by_row += sums[1, j + b]
                squares += sums[2, j + b]
            rest = squares - total * total / n - (by_col * by_col + by_row * by_row) / spread
            if math.isfinite(rest):
                tilts[i, j, 0] = by_col / spread
                tilts[i, j, 1] = by_row / spread
                tilts[i, j, 2] = total / n
                rms[i, j] = math.sqrt(max(rest, 0.0) / (n - 3))


@njit(**LOOP)
def free_fits(z, datum, labels, step, tilts, rms, moments, plane):
    """As `window_fits`, for what is left: 3 x 3 around free pixels (label 0), of free pixels only.

    Neighbours farther in height than `step` are on another surface; LEAST_PX must be left. `moments` and `plane`
    of one face are scratch.
    """
    rows, cols = z.shape
    for i in range(rows):
        for j in range(cols):
            if labels[i, j] != 0:
                continue
            moments[:] = 0.0
            for a in range(max(0, i - 1), min(rows, i + 2)):
                for b in range(max(0, j - 1), min(cols, j + 2)):
                    if labels[a, b] == 0 and abs(z[a, b] - z[i, j]) <= step:
                        _add(moments, b - j, a - i, z[a, b] - datum)
            if moments[0] >= LEAST_PX and _solve(moments, plane):
                tilts[i, j, 0], tilts[i, j, 1] = plane[0], plane[1]
                tilts[i, j, 2] = _height(plane, 0, 0)
                rms[i, j] = math.sqrt(_misfit(moments) / (moments[0] - 3.0))


def best_first(rms, sigma):
    """Flat indices of the pixels that may be seeds, by classes of rms, then in row order."""
    flat, limit = rms.ravel(), SEED_RMS * sigma
    seeds = np.flatnonzero(flat < limit)
    classes = (flat[seeds] / np.float64(limit) * SEED_CLASSES).astype(np.uint8)
    return seeds[np.argsort(classes, kind="stable")]


@njit(**LOOP)
def grow(z, datum, labels, tilts, seeds, tolerance, first_fit, label, queue, moments, plane):
    """Spread planes from seeds, best first, over free neighbours (label 0) that fit: next free label.

    `tilts` are those of `window_fits` or `free_fits`. A face's plane is fitted again when it has
    `first_fit` pixels and each time it has doubled. `queue`, int32 ((2 REACH_PX + 1)^2,), `moments` and `plane`
    are scratch.
    """
    rows, cols = z.shape
    for seed in seeds:
        row, col = seed // cols, seed % cols
        plane[0], plane[1], plane[2], plane[3] = tilts[row, col, 0], tilts[row, col, 1], col, row
        plane[4] = tilts[row, col, 2]
        if labels[row, col] != 0 or abs(z[row, col] - datum - plane[4]) > tolerance:
            continue
        moments[:] = 0.0
        taken, next_fit = 1, first_fit
        queue[0] = seed
        labels[row, col] = label
        done = 0
        while done < taken:
            i, j = queue[done] // cols, queue[done] % cols
            done += 1
            _add(moments, j, i, z[i, j] - datum)
            if done == next_fit:
                _solve(moments, plane)
                next_fit *= 2
            for a, b in ((i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
                if a < 0 or b < 0 or a >= rows or b >= cols or labels[a, b] != 0:
                    continue
                if abs(a - row) > REACH_PX or abs(b - col) > REACH_PX:
                    continue
                if abs(z[a, b] - datum - _height(plane, b, a)) < tolerance:
                    labels[a, b] = label
                    queue[taken] = a * cols + b
                    taken += 1
        if taken >= LEAST_PX:
            label += 1
        else:
            for k in range(taken):
                labels[queue[k] // cols, queue[k] % cols] = 0
    return label


@njit(**LOOP)
def add_moments(z, datum, labels, planes, tolerance, moments):
    """Add to the moments of each face its pixels that lie within `tolerance` of its plane; inf takes all."""
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            label = labels[i, j]
            if label > 0:
                h = z[i, j] - datum
                if tolerance == math.inf or abs(h - _height(planes[label], j, i)) < tolerance:
                    _add(moments[label], j, i, h)


@njit(**LOOP)
def fit_planes(moments, planes):
    """Fit the plane of each face; a face with too few pixels, or pixels in a line, keeps the one it had."""
    for label in range(1, len(moments)):
        if moments[label, 0] >= 3:
            _solve(moments[label], planes[label])


@njit(**PART)
def _root(parent, label):
    while parent[label] != label:
        parent[label] = parent[parent[label]]
        label = parent[label]
    return label


@njit(**LOOP)
def merge(labels, moments, sigma, parent, both):
    """Join touching pieces that one plane fits as well as two; changes labels and moments.

    parent : int64 (faces,), each face its own on entry; both : scratch for the moments of one face.
    """
    rows, cols = labels.shape
    for i in range(rows):
        for j in range(cols):
            for a, b in ((i, j + 1), (i + 1, j)):
                if a == rows or b == cols or labels[i, j] == 0 or labels[a, b] == 0:
                    continue
                if labels[i, j] == labels[a, b]:
                    continue
                first, second = _root(parent, labels[i, j]), _root(parent, labels[a, b])
                if first == second:
                    continue
                for m in range(both.size):
                    both[m] = moments[first, m] + moments[second, m]
                worse = _misfit(both) - _misfit(moments[first]) - _misfit(moments[second])
                if worse < MERGE_CHI2 * sigma * sigma:
                    keep, drop = min(first, second), max(first, second)
                    parent[drop] = keep
                    for m in range(both.size):
                        moments[keep, m], moments[drop, m] = both[m], 0.0
    for i in range(rows):
        for j in range(cols):
            if labels[i, j] > 0:
                labels[i, j] = _root(parent, labels[i, j])


def border(labels):
    """Flat indices of the pixels that have an 8-neighbour with another label, in row order."""
    beside = np.zeros(labels.shape, np.bool_)
    for here, there in (
        (np.s_[1:], np.s_[:-1]),
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        different = labels[here] != labels[there]
        beside[here] |= different
        beside[there] |= different
    return np.flatnonzero(beside)


@njit(**LOOP)
def relabel(z, datum, labels, planes, sigma, border, near, votes):
    """One sweep: each pixel at a border takes the neighbouring face of least cost, or none (0).

    near, votes : int32 (8,), scratch.
    """
    rows, cols = z.shape
    for pixel in border:
        i, j = pixel // cols, pixel % cols
        if not math.isfinite(z[i, j]):
            continue
        kinds, neighbours = 0, -1  # the pixel itself is none
        for a in range(max(0, i - 1), min(rows, i + 2)):
            for b in range(max(0, j - 1), min(cols, j + 2)):
                neighbours += 1
                if labels[a, b] == 0 or (a == i and b == j):
                    continue
                k = 0
                while k < kinds and near[k] != labels[a, b]:
                    k += 1
                if k == kinds:
                    near[k], votes[k] = labels[a, b], 0
                    kinds += 1
                votes[k] += 1
        labels[i, j], least = 0, math.inf
        for k in range(kinds):
            misfit = 0.5 * ((z[i, j] - datum - _height(planes[near[k]], j, i)) / sigma) ** 2
            cost = misfit + NEIGHBOUR_COST * (neighbours - votes[k])
            if misfit < OUTLIER_COST and cost < least:
                labels[i, j], least = near[k], cost


@njit(**PART)
def _valley(labels, planes, own, other, i, j, limit):
    """How two faces meet near a pixel, from -1 (ridge: the surface is the lower plane) to 1 (valley)."""
    middle = _height(planes[own], j, i) - _height(planes[other], j, i)
    by_col, by_row = planes[own, 0] - planes[other, 0], planes[own, 1] - planes[other, 1]
    valley, total = 0.0, 0.0
    for a in range(max(0, i - 2), min(labels.shape[0], i + 3)):
        for b in range(max(0, j - 2), min(labels.shape[1], j + 3)):
            if labels[a, b] == own or labels[a, b] == other:
                gap = min(max(middle + by_col * (b - j) + by_row * (a - i), -limit), limit)
                valley += gap if labels[a, b] == own else -gap
                total += abs(gap)
    return valley / total if total > 0.0 else 0.0


@njit(**LOOP)
def resolve(z, datum, labels, planes, sigma, tolerance, border, settled):
    """Into `settled`, a copy of the labels: the pixels on the planes of two faces settled by how the faces meet.

    In the 5 x 5 pixels around, each face shows whether it is the lower of the two planes where it
    lives (ridge) or the higher (valley); then the two planes, not the noisy height, decide.
    """
    rows, cols = z.shape
    for pixel in border:
        i, j = pixel // cols, pixel % cols
        own = labels[i, j]
        if own == 0:
            continue
        asked = own  # a run of one label is asked once; one's own plane is one with itself
        for a in range(max(0, i - 1), min(rows, i + 2)):
            for b in range(max(0, j - 1), min(cols, j + 2)):
                other = labels[a, b]
                if not other or other == asked:
                    continue
                asked = other
                if abs(z[i, j] - datum - _height(planes[other], j, i)) > tolerance:
                    continue
                gap = _height(planes[own], j, i) - _height(planes[other], j, i)
                by_col, by_row = planes[own, 0] - planes[other, 0], planes[own, 1] - planes[other, 1]
                if abs(gap) + 2.0 * (abs(by_col) + abs(by_row)) < sigma:
                    continue  # the planes are one as far as these heights can tell
                valley = _valley(labels, planes, own, other, i, j, tolerance)
                if abs(valley) > CLEAR_MEETING and valley * gap < 0.0:
                    settled[i, j] = other


@njit(**LOOP)
def mark_undecided(labels, planes, limit, tilt, cell_x_m, cell_y_m, border, result):
    """Set pixels within `limit` of the plane of a neighbouring face whose slope differs by more than `tilt`."""
    rows, cols = labels.shape
    for pixel in border:
        i, j = pixel // cols, pixel % cols
        own = planes[labels[i, j]]
        for a in range(max(0, i - 1), min(rows, i + 2)):
            for b in range(max(0, j - 1), min(cols, j + 2)):
                if labels[i, j] == 0 or labels[a, b] == 0 or labels[a, b] == labels[i, j]:
                    continue
                other = planes[labels[a, b]]
                apart = math.hypot((own[0] - other[0]) / cell_x_m, (own[1] - other[1]) / cell_y_m)
                gap = abs(_height(own, j, i) - _height(other, j, i))
                result[i, j] |= apart > tilt and gap < limit


@njit(**LOOP)
def adopt(z, datum, labels, planes, adopted):
    """Into `adopted`, a copy of the labels: pixels on no face take the face in 5 x 5 whose plane is nearest."""
    rows, cols = z.shape
    for i in range(rows):
        for j in range(cols):
            if labels[i, j] != 0 or not math.isfinite(z[i, j]):
                continue
            nearest = math.inf
            for a in range(max(0, i - 2), min(rows, i + 3)):
                for b in range(max(0, j - 2), min(cols, j + 3)):
                    if labels[a, b] != 0:
                        distance = abs(z[i, j] - datum - _height(planes[labels[a, b]], j, i))
                        if distance < nearest:
                            nearest, adopted[i, j] = distance, labels[a, b]
