"""The scenes of a batch on the cores of this machine."""

import json
import logging
import threading
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from typing import Self

from tscorr import rasters
from tscorr.batch.outcome import SceneOutcome, SceneProgress
from tscorr.errors import TscorrError
from tscorr.scene.correct import correct_scene, is_current, target_of
from tscorr.scene.cutting import BASE_MB, scene_mb, threads_of, units_of, wanted_workers
from tscorr.scene.memory import give_back
from tscorr.scene.plan import Scene

log = logging.getLogger("tscorr")


def outcomes(planned: Sequence[Scene], overwrite: bool, progress: SceneProgress) -> list[SceneOutcome]:
    """Correct each scene, unless its result is current; what became of them, in the same order.

    A scene with a block for each worker is done alone, by this thread. Smaller ones are done side by side, as many as
    there are workers for and as the memory limit allows: while one is read and computed, another is reported.
    """
    found: dict[str, SceneOutcome] = {}
    running: dict[Future[SceneOutcome], Scene] = {}

    def collect(ended: Iterable[Future[SceneOutcome]]) -> None:
        for future in list(ended):
            del running[future]
            found[future.result().name] = future.result()

    most = max((wanted_workers(scene) for scene in planned), default=1)
    with rasters.environment(), ThreadPoolExecutor(most) as pool, _Crew() as crew:
        for scene in planned:
            while running and not _fit([*running.values(), scene]):
                collect(wait(running, return_when=FIRST_COMPLETED).done)
            if _is_large(scene):
                found[scene.name] = _outcome(scene, overwrite, progress)
            else:
                running[pool.submit(crew.done, scene, overwrite, progress)] = scene
        collect(wait(running).done)
    return [found[scene.name] for scene in planned]


class _Crew:
    """The threads that work on scenes; leaving it waits for them, whatever ended the batch.

    A pool forgets the thread that it was about to start when a signal came.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._active = 0
        self._ended = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.wait_for(lambda: self._active == 0)

    def done(self, scene: Scene, overwrite: bool, progress: SceneProgress) -> SceneOutcome:
        """The outcome of a scene; CancelledError where the batch ended before its turn came."""
        with self._changed:
            if self._ended:
                raise CancelledError
            self._active += 1
        try:
            return _outcome(scene, overwrite, progress)
        finally:
            with self._changed:
                self._active -= 1
                self._changed.notify_all()


def _is_large(scene: Scene) -> bool:
    return len(units_of(scene)) >= wanted_workers(scene)


def _fit(scenes: Sequence[Scene]) -> bool:
    """Whether scenes can be worked on at the same time: with a thread for each of their blocks, and the memory."""
    if any(map(_is_large, scenes)):
        return False
    threads, memory_mb = sum(map(threads_of, scenes)), BASE_MB + sum(map(scene_mb, scenes))
    return threads <= wanted_workers(scenes[0]) and memory_mb <= scenes[0].config.run.memory_limit_mb


def _outcome(scene: Scene, overwrite: bool, progress: SceneProgress) -> SceneOutcome:
    """Correct a scene, unless its result is current; an error is an outcome too: it must not stop the batch."""
    target = target_of(scene)
    try:
        if not overwrite and is_current(scene):
            report = json.loads((target / "report.json").read_text(encoding="utf-8"))
            log.info("scene '%s' is current", scene.name)
            return SceneOutcome.of(scene.name, "current", target, report)
        started = time.perf_counter()
        report = correct_scene(scene, progress(scene))
        give_back()
        log.info("scene '%s' done in %.1f s", scene.name, time.perf_counter() - started)
        return SceneOutcome.of(scene.name, "done", target, report)
    except Exception as error:
        expected = isinstance(error, TscorrError | OSError | MemoryError)
        message = str(error) or type(error).__name__
        message = message if expected else f"{type(error).__name__}: {message} (a fault of tscorr; please report it)"
        log.error("scene '%s' failed: %s", scene.name, message, exc_info=None if expected else error)  # noqa: TRY400
        return SceneOutcome(scene.name, "failed", target, error=message)
