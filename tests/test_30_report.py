"""report: exact counts, quantiles within a bin, sentences and a page that a browser shows whole."""

import dataclasses
import html
import json
import math
import re
import shutil
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from tscorr import angles
from tscorr.correction import SINGLE_FLAGS, BlockInputs, Corrector, Rules, Stored, add_tally, new_tally
from tscorr.materials import material
from tscorr.report import SceneFacts, page, summary, write_json
from tscorr.report.histograms import above, quantile
from tscorr.report.plots import phong_width
from tscorr.report.words import heading_advice, headline, percent
from tscorr.width import azimuthal_width, lobe_shape

BANDS, ROWS, COLS = 2, 90, 300
SUN = (42.0, 200.0)
NAMES = ("red_concrete", "red_aluminum", "lambertian")

# Scene inputs from which everything that is asserted can be computed without the report.


@pytest.fixture(scope="module")
def scene():
    """A block of random roofs: inputs, and the incidence [deg] of each pixel."""
    rng = np.random.default_rng(7)
    shape = (ROWS, COLS)
    normal = angles.unit_vector(rng.uniform(0, 35, shape), rng.uniform(0, 360, shape))
    view = angles.unit_vector(rng.uniform(0, 40, shape), rng.uniform(-40, 80, shape))
    sun = angles.unit_vector(*SUN)[:, None, None]
    image = rng.integers(500, 4000, (BANDS, *shape)).astype(np.int16)
    image[:, rng.random(shape) < 0.02] = -1
    image[0, rng.random(shape) < 0.01] = 9500
    cosine = (normal * sun).sum(axis=0)
    return {
        "image": image,
        "material": rng.integers(0, 4, shape).astype(np.uint8),
        "sun": sun,
        "view": view,
        "normal": normal,
        "shadowed": rng.random(shape) < 0.05,
        "hidden": rng.random(shape) < 0.03,
    }, np.rad2deg(np.arccos(cosine))


def materials():
    return [(material(name), material(name).at(bands=BANDS), Rules(direct_fraction=(0.8, 0.9))) for name in NAMES]


def corrected(scene, cuts, *, backwards=False):
    """Flags, and the tally over blocks between `cuts` along the columns."""
    corrector = Corrector(
        materials(),
        Stored(dtype=np.dtype(np.int16), scale=(1e-4,) * 2, offset=(0.0,) * 2, nodata=-1, saturation=(9000,) * 2),
    )
    flags, total = np.zeros((ROWS, COLS), np.uint16), new_tally(len(NAMES) + 1, BANDS)
    blocks = [slice(a, b) for a, b in pairwise(cuts)]
    for block in reversed(blocks) if backwards else blocks:
        pieces = {key: value if value.shape[-1] == 1 else value[..., block].copy() for key, value in scene[0].items()}
        result = corrector(BlockInputs(**pieces))
        flags[:, block] = result.flags
        add_tally(total, result.tally)
    return flags, total


def sun_at(minutes):
    """A sun that turns by a quarter of a degree a minute at a constant height."""
    minutes = np.asarray(minutes, dtype=float)
    return np.full_like(minutes, SUN[0]), (SUN[1] + minutes / 4) % 360


def facts_of(scene, flags, tally, **changes):
    zenith, azimuth = angles.zenith_azimuth(scene[0]["view"][:, ::10, ::10])
    facts = SceneFacts(
        scene="roofs",
        image="roofs.tif",
        bands=("green", "red"),
        wavelengths_um=(0.55, 0.66),
        materials=materials(),
        tally=tally,
        tally_stride=1,
        flag_counts={flag.name: int(np.count_nonzero(flags & flag)) for flag in SINGLE_FLAGS},
        skipped={
            "blocks": 4,
            "blocks_no_specular_material": 1,
            "blocks_out_of_reach": 0,
            "blocks_shadow_or_nodata": 0,
        },
        uncertainty_evaluated=False,
        solar_zenith_deg=SUN[0],
        solar_azimuth_deg=SUN[1],
        convergence_deg=0.7,
        sun_at=sun_at,
        view_zenith_deg=zenith,
        view_azimuth_deg=azimuth,
        relative_azimuth_deg=angles.relative_azimuth(azimuth, SUN[1]),
        centre_view_deg=(30.0, 35.0),
        seconds={"wall": 2.0, "read": 0.5, "geometry": 0.4, "kernel": 0.3, "write": 0.6},
        peak_rss_mb=280.0,
        version="0.0",
    )
    return dataclasses.replace(facts, **changes)


