"""The keys of report.json from the sums of a scene. Keys that exist are never renamed."""

import json
import math
from collections import ChainMap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np

from tscorr.angles import relative_azimuth, unit_vector
from tscorr.correction import SINGLE_FLAGS, SpecularState
from tscorr.report.certainty import certainty
from tscorr.report.facts import Array, SceneFacts
from tscorr.report.histograms import INCIDENCE_BIN_DEG, SHARE_BIN, TILT_BIN_DEG, above, quantile
from tscorr.width import (
    LobeShape,
    azimuthal_width,
    critical_roof,
    crossover_incidence,
    cutoff_tilt,
    flank_slope,
    heading_table,
    lobe_shapes,
    width_rows,
    width_table,
    zenithal_width,
)

SHARES_ABOVE = (0.01, 0.05, 0.10, 0.50)
REMOVED_UNIT = 2.0**-32
"""of Tally.removed"""
QUANTILES = {"p05": 0.05, "p50": 0.50, "p95": 0.95}
MAX_FIELD_DEG = 85.0
"""half field of view up to which headings are compared"""
STAGES = ("wall", "read", "geometry", "kernel", "write")


def summary(facts: SceneFacts) -> dict[str, Any]:
    """What report.json holds: counts are exact, quantiles are from histograms.

    A quantile is within one bin of that of the pixels of the tallied rows; `quantiles` names the bins and
    how many rows were tallied. Floats have six digits; what does not exist is None.
    """
    wall = facts.seconds.get("wall")
    pixels = _pixels(facts)
    result = {
        "scene": facts.scene,
        "image": facts.image,
        "tscorr": facts.version,
        "bands": list(facts.bands),
        "pixels": pixels,
        "uncertainty_evaluated": facts.uncertainty_evaluated,
        "skipped": {**facts.skipped, "pixels_out_of_lobe": int(facts.tally.out_of_lobe[0])},
        "sun": {
            "zenith_deg": facts.solar_zenith_deg,
            "azimuth_deg": facts.solar_azimuth_deg,
            "convergence_deg": facts.convergence_deg,
            "drift_deg_per_hour": _drift(facts),
        },
        "view": _view(facts),
        "materials": _materials(facts),
        "heading": _heading(facts),
        "simplified": {
            "pixels_g_below_one": int(facts.tally.attenuated[0]),
            "max_relative_difference": facts.tally.attenuated[1],
        },
        "quantiles": {
            "every_rows": facts.tally_stride,
            "incidence_bin_deg": INCIDENCE_BIN_DEG,
            "facet_tilt_bin_deg": TILT_BIN_DEG,
            "specular_share_bin": SHARE_BIN,
        },
        "seconds": {stage: facts.seconds.get(stage) for stage in STAGES},
        "peak_rss_mb": facts.peak_rss_mb,
        "mpixel_per_s": pixels["total"] / 1e6 / wall if wall else None,
    }
    plain: dict[str, Any] = _plain(result)
    return plain


def write_json(report: Mapping[str, Any], path: Path) -> None:
    """Write a summary as JSON, a key a line, readable by any parser: no NaN, UTF-8.

    Indented any deeper, json leaves its compiled encoder and takes ten times as long.
    """
    encode = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode
    lines = ",\n".join(f"{encode(key)}: {encode(value)}" for key, value in report.items())
    path.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def _pixels(facts: SceneFacts) -> dict[str, int]:
    states = facts.tally.states.sum(axis=0)
    total, not_assessed = int(states.sum()), int(states[SpecularState.NOT_ASSESSED])
    flags = {flag.name: int(facts.flag_counts[str(flag.name)]) for flag in SINGLE_FLAGS}
    return {
        "total": total,
        "valid": total - flags["NODATA"],
        "evaluated": total - not_assessed,
        **{state.name.lower(): int(states[state]) for state in SpecularState},
        **{str(name).lower(): count for name, count in flags.items()},
    }


def _view(facts: SceneFacts) -> dict[str, Any]:
    zenith, _, relative = facts.views()
    return {
        "zenith_deg": _spread(zenith),
        "relative_azimuth_deg": _spread(relative),
        "forward_fraction": float(np.mean(relative > 90)) if relative.size else None,
    }


def _spread(values: Array) -> list[float | None]:
    """Minimum, median, maximum."""
    if values.size == 0:
        return [None, None, None]
    return [float(values.min()), float(np.median(values)), float(values.max())]


