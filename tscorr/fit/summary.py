"""A fit as text for the terminal."""

import numpy as np

from tscorr.fit.result import FitResult


def summary(result: FitResult) -> str:
    """Parameters with 1 sigma, correlations, chi2/df, bootstrap and warnings of a fit."""
    material = result.material
    held = "k" not in result.names
    bands, samples = result.measured.f_r.shape
    fit = (
        f"  {samples} of {result.given} samples, {bands} wavelength(s), chi2/df = {result.chi2_dof:.3g} with "
        f"df = {result.degrees_of_freedom}; 1 sigma is {_scaling(result):.3g} times the formal one"
    )
    lines = [f"{material.name}: {material.source}", fit]
    if held:
        lines.append(f"  k is held at {material.k[0]:g}: measurements tell t1 F0 and w, but not n, t1 and k apart")
    lines += ["", *_parameters(result), "", *_correlations(result)]
    if result.bootstrap is not None:
        lines += ["", *_bootstrap(result)]
    if result.warnings:
        lines += ["", *(f"  ! {warning}" for warning in result.warnings)]
    return "\n".join(lines)


def _scaling(result: FitResult) -> float:
    return float(np.sqrt(result.covariances[0, 0, 0] / result.formal_covariances[0, 0, 0]))


def _parameters(result: FitResult) -> list[str]:
    names = (*result.names, "t1 F0")
    sigma = np.sqrt(np.diagonal(result.covariances, axis1=1, axis2=2))
    values = np.column_stack([result.parameters[:, : len(result.names)], result.t1_f0])
    errors = np.column_stack([sigma, result.t1_f0_sigma])
    head = "  " + "um".ljust(8) + "".join(f"{name:<22}" for name in names)
    wavelengths = result.measured.wavelength_um or (float("nan"),)
    rows = [
        f"  {_wavelength(wavelength):<8}"
        + "".join(f"{f'{v:.4g} +- {e:.2g}':<22}" for v, e in zip(value, error, strict=True))
        for wavelength, value, error in zip(wavelengths, values, errors, strict=True)
    ]
    return [line.rstrip() for line in (head, *rows)]


def _wavelength(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.4g}"


def _correlations(result: FitResult) -> list[str]:
    names = result.names
    pairs = [
        f"{names[i]}-{names[j]} {result.correlation[i, j]:+.2f}"
        for i in range(len(names))
        for j in range(i + 1, len(names))
    ]
    return [f"  correlations: {', '.join(pairs)}; condition number {result.condition:.3g}"]


def _bootstrap(result: FitResult) -> list[str]:
    boot, middle = result.bootstrap, result.middle
    assert boot is not None
    cells = [
        f"{name} {coverage:.0%} ({sigma:.2g})"
        for name, coverage, sigma in zip(result.names, boot.coverage[middle], boot.sigma[middle], strict=True)
    ]
    head = f"  bootstrap, {boot.replicates} replicates: share within 1 sigma (68 % is right), and their scatter:"
    return [f"{head} {', '.join(cells)}"]