@pytest.fixture(scope="module")
def flags_and_tally(scene):
    return corrected(scene, [0, COLS])


@pytest.fixture(scope="module")
def facts(scene, flags_and_tally):
    return facts_of(scene, *flags_and_tally)


@pytest.fixture(scope="module")
def report(facts):
    return summary(facts)


# The keys that are promised; more may be added, none renamed.

FLAG_KEYS = {
    "nodata", "no_material", "self_shadow", "cast_shadow", "not_viewed", "grazing",
    "saturated", "clipped", "uncertain", "normal_unreliable", "low_confidence",
}  # fmt: skip
PROMISED = {
    "": {
        "scene", "image", "tscorr", "pixels", "skipped", "sun", "view", "materials", "heading", "simplified",
        "seconds", "peak_rss_mb", "mpixel_per_s",
    },
    "pixels": {"total", "valid", "evaluated", "negligible", "corrected", "uncorrectable", "not_assessed"} | FLAG_KEYS,
    "skipped": {
        "blocks", "blocks_no_specular_material", "blocks_out_of_reach", "blocks_shadow_or_nodata",
        "pixels_out_of_lobe",
    },
    "sun": {"zenith_deg", "azimuth_deg", "convergence_deg"},
    "view": {"zenith_deg", "relative_azimuth_deg"},
    "simplified": {"pixels_g_below_one", "max_relative_difference"},
    "seconds": {"wall", "read", "geometry", "kernel", "write"},
}  # fmt: skip
PROMISED_OF_A_MATERIAL = {
    "": {
        "pixels", "corrected", "uncorrectable", "incidence_deg", "facet_tilt_deg", "specular_share",
        "removed_mean", "azimuthal_width_deg", "azimuthal_arc_deg", "zenithal_width_deg", "width_at",
        "crossover_incidence_deg", "alpha_cut_deg", "critical_roof", "sensitivity",
        "level_spot_m",
    },
    "facet_tilt_deg": {"min", "p05", "p50"},
    "specular_share": {"p50", "p95", "max"},
    "azimuthal_width_deg": {"p05", "p50", "p95", "none_fraction"},
    "azimuthal_arc_deg": {"p05", "p50", "p95", "none_fraction"},
    "zenithal_width_deg": {"p05", "p50", "p95", "none_fraction"},
    "critical_roof": {"slope_deg", "aspect_deg"},
}  # fmt: skip


def test_promised_keys(report):
    for key, promised in PROMISED.items():
        assert promised <= set(report[key] if key else report), key
    assert list(report["materials"]) == list(NAMES)
    for values in report["materials"].values():
        for key, promised in PROMISED_OF_A_MATERIAL.items():
            assert promised <= set(values[key] if key else values), key
        assert [row["incidence_deg"] for row in values["width_at"]] == list(range(10, 75, 5))
        assert len(values["incidence_deg"]) == 3
        assert len(values["removed_mean"]) == BANDS
    assert [row["heading_deg"] for row in report["heading"]] == list(range(0, 360, 10))
    assert set(report["heading"][0]) == {"heading_deg", "min_facet_tilt_deg", "max_specular_share"}


