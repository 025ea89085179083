"""The benchmark: what it promises, that it can tell when a promise is broken, and its outputs."""

import copy
import json
import runpy
from pathlib import Path

import mpmath as mp
import numpy as np
import pytest

from tscorr import bench
from tscorr.bench.directions import Directions, clipped, hard_directions
from tscorr.bench.errors import bound, judge
from tscorr.bench.figures import attenuation_in_plane
from tscorr.bench.search import climb
from tscorr.bench.variants import VARIANTS, Variant, surfaces, truth
from tscorr.correction import Rules
from tscorr.correction.tables import computed_precision
from tscorr.errors import OutputError
from tscorr.materials import Material, builtin_materials, material

LONG_ENOUGH = np.finfo(np.longdouble).eps < 1e-18
needs_long = pytest.mark.skipif(not LONG_ENOUGH, reason="longdouble is no longer than double here")
BY_NAME = {variant.name: variant for variant in VARIANTS}


@pytest.fixture(scope="module")
def result():
    return bench.bench(quick=True)


@needs_long
def test_every_promise_holds(result):
    assert bench.broken_promises(result) == []


def test_the_variants_and_their_keys(result):
    names = [entry["name"] for entry in result["variants"]]
    assert names == list(BY_NAME)
    assert {
        f"{precision} {form}" for precision in ("reference", "exact", "fast") for form in ("full", "simplified")
    } <= {*names}
    for entry in result["variants"]:
        assert entry["ns_per_pixel"] > 0
        assert entry["inputs_tried"] > 1000
        assert entry["rms_relative_error"] <= entry["max_relative_error"]
        assert entry["worst_input"]["material"]["name"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert {"machine", "variants", "simplified_form"} == set(result)


def test_float32_and_float64_are_told_apart(result):
    errors = {entry["name"]: entry["max_relative_error"] for entry in result["variants"]}
    for form in ("full", "simplified"):
        assert errors[f"exact {form}"] < 1e-9
        assert 1e-8 < errors[f"fast {form}"] < 1e-4
        assert errors[f"angles {form}"] < 1e-13
        assert 1e-8 < errors[f"angles float32 {form}"] < 1e-4


def test_a_threshold_leaves_at_most_itself(result):
    for entry in result["variants"]:
        threshold = BY_NAME[entry["name"]].negligible_reflectance
        if threshold:
            assert 0.5 * threshold < entry["max_absolute_reflectance_error"] <= threshold * 1.001


def test_broken_promises_are_told(result):
    worse = copy.deepcopy(result)
    fast = next(entry for entry in worse["variants"] if entry["name"] == "fast full")
    others = bench.broken_promises(worse)
    fast["error_over_bound"] = 1.5
    fast["stored"]["most_steps"] = 2
    assert [text for text in bench.broken_promises(worse) if text not in others] == [
        text for text in bench.broken_promises(worse) if text.startswith("fast full: ")
    ]
    assert len(bench.broken_promises(worse)) == len(others) + 2
    fast["error_over_bound"] = float("nan")
    assert len(bench.broken_promises(worse)) == len(others) + 2


def test_the_worst_input_can_be_computed_again(result):
    entry = next(entry for entry in result["variants"] if entry["name"] == "fast full")
    worst, variant = entry["worst_input"], BY_NAME["fast full"]
    directions = Directions(*(np.array([worst[f"{name}_deg"]]) for name in Directions._fields))
    values = {key: (value,) for key, value in worst["material"].items() if key != "name"}
    m = Material("again", t0=(0.02,), **values)
    error, true, excess = judge(variant, m, directions)
    assert float(true.removed[0]) == worst["removed"]
    assert float(error[0]) == worst["error"]
    assert float(excess[0]) == worst["error_over_bound"]
    for name, vector in zip(("sun", "view", "normal"), directions.vectors(), strict=True):
        assert vector[:, 0].tolist() == worst[name]


def test_table(result):
    text = bench.table(result)
    for entry in result["variants"]:
        assert entry["name"] in text
    assert "Worst inputs" in text
    assert "roof_tile, 0 to 180" in text
    starred = [line.split()[1:3] for line in text.splitlines() if line.startswith("*  ")]
    assert ["exact", "full"] in starred


def test_plot_and_figures_are_pictures(result, tmp_path):
    bench.plot(result, tmp_path / "plot.png")
    files = [tmp_path / "plot.png", *bench.draw_figures(tmp_path / "paper")]
    assert [file.name for file in files[1:]] == [f"figure_{number}.png" for number in range(1, 6)]
    for file in files:
        assert file.read_bytes().startswith(b"\x89PNG")
        assert file.stat().st_size > 10_000


def test_plot_where_nothing_can_be_written(result, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"plot\.png cannot be written"):
        bench.plot(result, tmp_path / "file" / "plot.png")
    with pytest.raises(OutputError, match=r"figure_1\.png cannot be written"):
        bench.draw_figures(tmp_path / "file")


def test_figure_4_and_5_show_the_ends_that_the_paper_names():
    np.testing.assert_allclose(attenuation_in_plane(60.0, np.array([0.0, 80.0])), 1, atol=1e-14)
    assert np.all(attenuation_in_plane(60.0, np.array([-1.0, 81.0])) < 0.99)
    assert attenuation_in_plane(60.0, np.array([-60.0])) == pytest.approx(0.5)


def test_simplified_form_in_section_5(result):
    found = {
        (row["material"], row["max_zenith_deg"], row["relative_azimuth_deg"]): row["max_relative_difference"]
        for row in result["simplified_form"]
    }
    assert found["roof_tile", 60, "180"] == 0
    assert found["roof_tile", 70, "180"] == pytest.approx(0.1059, abs=5e-4)
    assert found["roof_tile", 60, "0 to 180"] == pytest.approx(0.029, abs=1e-3)
    assert all(difference == 0 for (_, limit, _), difference in found.items() if limit == 45)


# --- the judge ----------------------------------------------------------------------------------------


@needs_long
def test_the_truth_is_true():
    """Against mpmath from the same vectors, at 60 digits."""
    rng = np.random.default_rng(5)
    directions = hard_directions(rng, 3, 85.0)
    variant, m = BY_NAME["exact full"], material("red_aluminum")
    found = truth(variant, m, directions)
    vectors = directions.vectors()
    with mp.workdps(60):
        for j in np.flatnonzero(np.isfinite(found.removed)):
            s, v, n = (mp.matrix([mp.mpf(float(x)) for x in vector[:, j]]) for vector in vectors)
            up = s[2]
            s, v, n = (x / mp.norm(x) for x in (s, v, n))
            cos_i, cos_r, half = mp.fdot(s, n), mp.fdot(v, n), s + v
            c = mp.norm(half) / 2
            alpha = 2 * mp.asin(mp.norm(half / mp.norm(half) - n) / 2)
            index = mp.mpc(m.n[0], -m.k[0])
            q = mp.sqrt(index**2 - 1 + c**2)
            fresnel = (abs((c - q) / (c + q)) ** 2 + abs((index**2 * c - q) / (index**2 * c + q)) ** 2) / 2
            g = min(mp.mpf(1), min(cos_i, cos_r) * (cos_i + cos_r) / c**2)
            expected = mp.pi * m.t1[0] * fresnel * g * mp.exp(-((m.w[0] * mp.degrees(alpha)) ** 2)) / cos_r / up
            assert abs(_digits(found.removed[j]) - expected) <= 1e-16 * expected + mp.mpf(10) ** -4000


def _digits(value):
    """A longdouble in full."""
    high = np.float64(value)
    return mp.mpf(float(high)) + mp.mpf(float(value - high))


def test_the_search_finds_a_hidden_needle():
    def height(directions):
        return -np.hypot(directions.incidence - 61.23456, directions.exitance - 12.3)

    rng = np.random.default_rng(0)
    start = hard_directions(rng, 20, 85.0)
    top, heights = climb(height, start, height(start), rng, max_zenith_deg=85.0, rounds=30)
    assert heights.max() > -1e-3
    assert heights.max() > height(start).max()
    assert np.all(heights == height(top))


def test_directions_are_dense_at_the_bad_places_and_inside_the_limits():
    directions = hard_directions(np.random.default_rng(1), 300, 85.0)
    incidence, exitance, phi = directions[:3]
    for angle in (incidence, exitance):
        assert angle.min() >= 0
        assert angle.max() <= 85
    assert phi.min() >= 0
    assert phi.max() <= 180
    for close in (
        np.abs(incidence - exitance) + 180 - phi,
        np.abs(incidence - exitance) + phi,
        85 - incidence,
        incidence,
        170 - incidence - exitance + 180 - phi,
    ):
        assert np.count_nonzero(close < 1e-5) > 8
    sun, view, normal = directions.vectors()
    for vector in (sun, view, normal):
        np.testing.assert_allclose((vector**2).sum(axis=0), 1, atol=1e-15)
    np.testing.assert_allclose((sun * normal).sum(axis=0), np.cos(np.deg2rad(incidence)), atol=1e-15)
    np.testing.assert_allclose((view * normal).sum(axis=0), np.cos(np.deg2rad(exitance)), atol=1e-15)
    assert clipped(directions, 50.0).incidence.max() == 50


def test_bounds_grow_with_what_limits_the_digits():
    lobe = surfaces()[4]
    near, far = (truth(BY_NAME["exact full"], lobe, _one(40.0, 40.0 - tilt)) for tilt in (0.0, 30.0))
    assert (
        bound(BY_NAME["exact full"], lobe, near) / near.removed < bound(BY_NAME["exact full"], lobe, far) / far.removed
    )
    assert float(bound(BY_NAME["fast full"], lobe, far)[0]) == 1e-6


def _one(incidence, exitance, phi=180.0):
    return Directions(*(np.array([angle]) for angle in (incidence, exitance, phi, 0.0, 0.0, 0.0)))


# --- where "fast" hands over to "exact" ---------------------------------------------------------------


def precision_of(m, **rules):
    return computed_precision(m.at(), Rules(**rules))


def test_fast_is_fast_for_the_paper_s_materials():
    assert {precision_of(m) for m in builtin_materials().values()} == {"fast"}


@pytest.mark.parametrize(
    ("w", "n", "k", "rules", "expected"),
    [
        (0.07, 1.5, 0.0, {}, "fast"),
        (50.0, 1.5, 0.0, {}, "fast"),
        (0.05, 0.7, 0.0, {}, "exact"),
        (0.05, 0.7, 0.1, {}, "fast"),
        (5.0, 1.5, 0.0, {"precision": "reference"}, "reference"),
    ],
)
def test_kinks_are_computed_exactly(w, n, k, rules, expected):
    m = Material("m", t0=(0.02,), t1=(1.0,), w=(w,), n=(n,), k=(k,))
    assert precision_of(m, **rules) == expected


def test_no_lobe_needs_no_digits():
    assert precision_of(Material("m", t0=(0.02,), t1=(0.0,), w=(50.0,), n=(0.7,), k=(0.0,))) == "fast"


@needs_long
@pytest.mark.parametrize("limit", [60.0, 85.0])
@pytest.mark.parametrize("w", [0.07, 0.2, 5.0, 50.0])
@pytest.mark.parametrize(("n", "k"), [(1.5, 0.25), (0.2, 3.4), (0.7, 0.05)])
def test_fast_keeps_its_promise_for_lobes_of_any_width(limit, w, n, k, monkeypatch):
    monkeypatch.setattr("tscorr.bench.variants.MAX_ZENITH_DEG", {"full": limit, "simplified": limit})
    strongest = min(50.0, 0.08 * np.rad2deg(w) ** 2)  # at most, reflects all that its facets receive
    m = Material("m", t0=(0.02,), t1=(strongest,), w=(w,), n=(n,), k=(k,))
    assert precision_of(m, max_zenith_deg=limit) == "fast"
    variant, rng = Variant("", "full", "fast"), np.random.default_rng(6)
    start = hard_directions(rng, 400, limit)

    def excess(directions):
        return judge(variant, m, directions)[2]

    _, heights = climb(excess, start, excess(start), rng, max_zenith_deg=limit, rounds=8)
    assert 0.01 < heights.max() <= 1


# The script that times the kernel


def test_the_kernel_is_timed_by_a_script(tmp_path, capsys):
    """It runs, and its JSON holds what it prints; a small block on a busy machine judges nothing."""
    script = runpy.run_path(str(Path(__file__).parent / "benchmarks" / "kernel.py"))
    script["main"](["--quick", "--json", str(tmp_path / "kernel.json")])
    found = json.loads((tmp_path / "kernel.json").read_text())
    assert found["ns_per_pixel"]["numpy"] > found["ns_per_pixel"]["kernel"] > found["ns_per_pixel"]["memcpy"] > 0
    printed = {line.split()[0]: float(line.split()[1]) for line in capsys.readouterr().out.splitlines()}
    assert printed == pytest.approx({**found["ns_per_pixel"], **found["ratios"]}, rel=1e-6, abs=0.051)