def _materials(facts: SceneFacts) -> dict[str, Any]:
    path = _sun_path(facts)
    return {entry[0].name: _material(facts, row, path) for row, entry in enumerate(facts.materials)}


def _material(facts: SceneFacts, row: int, path: Array | None) -> dict[str, Any]:
    rules, lobe, tally = facts.materials[row][2], facts.lobe(row), facts.tally
    states, extremes = tally.states[row + 1], tally.extremes[row + 1]
    incidence, tilt, share = tally.incidence[row + 1], tally.tilt[row + 1], tally.share[row + 1]
    most = extremes[1] if share.any() else 1.0
    level_width_deg = float(azimuthal_width(lobe, facts.solar_zenith_deg, form=rules.form))
    return {
        "pixels": states.sum(),
        **{state.name.lower(): states[state] for state in SpecularState},
        "incidence_deg": [quantile(incidence, q, INCIDENCE_BIN_DEG) for q in (0.05, 0.5, 0.95)],
        "facet_tilt_deg": {
            "min": extremes[0],
            "p05": quantile(tilt, 0.05, TILT_BIN_DEG),
            "p50": quantile(tilt, 0.5, TILT_BIN_DEG),
        },
        "specular_share": {
            "p50": np.minimum(most, quantile(share, 0.50, SHARE_BIN)),
            "p95": np.minimum(most, quantile(share, 0.95, SHARE_BIN)),
            "max": extremes[1] if share.any() else None,
            "above": _shares_above(share, incidence.sum()),
        },
        "removed_mean": tally.removed[row + 1] * REMOVED_UNIT / max(share.sum(), 1),
        **_widths(lobe, rules.form, incidence),
        "width_at": width_rows(lobe, form=rules.form),
        "crossover_incidence_deg": crossover_incidence(lobe, rules.form),
        "alpha_cut_deg": _alpha_cut(facts, row),
        "sensitivity": _sensitivity(lobe),
        "critical_roof": _critical_roof(facts),
        "level_width_deg": level_width_deg,
        "uncertainty": certainty(facts, row),
        "level_spot_m": _spot(facts, level_width_deg, float(zenithal_width(lobe, facts.solar_zenith_deg, rules.form))),
        "half_width_minutes": _minutes_to_turn(path, level_width_deg / 2),
    }


def _shares_above(share: Array, assessed: int) -> list[dict[str, Any]]:
    """Which part of the assessed pixels has a specular share of at least so much."""
    return [
        {
            "specular_share": threshold,
            "fraction": share[round(threshold / SHARE_BIN) :].sum() / assessed if assessed else None,
        }
        for threshold in SHARES_ABOVE
    ]


def _widths(lobe: LobeShape, form: str, incidence: Array) -> dict[str, Any]:
    """Quantiles of the three widths over the pixels counted by incidence.

    All of them fall with incidence, so that a quantile of a width is the width at a quantile of incidence.
    """
    table = width_table(lobe, form)

    def arc(incidence_deg: float) -> float:
        return float(table.at(incidence_deg) * math.sin(math.radians(incidence_deg)))

    def zenithal(incidence_deg: float) -> float:
        return float(zenithal_width(lobe, incidence_deg, form))

    zenithal_edge_deg = 0.0 if lobe.has_peak else math.nan
    return {
        "azimuthal_width_deg": _falling_quantiles(table.at, table.edge_deg, incidence),
        "azimuthal_arc_deg": _falling_quantiles(arc, table.edge_deg, incidence),
        "zenithal_width_deg": _falling_quantiles(zenithal, zenithal_edge_deg, incidence),
    }


def _falling_quantiles(width: Callable[[float], SupportsFloat], edge_deg: float, incidence: Array) -> dict[str, Any]:
    """Quantiles of a width that falls with incidence and exists from `edge_deg` on; nan: nowhere."""
    total = incidence.sum()
    if total == 0 or math.isnan(edge_deg):
        return {"p05": None, "p50": None, "p95": None, "none_fraction": 1.0 if total else None}
    wide = above(incidence, edge_deg, INCIDENCE_BIN_DEG)
    at = {name: quantile(wide, 1 - q, INCIDENCE_BIN_DEG) for name, q in QUANTILES.items()}
    return {
        **{name: float(width(max(place, edge_deg))) for name, place in at.items()},
        "none_fraction": 1 - wide.sum() / total,
    }


