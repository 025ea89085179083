"""All scenes checked before work on any of them starts."""

from collections.abc import Sequence
from functools import cache

from tscorr import config, rasters
from tscorr.batch.doubts import warn
from tscorr.batch.preflight import preflight
from tscorr.errors import ConfigError, InputError, TscorrError, nearest
from tscorr.materials import Material, builtin_materials, find, load_materials
from tscorr.scene.plan import Scene, plan_scene


def library_of(settings: config.Config) -> dict[str, Material]:
    """The built-in library with those of the configuration laid over it."""
    library = dict(builtin_materials())
    for path in settings.materials.library:
        library.update(load_materials(path))
    return library


def plan(
    settings: config.Config,
    scenes: Sequence[str] = (),
    materials: Sequence[str] = (),
    *,
    to_run: bool = False,
    overwrite: bool = False,
) -> list[Scene]:
    """Check everything that can be checked before work starts.

    scenes, materials : names to restrict the batch to; all if empty.
    to_run            : check also that the results can be computed and written here.
    overwrite         : current results are to be computed again.
    Raises ConfigError, MaterialError, InputError or OutputError with every problem that was found, one a line.
    """
    names = [str(scene.name) for scene in settings.scenes]
    for name in scenes:
        if name not in names:
            raise ConfigError(f"no scene '{name}'{nearest(name, names)}; the configuration has {', '.join(names)}")
    library = library_of(settings)
    used = list(dict.fromkeys(settings.materials.classes.values()))
    for name in materials:
        if name not in used:
            raise ConfigError(f"no material '{name}'{nearest(name, used)} in [materials.classes]")
    problems: list[TscorrError] = []
    for name in used:
        try:
            find(name, library)
        except TscorrError as error:
            classes = ", ".join(str(value) for value, its in settings.materials.classes.items() if its == name)
            problems.append(type(error)(f"[materials.classes] {classes}: {error}"))
            library[name] = library["lambertian"]  # so that the scenes can be checked all the same
    planned = []
    describe = cache(rasters.describe)  # class maps and surface models serve many scenes
    for scene in settings.scenes:
        if scenes and scene.name not in scenes:
            continue
        try:
            planned.append(plan_scene(scene, settings, library, materials, describe))
        except TscorrError as error:
            problems += [type(error)(f"scene '{scene.name}': {line}") for line in str(error).splitlines()]
    if to_run:
        problems += preflight(settings, planned, overwrite=overwrite)
    if problems:
        kind = type(problems[0]) if len({type(problem) for problem in problems}) == 1 else InputError
        raise kind("\n".join(map(str, problems)))
    warn(planned)
    return planned
