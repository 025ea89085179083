"""Small scenes on disk for tests: flat ground, a block of tiles and a gable of metal, with glare on the flat parts.

The sun stands in the south at 40 degrees of zenith angle, and the camera looks from the north at 40 degrees: every
horizontal pixel mirrors the sun into it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tomli_w
from affine import Affine

CRS = "EPSG:28992"
WEST, NORTH, CELL = 84664.0, 447719.0, 0.5
SHAPE = 48, 64
BANDS = 3
TILE, METAL, GROUND, UNKNOWN = 1, 4, 5, 9
SCALE = 1e-4
NODATA = -9999
WAVELENGTHS = 0.475, 0.56, 0.668


def write_raster(path, values, *, crs=CRS, west=WEST, north=NORTH, cell=CELL, **profile):
    """A GeoTIFF of (rows, cols) or (bands, rows, cols); its path."""
    values = np.asarray(values)
    cube = values if values.ndim == 3 else values[None]
    bands, rows, cols = cube.shape
    profile = {"tiled": True, "blockxsize": 16, "blockysize": 16, "compress": "deflate", **profile}
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=bands,
        height=rows,
        width=cols,
        dtype=cube.dtype,
        crs=crs,
        transform=Affine(cell, 0, west, 0, -cell, north),
        **profile,
    ) as file:
        file.write(cube)
    return Path(path)


def read_raster(path):
    """All bands (bands, rows, cols)."""
    with rasterio.open(path) as file:
        return file.read()


def class_map():
    """Ground with a block of tiles, a roof of metal, and a corner that no class names."""
    classes = np.full(SHAPE, GROUND, np.uint8)
    classes[6:20, 6:30] = TILE
    classes[26:42, 30:56] = METAL
    classes[:4, :4] = UNKNOWN
    return classes


def heights():
    """Ground at 1 m; a gable of 10 degrees whose ridge runs west to east over the metal. [m]"""
    dsm = np.ones(SHAPE, np.float32)
    rows = np.arange(26, 42)
    dsm[26:42, 30:56] = (5.0 - np.abs(rows - 33.5) * CELL * np.tan(np.deg2rad(10)))[:, None]
    return dsm


def image_values(dtype=np.int16):
    """Stored values whose reflectance factor is 0.3 to 0.6."""
    rng = np.random.default_rng(11)
    return rng.integers(3000, 6000, (BANDS, *SHAPE)).astype(dtype)


def write_image(path, values=None, **profile):
    """An image with names, wavelengths, scale, nodata and tags."""
    values = image_values() if values is None else values
    profile = {"nodata": NODATA, **profile}
    write_raster(path, values, **profile)
    with rasterio.open(path, "r+") as file:
        file.scales = (SCALE,) * file.count
        file.update_tags(FLIGHT="7", ACQUISITION="2024-05-15")
        for band in file.indexes:
            file.set_band_description(band, f"band at {WAVELENGTHS[band - 1]} um")
            file.update_tags(band, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=str(WAVELENGTHS[band - 1]), FWHM_UM="0.02")
            file.update_tags(band, CALIBRATED="yes")
    return Path(path)


SCENE: dict[str, Any] = {
    "name": "roofs",
    "image": "image.tif",
    "class_map": "class_map.tif",
    "sun": {"zenith_deg": 40.0, "azimuth_deg": 180.0},
    "view": {"kind": "constant", "zenith_deg": 40.0, "azimuth_deg": 0.0},
    "surface": {"kind": "dsm", "path": "dsm.tif"},
}


def write_inputs(folder):
    """The image, the class map and the surface model of the default scene."""
    write_image(folder / "image.tif")
    write_raster(folder / "class_map.tif", class_map())
    write_raster(folder / "dsm.tif", heights())


def write_config(folder, *scenes, **sections):
    """A configuration of the default scene with some keys changed; its path.

    scenes   : keys of each scene that differ from SCENE; a value of None leaves the key out.
    sections : whole tables of the file.
    """
    changes = scenes or ({},)
    entries = [{key: value for key, value in {**SCENE, **change}.items() if value is not None} for change in changes]
    classes = {str(TILE): "roof_tile", str(METAL): "red_aluminum", str(GROUND): "lambertian"}
    values = {
        "output": {"directory": "out", "quicklook": False},
        "materials": {"classes": classes},
        **sections,
        "scenes": entries,
    }
    path = folder / "city.toml"
    path.write_text(tomli_w.dumps(values), encoding="utf-8")
    return path


def small_scene(folder, *scenes, **sections):
    """Inputs and configuration of the default scene in a folder; the path of the configuration."""
    write_inputs(folder)
    return write_config(folder, *scenes, **sections)


def write_truncated_image(path):
    """An image whose header is whole and whose last tiles are missing."""
    noise = np.random.default_rng(8).integers(3000, 6000, (BANDS, *SHAPE)).astype(np.int16)
    write_raster(path, noise, nodata=NODATA)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path
