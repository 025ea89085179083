"""A batch that can be killed: an output is the old whole one, the new whole one, or absent; the next run finishes."""

import json
import shutil
import subprocess
import sys
from collections import Counter

import killing
import numpy as np
import pytest
import rasterio
from small_scene import (
    GROUND,
    TILE,
    write_config,
    write_inputs,
)

from tscorr import batch

KILLS, SIGNALS, SEED, PROCESSES = 50, 5, 7, 2
FLAT = {"surface": {"kind": "flat"}}
OLD, NEW = {"name": "a", **FLAT}, {"name": "a", **FLAT, "direct_fraction": 0.5}
CLASSES = {"classes": {str(TILE): "roof_tile", str(GROUND): "lambertian"}}
NOT_COMPARED = {"seconds", "peak_rss_mb", "mpixel_per_s"}


def config_of(folder, out, scene):
    """A scene, and one that never changes, of the inputs in a folder, written to another."""
    output = {"directory": str(out), "quicklook": False}
    path = write_config(folder, scene, {"name": "b", **FLAT}, output=output, materials=CLASSES)
    text = path.read_text()
    for name in ("image.tif", "class_map.tif"):
        text = text.replace(f'"{name}"', json.dumps(str(folder / name)))
    path.write_text(text)
    return path


def values(result):
    """Decoded rasters, and the report but for what depends on the machine."""
    rasters = {}
    for path in sorted(result.glob("*.tif")):
        with rasterio.open(path) as file:
            rasters[path.name] = file.read()
    report = json.loads((result / "report.json").read_text())
    return rasters, {key: value for key, value in report.items() if key not in NOT_COMPARED}


def assert_same(result, reference):
    """Equal decoded values, flags and sums."""
    (rasters, report), (true_rasters, true_report) = values(result), values(reference)
    assert rasters.keys() == true_rasters.keys()
    for name, raster in rasters.items():
        np.testing.assert_array_equal(raster, true_rasters[name])
    assert report == true_report


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """The folder of the trials, and what was seen in each."""
    folder = tmp_path_factory.mktemp("kill")
    write_inputs(folder)
    assert batch.run(config_of(folder, folder / "old", OLD)).exit_code == 0
    shutil.copytree(folder / "old", folder / "new")
    result = batch.run(config_of(folder, folder / "new", NEW))
    assert [scene.state for scene in result.scenes] == ["done", "current"]
    config_of(folder, "@OUT@", NEW).rename(folder / "new.toml")
    processes = [
        subprocess.Popen(
            [sys.executable, killing.__file__, folder, str(share), *map(str, (PROCESSES, KILLS, SIGNALS, SEED))],
            stdout=subprocess.PIPE,
            text=True,
        )
        for share in range(PROCESSES)
    ]
    seen = [json.loads(line) for process in processes for line in process.communicate()[0].splitlines()]
    assert [process.returncode for process in processes] == [0] * PROCESSES
    return folder, sorted(seen, key=lambda trial: trial["trial"])


def test_enough_runs_were_stopped(trials, capsys):
    _, seen = trials
    ends = Counter(trial["first"] for trial in seen if trial["step"] is None)
    steps = [trial for trial in seen if trial["step"] is not None]
    with capsys.disabled():  # the count is a result
        print(f"\n{len(seen)} trials: {len(steps)} kills at each step of writing; random times: {dict(ends)}")  # noqa: T201
    assert len(seen) == len(steps) + KILLS + 2 * SIGNALS
    assert [trial["first"] for trial in steps] == [-9] * len(steps)
    assert len(steps) > 20
    assert ends[-9] > KILLS / 3
    assert ends[130] > 0
    assert ends[143] > 0
    assert {trial["states"]["a"] for trial in seen} == {"old", "new", "absent"}


def test_a_stopped_run_leaves_each_output_old_new_or_absent(trials):
    for trial in trials[1]:
        assert trial["states"]["a"] in {"old", "new", "absent"}, trial
        assert trial["states"]["b"] == "same", trial


def test_only_a_kill_leaves_something_to_clear_up_and_the_next_run_does(trials):
    for trial in trials[1]:
        if trial["first"] >= 0:
            assert trial["hidden"] == [], trial
        assert trial["then"]["hidden"] == [], trial


def test_the_next_run_finishes_the_rest(trials):
    folder, seen = trials
    for trial in seen:
        assert trial["second"] == 0, trial
        assert trial["then"]["states"] == {"a": "new", "b": "same"}, trial
        assert_same(folder / f"{trial['trial']:03d}" / "out" / "a", folder / "new" / "a")


def test_an_interrupted_run_says_one_line(trials):
    words = {2: (130, "interrupted"), 15: (143, "terminated")}
    for trial in trials[1]:
        if trial["signal"] in words and trial["first"] != 0:
            code, word = words[trial["signal"]]
            said = f"tscorr: {word}; what was finished stays, the rest is done by the next run\n"
            assert (trial["first"], trial["said"]) == (code, said), trial
