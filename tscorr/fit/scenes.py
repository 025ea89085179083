"""Fit a material to what images show of it.

With beta c the sunlight on a facet and D = beta c + (1 - beta) V all light on it, both as parts of the irradiance
that R refers to (V: the part of the sky that it sees), the model of a pixel is

    R_b = q pi t0_b D_b + pi beta_b c t1 f_spec(w, n, k)

for each band b. The lobe is the same in all bands. q is the pixel's own diffuse brightness: roofs of one material
differ, and q is near 1 with a scatter of `BRIGHTNESS`. It is not fitted but marginalised: the errors of the bands
of a pixel are

    C = diag(sigma_b^2) + BRIGHTNESS^2 d d^T,      d_b = pi t0_b D_b

so that a pixel brighter by one factor in all bands says little, while light that is added in the proportions of
beta c, as glare is, says much. Pixels of a wrong class, shadow or normal are held down by Cauchy weights, one a
pixel. Errors of parameters are from the scatter between roofs (sandwich estimate), not between pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.errors import ConfigError, InputError, Limits, check_values
from tscorr.fit.images import ImageSamples
from tscorr.fit.scene_result import SceneFit
from tscorr.fit.solver import BOUNDS, INSIDE, SEARCH_N, SEARCH_W, normal_incidence

Array = NDArray[np.float64]

BRIGHTNESS = 0.15
"""1 sigma of the diffuse brightness of pixels of one material about its mean"""
NOISE_FLOOR, NOISE_SHARE = 0.0005, 0.003
"""error of R up to a common factor, which the scatter decides: floor + share R"""
OUTLIER = 1.0
"""typical residuals from which on a pixel loses weight"""

MIN_SAMPLES = 100
SEARCH_SAMPLES = 1000
SEARCH_PASSES = 4
ROUNDS = 40
SETTLED = 0.05  # of the formal 1 sigma: change of every parameter that ends the reweighting
STEPS = 4  # of the solver within one round


@dataclass(frozen=True, slots=True)
class SceneFitSettings:
    """How materials are fitted to scenes."""

    k: float = 0.25
    """held at this value: unpolarised light does not tell n, t1 and k apart"""
    form: Literal["full", "simplified"] = "full"
    seed: int = 0
    """of the choice of samples"""

    def __post_init__(self) -> None:
        limits: Limits = {
            "form": ({"full", "simplified"}.__contains__, "'full' or 'simplified'"),
            "k": (lambda k: 0 <= k <= 100, "0 to 100"),
        }
        check_values({name: getattr(self, name) for name in limits}, limits, ConfigError)


def fit_samples(samples: ImageSamples, settings: SceneFitSettings | None = None) -> SceneFit:
    """The material that explains the samples best: t0 a band; t1, w and n for all bands.

    Nothing is taken from a library: the start is the best node of a grid over w and n.
    Raises InputError where there are fewer than 100 samples.
    """
    settings = settings or SceneFitSettings()
    if len(samples) < MIN_SAMPLES:
        raise InputError(
            f"{samples.source}: {len(samples)} samples of {samples.name}; at least {MIN_SAMPLES} are needed"
        )
    x, errors, converged = _solved(samples, settings, _search(samples, settings))
    model, jacobian = _model(x, samples, settings)
    rows = errors.whitened(np.concatenate([jacobian, (samples.reflectance_factor - model)[..., None]], axis=-1))
    jacobian, residual = rows[..., :-1], rows[..., -1]
    return SceneFit.of(
        samples=samples,
        x=x,
        covariance=_sandwich(jacobian, residual, samples.roof),
        k=settings.k,
        form=settings.form,
        residual=errors.distance(samples.reflectance_factor - model),
        scatter=errors.scale,
        converged=converged,
    )


def _model(x: Array, samples: ImageSamples, settings: SceneFitSettings) -> tuple[Array, Array]:
    """R (bands, samples) of the parameters t0 of each band, p = t1 F0, w, n, and its partials (.., parameters)."""
    bands = len(samples.reflectance_factor)
    t0, (p, w, n) = x[:bands], (np.asarray(value) for value in x[bands:])
    f0, f0_by_n, _ = normal_incidence(n, np.asarray(settings.k))
    t1 = p / f0
    simplified = settings.form == "simplified"
    by = reference.brdf_gradient(samples.geometry, t1, w, n, np.asarray(settings.k), simplified=simplified)
    glare, light = np.pi * samples.direct, np.pi * samples.diffuse
    partials = np.zeros((*glare.shape, len(x)))
    partials[range(bands), :, range(bands)] = light
    partials[..., bands] = glare * by.t1 / f0
    partials[..., bands + 1] = glare * by.w
    partials[..., bands + 2] = glare * (by.n - t1 * by.t1 * f0_by_n / f0)  # at fixed p
    return light * t0[:, None] + glare * t1 * by.t1, partials


@dataclass(frozen=True, slots=True)
class _Errors:
    """The errors of samples about a model, with their weights."""

    sigma: Array
    """(bands, samples), up to `scale`"""
    common: Array
    """(bands, samples): the pattern d of a pixel that is brighter as a whole, in sigma"""
    weight: Array
    """(samples,)"""
    scale: float = 1.0
    """typical residual in sigma"""

    @classmethod
    def about(cls, samples: ImageSamples, model: Array, t0: Array) -> "_Errors":
        """Errors about a model (bands, samples) whose diffuse part is of t0 (bands,), all weights equal."""
        sigma = NOISE_FLOOR + NOISE_SHARE * np.maximum(model, 0)
        return cls(sigma, common=np.pi * t0[:, None] * samples.diffuse / sigma, weight=np.ones(len(samples)))

    def weighted(self, residual: Array) -> "_Errors":
        """The same with scale and weights that residuals (bands, samples) call for."""
        square = np.sum(self._independent(residual) ** 2, axis=0) / len(residual)
        scale = max(float(np.median(square)), np.finfo(float).tiny)
        return replace(self, weight=1 / (1 + square / (scale * OUTLIER**2)), scale=float(np.sqrt(scale)))

    def whitened(self, values: Array) -> Array:
        """Values (bands, samples, ...) turned and scaled so that errors are independent and of weight 1."""
        factor = np.sqrt(self.weight) / self.scale
        return self._independent(values) * (factor[:, None] if values.ndim == 3 else factor)

    def distance(self, residual: Array) -> Array:
        """Root mean square over the bands of each sample's residual, in units of `scale`: (samples,)."""
        return np.sqrt(np.mean(self._independent(residual) ** 2, axis=0)) / self.scale

    def _independent(self, values: Array) -> Array:
        """C^(-1/2) values = (1 - g d d^T) diag(1/sigma) values, g = b^2 / (r (r + 1)), r^2 = 1 + b^2 |d|^2."""
        root = np.sqrt(1 + BRIGHTNESS**2 * np.sum(self.common**2, axis=0))
        factor = BRIGHTNESS**2 / (root * (root + 1))
        if values.ndim == 2:
            scaled = values / self.sigma
            return scaled - self.common * (factor * np.sum(self.common * scaled, axis=0))
        scaled = values / self.sigma[..., None]
        along = np.einsum("bs,bsp->sp", self.common, scaled) * factor[:, None]
        return scaled - self.common[..., None] * along


