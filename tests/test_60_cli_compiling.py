"""The first run on a machine says that it compiles; later ones find what it compiled, wherever that may be kept."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from numba import njit
from numba.core.event import RecordingListener, install_listener
from small_scene import SHAPE, small_scene, write_raster

import tscorr
from tscorr import batch
from tscorr.cli import cli
from tscorr.cli.common import COMPILING, compilation_told
from tscorr.correction import ahead
from tscorr.kernels import correct_block
from tscorr.kernels.stamp import SOURCES, sources_of
from tscorr.scene.run import Pipeline

PACKAGE = Path(tscorr.__file__).parent
COUNT = """
import numpy as np
from numba.core.event import RecordingListener, install_listener
from tscorr.scene.compiled import count_values
with install_listener("numba:compile", RecordingListener()) as heard:
    count_values(np.zeros((2, 2), np.uint16), np.zeros(8192, np.int64))
print(len(heard.buffer))
"""


def compiled(folder, environment):
    """How often a new process, started in a folder, begins and ends a compilation for one function."""
    place = {"cwd": folder, "env": environment}
    result = subprocess.run([sys.executable, "-c", COUNT], **place, capture_output=True, text=True, check=True)
    return int(result.stdout)


def heard(enabled):
    """What a command that compiles two functions says on stderr."""

    @click.command()
    def command():
        with compilation_told(enabled=enabled):
            for one in (1, 2):
                njit(lambda x, one=one: x + one)(1)

    return CliRunner().invoke(command).stderr


def test_compilation_is_told_once():
    assert heard(enabled=True) == f"{COMPILING}\n"
    assert heard(enabled=False) == ""


def test_a_second_process_compiles_nothing(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(PACKAGE.parent)}
    assert compiled(tmp_path, environment) > 0
    assert compiled(tmp_path, environment) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is of Linux")
def test_nor_where_the_package_cannot_be_written_to(tmp_path):
    """Files where the folders of compiled code would stand: so it is kept in the user's cache."""
    installed = tmp_path / "installed" / "tscorr"
    shutil.copytree(PACKAGE, installed, ignore=shutil.ignore_patterns("__pycache__"))
    folders = [installed, *(path for path in installed.rglob("*") if path.is_dir())]
    for folder in folders:
        (folder / "__pycache__").touch()
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(installed.parent), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    assert compiled(tmp_path, environment) > 0
    assert compiled(tmp_path, environment) == 0
    assert list((tmp_path / "cache").rglob("compiled.count_values-*.nbi"))


def test_a_second_run_compiles_nothing(tmp_path):
    """Whatever a run needs, from the first row to the report."""
    config = str(small_scene(tmp_path))
    assert CliRunner().invoke(cli, ["run", config, "-q"]).exit_code == 0
    again = [sys.executable, "-m", "tscorr", "run", config, "--overwrite"]
    result = subprocess.run(again, capture_output=True, text=True, check=True)
    assert result.stderr == ""
    assert "results: " in result.stdout


FIRST = """
import sys
from tscorr import batch
from tscorr.kernels import correct_block
assert batch.run(sys.argv[1]).scenes[0].state == "done"
print(sum(correct_block.stats.cache_misses.values()), sum(correct_block.stats.cache_hits.values()))
"""


@pytest.mark.parametrize("given", [False, True])
def test_a_first_run_has_the_kernel_compiled_by_another_process(tmp_path, given):
    """And finds it in the cache: types that differ anywhere, as those of given normals do, would be compiled here."""
    normals = write_raster(tmp_path / "normals.tif", np.broadcast_to(np.eye(3)[2, :, None, None], (3, *SHAPE)))
    surface = {"kind": "normals", "path": str(normals), "heights": "dsm.tif"}
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(PACKAGE.parent)}
    config = str(small_scene(tmp_path, {"surface": surface} if given else {}, run={"workers": 2}))
    command = [sys.executable, "-c", FIRST, config]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert result.stdout == "0 1\n"


@pytest.mark.parametrize("program", ["a program that is not there", "false"])
def test_where_no_other_process_compiles_this_one_does(tmp_path, monkeypatch, program):
    monkeypatch.setattr(ahead, "_is_new", lambda: True)
    monkeypatch.setattr(ahead, "another", lambda _: {"args": [program]})
    scene = batch.run(small_scene(tmp_path, run={"workers": 2})).scenes[0]
    assert scene.state == "done", scene.error


