"""Weighted least squares of the Torrance-Sparrow model at one or many wavelengths at once.

The parameters of a wavelength, in this order: t0, p, w, n, and k where it is not held fixed. p = t1 F0 is
the strength of the lobe at normal incidence, F0 = F(theta_l = 0; n, k): the measurements determine p well,
but t1 and n only together. Parameters may be shared by all wavelengths.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.reference import Geometry

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FREE = ("t0", "t1_f0", "w", "n", "k")
"""what is solved for; k only on request"""

BOUNDS = {
    "t0": (0.0, np.inf),
    "t1_f0": (0.0, np.inf),
    "w": (1e-3, 10.0),
    "n": (1.0001, 6.0),
    "k": (0.0, 6.0),
}
INSIDE = 1e-6  # how far inside the bounds a start must lie
TOLERANCE = 1e-9
MAX_EVALUATIONS = 300

SEARCH_W = np.geomspace(0.015, 2.0, 40)  # per degree: from lobes as wide as the hemisphere to half a degree
SEARCH_N = np.array([1.1, 1.3, 1.6, 2.2])
SEARCH_K = 0.25  # where k is free
STARTS = 3


@dataclass(frozen=True, slots=True)
class Problem:
    """What is fitted to: values and their errors (bands, samples)."""

    geometry: Geometry
    """arrays (samples,)"""
    f_r: Array
    """nan where nothing was measured"""
    sigma: Array
    k: float | None = 0.25
    """held at this value; None: fitted"""
    simplified: bool = False
    shared: frozenset[str] = frozenset({"w"})
    """parameters that all wavelengths have in common"""

    @property
    def free(self) -> tuple[str, ...]:
        """Names of what is solved for at each wavelength."""
        return FREE if self.k is None else FREE[:-1]

    @property
    def index(self) -> Index:
        """(bands, parameters): where the parameters of a wavelength stand in the vector of unknowns."""
        bands, used, columns = len(self.f_r), 0, []
        for name in self.free:
            count = 1 if name in self.shared else bands
            columns.append(np.broadcast_to(used + np.arange(count), bands))
            used += count
        return np.stack(columns, axis=1)

    @property
    def weight(self) -> Array:
        """1/sigma, and 0 where nothing was measured."""
        return np.where(np.isfinite(self.f_r), 1 / self.sigma, 0.0)


@dataclass(frozen=True, slots=True)
class Solution:
    """The parameters of least chi2."""

    parameters: Array
    """(bands, parameters), in the order of `Problem.free`"""
    covariance: Array
    """(bands, parameters, parameters), as the given sigma have it; nan where it is singular"""
    chi2: Array
    """(bands,)"""
    f_r: Array
    """the model at the samples (bands, samples)"""
    converged: bool
    other_chi2: float
    """total chi2 of the next best minimum that another start led to; inf where all starts agree"""


def model(parameters: Array, problem: Problem) -> tuple[Array, Array]:
    """f_r of parameters (bands, p) at the samples, (bands, samples), and its partials (bands, samples, p)."""
    t0, p, w, n = (parameters[:, i, None] for i in range(4))
    k = parameters[:, 4, None] if problem.k is None else np.asarray(problem.k)
    f0, f0_by_n, f0_by_k = normal_incidence(n, k)
    t1 = p / f0
    by = reference.brdf_gradient(problem.geometry, t1, w, n, k, simplified=problem.simplified)
    partials = [
        by.t0,
        by.t1 / f0,
        by.w,
        by.n - t1 * by.t1 * f0_by_n / f0,  # at fixed p, t1 = p / F0 falls as F0 rises with n
        by.k - t1 * by.t1 * f0_by_k / f0,
    ]
    return reference.brdf(by.t1, t0, t1), np.stack(partials[: len(problem.free)], axis=-1)


def solve(problem: Problem, starts: Sequence[Array] | None = None) -> Solution:
    """The best of the least-squares solutions from `starts`, each (bands, p); by default from `search`."""
    index = problem.index
    triangles = _Triangles(problem)
    results = [_least_squares(triangles, start) for start in (search(problem) if starts is None else starts)]
    results.sort(key=lambda result: float(result.cost))
    best = results[0]
    parameters = best.x[index]
    blocks = triangles.at(best.x)
    return Solution(
        parameters=parameters,
        covariance=_covariance(blocks[..., :-1], index),
        chi2=np.sum(blocks[..., -1] ** 2, axis=1),
        f_r=model(parameters, problem)[0],
        converged=bool(best.status > 0),
        other_chi2=min((2 * r.cost for r in results[1:] if _elsewhere(r.x, best.x)), default=np.inf),
    )


def search(problem: Problem) -> list[Array]:
    """Starts (bands, p): the best few local minima of chi2 over a grid of w and n.

    For a given shape of the lobe f_r is linear in t0 and p, so that every node of the grid is solved exactly.
    """
    t0, p, chi2 = lobe_grid(problem)
    best_n = np.argmin(chi2.sum(axis=0, keepdims=True) if "n" in problem.shared else chi2, axis=2)
    best_n = np.broadcast_to(best_n, chi2.shape[:2])
    score = np.take_along_axis(chi2, best_n[..., None], axis=2)[..., 0]
    if "w" in problem.shared:
        score = np.broadcast_to(score.sum(axis=0), score.shape)
    ranked = [_local_minima(row) for row in score]
    bands = np.arange(len(chi2))
    starts = []
    for rank in range(min(STARTS, max(len(minima) for minima in ranked))):
        i_w = np.array([minima[min(rank, len(minima) - 1)] for minima in ranked])
        i_n = best_n[bands, i_w]
        n = SEARCH_N[i_n]
        columns = [t0[bands, i_w, i_n], p[bands, i_w, i_n], SEARCH_W[i_w], n, np.full(len(bands), SEARCH_K)]
        starts.append(np.stack(columns[: len(problem.free)], axis=1))
    return starts


def lobe_grid(problem: Problem) -> tuple[Array, Array, Array]:
    """t0, p >= 0 and chi2 of the best fit at each w and n of the search grid, (bands, w, n) each."""
    k = np.asarray(SEARCH_K if problem.k is None else problem.k)
    w, n = SEARCH_W[:, None, None], SEARCH_N[None, :, None]
    f0 = normal_incidence(n, k)[0]
    lobe = reference.specular(problem.geometry, w, n, k, simplified=problem.simplified) / f0
    shape = lobe.shape[:2]
    lobe = lobe.reshape(-1, lobe.shape[-1]).T
    w1 = problem.weight**2
    wy = w1 * np.where(w1 > 0, problem.f_r, 0)
    s, sy, syy = (row[:, None] for row in (w1.sum(1), wy.sum(1), np.nansum(wy * problem.f_r, axis=1)))
    sf, sff, sfy = w1 @ lobe, w1 @ lobe**2, wy @ lobe
    determinant = s * sff - sf**2
    p = np.maximum(0, _ratio(s * sfy - sf * sy, determinant))
    t0 = (sy - sf * p) / s
    p = np.where(t0 < 0, np.maximum(0, _ratio(sfy, sff)), p)
    t0 = np.maximum(0, t0)
    chi2 = syy - 2 * (t0 * sy + p * sfy) + t0**2 * s + 2 * t0 * p * sf + p**2 * sff
    return t0.reshape(-1, *shape), p.reshape(-1, *shape), chi2.reshape(-1, *shape)


class _Triangles:
    """The residual and Jacobian of a problem, each wavelength's block as a small triangle.

    A trust-region solver knows the residual r and the Jacobian J by their lengths and products only, which
    a rotation of the samples does not change. So the block [J r] of a wavelength, thousands of rows long,
    is handed over as the triangle of its QR decomposition, with as many rows as columns.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.index = problem.index
        self.weight = problem.weight
        self.values = np.where(self.weight > 0, problem.f_r, 0)
        self._x = np.empty(0)
        self._blocks = np.empty(0)

    def at(self, x: Array) -> Array:
        """Triangles (bands, p + 1, p + 1) of [J r]; kept, as the solver asks for r, then for J."""
        if not np.array_equal(x, self._x):
            f_r, partials = model(x[self.index], self.problem)
            block = np.concatenate([partials, (f_r - self.values)[..., None]], axis=-1)
            self._blocks = np.asarray(np.linalg.qr(block * self.weight[..., None], mode="r"))
            self._x = x.copy()
        return self._blocks

    def residual(self, x: Array) -> Array:
        return self.at(x)[..., -1].ravel()

    def jacobian(self, x: Array) -> Array:
        blocks = self.at(x)[..., :-1]
        bands, rows, _ = blocks.shape
        jacobian = np.zeros((bands, rows, len(x)))
        np.put_along_axis(jacobian, self.index[:, None, :].repeat(rows, axis=1), blocks, axis=2)
        return jacobian.reshape(-1, len(x))


