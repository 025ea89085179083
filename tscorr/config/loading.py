"""Reading a configuration: paths made absolute, globs expanded, every problem named with its place."""

import os
import tomllib
import unicodedata
from collections.abc import Iterator, Mapping
from datetime import date, time
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tscorr.config.scenes import SURFACES, VIEWS, Scene
from tscorr.config.sections import TABLES, Config, Run
from tscorr.config.template import FILL_IN
from tscorr.errors import ConfigError, nearest
from tscorr.texts import read_text


def load_config(path: str | Path) -> Config:
    """The configuration of a TOML file, with every path made absolute and globs of images expanded.

    Raises ConfigError listing every problem, each with its place in the file, its value and what is allowed.
    """
    if not isinstance(path, str | Path):
        raise ConfigError(f"a configuration is asked for as {path!r}; allowed is the path of a file")
    path = Path(path)
    try:
        data = tomllib.loads(read_text(path, "configuration", ConfigError))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not a TOML file: {error}") from None
    try:
        config = Config.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(_problem(path, item, data) for item in error.errors())) from None
    folder = path.resolve().parent
    scenes = [scene for entry in config.scenes for scene in _expanded(entry, folder, path)]
    _require_distinct([scene.name or "" for scene in scenes], path)
    return config.model_copy(
        update={
            "scenes": scenes,
            "output": config.output.model_copy(update={"directory": str(absolute(folder, config.output.directory))}),
            "materials": config.materials.model_copy(
                update={"library": [str(absolute(folder, library)) for library in config.materials.library]}
            ),
        }
    )


def with_run_settings(settings: Config, given: Mapping[str, Any]) -> Config:
    """The configuration with some keys of [run] changed; ConfigError where they cannot be."""
    try:
        run = Run.model_validate({**settings.run.model_dump(), **given})
    except ValidationError as error:
        problems = (_problem(Path("run"), item, {}) for item in error.errors())
        raise ConfigError("\n".join(problems)) from None
    return settings.model_copy(update={"run": run})


def _expanded(scene: Scene, folder: Path, config: Path) -> Iterator[Scene]:
    """The scene of each image that a glob matches, with {stem} and {parent} filled in and absolute paths."""
    one = absolute(folder, scene.image)
    if any(c in scene.image for c in "*?[") and not one.exists():
        images = _matches(scene.image, folder, config)
        if scene.name is not None and len(images) > 1:
            raise ConfigError(f"{config}: the name '{scene.name}' cannot serve {len(images)} images; leave it out")
    else:
        images = [one]
    for image in images:
        words = {"stem": image.stem, "parent": str(image.parent)}
        filled = _with_paths(scene.model_dump(), folder, words)
        try:
            yield Scene.model_validate({**filled, "image": str(image), "name": scene.name or image.stem})
        except ValidationError as error:
            scenes = {"scenes": [{"name": image.stem}]}
            items = [{**item, "loc": ("scenes", 0, *item["loc"])} for item in error.errors()]
            raise ConfigError("\n".join(_problem(config, item, scenes) for item in items)) from None


def _matches(pattern: str, folder: Path, config: Path) -> list[Path]:
    """Images that a pattern matches, in the order of their names."""
    whole = absolute(folder, pattern)
    try:
        images = sorted(Path(whole.anchor).glob(str(whole.relative_to(whole.anchor))))
    except (ValueError, OSError) as error:
        raise ConfigError(f"{config}: image = {pattern!r} is no pattern of paths: {error}") from None
    if not images:
        raise ConfigError(f"{config}: no image matches {pattern}")
    return [absolute(folder, str(image)) for image in images]


LONGEST_PART = 255
"""bytes of a file's name that file systems take"""


def absolute(folder: Path, path: str) -> Path:
    """A path of the file, which is relative to the file's folder, without `..` in it.

    Raises ConfigError where no file can have this path, or where it would garble what it is printed on.
    """
    long = any(len(os.fsencode(part)) > LONGEST_PART for part in Path(path).parts)
    if long or not path.isprintable() or len(os.fsencode(path)) > PATH_MAX:
        raise ConfigError(
            f"the path {path!r} can be of no file; allowed are printable characters, at most {LONGEST_PART} bytes "
            f"in a name and {PATH_MAX} in all"
        )
    return Path(os.path.normpath(folder / path))


PATH_MAX = 2000


PATHS = {
    "class_map",
    "class_confidence",
    "path",
    "heights",
    "trajectory",
    "zenith",
    "azimuth",
    "index",
    "cameras",
    "diffuse",
    "sunlit",
}


