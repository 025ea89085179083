"""What no honest raster declares: refused from its header, before a pixel is read.

A header is cheap to forge, and GDAL believes it: a tile of 60000 x 60000 pixels in a file of 292 bytes costs 14 GB,
an ENVI file that is shorter than its header says reads as zeros, and an overview may be any file of the machine.
"""

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.enums import Interleaving, MaskFlags
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from tscorr.errors import InputError
from tscorr.grid import Grid
from tscorr.rasters import tiff

DRIVERS = ("GTiff", "ENVI", "HFA", "JP2OpenJPEG", "PNG", "JPEG", "AAIGrid", "EHdr")
"""formats that are opened; a VRT from an unknown hand may name any file of the machine"""
RESULTS = ("GTiff", "VRT", "ENVI")
"""formats that are written"""
NUMBERS = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float32", "float64")
GDAL_ERRORS = (RasterioError, CPLE_BaseError)
"""rasterio passes some errors of GDAL on as they are"""
LARGEST_TILE_BYTES = 256e6
MOST_PIXELS = 1e11
LONGEST_SIDE = 10_000_000
MOST_BANDS = 4096
MOST_PAGES = 100
"""images in one TIFF: overviews and masks; each overview is half of the one before"""
GDAL_NODATA = 42113
LONGEST_NODATA = 80
PARTS = {".ovr": "GTiff", ".msk": "GTiff", ".aux": "HFA"}
"""files beside a raster that hold pixels of it too, and their formats"""


def open_dataset(path: Path, *, ours: bool = False, **options: Any) -> Any:
    """A dataset of one of DRIVERS, tried one after the other so that no other driver sees the file.

    ours : a result of this program: one of RESULTS.
    Raises RasterioError with the reason of the driver that knew the format.
    """
    reasons = []
    for driver in RESULTS if ours else DRIVERS:
        try:
            return rasterio.open(path, driver=driver, sharing=False, **options)
        except GDAL_ERRORS as error:
            reasons.append(str(error.__cause__ or error))
    known = [reason for reason in reasons if "not recognized as being in a supported" not in reason]
    raise RasterioError(known[0] if known else f"it is in none of the formats {', '.join(DRIVERS)}")


def check_sound(dataset: Any, path: Path, draws_on: Sequence[Path] = ()) -> None:
    """Raise InputError where a header declares what no honest file has; names the file and what is allowed.

    draws_on : files that it may draw on beside those in its folder.
    """
    _check_bands(dataset, path)
    _check_nodata(dataset, path)
    _check_size(dataset, path)
    _check_place(dataset, path)
    _check_tile(dataset, str(path))
    _check_length(dataset, path)
    _check_parts(dataset, path, draws_on)


def _check_bands(dataset: Any, path: Path) -> None:
    dtypes = sorted(set(dataset.dtypes))
    if len(dtypes) != 1:
        raise InputError(f"{path} has bands of the types {dtypes}; allowed is one type")
    if dtypes[0] not in NUMBERS:
        raise InputError(f"{path} holds {dtypes[0]} values; allowed are {', '.join(NUMBERS)}")
    if dataset.count > MOST_BANDS:
        raise InputError(f"{path} has {dataset.count} bands; allowed are {MOST_BANDS}")


def _check_nodata(dataset: Any, path: Path) -> None:
    """GDAL takes a text for 0."""
    if dataset.nodata != 0:
        return
    text = _nodata_of_tiff(path) if dataset.driver == "GTiff" else dataset.tags(ns="ENVI").get("data_ignore_value")
    try:
        float(text or 0)
    except ValueError:
        raise InputError(f"{path} has the nodata value {text!r}; allowed is a number") from None


def _nodata_of_tiff(path: Path) -> str | None:
    """The text of the tag GDAL_NODATA, or None where it has none."""
    with path.open("rb", buffering=0) as file:
        return tiff.text(lambda start, size: os.pread(file.fileno(), size, start), GDAL_NODATA, LONGEST_NODATA)


