"""From measurements to a material: selection, weights, solution, errors, advice."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tscorr.errors import ConfigError, InputError, Limits, check_values
from tscorr.fit.advice import advice, check_forward, check_sampling, check_varies
from tscorr.fit.measurements import Measurements, Selection
from tscorr.fit.noise import Noise
from tscorr.fit.result import Bootstrap, FitResult, common_residual, to_physical
from tscorr.fit.solver import Problem, Solution, solve
from tscorr.materials import Material

Array = NDArray[np.float64]
Form = Literal["full", "simplified"]

PAPER_K = 0.25
"""held in the paper's fits: polarised measurements of its roof tile gave this value"""

SHAREABLE = ("w", "n", "k")
MIN_SAMPLES = 8  # at a wavelength: twice the parameters
REWEIGHTINGS = 30
SETTLED = 0.01  # of 1 sigma: change of the parameters that ends the reweighting
DAMPED = 5  # rounds after which the errors go only halfway, lest two solutions take turns


@dataclass(frozen=True, slots=True)
class FitSettings:
    """How to fit. The defaults are the paper's choices, and one w for all wavelengths."""

    k: float | None = PAPER_K
    """held at this value, as n, t1 and k cannot be told apart by unpolarised measurements; None: fitted"""
    form: Form = "full"
    """of the model: with or without the geometric attenuation factor"""
    shared: tuple[str, ...] = ("w",)
    """parameters with one value for all wavelengths"""
    selection: Selection = field(default_factory=Selection)
    bootstrap: int = 0
    """replicates for `FitResult.bootstrap`; 0: none"""
    seed: int = 0
    """of the bootstrap"""

    def __post_init__(self) -> None:
        limits: Limits = {
            "form": ({"full", "simplified"}.__contains__, "'full' or 'simplified'"),
            "k": (lambda k: k is None or 0 <= k <= 100, "0 to 100, or None to fit it"),
            "bootstrap": (lambda count: count == int(count) >= 0, "a whole number from 0"),
        }
        check_values({name: getattr(self, name) for name in limits}, limits, ConfigError)
        for name in self.shared:
            if name not in SHAREABLE:
                raise ConfigError(f"shared = {name!r}; allowed are {', '.join(SHAREABLE)}")


def fit_brdf(
    incidence_deg: ArrayLike,
    exitance_deg: ArrayLike,
    relative_azimuth_deg: ArrayLike,
    f_r: ArrayLike,
    sigma: ArrayLike | None = None,
    k: float | None = PAPER_K,
    form: Form = "full",
    *,
    wavelength_um: ArrayLike = (),
    shared: tuple[str, ...] = ("w",),
    selection: Selection | None = None,
    bootstrap: int = 0,
    name: str = "fitted",
) -> FitResult:
    """Fit the Torrance-Sparrow model to measured f_r.

    incidence_deg, exitance_deg : from the surface normal, [0, 90), (samples,)
    relative_azimuth_deg        : 0 back-scatter, 180 forward, (samples,)
    f_r                         : sr^-1, (samples,) or (wavelengths, samples); nan where not measured
    sigma                       : 1 sigma of f_r, a number or the shape of f_r; None: assumed, see `Noise`
    k, form, shared, bootstrap  : see `FitSettings`
    wavelength_um               : one for each row of f_r
    selection                   : the samples to use; by default phi >= 90 and zenith angles to 75

    Raises InputError where the data cannot be fitted: phi reversed, too few samples, a lobe narrower than
    the sampling. What is only doubtful is said in `FitResult.warnings`.

    >>> import numpy as np, tscorr
    >>> incidence, exitance = (angle.ravel() for angle in np.meshgrid([20, 40, 60], np.arange(0, 75, 2.5)))
    >>> measured = tscorr.brdf("red_concrete", incidence, exitance, 180)
    >>> result = tscorr.fit_brdf(incidence, exitance, 180 + 0 * exitance, measured)
    >>> round(float(result.material.w[0]), 4)
    0.0804
    """
    measured = Measurements.of(
        incidence_deg,
        exitance_deg,
        relative_azimuth_deg,
        f_r,
        sigma,
        wavelength_um=np.atleast_1d(wavelength_um),
        source=name,
    )
    settings = FitSettings(k=k, form=form, shared=shared, selection=selection or Selection(), bootstrap=bootstrap)
    return fit_measurements(measured, settings, name)


def fit_measurements(measured: Measurements, settings: FitSettings, name: str) -> FitResult:
    """`fit_brdf` of checked measurements; `name` becomes the material's."""
    used = _selected(measured, settings.selection)
    check_varies(used)
    noise = Noise.of(used)
    problem = Problem(
        geometry=used.geometry,
        f_r=used.f_r,
        sigma=noise.at(used.f_r),
        k=settings.k,
        simplified=settings.form == "simplified",
        shared=frozenset(settings.shared),
    )
    check_forward(measured, problem)
    problem, solution = _reweighted(problem, solve(problem), noise)
    result = _result(used, problem, solution, noise, settings, name, len(measured.zenith_deg))
    left_out = settings.selection.left_out_mirror(measured)
    check_sampling(result, left_out)
    if settings.bootstrap:
        result = replace(result, bootstrap=_bootstrap(result, problem, solution, noise, settings))
    return replace(result, warnings=tuple(advice(result, left_out, solution, noise)))