def test_a_process_that_compiles_ends_with_the_run(monkeypatch):
    """Here one that takes long, of a run that fails meanwhile."""
    monkeypatch.setattr(ahead, "_is_new", lambda: True)
    monkeypatch.setattr(ahead, "another", lambda _: {"args": ["sleep", "100"]})
    start = time.perf_counter()
    with pytest.raises(ValueError, match="at once"), ahead.compiling(lambda: [()]):
        raise ValueError("at once")
    assert time.perf_counter() - start < 5


def test_scenes_side_by_side_wait_for_one_process(monkeypatch):
    started = []

    def one(_):
        started.append(1)
        return {"args": ["sleep", "0.3"]}

    monkeypatch.setattr(ahead, "_is_new", lambda: True)
    monkeypatch.setattr(ahead, "another", one)
    with ahead.compiling(lambda: [()]) as first, ahead.compiling(lambda: [()]) as second:
        start = time.perf_counter()
        second()
        assert time.perf_counter() - start > 0.1
        first()
    assert started == [1]
    assert not ahead._at_work


def test_without_a_place_for_the_types_nothing_is_compiled_ahead(tmp_path, monkeypatch):
    monkeypatch.setattr(ahead, "_is_new", lambda: True)
    monkeypatch.setattr(ahead.tempfile, "tempdir", str(tmp_path / "nowhere"))
    with ahead.compiling(lambda: [()]) as until_compiled:
        until_compiled()
        assert not ahead._at_work


def test_where_the_kernel_is_compiled_no_scene_makes_a_sample(tmp_path, monkeypatch):
    """It would take a block to be made, and a pixel to be read, for each of many scenes."""
    monkeypatch.setattr(ahead, "_is_new", lambda: False)
    monkeypatch.setattr(Pipeline, "_one_pixel", lambda _: pytest.fail("made"))
    scene = batch.run(small_scene(tmp_path, run={"workers": 2})).scenes[0]
    assert scene.state == "done", scene.error


def test_python_ends_in_silence_where_pictures_were_made_before_something_was_compiled():
    """As in a batch whose last scene alone has a line scanner."""
    code = (
        "import OpenImageIO\nfrom numba.core.event import trigger_event\n"
        "from tscorr.cli.common import compilation_told\n"
        "with compilation_told(enabled=False), trigger_event('numba:compile', data={}): pass"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stderr == ""


def test_a_wait_for_the_other_process_is_told(monkeypatch):
    monkeypatch.setattr(ahead, "_is_new", lambda: True)
    monkeypatch.setattr(ahead, "another", lambda _: {"args": ["sleep", "0.2"]})
    with (
        install_listener("numba:compile", RecordingListener()) as heard,
        ahead.compiling(lambda: [()]) as until_compiled,
    ):
        until_compiled()
        assert len(heard.buffer) == 2
        until_compiled()
        assert len(heard.buffer) == 2


ENTRY = """
from pathlib import Path
from numba import njit
from part import part
from tscorr.kernels.stamp import sources_of

@njit(cache=True)
def entry(x, sources=sources_of(Path(__file__).parent)):
    return part(x)

print(entry(1), sum(entry.stats.cache_hits.values()))
"""
PART = """
from numba import njit

@njit
def part(x):
    return x + {step}
"""


def test_an_edit_of_a_part_is_compiled(tmp_path):
    """numba's cache looks at the file of the cached function alone; the stamp of its folder tells the rest."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(PACKAGE.parent)}

    def printed(step):
        (tmp_path / "part.py").write_text(PART.format(step=step))
        command = [sys.executable, "-B", "-c", "import entry"]
        place = {"cwd": tmp_path, "env": environment}
        return subprocess.run(command, **place, capture_output=True, text=True, check=True).stdout

    (tmp_path / "entry.py").write_text(ENTRY)
    assert [printed(step) for step in (1, 1, 2)] == ["2 0\n", "2 1\n", "3 0\n"]


def test_every_file_of_the_kernel_is_in_its_stamp(tmp_path):
    folder = shutil.copytree(PACKAGE / "kernels", tmp_path / "kernels")
    stamps = [sources_of(folder)]
    assert stamps == [SOURCES]
    assert SOURCES in correct_block.py_func.__defaults__
    for path in sorted(folder.glob("*.py")):
        path.write_text(path.read_text() + "\n")
        stamps.append(sources_of(folder))
    assert len(set(stamps)) == len(stamps) > 10
