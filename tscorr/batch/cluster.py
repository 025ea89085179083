"""The scenes of a batch on a Dask cluster whose machines share a file system.

One task a scene, or for a large scene one a strip; each worker has one task at a time, whose threads are its own. The
scheduler gives the tasks of a lost worker to another one, and tries again what failed.
"""

import asyncio
import json
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from tscorr import __version__, publish
from tscorr.batch.lock import LOCK
from tscorr.batch.outcome import SceneOutcome, SceneProgress
from tscorr.errors import ConfigError, InputError, TscorrError
from tscorr.scene.correct import is_current, resume_key, target_of
from tscorr.scene.plan import Scene
from tscorr.scene.strips import Strips, clear

log = logging.getLogger("tscorr")

CONNECT_S = 5
RETRIES = 2
"""of a task that failed; a task whose worker died is given to others first (distributed.scheduler.allowed-failures)"""
MOST_PROBLEMS = 10
"""of workers that are named in one error"""


@dataclass(slots=True)
class Work:
    """The tasks of one scene: the last one returns its report."""

    scene: Scene
    last: Any
    strips: Mapping[Any, int] = field(default_factory=dict)
    """pixels by future"""

    @property
    def futures(self) -> list[Any]:
        """All that must be waited for."""
        return [*self.strips, self.last]


def outcomes(planned: Sequence[Scene], overwrite: bool, progress: SceneProgress) -> Iterator[SceneOutcome]:
    """Correct the scenes that are not current on the cluster of [run] scheduler; in the order of `planned`.

    Raises ConfigError without distributed and where the scheduler does not answer, InputError where a worker cannot
    see what it must.
    """
    found = {scene.name: _current(scene) for scene in planned if not overwrite}
    todo = [scene for scene in planned if found.get(scene.name) is None]
    if todo:
        with _connected(str(todo[0].config.run.scheduler)) as client:
            jobs = [_job(scene) for scene in todo]
            _check_workers(client, jobs)
            work = [_submitted(client, scene, job, overwrite) for scene, job in zip(todo, jobs, strict=True)]
            found |= {outcome.name: outcome for outcome in _finished(client, work, progress)}
    for scene in planned:
        outcome = found[scene.name]
        assert outcome is not None
        yield outcome


def _current(scene: Scene) -> SceneOutcome | None:
    if not is_current(scene):
        return None
    log.info("scene '%s' is current", scene.name)
    target = target_of(scene)
    report = json.loads((target / "report.json").read_text(encoding="utf-8"))
    return SceneOutcome.of(scene.name, "current", target, report)


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """A client of the scheduler."""
    try:
        from distributed import Client
        from distributed.comm import CommClosedError
    except ImportError:
        raise ConfigError(f"the scheduler {address} needs Dask: pip install tscorr[dask]") from None
    try:
        with ThreadPoolExecutor(1) as pool:  # whose thread has no event loop yet, as that of a notebook has
            pool.submit(asyncio.run, _greeted(address)).result()
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = str(error) or f"within {CONNECT_S} s"
        raise ConfigError(
            f"the scheduler {address} does not answer ({reason}); allowed is the address that dask-scheduler prints, "
            f"such as tcp://host:8786"
        ) from None
    try:
        yield client
    except CommClosedError as error:
        raise ConfigError(f"the scheduler {address} was lost: {error}") from None
    finally:
        client.close(timeout=CONNECT_S)


async def _greeted(address: str) -> None:
    """Raise TimeoutError unless a scheduler greets us: a client waits for ever on a port that takes calls only."""
    from distributed import Security
    from distributed.comm import connect

    async with asyncio.timeout(CONNECT_S):
        comm = await connect(address, timeout=CONNECT_S, **Security().get_connection_args("client"))
    comm.abort()


def _job(scene: Scene) -> Any:
    """What a worker has to know of a scene."""
    from tscorr.batch.tasks import Job, stamp

    manifest = target_of(scene) / publish.MANIFEST
    return Job(
        settings=scene.config.model_copy(update={"scenes": [scene.settings]}).model_dump(mode="json"),
        only=scene.only,
        key=resume_key(scene),
        inputs=tuple(map(stamp, scene.inputs)),
        holder=(target_of(scene).parent / LOCK).read_text(encoding="utf-8"),
        replaced=manifest.stat().st_mtime_ns if manifest.exists() else 0,
        split_mpixel=scene.config.run.split_mpixel,
        version=__version__,
    )


