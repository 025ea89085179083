"""How sure the corrected values are: the numbers of report.json, and their section of the page."""

from typing import Any

import numpy as np

from tscorr.correction.covariance import ORIGINS, origin
from tscorr.report.charts import INK, Chart, nice_ticks
from tscorr.report.facts import SceneFacts
from tscorr.report.markup import figure, paragraph, section, table
from tscorr.report.words import Report, percent, readable


def certainty(facts: SceneFacts, row: int) -> dict[str, Any] | None:
    """1 sigma of a material's corrected values over all bands, and what is said of its errors; None: not evaluated."""
    if facts.sigmas is None:
        return None
    surface, _, rules = facts.materials[row]
    touched = int(facts.sigmas.touched[row + 1])
    return {
        "covariance": origin(surface, rules.material_covariance),
        "sigma": {"p50": facts.sigmas.quantile(row + 1, 0.5), "p95": facts.sigmas.quantile(row + 1, 0.95)},
        "uncertain_fraction": facts.sigmas.uncertain[row + 1] / touched if touched else None,
    }


def section_of(report: Report) -> str:
    """The section of the page; nothing where the uncertainty was not evaluated."""
    if not report["uncertainty_evaluated"]:
        return ""
    rows = [
        (
            readable(name),
            _reflectance(known["sigma"]["p50"]),
            _reflectance(known["sigma"]["p95"]),
            percent(known["uncertain_fraction"], 1),
            ORIGINS[known["covariance"]],
        )
        for name, material in report["materials"].items()
        if (known := material["uncertainty"]) is not None and known["uncertain_fraction"] is not None
    ]
    head = ("material", "1 sigma, median", "95 % below", "uncertain", "errors of its parameters")
    note = paragraph(
        "1 sigma of the corrected reflectance factor over all bands of the pixels with something removed: noise "
        "of the image, parameters, direct fraction, normal and direction to the sensor, to first order. Uncertain: "
        "the error of what was removed exceeds half of what is left.",
        "note",
    )
    return section(
        "How sure the result is", table(head, rows) if rows else "", note, _coverage(report.get("coverage"))
    )


def _reflectance(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _coverage(coverage: Report | None) -> str:
    """What the truth of a synthetic scene says of the claim."""
    if coverage is None or not coverage["values"]:
        return ""
    edges, shares = np.array(coverage["histogram"]["edges"]), np.array(coverage["histogram"]["share"])
    density = 100 * shares
    middle = (edges[1:] + edges[:-1]) / 2
    expected = 100 * np.diff(edges) * np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi)
    chart = Chart(range(-4, 5), nice_ticks(max(density.max(), expected.max()), 6), "(corrected - truth) / sigma", "%")
    chart.bars(edges, density)
    chart.line(middle, expected, INK, dash="4 3")
    description = "Histogram of the errors against the truth in units of the claimed sigma, and a normal distribution"
    words = (
        f"The truth of this scene is known: {percent(coverage['within_1_sigma'], 1)} of the corrected values lie "
        f"within 1 sigma of it, {percent(coverage['within_2_sigma'], 1)} within 2; right would be 68 % and 95 %."
    )
    picture = figure(chart.svg(description), "Errors in units of the claim; dashed: a normal distribution")
    return paragraph(words) + f'<div class="plots">\n{picture}\n</div>'
