"""Tiles of a GeoTIFF as they are stored: those that nothing is removed from are copied without being decoded."""

import math
import os
from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tscorr.errors import InputError
from tscorr.grid import Block
from tscorr.rasters import tiff
from tscorr.rasters.encoding import Tiles
from tscorr.rasters.header import RasterInfo

Array = NDArray[Any]

LARGEST = 1.5
"""bytes of an encoded tile, at most, for one of its values' bytes: more is no codec's work"""


class StoredTiles:
    """The encoded tiles of an image; any thread may ask.

    info : of the image. decode : its values (bands, rows, cols) in a block, for who copies tiles. wanted : told how
           they are coded, whether to go on; the places and sizes of all tiles are read then.
    Raises ValueError where its tiles cannot be found or are not wanted, and OSError where it cannot be read.
    """

    def __init__(
        self,
        info: RasterInfo,
        decode: Callable[[Block], Array] | None = None,
        wanted: Callable[[tiff.Coded], bool] = lambda _: True,
    ) -> None:
        if info.driver != "GTiff":
            raise ValueError(f"{info.path} is no TIFF")
        self.decode = decode
        self._info = info
        by_pixel = info.profile["interleave"] == "pixel"
        self.layout = tiff.Layout(info.shape, info.tile, 1 if by_pixel else info.bands)
        values = info.tile[0] * info.tile[1] * (info.bands if by_pixel else 1)
        self._largest = LARGEST * values * info.dtype.itemsize + 1024
        self._file = info.path.open("rb", buffering=0)
        try:
            places = tiff.directory(self._read, self.layout.planes * math.prod(self.layout.tiles))
            self.coded = places.coded(self._read)
            """as of `tiff.Directory`"""
            is_wanted = wanted(self.coded)
            if is_wanted:
                self._offsets, self._sizes = places.offsets.of(self._read), places.sizes.of(self._read)
        except BaseException:
            self.close()
            raise
        if not is_wanted:
            self.close()
            raise ValueError(f"the tiles of {info.path} are coded in another way")

    def holds(self, block: Block) -> bool:
        """Whether all tiles of a block are stored, which those of a sparse file are not, and of a size that can be."""
        sizes = self._sizes[self.layout.numbers(block)]
        return bool(np.all((sizes > 0) & (sizes <= self._largest)))

    def tiles(self, block: Block) -> Tiles:
        """The tiles of a block; InputError where the file ends before."""
        numbers = self.layout.numbers(block).ravel()
        tiles = Tiles.joined(map(self.content, numbers.tolist()), self._sizes[numbers])
        if len(tiles.data) != tiles.sizes.sum():
            raise InputError(f"{self._info.path} cannot be read: it ends within a tile of {block}")
        return tiles

    def content(self, number: int) -> bytes:
        """The bytes of one tile; none where it is not there as a whole, or larger than a tile can be."""
        start, size = int(self._offsets[number]), int(self._sizes[number])
        try:
            content = self._read(start, size) if 0 < size <= self._largest else b""
        except OSError:  # at a place that no file has
            return b""
        return content if len(content) == size else b""

    def _read(self, start: int, size: int) -> bytes:
        return os.pread(self._file.fileno(), size, start)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
