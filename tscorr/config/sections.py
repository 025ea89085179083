"""The tables of a configuration file as pydantic models."""

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

from tscorr.errors import nearest

Product = Literal["corrected", "flags", "removed", "uncertainty", "azimuthal_width", "angles"]
Method = Literal["subtract", "ratio", "reference"]


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
    format: Literal["gtiff", "cog", "envi"] = Field(
        "gtiff", description="GeoTIFF laid out as the image, cloud-optimised GeoTIFF, or ENVI (.dat and .hdr)"
    )
    compression: Literal["none", "deflate", "zstd", "lzw"] | None = Field(
        None, description="codec of the results; default: the input's"
    )
    corrected: Literal["file", "vrt"] = Field(
        "file", description="vrt: only what was removed is written, and a small file that subtracts it from the image"
    )
    quicklook: bool = Field(True, description="draw a true-colour picture: before, after, flags")
    hash: Literal["blake3", "sha256"] = Field("blake3", description="of inputs and outputs, in manifest.json")


class Model(Section):
    """[model]: which form of the Torrance-Sparrow model, and how exactly it is evaluated."""

    form: Literal["full", "simplified"] = Field(
        "full", description="simplified drops the geometric attenuation factor"
    )
    precision: Literal["fast", "exact", "reference"] = Field(
        "fast", description="float32, float64, or plain numpy for checking"
    )


def _noise(value: Any, numbers: ValidatorFunctionWrapHandler) -> Any:
    """One message instead of one for each half of the union."""
    try:
        return numbers(value)
    except ValidationError:
        raise ValueError("allowed is [a, b], or a list of such pairs, one a band, none below 0") from None


NotNegative = Annotated[float, Field(ge=0)]
Noise = tuple[NotNegative, NotNegative]


class Reference(Section):
    """`reference` of [correction]: the directions that the specular part is normalised to."""

    solar_zenith_deg: Annotated[float, Field(ge=0, le=75)] = 45.0
    view_zenith_deg: Annotated[float, Field(ge=0, le=75)] = 0.0
    relative_azimuth_deg: Annotated[float, Field(ge=0, le=180)] = 0.0


class Correction(Section):
    """[correction]: what is taken away, and what is done where that cannot be right."""

    method: Method = Field(
        "subtract",
        description="take the specular reflectance away; ratio: by the material's own share of it; "
        "reference: and add what level ground shows at the reference directions",
    )
    reference: Reference = Field(Reference(), description="directions about level ground for method reference")
    negligible_reflectance: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None,
        description="below this nothing is removed; default: half a stored step (5e-5 for floating point)",
    )
    uncorrectable: Literal["best", "keep", "nodata"] = Field(
        "best", description="what becomes of a pixel whose share is above the limit"
    )
    uncorrectable_share: Annotated[float, Field(gt=0, le=1)] = Field(
        0.9, description="part of the signal; where more would be removed the pixel is uncorrectable"
    )
    max_zenith_deg: Annotated[float, Field(gt=0, lt=90)] | None = Field(
        None, description="largest incidence and exitance; default 85, 70 with the simplified form"
    )
    irradiance_plane: Literal["horizontal", "facet"] = Field(
        "horizontal", description="the plane that the reflectance of the image refers to"
    )
    direct_fraction: PerBand = Field(1.0, description="direct share of that irradiance, one value or one a band")
    sky_specular: bool = Field(False, description="take the specular part of an even sky's light away too")
    weigh_by_confidence: bool = Field(
        True, description="take away the part of the lobe that class_confidence says, where it is given"
    )
    image_noise: Annotated[Noise | list[Noise], WrapValidator(_noise)] = Field(
        (0.0, 0.0), description="a, b of the image's 1 sigma a + b R in reflectance factor, or one pair a band"
    )
    direct_fraction_sigma: PerBand = Field(0.0, description="1 sigma of direct_fraction")
    normal_sigma_deg: Annotated[float, Field(ge=0, le=45)] | None = Field(
        None,
        description="1 sigma of the surface normals along each of two axes; default: what the surface knows of it",
    )
    average_normals: bool = Field(False, description="average the lobe over the scatter of the normals")
    direction_sigma_deg: Annotated[float, Field(ge=0, le=45)] = Field(
        0.0, description="1 sigma of the direction to the sensor along each of two axes"
    )
    material_covariance: Literal["synthetic", "independent"] = Field(
        "synthetic",
        description="of materials with errors but no covariance: as of the paper's fits, or an upper bound",
    )


