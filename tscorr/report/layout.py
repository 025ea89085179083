"""The page of a scene: what was found, in the order in which one wants to know it."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from tscorr.report import certainty, pictures, plots
from tscorr.report.charts import GREY, INK, PALE, stroke
from tscorr.report.facts import Array, SceneFacts
from tscorr.report.markup import counts, document, figure, image, legend, paragraph, section, table, tile
from tscorr.report.words import (
    Report,
    both_ways,
    by_glare,
    count,
    degrees,
    glare_fraction,
    heading_advice,
    headline,
    percent,
    readable,
    standfirst,
)

MOST_DRAWN = 8
"""materials with pictures of their own; the table has all"""

STATES = {
    "corrected": "the peak was removed",
    "uncorrectable": "too little would be left, or a band is saturated",
    "negligible": "nothing worth removing",
    "not_assessed": "no model, no light or no view; the flags below say which",
}
FLAGS = {
    "no_material": "a class without a material in the settings; left alone",
    "nodata": "the image has no data",
    "cast_shadow": "another surface hides the sun",
    "self_shadow": "the sun is behind the surface",
    "not_viewed": "the sensor is behind the surface, or hidden from it",
    "grazing": "light or view too flat for the model or the material",
    "saturated": "in at least one band",
    "clipped": "the result left the range of the file or fell below zero",
    "uncertain": "the error of what was removed exceeds half of the result",
    "normal_unreliable": "a gap or step of the surface model is near",
    "low_confidence": "the class is less than half certain",
}


def page(
    report: Report, facts: SceneFacts, quicklook: Path | None = None, azimuthal_width: Array | None = None
) -> str:
    """The page of a scene, as HTML in one file.

    report          : from `summary(facts)`.
    quicklook       : the PNG of before, after and flags; embedded, and linked as a file beside the page.
    azimuthal_width : (rows, cols), a decimated map of the width [deg], nan where there is none.
    """
    order = by_glare(report)
    drawn = [name for name in order if _has_lobe(report, name)][:MOST_DRAWN]
    parts = (
        _header(report),
        _picture(quicklook),
        _materials(report, facts, drawn),
        _numbers(report, order),
        certainty.section_of(report),
        _motion(report, facts, drawn),
        _map(azimuthal_width),
        _pixels(report),
        _trust(report),
        _footer(report),
    )
    return document(f"Glare in {report['scene']}", "\n".join(part for part in parts if part))


def _has_lobe(report: Report, name: str) -> bool:
    """Whether there is anything to draw: a lobe, and pixels that it was looked for in."""
    return report["materials"][name]["zenithal_width_deg"]["p50"] is not None


def _header(report: Report) -> str:
    kicker = f"{report['scene']} · {report['image']} · azimuthal-width report by tscorr {report['tscorr']}"
    text = paragraph(" ".join(standfirst(report)), "standfirst")
    return (
        f"<header>\n{paragraph(kicker, 'kicker')}\n<h1>{escape(headline(report))}</h1>\n{text}\n</header>\n"
        f'<div class="tiles">\n{_tiles(report)}\n</div>'
    )


def _tiles(report: Report) -> str:
    pixels, sun, view = report["pixels"], report["sun"], report["view"]
    touched = (pixels["corrected"] + pixels["uncorrectable"]) / max(pixels["valid"], 1)
    drift = sun["drift_deg_per_hour"]
    low, median, high = view["zenith_deg"]
    tiles = [
        tile(
            "Pixels with something to remove",
            percent(touched),
            f"{count(pixels['corrected'])} corrected, {count(pixels['uncorrectable'])} beyond correction",
        ),
        tile(
            "Sun from the zenith",
            degrees(sun["zenith_deg"], 1),
            f"azimuth {degrees(sun['azimuth_deg'], 1)}"
            + (f", turning {abs(drift['azimuth']):.1f}° an hour" if drift else ""),
        ),
        tile(
            "Views from the zenith",
            f"{degrees(low)} to {degrees(high)}",
            f"median {degrees(median)}; {percent(view['forward_fraction'])} look towards the sun",
        ),
    ]
    advice = heading_advice(report)
    if advice is not None:
        tiles.append(
            tile(
                "Safest heading",
                both_ways(advice.safest_deg),
                f"at most {percent(advice.safest_share)} glare, against {percent(advice.worst_share)} "
                f"at {both_ways(advice.worst_deg)}",
            )
        )
    return "\n".join(tiles)


def _picture(quicklook: Path | None) -> str:
    if quicklook is None:
        return ""
    picture = image(
        *pictures.embeddable(quicklook),
        "The image before and after the correction, and the flags of its pixels",
    )
    return section("Before, after, and what was done", f'<a href="{escape(quicklook.name)}">{picture}</a>')


def _materials(report: Report, facts: SceneFacts, drawn: Sequence[str]) -> str:
    if not drawn:
        return ""
    introduction = paragraph(
        "The sky: which part of the signal a sensor standing there would see as glare, above level ground, "
        "with north up. The width: a Phong lobe, as simpler tools use it, narrows too slowly as the light "
        "falls flatter. The tilt: how the glare fades as facets must lean further away from their surface to "
        "mirror the sun into the camera."
    )
    rows = {entry[0].name: row for row, entry in enumerate(facts.materials)}
    cards = [_material(report, facts, name, rows[name]) for name in drawn]
    return section("The glare of each material", introduction, _legend_of_lobes(), *cards)


def _legend_of_lobes() -> str:
    levels = (*(f"{100 * level:g}" for level in plots.SHARE_LEVELS), "100")
    patch = '<rect width="26" height="14" fill="{}"/>'
    line = '<path d="M0 7h26" {}/>'
    return legend(
        [
            *(
                (patch.format(colour), f"{low} to {high} %")
                for colour, low, high in zip(plots.SHARE_COLOURS, levels[:-1], levels[1:], strict=True)
            ),
            (line.format(stroke(INK, 2.2)), "half of the mirror direction’s value"),
            (line.format(stroke(INK, 1.2, "4 3")), "nothing removed beyond"),
            (f'<circle cx="13" cy="7" r="2" fill="{INK}"/>', "views of this scene"),
            (f'<path d="M6 7h14m-7 -7v14" {stroke(INK, 2)}/>', "mirror direction"),
            (line.format(stroke(plots.BLUE, 4)), "azimuthal width; share removed"),
            (line.format(stroke(plots.ORANGE, 2.2, "9 4")), "zenithal width"),
            (line.format(stroke(GREY, 1.8, "2 3")), "Phong lobe fitted at 30°"),
            (patch.format(PALE), "where this scene’s pixels are"),
        ]
    )


def _material(report: Report, facts: SceneFacts, name: str, row: int) -> str:
    label, incidence = readable(name), report["materials"][name]["incidence_deg"]
    low, median, high = (degrees(angle) for angle in incidence)
    sky = f"Sky above level {label}: contours of its lobe, the sun, and the view directions of the scene"
    width = f"Azimuthal and zenithal width of the glare of {label} against the angle of incidence"
    tilt = f"Share of the signal of {label} that is glare against facet tilt"
    drawings = (
        figure(plots.dome(facts, row, sky), "Sky: glare in the signal"),
        figure(plots.widths(facts, row, incidence, width), f"Width; 90 % of the pixels at {low} to {high}"),
        figure(plots.tilts(facts, row, incidence[1], tilt), f"Facet tilt; light falling in at {median}"),
    )
    source = facts.materials[row][0].source
    return (
        f'<article class="material">\n<h3>{escape(label)}</h3>\n{paragraph(_sentences(report, name))}\n'
        f'<div class="plots">\n{"".join(drawings)}\n</div>\n'
        f"{paragraph(f'Parameters: {source}', 'note') if source else ''}\n</article>"
    )


def _sentences(report: Report, name: str) -> str:
    """What the pictures of a material show."""
    material = report["materials"][name]
    width, minutes = material["azimuthal_width_deg"], material["half_width_minutes"]
    text = (
        f"At least a tenth of the signal is glare in {percent(glare_fraction(material))} of its assessed "
        f"pixels, at least half in {percent(glare_fraction(material, 0.5))}."
    )
    if width["p50"] is None:
        text += " Nowhere in the scene has its glare a half maximum in azimuth."
    else:
        none = width["none_fraction"]
        text += (
            f" On its surfaces the glare is {degrees(width['p05'])} to {degrees(width['p95'])} wide in "
            f"azimuth, typically {degrees(width['p50'])}"
            + (f"; on {percent(none)} of them it has no half maximum." if none >= 0.005 else ".")
        )
    spot = material["level_spot_m"]
    if spot["across"] is not None and spot["along"] is not None:
        text += (
            f" Seen from this camera, its glare on level ground is a spot of {spot['along']:.0f} m along the plane of "
            f"the sun and {spot['across']:.0f} m across."
        )
    slope = material["sensitivity"]["per_degree_of_normal"]
    text += (
        f" Where it is half as strong as at its peak, a degree of error in the roof’s slope changes it by "
        f"{percent(slope)}, one in the direction of the view by {percent(slope / 2)}."
    )
    if minutes is not None:
        text += f" On level ground the sun turns by half of its width in {minutes:.0f} minutes."
    return text


def _numbers(report: Report, order: Sequence[str]) -> str:
    head = (
        "material",
        "pixels",
        "corrected",
        "beyond correction",
        "incidence",
        "smallest tilt",
        "share removed",
        "azimuthal width",
        "as an arc",
        "zenithal width",
        "widths equal at",
        "reach in tilt",
    )
    note = paragraph(
        "Medians, with the range of 90 % of the pixels in brackets; the share with its 95 % quantile and its "
        "largest value, over pixels with something removed, in the band where it is largest. Widths are full "
        "widths at half maximum about the surface’s own normal, at exitance = incidence: azimuthal ones of "
        "the whole lobe, in degrees of azimuth, and zenithal ones of its exponential. Above the incidence at "
        "which they are equal, the azimuthal one is smaller. Beyond the reach in tilt nothing is removed.",
        "note",
    )
    return section("In numbers", table(head, [_row(report, name) for name in order]), note) if order else ""


def _row(report: Report, name: str) -> tuple[str, ...]:
    m = report["materials"][name]
    low, median, high = m["incidence_deg"]
    share, width = m["specular_share"], m["azimuthal_width_deg"]
    return (
        readable(name),
        count(m["pixels"]),
        count(m["corrected"]),
        count(m["uncorrectable"]),
        _spread(median, low, high),
        degrees(m["facet_tilt_deg"]["min"], 1),
        "–" if share["p50"] is None else f"{percent(share['p50'])} ({percent(share['p95'])}, {percent(share['max'])})",
        _spread(width["p50"], width["p05"], width["p95"]),
        degrees(m["azimuthal_arc_deg"]["p50"]),
        degrees(m["zenithal_width_deg"]["p50"]),
        degrees(m["crossover_incidence_deg"]),
        degrees(m["alpha_cut_deg"] or None),
    )


def _spread(median: float | None, low: float | None, high: float | None) -> str:
    if median is None or low is None or high is None:
        return "–"
    return f"{median:.0f}° ({low:.0f}–{high:.0f})"


def _motion(report: Report, facts: SceneFacts, drawn: Sequence[str]) -> str:
    if not drawn:
        return ""
    rows = {entry[0].name: row for row, entry in enumerate(facts.materials)}
    strokes = [stroke(colour, 2.2, dash) for colour, dash in plots.lines(len(drawn))]
    names = legend(
        (f'<path d="M0 7h26" {style}/>', readable(name)) for name, style in zip(drawn, strokes, strict=True)
    )
    charts, sentences = [], []
    advice = heading_advice(report)
    if advice is not None:
        description = "Largest share of glare along a scan line against heading, for each material"
        drawing = plots.headings(report["heading"], drawn, description)
        charts.append(figure(drawing, "Heading: the most glare that a line scanner sees"))
        sentences.append(
            f"A line scanner over level ground, under this sun and with views up to "
            f"{degrees(report['view']['zenith_deg'][2])} from the zenith, sees the least glare heading "
            f"{both_ways(advice.safest_deg)}: at most {percent(advice.safest_share)} of the signal. Heading "
            f"{both_ways(advice.worst_deg)} it would see {percent(advice.worst_share)}, on "
            f"{readable(advice.worst_material)}."
        )
    description = "Azimuthal width on level ground against the time of flight, for each material"
    clock = plots.times_of_day(facts, [rows[name] for name in drawn], description)
    if clock:
        charts.append(figure(clock, "Time of day: azimuthal width on level ground"))
        sentences.append("The lower the sun, the narrower the glare.")
    roof = report["materials"][drawn[0]]["critical_roof"]
    if roof["slope_deg"] is not None:
        sentences.append(
            f"At the scene’s centre, a roof that slopes {degrees(roof['slope_deg'], 1)} towards azimuth "
            f"{degrees(roof['aspect_deg'])} mirrors the sun straight into the camera."
        )
    if not sentences:
        return ""
    plots_side_by_side = f'{names}\n<div class="plots">\n{"".join(charts)}\n</div>' if charts else ""
    return section("How to avoid it, and how it moves", paragraph(" ".join(sentences)), plots_side_by_side)


def _map(azimuthal_width: Array | None) -> str:
    if azimuthal_width is None:
        return ""
    data, top = pictures.width_map(azimuthal_width)
    picture = image(data, "image/png", "Map of the azimuthal width of the glare").replace(
        "<img", '<img class="pixels"'
    )
    ramp = ", ".join(f"rgb{colour}" for colour in pictures.RAMP)
    scale = (
        f'<div class="scale"><span>0°</span><i style="background:linear-gradient(90deg, {ramp})"></i>'
        f"<span>{top:.0f}° and more</span></div>"
    )
    note = paragraph("White: no material with a peak, not assessed, or no half maximum.", "note")
    return section("Azimuthal width, pixel by pixel", f'<div class="wide">{picture}{scale}</div>', note)


def _pixels(report: Report) -> str:
    pixels = report["pixels"]
    total = max(pixels["total"], 1)

    def line(key: str, meaning: str) -> tuple[str, str, float | None, str]:
        if key == "uncertain" and not report["uncertainty_evaluated"]:
            return readable(key), "–", None, f"{meaning}; not evaluated in this run"
        return readable(key), count(pixels[key]), pixels[key] / total, meaning

    return section(
        "What became of each pixel",
        paragraph(f"Of {count(pixels['total'])} pixels {count(pixels['valid'])} hold data. Each has one state:"),
        counts(line(key, meaning) for key, meaning in STATES.items()),
        paragraph("and any number of flags:"),
        counts(line(key, meaning) for key, meaning in FLAGS.items()),
    )


def _trust(report: Report) -> str:
    simplified, skipped, quantiles = report["simplified"], report["skipped"], report["quantiles"]
    every = quantiles["every_rows"]
    rows = "all rows" if every == 1 else f"one row in {every}"
    return section(
        "How far to trust this",
        paragraph(
            f"Simplified model: in {count(simplified['pixels_g_below_one'])} pixels the geometric "
            f"attenuation factor is below one. Leaving it out would change a reflectance by up to "
            f"{percent(simplified['max_relative_difference'], 1)}."
        ),
        paragraph(
            f"Skipped: {count(skipped['pixels_out_of_lobe'])} pixels were not computed since they are "
            f"certainly outside of the lobe; no result depends on that."
        ),
        paragraph(
            f"Counts are exact. Quantiles and extremes are of {rows} of the image; quantiles are read from "
            f"histograms, to within {quantiles['incidence_bin_deg']}° of incidence, "
            f"{quantiles['facet_tilt_bin_deg']}° of tilt and {100 * quantiles['specular_share_bin']} % of "
            f"share. A quantile of a width is the width at a quantile of incidence."
        ),
    )


def _footer(report: Report) -> str:
    stages = [f"{name} {value:.2f} s" for name, value in report["seconds"].items() if value is not None]
    speed = report["mpixel_per_s"]
    numbers = [*stages, *([f"{speed:.1f} million pixels a second"] if speed else [])]
    text = f"{', '.join(numbers)}; at most {report['peak_rss_mb']:.0f} MB of memory."
    return f"<footer>{paragraph(text, 'note')}</footer>"
