"""Styles that QGIS finds beside a raster by its name."""

from collections.abc import Sequence
from xml.etree import ElementTree as ET

import numpy as np

from tscorr.correction import SINGLE_FLAGS, PixelFlag
from tscorr.quicklook import FLAG_COLOURS, flag_classes, flag_palette

DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
SAID_BY_COLOUR = PixelFlag.NODATA | PixelFlag.NO_MATERIAL


def flag_style(values: Sequence[int]) -> str:
    """A style of the flags as XML (.qml) with a legend of the given values, as they occur in one scene.

    Else the legend would have all 65536 entries of the colour table.
    """
    root = ET.Element("qgis", version="3.0")
    pipe = ET.SubElement(root, "pipe")
    renderer = ET.SubElement(pipe, "rasterrenderer", type="paletted", band="1", opacity="1", alphaBand="-1")
    palette = ET.SubElement(renderer, "colorPalette")
    classes = flag_classes(np.array(values, np.uint16))
    for value, place in sorted(zip(values, classes.tolist(), strict=True), key=lambda entry: (entry[1], entry[0])):
        colour = "#" + "".join(f"{part:02x}" for part in flag_palette()[value])
        label = _label(list(FLAG_COLOURS)[place], value)
        ET.SubElement(palette, "paletteEntry", value=str(value), color=colour, alpha="255", label=label)
    ET.indent(root)
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + ET.tostring(root, encoding="unicode") + "\n"
    )


def _label(reason: str, value: int) -> str:
    """The decisive reason in words, and the names of the flags that are set."""
    names = [str(flag.name) for flag in SINGLE_FLAGS if value & flag & ~SAID_BY_COLOUR]
    return f"{reason}: {', '.join(names)}" if names else reason