class MaterialSettings(Section):
    """[materials.settings.NAME]: any key of [model] and [correction] for one material, but those of the image."""

    enabled: bool = True
    form: Literal["full", "simplified"] | None = None
    precision: Literal["fast", "exact", "reference"] | None = None
    method: Method | None = None
    reference: Reference | None = None
    negligible_reflectance: Annotated[float, Field(ge=0, le=1)] | None = None
    uncorrectable: Literal["best", "keep", "nodata"] | None = None
    uncorrectable_share: Annotated[float, Field(gt=0, le=1)] | None = None
    max_zenith_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    irradiance_plane: Literal["horizontal", "facet"] | None = None
    direct_fraction: PerBand | None = None
    direct_fraction_sigma: PerBand | None = None
    sky_specular: bool | None = None
    normal_sigma_deg: Annotated[float, Field(ge=0, le=45)] | None = None
    average_normals: bool | None = None
    material_covariance: Literal["synthetic", "independent"] | None = None


class Run(Section):
    """[run]: how the machine is used."""

    workers: Annotated[int, Field(ge=0, le=256)] = Field(0, description="0: all cores")
    memory_limit_mb: Annotated[int, Field(ge=128)] = Field(450, description="bound on the memory of a scene")
    skip: bool = Field(True, description="false computes everything: for checking")
    scheduler: str | None = Field(
        None, description="address of a Dask scheduler, whose workers do the batch", examples=["tcp://host:8786"]
    )
    split_mpixel: Annotated[float, Field(gt=0)] = Field(
        400, description="on a cluster, scenes with more pixels than this [millions] are done in strips"
    )


class Materials(Section):
    """[materials]: which class of the class map is which material."""

    library: list[str] = Field([], description="material files beside the built-in library")
    classes: dict[int, str] = Field(description="value in the class map = material")
    settings: dict[str, MaterialSettings] = Field({}, description="settings of one material")

    @field_validator("classes", mode="before")
    @classmethod
    def _classes_are_named_once(cls, classes: Any) -> Any:
        """TOML takes 1 and 01 for two keys."""
        if isinstance(classes, dict):
            values = [int(key) for key in classes if str(key).strip().lstrip("+-").isdecimal()]
            for value in values:
                if values.count(value) > 1:
                    raise ValueError(f"names {value} more than once; allowed is one material for each class")
        return classes


class Sun(Section):
    """`sun`: a time, or a direction."""

    time: AwareDatetime | None = Field(None, description="with its zone, like 2026-06-21T10:12:00Z")
    zenith_deg: Annotated[float, Field(ge=0, lt=90)] | None = Field(None, description="from the vertical")
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None = Field(
        None, description="clockwise from true north, surface to sun"
    )

    @model_validator(mode="after")
    def _one_of_two(self) -> "Sun":
        given = (self.zenith_deg is not None, self.azimuth_deg is not None)
        if (self.time is not None) == any(given) or given[0] != given[1]:
            raise ValueError("give { time = ... } or { zenith_deg = ..., azimuth_deg = ... }")
        return self


class ConstantViewSettings(Section):
    """`view` of kind constant: one direction for the whole image."""

    kind: Literal["constant"]
    zenith_deg: Annotated[float, Field(ge=0, lt=90)] = Field(description="from the vertical", examples=[10.0])
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        description="clockwise from true north, surface to sensor", examples=[90.0]
    )


