"""The page of a batch: all scenes, the worst first; each material across flight lines; where scenes overlap."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import NamedTuple
from urllib.parse import quote

from tscorr.report.markup import document, paragraph, section, tile
from tscorr.report.words import Report, count, degrees, glare_fraction, listed, percent, readable


@dataclass(frozen=True, slots=True)
class SceneLine:
    """One scene of a batch, for the page."""

    name: str
    state: str
    """done, current, failed, or earlier: of a run before this one"""
    folder: str
    """relative to the page"""
    error: str = ""
    report: Report | None = None
    """the content of its report.json"""


class Difference(NamedTuple):
    """How much two images of the same ground differ."""

    pixels: int
    rmse_before: float
    """root mean square difference of reflectance factors over bands and pixels"""
    rmse_after: float
    """the same of the corrected images"""


@dataclass(frozen=True, slots=True)
class Overlap:
    """Two scenes that show the same ground."""

    first: str
    second: str
    materials: Mapping[str, Difference] = field(default_factory=dict)


class Cell(NamedTuple):
    """A cell of a sortable table: what is shown, as ready HTML, and what it is sorted by."""

    shown: str
    key: float | str
    is_text: bool = False


SORT_SCRIPT = """<script>
for (const table of document.querySelectorAll("table.sortable")) {
  table.querySelectorAll("thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") === "descending";
      table.querySelectorAll("thead th").forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const key = row => row.cells[column].dataset.key;
      const order = (a, b) => isNaN(a) || isNaN(b) ? a.localeCompare(b) : a - b;
      const rows = [...table.tBodies[0].rows].sort((a, b) => order(key(a), key(b)) * (up ? 1 : -1));
      table.tBodies[0].append(...rows);
    });
  });
}
</script>"""
SORT_STYLE = """<style>
.sortable button { all: unset; cursor: pointer; font-weight: 600; }
.sortable button:focus-visible { outline: 2px solid var(--accent); }
.sortable th[aria-sort] button::after { content: " ▾"; }
.sortable th[aria-sort="ascending"] button::after { content: " ▴"; }
.sortable th[scope="row"] { min-width: 9rem; }
.sortable .text { text-align: left; white-space: normal; overflow-wrap: anywhere; }
.standfirst, .failed { overflow-wrap: anywhere; }
@media (max-width: 640px) { .sortable .text { text-align: right; } }
</style>"""

STATES = {"done": "done", "current": "was current", "earlier": "of an earlier run", "failed": "failed"}


def batch_page(title: str, scenes: Sequence[SceneLine], overlaps: Sequence[Overlap] = (), version: str = "") -> str:
    """The page of a batch, as HTML in one file; readable without its few lines of script.

    title    : of the configuration; may be empty.
    overlaps : scenes that show the same ground, with the differences of their images.
    """
    parts = (
        SORT_STYLE,
        _header(title or "tscorr", scenes, version),
        _failures(scenes),
        _scenes(scenes),
        _overlaps(overlaps),
        _materials(scenes),
        SORT_SCRIPT,
    )
    return document(title or "tscorr", "\n".join(part for part in parts if part))


def scene_glare(report: Report) -> float:
    """Part of a scene's valid pixels in which at least a tenth of the signal was glare."""
    return sum(_touched(entry) for entry in report["materials"].values()) / max(1, report["pixels"]["valid"])


def _touched(material: Report) -> float:
    """Pixels of a material in which at least a tenth of the signal was glare."""
    assessed = sum(material[state] for state in ("negligible", "corrected", "uncorrectable"))
    return glare_fraction(material) * assessed


def _header(title: str, scenes: Sequence[SceneLine], version: str) -> str:
    reports = [scene.report for scene in scenes if scene.report is not None]
    failed = [scene.name for scene in scenes if scene.state == "failed"]
    pixels, corrected, lost = (
        sum(report["pixels"][key] for report in reports) for key in ("valid", "corrected", "uncorrectable")
    )
    tiles = (
        tile("Scenes", count(len(scenes)), f"{len(failed)} failed" if failed else "none failed"),
        tile("Pixels with something to remove", percent((corrected + lost) / max(1, pixels)), f"of {count(pixels)}"),
        tile("Beyond correction", count(lost), f"{percent(lost / max(1, pixels), 1)} of the pixels"),
        tile("Time", f"{sum(report['seconds']['wall'] or 0 for report in reports):.0f} s", "for all scenes"),
    )
    return (
        f"<header>\n{paragraph(f'Batch report by tscorr {version}', 'kicker')}\n<h1>{escape(title)}</h1>\n"
        f"{paragraph(_headline(scenes), 'standfirst')}\n</header>\n"
        f'<div class="tiles">\n{"".join(tiles)}\n</div>'
    )


def _headline(scenes: Sequence[SceneLine]) -> str:
    """What one should know first."""
    failed = [scene.name for scene in scenes if scene.state == "failed"]
    seen = [(scene_glare(scene.report), scene.name) for scene in scenes if scene.report is not None]
    sentences = []
    if failed:
        shown = [*failed[:3], f"{len(failed) - 3} more"] if len(failed) > 3 else failed
        sentences.append(f"{listed(shown)} failed.")
    if seen:
        worst, name = max(seen)
        sentences.append(
            f"The most glare is in {name}: at least a tenth of the signal in {percent(worst)} of its pixels."
        )
    return " ".join(sentences)


def _failures(scenes: Sequence[SceneLine]) -> str:
    lines = (paragraph(f"{scene.name}: {scene.error}", "failed") for scene in scenes if scene.error)
    return section("What failed", *lines)


