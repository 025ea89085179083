"""The configuration: a TOML file as pydantic models, checked before any work starts."""

import os
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
    model_validator,
)

from tscorr.errors import ConfigError, nearest

Product = Literal["corrected", "flags", "removed", "azimuthal_width", "angles"]


def _numbers(value: Any, numbers: ValidatorFunctionWrapHandler) -> Any:
    """One message instead of one for each half of the union."""
    try:
        return numbers(value)
    except ValidationError:
        raise ValueError("allowed is a number, or a list of numbers, one a band") from None


PerBand = Annotated[float | list[float], WrapValidator(_numbers)]


class Section(BaseModel):
    """A table of the file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Output(Section):
    """[output]: where results go, and which."""

    directory: str = Field("out", description="folder for the results, relative to this file")
    products: list[Product] = Field(["corrected", "flags", "removed"], description="rasters to write")
    format: Literal["gtiff", "cog"] = Field("gtiff", description="tiled GeoTIFF, or cloud-optimised with overviews")
    compression: Literal["none", "deflate", "zstd", "lzw"] | None = Field(
        None, description="codec of the results; default: the input's"
    )
    quicklook: bool = Field(True, description="draw a true-colour picture: before, after, flags")


class Model(Section):
    """[model]: which form of the Torrance-Sparrow model, and how exactly it is evaluated."""

    form: Literal["full", "simplified"] = Field(
        "full", description="simplified drops the geometric attenuation factor"
    )
    precision: Literal["fast", "exact", "reference"] = Field(
        "fast", description="float32, float64, or plain numpy for checking"
    )


class Correction(Section):
    """[correction]: what is taken away, and what is done where that cannot be right."""

    method: Literal["subtract"] = Field("subtract", description="take the specular reflectance away")
    negligible_reflectance: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None,
        description="below this nothing is removed; default: half a stored step (5e-5 for floating point)",
    )
    uncorrectable: Literal["best", "keep", "nodata"] = Field(
        "best", description="what becomes of a pixel whose share is above the limit"
    )
    uncorrectable_share: Annotated[float, Field(gt=0, le=1)] = Field(
        0.9, description="largest part of the signal that may be removed"
    )
    max_zenith_deg: Annotated[float, Field(gt=0, lt=90)] | None = Field(
        None, description="largest incidence and exitance; default 85, 70 with the simplified form"
    )
    irradiance_plane: Literal["horizontal", "facet"] = Field(
        "horizontal", description="the plane that the reflectance of the image refers to"
    )
    direct_fraction: PerBand = Field(1.0, description="direct share of that irradiance, one value or one a band")


class MaterialSettings(Section):
    """[materials.settings.NAME]: any key of [model] and [correction] for one material."""

    enabled: bool = True
    form: Literal["full", "simplified"] | None = None
    precision: Literal["fast", "exact", "reference"] | None = None
    method: Literal["subtract"] | None = None
    negligible_reflectance: Annotated[float, Field(ge=0, le=1)] | None = None
    uncorrectable: Literal["best", "keep", "nodata"] | None = None
    uncorrectable_share: Annotated[float, Field(gt=0, le=1)] | None = None
    max_zenith_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    irradiance_plane: Literal["horizontal", "facet"] | None = None
    direct_fraction: PerBand | None = None


class Run(Section):
    """[run]: how the machine is used."""

    workers: Annotated[int, Field(ge=0, le=256)] = Field(0, description="0: all cores")
    memory_limit_mb: Annotated[int, Field(ge=128)] = Field(450, description="bound on the memory of a scene")
    skip: bool = Field(True, description="false computes everything: for checking")


class Materials(Section):
    """[materials]: which class of the class map is which material."""

    library: list[str] = Field([], description="material files beside the built-in library")
    classes: dict[int, str] = Field(description="value in the class map = material")
    settings: dict[str, MaterialSettings] = Field({}, description="settings of one material")


class Sun(Section):
    """`sun`: a time, or a direction."""

    time: AwareDatetime | None = None
    zenith_deg: Annotated[float, Field(ge=0, lt=90)] | None = None
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None = None

    @model_validator(mode="after")
    def _one_of_two(self) -> "Sun":
        given = (self.zenith_deg is not None, self.azimuth_deg is not None)
        if (self.time is not None) == any(given) or given[0] != given[1]:
            raise ValueError("give { time = ... } or { zenith_deg = ..., azimuth_deg = ... }")
        return self


class ConstantViewSettings(Section):
    """`view` of kind constant."""

    kind: Literal["constant"]
    zenith_deg: Annotated[float, Field(ge=0, lt=90)]
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)]


class FrameViewSettings(Section):
    """`view` of kind frame."""

    kind: Literal["frame"]
    position: tuple[float, float, float]
    crs: str | None = None
    height_offset_m: float = 0.0


class LineViewSettings(Section):
    """`view` of kind line."""

    kind: Literal["line"]
    trajectory: str = Field(description="CSV: utc,x,y,z[,roll_deg,pitch_deg,heading_deg]")
    start: AwareDatetime | None = Field(None, description="first time of the line, where the file holds more")
    end: AwareDatetime | None = None
    crs: str | None = None
    height_offset_m: float = 0.0

    @model_validator(mode="after")
    def _start_before_end(self) -> "LineViewSettings":
        if self.start is not None and self.end is not None and not self.start < self.end:
            raise ValueError("allowed is an end after the start")
        return self


class AnglesViewSettings(Section):
    """`view` of kind angles."""

    kind: Literal["angles"]
    zenith: str = Field(description="raster of the view zenith angle [degrees]")
    azimuth: str = Field(description="raster of the azimuth from true north, surface to sensor [degrees]")
    scale: Annotated[float, Field(gt=0)] | None = Field(
        None, description="stored value times this is degrees; default: the scale and offset of the file"
    )


class ObsViewSettings(Section):
    """`view` of kind obs: an observation geometry file of JPL, EMIT or NEON; with no `sun`, the sun is its own."""

    kind: Literal["obs"]
    path: str


class MosaicViewSettings(Section):
    """`view` of kind mosaic."""

    kind: Literal["mosaic"]
    index: str = Field(description="raster of the number of the camera that each pixel came from")
    cameras: str = Field(description="CSV: id,x,y,z")
    crs: str | None = None
    height_offset_m: float = 0.0


ViewSettings = Annotated[
    ConstantViewSettings
    | FrameViewSettings
    | LineViewSettings
    | AnglesViewSettings
    | ObsViewSettings
    | MosaicViewSettings,
    Field(discriminator="kind"),
]


class FlatSettings(Section):
    """`surface` of kind flat."""

    kind: Literal["flat"]
    height_m: float = 0.0


class DsmSettings(Section):
    """`surface` of kind dsm or roof_planes."""

    kind: Literal["dsm", "roof_planes"]
    path: str


class NormalsSettings(Section):
    """`surface` of kind normals."""

    kind: Literal["normals"]
    path: str
    heights: str | None = None


class ObsSurfaceSettings(Section):
    """`surface` of kind obs: slope and aspect of an observation geometry file."""

    kind: Literal["obs"]
    path: str
    heights: str | None = None


SurfaceSettings = Annotated[
    FlatSettings | DsmSettings | NormalsSettings | ObsSurfaceSettings, Field(discriminator="kind")
]


class Truth(Section):
    """`truth` of a synthetic scene: what the image would be without the specular part."""

    diffuse: str = Field(description="reflectance factor without the specular part")
    sunlit: str = Field(description="1 where the sun shines")


class Scene(Section):
    """[[scenes]]: one image, or a glob of images that share their settings."""

    name: str | None = Field(None, description="default: the image's stem")
    image: str
    quantity: Literal["reflectance_factor", "brdf"] = "reflectance_factor"
    scale: PerBand | None = None
    offset: PerBand | None = None
    nodata: float | None = None
    wavelength_um: list[float] | None = None
    saturation: PerBand | None = Field(None, description="stored value from which a band is saturated")
    direct_fraction: PerBand | None = None
    class_map: str
    class_confidence: str | None = None
    sun: Sun | None = None
    view: ViewSettings
    surface: SurfaceSettings = FlatSettings(kind="flat")
    shadows: bool = True
    truth: Truth | None = Field(None, description="of a synthetic scene: the residual glare is reported")

    @field_validator("name")
    @classmethod
    def _safe_name(cls, name: str | None) -> str | None:
        if name is not None and (not name.strip(". ") or len(name) > 100 or any(c in name for c in "/\\\0\n<>")):
            raise ValueError("a name is a folder: 1 to 100 characters without / \\ < >, not only dots")
        return name


class Config(Section):
    """The whole file; `folder` is where its relative paths start."""

    title: str = ""
    output: Output = Output()
    model: Model = Model()
    correction: Correction = Correction()
    run: Run = Run()
    materials: Materials
    scenes: list[Scene] = Field(min_length=1)

    @model_validator(mode="after")
    def _settings_are_used(self) -> "Config":
        used = set(self.materials.classes.values())
        for name in self.materials.settings:
            if name not in used:
                raise ValueError(
                    f"[materials.settings.{name}] is for no material of [materials.classes]{nearest(name, used)}"
                )
        return self


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


VIEWS: dict[str, type[Section]] = {
    "constant": ConstantViewSettings,
    "frame": FrameViewSettings,
    "line": LineViewSettings,
    "angles": AnglesViewSettings,
    "obs": ObsViewSettings,
    "mosaic": MosaicViewSettings,
}
SURFACES: dict[str, type[Section]] = {
    "flat": FlatSettings,
    "dsm": DsmSettings,
    "roof_planes": DsmSettings,
    "normals": NormalsSettings,
    "obs": ObsSurfaceSettings,
}


def _inside(model: Any, part: Any) -> Any:
    """The model one step further down a location: a field, an item of a list, a kind of view or surface."""
    if isinstance(model, dict):
        return model.get(part)
    sections: dict[str, Any] = {
        "output": Output,
        "model": Model,
        "correction": Correction,
        "run": Run,
        "materials": Materials,
        "scenes": Scene,
        "sun": Sun,
        "view": VIEWS,
        "surface": SURFACES,
        "truth": Truth,
        "settings": MaterialSettings,
    }
    return sections.get(part, model) if isinstance(part, str) else model
