"""lock: one batch at a time in a folder; who holds it is named, and who died holds nothing."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from small_scene import small_scene

from tscorr import batch, publish
from tscorr.batch import lock
from tscorr.errors import ConfigError, OutputError

HOLDER = """
import sys, time
from pathlib import Path
from tscorr.batch.lock import locked

with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the folder `out`."""
    process = subprocess.Popen([sys.executable, "-c", HOLDER, tmp_path / "out"], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    yield process
    process.kill()
    process.communicate()


def sign(path, **holder):
    """Leave a lock file as a process that is gone would."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"pid": 1, "host": "elsewhere", "since": "2026-01-01T00:00:00+00:00", **holder}))


def test_the_second_batch_says_who_holds_the_folder_and_touches_nothing(tmp_path, holder):
    (tmp_path / "out" / ".roofs.01234567.part").mkdir()
    with pytest.raises(OutputError) as caught:
        batch.run(small_scene(tmp_path))
    said = (
        f"{tmp_path / 'out'} is being written by another batch: process {holder.pid} on {socket.gethostname()}, since"
    )
    assert str(caught.value).startswith(said)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".roofs.01234567.part", lock.LOCK]


def test_a_holder_that_was_killed_holds_nothing(tmp_path, holder):
    holder.kill()
    holder.wait()
    assert (tmp_path / "out" / lock.LOCK).exists()
    assert batch.run(small_scene(tmp_path)).exit_code == 0
    assert not (tmp_path / "out" / lock.LOCK).exists()


def test_a_process_of_this_machine_that_is_gone_is_not_asked_for(tmp_path):
    sign(tmp_path / lock.LOCK, host=socket.gethostname(), pid=os.getpid())  # a number that was given anew
    with lock.locked(tmp_path):
        assert json.loads((tmp_path / lock.LOCK).read_text())["pid"] == os.getpid()


def test_another_machine_holds_the_folder_as_long_as_it_gives_signs_of_life(tmp_path):
    path = tmp_path / "out" / lock.LOCK
    sign(path)
    with pytest.raises(OutputError, match=rf"process 1 on elsewhere.* if it is gone, remove {path}"):
        batch.run(small_scene(tmp_path))
    assert json.loads(path.read_text())["host"] == "elsewhere"
    old = time.time() - 2 * lock.ALIVE_S
    os.utime(path, (old, old))
    assert batch.run(small_scene(tmp_path)).exit_code == 0


def test_the_holder_gives_signs_of_life(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "RENEWED_S", 0.01)
    with lock.locked(tmp_path):
        path = tmp_path / lock.LOCK
        os.utime(path, (0, 0))
        deadline = time.monotonic() + 10
        while path.stat().st_mtime == 0 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert time.time() - path.stat().st_mtime < 60


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00"])
def test_a_lock_file_that_says_nothing_is_taken_over(tmp_path, text):
    (tmp_path / lock.LOCK).write_text(text)
    with lock.locked(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_the_lock_is_let_go_whatever_happens(tmp_path, error):
    with pytest.raises(error), lock.locked(tmp_path):
        raise error
    with lock.locked(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_while_the_lock_is_signed_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(lock.os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt), lock.locked(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_of_many_at_once_one_holds_the_folder_at_a_time(tmp_path):
    inside, most = [], []

    def work(_):
        for _ in range(200):
            try:
                with lock.locked(tmp_path):
                    inside.append(1)
                    most.append(len(inside))
                    inside.pop()
                    return True
            except OutputError:
                time.sleep(0.001)
        return False

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(work, range(40)))
    assert set(most) == {1}


def test_a_file_that_its_holder_removes_meanwhile_is_made_anew(tmp_path, monkeypatch):
    real, removed = lock._take, []

    def late(descriptor, path):
        if not removed:
            removed.append(path)
            path.unlink()
        real(descriptor, path)

    monkeypatch.setattr(lock, "_take", late)
    with lock.locked(tmp_path):
        assert json.loads((tmp_path / lock.LOCK).read_text())["pid"] == os.getpid()


def test_a_lock_is_no_result(tmp_path):
    config = small_scene(tmp_path)
    result = batch.run(config)
    sign(tmp_path / "out" / lock.LOCK, host=socket.gethostname())
    assert publish.damaged(tmp_path / "out" / "roofs") == []
    assert [scene.state for scene in batch.run(config).scenes] == ["current"]
    assert result.scenes[0].state == "done"


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    folder = tmp_path / "file" / "out"
    message = rf"\[output\] directory = {folder} cannot be written"
    with pytest.raises(ConfigError, match=message), lock.locked(folder):
        pass


def test_a_file_system_without_locks_costs_a_warning(tmp_path, monkeypatch, caplog):
    def unsupported(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(lock.fcntl, "flock", unsupported)
    with lock.locked(tmp_path):
        pass
    assert f"the file system of {tmp_path} has no locks" in caplog.text


def test_a_terminated_run_lets_go(tmp_path):
    config = small_scene(tmp_path, {"name": "a"}, {"name": "b"})
    run = subprocess.Popen([sys.executable, "-m", "tscorr", "run", config], stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "out" / "batch.log").exists():
        time.sleep(0.01)
        assert run.poll() is None
    run.send_signal(signal.SIGTERM)
    assert run.communicate()[1] == "tscorr: terminated; what was finished stays, the rest is done by the next run\n"
    assert run.returncode == 143
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")] == []
