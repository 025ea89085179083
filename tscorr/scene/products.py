"""The rasters that a scene is written to."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from tscorr import __version__, rasters
from tscorr.correction import SINGLE_FLAGS
from tscorr.correction.covariance import ORIGINS, origin
from tscorr.correction.extras import signed
from tscorr.grid import Block
from tscorr.quicklook import flag_palette
from tscorr.scene.plan import Scene

ANGLE_NAMES = (
    "incidence",
    "exitance",
    "relative_azimuth",
    "facet_tilt",
    "local_angle",
    "solar_zenith",
    "solar_azimuth",
    "view_zenith",
    "view_azimuth",
)
FASTER_CODEC: dict[str, dict[str, Any]] = {"none": {"compress": "zstd"}, "deflate": {"zlevel": 3}}
"""by the image's codec, for layers that it sets no example for: flags and what was removed, mostly 0, become small by
any codec, and fast by these: of the levels of DEFLATE 3 is faster here than 1, and smaller"""
FLAG_TAGS = {f"FLAG_BIT_{flag.value.bit_length() - 1}": str(flag.name) for flag in SINGLE_FLAGS} | {
    "FLAG_BITS_6_7": "SPECULAR_STATE: 0 negligible, 1 corrected, 2 uncorrectable, 3 not assessed"
}


def written_products(scene: Scene) -> set[str]:
    """The products whose pixels are written; with `corrected = "vrt"`, what was removed instead of the image."""
    products: set[str] = set(scene.config.output.products)
    return products - {"corrected"} | {"removed"} if scene.config.output.corrected == "vrt" else products


def layer_of(scene: Scene, name: str) -> rasters.Layer:
    """What a product holds."""
    image, stored = scene.image, scene.stored
    tags = {"TSCORR_VERSION": __version__, "TSCORR_SCENE": scene.name, "TSCORR_PRODUCT": name}
    like_image = rasters.Layer(
        names=image.names,
        dtype=image.dtype.name,
        nodata=stored.nodata,
        scales=image.scales,
        offsets=image.offsets,
        of_image=True,
        tags=tags,
    )
    angles = rasters.Layer(names=ANGLE_NAMES, dtype="float32", nodata=float("nan"), units=("degree",) * 9, tags=tags)
    origins = "; ".join(
        f"{surface.name}: {ORIGINS[origin(surface, rules.material_covariance)]}"
        for surface, _, rules in scene.materials
        if surface.has_peak
    )
    layers = {
        "corrected": like_image,
        "removed": replace(
            like_image,
            dtype=signed(image.dtype, scene.materials).name,
            nodata=None,
            offsets=(0.0,) * image.bands,
            sparse=True,
        ),
        "uncertainty": replace(
            like_image,
            dtype="float32",
            nodata=float("nan"),
            scales=None,
            tags={**tags, "QUANTITY": "1 sigma of the corrected reflectance factor", "TSCORR_COVARIANCE": origins},
        ),
        "flags": rasters.Layer(
            names=("flags",),
            dtype="uint16",
            tags={**tags, **FLAG_TAGS},
            sparse=True,
            bits=True,
            palette=flag_palette(),
        ),
        "azimuthal_width": replace(angles, names=("azimuthal width",), units=("degree",)),
        "angles": angles,
    }
    return layers[name]


def writer_of(
    scene: Scene, folder: Path, name: str, strip: Block | None = None
) -> rasters.Writer | rasters.EnviWriter:
    """The file of a product in a folder, of the whole scene or of a strip of it."""
    image, profile = scene.image, dict(scene.image.profile)
    if (codec := scene.config.output.compression) is not None:
        profile["compress"] = codec
    layer = layer_of(scene, name)
    if not layer.of_image or name == "removed":
        profile |= FASTER_CODEC.get(profile["compress"], {})
    like = image if strip is None else image.crop(strip)
    if scene.config.output.format == "envi":
        return rasters.EnviWriter(folder / f"{name}{rasters.ENVI_SUFFIX}", like, layer)
    return rasters.Writer(folder / f"{name}.tif", profile, like, layer)


def write_corrected_vrt(scene: Scene, folder: Path) -> None:
    """The corrected image as a VRT: the image less what was removed."""
    removed = rasters.result(folder, "removed")
    assert removed is not None  # written before
    rasters.write_difference(folder / "corrected.vrt", scene.image, removed, layer_of(scene, "corrected"))