def paths_of(scene: Scene) -> list[Path]:
    """The files that a scene names, beside its image."""
    return list(_named_paths(scene.model_dump()))


def _named_paths(value: Any, key: str = "") -> Iterator[Path]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _named_paths(item, name)
    elif key in PATHS and isinstance(value, str):
        yield Path(value)


def _with_paths(value: Any, folder: Path, words: Mapping[str, str], key: str = "") -> Any:
    if isinstance(value, dict):
        return {name: _with_paths(item, folder, words, name) for name, item in value.items()}
    if key in PATHS and isinstance(value, str):
        for word, text in words.items():
            value = value.replace("{" + word + "}", text)
        return str(absolute(folder, value))
    return value


def _require_distinct(names: list[str], config: Path) -> None:
    """Folders of scenes must differ on file systems, too, that know no case or spell é in two ways."""
    known: dict[str, str] = {}
    for name in names:
        folder = unicodedata.normalize("NFC", name).casefold()
        if (other := known.get(folder)) is not None:
            called = f"two scenes are called '{name}'" if name == other else f"'{other}' and '{name}' are one folder"
            raise ConfigError(f"{config}: {called}; give them a name each")
        known[folder] = name


A_TIME = "a date and a time with its zone, like 2026-06-21T10:12:00Z"
IN_WORDS = {"datetime": A_TIME, "timezone": A_TIME, "tuple": "a list of numbers"}
"""what is allowed, by how pydantic's name of a problem begins, where its own words are of Python"""


def _problem(path: Path, item: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """One line for one problem that pydantic found; scenes are called by their names in `data`, the file's content."""
    location = [part for i, part in enumerate(item["loc"]) if not _is_kind(item["loc"], i)]
    if len(location) > 1 and location[0] == "scenes":
        location[:2] = [_scene_label(data["scenes"][location[1]], location[1])]
    where = ".".join(str(part) for part in location) or "file"
    if item["type"] == "extra_forbidden":
        *place, key = location
        known = _known_keys(item["loc"])
        table = ".".join(map(str, place)) or "the top level"
        homes = [name for name in ("output", "model", "correction", "run") if key in TABLES[name].model_fields]
        hint = f" (it is a key of [{homes[0]}])" if homes else nearest(str(key), known)
        return f"{path}: unknown key '{key}' in {table}{hint}"
    message = item["msg"].removeprefix("Value error, ")
    if item["type"] == "union_tag_invalid":
        kinds = SURFACES if location[-1] == "surface" else VIEWS
        kind = str(item["input"].get("kind"))
        return f"{path}: {where}.kind = '{kind}'; allowed are {', '.join(kinds)}{nearest(kind, kinds)}"
    if item["type"] == "missing":
        return f"{path}: {where} is missing"
    if where == "file":
        return f"{path}: {message}"
    if where == "scenes" and isinstance(item["input"], dict):
        return f"{path}: [scenes] is one table; allowed is one for each scene, headed [[scenes]]"
    if item["input"] == FILL_IN:
        return f"{path}: {where} = {FILL_IN!r} is still to be filled in"
    for kind, allowed in IN_WORDS.items():
        if item["type"].startswith(kind):
            return f"{path}: {where} = {_as_written(item['input'])}; allowed is {allowed}"
    return f"{path}: {where} = {_as_written(item['input'])}: {message[0].lower()}{message[1:]}"


def _as_written(value: Any) -> str:
    """A value about as it stands in the file."""
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, date | time) else repr(value)


def _scene_label(scene: Any, number: int) -> str:
    """What a scene is called in a message: by its name, else by its image, else by its number."""
    given = scene if isinstance(scene, dict) else {}
    name = given.get("name", given.get("image"))
    return f"scene {name!r}" if isinstance(name, str) else f"scenes.{number}"


def _is_kind(location: tuple[Any, ...], i: int) -> bool:
    """Whether a part of a location is the kind of a view or surface, which is no key of the file."""
    return i > 0 and location[i - 1] in {"view", "surface"} and location[i] in {**VIEWS, **SURFACES}


def _known_keys(location: tuple[Any, ...]) -> list[str]:
    """Keys that are known where an unknown one was found."""
    model: Any = Config
    for part in location[:-1]:
        model = _inside(model, part)
    return list(getattr(model, "model_fields", {}))


def _inside(model: Any, part: Any) -> Any:
    """The model one step further down a location: a field, an item of a list, a kind of view or surface."""
    if isinstance(model, dict):
        return model.get(part)
    return TABLES.get(part, model) if isinstance(part, str) else model
