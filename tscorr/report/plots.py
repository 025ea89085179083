"""The pictures of a report.

Colours of Okabe & Ito (2008) and a ramp of one hue: told apart with any colour vision, and in grey print.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from contourpy import contour_generator
from numpy.typing import ArrayLike

from tscorr import reference
from tscorr.angles import relative_azimuth
from tscorr.report.charts import GREY, INK, Chart, drawing, nice_ticks, polyline, stroke, text
from tscorr.report.facts import Array, SceneFacts
from tscorr.report.histograms import TILT_BIN_DEG
from tscorr.width import LobeShape, azimuthal_width, lobe_shapes, zenithal_width

BLUE, ORANGE, GREEN, GOLD = "#0072b2", "#d55e00", "#009e73", "#f0c419"
LINES = (
    (BLUE, ""),
    (ORANGE, "9 4"),
    (GREEN, "9 3 2 3"),
    ("#cc79a7", "3 3"),
    (INK, ""),
    ("#e69f00", "9 4"),
    ("#56b4e9", "9 3 2 3"),
    (GREY, "3 3"),
)
"""colour and dashes of the materials, in their order on the page"""
SHARE_LEVELS = (0.01, 0.05, 0.10, 0.25, 0.50, 0.75)
SHARE_COLOURS = ("#fff1cc", "#fedf9b", "#fdbf5c", "#f5963a", "#d0611c", "#8a3410")
RIM_DEG = 85.0
MOST_VIEWS = 250
PHONG_FIT_DEG = 30.0
WIDEST_AXIS_DEG = 240.0
CLOCK_MINUTES = np.arange(-480, 481, 20)


def dome(facts: SceneFacts, row: int, description: str) -> str:
    """Where in the sky a sensor sees the glare of level ground: north up, zenith angle outwards.

    Colour: the specular share. Solid: half of the lobe's value in the mirror direction; where it crosses
    the ring of the mirror direction, the azimuthal width begins and ends (blue arc). Dashed: the threshold
    of removal. Dots: view directions of the scene.
    """
    rules, lobe = facts.materials[row][2], _StrongestLobe(facts, row)
    sun_zenith, sun_azimuth = facts.solar_zenith_deg, facts.solar_azimuth_deg
    zenith, from_sun = np.meshgrid(np.linspace(0, RIM_DEG, 69), np.linspace(0, 360, 145), indexing="ij")
    f_spec = lobe.f_spec(sun_zenith, zenith, relative_azimuth(from_sun, 0))
    mirror = lobe.f_spec(sun_zenith, sun_zenith, 180)
    x, y = _on_dome(zenith, sun_azimuth + from_sun)

    parts = []
    share = contour_generator(x, y, lobe.share(f_spec))
    for level, colour in zip(SHARE_LEVELS, SHARE_COLOURS, strict=True):
        area = f'<path d="{_areas(share, level)}" fill="{colour}" stroke="{colour}" stroke-width=".5"/>'
        parts.append(area)
    parts += [*_graticule(), *_views(facts)]
    for values, level, style in (
        (lobe.gain * f_spec, rules.negligible_reflectance, stroke(INK, 1.2, "4 3")),
        (f_spec / mirror, 0.5, stroke(INK, 2.2)),
    ):
        parts.append(f'<path d="{_contours(contour_generator(x, y, values), level)}" {style}/>')
    width = float(azimuthal_width(lobe.shape, sun_zenith, form=rules.form))
    if math.isfinite(width):
        arc = sun_azimuth + 180 + np.linspace(-width, width, 91) / 2
        parts.append(f'<path d="{polyline(*_on_dome(sun_zenith, arc))}" {stroke(BLUE, 4.5)}/>')
    parts += _sun_and_mirror(sun_zenith, sun_azimuth)
    return drawing(parts, description, height=330)


def widths(facts: SceneFacts, row: int, incidence_deg: Sequence[float], description: str) -> str:
    """Azimuthal and zenithal width against incidence, the scene's range, and a Phong lobe for contrast.

    incidence_deg : of 5, 50 and 95 % of the scene's pixels.
    """
    lobe, form = facts.lobe(row), facts.materials[row][2].form
    incidence = np.linspace(5, 85, 161)
    azimuthal, zenithal = azimuthal_width(lobe, incidence, form=form), zenithal_width(lobe, incidence, form)
    shown = np.concatenate([azimuthal[incidence >= 20], zenithal])
    ceiling = min(WIDEST_AXIS_DEG, float(np.nanmax(shown, initial=20)))
    chart = Chart(range(0, 91, 15), nice_ticks(ceiling), "angle of incidence, degrees", "width, degrees")
    low, median, high = incidence_deg
    chart.span(low, high)
    chart.upright(median)
    chart.line(incidence, phong_width(lobe, form, incidence), GREY, dash="2 3", width=1.8)
    chart.line(incidence, zenithal, ORANGE, dash="9 4")
    chart.line(incidence, azimuthal, BLUE, width=2.8)
    return chart.svg(description)


def phong_width(lobe: LobeShape, form: str, incidence_deg: Array) -> Array:
    """Azimuthal width of a Phong lobe that has the lobe's own width at 30 degrees. [deg]

    Phong's lobe depends on the angle rho to the mirror direction alone, so that its half maximum keeps one
    rho: sin(rho/2) = sin theta sin(width/4). nan where the lobe has no width at 30 degrees, or this none.
    """
    fitted = np.deg2rad(azimuthal_width(lobe, PHONG_FIT_DEG, form=form))
    sine = math.sin(math.radians(PHONG_FIT_DEG)) * np.sin(fitted / 4) / np.sin(np.deg2rad(incidence_deg))
    return np.rad2deg(4 * np.arcsin(np.where(sine <= 1, sine, np.nan)))


def tilts(facts: SceneFacts, row: int, incidence_deg: float, description: str) -> str:
    """Specular share against facet tilt at one incidence, over how often tilts occur in the scene.

    The curve follows the ring exitance = incidence, from the mirror direction to the sun's.
    """
    lobe = _StrongestLobe(facts, row)
    relative = np.linspace(180, 0, 181)
    incidence = np.full_like(relative, incidence_deg)
    tilt = np.rad2deg(reference.geometry_from_angles(incidence, incidence, relative).alpha)
    share = lobe.share(lobe.f_spec(incidence_deg, incidence, relative))
    chart = Chart(range(0, 61, 10), range(0, 101, 20), "facet tilt, degrees", "share of the signal, %")
    degree = round(1 / TILT_BIN_DEG)
    counts = facts.tally.tilt[row + 1].reshape(-1, degree).sum(axis=1)[:60]
    chart.bars(np.arange(61), 90 * counts / max(counts.max(), 1))
    chart.line(tilt, 100 * share, BLUE, width=2.8)
    return chart.svg(description)


def headings(rows: Sequence[Mapping[str, Any]], names: Sequence[str], description: str) -> str:
    """Largest specular share along a scan line against heading, a line a material."""
    chart = Chart(range(0, 361, 60), range(0, 101, 20), "heading, degrees from north", "largest share, %")
    heading = [*(row["heading_deg"] for row in rows), 360]
    for name, (colour, dash) in zip(names, lines(len(names)), strict=True):
        share = [100 * row["max_specular_share"][name] for row in rows]
        chart.line(heading, [*share, share[0]], colour, dash=dash)
    return chart.svg(description)


def times_of_day(facts: SceneFacts, rows: Sequence[int], description: str) -> str:
    """Azimuthal width on level ground against the time of flight; empty where the sun's path is unknown."""
    if facts.sun_at is None:
        return ""
    zenith = np.asarray(facts.sun_at(CLOCK_MINUTES)[0], dtype=float)
    seen = np.where(zenith < RIM_DEG, zenith, np.nan)
    all_widths = [azimuthal_width(facts.lobe(row), seen, form=facts.materials[row][2].form) for row in rows]
    ceiling = min(WIDEST_AXIS_DEG, float(np.nanmax(all_widths, initial=20)))
    chart = Chart(range(-8, 9, 2), nice_ticks(ceiling), "hours after this flight", "width, degrees")
    chart.upright(0)
    for width, (colour, dash) in zip(all_widths, lines(len(rows)), strict=True):
        chart.line(CLOCK_MINUTES / 60, width, colour, dash=dash)
    return chart.svg(description)