def _scenes(scenes: Sequence[SceneLine]) -> str:
    head = ("scene", "glare", "corrected", "beyond correction", "not assessed", "sun", "views", "glare left", "state")
    rows = [_scene_row(scene) for scene in sorted(scenes, key=_worst_first)]
    note = paragraph(
        "The worst first. Glare: the part of the pixels in which at least a tenth of the signal was the sun's "
        "reflection. Sun and views: from the zenith. Glare left: RMS error against the truth after the correction "
        "over that before, where a scene has a truth.",
        "note",
    )
    return section("Scenes", sortable_table(head, rows), note)


def _worst_first(scene: SceneLine) -> tuple[int, float, str]:
    glare = scene_glare(scene.report) if scene.report is not None else 0.0
    return 0 if scene.state == "failed" else 1, -glare, scene.name


def _scene_row(scene: SceneLine) -> list[Cell]:
    report, name = scene.report, escape(scene.name)
    state = _text(STATES[scene.state], scene.state)
    if report is None:
        return [Cell(name, scene.name), *[Cell("–", -1)] * 7, state]
    pixels, (low, _, high) = report["pixels"], report["view"]["zenith_deg"]
    left = (report.get("residual_glare") or {}).get("ratio")
    parts = (pixels[key] / max(1, pixels["valid"]) for key in ("corrected", "uncorrectable"))
    return [
        Cell(f'<a href="{escape(quote(scene.folder))}/report.html">{name}</a>', scene.name),
        _share(scene_glare(report)),
        *(_share(part, 1) for part in parts),
        _share(pixels["not_assessed"] / max(1, pixels["total"])),
        Cell(degrees(report["sun"]["zenith_deg"], 1), report["sun"]["zenith_deg"]),
        Cell(f"{degrees(low)} to {degrees(high)}", high),
        _share(left, 1),
        state,
    ]


def _overlaps(overlaps: Sequence[Overlap]) -> str:
    rows = sorted(
        (
            (overlap, name, difference)
            for overlap in overlaps
            for name, difference in overlap.materials.items()
            if difference.pixels
        ),
        key=lambda row: -row[2].rmse_after,
    )
    if not rows:
        return ""
    head = ("scenes", "material", "pixels compared", "RMSE before", "RMSE after", "after / before")
    cells = [
        [
            _text(f"{overlap.first}, {overlap.second}", f"{overlap.first}, {overlap.second}"),
            _text(readable(name), name),
            Cell(count(difference.pixels), difference.pixels),
            Cell(f"{difference.rmse_before:.4f}", difference.rmse_before),
            Cell(f"{difference.rmse_after:.4f}", difference.rmse_after),
            _share(difference.rmse_after / difference.rmse_before if difference.rmse_before else None),
        ]
        for overlap, name, difference in rows
    ]
    note = paragraph(
        "The same ground in two scenes: root mean square difference of their reflectance factors over the bands, "
        "before and after the correction. Compared are pixels that are assessed in both and corrected in at least "
        "one, neither saturated nor beyond correction, from windows spread over the overlap. What is left includes "
        "noise, misregistration, and other light at another time.",
        "note",
    )
    return section("Where scenes overlap", sortable_table(head, cells), note)


def _materials(scenes: Sequence[SceneLine]) -> str:
    lines = [
        (name, scene.name, entry)
        for scene in scenes
        if scene.report is not None
        for name, entry in scene.report["materials"].items()
        if entry["zenithal_width_deg"]["p50"] is not None
    ]
    if not lines:
        return ""
    head = ("material", "scene", "pixels", "glare", "share removed", "incidence", "azimuthal width", "smallest tilt")
    rows = [
        [
            _text(readable(name), name),
            _text(scene, scene),
            Cell(count(entry["pixels"]), entry["pixels"]),
            _share(glare_fraction(entry)),
            _share(entry["specular_share"]["p50"]),
            _angle(entry["incidence_deg"][1]),
            _angle(entry["azimuthal_width_deg"]["p50"]),
            _angle(entry["facet_tilt_deg"]["min"], 1),
        ]
        for name, scene, entry in sorted(lines, key=lambda line: (line[0], -glare_fraction(line[2]), line[1]))
    ]
    note = paragraph(
        "Each material in every scene, the scene with the most glare first; share removed, incidence and width are "
        "medians over its pixels. A width that differs between flight lines comes from the sun and from the slopes "
        "that each line shows.",
        "note",
    )
    return section("The same material across scenes", sortable_table(head, rows), note)


def _text(shown: str, key: str) -> Cell:
    return Cell(escape(shown), key, is_text=True)


def _share(fraction: float | None, digits: int = 0) -> Cell:
    return Cell(escape(percent(fraction, digits)), -1 if fraction is None else fraction)


def _angle(angle_deg: float | None, digits: int = 0) -> Cell:
    return Cell(degrees(angle_deg, digits), -1 if angle_deg is None else angle_deg)


def sortable_table(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table whose columns the script of the page sorts; on a phone each row becomes a list."""
    texts = [cell.is_text for cell in rows[0]] if rows else [False] * len(head)
    heads = "".join(
        f'<th scope="col"{TEXT if is_text else ""}>{escape(label)}</th>'
        for label, is_text in zip(head, texts, strict=True)
    )
    lines = "\n".join(_line(head, row) for row in rows)
    return f'<table class="sortable">\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{lines}\n</tbody>\n</table>'


TEXT = ' class="text"'


def _line(head: Sequence[str], row: Sequence[Cell]) -> str:
    first, *rest = row
    cells = "".join(
        f'<td{TEXT if cell.is_text else ""} data-label="{escape(label)}" data-key="{escape(str(cell.key))}">'
        f"{cell.shown}</td>"
        for label, cell in zip(head[1:], rest, strict=True)
    )
    return f'<tr><th scope="row" data-key="{escape(str(first.key))}">{first.shown}</th>{cells}</tr>'
