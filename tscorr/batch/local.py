"""The scenes of a batch one after the other, on the cores of this machine."""

import json
import logging
import time
from collections.abc import Iterator, Sequence

from tscorr.batch.outcome import SceneOutcome, SceneProgress
from tscorr.errors import TscorrError
from tscorr.scene.correct import correct_scene, is_current, target_of
from tscorr.scene.plan import Scene

log = logging.getLogger("tscorr")


def outcomes(planned: Sequence[Scene], overwrite: bool, progress: SceneProgress) -> Iterator[SceneOutcome]:
    """Correct each scene, unless its result is current; what became of it, as soon as it is known."""
    for scene in planned:
        target = target_of(scene)
        try:
            if not overwrite and is_current(scene):
                report = json.loads((target / "report.json").read_text(encoding="utf-8"))
                log.info("scene '%s' is current", scene.name)
                yield SceneOutcome.of(scene.name, "current", target, report)
                continue
            started = time.perf_counter()
            report = correct_scene(scene, progress(scene))
            log.info("scene '%s' done in %.1f s", scene.name, time.perf_counter() - started)
            yield SceneOutcome.of(scene.name, "done", target, report)
        except Exception as error:  # one scene must not stop the batch
            expected = isinstance(error, TscorrError | OSError | MemoryError)
            message = str(error) or type(error).__name__
            message = (
                message if expected else f"{type(error).__name__}: {message} (a fault of tscorr; please report it)"
            )
            log.error("scene '%s' failed: %s", scene.name, message, exc_info=None if expected else error)  # noqa: TRY400
            yield SceneOutcome(scene.name, "failed", target, error=message)
