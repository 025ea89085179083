"""[[scenes]] of a configuration as pydantic models: the image, the sun, the sensor and the surface."""

from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, field_validator, model_validator

from tscorr.config.fields import Number, PerBand, Section, SharePerBand, Switch


class Sun(Section):
    """`sun`: a time, or a direction."""

    time: AwareDatetime | None = Field(None, description="with its zone, like 2026-06-21T10:12:00Z")
    zenith_deg: Annotated[Number, Field(ge=0, lt=90)] | None = Field(None, description="from the vertical")
    azimuth_deg: Annotated[Number, Field(ge=-360, le=360)] | None = Field(
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
    zenith_deg: Annotated[Number, Field(ge=0, lt=90)] = Field(description="from the vertical", examples=[10.0])
    azimuth_deg: Annotated[Number, Field(ge=-360, le=360)] = Field(
        description="clockwise from true north, surface to sensor", examples=[90.0]
    )


class FrameViewSettings(Section):
    """`view` of kind frame: one camera that took the whole image at once."""

    kind: Literal["frame"]
    position: tuple[Number, Number, Number] = Field(
        description="x, y, z of the camera in the image's CRS, or in `crs` [m]", examples=[[84500.0, 447200.0, 600.0]]
    )
    crs: str | None = Field(None, description="of the positions; default: the image's")
    height_offset_m: Number = Field(0.0, description="added to the heights, which are ellipsoidal from GNSS")


class LineViewSettings(Section):
    """`view` of kind line: a scanner that took row after row."""

    kind: Literal["line"]
    trajectory: str = Field(description="CSV: utc,x,y,z[,roll_deg,pitch_deg,heading_deg]", examples=["trajectory.csv"])
    start: AwareDatetime | None = Field(None, description="first time of the line, where the file holds more")
    end: AwareDatetime | None = Field(None, description="last time of the line")
    crs: str | None = Field(None, description="of the positions; default: the image's")
    height_offset_m: Number = Field(0.0, description="added to the heights, which are ellipsoidal from GNSS")

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
    scale: Annotated[Number, Field(gt=0)] | None = Field(
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
    height_offset_m: Number = Field(0.0, description="added to the heights, which are ellipsoidal from GNSS")


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
    height_m: Number = Field(0.0, description="of the ground", examples=[0.0])


class DsmSettings(Section):
    """`surface` of kind dsm, or roof_planes: a surface model as it is, or smoothed to planes of roofs."""

    kind: Literal["dsm", "roof_planes"]
    path: str = Field(description="raster of heights, in a projected CRS [m]", examples=["dsm.tif"])


class NormalsSettings(Section):
    """`surface` of kind normals: unit vectors that are known already."""

    kind: Literal["normals"]
    path: str = Field(
        description="raster of three bands: east, north, up of the image's grid", examples=["normals.tif"]
    )
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

    diffuse: str = Field(description="reflectance factor without the specular part", examples=["diffuse.tif"])
    sunlit: str = Field(description="1 where the sun shines", examples=["sunlit.tif"])


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
    nodata: Number | None = Field(None, description="stored value; default: the file's")
    wavelength_um: list[Number] | None = Field(None, description="centre of each band; default: the file's")
    saturation: PerBand | None = Field(None, description="stored value from which a band is saturated")
    direct_fraction: SharePerBand | None = Field(None, description="as in [correction], for this scene")
    class_map: str = Field(description="raster of classes, on any grid that overlaps the image")
    class_confidence: str | None = Field(None, description="raster of how sure the class is, 0 to 1")
    sun: Sun | None = Field(
        None, description="a time or a direction; left out where a trajectory or an OBS file tells it"
    )
    view: ViewSettings = Field(description="where the sensor was")
    surface: SurfaceSettings = Field(FlatSettings(kind="flat"), description="how the ground and the roofs lie")
    shadows: Switch = Field(True, description="find what casts shadows, and remove nothing there")
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
