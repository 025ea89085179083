"""What a Dask worker does for a batch: one task a scene, or for a large scene one a strip.

Only settings, names and numbers travel: every file is opened where it is read. A task may be done twice, at the same
time too, or be killed: results take their place by one rename. It stops soon after the run that asked for it ended.
"""

import json
import os
import socket
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed import Worker, WorkerPlugin, get_worker

from tscorr import __version__, publish
from tscorr.batch.lock import LOCK
from tscorr.batch.planning import library_of
from tscorr.config import Config
from tscorr.errors import InputError, OutputError
from tscorr.scene.correct import correct_scene, is_current, resume_key, target_of
from tscorr.scene.plan import Scene, plan_scene
from tscorr.scene.run import Progress
from tscorr.scene.strips import Strips, correct_strip, join, prepare

TURN = "tscorr"
"""the resource of which each worker has one: its threads work on the blocks of one scene at a time"""

Stamp = tuple[str, int, int]
"""path of an input, its size and its time of change [ns]"""


@dataclass(frozen=True, slots=True)
class Job:
    """One scene of a batch."""

    settings: Mapping[str, Any]
    """the configuration with this scene alone, as JSON has it"""
    only: tuple[str, ...]
    """the materials to correct; all if empty"""
    key: str
    """the scene's resume key"""
    inputs: tuple[Stamp, ...]
    holder: str
    """what the lock file of the output folder says while the run lives"""
    replaced: int
    """time of change of the manifest that stood in the scene's place at the start [ns], or 0"""
    split_mpixel: float
    version: str
    """of tscorr, where the run is"""

    @property
    def output(self) -> Path:
        """The folder of the batch's results."""
        return Path(self.settings["output"]["directory"])


class OneSceneAtATime(WorkerPlugin):  # type: ignore[misc] # distributed is Any to the type checker
    """Gives every worker, those that come later too, one turn."""

    name = "tscorr"

    async def setup(self, worker: Worker) -> None:
        """Let the scheduler know."""
        await worker.set_resources(**{TURN: 1})


def look(inputs: Iterable[Stamp], job: Job, dask_worker: Worker) -> list[str]:
    """What keeps a worker from taking part, one sentence each; empty where nothing does.

    inputs : of all jobs; `job` is any one of them.
    """
    problems = [*unseen(inputs), *_output_problems(job.output, job.holder)]
    if job.version != __version__:
        problems.append(f"has tscorr {__version__}; this is {job.version}: allowed is one version on all machines")
    limit, needed_mb = dask_worker.memory_manager.memory_limit, job.settings["run"]["memory_limit_mb"]
    if limit and limit < needed_mb * 1e6:
        problems.append(
            f"may use {limit / 1e6:.0f} MB of memory; [run] memory_limit_mb = {needed_mb}: allowed is no more than a "
            f"worker has"
        )
    return [f"{_name(dask_worker)} {problem}" for problem in problems]


def _name(worker: Worker) -> str:
    return f"worker {worker.address} on {socket.gethostname()}"


def stamp(path: Path) -> Stamp:
    """What tells one version of a file from another without reading it."""
    status = path.stat()
    return str(path), status.st_size, status.st_mtime_ns


def unseen(inputs: Iterable[Stamp]) -> list[str]:
    """Which inputs are missing here, or are other files."""
    problems = []
    for path, size, changed_ns in inputs:
        try:
            here = stamp(Path(path))
        except OSError as error:
            problems.append(f"cannot see the input {path}: {error.strerror}")
            continue
        if here[1:] != (size, changed_ns):
            problems.append(
                f"sees another file as the input {path}: {here[1]} bytes of {_time(here[2])}, not {size} of "
                f"{_time(changed_ns)}"
            )
    return problems


def _time(changed_ns: int) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(changed_ns / 1e9))


def _output_problems(output: Path, holder: str) -> list[str]:
    if not _is_held(output, holder):
        return [f"does not see the output folder {output} that this run holds"]
    if not os.access(output, os.W_OK | os.X_OK):
        return [f"cannot write to the output folder {output}"]
    return []


def _is_held(output: Path, holder: str) -> bool:
    """Whether the run that a task belongs to is at work in the output folder."""
    try:
        return (output / LOCK).read_text(encoding="utf-8") == holder
    except OSError:
        return False


def correct_whole(job: Job) -> dict[str, Any]:
    """Correct a scene and publish it, unless an earlier attempt has; the content of its report.json."""
    scene = _scene_of(job)
    return _published(job, scene) or correct_scene(scene, _while_held(job))


def prepare_strips(job: Job) -> float:
    """Find what no strip can know alone; the time at the start. [s]"""
    started = time.time()
    prepare(_strips_of(job))
    return started


def correct_one_strip(job: Job, number: int, started: float) -> None:
    """Correct a strip, after `prepare_strips`."""
    del started  # says only that the masks are there
    correct_strip(_strips_of(job), number, _while_held(job))


def join_strips(job: Job, started: float, parts: Iterable[None]) -> dict[str, Any]:
    """Publish a scene out of its strips, once all are there; the content of its report.json."""
    del parts
    strips = _strips_of(job)
    return _published(job, strips.scene) or join(strips, max(0.0, time.time() - started))


def _scene_of(job: Job) -> Scene:
    """The scene as this worker sees it; its threads are those of the worker. Raises InputError where it is another."""
    worker = get_worker()
    settings = Config.model_validate(job.settings)
    if problems := look(job.inputs, job, worker):
        raise InputError("\n".join(problems))
    run = settings.run.model_copy(update={"workers": worker.state.nthreads})
    settings = settings.model_copy(update={"run": run})
    scene = plan_scene(settings.scenes[0], settings, library_of(settings), job.only)
    if resume_key(scene) != job.key:
        raise InputError(f"{_name(worker)} finds other headers, materials or links to files than this run did")
    return scene


def _strips_of(job: Job) -> Strips:
    return Strips(_scene_of(job), job.split_mpixel)


def _published(job: Job, scene: Scene) -> dict[str, Any] | None:
    """The report that an earlier attempt of this run has published, whose worker was lost later."""
    target = target_of(scene)
    manifest = target / publish.MANIFEST
    if not is_current(scene) or manifest.stat().st_mtime_ns == job.replaced:
        return None
    report: dict[str, Any] = json.loads((target / "report.json").read_text(encoding="utf-8"))
    return report


def _while_held(job: Job) -> Progress:
    """Progress that raises OutputError once the run has ended, so that no worker goes on for nobody."""

    def check(pixels: int) -> None:
        del pixels
        if not _is_held(job.output, job.holder):
            raise OutputError(f"the run that wrote to {job.output} has ended")

    return check