def _least_squares(triangles: _Triangles, start: Array) -> Any:
    """The trust-region solver of scipy, with the analytic Jacobian, bounds, and scaling by the Jacobian."""
    from scipy.optimize import least_squares

    index, free = triangles.index, triangles.problem.free
    x0, lower, upper = (np.empty(int(index.max()) + 1) for _ in range(3))
    lower[index], upper[index] = np.array([BOUNDS[name] for name in free]).T
    x0[index] = start
    return least_squares(
        triangles.residual,
        np.clip(x0, lower + INSIDE, upper - INSIDE),
        triangles.jacobian,
        bounds=(lower, upper),
        x_scale="jac",
        ftol=TOLERANCE,
        xtol=TOLERANCE,
        gtol=TOLERANCE,
        max_nfev=MAX_EVALUATIONS,
    )


def _covariance(blocks: Array, index: Index) -> Array:
    """(J^T J)^-1 of all unknowns, taken apart into the parameters of each wavelength."""
    size = int(index.max()) + 1
    normal = np.zeros((size, size))
    for block, at in zip(blocks, index, strict=True):
        normal[np.ix_(at, at)] += block.T @ block
    scale = np.sqrt(np.diag(normal))
    try:
        with np.errstate(invalid="ignore", divide="ignore"):
            inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    except np.linalg.LinAlgError:  # a parameter without effect, or two with one effect
        inverse = np.full((size, size), np.nan)
    return inverse[index[:, :, None], index[:, None, :]]


def normal_incidence(n: Array, k: Array) -> tuple[Array, Array, Array]:
    """F0 = F(theta_l = 0) and its derivatives by n and k."""
    one = np.ones(())
    return reference.fresnel(one, n, k), *reference.fresnel_gradient(one, n, k)


def _ratio(numerator: Array, denominator: Array) -> Array:
    """The quotient, 0 where the denominator is: a lobe that no sample sees has no strength."""
    return np.where(denominator > 0, numerator, 0) / np.where(denominator > 0, denominator, 1)


def _local_minima(score: Array) -> list[int]:
    """Places of the local minima of a row, the lowest first."""
    padded = np.concatenate([[np.inf], score, [np.inf]])
    places = np.flatnonzero((score <= padded[:-2]) & (score < padded[2:]))
    return [int(place) for place in places[np.argsort(score[places], kind="stable")]] or [0]


def _elsewhere(x: Array, best: Array) -> bool:
    return not np.allclose(x, best, rtol=1e-3, atol=1e-6)
