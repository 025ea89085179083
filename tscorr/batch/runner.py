"""A batch from its configuration to the overview: plan all, correct what is not current, go on where one fails."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from tscorr import config, publish
from tscorr.batch import cluster, local
from tscorr.batch.lock import locked
from tscorr.batch.outcome import BatchResult, SceneProgress, silent_scene
from tscorr.batch.overview import write_overview
from tscorr.batch.planning import plan
from tscorr.scene import memory

log = logging.getLogger("tscorr")


def run(
    settings: config.Config | str | Path,
    *,
    scenes: Sequence[str] = (),
    materials: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: SceneProgress = silent_scene,
) -> BatchResult:
    """Correct the scenes of a configuration.

    settings  : a configuration, or the path of one.
    scenes, materials : names of those to do, or one name; all if empty.
    scheduler : address of a Dask scheduler, in place of that of the configuration.
    overwrite : recompute scenes whose published result is current.
    progress  : given a scene that starts, a function that is told of pixels done; several threads call both.
    Raises ConfigError, MaterialError or InputError before any work starts, OutputError where another batch is at work
    in the folder; later errors fail their scene.

    >>> import tscorr
    >>> result = tscorr.run("city.toml")
    >>> [(scene.name, scene.state) for scene in result.scenes], result.exit_code
    ([('roofs', 'done')], 0)
    """
    if not isinstance(settings, config.Config):
        settings = config.load_config(settings)
    given = {key: value for key, value in (("workers", workers), ("scheduler", scheduler)) if value is not None}
    settings = config.with_run_settings(settings, given)
    memory.share()
    only_scenes, only_materials = ([names] if isinstance(names, str) else names for names in (scenes, materials))
    planned = plan(settings, only_scenes, only_materials, to_run=True, overwrite=overwrite)
    folder = Path(settings.output.directory)
    with locked(folder), _log_file(folder):
        for deed in publish.recover(folder):
            log.warning("%s", deed)
        outcomes = local.outcomes if settings.run.scheduler is None else cluster.outcomes
        result = BatchResult(folder, tuple(outcomes(planned, overwrite, progress)))
        write_overview(settings, result, planned)
    return result


class _LogFile(logging.FileHandler):
    """A log file whose disk may be full: what cannot be written is left out, and not told on stderr line by line."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the library's name
        """Do nothing."""


@contextmanager
def _log_file(folder: Path) -> Iterator[None]:
    """Everything that is logged goes to batch.log too, behind what earlier runs wrote; where it can be written."""
    try:
        handler = _LogFile(folder / "batch.log", encoding="utf-8")
    except OSError as error:
        log.warning("%s cannot be written: %s", folder / "batch.log", error.strerror)
        yield
        return
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    level = log.level
    log.setLevel(logging.INFO)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        with suppress(OSError):
            handler.close()
