"""ENVI files beyond what GDAL makes of them.

GDAL leaves the reflectance scale factor and the bad bands in its domain ENVI and rounds wavelengths to 1 nm. Where
all bands of a pixel stand together (BIP) it reads the whole file once for each band, so such pixels are read here.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import InputError
from tscorr.grid import Block

Array = NDArray[Any]
Fields = Mapping[str, str]
"""a header as GDAL gives it: lower case, `_` for spaces, lists in braces"""

SCALING = {"reflectance_scale_factor", "data_gain_values", "data_offset_values"}
OF_THE_FILE = {
    "band_names",
    "bands",
    "byte_order",
    "coordinate_system_string",
    "data_ignore_value",
    "data_type",
    "description",
    "file_compression",
    "file_type",
    "header_offset",
    "interleave",
    "lines",
    "map_info",
    "projection_info",
    "samples",
}
"""fields that GDAL writes by itself"""


def items(fields: Fields, key: str, bands: int) -> list[str] | None:
    """The entries of a list with one for each band; None where there is no such list."""
    entries = [entry.strip() for entry in fields.get(key, "").strip().strip("{}").split(",")]
    return entries if key in fields and len(entries) == bands else None


def numbers(fields: Fields, key: str, bands: int) -> list[float] | None:
    """The numbers of a list with one for each band; None where there is no such list."""
    try:
        return [float(entry) for entry in items(fields, key, bands) or ()] or None
    except ValueError:
        return None


def reflectance_scale(fields: Fields) -> float | None:
    """What stored values are multiplied with to be reflectance: 1 over the reflectance scale factor."""
    try:
        factor = float(fields.get("reflectance_scale_factor", ""))
    except ValueError:
        return None
    return 1 / factor if np.isfinite(factor) and factor > 0 else None


def bad_bands(fields: Fields, bands: int, path: Path) -> tuple[bool, ...]:
    """Which bands the header marks as bad (0 in `bbl`); empty where it marks none.

    InputError where it has not one value for each band: that of another image, say.
    """
    marks = numbers(fields, "bbl", bands)
    if marks is None and fields.get("bbl", "").strip(" {}"):
        raise InputError(f"{path}: bbl = {fields['bbl']}; allowed is 0 or 1 for each of the {bands} bands")
    bad = tuple(good == 0 for good in marks or ())
    return bad if any(bad) else ()


@dataclass(frozen=True, slots=True)
class PixelByPixel:
    """Where the pixels of a BIP file stand."""

    path: Path
    dtype: np.dtype[Any]
    """as stored: with its byte order"""
    shape: tuple[int, int, int]
    """(rows, cols, bands)"""
    offset: int

    @classmethod
    def of(
        cls, path: Path, fields: Fields, dtype: np.dtype[Any], shape: tuple[int, int, int]
    ) -> "PixelByPixel | None":
        """None unless the header says that the file is BIP and not compressed."""
        if fields.get("interleave", "").strip().lower() != "bip" or fields.get("file_compression", "0").strip() != "0":
            return None
        offset = fields.get("header_offset", "0").strip()
        stored = dtype.newbyteorder(">" if fields.get("byte_order", "0").strip() == "1" else "<")
        return cls(path, stored, shape, int(offset) if offset.isdigit() else 0)

    def read(self, block: Block) -> Array:
        """The pixels of a block inside the image: (bands, rows, cols), in the machine's byte order."""
        _, cols, bands = self.shape
        line = cols * bands
        offset = self.offset + block.row * line * self.dtype.itemsize
        try:
            pixels = np.fromfile(self.path, self.dtype, block.height * line, offset=offset)
        except OSError as error:
            raise InputError(f"{self.path} cannot be read: {error}") from None
        if pixels.size < block.height * line:
            raise InputError(f"{self.path} ends before row {block.row + block.height}")
        of_block = pixels.reshape(block.height, cols, bands)[:, block.col : block.col + block.width]
        return np.ascontiguousarray(np.moveaxis(of_block, 2, 0), dtype=self.dtype.newbyteorder("="))


def new_fields(
    kept: Fields,
    wavelengths_um: Sequence[float] | None,
    fwhm_um: Sequence[float] | None,
    bad: Sequence[bool],
) -> dict[str, str]:
    """The fields of a header that tell of the bands of an image; `kept` from the image's own, where it is ENVI."""
    fields = {key: text for key, text in kept.items() if key not in OF_THE_FILE | SCALING}
    if wavelengths_um is not None and "wavelength" not in fields:
        fields |= {"wavelength_units": "Micrometers", "wavelength": as_list(wavelengths_um)}
        if fwhm_um is not None:
            fields["fwhm"] = as_list(fwhm_um)
    if any(bad):
        fields["bbl"] = as_list([0 if is_bad else 1 for is_bad in bad])
    return fields


def scale_factor(scales: Sequence[float], offsets: Sequence[float]) -> str | None:
    """The reflectance scale factor that says the same as scales and offsets, exactly; None where none does."""
    scale = scales[0]
    if any(offsets) or any(value != scale for value in scales) or scale <= 0:
        return None
    factor = f"{1 / scale:.12g}"
    return factor if 1 / float(factor) == scale else None


def as_list(values: Sequence[object]) -> str:
    """A list as a header holds it."""
    return "{" + ", ".join(map(str, values)) + "}"


def as_text(text: str) -> str:
    """A text without the characters that would end a field or an entry of a list."""
    return re.sub(r"\s*[,{}=\n\r]\s*", " ", text).strip()
