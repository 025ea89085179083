"""batch: what is done stays done, what changed is done again, and one broken scene does not stop the rest."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_scene import (
    SHAPE,
    TILE,
    small_scene,
    write_config,
    write_image,
    write_inputs,
    write_raster,
    write_truncated_image,
)

from tscorr import batch, publish
from tscorr.config import load_config
from tscorr.errors import ConfigError, InputError, MaterialError, TscorrError

LIBRARY = """
[tiles]
t0 = 0.02
t1 = {t1}
w = 0.04
n = 1.7
"""


def states(config, **options):
    """State of each scene of a run, by name."""
    return {scene.name: scene.state for scene in batch.run(config, **options).scenes}


def hidden(folder):
    """Folders of work that was not finished."""
    return [path.name for path in folder.rglob(".*")]


def prints(folder):
    """Identity and time of change of every file of the published scenes."""
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.glob("*/*")}


def test_a_second_run_computes_nothing_and_touches_nothing(tmp_path):
    config = small_scene(tmp_path)
    assert states(config) == {"roofs": "done"}
    before = prints(tmp_path / "out")
    started = []
    assert states(config, progress=started.append) == {"roofs": "current"}
    assert started == []
    assert prints(tmp_path / "out") == before
    result = batch.run(config)
    assert result.exit_code == 0
    assert result.scenes[0].report["scene"] == "roofs"


def test_overwrite_computes_again_and_gives_the_same(tmp_path):
    config = small_scene(tmp_path)
    batch.run(config)
    before = (tmp_path / "out/roofs/corrected.tif").read_bytes()
    assert states(config, overwrite=True) == {"roofs": "done"}
    assert (tmp_path / "out/roofs/corrected.tif").read_bytes() == before


MATERIALS = {"library": ["own.toml"], "classes": {str(TILE): "tiles"}}


def table_of(**changes):
    """Sections of a configuration whose scene uses a library of its own."""
    return {"materials": MATERIALS, "output": {"directory": "out", "quicklook": False}, **changes}


def test_a_restricted_run_is_not_taken_for_a_whole_one(tmp_path):
    config = small_scene(tmp_path)
    assert states(config, materials=["roof_tile"]) == {"roofs": "done"}
    assert states(config) == {"roofs": "done"}


@pytest.fixture
def with_a_broken_scene(tmp_path):
    """A configuration of three scenes, whose second image is cut short."""
    write_inputs(tmp_path)
    write_truncated_image(tmp_path / "cut.tif")
    broken = {"name": "b", "image": "cut.tif", "scale": 1e-4}
    return write_config(tmp_path, {"name": "a"}, broken, {"name": "c"}, title="<b>three</b>")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_scene_that_fails_does_not_stop_the_rest(tmp_path, with_a_broken_scene, workers):
    result = batch.run(with_a_broken_scene, workers=workers)
    assert [scene.state for scene in result.scenes] == ["done", "failed", "done"]
    assert result.exit_code == 1
    error = result.scenes[1].error
    assert f"{tmp_path / 'cut.tif'} cannot be read at rows" in error
    assert not (tmp_path / "out" / "b").exists()
    assert hidden(tmp_path) == []
    overview = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert [(scene["scene"], scene["state"]) for scene in overview["scenes"]] == [
        ("a", "done"),
        ("b", "failed"),
        ("c", "done"),
    ]
    assert overview["scenes"][1]["error"] == error
    page = (tmp_path / "out" / "index.html").read_text()
    assert "cut.tif cannot be read" in page
    assert "<b>three</b>" not in page


def test_the_next_run_tries_what_failed_and_only_that(tmp_path, with_a_broken_scene):
    batch.run(with_a_broken_scene)
    assert states(with_a_broken_scene) == {"a": "current", "b": "failed", "c": "current"}
    shutil.copy(tmp_path / "image.tif", tmp_path / "cut.tif")
    assert states(with_a_broken_scene) == {"a": "current", "b": "done", "c": "current"}


def test_when_every_scene_fails_the_exit_code_says_so(with_a_broken_scene):
    result = batch.run(with_a_broken_scene, scenes=["b"])
    assert [scene.state for scene in result.scenes] == ["failed"]
    assert result.exit_code == 3


def test_a_failure_leaves_the_earlier_result_as_it_was(tmp_path):
    config = small_scene(tmp_path, {"scale": 1e-4})
    batch.run(config)
    before = prints(tmp_path / "out")
    write_truncated_image(tmp_path / "image.tif")
    assert states(config) == {"roofs": "failed"}
    assert prints(tmp_path / "out") == before
    assert hidden(tmp_path) == []


def test_an_interruption_leaves_nothing_half_done(tmp_path):
    write_inputs(tmp_path)
    config = write_config(tmp_path, {"name": "a"}, {"name": "b"})

    def interrupting(scene):
        def pixels(_):
            if scene.name == "b":
                raise KeyboardInterrupt

        return pixels

    with pytest.raises(KeyboardInterrupt):
        batch.run(config, progress=interrupting)
    assert (tmp_path / "out" / "a").is_dir()
    assert not (tmp_path / "out" / "b").exists()
    assert hidden(tmp_path) == []
    assert states(config) == {"a": "current", "b": "done"}


def test_an_output_folder_that_cannot_be_made_is_found_before_work(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ConfigError, match=r"\[output\] directory = .*out is not a folder"):
        batch.run(small_scene(tmp_path))
    assert (tmp_path / "out").read_text() == "a file"


def test_progress_counts_every_pixel(tmp_path):
    done = []
    batch.run(small_scene(tmp_path), progress=lambda _: done.append)
    assert sum(done) == SHAPE[0] * SHAPE[1]


def test_the_problems_of_all_scenes_are_told_at_once(tmp_path):
    write_inputs(tmp_path)
    config = write_config(tmp_path, {"name": "a", "image": "nix.tif"}, {"name": "b"}, {"name": "c", "sun": None})
    with pytest.raises(InputError) as caught:
        batch.run(config)
    first, second = str(caught.value).splitlines()
    assert first == f"scene 'a': {tmp_path / 'nix.tif'} does not exist"
    assert second.startswith(f"scene 'c': the image {tmp_path / 'image.tif'} has no sun")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenes": ["rofs"]}, r"no scene 'rofs' \(did you mean 'roofs'\?\); the configuration has roofs"),
        ({"materials": ["roof_til"]}, r"no material 'roof_til' \(did you mean 'roof_tile'\?\)"),
    ],
)
def test_names_to_restrict_a_run_to_must_be_known(tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        batch.run(small_scene(tmp_path), **options)


def test_a_material_that_no_library_has_is_named_with_the_nearest(tmp_path):
    config = small_scene(tmp_path, materials={"classes": {"1": "roof_tyle"}})
    with pytest.raises(MaterialError, match=r"no material 'roof_tyle' \(did you mean 'roof_tile'\?\)"):
        batch.run(config)


def test_a_library_of_the_configuration_lies_over_the_built_in_one(tmp_path):
    (tmp_path / "own.toml").write_text(LIBRARY.format(t1=0.5).replace("tiles", "roof_tile"))
    config = small_scene(tmp_path, materials={"library": ["own.toml"], "classes": {"1": "roof_tile"}})
    library = batch.library_of(load_config(config))
    assert library["roof_tile"].t1 == (0.5,)
    assert "red_aluminum" in library


OPEN_FILES = Path("/proc/self/fd")


@pytest.mark.skipif(not OPEN_FILES.is_dir(), reason="open files are counted in /proc")
def test_a_batch_of_many_scenes_keeps_no_file_open(tmp_path):
    write_inputs(tmp_path)
    config = write_config(tmp_path, *({"name": f"s{i}"} for i in range(6)))
    batch.run(config, scenes=["s0"])
    before = len(list(OPEN_FILES.iterdir()))
    batch.run(config)
    assert len(list(OPEN_FILES.iterdir())) == before


@pytest.mark.parametrize("seed", range(12))
def test_flipped_bytes_of_an_image_leave_the_old_result_or_make_a_whole_new_one(with_a_result, seed):
    config, target = with_a_result
    rng = np.random.default_rng(seed)
    content = bytearray((config.parent / "image.tif").read_bytes())
    for place in rng.integers(0, len(content), 4):
        content[place] ^= 1 << rng.integers(8)
    (config.parent / "image.tif").write_bytes(content)
    assert_old_or_whole(config, target)


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.3, 0.6, 0.9, 0.999])
def test_an_image_cut_short_leaves_the_old_result(with_a_result, kept):
    config, target = with_a_result
    content = (config.parent / "image.tif").read_bytes()
    (config.parent / "image.tif").write_bytes(content[: int(kept * len(content))])
    assert_old_or_whole(config, target)


@pytest.fixture
def with_a_result(tmp_path):
    """A configuration whose scene is published, and that result's folder."""
    config = small_scene(tmp_path)
    assert states(config) == {"roofs": "done"}
    return config, tmp_path / "out" / "roofs"


