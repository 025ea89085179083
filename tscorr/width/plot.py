"""Azimuthal and zenithal width against incidence, drawn for materials without a scene.

Drawn with matplotlib's objects, without pyplot and its global state; matplotlib is imported by the call.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tscorr.errors import OutputError
from tscorr.materials import Material
from tscorr.width.azimuthal import azimuthal_width
from tscorr.width.zenithal import zenithal_width

INCIDENCE_DEG = np.arange(1.0, 86.0)
STYLES = ("-", "--", "-.", ":")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""distinct to the colour-blind (Okabe and Ito)"""


def save_width_plot(materials: Sequence[Material], path: str | Path, form: str = "full") -> None:
    """Write a picture of the widths of materials; its format is that of the suffix (.png, .svg, .pdf).

    Raises OutputError where it cannot be written.
    """
    figure = width_figure(materials, form)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise OutputError(f"the plot {path} cannot be written: {error}") from None


def width_figure(materials: Sequence[Material], form: str = "full") -> Any:
    """Azimuthal width on the left, zenithal on the right, a line for each material with a peak.

    No line where there is no half maximum.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    azimuthal, zenithal = figure.subplots(1, 2)
    for number, material in enumerate(material for material in materials if material.has_peak):
        look = {
            "color": COLOURS[number % len(COLOURS)],
            "linestyle": STYLES[number // len(COLOURS) % len(STYLES)],
            "label": material.name.replace("_", " "),
        }
        azimuthal.plot(INCIDENCE_DEG, azimuthal_width(material, INCIDENCE_DEG, form=form), **look)
        zenithal.plot(INCIDENCE_DEG, zenithal_width(material, INCIDENCE_DEG, form), **look)
    azimuthal.set(ylabel="azimuthal width of the lobe [°]", title="In azimuth, at exitance = incidence")
    zenithal.set(ylabel="zenithal width of the exponential [°]", title="In the principal plane, cut at the horizon")
    for axes in (azimuthal, zenithal):
        axes.set(xlabel="angle of incidence [°]", xlim=(0, 90))
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    if azimuthal.lines:
        azimuthal.legend()
    return figure
