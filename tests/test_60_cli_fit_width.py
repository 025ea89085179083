"""cli: tscorr fit and tscorr width."""

import re
import subprocess
import sys
from itertools import product

import numpy as np
import pytest
from click.testing import CliRunner
from small_scene import BANDS, METAL, NODATA, SCALE, SHAPE, TILE, heights, small_scene, write_image

import tscorr
from tscorr import reference
from tscorr.angles import unit_vector
from tscorr.cli import cli
from tscorr.fit.solver import normal_incidence
from tscorr.materials import load_materials, material


def run(*arguments):
    """The command in this process: exit_code, stdout, stderr."""
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def refused(*arguments):
    """The message of a command that is refused."""
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    return result.stderr


@pytest.fixture
def measured(tmp_path):
    """Noisy measurements of red concrete at two wavelengths, on a grid like the paper's."""
    rng = np.random.default_rng(3)
    grid = [(i, r, 180.0) for i, r in product((10, 30, 50, 65), range(0, 80, 5))]
    grid += [(a, a, phi) for a, phi in product((30, 50, 65), np.linspace(90, 177.5, 12))]
    lines = ["theta_i,theta_r,phi,f_r_550nm,sigma_550nm,f_r_650nm,sigma_650nm"]
    for i, r, phi in grid:
        f = float(tscorr.brdf("red_concrete", i, r, phi)[()])
        noisy = f * (1 + 0.02 * rng.standard_normal(2))
        lines.append(f"{i},{r},{phi:g},{noisy[0]:.6g},{0.02 * f:.6g},{noisy[1]:.6g},{0.02 * f:.6g}")
    path = tmp_path / "concrete.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_fit_does_not_write_what_did_not_converge(measured, tmp_path, monkeypatch):
    monkeypatch.setattr("tscorr.fit.solver.MAX_EVALUATIONS", 2)
    result = run("fit", measured, "-o", tmp_path / "m.toml")
    assert result.exit_code == 2
    assert "! the fit did not converge: do not use it" in result.stdout
    assert result.stderr == "tscorr: fits that did not converge, and of which no material is written: concrete\n"
    assert not (tmp_path / "m.toml").exists()


def test_fit_names_no_file_that_it_did_not_write(measured, tmp_path, monkeypatch):
    run("fit", measured, "-o", tmp_path / "m.toml")
    before = (tmp_path / "m.toml").read_bytes()
    monkeypatch.setattr("tscorr.fit.solver.MAX_EVALUATIONS", 2)
    assert "m.toml" not in run("fit", measured, "-o", tmp_path / "m.toml").stdout
    assert (tmp_path / "m.toml").read_bytes() == before


def test_fit_reads_what_a_spreadsheet_writes(measured):
    """Semicolons, and names of columns as one likes to write them."""
    plain = run("fit", measured).stdout
    head, rest = measured.read_text(encoding="utf-8").split("\n", 1)
    measured.write_text(f"{head.title()}\n{rest}".replace(",", ";"), encoding="utf-8")
    assert run("fit", measured).stdout == plain


def test_fit_does_not_replace_other_materials(measured, tmp_path):
    library = tmp_path / "mine.toml"
    library.write_text("[other]\nt0 = 0.1\nt1 = 0.1\nw = 0.1\nn = 1.5\n")
    before = library.read_bytes()
    assert f"the library {library} holds other, which would be lost" in refused("fit", measured, "-o", library)
    assert library.read_bytes() == before
    library.write_text("scale = 3\n")
    assert f"the file {library} exists and is no library of materials" in refused("fit", measured, "-o", library)
    again = tmp_path / "again.toml"
    assert run("fit", measured, "-o", again).exit_code == run("fit", measured, "-o", again).exit_code == 0


def test_fit_says_how_many_samples_it_used(measured):
    forward = len(measured.read_text().splitlines()) - 1
    with measured.open("a", encoding="utf-8") as file:
        file.write("\n30,40,10,0.1,0.01,0.1,0.01" * 5)
    assert f"  {forward} of {forward + 5} samples, 2 wavelength(s)" in run("fit", measured).stdout