def test_counts_are_those_of_the_flags(scene, flags_and_tally, report):
    flags, _ = flags_and_tally
    state = (flags >> 6) & 3
    pixels = report["pixels"]
    assert pixels["total"] == flags.size
    assert pixels["valid"] == np.count_nonzero(flags & 1 == 0)
    assert pixels["evaluated"] == np.count_nonzero(state != 3)
    for value, name in enumerate(("negligible", "corrected", "uncorrectable", "not_assessed")):
        assert pixels[name] == np.count_nonzero(state == value)
    for flag in SINGLE_FLAGS:
        assert pixels[flag.name.lower()] == np.count_nonzero(flags & flag)
    for row, name in enumerate(NAMES, 1):
        mine = scene[0]["material"] == row
        assert report["materials"][name]["pixels"] == np.count_nonzero(mine)
        assert report["materials"][name]["corrected"] == np.count_nonzero(mine & (state == 1))
        assert report["materials"][name]["uncorrectable"] == np.count_nonzero(mine & (state == 2))


@pytest.mark.parametrize("backwards", [False, True])
def test_blocks_and_their_order_do_not_matter(scene, report, backwards):
    # Cuts at multiples of the kernel's chunk: what is skipped depends on where chunks begin.
    flags, tally = corrected(scene, [0, 128, 256, COLS], backwards=backwards)
    assert summary(facts_of(scene, flags, tally)) == report


