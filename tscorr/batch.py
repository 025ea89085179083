"""Many scenes: plan all, then correct one after the other; resume what is done, go on where one fails."""

import html
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tscorr import __version__, config, publish
from tscorr.errors import ConfigError, InputError, TscorrError, nearest
from tscorr.materials import Material, builtin_materials, find, load_materials
from tscorr.scene.correct import correct_scene, resume_key, target_of
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
    if problems:
        kind = problems[0][1] if len(problems) == 1 else InputError
        raise kind("\n".join(message for message, _ in problems))
    return planned


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
    outcomes = tuple(_outcomes(planned, overwrite, progress))
    result = BatchResult(folder, outcomes)
    _write_overview(settings, result)
    return result


def _outcomes(planned: Sequence[Scene], overwrite: bool, progress: SceneProgress) -> Iterator[SceneOutcome]:
    for scene in planned:
        target = target_of(scene)
        try:
            if not overwrite and publish.is_current(target, resume_key(scene)):
                report = json.loads((target / "report.json").read_text(encoding="utf-8"))
                yield SceneOutcome(scene.name, "current", target, report=report)
                continue
            report = correct_scene(scene, progress(scene))
            yield SceneOutcome(scene.name, "done", target, report=report)
        except (TscorrError, OSError, MemoryError) as error:
            message = str(error) or type(error).__name__
            log.error("scene '%s' failed: %s", scene.name, message)  # noqa: TRY400 - the message is for the user
            yield SceneOutcome(scene.name, "failed", target, error=message)


def _write_overview(settings: config.Config, result: BatchResult) -> None:
    """batch.json and index.html at the top of the output folder."""
    rows = [
        {"scene": scene.name, "state": scene.state, "folder": scene.folder.name, "error": scene.error}
        for scene in result.scenes
    ]
    batch = {"title": settings.title, "tscorr": __version__, "scenes": rows}
    try:
        result.folder.mkdir(parents=True, exist_ok=True)
        (result.folder / "batch.json").write_text(json.dumps(batch, indent=1) + "\n", encoding="utf-8")
        (result.folder / "index.html").write_text(_index(settings.title, result), encoding="utf-8")
    except OSError as error:
        log.warning("the overview in %s could not be written: %s", result.folder, error)


def _index(title: str, result: BatchResult) -> str:
    rows = []
    for scene in result.scenes:
        name, folder = html.escape(scene.name), html.escape(scene.folder.name, quote=True)
        pixels = scene.report["pixels"]["corrected"] if scene.report else 0
        link = f'<a href="{folder}/report.html">{name}</a>' if scene.state != "failed" else name
        rows.append(
            f"<tr><td>{link}</td><td>{scene.state}</td><td>{pixels:,}</td><td>{html.escape(scene.error)}</td></tr>"
        )
    heading = html.escape(title or "tscorr")
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{heading}</title>'
        "<style>body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
        "table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.4rem .6rem;"
        "border-bottom:1px solid #ccc}</style>"
        f"<h1>{heading}</h1><table><tr><th>scene</th><th>state</th><th>pixels corrected</th><th>error</th></tr>"
        + "".join(rows)
        + "</table></html>\n"
    )
