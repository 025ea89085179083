"""Plots of a fit: measured and fitted curves as in the paper's figures 2 and 3, and the residuals.

Drawn with matplotlib's objects, without pyplot and its global state. Several wavelengths: the middle one.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.errors import OutputError
from tscorr.fit.result import FitResult

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FORWARD_DEG = 177.0  # phi from which a sample counts as in the forward plane
CURVES = 6
LOGARITHMIC = 20.0  # ratio of values beyond which their axis is logarithmic
EXITANCE_DEG = np.linspace(0, 85, 341)
AZIMUTH_DEG = np.linspace(0, 180, 361)


def save_plots(result: FitResult, directory: str | Path) -> list[Path]:
    """Write `<name>_zenith.png`, `<name>_azimuth.png` and `<name>_residuals.png`; returns the files."""
    directory = Path(directory)
    drawings = {"zenith": zenith_figure, "azimuth": azimuth_figure, "residuals": residual_figure}
    files = [directory / f"{result.material.name}_{kind}.png" for kind in drawings]
    for file, draw in zip(files, drawings.values(), strict=True):
        try:
            directory.mkdir(parents=True, exist_ok=True)
            draw(result).savefig(file, dpi=110)
        except OSError as error:
            raise OutputError(f"the plot {file} cannot be written: {error}") from None
    return files


def zenith_figure(result: FitResult) -> Any:
    """f_r against theta_r in the forward plane, a curve an angle of incidence: the paper's figure 2."""
    used = result.measured
    forward = used.relative_azimuth_deg >= FORWARD_DEG
    figure, (axes,) = _figure(result, 1)
    for number, (theta_i,) in enumerate(_groups(used.incidence_deg[None], forward)):
        colour = f"C{number}"
        here = forward & np.isclose(used.incidence_deg, theta_i, atol=0.05)
        _crosses(axes, result, used.exitance_deg, here, colour)
        axes.plot(EXITANCE_DEG, _curve(result, theta_i, EXITANCE_DEG, 180), colour, label=f"θᵢ = {theta_i:.3g}°")
    axes.set(xlabel="θᵣ [°] at φ = 180°", ylabel="f_r [1/sr]")
    _fit_height(axes, result, forward)
    _legend(axes)
    return figure


def azimuth_figure(result: FitResult) -> Any:
    """f_r against phi for pairs of zenith angles, and the peaks alone set to 1: the paper's figure 3."""
    used, t0 = result.measured, result.parameters[result.middle, 0]
    pairs = np.stack([used.incidence_deg, used.exitance_deg])
    figure, (axes, peaks) = _figure(result, 2)
    shown = np.zeros(used.zenith_deg.shape, dtype=bool)
    for number, (theta_i, theta_r) in enumerate(_groups(pairs, _sweeps(pairs))):
        colour = f"C{number}"
        here = np.isclose(pairs, np.array([[theta_i], [theta_r]]), atol=0.05).all(axis=0)
        shown |= here
        curve = _curve(result, theta_i, theta_r, AZIMUTH_DEG)
        height = max(curve[-1] - t0, np.finfo(float).tiny)
        _crosses(axes, result, used.relative_azimuth_deg, here, colour)
        _crosses(peaks, result, used.relative_azimuth_deg, here, colour, zero=t0, unit=height)
        axes.plot(AZIMUTH_DEG, curve, colour, label=f"θᵢ = {theta_i:.3g}°, θᵣ = {theta_r:.3g}°")
        peaks.plot(AZIMUTH_DEG, (curve - t0) / height, colour)
    low = float(used.relative_azimuth_deg[shown].min(initial=90))
    axes.set(xlabel="φ [°]", ylabel="f_r [1/sr]", xlim=(low, 181))
    _fit_height(axes, result, shown)
    peaks.set(xlabel="φ [°]", ylabel="(f_r - t0) / its value at φ = 180°", xlim=(low, 181), ylim=(-0.1, 1.4))
    _legend(axes)
    return figure


def residual_figure(result: FitResult) -> Any:
    """(measured - fitted) / sigma against theta_r, phi and facet tilt; colours are angles of incidence."""
    used = result.measured
    residuals = result.residuals[result.middle]
    figure, panels = _figure(result, 3)
    against = {
        "θᵣ [°]": used.exitance_deg,
        "φ [°]": used.relative_azimuth_deg,
        "facet tilt α [°]": used.facet_tilt_deg,
    }
    for axes, (label, x) in zip(panels, against.items(), strict=True):
        points = axes.scatter(x, residuals, c=used.incidence_deg, s=8, cmap="viridis")
        axes.axhline(0, color="0.5", linewidth=0.8)
        axes.set(xlabel=label)
    panels[0].set(ylabel="(measured - fitted) / σ")
    figure.colorbar(points, ax=panels[-1], label="θᵢ [°]")
    return figure


def _figure(result: FitResult, columns: int) -> tuple[Any, list[Any]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1 + 5 * columns, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    wavelengths = result.measured.wavelength_um
    at = f" at {wavelengths[result.middle]:g} µm" if wavelengths else ""
    figure.suptitle(f"{result.material.name}{at}, χ²/df = {result.chi2_dof:.3g}")
    return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def _curve(result: FitResult, theta_i: float, theta_r: Any, phi: Any) -> Array:
    geometry = reference.geometry_from_angles(*np.broadcast_arrays(theta_i, theta_r, phi))
    return result.brdf(geometry)[result.middle]


def _crosses(
    axes: Any, result: FitResult, x: Array, here: Mask, colour: str, *, zero: float = 0, unit: float = 1
) -> None:
    """Measured values with their errors, less `zero`, in units of `unit`."""
    y = (result.measured.f_r[result.middle, here] - zero) / unit
    error = result.sigma[result.middle, here] / unit
    axes.errorbar(x[here], y, error, fmt="x", color=colour, markersize=4, elinewidth=0.8)


def _groups(keys: Array, among: Mask) -> list[tuple[float, ...]]:
    """The columns of `keys` (to 0.1 degrees) that most samples share, at most `CURVES`, ascending."""
    unique, count = np.unique(keys[:, among].round(1), axis=1, return_counts=True)
    most = np.sort(np.argsort(-count, kind="stable")[:CURVES])
    return [tuple(column) for column in unique[:, most].T.tolist()]


def _sweeps(pairs: Array) -> Mask:
    """Samples with theta_r about theta_i: a turn of phi leads through the peak."""
    apart = np.abs(pairs[0] - pairs[1])
    closest: Mask = apart <= max(5.0, float(apart.min()))
    return closest


def _fit_height(axes: Any, result: FitResult, shown: Mask) -> None:
    """Let the f_r axis span the measured values; logarithmic where they differ much."""
    values = result.measured.f_r[result.middle, shown]
    values = values[np.isfinite(values) & (values > 0)]
    if not values.size:
        return
    if values.max() > LOGARITHMIC * values.min():
        axes.set(yscale="log", ylim=(values.min() / 1.5, values.max() * 1.5))
    else:
        axes.set(ylim=(0, 1.1 * values.max()))


def _legend(axes: Any) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize="small")