def assert_old_or_whole(config, target):
    """Run on a damaged input: refused, failed, or done; the result is whole whatever comes."""
    before = (target / "manifest.json").read_bytes()
    try:
        done = states(config) == {"roofs": "done"}
    except TscorrError:
        done = False
    assert publish.damaged(target) == []
    assert ((target / "manifest.json").read_bytes() == before) == (not done)
    assert hidden(config.parent) == []


BUSY = """
import sys, threading, time
from pathlib import Path
from tscorr import batch, publish

def states():
    for task in Path("/proc/self/task").iterdir():
        try:
            name, rest = (task / "stat").read_text().rsplit(")", 1)
            yield int(task.name), rest.split()[0], sum(map(int, rest.split()[11:13]))
        except OSError:
            pass

def ticks():
    return {task: used for task, _, used in states()}

batch.run(sys.argv[1], workers=int(sys.argv[2]))  # compiled and loaded
mine, before = threading.get_native_id(), ticks()
most = 0
ended = threading.Event()

def watch():
    global most
    me, known = threading.get_native_id(), set()
    while not ended.wait(0.002):
        running = [task for task, state, _ in states() if state == "R" and task not in (me, mine)]
        alive = {thread.native_id for thread in threading.enumerate()}
        known |= alive  # of those who are no longer, the system may still have to put one away
        most = max(most, sum(task in alive or task not in known for task in running))

watcher = threading.Thread(target=watch)
watcher.start()
batch.run(sys.argv[1], workers=int(sys.argv[2]), overwrite=True)
ended.set()
watcher.join()
print(most)
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted in /proc")
@pytest.mark.parametrize("workers", [1, 2])
def test_no_more_threads_are_busy_than_there_are_workers(tmp_path, workers):
    write_image(tmp_path / "image.tif", np.full((3, 1024, 1024), 4000, np.int16), blockxsize=64, blockysize=64)
    write_raster(tmp_path / "class_map.tif", np.full((1024, 1024), TILE, np.uint8))
    write_raster(tmp_path / "dsm.tif", np.ones((1024, 1024), np.float32))
    config = write_config(tmp_path, run={"memory_limit_mb": 390})
    command = [sys.executable, "-c", BUSY, config, str(workers)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(result.stdout) <= workers + 1  # one hashes the inputs beside the work
