"""Many scenes: plan all, then correct one after the other; resume what is done, go on where one fails."""

import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tscorr import __version__, config, publish, stac
from tscorr.errors import ConfigError, InputError, TscorrError, nearest
from tscorr.materials import Material, builtin_materials, find, load_materials
from tscorr.report import Difference, Overlap, SceneLine, batch_page
from tscorr.scene.correct import correct_scene, resume_key, target_of
from tscorr.scene.overlap import overlaps
from tscorr.scene.plan import Scene, plan_scene
from tscorr.scene.run import silent

log = logging.getLogger("tscorr")

SceneProgress = Callable[[Scene], Callable[[int], None]]
"""given a scene that starts, a function that is told of pixels done"""


def silent_scene(scene: Scene) -> Callable[[int], None]:
    """Progress that nobody watches."""
    del scene
    return silent


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """What became of one scene: `done`, `current` (nothing had to be done) or `failed`."""

    name: str
    state: str
    folder: Path
    error: str = ""
    report: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The outcomes of a batch, in the order of the configuration."""

    folder: Path
    scenes: tuple[SceneOutcome, ...] = field(default_factory=tuple)

    @property
    def exit_code(self) -> int:
        """0 all done, 1 some scenes failed, 3 all failed."""
        failed = [scene for scene in self.scenes if scene.state == "failed"]
        return 0 if not failed else 3 if len(failed) == len(self.scenes) else 1


def library_of(settings: config.Config) -> dict[str, Material]:
    """The built-in library with those of the configuration laid over it."""
    library = dict(builtin_materials())
    for path in settings.materials.library:
        library.update(load_materials(path))
    return library


def plan(settings: config.Config, scenes: Sequence[str] = (), materials: Sequence[str] = ()) -> list[Scene]:
    """Check everything that can be checked before work starts.

    scenes, materials : names to restrict the batch to; all if empty.
    Raises ConfigError or InputError with every problem that was found, one a line.
    """
    names = [str(scene.name) for scene in settings.scenes]
    for name in scenes:
        if name not in names:
            raise ConfigError(f"no scene '{name}'{nearest(name, names)}; the configuration has {', '.join(names)}")
    library = library_of(settings)
    used = set(settings.materials.classes.values())
    for name in used:
        find(name, library)
    for name in materials:
        if name not in used:
            raise ConfigError(f"no material '{name}'{nearest(name, used)} in [materials.classes]")
    planned, problems = [], []
    for scene in settings.scenes:
        if scenes and scene.name not in scenes:
            continue
        try:
            planned.append(plan_scene(scene, settings, library, materials))
        except TscorrError as error:
            problems.append((f"scene '{scene.name}': {error}", type(error)))
    if not problems:
        _check_output(Path(settings.output.directory))
    if problems:
        kind = problems[0][1] if len(problems) == 1 else InputError
        raise kind("\n".join(message for message, _ in problems))
    return planned


def _check_output(folder: Path) -> None:
    """Raise ConfigError unless the output folder, or what exists of the way to it, can be written."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        what = "cannot be written" if existing.is_dir() else "is not a folder"
        raise ConfigError(f"[output] directory = {folder}: {existing} {what}; allowed is a folder that can be made")


def run(
    settings: config.Config | str | Path,
    *,
    scenes: Sequence[str] = (),
    materials: Sequence[str] = (),
    workers: int | None = None,
    overwrite: bool = False,
    progress: SceneProgress = silent_scene,
) -> BatchResult:
    """Correct the scenes of a configuration.

    settings  : a configuration, or the path of one.
    overwrite : recompute scenes whose published result is current.
    Raises ConfigError, MaterialError or InputError before any work starts; later errors fail their scene.
    """
    if not isinstance(settings, config.Config):
        settings = config.load_config(settings)
    if workers is not None:
        settings = settings.model_copy(update={"run": settings.run.model_copy(update={"workers": workers})})
    planned = plan(settings, scenes, materials)
    folder = Path(settings.output.directory)
    with _log_file(folder):
        result = BatchResult(folder, tuple(_outcomes(planned, overwrite, progress)))
    _write_overview(settings, result, planned)
    return result