def test_fit_writes_a_material_file(measured, tmp_path):
    result = run("fit", measured, "-o", tmp_path / "m.toml", "--name", "my_concrete", "--plot", tmp_path / "plots")
    assert result.exit_code == 0
    fitted = load_materials(tmp_path / "m.toml")["my_concrete"]
    true = material("red_concrete")
    assert fitted.w[0] == pytest.approx(true.w[0], rel=0.02)
    assert fitted.wavelength_um == (0.55, 0.65)
    assert fitted.k == (0.25,)
    assert "my_concrete" in result.stdout
    assert f"materials: {tmp_path / 'm.toml'}" in result.stdout
    assert len(list((tmp_path / "plots").glob("my_concrete_*.png"))) == 3


def test_options_of_fit(measured, tmp_path):
    options = ("--k", "0.1", "--wavelengths", "0.65", "--form", "simplified", "--bootstrap", "2")
    result = run("fit", measured, "-o", tmp_path / "m.toml", *options)
    assert result.exit_code == 0
    fitted = load_materials(tmp_path / "m.toml")["concrete"]
    assert (fitted.k, fitted.wavelength_um) == ((0.1,), (0.65,))
    assert "simplified" in fitted.source
    assert "bootstrap, 2 replicates" in result.stdout
    assert "k is held" not in run("fit", measured, "--k", "free", "--wavelengths", "0.55").stdout


def test_what_cannot_be_fitted_is_refused(measured, tmp_path):
    config = small_scene(tmp_path)
    assert "give files of measurements, or --scenes CONFIG\n" in refused("fit")
    before = measured.read_bytes()
    assert f"{measured} is one of the files of measurements" in refused("fit", measured, "-o", measured)
    assert measured.read_bytes() == before
    assert "nowhere is not a folder" in refused("fit", measured, "-o", tmp_path / "nowhere" / "m.toml")
    assert "not both" in refused("fit", measured, "--scenes", config)
    assert "--k = 'much'; allowed is a number or 'free'" in refused("fit", measured, "--k", "much")
    assert "--wavelengths = 'red'" in refused("fit", measured, "--wavelengths", "0.55,red")
    assert "has no wavelength 0.7 um" in refused("fit", measured, "--wavelengths", "0.7")
    assert "--plot is for files of measurements" in refused("fit", "--scenes", config, "--plot", tmp_path)
    assert "--bootstrap is for files" in refused("fit", "--scenes", config, "--bootstrap", "3")
    assert "images do not tell n, t1 and k apart" in refused("fit", "--scenes", config, "--k", "free")
    assert not list(tmp_path.glob("*.toml.*"))


def shining_city(folder):
    """The small scene in three directions, where block and gable are of red concrete and called aluminium."""
    views = {"north": (40.0, 0.0), "steep": (15.0, 10.0), "side": (35.0, 60.0)}
    m = material("red_concrete")
    t0 = np.array([0.0125, 0.0192, 0.046])[:, None, None]
    slope = np.zeros((3, *SHAPE))
    down, right = np.gradient(heights(), 0.5)
    slope[0], slope[1], slope[2] = -right, down, 1
    normal = slope / np.sqrt((slope**2).sum(axis=0))
    sun = unit_vector(40.0, 180.0)
    scenes = []
    for name, direction in views.items():
        vectors = (np.broadcast_to(v[:, None, None], normal.shape) for v in (sun, unit_vector(*direction)))
        geometry = reference.geometry(*vectors, normal)
        lobe = reference.specular(geometry, m.w[0], m.n[0], m.k[0])
        r = np.pi * (t0 + m.t1[0] * lobe) * geometry.cos_i / sun[2]
        noise = np.random.default_rng(len(scenes)).standard_normal((BANDS, *SHAPE))
        stored = np.where(np.isnan(r), NODATA, np.clip(np.rint((r + 5e-4 * noise) / SCALE), 0, 32767))
        write_image(folder / f"{name}.tif", stored.astype(np.int16))
        view = {"kind": "constant", "zenith_deg": direction[0], "azimuth_deg": direction[1]}
        scenes.append({"name": name, "image": f"{name}.tif", "view": view})
    classes = {str(TILE): "red_aluminum", str(METAL): "red_aluminum"}
    return small_scene(folder, *scenes, materials={"classes": classes})