def _check_size(dataset: Any, path: Path) -> None:
    rows, cols = dataset.shape
    if rows * cols > MOST_PIXELS:
        raise InputError(f"{path} has {rows} x {cols} pixels; allowed are {MOST_PIXELS:.0e} in all")
    if max(rows, cols) > LONGEST_SIDE:
        raise InputError(f"{path} has {rows} x {cols} pixels; allowed are {LONGEST_SIDE} a side")


def _check_place(dataset: Any, path: Path) -> None:
    """A transform maps pixels to places and back."""
    transform = dataset.transform
    with np.errstate(over="ignore", invalid="ignore"):
        corners = Grid(None, transform, dataset.shape).corners()
    if not np.isfinite(corners).all() or transform.determinant == 0:
        numbers = ", ".join(f"{number:g}" for number in transform[:6])
        raise InputError(f"{path} has the transform {numbers}; allowed are finite numbers that give pixels an area")


def _check_tile(dataset: Any, name: str) -> None:
    """What is read at once fits into memory."""
    for (rows, cols), dtype in zip(dataset.block_shapes, dataset.dtypes, strict=True):
        at_once = rows * cols * np.dtype(dtype).itemsize
        at_once *= dataset.count if dataset.interleaving == Interleaving.pixel else 1
        if at_once > LARGEST_TILE_BYTES:
            raise InputError(
                f"{name} is stored in tiles of {rows} x {cols} pixels, {at_once / 1e6:.0f} MB each; "
                f"allowed are {LARGEST_TILE_BYTES / 1e6:.0f} MB"
            )


def _check_length(dataset: Any, path: Path) -> None:
    """A file without compression is as long as its pixels: GDAL reads zeros where an ENVI file ends early."""
    rows, cols = dataset.shape
    if dataset.driver in {"ENVI", "EHdr"}:
        header = dataset.tags(ns="ENVI")
        if header.get("file_compression", "0").strip() != "0":
            return
        bits = int(dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", 8 * np.dtype(dataset.dtypes[0]).itemsize))
        offset = header.get("header_offset", "0").strip()
        needed = (int(offset) if offset.isdigit() else 0) + rows * (cols * dataset.count * bits // 8)
    elif dataset.driver == "AAIGrid":
        needed = 2 * rows * cols - 1  # a digit and a space
    else:
        return
    if (length := path.stat().st_size) < needed:
        raise InputError(
            f"{path} has {length} bytes; {rows} x {cols} pixels x {dataset.count} bands as in its header are {needed}"
        )


def _check_parts(dataset: Any, path: Path, draws_on: Sequence[Path]) -> None:
    """Overviews and masks, inside and beside the file, are held to the same rules."""
    elsewhere = dataset.tags(ns="OVERVIEWS").get("OVERVIEW_FILE")
    if elsewhere is not None:
        raise InputError(f"{path} has its overviews in {elsewhere}; allowed is {path.name}.ovr")
    beside = [Path(file) for file in dataset.files[1:]]
    allowed = {file.resolve() for file in draws_on}
    for file in beside:
        if file.parent != path.parent and file.resolve() not in allowed:
            raise InputError(f"{path} draws on {file}; allowed are files beside it")
    parts = [(file, PARTS[file.suffix.lower()]) for file in beside if file.suffix.lower() in PARTS]
    if dataset.driver == "GTiff" and (dataset.overviews(1) or MaskFlags.per_dataset in dataset.mask_flag_enums[0]):
        parts.append((path, "GTiff"))
    for file, driver in parts:
        for number, page in enumerate(_pages(file, driver), start=1):
            with closing(page):
                if number > MOST_PAGES:
                    raise InputError(f"{file} holds more than {MOST_PAGES} images; allowed are overviews and masks")
                _check_tile(page, f"image {number} of {file}")


def _pages(file: Path, driver: str) -> Iterator[Any]:
    """The images of a TIFF one after the other; the one image of another file."""
    for number in count(1):
        name = f"GTIFF_DIR:{number}:{file}" if driver == "GTiff" else file
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)  # overviews and masks have no place
                page = rasterio.open(name, driver=driver, sharing=False)
        except GDAL_ERRORS as error:
            if number == 1:
                raise InputError(
                    f"{file} cannot be read: {error.__cause__ or error}; allowed is a file of the format {driver}"
                ) from None
            return
        yield page
        if driver != "GTiff":
            return
