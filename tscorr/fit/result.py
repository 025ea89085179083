"""What a fit gives back: parameters with their covariance, and how far to believe them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.fit.measurements import Measurements
from tscorr.fit.solver import Problem, Solution, normal_incidence
from tscorr.materials import FITTED, PARAMETERS, Material

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bootstrap:
    """How the fit does on data whose truth is known: the fitted model plus its own residuals, reshuffled.

    Arrays (bands, parameters) in the order t0, t1, w, n (and k where fitted).
    """

    replicates: int
    coverage: Array
    """share of replicates whose 1 sigma interval holds the truth; 0.68 is right"""
    bias: Array
    """mean error, in units of the stated sigma"""
    sigma: Array
    """scatter of the replicates; sees errors common to all wavelengths, which the covariance does not"""


@dataclass(frozen=True, slots=True)
class FitResult:
    """A fitted material and what is known of its errors; arrays over bands are in order of wavelength."""

    material: Material
    covariances: Array
    """(bands, p, p) of t0, t1, w, n (and k where fitted), scaled by chi2/df where that exceeds 1 or sigma was
    missing; shared parameters by what residuals of different wavelengths have in common, too"""
    formal_covariances: Array
    """the same as the given sigma have it, unscaled"""
    chi2_dof: float
    degrees_of_freedom: int
    t1_f0: Array
    """(bands,) t1 F0, the strength of the lobe at normal incidence: well determined where t1 is not"""
    t1_f0_sigma: Array
    given: int
    """how many samples there are, used or not"""
    measured: Measurements
    """the samples used"""
    model_f_r: Array
    """the fitted model at the samples (bands, samples)"""
    sigma: Array
    """error of each sample that the fit took (bands, samples)"""
    converged: bool
    form: str
    """of the model: "full" or "simplified" """
    warnings: tuple[str, ...] = ()
    bootstrap: Bootstrap | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fitted parameters, in the order of `covariances`."""
        return (*FITTED, "k")[: self.covariances.shape[-1]]

    @property
    def middle(self) -> int:
        """The band whose covariance the material carries."""
        return len(self.covariances) // 2

    @property
    def covariance(self) -> Array:
        """4 x 4 of t0, t1, w, n at the middle wavelength, as the material carries it."""
        return self.covariances[self.middle, :4, :4]

    @property
    def correlation(self) -> Array:
        """Correlations of t0, t1, w, n (and k where fitted) at the middle wavelength."""
        return correlation(self.covariances[self.middle])

    @property
    def condition(self) -> float:
        """Condition number of `correlation`: some 100 with k held, some 10 000 with k free."""
        return condition(self.correlation)

    @property
    def residuals(self) -> Array:
        """(measured - model) / sigma, (bands, samples); nan where nothing was measured."""
        return (self.measured.f_r - self.model_f_r) / self.sigma

    @property
    def parameters(self) -> Array:
        """(bands, 5) t0, t1, w, n, k."""
        columns = (getattr(self.material, name) for name in PARAMETERS)
        return np.stack([np.broadcast_to(column, len(self.covariances)) for column in columns], axis=1)

    def brdf(self, geometry: reference.Geometry) -> Array:
        """The fitted f_r [sr^-1] at a geometry of arrays (samples,): (bands, samples)."""
        t0, t1, w, n, k = self.parameters.T[..., None]
        lobe = reference.specular(geometry, w, n, k, simplified=self.form == "simplified")
        return reference.brdf(lobe, t0, t1)

    def summary(self) -> str:
        """The result as text, for the terminal."""
        from tscorr.fit.summary import summary

        return summary(self)


def to_physical(problem: Problem, solution: Solution) -> tuple[Array, Array]:
    """Parameters (bands, 5) t0, t1, w, n, k and the covariance of the fitted ones, from a solution."""
    t0, p, w, n = solution.parameters.T[:4]
    k = np.full_like(t0, problem.k) if problem.k is not None else solution.parameters[:, 4]
    f0, f0_by_n, f0_by_k = normal_incidence(n, k)
    t1 = p / f0
    size = len(problem.free)
    change = np.tile(np.eye(size), (len(t0), 1, 1))  # d(t0, t1, w, n, k) / d(t0, p, w, n, k)
    change[:, 1, 1] = 1 / f0
    change[:, 1, 3] = -t1 * f0_by_n / f0
    if problem.k is None:
        change[:, 1, 4] = -t1 * f0_by_k / f0
    covariance = change @ solution.covariance @ change.transpose(0, 2, 1)
    return np.stack([t0, t1, w, n, k], axis=1), covariance


def correlation(covariance: Array) -> Array:
    """The correlation matrix of a covariance; nan where a variance is."""
    sigma = np.sqrt(np.diag(covariance))
    return covariance / np.outer(sigma, sigma)


def condition(matrix: Array) -> float:
    """Condition number; inf where the matrix holds nan."""
    return float(np.linalg.cond(matrix)) if np.isfinite(matrix).all() else float("inf")


def common_residual(residuals: Array) -> float:
    """Mean correlation of residuals (bands, samples) between wavelengths, at least 0; 0 for one wavelength.

    Over the samples that all wavelengths have.
    """
    complete = residuals[:, np.isfinite(residuals).all(axis=0)]
    bands, samples = complete.shape
    if bands < 2 or samples < 2:
        return 0.0
    return max(0.0, float((np.corrcoef(complete).sum() - bands) / (bands * (bands - 1))))
