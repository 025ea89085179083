"""What the README shows works, and says what the project does."""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rasterio.rio.main import main_group
from small_scene import write_inputs

import tscorr
from tscorr.cli import cli
from tscorr.config import Config, load_config
from tscorr.correction import SINGLE_FLAGS
from tscorr.materials import Material, load_materials

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    """Fenced blocks of one language, without the indent of the list they stand in."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", README, flags=re.MULTILINE | re.DOTALL)
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


RUN = "python3 -m venv .venv && .venv/bin/pip install -q . && .venv/bin/tscorr run configs/delft.toml"
TEST = 'python3 -m venv .venv && .venv/bin/pip install -q -e ".[test]" && .venv/bin/pytest -q -n auto'
LONG = {
    RUN: (".ci/run", ".venv/bin/tscorr run configs/delft.toml"),
    TEST: (".ci/run", TEST),
    "tscorr run configs/delft_true_normals.toml": (".ci/run", "tscorr run configs/delft_true_normals.toml"),
    "tscorr fit --scenes configs/delft.toml -o mine.toml": ("tests/test_40_samples.py", "fit_scenes(planned(delft("),
    "tscorr bench --quick": ("tests/test_30_bench.py", "bench(quick=True"),
    "python tests/benchmarks/kernel.py": ("tests/test_30_bench.py", 'script["main"](["--quick"'),
    "python tests/benchmarks/against_copy.py": ("tests/test_40_against_copy.py", "against_copy.measure("),
    "python tests/benchmarks/footprint.py": ("tests/test_60_footprint.py", "footprint.main()"),
}
"""commands that take long; what runs them, or the same with less to do, and how it says so"""


def commands():
    """Every command that the README shows, in the order in which a reader meets them."""
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    shown = [re.sub(r"\s+#.*", "", line).strip() for line in lines]
    inline = re.findall(r"`((?:rio )?tscorr [^`A-Z]+ [^`A-Z]+|python [^`]+)`", README)
    return [command for command in dict.fromkeys([*shown, *inline]) if command]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where a reader stands after the five steps: flight.tif, classes.tif, dsm.tif, city.toml, measurements.csv."""
    path = tmp_path_factory.mktemp("reader")
    write_inputs(path)
    (path / "image.tif").rename(path / "flight.tif")
    (path / "class_map.tif").rename(path / "classes.tif")
    (text,) = blocks("toml")
    (path / "city.toml").write_text(text, encoding="utf-8")
    for name in ("configs", "samples"):
        (path / name).symlink_to(ROOT / name)
    incidence, exitance, phi = (a.ravel() for a in np.meshgrid([20, 40, 60], np.arange(0, 75, 2.5), [0, 180]))
    rows = zip(incidence, exitance, phi, tscorr.brdf("red_concrete", incidence, exitance, phi), strict=True)
    lines = ["theta_i,theta_r,phi,f_r", *(",".join(map(str, row)) for row in rows)]
    (path / "measurements.csv").write_text("\n".join(lines) + "\n")
    assert CliRunner().invoke(cli, ["run", str(path / "city.toml")]).exit_code == 0
    return path


@pytest.mark.parametrize("command", [command for command in commands() if command not in LONG])
def test_every_command_shown_works(folder, command, monkeypatch):
    monkeypatch.chdir(folder)
    program, *words = shlex.split(command)
    if program in {"tscorr", "rio"} and ">" not in words:
        result = CliRunner().invoke(cli if program == "tscorr" else main_group, words)
        assert result.exit_code == 0, result.output
    else:
        environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
        result = subprocess.run(["bash", "-ec", command], env=environment, capture_output=True, text=True, check=False)
        assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize("command", LONG)
def test_what_takes_long_is_shown_and_run_elsewhere(command):
    assert command in commands()
    file, words = LONG[command]
    assert words in (ROOT / file).read_text(encoding="utf-8")


def test_the_run_command_names_a_configuration_that_loads():
    path = RUN.split("tscorr run ")[1]
    assert [scene.name for scene in load_config(ROOT / path).scenes] == ["forward", "nadir", "line"]


def test_every_setting_and_flag_is_named():
    for model in (
        Config,
        *(Config.model_fields[name].annotation for name in ("output", "model", "correction", "run")),
    ):
        for key in model.model_fields:
            assert f"`{key}`" in README or f"[{key}]" in README or key == "title", key
    for flag in SINGLE_FLAGS:
        assert f"| {flag.name} |" in README, flag.name


@pytest.mark.parametrize("name", cli.commands)
def test_every_command_and_option_is_named(name):
    row = next(line for line in README.splitlines() if line.startswith(f"| `tscorr {name}"))
    for option in (option for parameter in cli.commands[name].params for option in parameter.opts):
        assert not option.startswith("--") or f"`{option}" in row, option


def test_the_python_shown_runs(folder, monkeypatch, capsys):
    (text,) = blocks("python")
    monkeypatch.chdir(folder)
    exec(compile(text, "README.md", "exec"), {})
    assert "'p95'" in capsys.readouterr().out


@pytest.mark.parametrize("word", re.findall(r"`tscorr (\w+)", README))
def test_every_command_named_exists(word):
    assert word in cli.commands


def test_files_that_the_readme_points_at_exist():
    for path in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / path).exists(), path
    assert len(README.splitlines()) < 300


def test_the_file_of_materials_that_the_page_shows_is_one(tmp_path):
    page = (ROOT / "docs/materials.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    (shown,) = load_materials(path).values()
    assert shown.wavelength_um == (0.45, 0.55, 0.65)
    keys = {field.name for field in fields(Material)} - {"name", "file"}
    assert all(re.search(rf"^(# )?{key} = ", text, flags=re.MULTILINE) for key in keys)
