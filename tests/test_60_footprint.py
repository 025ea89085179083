"""What is imported, and when: the benchmark of the footprint runs, and no command loads what it does not use."""

import importlib.util
import re
from pathlib import Path

import pytest
from small_scene import small_scene

PATH = Path(__file__).parent / "benchmarks" / "footprint.py"
SPEC = importlib.util.spec_from_file_location("footprint", PATH)
footprint = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(footprint)

FILES = {"numpy", "rasterio"}
WORK = {*FILES, "pydantic", "numba", "scipy"}
IMAGE, CONFIG = "image.tif", "city.toml"
ALLOWED = {
    "--help": set(),
    "run --help": set(),
    "materials": {"numpy"},
    "init --schema": {"numpy", "pydantic"},
    f"init {IMAGE} -o new.toml": {*FILES, "pydantic"},
    f"quicklook {IMAGE} -o x.png": {*FILES, "colour", "OpenImageIO", "matplotlib", "scipy", "pandas", "PIL"},
    f"plan {CONFIG}": WORK,
    f"run {CONFIG}": WORK,
    f"run {CONFIG} -q": WORK,  # a second time: nothing to do
    "width roof_tile": {"numpy", "scipy", "numba"},
    "verify out": {"numpy"},
}
"""what each command may load, with the sun given as angles and no picture asked for"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("commands")
    small_scene(path)
    return path


@pytest.mark.parametrize("command", ALLOWED)
def test_nothing_is_imported_before_it_is_needed(folder, command, monkeypatch):
    monkeypatch.chdir(folder)
    assert set(footprint.loaded(footprint.START.format(command.split()))) <= ALLOWED[command]


def test_import_tscorr_loads_nothing():
    assert footprint.loaded("import sys, tscorr\n") == []


def test_the_footprint_is_measured_by_one_command(monkeypatch, capsys):
    monkeypatch.setattr(footprint, "REPEATS", 1)
    monkeypatch.setattr(footprint, "STARTS", {key: footprint.STARTS[key] for key in ("python", "tscorr --help")})
    footprint.main()
    lines = capsys.readouterr().out.splitlines()
    sizes = dict(re.match(r"(\S+) +([\d.]+) MB", line).groups() for line in lines if re.match(r"\S+ +[\d.]+ MB", line))
    assert 400 < float(sizes["all"]) < 2000
    assert float(sizes["numpy"]) > 10
    assert float(re.search(r"--help +([\d.]+) x python", lines[-1])[1]) > 1
