"""Small scenes are worked on side by side, within the workers and the memory, and come out as one after the other."""

import json
import threading

import numpy as np
import pytest
from small_scene import TILE, small_scene, write_config, write_image, write_inputs, write_raster

from tscorr import batch
from tscorr.batch import local
from tscorr.config import load_config
from tscorr.scene.cutting import BASE_MB, units_of

TIMES = {"seconds", "peak_rss_mb", "mpixel_per_s"}
SCENES = [{"name": f"s{i}", "direct_fraction": 1 - 0.1 * i} for i in range(5)]


class Started:
    """Scenes that have started and are not done, as the `progress` of a batch; the most at a time."""

    def __init__(self, pixels):
        self.pixels, self.left, self.together = pixels, {}, []
        self._lock = threading.Lock()

    def __call__(self, scene):
        with self._lock:
            self.left[scene.name] = self.pixels(scene)
            self.together.append({name for name, left in self.left.items() if left > 0})

        def done(pixels):
            with self._lock:
                self.left[scene.name] -= pixels

        return done


def content(folder):
    """Bytes of each file of a result, and what its report says but for the times."""
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in {".tif", ".png", ".qml"}}
    report = json.loads((folder / "report.json").read_text())
    return files, {key: value for key, value in report.items() if key not in TIMES}


def test_scenes_side_by_side_are_what_they_are_one_after_the_other(tmp_path):
    write_inputs(tmp_path)
    products = ["corrected", "flags", "removed", "azimuthal_width"]
    results = {}
    for workers in (1, 2, 4):
        output = {"directory": f"out{workers}", "quicklook": True, "products": products}
        config = write_config(tmp_path, *SCENES, output=output, run={"workers": workers, "memory_limit_mb": 1000})
        result = batch.run(config)
        assert [(scene.name, scene.state) for scene in result.scenes] == [(s["name"], "done") for s in SCENES]
        results[workers] = [content(tmp_path / f"out{workers}" / scene["name"]) for scene in SCENES]
    assert results[1] == results[2] == results[4]
    assert results[1][0] != results[1][1]


def test_two_workers_do_two_small_scenes_at_the_same_time(tmp_path):
    config = small_scene(tmp_path, *SCENES[:4], run={"workers": 2})
    met = threading.Barrier(2, timeout=60)  # breaks unless two scenes are there

    def start(_):
        met.wait()
        return lambda _: None

    assert batch.run(config, progress=start).exit_code == 0


@pytest.mark.parametrize("run", [{"workers": 1}, {"workers": 2, "memory_limit_mb": BASE_MB + 2}])
def test_one_worker_or_little_memory_does_one_scene_at_a_time(tmp_path, run):
    write_image(tmp_path / "image.tif", np.full((3, 128, 128), 4000, np.int16), blockxsize=128, blockysize=128)
    write_raster(tmp_path / "class_map.tif", np.full((128, 128), TILE, np.uint8))
    started = Started(lambda scene: scene.image.shape[0] * scene.image.shape[1])
    batch.run(write_config(tmp_path, *({"surface": None, **scene} for scene in SCENES), run=run), progress=started)
    assert [len(scenes) for scenes in started.together] == [1] * len(SCENES)


def test_a_scene_with_a_block_for_each_worker_is_done_alone_by_the_calling_thread(tmp_path, monkeypatch):
    write_inputs(tmp_path)
    write_image(tmp_path / "large.tif", np.full((3, 2048, 64), 4000, np.int16), blockxsize=64, blockysize=64)
    large = {"name": "large", "image": "large.tif", "scale": 1e-4}
    config = write_config(tmp_path, SCENES[0], SCENES[1], large, SCENES[2], run={"workers": 2})
    whole, seen = local.correct_scene, []

    def correct_scene(scene, progress):
        seen.append((scene.name, threading.current_thread() is threading.main_thread(), "enter"))
        try:
            return whole(scene, progress)
        finally:
            seen.append((scene.name, threading.current_thread() is threading.main_thread(), "leave"))

    monkeypatch.setattr(local, "correct_scene", correct_scene)
    assert batch.run(config).exit_code == 0
    sizes = {scene.name: len(units_of(scene)) for scene in batch.plan(load_config(config))}
    assert sizes == {"s0": 1, "s1": 1, "large": 4, "s2": 1}
    first = seen.index(("large", True, "enter"))
    assert seen[first + 1] == ("large", True, "leave")
    assert {name for name, *_ in seen[:first]} == {"s0", "s1"}
    assert not any(main for name, main, _ in seen if name != "large")


def test_an_error_of_one_scene_leaves_those_beside_it_alone(tmp_path, monkeypatch):
    config = small_scene(tmp_path, *SCENES, run={"workers": 3})
    whole = local.correct_scene

    def correct_scene(scene, progress):
        if scene.name == "s1":
            raise ValueError("for a test")
        return whole(scene, progress)

    monkeypatch.setattr(local, "correct_scene", correct_scene)
    result = batch.run(config)
    assert [scene.state for scene in result.scenes] == ["done", "failed", "done", "done", "done"]
    assert "for a test (a fault of tscorr; please report it)" in result.scenes[1].error


def test_what_scenes_share_is_hashed_once_though_they_start_together(tmp_path, monkeypatch):
    config = small_scene(tmp_path, *SCENES, run={"workers": 4})
    hashed, whole = [], batch.runner.publish.digest

    def digest(path, algorithm, stop=None):
        hashed.append(path.name)
        return whole(path, algorithm, stop)

    monkeypatch.setattr(batch.runner.publish, "digest", digest)
    batch.run(config)
    assert hashed.count("dsm.tif") == 1
