"""Figures 1 to 5 of the paper, drawn from the model; its measurements were never published as numbers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr import reference
from tscorr.bench.forms import f_r
from tscorr.errors import OutputError
from tscorr.materials import Material, builtin_materials

Array = NDArray[np.float64]

STYLES = ("-", "--", ":", "*")
INDEX_PAIRS = (((1.5, 0.0), (1.35, 0.4)), ((1.6, 0.2), (1.4, 0.55)))
"""refractive indices n, k whose Fresnel reflectances figure 1 finds alike"""
G_INCIDENCE_DEG = (0.0, 40.0, 60.0, 80.0)
ZENITH_SWEEPS_DEG = (10.0, 30.0, 50.0, 65.0)
AZIMUTH_SWEEPS_DEG = ((30.0, 30.0), (50.0, 50.0), (65.0, 70.0))


def draw_figures(folder: str | Path) -> list[Path]:
    """Write `figure_1.png` to `figure_5.png` into a folder, which is made; returns the files."""
    folder = Path(folder)
    drawings = (fresnel_figure, zenith_figure, azimuth_figure, attenuation_by_tilt, attenuation_by_exitance)
    files = [folder / f"figure_{number}.png" for number in range(1, len(drawings) + 1)]
    for file, draw in zip(files, drawings, strict=True):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            draw().savefig(file, dpi=110)
        except OSError as error:
            raise OutputError(f"the figure {file} cannot be written: {error}") from None
    return files


def fresnel_figure() -> Any:
    """Figure 1: two pairs of refractive indices whose Fresnel reflectance has the same course."""
    figure, (axes,) = _panels("Fresnel reflectance, scaled to its partner at 0°", 1)
    theta = np.arange(0.0, 90.1, 0.5)
    for (first, second), line, mark in zip(INDEX_PAIRS, ("-", ":"), ("+", "*"), strict=True):
        ours, partner = fresnel_pair(theta, first, second)
        axes.plot(theta, ours, "k" + line, label=f"n = {first[0]}, k = {first[1]}")
        axes.plot(theta[::8], partner[::8], "k" + mark, label=f"n = {second[0]}, k = {second[1]}")
    axes.set(xlabel="angle of incidence [°]", ylabel="F", xlim=(0, 90), ylim=(0, 1))
    axes.legend()
    return figure


def fresnel_pair(theta_deg: Array, first: tuple[float, float], second: tuple[float, float]) -> tuple[Array, Array]:
    """F of two indices (n, k) at local angles, the second scaled to the first at 0 degrees."""
    cos_l = np.sin(np.deg2rad(90 - theta_deg))
    ours, other = (reference.fresnel(cos_l, np.asarray(n), np.asarray(k)) for n, k in (first, second))
    at_0 = [reference.fresnel(np.asarray(1.0), np.asarray(n), np.asarray(k)) for n, k in (first, second)]
    return ours, other * (at_0[0] / at_0[1])


def zenith_figure() -> Any:
    """Figure 2: f_r against the zenith angle of view in forward scatter."""
    surfaces = _surfaces()
    figure, panels = _panels("f_r [1/sr] in forward scatter, φ = 180°", len(surfaces))
    theta_r = np.linspace(0, 80, 321)
    for axes, surface in zip(panels, surfaces, strict=True):
        for number, theta_i in enumerate(ZENITH_SWEEPS_DEG):
            values = _f_r(surface, theta_i, theta_r, 180.0)
            axes.plot(theta_r, values, f"C{number}", label=f"θᵢ = {theta_i:g}°")
            axes.axvline(theta_i, color=f"C{number}", linewidth=0.6, alpha=0.5)
        axes.set(title=surface.name, xlabel="θᵣ [°]", xlim=(0, 80))
        axes.set_ylim(bottom=0)
    panels[0].legend(fontsize="small")
    return figure


def azimuth_figure() -> Any:
    """Figure 3: f_r against the relative azimuth; below, the peak alone, set to 1 at phi = 180."""
    surfaces = _surfaces()
    figure, panels = _panels("f_r [1/sr]; below, (f_r - t0) / its value at φ = 180°", len(surfaces), rows=2)
    phi = np.linspace(90, 180, 361)
    for axes, below, surface in zip(panels[: len(surfaces)], panels[len(surfaces) :], surfaces, strict=True):
        for (theta_i, theta_r), line in zip(AZIMUTH_SWEEPS_DEG, STYLES, strict=False):
            values = _f_r(surface, theta_i, theta_r, phi)
            axes.plot(phi, values, "k" + line, label=f"θᵢ = {theta_i:g}°, θᵣ = {theta_r:g}°")
            below.plot(phi, (values - surface.t0[0]) / (values[-1] - surface.t0[0]), "k" + line)
        below.axhline(0.5, color="0.7", linewidth=0.8)
        axes.set(title=surface.name, xlim=(90, 180))
        axes.set_ylim(bottom=0)
        below.set(xlabel="φ [°]", xlim=(90, 180), ylim=(0, 1.05))
    panels[0].legend(fontsize="x-small")
    return figure


def attenuation_by_tilt() -> Any:
    """Figure 4: G against the facet tilt in the principal plane; negative towards the source."""
    figure, (axes,) = _panels("Geometric attenuation factor in the principal plane", 1)
    for theta_i, style in zip(G_INCIDENCE_DEG, STYLES, strict=True):
        exitance = _exitances(style)
        axes.plot(
            (exitance - theta_i) / 2, attenuation_in_plane(theta_i, exitance), "k" + style, label=f"{theta_i:g}°"
        )
    axes.set(xlabel="facet tilt α [°]", ylabel="G", ylim=(0, 1.05))
    axes.legend(title="θᵢ", loc="upper left")
    return figure


def attenuation_by_exitance() -> Any:
    """Figure 5: G against the zenith angle of view in the principal plane; negative on the source's side."""
    figure, (axes,) = _panels("Geometric attenuation factor in the principal plane", 1)
    for theta_i, style in zip(G_INCIDENCE_DEG, STYLES, strict=True):
        exitance = _exitances(style)
        axes.plot(exitance, attenuation_in_plane(theta_i, exitance), "k" + style, label=f"{theta_i:g}°")
    axes.set(xlabel="θᵣ [°]", ylabel="G", xlim=(-90, 90), ylim=(0, 1.05))
    axes.legend(title="θᵢ", loc="lower center")
    return figure


def attenuation_in_plane(theta_i_deg: float, exitance_deg: Array) -> Array:
    """G at exitances from -90 to 90 degrees along the principal plane, positive in forward scatter."""
    incidence = np.full_like(exitance_deg, theta_i_deg)
    phi = np.where(exitance_deg >= 0, 180.0, 0.0)
    geometry = reference.geometry_from_angles(incidence, np.abs(exitance_deg), phi)
    return reference.attenuation(geometry.cos_i, geometry.cos_r, geometry.cos_l)


def _exitances(style: str) -> Array:
    """Along the principal plane: close together for a line, apart for stars."""
    return np.linspace(-89.0, 89.0, 90 if style == "*" else 1425)


def _surfaces() -> list[Material]:
    return [surface for surface in builtin_materials().values() if surface.has_peak]


def _f_r(surface: Material, theta_i: float, theta_r: Array | float, phi: Array | float) -> Any:
    angles = np.broadcast_arrays(np.asarray(theta_i), theta_r, phi)
    return f_r(surface, reference.geometry_from_angles(*angles))


def _panels(title: str, columns: int, rows: int = 1) -> tuple[Any, Sequence[Any]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (7.5, 5.0) if columns == 1 else (3.2 * columns, 3.4 * rows)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)