def _selected(measured: Measurements, selection: Selection) -> Measurements:
    used = selection.used(measured)
    fewest = int(np.isfinite(used.f_r).sum(axis=1).min())
    if fewest < MIN_SAMPLES:
        raise InputError(
            f"{measured.source}: {fewest} of {len(measured.zenith_deg)} samples remain with "
            f"{selection}; at least {MIN_SAMPLES} a wavelength are needed. phi = 180 is forward "
            f"scattering: is it so in the file?"
        )
    return used


def _reweighted(problem: Problem, solution: Solution, noise: Noise) -> tuple[Problem, Solution]:
    """The solution whose own model sets the weights; unchanged where sigma is fixed."""
    if noise.fixed is not None:
        return problem, solution
    for reweighting in range(REWEIGHTINGS):
        sigma = noise.at(solution.f_r)
        problem = replace(problem, sigma=sigma if reweighting < DAMPED else np.sqrt(sigma * problem.sigma))
        following = replace(solve(problem, [solution.parameters]), other_chi2=solution.other_chi2)
        change = np.abs(following.parameters - solution.parameters)
        solution = following
        if np.all(change <= SETTLED * np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))):
            return problem, solution
    return problem, replace(solution, converged=False)


def _scaled(formal: Array, problem: Problem, solution: Solution, noise: Noise) -> tuple[Array, float]:
    """Covariances (bands, p, p) enlarged to the scatter, and the factor chi2/df that did it.

    The scatter never makes a given sigma smaller. Where residuals of different wavelengths agree, with
    correlation r, B wavelengths measure a shared parameter no better than B / (1 + (B - 1) r) would.
    """
    chi2_dof = float(solution.chi2.sum()) / _degrees_of_freedom(problem)
    scale = chi2_dof if noise.assumed else max(1.0, chi2_dof)
    common = common_residual((problem.f_r - solution.f_r) / problem.sigma)
    enlarged = np.sqrt(1 + (len(problem.f_r) - 1) * common)
    stretch = np.array([enlarged if name in problem.shared else 1.0 for name in problem.free])
    return scale * formal * np.outer(stretch, stretch), scale


def _degrees_of_freedom(problem: Problem) -> int:
    return int(np.isfinite(problem.f_r).sum()) - int(problem.index.max()) - 1


def _result(
    used: Measurements,
    problem: Problem,
    solution: Solution,
    noise: Noise,
    settings: FitSettings,
    name: str,
    given: int,
) -> FitResult:
    parameters, formal = to_physical(problem, solution)
    covariances, scale = _scaled(formal, problem, solution, noise)
    degrees_of_freedom = _degrees_of_freedom(problem)
    chi2_dof = float(solution.chi2.sum()) / degrees_of_freedom
    return FitResult(
        material=_material(used, parameters, covariances, chi2_dof, settings, name),
        covariances=covariances,
        formal_covariances=formal,
        chi2_dof=chi2_dof,
        degrees_of_freedom=degrees_of_freedom,
        t1_f0=solution.parameters[:, 1],
        t1_f0_sigma=np.sqrt(scale * solution.covariance[:, 1, 1]),
        given=given,
        measured=used,
        model_f_r=solution.f_r,
        sigma=problem.sigma,
        converged=solution.converged,
        form=settings.form,
    )


def _material(
    used: Measurements,
    parameters: Array,
    covariances: Array,
    chi2_dof: float,
    settings: FitSettings,
    name: str,
) -> Material:
    """The material, with the covariance of t0, t1, w, n at the middle wavelength."""
    t0, t1, w, n, k = parameters.T
    covariance = covariances[len(covariances) // 2, :4, :4]
    return Material(
        name=name,
        t0=_values(t0),
        t1=_values(t1),
        w=_values(w, one="w" in settings.shared),
        n=_values(n, one="n" in settings.shared),
        k=_values(k, one=settings.k is not None or "k" in settings.shared),
        wavelength_um=used.wavelength_um,
        source=f"tscorr fit of {used.source}: {settings.form} model, {settings.selection}",
        covariance=tuple(map(tuple, covariance.tolist())) if np.isfinite(covariance).all() else (),
        chi2_dof=chi2_dof,
        zenith_range_deg=(0.0, float(np.ceil(used.zenith_deg.max()))),
    )


def _values(column: Array, *, one: bool = False) -> tuple[float, ...]:
    return tuple(column[:1].tolist() if one else column.tolist())


def _bootstrap(
    result: FitResult, problem: Problem, solution: Solution, noise: Noise, settings: FitSettings
) -> Bootstrap:
    """Refit the model plus its own residuals, drawn anew by geometry so that wavelengths stay together."""
    rng = np.random.default_rng(settings.seed)
    truth = to_physical(problem, solution)[0][:, : len(problem.free)]
    size = result.residuals.size / result.degrees_of_freedom
    residuals = result.residuals * np.sqrt(size)
    found, sigma = [], []
    for _ in range(settings.bootstrap):
        drawn = residuals[:, rng.integers(residuals.shape[1], size=residuals.shape[1])]
        replicate = replace(problem, f_r=solution.f_r + problem.sigma * drawn)
        again = solve(replicate, [solution.parameters])
        parameters, formal = to_physical(replicate, again)
        covariances, _ = _scaled(formal, replicate, again, noise)
        found.append(parameters[:, : len(problem.free)])
        sigma.append(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))
    error, stated = np.array(found) - truth, np.array(sigma)
    return Bootstrap(
        replicates=settings.bootstrap,
        coverage=np.mean(np.abs(error) < stated, axis=0),
        bias=np.mean(error / stated, axis=0),
        sigma=np.std(error, axis=0),
    )
