"""Surface normals of roof faces: planes fitted to the connected pieces of a DSM.

A DSM carries centimetres of noise, which in a window of 3 x 3 pixels of 0.5 m makes degrees of
slope; and a window at a ridge, an eave or a wall sees two surfaces. Here every pixel gets the
normal of the plane of the face that it belongs to. Decisions are taken by heights in units of
their noise (sigma), in these steps:

1. grow: from pixels whose 5 x 5 window is plane within the noise, best first, a plane is spread over
   the neighbours that fit it, and fitted again each time the face has doubled; then the same from
   what is left in 3 x 3, for narrow faces;
2. merge: touching pieces become one where one plane fits both as well as two (chi-square);
3. relabel: a pixel at a border goes to the neighbouring face that fits its own height best, at a cost for
   each neighbour of another face (Potts), by iterated conditional modes (Besag 1986, J. R. Stat.
   Soc. B 48, 259); planes proposed, spread and fitted again are Isack & Boykov 2012 (IJCV 97, 123);
4. resolve: near a ridge the heights of two faces differ by less than the noise, but the planes are
   known better: the surface is the lower plane at a ridge, the higher one in a valley.
   Planes are fitted again, and 3 and 4 repeated;
5. a pixel that fits no plane takes the tilt of the nearest plane beside it, and is unreliable.

Conventions as in `tscorr.terrain.normals`. Callers that work in tiles give `HALO_PX` pixels more on
every side and estimate the noise once per scene with `height_noise`. Then results depend on the tiling
only where a face is larger than the halo (another set of its pixels is fitted) and by chains of
decisions at borders. Memory: about 35 bytes a pixel.

Noise that neighbouring pixels share (image matching, interpolation) is not seen by
`height_noise` and makes faces break up or bend: give a larger `noise_m` then.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.terrain import faces

HALO_PX = 64  # twice the reach of a face: what touches a tile, and what competes with that
LEAST_NOISE = 0.01  # of the larger cell: 0.6 degrees between neighbours, 5 mm at 0.5 m
ROOF_SLOPE = 3.0  # 72 degrees: neighbours farther apart in height are on two surfaces
TOLERANCE = 3.0  # sigma: a height farther from a plane is not on it
SWEEPS = 3
TRUSTED_FACE_PX = 12  # fewer do not show a plane well enough
FORK_TILT_DEG = 5.0  # faces tilted by more against each other must not be confused
FORK_SIGMA = 1.0  # sigma: where two planes are nearer than this, one normal in four is the wrong one's (sample)
UNKNOWN_SIGMA_DEG = 35.0  # of a pixel on no face, as measured in the sample

_CLIPPED_MEDIAN = 0.6722  # median magnitude of unit Gaussian noise clipped at 3

Array = NDArray[np.floating[Any]]


class RoofPlanes(NamedTuple):
    """What `roof_planes` returns; arrays (rows, cols), normals (3, rows, cols).

    normals    : float32 unit vectors, east, north, up; finite everywhere, up where nothing is known.
    unreliable : bool; a void, a pixel on no face, on a face of less than TRUSTED_FACE_PX pixels, or
                 where two faces meet so near the pixel's centre that it may belong to the other.
    sigma_deg  : float32; 1-sigma error of the face's normal from the noise of its heights, along
                 each of two perpendicular axes (the error angle's rms is sqrt(2) times that). [deg]
    """

    normals: NDArray[np.float32]
    unreliable: NDArray[np.bool_]
    sigma_deg: NDArray[np.float32]


def height_noise(heights: Array) -> float:
    """Standard deviation of the uncorrelated noise of heights (rows, cols), nan = void. [m]

    From the response to [1 -2 1; -2 4 -2; 1 -2 1], which is zero on every plane and on ridges along
    the axes, and 6 sigma on noise (Immerkaer 1996, Comput. Vis. Image Underst. 64, 300). Edges and
    trees are left out by clipping at 3 sigma until nothing changes, responses of exactly zero
    (flattened water) from the start. 0 where there is nothing to measure.
    Estimate once per scene: the value must not depend on how the scene is cut into tiles.
    """
    along = np.diff(np.asarray(heights, dtype=np.float64), n=2, axis=0)
    response = np.abs(np.diff(along, n=2, axis=1)) / 6.0
    response = np.sort(response[(response > 0) & np.isfinite(response)])
    sigma, inside, before = 0.0, response.size, -1
    while inside not in {before, 0}:
        sigma = float(response[inside // 2]) / _CLIPPED_MEDIAN
        before, inside = inside, int(np.searchsorted(response, 3.0 * sigma))
    return sigma


def roof_planes(heights: Array, *, cell_x_m: float, cell_y_m: float, noise_m: float | None = None) -> RoofPlanes:
    """Normals of the planes that the surface is made of.

    heights : (rows, cols), row 0 in the north, nan = void. [m]
    noise_m : standard deviation of the heights' noise; None estimates it from these heights, so give
              the scene's value (`height_noise`) when working in tiles. [m]
    """
    z = np.ascontiguousarray(heights)
    if noise_m is None:
        noise_m = height_noise(z)
    cell_m = max(cell_x_m, cell_y_m)
    sigma = max(noise_m, LEAST_NOISE * cell_m)
    finite = np.isfinite(z)
    datum = float(z[finite].mean(dtype=np.float64)) if finite.any() else 0.0

    labels, planes, moments = _find_faces(z, datum, sigma, ROOF_SLOPE * cell_m)
    tilt = math.tan(math.radians(FORK_TILT_DEG))
    fork = np.zeros(z.shape, np.bool_)
    faces.mark_undecided(labels, planes, FORK_SIGMA * sigma, tilt, cell_x_m, cell_y_m, faces.border(labels), fork)
    small = moments[:, 0] < TRUSTED_FACE_PX  # and so is face 0, which has no pixels
    normals = _face_normals(planes, cell_x_m, cell_y_m)
    sigma_deg = _face_sigma_deg(moments, normals, sigma, cell_x_m, cell_y_m)
    adopted = labels.copy()
    faces.adopt(z, datum, labels, planes, adopted)
    return RoofPlanes(
        np.stack([component[adopted] for component in normals.astype(np.float32)]),
        small[labels] | fork,
        sigma_deg.astype(np.float32)[labels],
    )


def _find_faces(z: Array, datum: float, sigma: float, step: float) -> tuple[NDArray[np.int32], Array, Array]:
    """Steps 1 to 4: labels, planes and moments as `tscorr.terrain.faces` describes them."""
    tolerance = TOLERANCE * sigma
    labels = np.zeros(z.shape, np.int32)
    window_px = (2 * faces.SEED_RADIUS + 1) ** 2
    face = np.zeros(10), np.zeros(5)  # scratch: moments and plane of one
    queue = np.zeros((2 * faces.REACH_PX + 1) ** 2, np.int32)
    tilts, rms = _no_fits(z.shape)
    faces.window_fits(z, datum, tilts, rms, np.zeros((3, z.shape[1])))
    seeds = faces.best_first(rms, sigma)
    count = faces.grow(z, datum, labels, tilts, seeds, tolerance, window_px, 1, queue, *face)
    tilts, rms = _no_fits(z.shape)
    faces.free_fits(z, datum, labels, step, tilts, rms, *face)
    seeds = faces.best_first(rms, sigma)
    count = faces.grow(z, datum, labels, tilts, seeds, tolerance, faces.LEAST_PX, count, queue, *face)
    planes, moments = np.zeros((count, 5)), np.zeros((count, 10))
    faces.add_moments(z, datum, labels, planes, math.inf, moments)
    faces.merge(labels, moments, sigma, np.arange(count), face[0])
    faces.fit_planes(moments, planes)
    for _ in range(SWEEPS):
        near, votes = np.zeros((2, 8), np.int32)
        faces.relabel(z, datum, labels, planes, sigma, faces.border(labels), near, votes)
        settled, moments = labels.copy(), np.zeros((count, 10))
        faces.resolve(z, datum, labels, planes, sigma, tolerance, faces.border(labels), settled)
        labels = settled
        faces.add_moments(z, datum, labels, planes, tolerance, moments)
        faces.fit_planes(moments, planes)
    return labels, planes, moments


def _no_fits(shape: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fits as `tscorr.terrain.faces` describes them, without any plane."""
    return np.zeros((*shape, 3), np.float32), np.full(shape, np.inf, np.float32)


def _face_normals(planes: Array, cell_x_m: float, cell_y_m: float) -> Array:
    """Unit normals (3, faces); up for face 0. Rows run south, so a rise a row is a fall to the south."""
    normals = np.stack([-planes[:, 0] / cell_x_m, planes[:, 1] / cell_y_m, np.ones(len(planes))])
    return normals / np.sqrt((normals**2).sum(axis=0))


def _face_sigma_deg(moments: Array, normals: Array, sigma: float, cell_x_m: float, cell_y_m: float) -> Array:
    """1-sigma error (faces,) of the normals along each of two perpendicular axes. [deg]

    The covariance of the two slopes is sigma^2 times the inverse of the centred second moments. An
    error of slope turns the normal by cos^2 of the tilt downhill, by cos of the tilt across.
    """
    n = np.maximum(moments[:, 0], 1.0)
    x, y = moments[:, 1] / n, moments[:, 2] / n
    xx = (moments[:, 4] - n * x * x) * cell_x_m**2
    xy = -(moments[:, 5] - n * x * y) * cell_x_m * cell_y_m  # rows run south
    yy = (moments[:, 6] - n * y * y) * cell_y_m**2
    determinant = xx * yy - xy * xy
    known = (moments[:, 0] >= faces.LEAST_PX) & (determinant > 0.0)
    scale = sigma**2 / np.where(known, determinant, 1.0)
    east, north, up = normals
    level = np.hypot(east, north)
    sin_a, cos_a = np.where(level > 0.0, (east, north), ((0.0,), (1.0,))) / np.where(level > 0.0, level, 1.0)
    downhill = scale * (yy * sin_a**2 - 2.0 * xy * sin_a * cos_a + xx * cos_a**2)
    across = scale * (xx + yy) - downhill
    error = np.rad2deg(np.sqrt(np.maximum(0.5 * (downhill * up**4 + across * up**2), 0.0)))
    return np.where(known, np.minimum(error, UNKNOWN_SIGMA_DEG), UNKNOWN_SIGMA_DEG)