@pytest.mark.parametrize("q", [0.0, 0.05, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("size", [1, 2, 37, 5000])
def test_quantile_is_within_a_bin_of_numpy(q, size):
    values = np.random.default_rng(size).gamma(2, 9, size)
    counts = np.bincount((values / 0.25).astype(int), minlength=2000)
    assert abs(quantile(counts, q, 0.25) - np.quantile(values, q, method="inverted_cdf")) <= 0.25


def test_quantile_of_nothing_is_nan():
    assert np.isnan(quantile(np.zeros(5, int), 0.5, 1.0))


def test_above_splits_the_bin_of_the_threshold():
    assert above(np.array([4, 4, 4]), 0.75, 0.5).tolist() == [0, 2, 4]


@pytest.mark.parametrize("row", [1, 2])
def test_quantiles_are_those_of_the_pixels(scene, flags_and_tally, report, row):
    flags, _ = flags_and_tally
    assessed = (scene[0]["material"] == row) & ((flags >> 6) & 3 != 3)
    incidence = scene[1][assessed]
    values = report["materials"][NAMES[row - 1]]
    expected = np.quantile(incidence, [0.05, 0.5, 0.95], method="inverted_cdf")
    assert np.abs(np.array(values["incidence_deg"]) - expected).max() <= 0.2501

    lobe = lobe_shape(material(NAMES[row - 1]))
    widths = azimuthal_width(lobe, incidence)
    none = np.isnan(widths).mean()
    in_the_bin_of_the_edge = 0.005
    assert abs(values["azimuthal_width_deg"]["none_fraction"] - none) < in_the_bin_of_the_edge
    with_width = np.sort(incidence[~np.isnan(widths)])
    for key, q in (("p05", 0.95), ("p50", 0.5), ("p95", 0.05)):
        place = np.quantile(with_width, q, method="inverted_cdf") + np.array([0.3, -0.3])
        low, high = azimuthal_width(lobe, place)
        width, arc = values["azimuthal_width_deg"][key], values["azimuthal_arc_deg"][key]
        assert low <= width <= high
        assert low * np.sin(np.deg2rad(place[0])) <= arc <= high * np.sin(np.deg2rad(place[1]))


def test_removed_mean_and_shares(scene, facts, report):
    values = report["materials"]["red_concrete"]
    touched = values["corrected"] + values["uncorrectable"]
    assert facts.tally.share[1].sum() == touched
    for row in values["specular_share"]["above"]:
        part = facts.tally.share[1][int(row["specular_share"] * 200 + 0.5) :].sum()
        assessed = values["pixels"] - values["not_assessed"]
        assert row["fraction"] == pytest.approx(part / assessed, rel=1e-5)
    before = scene[0]["image"][:, scene[0]["material"] == 1]
    assert 0 < values["removed_mean"][0] < before.max() * 1e-4
    assert values["removed_mean"][1] / values["removed_mean"][0] == pytest.approx(0.9 / 0.8, rel=0.05)


def test_minutes_until_the_sun_has_turned_by_half_a_width(report):
    for name in NAMES[:2]:
        width = float(azimuthal_width(material(name), SUN[0]))
        assert report["materials"][name]["level_width_deg"] == pytest.approx(width, rel=1e-5)
        assert report["materials"][name]["half_width_minutes"] == pytest.approx(4 * width / 2, rel=1e-5)
    assert report["sun"]["drift_deg_per_hour"] == {"zenith": 0.0, "azimuth": pytest.approx(15)}


def test_critical_roof_mirrors_the_sun_into_the_camera(report):
    roof = report["materials"]["red_concrete"]["critical_roof"]
    normal, sun = angles.unit_vector(roof["slope_deg"], roof["aspect_deg"]), angles.unit_vector(*SUN)
    mirrored = 2 * (normal @ sun) * normal - sun
    assert mirrored == pytest.approx(angles.unit_vector(30.0, 35.0), abs=1e-5)


def test_safest_heading_is_along_the_sun(report):
    advice = heading_advice(report)
    assert advice.safest_deg == 20  # the sun is at 200
    assert advice.worst_deg == 110
    assert advice.safest_share < advice.worst_share


def test_phong_lobe_keeps_its_angle_to_the_mirror_direction():
    lobe, incidence = lobe_shape(material("red_concrete")), np.array([20.0, 30.0, 50.0, 70.0])
    width = phong_width(lobe, "full", incidence)
    mirror = angles.unit_vector(incidence, np.zeros(4))
    edge = angles.unit_vector(incidence, width / 2)
    rho = np.arccos((mirror * edge).sum(axis=0))
    assert rho == pytest.approx(rho[0])
    true_width = azimuthal_width(lobe, incidence)
    assert width[1] == pytest.approx(true_width[1])
    assert (width[2:] > true_width[2:]).all()
    assert np.isnan(phong_width(lobe, "full", np.array([2.0]))).all()


def test_json_is_strict_and_comes_back(report, tmp_path):
    write_json(report, tmp_path / "report.json")
    text = (tmp_path / "report.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=pytest.fail) == report


def empty_scene(scene):
    """Nothing known: no material, no view, no path of the sun."""
    tally, nothing = new_tally(1, BANDS), np.full((3, 3), np.nan)
    tally.states[0, 3] = 12
    flags = np.full((3, 4), 2 | 3 << 6, np.uint16)
    return facts_of(
        scene,
        flags,
        tally,
        materials=[],
        sun_at=None,
        view_zenith_deg=nothing,
        view_azimuth_deg=nothing,
        relative_azimuth_deg=nothing,
        centre_view_deg=None,
        seconds={},
    )


def test_a_scene_without_anything(scene):
    facts = empty_scene(scene)
    report = summary(facts)
    assert report["pixels"]["no_material"] == report["pixels"]["total"] == 12
    assert report["heading"] == []
    assert report["mpixel_per_s"] is None
    assert "Nothing was assessed in this scene" in page(report, facts)


def test_a_material_that_is_not_in_the_scene(scene):
    tally = new_tally(len(NAMES) + 1, BANDS)
    report = summary(facts_of(scene, np.zeros((1, 1), np.uint16), tally))
    values = report["materials"]["red_concrete"]
    assert values["incidence_deg"] == [None] * 3
    assert values["specular_share"]["p95"] is values["facet_tilt_deg"]["min"] is None
    assert values["azimuthal_width_deg"] == {"p05": None, "p50": None, "p95": None, "none_fraction": None}


@pytest.mark.parametrize(
    ("fraction", "words"),
    [(0.0, "0 %"), (0.001, "< 1 %"), (0.124, "12 %"), (0.999, "> 99 %"), (1.0, "100 %"), (None, "–")],
)
def test_percentages_do_not_round_to_nothing_or_all(fraction, words):
    assert percent(fraction) == words


# The page


@pytest.fixture(scope="module")
def quicklook(tmp_path_factory):
    from PIL import Image

    path = tmp_path_factory.mktemp("pictures") / "quicklook.png"
    noise = np.random.default_rng(0).integers(0, 255, (300, 2400, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    return path


@pytest.fixture(scope="module")
def whole_page(scene, facts, report, quicklook):
    return page(report, facts, quicklook, np.where(scene[1] > 20, scene[1], np.nan))


def test_page_opens_with_the_finding(report, whole_page):
    assert headline(report).startswith("Glare touches ")
    assert html.escape(headline(report)) in whole_page
    share = next(
        row for row in report["materials"]["red_concrete"]["specular_share"]["above"] if row["specular_share"] == 0.1
    )
    assert f"{100 * share['fraction']:.0f} % of red concrete" in headline(report)


def test_page_needs_nothing_from_elsewhere(whole_page):
    assert "<script" not in whole_page
    targets = re.findall(r'(?:src|href|url)\s*[=(]\s*"?([^"\s>)]*)', whole_page)
    assert {target for target in targets if not target.startswith("data:")} == {"quicklook.png"}
    assert len(whole_page) < 1_500_000


def test_names_are_escaped(facts):
    hostile = '<script>alert("x")</script>'
    named = [(dataclasses.replace(m, name=hostile, source=hostile), *rest) for m, *rest in facts.materials[:1]]
    changed = dataclasses.replace(facts, scene=hostile, image=hostile, materials=named)
    text = page(summary(changed), changed)
    assert "<script" not in text
    assert html.escape(hostile).replace("_", " ") in text


def test_matplotlib_is_not_imported():
    code = "import sys, tscorr.report; sys.exit(any(m in sys.modules for m in ('matplotlib', 'PIL', 'rasterio')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PROBE = """<script>addEventListener("load", () => {
  const clipped = [...document.querySelectorAll("body *:not(svg *)")].filter(e =>
    e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== "inline" && e.clientWidth > 0);
  const letters = [...document.querySelectorAll("svg.plot text")].filter(e => {
    const a = e.getBoundingClientRect(), b = e.closest("svg.plot").getBoundingClientRect();
    return a.left < b.left - 1 || a.right > b.right + 1 || a.top < b.top - 1 || a.bottom > b.bottom + 1; });
  document.title = JSON.stringify({
    width: innerWidth,
    overflow: document.documentElement.scrollWidth - innerWidth,
    clipped: clipped.map(e => e.outerHTML.slice(0, 80)),
    letters: letters.map(e => e.textContent),
    images: [...document.images].map(i => i.complete && i.naturalWidth > 0),
    plots: document.querySelectorAll("svg.plot").length});
});</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
@pytest.mark.parametrize("width", [1280, 500, 400])
def test_a_browser_shows_all_of_it(whole_page, tmp_path, width):
    # Chromium's windows are at least 500 wide: the page is looked at through a frame.
    inner = (PROBE + whole_page).replace("document.title =", "parent.document.body.dataset.found =")
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
    assert found["letters"] == []
    assert found["images"] == [True, True]
    assert found["plots"] == 3 * 2 + 2


def test_spot_of_a_camera_is_where_the_exponential_is_above_half(facts):
    """Level ground 1000 m under a camera, the sun in the south; the report is of first order in the width."""
    report = summary(dataclasses.replace(facts, camera_height_m=1000.0))
    sun = angles.unit_vector(SUN[0], 180.0)[:, None]
    mirror = np.full(2401, 1000 * math.tan(math.radians(SUN[0])))  # from there the camera is seen in the north
    step = np.linspace(-600, 600, mirror.size)

    def extent(east, north):
        to_camera = np.stack([east, north, np.full_like(step, 1000)])
        half = to_camera / np.linalg.norm(to_camera, axis=0) + sun
        tilt = np.degrees(np.arctan2(np.hypot(half[0], half[1]), half[2]))
        return np.ptp(step[np.exp(-((0.153 * tilt) ** 2)) > 0.5])

    spot = report["materials"]["red_aluminum"]["level_spot_m"]
    assert spot["along"] == pytest.approx(extent(0 * step, mirror + step), rel=0.15)
    assert spot["across"] == pytest.approx(extent(step, mirror), rel=0.15)
    assert summary(facts)["materials"]["red_aluminum"]["level_spot_m"] == {"across": None, "along": None}