class FrameViewSettings(Section):
    """`view` of kind frame: one camera that took the whole image at once."""

    kind: Literal["frame"]
    position: tuple[float, float, float] = Field(
        description="x, y, z of the camera in the image's CRS, or in `crs` [m]", examples=[[84500.0, 447200.0, 600.0]]
    )
    crs: str | None = Field(None, description="of the positions; default: the image's")
    height_offset_m: float = Field(0.0, description="added to the heights, which are ellipsoidal from GNSS")


class LineViewSettings(Section):
    """`view` of kind line: a scanner that took row after row."""

    kind: Literal["line"]
    trajectory: str = Field(description="CSV: utc,x,y,z[,roll_deg,pitch_deg,heading_deg]", examples=["trajectory.csv"])
    start: AwareDatetime | None = Field(None, description="first time of the line, where the file holds more")
    end: AwareDatetime | None = None
    crs: str | None = Field(None, description="of the positions; default: the image's")
    height_offset_m: float = Field(0.0, description="added to the heights, which are ellipsoidal from GNSS")

    @model_validator(mode="after")
    def _start_before_end(self) -> "LineViewSettings":
        if self.start is not None and self.end is not None and not self.start < self.end:
            raise ValueError("allowed is an end after the start")
        return self


class AnglesViewSettings(Section):
    """`view` of kind angles: rasters of zenith angle and azimuth."""

    kind: Literal["angles"]
    zenith: str = Field(description="raster of the view zenith angle [degrees]", examples=["vza.tif"])
    azimuth: str = Field(
        description="raster of the azimuth from true north, surface to sensor [degrees]", examples=["vaa.tif"]
    )
    scale: Annotated[float, Field(gt=0)] | None = Field(
        None, description="stored value times this is degrees; default: the scale and offset of the file"
    )


class ObsViewSettings(Section):
    """`view` of kind obs: an observation geometry file of JPL, EMIT or NEON; with no `sun`, the sun is its own."""

    kind: Literal["obs"]
    path: str = Field(description="the observation geometry file", examples=["flight_obs"])


class MosaicViewSettings(Section):
    """`view` of kind mosaic: which camera each pixel came from."""

    kind: Literal["mosaic"]
    index: str = Field(
        description="raster of the number of the camera that each pixel came from", examples=["source.tif"]
    )
    cameras: str = Field(description="CSV: id,x,y,z", examples=["cameras.csv"])
    crs: str | None = Field(None, description="of the positions; default: the image's")
    height_offset_m: float = Field(0.0, description="added to the heights, which are ellipsoidal from GNSS")


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
    """`surface` of kind flat: everything is horizontal."""

    kind: Literal["flat"]
    height_m: float = Field(0.0, description="of the ground", examples=[0.0])


class DsmSettings(Section):
    """`surface` of kind dsm, or roof_planes: a surface model as it is, or smoothed to planes of roofs."""

    kind: Literal["dsm", "roof_planes"]
    path: str = Field(description="raster of heights, in a projected CRS [m]", examples=["dsm.tif"])


class NormalsSettings(Section):
    """`surface` of kind normals: unit vectors that are known already."""

    kind: Literal["normals"]
    path: str = Field(description="raster of three bands: east, north, up", examples=["normals.tif"])
    heights: str | None = Field(None, description="raster of heights, for shadows [m]")


class ObsSurfaceSettings(Section):
    """`surface` of kind obs: slope and aspect of an observation geometry file."""

    kind: Literal["obs"]
    path: str = Field(description="the observation geometry file", examples=["flight_obs"])
    heights: str | None = Field(None, description="raster of heights, for shadows [m]")


SurfaceSettings = Annotated[
    FlatSettings | DsmSettings | NormalsSettings | ObsSurfaceSettings, Field(discriminator="kind")
]


class Truth(Section):
    """`truth` of a synthetic scene: what the image would be without the specular part."""

    diffuse: str = Field(description="reflectance factor without the specular part")
    sunlit: str = Field(description="1 where the sun shines")