def _solved(samples: ImageSamples, settings: SceneFitSettings, x: Array) -> tuple[Array, _Errors, bool]:
    """The parameters that the reweighting settles on, the errors there, and whether it settled."""
    bands = len(samples.reflectance_factor)
    for _ in range(ROUNDS):
        model = _model(x, samples, settings)[0]
        errors = _Errors.about(samples, model, x[:bands]).weighted(samples.reflectance_factor - model)
        following, sigma = _least_squares(samples, settings, errors, x)
        settled = bool(np.all(np.abs(following - x) <= SETTLED * sigma))
        x = following
        if settled:
            break
    return x, errors, settled


def _least_squares(
    samples: ImageSamples, settings: SceneFitSettings, errors: _Errors, start: Array
) -> tuple[Array, Array]:
    """A few steps towards the least squares of fixed weights, and 1 sigma there, formal and without bounds.

    The solver knows residual and Jacobian by their products only, so it is given the small triangle of their
    QR decomposition.
    """
    from scipy.optimize import least_squares

    bands = len(samples.reflectance_factor)
    lower, upper = np.array([*[BOUNDS["t0"]] * bands, BOUNDS["t1_f0"], BOUNDS["w"], BOUNDS["n"]]).T
    known: dict[bytes, Array] = {}

    def triangle(x: Array) -> Array:
        if x.tobytes() not in known:
            model, partials = _model(x, samples, settings)
            rows = np.concatenate([partials, (model - samples.reflectance_factor)[..., None]], axis=-1)
            known.clear()
            known[x.tobytes()] = np.asarray(np.linalg.qr(errors.whitened(rows).reshape(-1, len(x) + 1), mode="r"))
        return known[x.tobytes()]

    found: Any = least_squares(
        lambda x: triangle(x)[:, -1],
        np.clip(start, lower + INSIDE, upper - INSIDE),
        lambda x: triangle(x)[:, :-1],
        bounds=(lower, upper),
        x_scale="jac",
        max_nfev=STEPS,
    )
    length = np.linalg.norm(found.jac, axis=0)
    unit = found.jac / np.where(length > 0, length, 1)
    variance = np.diag(np.linalg.pinv(unit.T @ unit)) / np.where(length > 0, length, 1) ** 2
    return found.x, np.where(length > 0, np.sqrt(variance), np.inf)