@contextmanager
def _log_file(folder: Path) -> Iterator[None]:
    """Everything that is logged goes to batch.log too, behind what earlier runs wrote; where it can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handler = logging.FileHandler(folder / "batch.log", encoding="utf-8")
    except OSError:
        yield  # the scenes will say that the folder cannot be written
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
        handler.close()


def _outcomes(planned: Sequence[Scene], overwrite: bool, progress: SceneProgress) -> Iterator[SceneOutcome]:
    for scene in planned:
        target = target_of(scene)
        try:
            if not overwrite and publish.is_current(target, resume_key(scene)):
                report = json.loads((target / "report.json").read_text(encoding="utf-8"))
                log.info("scene '%s' is current", scene.name)
                yield SceneOutcome(scene.name, "current", target, report=report)
                continue
            started = time.perf_counter()
            report = correct_scene(scene, progress(scene))
            log.info("scene '%s' done in %.1f s", scene.name, time.perf_counter() - started)
            yield SceneOutcome(scene.name, "done", target, report=report)
        except Exception as error:  # one scene must not stop the batch
            expected = isinstance(error, TscorrError | OSError | MemoryError)
            message = str(error) or type(error).__name__
            message = (
                message if expected else f"{type(error).__name__}: {message} (a fault of tscorr; please report it)"
            )
            log.error("scene '%s' failed: %s", scene.name, message, exc_info=None if expected else error)  # noqa: TRY400
            yield SceneOutcome(scene.name, "failed", target, error=message)


def _write_overview(settings: config.Config, result: BatchResult, planned: Sequence[Scene]) -> None:
    """batch.json, index.html and the STAC collection at the top of the output folder."""
    rows = [
        {"scene": scene.name, "state": scene.state, "folder": scene.folder.name, "error": scene.error}
        for scene in result.scenes
    ]
    shared = _overlaps(result, planned)
    batch = {
        "title": settings.title,
        "tscorr": __version__,
        "scenes": rows,
        "overlaps": [asdict(overlap) for overlap in shared],
    }
    page = batch_page(settings.title, _lines(settings, result), shared, __version__)
    try:
        result.folder.mkdir(parents=True, exist_ok=True)
        (result.folder / "batch.json").write_text(json.dumps(batch, indent=1) + "\n", encoding="utf-8")
        (result.folder / "index.html").write_text(page, encoding="utf-8")
        items = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(result.folder.glob("*/item.json"))]
        if items:
            collected = stac.collection(title=settings.title or "tscorr", items=items)
            (result.folder / "collection.json").write_text(json.dumps(collected, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        log.warning("the overview in %s could not be written: %s", result.folder, error)


def _lines(settings: config.Config, result: BatchResult) -> list[SceneLine]:
    """The scenes of this run, and those of the configuration that earlier runs have published."""
    lines = [
        SceneLine(scene.name, scene.state, scene.folder.name, scene.error, scene.report) for scene in result.scenes
    ]
    known = {scene.name for scene in result.scenes}
    for name in (str(scene.name) for scene in settings.scenes):
        report = result.folder / name / "report.json"
        if name not in known and report.exists():
            lines.append(SceneLine(name, "earlier", name, report=json.loads(report.read_text(encoding="utf-8"))))
    return lines


def _overlaps(result: BatchResult, planned: Sequence[Scene]) -> list[Overlap]:
    """The differences of scenes that share ground; those of the last run where it had the same results."""
    states = {scene.name: scene.state for scene in result.scenes}
    if set(states.values()) == {"current"} and (known := _known_overlaps(result)) is not None:
        return known
    try:
        return overlaps([(scene, target_of(scene)) for scene in planned if states[scene.name] != "failed"])
    except (TscorrError, OSError) as error:
        log.warning("the overlaps of the scenes could not be compared: %s", error)
        return []


def _known_overlaps(result: BatchResult) -> list[Overlap] | None:
    """The overlaps in batch.json if it is of the same scenes, none of which failed."""
    try:
        batch = json.loads((result.folder / "batch.json").read_text(encoding="utf-8"))
        same = [row["scene"] for row in batch["scenes"]] == [scene.name for scene in result.scenes]
        if not same or any(row["state"] == "failed" for row in batch["scenes"]):
            return None
        return [
            Overlap(row["first"], row["second"], {name: Difference(*d) for name, d in row["materials"].items()})
            for row in batch["overlaps"]
        ]
    except (OSError, ValueError, KeyError, TypeError):  # missing, or of another version
        return None