def test_fit_to_scenes_needs_no_right_library(tmp_path):
    """A few roofs of few directions: t1 F0 and w together fit what was seen, so the lobe there is right."""
    result = run("fit", "--scenes", shining_city(tmp_path), "-o", tmp_path / "m.toml")
    assert result.exit_code == 0
    assert re.search(r"red_aluminum: tscorr fit of scenes north, steep, side: full model, \d+ roofs", result.stdout)
    fitted, true = load_materials(tmp_path / "m.toml")["red_aluminum"], material("red_concrete")
    p, wanted = (m.t1[0] * float(normal_incidence(np.array(m.n[0]), np.array(m.k[0]))[0]) for m in (fitted, true))
    assert fitted.w[0] == pytest.approx(true.w[0], rel=0.05)
    assert p == pytest.approx(wanted, rel=0.1)


def test_widths_are_the_papers():
    """Section 4 of the physics: azimuthal width at 30, 50; zenithal; crossover of the exponential."""
    result = run("width", "roof_tile", "red_aluminum")
    assert result.exit_code == 0
    rows = {tuple(line.split()[:2]): line.split()[2:] for line in result.stdout.splitlines() if "_" in line}
    assert rows["roof_tile", "30"][0] == "185.6"
    assert rows["roof_tile", "50"][0] == "78.7"
    assert rows["roof_tile", "10"][0] == "-"
    assert rows["red_aluminum", "30"][:1] == ["37.9"]
    assert rows["red_aluminum", "50"][2] == "21.8"
    assert rows["red_aluminum", "50"][3] == "53.0"
    assert "roof_tile: from 47.4 degrees" in result.stdout
    assert "red_aluminum: from 45.1 degrees" in result.stdout


def test_a_material_without_a_peak_has_no_width():
    result = run("width", "lambertian")
    assert result.exit_code == 0
    assert "lambertian has no peak" in result.stdout


def test_width_reads_libraries_and_draws(tmp_path):
    library = tmp_path / "own.toml"
    library.write_text("[own]\nt0 = 0.1\nt1 = 1.0\nw = 0.1\nn = 1.5\n", encoding="utf-8")
    for suffix, begins in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        plot = tmp_path / f"w.{suffix}"
        result = run("width", "own", "lambertian", "--library", library, "--plot", plot, "--form", "simplified")
        assert result.exit_code == 0
        assert plot.read_bytes().startswith(begins)
    drawn = (tmp_path / "w.svg").read_text(encoding="utf-8")
    assert "own" in drawn
    assert "lambertian" not in drawn


def test_bench_and_figures_refuse_what_cannot_be_written_before_they_start(tmp_path, monkeypatch):
    monkeypatch.setattr("tscorr.bench.bench", lambda **_: pytest.fail("started"))
    assert "b.xyz cannot be written; allowed are files that end in" in refused("bench", "--plot", tmp_path / "b.xyz")
    assert "nowhere is not a folder" in refused("bench", "--json", tmp_path / "nowhere" / "b.json")
    (tmp_path / "file").touch()
    assert f"the folder {tmp_path}/file/figures cannot be made" in refused("figures", tmp_path / "file" / "figures")


def test_width_refuses_what_it_does_not_know(tmp_path):
    assert "no material 'rooftile' (did you mean 'roof_tile'?)" in refused("width", "rooftile")
    result = run("width", "roof_tile", "--plot", tmp_path / "w.doc")
    assert result.exit_code == 2
    assert "w.doc cannot be written" in result.stderr
    assert "are files that end in .png, .svg, .pdf" in refused("width", "roof_tile", "--plot", tmp_path / "w.jpg")
    assert run("width").exit_code == 2


@pytest.mark.parametrize(
    ("command", "heavy"),
    [("width roof_tile", "matplotlib scipy rasterio"), ("fit --help", "numpy scipy matplotlib rasterio numba")],
)
def test_nothing_heavy_is_imported_without_need(command, heavy):
    code = (
        "import sys, tscorr.cli\n"
        "try:\n tscorr.cli.cli(sys.argv[1].split())\n"
        "except SystemExit as end:\n assert not end.code\n"
        "sys.exit(' '.join(name for name in sys.argv[2].split() if name in sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code, command, heavy], capture_output=True, text=True, check=False)
    assert result.stderr.strip() == ""
