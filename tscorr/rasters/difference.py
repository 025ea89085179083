"""A raster that is the difference of two others, as a VRT of a few kilobytes: nothing is copied.

GDAL subtracts when the VRT is read (its built-in pixel function `diff`, in every version since 2.2): plain rasterio,
gdal_translate or a GIS open it like any file, as long as both rasters stay where they are.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from rasterio.enums import ColorInterp

from tscorr.errors import OutputError
from tscorr.rasters.header import RasterInfo
from tscorr.rasters.writing import Layer

GDAL_TYPES = {"uint8": "Byte", "int16": "Int16", "uint16": "UInt16", "int32": "Int32", "float32": "Float32"}
BETWEEN = 0.5
"""added to both integers of a difference: since 3.12 `diff` gives nodata where either of them equals it"""


def expressible(image: RasterInfo, nodata: float | None) -> bool:
    """Whether a difference keeps an image's nodata in every version of GDAL.

    Of floating point, a nodata value that can be an amount is no good: `diff` takes the amount 0 for nodata 0.
    """
    return image.dtype.kind in "iu" or nodata is None or not 0 <= nodata < float("inf")


def write_difference(path: Path, image: RasterInfo, less: RasterInfo, layer: Layer) -> None:
    """Write the VRT of `image` less `less`, rasters of one shape.

    layer : names, nodata, scales, offsets and tags. Where the image can be reached from the VRT's folder, its path is
    relative: folders can be moved together.
    """
    root = ET.Element("VRTDataset", rasterXSize=str(image.shape[1]), rasterYSize=str(image.shape[0]))
    if image.grid.crs is not None:
        ET.SubElement(root, "SRS").text = image.grid.crs.to_wkt()
    ET.SubElement(root, "GeoTransform").text = ", ".join(map(repr, image.grid.transform.to_gdal()))
    _describe(root, {"": {**image.tags, **layer.tags}})
    for index in range(image.bands):
        root.append(_band(index, path.parent, image, less, layer))
    try:
        ET.indent(root)
        ET.ElementTree(root).write(path, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error}") from None


def _band(index: int, folder: Path, image: RasterInfo, less: RasterInfo, layer: Layer) -> ET.Element:
    rows, cols = image.tile
    band = ET.Element(
        "VRTRasterBand",
        dataType=GDAL_TYPES[image.dtype.name],
        band=str(index + 1),
        subClass="VRTDerivedRasterBand",
        blockXSize=str(cols),
        blockYSize=str(rows),
    )
    _describe(band, image.band_tags[index])
    _set(band, "Description", layer.names[index])
    if layer.nodata is not None:
        _set(band, "NoDataValue", layer.nodata)
    if layer.offsets is not None and layer.scales is not None:
        _set(band, "Offset", layer.offsets[index])
        _set(band, "Scale", layer.scales[index])
    if image.colors and ColorInterp.palette not in image.colors:
        _set(band, "ColorInterp", image.colors[index].name.capitalize())
    _set(band, "PixelFunctionType", "diff")
    _set(band, "SourceTransferType", "Float64")
    for raster in (image, less):
        band.append(_source(index, folder, raster))
    return band


def _source(index: int, folder: Path, raster: RasterInfo) -> ET.Element:
    """One band of a raster; the properties spare GDAL from opening it before it is read."""
    integer = raster.dtype.kind in "iu"
    source = ET.Element("ComplexSource" if integer else "SimpleSource")
    name, relative = _path_from(folder, raster.path)
    ET.SubElement(source, "SourceFilename", relativeToVRT=str(int(relative))).text = name
    _set(source, "SourceBand", index + 1)
    rows, cols = raster.shape
    ET.SubElement(
        source,
        "SourceProperties",
        RasterXSize=str(cols),
        RasterYSize=str(rows),
        DataType=GDAL_TYPES[raster.dtype.name],
        BlockXSize=str(raster.tile[1]),
        BlockYSize=str(raster.tile[0]),
    )
    for rect in ("SrcRect", "DstRect"):
        ET.SubElement(source, rect, xOff="0", yOff="0", xSize=str(cols), ySize=str(rows))
    if integer:
        _set(source, "ScaleOffset", BETWEEN)
        _set(source, "ScaleRatio", 1)
    return source


def _path_from(folder: Path, path: Path) -> tuple[str, bool]:
    """The way from a folder to a file, and whether it is relative; absolute across drives."""
    try:
        return os.path.relpath(path.resolve(), folder.resolve()), True
    except ValueError:
        return str(path.resolve()), False


def _describe(parent: ET.Element, domains: Mapping[str, Mapping[str, str]]) -> None:
    """Metadata by domain."""
    for domain, tags in domains.items():
        if tags:
            metadata = ET.SubElement(parent, "Metadata", {"domain": domain} if domain else {})
            for key, value in tags.items():
                ET.SubElement(metadata, "MDI", key=key).text = value


def _set(parent: ET.Element, name: str, value: Any) -> None:
    text = repr(float(value)) if isinstance(value, float | np.floating) else str(value)
    ET.SubElement(parent, name).text = text
