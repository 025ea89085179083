"""The tables of a configuration file as pydantic models, and the whole file."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from tscorr.config.fields import NoisePerBand, Number, Section, Share, SharePerBand, Switch, Whole
from tscorr.config.scenes import SURFACES, VIEWS, Scene, Sun, Truth
from tscorr.errors import nearest

Product = Literal["corrected", "flags", "removed", "uncertainty", "azimuthal_width", "angles"]
Method = Literal["subtract", "ratio", "reference"]


class Output(Section):
    """[output]: where results go, and which."""

    directory: str = Field("out", min_length=1, description="folder for the results, relative to this file")
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
    quicklook: Switch = Field(True, description="draw a true-colour picture: before, after, flags")
    hash: Literal["blake3", "sha256"] = Field("blake3", description="of inputs and outputs, in manifest.json")


class Model(Section):
    """[model]: which form of the Torrance-Sparrow model, and how exactly it is evaluated."""

    form: Literal["full", "simplified"] = Field(
        "full", description="simplified drops the geometric attenuation factor"
    )
    precision: Literal["fast", "exact", "reference"] = Field(
        "fast", description="float32, float64, or plain numpy for checking"
    )


class Reference(Section):
    """`reference` of [correction]: the directions that the specular part is normalised to."""

    solar_zenith_deg: Annotated[Number, Field(ge=0, le=75)] = 45.0
    view_zenith_deg: Annotated[Number, Field(ge=0, le=75)] = 0.0
    relative_azimuth_deg: Annotated[Number, Field(ge=0, le=180)] = 0.0


class Correction(Section):
    """[correction]: what is taken away, and what is done where that cannot be right."""

    method: Method = Field(
        "subtract",
        description="take the specular reflectance away; ratio: by the material's own share of it; "
        "reference: and add what level ground shows at the reference directions",
    )
    reference: Reference = Field(Reference(), description="directions about level ground for method reference")
    negligible_reflectance: Share | None = Field(
        None,
        description="below this nothing is removed; default: half a stored step (5e-5 for floating point)",
    )
    uncorrectable: Literal["best", "keep", "nodata"] = Field(
        "best", description="what becomes of a pixel whose share is above the limit"
    )
    uncorrectable_share: Annotated[Number, Field(gt=0, le=1)] = Field(
        0.9, description="part of the signal; where more would be removed the pixel is uncorrectable"
    )
    max_zenith_deg: Annotated[Number, Field(gt=0, lt=90)] | None = Field(
        None, description="largest incidence and exitance; default 85, 70 with the simplified form"
    )
    irradiance_plane: Literal["horizontal", "facet"] = Field(
        "horizontal", description="the plane that the reflectance of the image refers to"
    )
    direct_fraction: SharePerBand = Field(1.0, description="direct share of that irradiance, one value or one a band")
    sky_specular: Switch = Field(False, description="take the specular part of an even sky's light away too")
    weigh_by_confidence: Switch = Field(
        True, description="take away the part of the lobe that class_confidence says, where it is given"
    )
    image_noise: NoisePerBand = Field(
        (0.0, 0.0), description="a, b of the image's 1 sigma a + b R in reflectance factor, or one pair a band"
    )
    direct_fraction_sigma: SharePerBand = Field(0.0, description="1 sigma of direct_fraction")
    normal_sigma_deg: Annotated[Number, Field(ge=0, le=45)] | None = Field(
        None,
        description="1 sigma of the surface normals along each of two axes; default: what the surface knows of it",
    )
    average_normals: Switch = Field(False, description="average the lobe over the scatter of the normals")
    direction_sigma_deg: Annotated[Number, Field(ge=0, le=45)] = Field(
        0.0, description="1 sigma of the direction to the sensor along each of two axes"
    )
    material_covariance: Literal["synthetic", "independent"] = Field(
        "synthetic",
        description="of materials with errors but no covariance: as of the paper's fits, or an upper bound",
    )


class MaterialSettings(Section):
    """[materials.settings.NAME]: any key of [model] and [correction] for one material, but those of the image."""

    enabled: Switch = True
    form: Literal["full", "simplified"] | None = None
    precision: Literal["fast", "exact", "reference"] | None = None
    method: Method | None = None
    reference: Reference | None = None
    negligible_reflectance: Share | None = None
    uncorrectable: Literal["best", "keep", "nodata"] | None = None
    uncorrectable_share: Annotated[Number, Field(gt=0, le=1)] | None = None
    max_zenith_deg: Annotated[Number, Field(gt=0, lt=90)] | None = None
    irradiance_plane: Literal["horizontal", "facet"] | None = None
    direct_fraction: SharePerBand | None = None
    direct_fraction_sigma: SharePerBand | None = None
    sky_specular: Switch | None = None
    normal_sigma_deg: Annotated[Number, Field(ge=0, le=45)] | None = None
    average_normals: Switch | None = None
    material_covariance: Literal["synthetic", "independent"] | None = None


class Run(Section):
    """[run]: how the machine is used."""

    workers: Annotated[Whole, Field(ge=0, le=256)] = Field(0, description="0: as many as there are cores, up to 4")
    memory_limit_mb: Annotated[Whole, Field(ge=128)] = Field(450, description="bound on the memory of a scene")
    skip: Switch = Field(True, description="false computes everything: for checking")
    scheduler: str | None = Field(
        None, description="address of a Dask scheduler, whose workers do the batch", examples=["tcp://host:8786"]
    )
    split_mpixel: Annotated[Number, Field(gt=0)] = Field(
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
