"""ENVI files written block by block, and read again before they count as written."""

import os
import threading
from collections.abc import Callable, Iterator
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError

from tscorr.errors import InputError, OutputError
from tscorr.grid import Block
from tscorr.rasters import envi
from tscorr.rasters.header import ENVIRONMENT, RasterInfo, describe
from tscorr.rasters.reading import Reader
from tscorr.rasters.writing import Layer, Stretch, checksum, read_at, unwatched, write_at

Array = NDArray[Any]

ENVI_SUFFIX = ".dat"
AXES = {"bsq": (0, 1, 2), "bil": (1, 0, 2), "bip": (1, 2, 0)}
"""order of (bands, rows, cols) in the file"""


class EnviWriter:
    """One ENVI raster being written, in the order of the image's pixels; any thread may write, each pixel once.

    GDAL writes the header; pixels are put in their places by calls of the operating system that raise where a disk is
    full. `close` reads every block again and compares it with what was written.
    """

    def __init__(self, path: Path, like: RasterInfo, layer: Layer) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._written: dict[Block, int] = {}
        interleave = _interleave(like, len(layer.names))
        rows, cols = like.shape
        options = {
            "driver": "ENVI",
            "interleave": interleave,
            "height": rows,
            "width": cols,
            "count": len(layer.names),
            "dtype": layer.dtype,
            "crs": like.grid.crs,
            "transform": like.grid.transform,
            "nodata": layer.nodata,
        }
        try:  # what a header cannot hold shall not go to a file beside it
            with rasterio.Env(**ENVIRONMENT, GDAL_PAM_ENABLED="NO"), rasterio.open(path, "w", **options) as dataset:
                _describe(dataset, layer, like)
            header = path.with_suffix(".hdr")  # GDAL puts the path into it, which is that of a hidden folder
            header.write_bytes(header.read_bytes().replace(bytes(path), path.name.encode()))
            self._file = os.open(path, os.O_RDWR)
        except (RasterioError, OSError) as error:
            raise OutputError(f"{path} cannot be written: {error}") from None
        self._dtype = np.dtype(layer.dtype).newbyteorder("<")
        self._axes = AXES[interleave]
        self._shape = self._in_order((len(layer.names), rows, cols))

    def write(self, block: Block, values: Array) -> None:
        """Write a block (bands, rows, cols)."""
        ordered = np.ascontiguousarray(np.transpose(values, self._axes), dtype=self._dtype)
        octets = ordered.reshape(-1).view(np.uint8).data
        done = 0
        try:
            for stretch in self._stretches(block):
                write_at(self._file, octets[done : done + stretch.size], stretch.start)
                done += stretch.size
        except OSError as error:
            raise OutputError(f"{self.path} cannot be written: {error}") from None
        with self._lock:
            self._written[block] = checksum(octets)

    def abandon(self) -> None:
        """Close without a check; what was written will be deleted."""
        os.close(self._file)

    def close(self, final: Callable[[Path], None] = unwatched) -> RasterInfo:
        """Close; what the header says. Raises OutputError unless every block reads back as it was written.

        final : called once the file does not change any more, before it is read.
        """
        final(self.path)
        try:
            whole = all(checksum(self._read(block)) == expected for block, expected in self._written.items())
        finally:
            os.close(self._file)
        info = self._read_again() if whole else None
        if info is None:
            raise OutputError(f"{self.path} does not read back as written; is the disk full?")
        return info

    def _read(self, block: Block) -> bytes:
        return b"".join(read_at(self._file, stretch) for stretch in self._stretches(block))

    def _read_again(self) -> RasterInfo | None:
        """The header, which is whole too if a block comes out of the file as it went in; None where it does not."""
        block, expected = next(iter(self._written.items()))
        try:
            info = describe(self.path, ours=True)
            with Reader(info) as reader:
                ordered = np.ascontiguousarray(np.transpose(reader.read(block), self._axes), dtype=self._dtype)
        except InputError:
            return None
        return info if checksum(ordered.reshape(-1).view(np.uint8)) == expected else None

    def _in_order(self, of_bands_rows_cols: tuple[Any, Any, Any]) -> tuple[Any, ...]:
        return tuple(of_bands_rows_cols[axis] for axis in self._axes)

    def _stretches(self, block: Block) -> Iterator[Stretch]:
        """Where the bytes of a block stand in the file, in their order, as few stretches as there are."""
        first = self._in_order((0, block.row, block.col))
        counts = self._in_order((self._shape[self._axes.index(0)], block.height, block.width))
        strides = [self._dtype.itemsize * prod(self._shape[axis + 1 :]) for axis in range(3)]
        cut = [axis for axis in range(3) if counts[axis] < self._shape[axis]]
        inner = cut[-1] if cut else 0  # from this axis on the bytes stand together
        size = counts[inner] * strides[inner]
        start = sum(place * stride for place, stride in zip(first, strides, strict=True))
        for place in np.ndindex(*counts[:inner]):
            yield Stretch(start + sum(i * stride for i, stride in zip(place, strides, strict=False)), size, 0)


def _interleave(like: RasterInfo, bands: int) -> str:
    """ENVI's name of the order in which the pixels of an image stand."""
    own = like.envi.get("interleave", "bip" if like.profile.get("interleave") == "pixel" else "bsq")
    return own.strip().lower() if bands > 1 else "bsq"


def _describe(dataset: Any, layer: Layer, like: RasterInfo) -> None:
    """Give a new ENVI file the names, tags, scales and units of its layer."""
    fields = {}
    if layer.of_image:
        fields = envi.new_fields(like.envi, like.wavelengths_um, like.fwhm_um, like.bad_bands)
    if layer.scales is not None and layer.offsets is not None:
        if (factor := envi.scale_factor(layer.scales, layer.offsets)) is not None:
            fields["reflectance_scale_factor"] = factor
        else:
            dataset.scales, dataset.offsets = layer.scales, layer.offsets
    if layer.units is not None:
        fields["units"] = layer.units[0]
    fields |= {key.lower(): envi.as_text(text) for key, text in layer.tags.items()}
    dataset.update_tags(ns="ENVI", **fields)
    for index, name in enumerate(layer.names, start=1):
        dataset.set_band_description(index, envi.as_text(name))
