"""One raster of several files that lie below each other: a VRT, which names them and holds no pixels."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from xml.etree import ElementTree as ET

import rasterio
from rasterio.errors import RasterioError
from rasterio.shutil import copy as copy_raster

from tscorr.errors import OutputError
from tscorr.rasters.header import RasterInfo, describe, environment


def join_rows(parts: Sequence[Path], path: Path) -> None:
    """Write a VRT of rasters of equal width, bands and tags, top to bottom; all of them in the folder of `path`."""
    try:
        with environment():
            copy_raster(parts[0], path, driver="VRT")
            with rasterio.open(parts[0], sharing=False) as first:
                tags = [first.tags(band, ns="IMAGERY") for band in first.indexes]
            heights = [_rows(part) for part in parts]
    except RasterioError as error:
        raise OutputError(f"{path} cannot be made of its {len(parts)} strips: {error}") from None
    tree = ET.parse(path)  # noqa: S314 - written above
    root = tree.getroot()
    root.set("rasterYSize", str(sum(heights)))
    for overviews in root.findall("OverviewList"):
        root.remove(overviews)  # for the first part alone; those of the files serve without a list
    for band in root.findall("VRTRasterBand"):
        for table in band.findall("ColorTable"):  # 65536 lines of XML; those of the files serve
            band.remove(table)
    for band, imagery in zip(root.findall("VRTRasterBand"), tags, strict=True):
        if imagery:  # GDAL copies the tags of the default domain only
            band.insert(0, _metadata("IMAGERY", imagery))
        (source,) = band.findall("SimpleSource")
        band.remove(source)
        band.extend([_placed(source, part, sum(heights[:i]), heights[i]) for i, part in enumerate(parts)])
    tree.write(path, encoding="utf-8")


def result(folder: Path, product: str, image: RasterInfo | None = None) -> RasterInfo | None:
    """A product in a folder of results: one file, or a VRT of several; None where there is neither.

    image : the image of the scene, from which a VRT may subtract what was removed.
    """
    files = (folder / f"{product}{suffix}" for suffix in (".vrt", ".tif", ".dat"))
    found = next((file for file in files if file.exists()), None)
    return None if found is None else describe(found, ours=True, draws_on=() if image is None else image.files)


def _rows(path: Path) -> int:
    with rasterio.open(path, sharing=False) as part:
        return part.height


def _metadata(domain: str, tags: Mapping[str, str]) -> ET.Element:
    element = ET.Element("Metadata", domain=domain)
    for key, value in tags.items():
        ET.SubElement(element, "MDI", key=key).text = value
    return element


def _placed(source: ET.Element, part: Path, top: int, rows: int) -> ET.Element:
    """The source of a VRT turned into that of another file, whose first row is the row `top` of the whole."""
    placed = deepcopy(source)
    for element in placed:
        match element.tag:
            case "SourceFilename":
                element.text = part.name
                element.set("relativeToVRT", "1")
            case "SourceProperties":
                element.set("RasterYSize", str(rows))
            case "SrcRect" | "DstRect":
                element.set("ySize", str(rows))
                element.set("yOff", str(top if element.tag == "DstRect" else 0))
    return placed