LONGEST_NAME = 100
"""bytes of a scene's name: its folder has a longer one while it is made"""
UNFIT = set('/\\<>:"|?*')
"""no folder can have them in its name on Linux or Windows"""
TOP_FILES = {"batch.json", "batch.log", "index.html", "collection.json"}
DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(1, 10))}
"""names that Windows keeps for itself, with any ending"""


class Scene(Section):
    """[[scenes]]: one image, or a glob of images that share their settings."""

    name: str | None = Field(None, description="default: the image's stem")
    image: str = Field(description="path, or a glob: {stem} and {parent} then serve in the other paths")
    quantity: Literal["reflectance_factor", "brdf"] = Field(
        "reflectance_factor", description="what scale * stored + offset is"
    )
    scale: PerBand | None = Field(None, description="default: the file's; one value or one a band")
    offset: PerBand | None = Field(None, description="default: the file's; one value or one a band")
    nodata: float | None = Field(None, description="stored value; default: the file's")
    wavelength_um: list[float] | None = Field(None, description="centre of each band; default: the file's")
    saturation: PerBand | None = Field(None, description="stored value from which a band is saturated")
    direct_fraction: PerBand | None = Field(None, description="as in [correction], for this scene")
    class_map: str = Field(description="raster of classes, on any grid that overlaps the image")
    class_confidence: str | None = Field(None, description="raster of how sure the class is, 0 to 1")
    sun: Sun | None = Field(
        None, description="a time or a direction; left out where a trajectory or an OBS file tells it"
    )
    view: ViewSettings = Field(description="where the sensor was")
    surface: SurfaceSettings = Field(FlatSettings(kind="flat"), description="how the ground and the roofs lie")
    shadows: bool = Field(True, description="find what casts shadows, and remove nothing there")
    truth: Truth | None = Field(None, description="of a synthetic scene: the residual glare is reported")

    @field_validator("name")
    @classmethod
    def _safe_name(cls, name: str | None) -> str | None:
        if name is None:
            return None
        fits = 0 < len(name.encode()) <= LONGEST_NAME and name.isprintable() and not set(name) & UNFIT
        taken = name.lower() in TOP_FILES or name.partition(".")[0].lower() in DEVICES
        if not fits or taken or name != name.strip(". "):
            raise ValueError(
                f"a name is a folder on any system: 1 to {LONGEST_NAME} bytes of printable characters without "
                f"{' '.join(sorted(UNFIT))}, no dot or space at its ends, and not taken, as con or batch.json are"
            )
        return name


class Config(Section):
    """The whole file; `folder` is where its relative paths start."""

    title: str = Field("", description="heads the page of the results")
    output: Output = Output()
    model: Model = Model()
    correction: Correction = Correction()
    run: Run = Run()
    materials: Materials
    scenes: list[Scene] = Field(min_length=1)

    @model_validator(mode="after")
    def _vrt_is_a_difference(self) -> "Config":
        if self.output.corrected == "vrt":
            if self.output.format == "envi":
                raise ValueError("output.corrected = 'vrt' needs output.format = 'gtiff' or 'cog', not 'envi'")
            if "corrected" not in self.output.products:
                raise ValueError("output.corrected = 'vrt' needs 'corrected' among the output.products")
            policies = {"correction": self.correction.uncorrectable} | {
                f"materials.settings.{name}": own.uncorrectable for name, own in self.materials.settings.items()
            }
            for table, policy in policies.items():
                if policy == "nodata":
                    raise ValueError(
                        f"{table}.uncorrectable = 'nodata' cannot be had with output.corrected = 'vrt': a difference "
                        f"makes no nodata; allowed are 'best' and 'keep', or output.corrected = 'file'"
                    )
        return self

    @model_validator(mode="after")
    def _settings_are_used(self) -> "Config":
        used = set(self.materials.classes.values())
        for name in self.materials.settings:
            if name not in used:
                raise ValueError(
                    f"[materials.settings.{name}] is for no material of [materials.classes]{nearest(name, used)}"
                )
        return self


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
TABLES: dict[str, Any] = {
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
    "reference": Reference,
    "settings": MaterialSettings,
}
"""what stands under a key, wherever that is in the file"""
