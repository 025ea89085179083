"""A configuration to start from, and the JSON Schema that editors read: both from the descriptions of the models."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from tscorr.config.fields import Section
from tscorr.config.scenes import SURFACES, VIEWS, Scene, Truth
from tscorr.config.sections import Config
from tscorr.materials import builtin_materials

FILL_IN = "FILL IN"
"""stands where only the user knows the value; no model takes it for one"""


def json_schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of the configuration, for editors that check and complete TOML."""
    schema = Config.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "tscorr configuration"}


def template(image: str, class_map: str, title: str, facts: Sequence[str] = ()) -> str:
    """A configuration of one scene with every key, its default and its description, as TOML.

    image, class_map : paths as they shall stand in the file.
    facts            : what is known of the image, for the head of the file.

    What only the user knows stands as FILL_IN in three places: the materials of the classes, the time, and the
    position of the camera.
    """
    head = [f"The three values that read {FILL_IN} are missing; all others may stay as they are.", *facts]
    lines = [*(f"# {fact}" for fact in head), "", _line("title", Config.model_fields["title"], title)]
    for name in ("output", "model", "correction", "run"):
        lines += ["", *_table(name, Config.model_fields[name].annotation)]
    lines += ["", *_materials(), "", *_scene(image, class_map)]
    return "\n".join(lines) + "\n"


def _table(name: str, section: Any) -> Iterator[str]:
    yield f"[{name}]"
    for key, field in section.model_fields.items():
        yield _line(key, field, field.default)


def _materials() -> Iterator[str]:
    fields = Config.model_fields["materials"].annotation.model_fields  # type: ignore[union-attr]
    yield "[materials]"
    yield _line("library", fields["library"], fields["library"].default)
    yield ""
    yield f"[materials.classes]  # {fields['classes'].description}; built in are {', '.join(builtin_materials())}"
    yield f"1 = {_toml(FILL_IN)}"
    yield ""
    yield "# any key of [model] and [correction] can be set for one material, and enabled = false:"
    yield "# [materials.settings.roof_tile]"


def _scene(image: str, class_map: str) -> Iterator[str]:
    """The table of the scene, with the other kinds of views and surfaces as comments."""
    given = {
        "image": image,
        "class_map": class_map,
        "sun": {"time": FILL_IN},
        "view": {"kind": "frame", "position": FILL_IN},
    }
    others = {
        "sun": [{"zenith_deg": 40.0, "azimuth_deg": 170.0}],
        "view": _examples(VIEWS),
        "surface": _examples(SURFACES),
        "truth": [_example(Truth)],
    }
    more = {"view": VIEWS, "surface": SURFACES}
    yield "[[scenes]]"
    for key, field in Scene.model_fields.items():
        line = _line(key, field, given.get(key, field.default))
        yield line
        for example in others.get(key, ()):
            other = f"{key} = {_toml(example)}"
            if not line.startswith(other):
                yield f"# {other}{_also(more[key][example['kind']]) if key in more else ''}"


def _examples(kinds: Mapping[str, type[Section]]) -> list[dict[str, Any]]:
    """One example of each kind."""
    return [{"kind": kind, **_example(section)} for kind, section in kinds.items()]


def _example(section: type[Section]) -> dict[str, Any]:
    """A table of the examples of its fields."""
    return {key: field.examples[0] for key, field in section.model_fields.items() if field.examples}


def _also(section: type[Section]) -> str:
    """A remark on the keys that an example of the table does without."""
    rest = [f"{key} ({field.description})" for key, field in section.model_fields.items() if not field.examples]
    return f"  # also: {', '.join(rest[1:])}" if len(rest) > 1 else ""  # the first is its kind


def _line(key: str, field: FieldInfo, value: Any) -> str:
    """One key with its value, or as a comment where it has none, and its description."""
    choices = ", ".join(map(_toml, _choices(field.annotation)))
    remark = "; ".join(part for part in (field.description, choices and f"allowed: {choices}") if part)
    line = f"# {key} =" if value is None else f"{key} = {_toml(value)}"
    return f"{line}  # {remark}" if remark else line


def _choices(annotation: Any) -> list[str]:
    """The words that a field may hold, where only some are allowed; those of a list's items too."""
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    return [choice for part in get_args(annotation) for choice in _choices(part)]


def _toml(value: Any) -> str:
    """A value as TOML writes it in one line; JSON's scalars and lists are TOML's."""
    if isinstance(value, Section):
        value = value.model_dump(exclude_none=True)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False)
