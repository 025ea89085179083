"""cluster: a batch on a Dask cluster of two processes gives what a batch on this machine gives, whatever dies."""

import json
import os
import signal
import socket
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from click.testing import CliRunner
from small_scene import read_raster, write_config, write_truncated_image
from test_40_strips import SPLIT_MPIXEL, tall_inputs, without_times

from tscorr import batch, publish
from tscorr.batch import cluster as driver
from tscorr.batch import tasks
from tscorr.cli import cli
from tscorr.config import load_config
from tscorr.errors import ConfigError, InputError, OutputError

distributed = pytest.importorskip("distributed")

THREADS = 2
NAMES = "north", "south"
SUNS = 60.0, 50.0
PRODUCTS = ["corrected", "flags", "removed"]


@pytest.fixture(scope="module")
def cluster():
    """A scheduler in this process and two worker processes of two threads."""
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=THREADS,
        processes=True,
        dashboard_address=":0",
        memory_limit="4GB",
        silence_logs=50,
    ) as started:
        yield started


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cluster")
    tall_inputs(folder)
    return folder


def config_of(inputs, output, *scenes, **run):
    """Two scenes that differ by their sun, or others."""
    suns = [
        {"name": name, "sun": {"zenith_deg": zenith, "azimuth_deg": 170.0}}
        for name, zenith in zip(NAMES, SUNS, strict=True)
    ]
    path = write_config(
        inputs,
        *(scenes or suns),
        output={"directory": output, "quicklook": False, "products": PRODUCTS},
        run={"workers": THREADS, **run},
    )
    return path.rename(inputs / f"{output}.toml")


@pytest.fixture(scope="module")
def local(inputs):
    """The batch on this machine."""
    return batch.run(config_of(inputs, "local"))


@pytest.fixture(scope="module")
def whole(cluster, inputs):
    """The batch on the cluster, a task a scene."""
    return batch.run(config_of(inputs, "whole"), scheduler=cluster.scheduler_address)


def hidden(folder):
    return [path.name for path in folder.glob(".*")]


def assert_equal(result, expected):
    """The same scenes with the same values, flags and reports, all of them whole."""
    assert [(scene.name, scene.state) for scene in result.scenes] == [(name, "done") for name in NAMES]
    for mine, theirs in zip(result.scenes, expected.scenes, strict=True):
        assert without_times(mine.report) == without_times(theirs.report)
        for product in PRODUCTS:
            (path,) = (path for s in ("vrt", "tif") if (path := mine.folder / f"{product}.{s}").exists())
            assert read_raster(path).tobytes() == read_raster(theirs.folder / f"{product}.tif").tobytes()
        assert publish.damaged(mine.folder) == []
    assert hidden(result.folder) == []


def test_a_task_a_scene_gives_what_this_machine_gives(whole, local):
    assert_equal(whole, local)
    assert whole.exit_code == 0
    overview = json.loads((whole.folder / "batch.json").read_text())
    assert [(scene["scene"], scene["state"]) for scene in overview["scenes"]] == [(name, "done") for name in NAMES]
    assert "north" in (whole.folder / "index.html").read_text()
    assert "scene 'south' done" in (whole.folder / "batch.log").read_text()


def test_what_is_current_needs_no_cluster(whole):
    config = whole.folder.with_suffix(".toml")
    again = batch.run(config, scheduler="tcp://127.0.0.1:1")
    assert {scene.state for scene in again.scenes} == {"current"}


def test_a_task_a_strip_gives_the_same_though_a_worker_is_killed(cluster, inputs, local):
    """The worker that is killed is at work; nothing but time is lost."""
    config = config_of(inputs, "strips", scheduler=cluster.scheduler_address, split_mpixel=SPLIT_MPIXEL)
    killed, told = [], []

    def killing(scene):
        def pixels(count):
            told.append((scene.name, count))
            busy = [state for state in cluster.scheduler.workers.values() if state.processing]
            if not killed and busy:
                (nanny,) = (worker for worker in cluster.workers.values() if worker.worker_address == busy[0].address)
                os.kill(nanny.pid, signal.SIGKILL)
                killed.append(nanny.pid)

        return pixels

    result = batch.run(config, progress=killing)
    assert len(killed) == 1
    assert_equal(result, local)
    for scene in result.scenes:
        assert len(list(scene.folder.glob("corrected.????.tif"))) == 3
        assert sum(count for name, count in told if name == scene.name) == 1296 * 64


