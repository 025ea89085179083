"""What a fit cannot do, refused; what is doubtful, said together with what to do about it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import InputError
from tscorr.fit.measurements import Measurements
from tscorr.fit.noise import Noise
from tscorr.fit.result import FitResult, common_residual
from tscorr.fit.solver import BOUNDS, Problem, Solution, lobe_grid

Array = NDArray[np.float64]

ROUNDING = 1e-9  # relative, of measurements that are all the same
FLAT = 10.0  # F value of a lobe against a constant, below which it may be scatter
REVERSED = 0.5  # chi2 of the reversed phi over that of the given phi, below which phi is reversed
IN_LOBE = 2.0  # of w alpha: exp(-4) = 2 % of the peak
FEWEST_IN_LOBE = 8  # twice the parameters
FEW_IN_LOBE = 16
NEAR_PEAK = 0.5  # of w alpha: 78 % of the peak
MIRROR_REFUSED = 10.0  # times the model
MIRROR_DOUBTFUL = 2.0
SEPARABLE = 1000.0  # condition number of the correlations: 50 to 130 on the paper's grids with k held
SIGNIFICANT = 3.0  # sigma
POOR_FIT = 2.0  # chi2/df
TREND = 0.1  # of t0 over the zenith angles
DIFFUSE_SHARE = 0.05  # specular share of f_r below which a residual is the diffuse part's
FEWEST_DIFFUSE = 10  # samples for a trend
STEEP_DEG = 65.0  # the rise of F beyond it separates n from t1
ALIKE = 9.0  # difference of chi2, in units of chi2/df, within which two minima are equally good
COMMON = 0.3  # correlation of residuals between wavelengths


def check_varies(used: Measurements) -> None:
    """Refuse measurements that are of nothing, or the same in every direction."""
    highest, lowest = np.nanmax(used.f_r, axis=1), np.nanmin(used.f_r, axis=1)
    dark = np.flatnonzero(highest <= 0)
    if dark.size:
        raise InputError(
            f"{used.source}: {_at(used, dark)}f_r is nowhere above 0; allowed are numbers in 1/sr above 0"
        )
    if np.all(highest - lowest <= ROUNDING * highest):
        raise InputError(
            f"{used.source}: f_r is {highest[0]:.4g} in every direction, so that there is no peak to fit; a material "
            f"with this as its t0, and t1 = 0, says so"
        )


def check_forward(measured: Measurements, problem: Problem) -> None:
    """Refuse measurements whose peak lies at phi = 0: their azimuths are 180 degrees off.

    The best lobe of a grid of shapes is fitted to all samples, once with phi as given and once with
    180 - phi; the second must not be the better by far.
    """
    chi2 = []
    sigma = Noise.of(measured).at(measured.f_r)
    for phi in (measured.relative_azimuth_deg, 180 - measured.relative_azimuth_deg):
        geometry = replace(measured, relative_azimuth_deg=phi).geometry
        shapes = lobe_grid(replace(problem, geometry=geometry, f_r=measured.f_r, sigma=sigma))[2]
        chi2.append(float(shapes.min(axis=(1, 2)).sum()))
    if chi2[1] < REVERSED * chi2[0]:
        raise InputError(
            f"{measured.source}: the peak lies at phi = 0 (chi2 {chi2[0]:.3g} with phi as given, "
            f"{chi2[1]:.3g} with 180 - phi); allowed is phi = 180 in forward scattering. Was an azimuth "
            f"taken from the sensor to the surface? Then add 180 to phi. A surface that shines back to "
            f"the source is no case for this model"
        )


def check_sampling(result: FitResult, left_out_mirror: Measurements) -> None:
    """Refuse a lobe that fits between the samples: its w and t1 would be guesses."""
    inside, within = _in_lobe(result)
    ratio = _mirror_ratio(result, left_out_mirror)
    if inside >= FEWEST_IN_LOBE and ratio <= MIRROR_REFUSED:
        return
    if _lobe_against_constant(result) < FLAT:
        raise InputError(
            f"{result.measured.source}: no peak stands out of the scatter of f_r: no direction near phi = 180, "
            f"theta_r = theta_i is brighter than others by more. Measure there in finer steps, or more exactly; a "
            f"surface without a peak is a material of t1 = 0"
        )
    finding = (
        f"{inside} samples lie within {within:.2g} degrees of facet tilt, where the fitted lobe is"
        if inside < FEWEST_IN_LOBE
        else f"the samples left out for looking into the mirror direction are {ratio:.3g} times the fit"
    )
    raise InputError(
        f"{result.measured.source}: the lobe is narrower than the sampling: {finding}. Measure in finer "
        f"steps about theta_r = theta_i, phi = 180; a surface so glossy may be no case for a model of broad "
        f"peaks"
    )


def advice(result: FitResult, left_out_mirror: Measurements, solution: Solution, noise: Noise) -> Iterator[str]:
    """Warnings, each with its remedy."""
    if noise.remark:
        yield noise.remark
    if not result.converged:
        yield "the fit did not converge: do not use it; look at the residual plots for wrong samples"
    yield from _of_the_lobe(result, left_out_mirror)
    yield from _of_the_parameters(result, solution)
    yield from _of_the_residuals(result, noise)


def _of_the_lobe(result: FitResult, left_out_mirror: Measurements) -> Iterator[str]:
    used, w = result.measured, float(np.median(result.parameters[:, 2]))
    tilt = used.facet_tilt_deg
    weak = np.flatnonzero(result.t1_f0 < SIGNIFICANT * result.t1_f0_sigma)
    if weak.size:
        yield (
            f"{_at(result.measured, weak)}no peak stands out (t1 F0 = {result.t1_f0[weak[0]]:.2g} +- "
            f"{result.t1_f0_sigma[weak[0]]:.2g}): set t1 = 0, the surface is diffuse"
        )
    inside, within = _in_lobe(result)
    if inside < FEW_IN_LOBE:
        yield (
            f"the lobe is hardly wider than the sampling: {inside} samples within {within:.2g} degrees of "
            f"facet tilt; measure in finer steps about theta_r = theta_i, phi = 180"
        )
    if tilt.min() > NEAR_PEAK / w:
        yield (
            f"no sample near the peak: the smallest facet tilt is {tilt.min():.2g} degrees, the half-width "
            f"of the lobe {np.sqrt(np.log(2)) / w:.2g}; measure at theta_r = theta_i, phi = 180"
        )
    if not np.any((w * tilt < 1) & (used.zenith_deg >= STEEP_DEG)):
        yield (
            f"no sample in the peak beyond {STEEP_DEG:g} degrees of zenith, where the rise of the Fresnel "
            f"reflectance tells n from t1: rely on t1 F0 only, or measure at 65 to 75 degrees"
        )
    ratio = _mirror_ratio(result, left_out_mirror)
    if ratio > MIRROR_DOUBTFUL:
        yield (
            f"the samples left out for looking into the mirror direction are {ratio:.2g} times the fit: a "
            f"narrow core stands on the lobe, which this model does not have; pixels that look into it stay "
            f"too bright"
        )


def _of_the_parameters(result: FitResult, solution: Solution) -> Iterator[str]:
    if result.condition > SEPARABLE:
        yield (
            f"n, t1 and k are not separable here (condition number {result.condition:.2g}): only t1 F0, "
            f"w and t0 mean something; hold k (0.25 in the paper), and share n between wavelengths"
        )
    for name, column in zip(("w", "n"), result.parameters.T[2:4], strict=True):
        low, high = BOUNDS[name]
        stuck = np.flatnonzero((column < low * 1.01) | (column > high * 0.99))
        if stuck.size:
            yield (
                f"{_at(result.measured, stuck)}{name} = {column[stuck[0]]:.3g} is at the end of its range, {low:g} "
                f"to {high:g}: the data do not determine it; share it, or widen the range of zenith angles"
            )
    best = float(solution.chi2.sum())
    if solution.other_chi2 - best < ALIKE * max(1.0, result.chi2_dof):
        yield (
            f"another set of parameters fits as well (chi2 {solution.other_chi2:.4g} against {best:.4g}): "
            f"add samples about the peak"
        )


def _of_the_residuals(result: FitResult, noise: Noise) -> Iterator[str]:
    if result.chi2_dof > POOR_FIT:
        size = "the assumed errors" if noise.assumed else "sigma"
        yield (
            f"chi2/df = {result.chi2_dof:.3g}: residuals are {np.sqrt(result.chi2_dof):.2g} times {size}; "
            f"the model describes the shape of the peak to that, and the covariance is scaled by it"
        )
    change, significance = _diffuse_trend(result)
    bent = np.flatnonzero((np.abs(change) > TREND) & (significance > SIGNIFICANT))
    if bent.size:
        typical = float(np.median(change[bent]))
        yield (
            f"{_at(result.measured, bent)}the diffuse part is not Lambertian: it changes by {typical:+.0%} of t0 "
            f"from low to high zenith angles; fit a smaller range of zenith angles (max_zenith_deg), and use "
            f"the material for that range only"
        )
    common = common_residual(result.residuals)
    if common > COMMON:
        yield (
            f"residuals of different wavelengths agree (correlation {common:.2f}), so that "
            f"{len(result.sigma)} wavelengths are not as many measurements: the errors of "
            f"shared parameters are enlarged for it"
        )


def _in_lobe(result: FitResult) -> tuple[int, float]:
    """How many samples lie in the lobe, and the facet tilt [deg] that bounds it."""
    within = IN_LOBE / float(np.median(result.parameters[:, 2]))
    return int(np.sum(result.measured.facet_tilt_deg < within)), within


def _lobe_against_constant(result: FitResult) -> float:
    """F value: what the lobes take off chi2 for each of their parameters, against what is left a degree of freedom."""
    f_r, weight = result.measured.f_r, result.sigma**-2
    weight = np.where(np.isfinite(f_r), weight, 0)
    values = np.where(np.isfinite(f_r), f_r, 0)
    mean = (weight * values).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
    constant = float((weight * (values - mean) ** 2).sum())
    left = result.chi2_dof * result.degrees_of_freedom
    parameters = weight[weight > 0].size - len(f_r) - result.degrees_of_freedom
    return (constant - left) / parameters / max(result.chi2_dof, np.finfo(float).tiny)


def _mirror_ratio(result: FitResult, left_out_mirror: Measurements) -> float:
    """Median of measured over modelled f_r of the samples left out; 1 where there are none."""
    ratio = left_out_mirror.f_r / result.brdf(left_out_mirror.geometry)
    return float(np.median(ratio[np.isfinite(ratio)])) if np.isfinite(ratio).any() else 1.0


def _diffuse_trend(result: FitResult) -> tuple[Array, Array]:
    """Change of the diffuse part over the zenith angles, relative to t0, and its significance in sigma.

    Arrays (bands,). A straight line against the mean of incidence and exitance, through the
    residuals of the samples out of the lobe.
    """
    zenith = (result.measured.incidence_deg + result.measured.exitance_deg) / 2
    change, significance = np.zeros(len(result.sigma)), np.zeros(len(result.sigma))
    for band, t0 in enumerate(result.parameters[:, 0]):
        measured, model = result.measured.f_r[band], result.model_f_r[band]
        diffuse = np.isfinite(measured) & (model - t0 < DIFFUSE_SHARE * model)
        if diffuse.sum() < FEWEST_DIFFUSE or np.ptp(zenith[diffuse]) == 0:
            continue
        x = (zenith[diffuse] - zenith[diffuse].min()) / np.ptp(zenith[diffuse])
        y, sigma = (measured - model)[diffuse] / t0, result.sigma[band, diffuse] / t0
        weight = sigma**-2
        x -= np.average(x, weights=weight)
        spread = np.sum(weight * x**2)
        change[band] = np.sum(weight * x * y) / spread
        scatter = np.average((y - np.average(y, weights=weight) - change[band] * x) ** 2, weights=weight)
        significance[band] = abs(change[band]) * np.sqrt(spread / max(1.0, scatter * np.mean(weight)))
    return change, significance


def _at(measured: Measurements, bands: NDArray[np.intp]) -> str:
    """`at 0.55 um: ` or `at 3 of 31 wavelengths: `, nothing where there is one."""
    wavelengths = measured.wavelength_um
    if len(wavelengths) < 2 or len(bands) == len(wavelengths):
        return ""
    if len(bands) == 1:
        return f"at {wavelengths[bands[0]]:g} um: "
    return f"at {len(bands)} of {len(wavelengths)} wavelengths: "
