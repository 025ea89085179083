"""Reading a configuration: paths made absolute, globs expanded, every problem named with its place."""

import os
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tscorr.config.sections import SURFACES, TABLES, VIEWS, Config, Scene
from tscorr.errors import ConfigError, nearest


def load_config(path: str | Path) -> Config:
    """The configuration of a TOML file, with every path made absolute and globs of images expanded.

    Raises ConfigError listing every problem, each with its place in the file, its value and what is allowed.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the configuration {path} cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not a TOML file: {error}") from None
    try:
        config = Config.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(_problem(path, item) for item in error.errors())) from None
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


def _expanded(scene: Scene, folder: Path, config: Path) -> Iterator[Scene]:
    """The scene of each image that a glob matches, with {stem} and {parent} filled in and absolute paths."""
    pattern = Path(scene.image)
    if any(c in scene.image for c in "*?["):
        anchor = Path(pattern.anchor) if pattern.is_absolute() else folder
        images = sorted(anchor.glob(str(pattern.relative_to(pattern.anchor))))
        if not images:
            raise ConfigError(f"{config}: no image matches {scene.image}")
        if scene.name is not None and len(images) > 1:
            raise ConfigError(f"{config}: the name '{scene.name}' cannot serve {len(images)} images; leave it out")
    else:
        images = [absolute(folder, scene.image)]
    for image in images:
        words = {"stem": image.stem, "parent": str(image.parent)}
        filled = _with_paths(scene.model_dump(), folder, words)
        try:
            yield Scene.model_validate({**filled, "image": str(image), "name": scene.name or image.stem})
        except ValidationError as error:
            raise ConfigError("\n".join(_problem(config, item) for item in error.errors())) from None


def absolute(folder: Path, path: str) -> Path:
    """A path of the file, which is relative to the file's folder, without `..` in it."""
    return Path(os.path.normpath(folder / path))


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


def _with_paths(value: Any, folder: Path, words: Mapping[str, str], key: str = "") -> Any:
    if isinstance(value, dict):
        return {name: _with_paths(item, folder, words, name) for name, item in value.items()}
    if key in PATHS and isinstance(value, str):
        for word, text in words.items():
            value = value.replace("{" + word + "}", text)
        return str(absolute(folder, value))
    return value


def _require_distinct(names: list[str], config: Path) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{config}: two scenes are called '{name}'; give them a name each")


def _problem(path: Path, item: Mapping[str, Any]) -> str:
    """One line for one problem that pydantic found."""
    location = [part for i, part in enumerate(item["loc"]) if not _is_kind(item["loc"], i)]
    where = ".".join(str(part) for part in location) or "file"
    if item["type"] == "extra_forbidden":
        *place, key = location
        known = _known_keys(item["loc"])
        table = ".".join(map(str, place)) or "the top level"
        return f"{path}: unknown key '{key}' in {table}{nearest(str(key), known)}"
    message = item["msg"].removeprefix("Value error, ")
    if item["type"] == "union_tag_invalid":
        kinds = SURFACES if location[-1] == "surface" else VIEWS
        kind = str(item["input"].get("kind"))
        return f"{path}: {where}.kind = '{kind}'; allowed are {', '.join(kinds)}{nearest(kind, kinds)}"
    if item["type"] == "missing":
        return f"{path}: {where} is missing"
    if where == "file":
        return f"{path}: {message}"
    return f"{path}: {where} = {item['input']!r}: {message[0].lower()}{message[1:]}"


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