def _search(samples: ImageSamples, settings: SceneFitSettings) -> Array:
    """The best node of a grid over w and n; t0 and p are solved for, robustly, at each.

    The score is the sum of the Cauchy losses of some of the samples, with the least scale of all nodes.
    """
    places = np.random.default_rng(settings.seed).permutation(len(samples))[:SEARCH_SAMPLES]
    few = samples.at(places)
    away = few.reflectance_factor / (np.pi * few.diffuse)
    errors = _Errors.about(few, few.reflectance_factor, np.quantile(away, 0.3, axis=1))
    nodes = list(_nodes(few, settings, errors))
    scale = min(float(np.median(square)) for _, square in nodes)
    score = [float(np.sum(np.log1p(square / scale))) for _, square in nodes]
    return nodes[int(np.argmin(score))][0]


def _nodes(samples: ImageSamples, settings: SceneFitSettings, errors: _Errors) -> Iterator[tuple[Array, Array]]:
    """Parameters and squared residuals (samples,) at each node of the grid."""
    bands, count = samples.reflectance_factor.shape
    geometry, k = samples.geometry, np.asarray(settings.k)
    design = np.zeros((bands, count, bands + 2))
    design[range(bands), :, range(bands)] = np.pi * samples.diffuse
    design[..., -1] = samples.reflectance_factor
    for w in SEARCH_W[::2]:
        for n in SEARCH_N:
            lobe = reference.specular(geometry, w, n, k, simplified=settings.form == "simplified")
            design[..., bands] = np.pi * samples.direct * lobe / normal_incidence(n, k)[0]
            rows = errors.whitened(design)
            linear, square = _robust_linear(rows[..., :-1], rows[..., -1])
            yield np.array([*np.maximum(linear, INSIDE), w, n]), square


def _robust_linear(columns: Array, values: Array) -> tuple[Array, Array]:
    """Coefficients of columns (bands, samples, p), by a few passes of Cauchy weights; residuals squared."""
    weight: NDArray[Any] = np.ones(values.shape[1])
    for _ in range(SEARCH_PASSES):
        flat = (columns * weight[:, None]).reshape(-1, columns.shape[-1])
        coefficients: Array = np.linalg.lstsq(
            flat.T @ columns.reshape(flat.shape), flat.T @ values.ravel(), rcond=None
        )[0]
        square = np.mean((values - columns @ coefficients) ** 2, axis=0)
        weight = 1 / (1 + square / max(float(np.median(square)), np.finfo(float).tiny))
    return coefficients, square


def _sandwich(jacobian: Array, residual: Array, roof: Array) -> Array:
    """Covariance of the parameters from the scatter between roofs; nan where it is singular.

    A^-1 (sum over roofs of g g^T) A^-1 with A = J^T J and g = J^T r of one roof (Huber 1967, White 1980; for
    groups Liang & Zeger 1986), times roofs / (roofs - 1).
    """
    _, number = np.unique(roof, return_inverse=True)
    count = int(number.max()) + 1
    pulls = np.einsum("bsp,bs->sp", jacobian, residual)
    by_roof = np.zeros((count, pulls.shape[1]))
    np.add.at(by_roof, number, pulls)
    normal = np.einsum("bsp,bsq->pq", jacobian, jacobian, optimize=True)
    scale = np.sqrt(np.diag(normal))
    with np.errstate(divide="ignore", invalid="ignore"):
        normal, by_roof = normal / np.outer(scale, scale), by_roof / scale
    if not np.isfinite(normal).all() or np.linalg.matrix_rank(normal) < len(scale):
        return np.full(normal.shape, np.nan)
    half = by_roof @ np.linalg.inv(normal) / scale
    return half.T @ half * count / max(1, count - 1)
