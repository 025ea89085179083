"""All scenes checked before work on any of them starts."""

import os
from collections.abc import Sequence
from pathlib import Path

from tscorr import config
from tscorr.errors import ConfigError, InputError, TscorrError, nearest
from tscorr.materials import Material, builtin_materials, find, load_materials
from tscorr.scene.plan import Scene, plan_scene


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