def _spot(facts: SceneFacts, azimuthal_deg: float, zenithal_deg: float) -> dict[str, float | None]:
    """Size of the half maximum on level ground around the mirror point of a frame camera. [m]

    Across the plane of the sun H tan(theta) times the azimuthal width, along it H / cos^2(theta) times the zenithal.
    """
    height, theta = facts.camera_height_m, math.radians(facts.solar_zenith_deg)
    if height is None or theta >= math.pi / 2:
        return {"across": None, "along": None}
    return {
        "across": height * math.tan(theta) * math.radians(azimuthal_deg),
        "along": height / math.cos(theta) ** 2 * math.radians(zenithal_deg),
    }


def _sensitivity(lobe: LobeShape) -> dict[str, float | None]:
    """Relative change of the glare, where it is half of its peak, per degree of error in a direction."""
    slope = flank_slope(lobe) if lobe.has_peak else None
    return {"per_degree_of_normal": slope, "per_degree_of_view": None if slope is None else slope / 2}


def _alpha_cut(facts: SceneFacts, row: int) -> float:
    """Facet tilt from which on nothing is removed, at the material's median incidence, in any band. [deg]"""
    _, parameters, rules = facts.materials[row]
    median = quantile(facts.tally.incidence[row + 1], 0.5, INCIDENCE_BIN_DEG)
    incidence = facts.solar_zenith_deg if math.isnan(median) else median
    fractions = np.broadcast_to(rules.direct_fraction, len(parameters.w))
    return max(
        float(
            cutoff_tilt(
                shape,
                incidence,
                incidence,
                rules.negligible_reflectance,
                rules.form,
                direct_fraction=float(fraction),
            )
        )
        for shape, fraction in zip(lobe_shapes(parameters), fractions, strict=True)
    )


def _critical_roof(facts: SceneFacts) -> dict[str, Any]:
    if facts.centre_view_deg is None:
        return {"slope_deg": None, "aspect_deg": None}
    sun = unit_vector(facts.solar_zenith_deg, facts.solar_azimuth_deg)
    roof = critical_roof(sun, unit_vector(*facts.centre_view_deg))
    return {"slope_deg": roof.slope_deg, "aspect_deg": roof.aspect_deg}


def _heading(facts: SceneFacts) -> list[dict[str, Any]]:
    """`heading_table` over all materials with a lobe; empty where the sun or the view does not allow it."""
    zenith, _, _ = facts.views()
    half_field_of_view_deg = min(float(zenith.max(initial=0)), MAX_FIELD_DEG)
    if not (half_field_of_view_deg > 0 and facts.solar_zenith_deg < 90):
        return []
    tables = [
        heading_table(
            facts.solar_zenith_deg,
            facts.solar_azimuth_deg,
            half_field_of_view_deg,
            {surface.name: parameters},
            rules.form,
            direct_fraction=rules.direct_fraction,
        )
        for surface, parameters, rules in facts.materials
        if surface.has_peak
    ]
    return [
        {**rows[0], "max_specular_share": dict(ChainMap(*(row["max_specular_share"] for row in rows)))}
        for rows in zip(*tables, strict=True)
    ]


def _sun_path(facts: SceneFacts) -> Array | None:
    """Minutes from now and how far the sun has turned by then [deg], (steps, 2), until it sets."""
    if facts.sun_at is None:
        return None
    minutes = np.arange(0.0, 485.0, 10.0)
    zenith, azimuth = facts.sun_at(minutes)
    turned = relative_azimuth(azimuth, facts.solar_azimuth_deg)
    is_up = np.logical_and.accumulate(np.asarray(zenith) < 90)
    return np.stack([minutes, turned], axis=1)[is_up]


def _minutes_to_turn(path: Array | None, goal_deg: float) -> float | None:
    """Minutes until the sun has turned by an angle, or None where it does not within its path."""
    if path is None or not (path[:, 1] >= goal_deg).any():
        return None
    place = int((path[:, 1] >= goal_deg).argmax())
    return float(np.interp(goal_deg, path[: place + 1, 1], path[: place + 1, 0]))


def _drift(facts: SceneFacts) -> dict[str, float] | None:
    """How fast the sun moves, over the ten minutes before and after."""
    if facts.sun_at is None:
        return None
    zenith, azimuth = facts.sun_at(np.array([-10.0, 10.0]))
    turned = (azimuth[1] - azimuth[0] + 180) % 360 - 180
    return {"zenith": 3 * (zenith[1] - zenith[0]), "azimuth": 3 * turned}


def _plain(value: Any) -> Any:
    """A value as JSON has it: plain types, floats of six digits, None for nan and infinity."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