def lines(number: int) -> list[tuple[str, str]]:
    """Colour and dashes of so many materials."""
    return [LINES[place % len(LINES)] for place in range(number)]


class _StrongestLobe:
    """The lobe of a material in the band in which it stands out most, as seen over level ground."""

    def __init__(self, facts: SceneFacts, row: int) -> None:
        _, parameters, rules = facts.materials[row]
        strengths = np.broadcast_to(rules.direct_fraction, len(parameters.w)) * parameters.t1
        shapes = lobe_shapes(parameters)
        at_normal = np.array([float(shape.fresnel(np.ones(()))) for shape in shapes])
        band = int((strengths * at_normal / np.maximum(parameters.t0, 1e-12)).argmax())
        self.shape = shapes[band]
        self._simplified = rules.form == "simplified"
        self._strength, self._t0 = strengths[band], parameters.t0[band]
        self.gain = math.pi * float(strengths.max())
        """reflectance factor per f_spec, in the band that most is removed from"""

    def f_spec(self, incidence_deg: float, exitance_deg: ArrayLike, relative_azimuth_deg: ArrayLike) -> Array:
        exitance, relative = np.broadcast_arrays(
            np.asarray(exitance_deg, dtype=float), np.asarray(relative_azimuth_deg, dtype=float)
        )
        geometry = reference.geometry_from_angles(np.full(exitance.shape, incidence_deg), exitance, relative)
        w, n, k = (np.asarray(value) for value in (self.shape.w, self.shape.n, self.shape.k))
        return reference.specular(geometry, w, n, k, simplified=self._simplified)

    def share(self, f_spec: Array) -> Array:
        return self._strength * f_spec / (self._t0 + self._strength * f_spec)