def _check_workers(client: Any, jobs: Sequence[Any]) -> None:
    """Raise InputError unless all workers see all files and have this version; gives each one turn."""
    from tscorr.batch import tasks

    inputs = sorted({stamp for job in jobs for stamp in job.inputs})
    answers = client.run(tasks.look, inputs, jobs[0], on_error="return")
    if not answers:
        log.warning("the scheduler %s has no workers yet; waiting for one", client.scheduler.address)
    problems = [problem for address, answer in answers.items() for problem in _problems(address, answer)]
    if problems:
        more = [f"and {len(problems) - MOST_PROBLEMS} more"] if len(problems) > MOST_PROBLEMS else []
        rule = "the workers of a cluster need the same tscorr, and all files under the same paths as here"
        raise InputError("\n".join([*problems[:MOST_PROBLEMS], *more, rule]))
    client.register_plugin(tasks.OneSceneAtATime())


def _problems(address: str, answer: Any) -> list[str]:
    if isinstance(answer, BaseException):
        return [f"worker {address} cannot take part: {type(answer).__name__}: {answer}"]
    return list(answer)


def _submitted(client: Any, scene: Scene, job: Any, overwrite: bool) -> Work:
    """The tasks of a scene on their way."""
    from tscorr.batch import tasks

    options = {"retries": RETRIES, "resources": {tasks.TURN: 1}, "pure": False}
    strips = Strips(scene, job.split_mpixel)
    blocks = strips.blocks
    clear(scene, keep=None if overwrite or len(blocks) == 1 else strips.folder)
    if len(blocks) == 1:
        return Work(scene, client.submit(tasks.correct_whole, job, **options))
    first = client.submit(tasks.prepare_strips, job, **options)
    parts = {
        client.submit(tasks.correct_one_strip, job, number, first, **options): block.height * block.width
        for number, block in enumerate(blocks)
    }
    return Work(scene, client.submit(tasks.join_strips, job, first, list(parts), **options), parts)


def _finished(client: Any, work: Sequence[Work], progress: SceneProgress) -> Iterator[SceneOutcome]:
    """What became of each scene, as soon as it is known; whoever stops listening stops the work."""
    from distributed import as_completed

    of = {future: entry for entry in work for future in entry.futures}
    started, told = time.perf_counter(), {}
    try:
        for future in as_completed(of, loop=client.loop):
            entry = of[future]
            if future.status == "finished":
                if entry.scene.name not in told:
                    told[entry.scene.name] = progress(entry.scene)
                rows, cols = entry.scene.image.shape
                told[entry.scene.name](entry.strips.get(future, 0 if entry.strips else rows * cols))
            if future is entry.last:
                outcome = _outcome(entry, time.perf_counter() - started)
                client.cancel(entry.futures)  # where one strip failed, the others are not needed
                yield outcome
    finally:
        client.cancel(list(of))


def _outcome(work: Work, seconds: float) -> SceneOutcome:
    scene, future = work.scene, work.last
    if future.status == "finished":
        log.info("scene '%s' done after %.1f s", scene.name, seconds)
        return SceneOutcome.of(scene.name, "done", target_of(scene), future.result())
    message = _message(future)
    log.error("scene '%s' failed: %s", scene.name, message)
    return SceneOutcome(scene.name, "failed", target_of(scene), error=message)


def _message(future: Any) -> str:
    """Why a task was not done."""
    from distributed import KilledWorker

    if future.status != "error":
        return f"the scheduler let go of it ({future.status}); was it stopped?"
    error = future.exception()
    if isinstance(error, KilledWorker):
        return (
            f"{error.allowed_failures + 1} workers died of it, the last was {error.last_worker.address}; "
            f"do they have too little memory?"
        )
    text = str(error) or type(error).__name__
    expected = isinstance(error, TscorrError | OSError | MemoryError)
    return text if expected else f"{type(error).__name__}: {text} (a fault of tscorr; please report it)"