def test_an_interruption_cancels_the_rest_and_the_next_run_goes_on(cluster, inputs, local):
    config = config_of(inputs, "interrupted", scheduler=cluster.scheduler_address, split_mpixel=SPLIT_MPIXEL)

    def interrupting(_):
        def pixels(_):
            raise KeyboardInterrupt

        return pixels

    with pytest.raises(KeyboardInterrupt):
        batch.run(config, progress=interrupting)
    assert not list((inputs / "interrupted").glob("*/manifest.json"))
    deadline = time.monotonic() + 10
    while any(state.processing for state in cluster.scheduler.workers.values()) and time.monotonic() < deadline:
        time.sleep(0.05)
    kept = {path: path.stat().st_mtime_ns for path in inputs.glob("interrupted/.*.strips/????/manifest.json")}
    assert kept
    seen = []

    def noting(_):
        def pixels(count):
            del count
            now = {path: path.stat().st_mtime_ns for path in kept if path.exists()}
            seen.append(now.items() <= kept.items())

        return pixels

    assert_equal(batch.run(config, progress=noting), local)
    assert all(seen)


def test_a_scene_that_fails_does_not_stop_the_rest(cluster, inputs):
    write_truncated_image(inputs / "cut.tif")
    scenes = {"name": "good"}, {"name": "cut", "image": "cut.tif", "scale": 1e-4}
    result = batch.run(config_of(inputs, "failing", *scenes), scheduler=cluster.scheduler_address)
    assert [(scene.name, scene.state) for scene in result.scenes] == [("good", "done"), ("cut", "failed")]
    assert result.exit_code == 1
    assert f"{inputs / 'cut.tif'} cannot be read at rows" in result.scenes[1].error
    assert json.loads((result.folder / "batch.json").read_text())["scenes"][1]["error"] == result.scenes[1].error
    assert hidden(result.folder) == []


def job_of(config):
    """The job of the first scene as the driver sends it, while a lock of our own is held."""
    (scene, *_) = batch.plan(load_config(config))
    folder = Path(scene.config.output.directory)
    folder.mkdir(exist_ok=True)
    (folder / driver.LOCK).write_text("held by a test")
    return driver._job(scene)


def test_a_task_done_twice_publishes_once(cluster, inputs):
    job = job_of(config_of(inputs, "twice"))
    manifest = inputs / "twice" / "north" / "manifest.json"
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        first = client.submit(tasks.correct_whole, job, pure=False).result()
        before = manifest.stat().st_mtime_ns
        assert client.submit(tasks.correct_whole, job, pure=False).result() == first
        assert manifest.stat().st_mtime_ns == before
        again = job_of(inputs / "twice.toml")  # as with --overwrite
        client.submit(tasks.correct_whole, again, pure=False).result()
        assert manifest.stat().st_mtime_ns > before


def test_a_task_stops_when_its_run_has_ended(inputs):
    job = job_of(config_of(inputs, "ended"))
    progress = tasks._while_held(job)
    progress(1)
    (job.output / driver.LOCK).write_text("held by another run")
    with pytest.raises(OutputError, match=r"the run that wrote to .*ended has ended"):
        progress(1)
    (job.output / driver.LOCK).unlink()
    with pytest.raises(OutputError):
        progress(1)


def test_only_plain_values_travel(inputs):
    job = job_of(config_of(inputs, "plain"))
    assert json.loads(json.dumps(job.settings)) == job.settings
    assert [scene["name"] for scene in job.settings["scenes"]] == ["north"]


def busy_for(seconds):
    """When a task ran, and in which process; the threads that its scene would have."""
    started = time.time()
    time.sleep(seconds)
    return os.getpid(), started, time.time(), distributed.get_worker().state.nthreads


def test_a_worker_has_one_scene_at_a_time_whatever_its_threads(cluster, whole):
    del whole  # which told the workers
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        futures = [client.submit(busy_for, 0.1, resources={tasks.TURN: 1}, pure=False) for _ in range(6)]
        runs = sorted(client.gather(futures))
    assert {threads for *_, threads in runs} == {THREADS}
    assert len({pid for pid, *_ in runs}) == 2
    for (pid, _, ended, _), (next_pid, started, _, _) in pairwise(runs):
        assert pid != next_pid or started >= ended