CENTRE_X, CENTRE_Y, RADIUS = 180.0, 166.0, 142.0


def _on_dome(zenith_deg: ArrayLike, azimuth_deg: ArrayLike) -> tuple[Array, Array]:
    """Place of a direction on the drawing of the dome."""
    radius, azimuth = np.asarray(zenith_deg) * (RADIUS / RIM_DEG), np.deg2rad(azimuth_deg)
    return CENTRE_X + radius * np.sin(azimuth), CENTRE_Y - radius * np.cos(azimuth)


def _areas(generator: Any, level: float) -> str:
    """Path around what is above a level: outer rings, and holes that wind the other way."""
    return "".join(
        polyline(*points[start:end].T) + "Z"
        for points, offsets in zip(*generator.filled(level, np.inf), strict=True)
        for start, end in pairwise(offsets)
    )


def _contours(generator: Any, level: float) -> str:
    """Path along a level."""
    return "".join(polyline(*line.T) for line in generator.lines(level))


def _graticule() -> list[str]:
    """Circles of zenith angle and the points of the compass."""
    rim = f'<circle cx="{CENTRE_X}" cy="{CENTRE_Y}" r="{RADIUS}" {stroke(GREY, 0.8)}/>'
    circles = []
    for zenith in (20, 40, 60):
        radius = zenith * RADIUS / RIM_DEG
        circle = f'cx="{CENTRE_X}" cy="{CENTRE_Y}" r="{radius:.1f}"'
        circles.append(f'<circle {circle} {stroke(GREY, 0.6)} stroke-opacity=".6"/>')
        circles.append(text(f"{zenith}°", CENTRE_X + 2, CENTRE_Y - radius - 2, colour=GREY, halo=True))
    compass = [
        text("N", CENTRE_X, CENTRE_Y - RADIUS - 8, anchor="middle"),
        text("E", CENTRE_X + RADIUS + 12, CENTRE_Y + 4, anchor="middle"),
        text("S", CENTRE_X, CENTRE_Y + RADIUS + 16, anchor="middle"),
        text("W", CENTRE_X - RADIUS - 12, CENTRE_Y + 4, anchor="middle"),
    ]
    return [rim, *circles, *compass]


def _views(facts: SceneFacts) -> list[str]:
    """Dots at some of the scene's view directions, the same at every call."""
    zenith, azimuth, _ = facts.views()
    chosen = np.random.default_rng(0).permutation(zenith.size)[:MOST_VIEWS]
    x, y = _on_dome(zenith[chosen], azimuth[chosen])
    dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    return [
        f'<path d="{dots}" {stroke(colour, width)} stroke-linecap="round"/>'
        for colour, width in (("#fff", 3.4), (INK, 2.0))
    ]


def _sun_and_mirror(zenith_deg: float, azimuth_deg: float) -> list[str]:
    x, y = _on_dome(zenith_deg, azimuth_deg)
    mirror_x, mirror_y = _on_dome(zenith_deg, azimuth_deg + 180)
    return [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="{GOLD}" stroke="{INK}"/>',
        text("sun", float(x), float(y) + 20, anchor="middle", halo=True),
        f'<path d="M{mirror_x - 7:.1f} {mirror_y:.1f}h14m-7 -7v14" {stroke("#fff", 4.5)}/>',
        f'<path d="M{mirror_x - 7:.1f} {mirror_y:.1f}h14m-7 -7v14" {stroke(INK, 2)}/>',
    ]
