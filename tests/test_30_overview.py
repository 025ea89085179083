"""report.overview: the page of a batch, as a person and as a browser see it."""

import html
import json
import re
import shutil
import subprocess

import pytest

from tscorr.report import Difference, Overlap, SceneLine, batch_page
from tscorr.report.overview import scene_glare

HOSTILE = "<img src=x onerror=alert(1)>&\"'"
LONG = "strip_17_2026-06-21_a_name_of_a_flight_line_without_any_blank_in_it"


def material(glare, *, pixels=1000, width=42.0):
    """What report.json says of a material, as far as the page asks."""
    return {
        "pixels": pixels,
        "negligible": 200,
        "corrected": 700,
        "uncorrectable": 100,
        "incidence_deg": [20.0, 40.0, 60.0],
        "facet_tilt_deg": {"min": 1.2, "p05": 2.0, "p50": 10.0},
        "specular_share": {"p50": 0.3, "p95": 0.5, "max": 0.9, "above": [{"specular_share": 0.1, "fraction": glare}]},
        "azimuthal_width_deg": {"p05": 20.0, "p50": width, "p95": 90.0, "none_fraction": 0.0},
        "zenithal_width_deg": {"p05": 41.0, "p50": 41.0 if width else None, "p95": 41.0, "none_fraction": 0.0},
    }


def scene(name, glare, **changes):
    """A finished scene, of 4000 valid pixels, 1000 of which are of the material that shines."""
    report = {
        "pixels": {"total": 5000, "valid": 4000, "corrected": 700, "uncorrectable": 100, "not_assessed": 1000},
        "sun": {"zenith_deg": 39.44},
        "view": {"zenith_deg": [5.0, 20.0, 40.0]},
        "materials": {"roof_tile": material(glare), "lawn": material(0.0, width=None)},
        "seconds": {"wall": 3.0},
        "residual_glare": {"ratio": 0.07},
    }
    return SceneLine(name, "done", name, report=report, **changes)


def failed(name=LONG):
    return SceneLine(name, "failed", name, error=f"/data/{LONG}/{LONG}/{LONG}.tif cannot be read at rows 0 to 512")


def rows(page, title):
    """The texts of the rows of the table under a heading."""
    table = page.split(f"<h2>{title}</h2>")[1].split("</tbody>")[0].split("<tbody>")[1]
    cells = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in table.split("<tr>")[1:]]
    return [[html.unescape(re.sub(r"<[^>]*>", "", cell)) for cell in row] for row in cells]


def test_the_worst_scene_comes_first():
    page = batch_page("city", [scene("mild", 0.1), scene("bad", 0.6), failed(), scene("none", 0.0)])
    assert [row[0] for row in rows(page, "Scenes")] == [LONG, "bad", "mild", "none"]


def test_glare_counts_assessed_pixels():
    """0.6 of the 1000 assessed pixels of the tile, of 4000 valid ones."""
    assert scene_glare(scene("a", 0.6).report) == pytest.approx(0.15)
    page = batch_page("city", [scene("a", 0.6)])
    row = ["a", "15 %", "17.5 %", "2.5 %", "20 %", "39.4°", "5° to 40°", "7.0 %", "done"]
    assert rows(page, "Scenes") == [row]
    assert "The most glare is in a: at least a tenth of the signal in 15 % of its pixels." in page


def test_what_failed_is_said_with_its_reason():
    page = batch_page("city", [failed("x"), scene("a", 0.1), SceneLine("b", "failed", "b", error="no sun")])
    assert "x and b failed." in page
    assert "b: no sun" in page
    assert "2 failed" in page
    assert 'href="x/report.html"' not in page


def test_materials_are_compared_across_scenes():
    page = batch_page("city", [scene("one", 0.2), scene("two", 0.4)])
    table = rows(page, "The same material across scenes")
    assert [row[:4] for row in table] == [
        ["roof tile", "two", "1\u202f000", "40 %"],
        ["roof tile", "one", "1\u202f000", "20 %"],
    ]
    assert table[0][6] == "42°"


def test_overlaps_are_shown_the_largest_rest_first():
    found = {
        "roof_tile": Difference(1200, 0.1, 0.01),
        "red_aluminum": Difference(90, 0.2, 0.05),
        "x": Difference(0, 0, 0),
    }
    page = batch_page("city", [scene("a", 0.2), scene("b", 0.4)], [Overlap("a", "b", found)])
    assert rows(page, "Where scenes overlap") == [
        ["a, b", "red aluminum", "90", "0.2000", "0.0500", "25 %"],
        ["a, b", "roof tile", "1\u202f200", "0.1000", "0.0100", "10 %"],
    ]
    assert "Where scenes overlap" not in batch_page("city", [scene("a", 0.2)])
    same = Overlap("a", "b", {"roof_tile": Difference(5, 0.0, 0.0)})
    assert rows(batch_page("city", [], [same]), "Where scenes overlap")[0][-1] == "–"


def test_text_of_others_is_text():
    lines = [scene(HOSTILE, 0.2), SceneLine(HOSTILE, "failed", HOSTILE, error=HOSTILE)]
    page = batch_page(HOSTILE, lines, [Overlap(HOSTILE, "b", {HOSTILE: Difference(5, 0.1, 0.1)})])
    assert "<img" not in page
    assert page.count("<script>") == 1
    links = re.findall(r'href="([^"]*)"', page)
    assert links == ["%3Cimg%20src%3Dx%20onerror%3Dalert%281%29%3E%26%22%27/report.html"]


def test_an_empty_batch_and_one_without_title_have_a_page():
    assert "<h1>tscorr</h1>" in batch_page("", [])


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PROBE = """<script>addEventListener("load", () => {
  const clipped = [...document.querySelectorAll("body *")].filter(e =>
    e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== "inline" && e.clientWidth > 0);
  const names = () => [...document.querySelector("table").tBodies[0].rows].map(row => row.cells[0].textContent);
  const before = names();
  const heads = document.querySelectorAll("table thead button");
  heads[1].click();
  const by_glare = names();
  heads[1].click();
  const turned = names();
  heads[0].click();
  document.title = JSON.stringify({
    width: innerWidth,
    overflow: document.documentElement.scrollWidth - innerWidth,
    clipped: clipped.map(e => e.outerHTML.slice(0, 80)),
    before, by_glare, turned, by_name: names()});
});</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_shows_and_sorts_it(tmp_path, width):
    overlap = Overlap("a", LONG, {"red_aluminum": Difference(90, 0.2, 0.05)})
    page = batch_page("city", [scene("b", 0.1), scene("a", 0.6), failed(), scene("c", 0.0)], [overlap], "1.0")
    # Chromium's windows are at least 500 wide: the page is looked at through a frame.
    inner = (page + PROBE).replace("document.title =", "parent.document.body.dataset.found =")
    framed = html.escape(inner, quote=True)
    file = tmp_path / "page.html"
    file.write_text(f'<body><iframe width="{width}" height="900" frameborder="0" srcdoc="{framed}"></iframe>', "utf-8")
    result = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
         "--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000",
         "--window-size=1400,1000", "--dump-dom", file.as_uri()],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert "CONSOLE" not in result.stderr
    found = json.loads(html.unescape(re.search(r'data-found="([^"]*)"', result.stdout)[1]))
    assert found["width"] == width
    assert found["overflow"] <= 0
    assert found["clipped"] == []
    assert found["before"] == [LONG, "a", "b", "c"]
    assert found["by_glare"] == ["a", "b", "c", LONG]
    assert found["turned"] == [LONG, "c", "b", "a"]
    assert found["by_name"] == [LONG, "c", "b", "a"]