def moved(path):
    return f"{path}.elsewhere", 1, 1


def older(path):
    return str(path), path.stat().st_size, 0


@pytest.mark.parametrize(
    ("stamp", "message"),
    [
        (moved, r"cannot see the input .*image\.tif\.elsewhere: No such file"),
        (older, r"sees another file as the input .*image\.tif: \d+ bytes of 20.*, not \d+ of 1970-01-01"),
    ],
)
def test_a_worker_that_cannot_see_an_input_says_so_before_work(cluster, inputs, monkeypatch, stamp, message):
    monkeypatch.setattr(tasks, "stamp", stamp)
    worker = rf"worker tcp://127\.0\.0\.1:\d+ on {socket.gethostname()} "
    with pytest.raises(InputError, match=worker + message):
        batch.run(config_of(inputs, "unseen"), scheduler=cluster.scheduler_address)
    assert hidden(inputs / "unseen") == []


def test_a_worker_that_comes_later_says_so_too(cluster, inputs, monkeypatch):
    monkeypatch.setattr(tasks, "stamp", moved)
    turns = tasks.OneSceneAtATime()  # without them, which are all that is left of the check, no worker starts
    monkeypatch.setattr(driver, "_check_workers", lambda client, _: client.register_plugin(turns))
    result = batch.run(config_of(inputs, "late"), scheduler=cluster.scheduler_address)
    assert result.exit_code == 3
    assert f"on {socket.gethostname()} cannot see the input" in result.scenes[0].error


def test_workers_must_share_the_output_folder_and_the_version(cluster, inputs, monkeypatch):
    monkeypatch.setattr(driver, "__version__", "9.9")
    made = driver._job
    monkeypatch.setattr(driver, "_job", lambda *arguments: _held_by_another(made(*arguments)))
    with pytest.raises(InputError) as caught:
        batch.run(config_of(inputs, "other"), scheduler=cluster.scheduler_address)
    text = str(caught.value)
    assert text.count(f"does not see the output folder {inputs / 'other'} that this run holds") == 2
    assert "has tscorr 0.1.0; this is 9.9" in text


def _held_by_another(job):
    from dataclasses import replace

    return replace(job, holder="another run")


def test_a_worker_must_have_the_memory_that_a_scene_may_use(cluster, inputs):
    config = config_of(inputs, "large", scheduler=cluster.scheduler_address, memory_limit_mb=5000)
    with pytest.raises(InputError, match=r"may use 4000 MB of memory; \[run\] memory_limit_mb = 5000"):
        batch.run(config)


def refused(config, address):
    """Message, exit code and seconds of a run on a scheduler that is none."""
    started = time.monotonic()
    result = CliRunner().invoke(cli, ["run", str(config), "--scheduler", address])
    return result.stderr, result.exit_code, time.monotonic() - started


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere://x:1", "tcp://127.0.0.1"])
def test_a_scheduler_that_is_not_there_is_one_clear_error(inputs, address, monkeypatch):
    monkeypatch.setattr(driver, "CONNECT_S", 1)
    text, code, seconds = refused(config_of(inputs, "nobody"), address)
    assert text.startswith(f"tscorr: the scheduler {address} does not answer (")
    assert text.count("\n") == 1
    assert code == 2
    assert seconds < 10
    assert hidden(inputs / "nobody") == []


def test_a_port_that_does_not_answer_is_one_clear_error(inputs, monkeypatch):
    monkeypatch.setattr(driver, "CONNECT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        text, code, seconds = refused(config_of(inputs, "silent"), address)
    assert text.startswith(f"tscorr: the scheduler {address} does not answer (")
    assert code == 2
    assert seconds < 10


def test_without_dask_the_error_names_what_to_install(inputs, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"needs Dask: pip install tscorr\[dask\]"):
        batch.run(config_of(inputs, "without"), scheduler="tcp://127.0.0.1:1")


def test_a_scheduler_that_is_lost_on_the_way_is_one_clear_error(cluster, inputs, monkeypatch):
    def lost(*_):
        raise distributed.comm.CommClosedError("stream is closed")

    monkeypatch.setattr(driver, "_check_workers", lost)
    with pytest.raises(ConfigError, match=r"the scheduler tcp://.* was lost: stream is closed"):
        batch.run(config_of(inputs, "lost"), scheduler=cluster.scheduler_address)
    assert hidden(inputs / "lost") == []
