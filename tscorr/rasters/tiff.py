"""Where a TIFF keeps its tiles or strips: what lets whole ones be written, and moved, as bytes.

TIFF 6.0 and BigTIFF. All tags are GDAL's work; only the two lists of places and sizes are read and changed here.
"""

import struct
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.grid import Block

Array = NDArray[Any]

OFFSETS, SIZES = (273, 324), (279, 325)
"""tags of strips and of tiles"""
WORDS = {3: "u2", 4: "u4", 16: "u8"}
"""the types that these lists may have"""


class Words(NamedTuple):
    """A list of whole numbers in a file: where it starts, the type of its numbers, and how many."""

    start: int
    dtype: np.dtype[Any]
    length: int

    def of(self, content: Any) -> Array:
        """The numbers, from the bytes of the file."""
        return np.frombuffer(content, self.dtype, self.length, self.start).astype(np.int64)


class Directory(NamedTuple):
    """Where the first image of a TIFF says where its tiles are, and how long."""

    offsets: Words
    sizes: Words


@dataclass(frozen=True, slots=True)
class Layout:
    """How a raster is cut into tiles; strips are tiles as wide as the raster.

    shape, tile : (rows, cols). planes : 1 where a tile holds all bands, else the number of bands.
    """

    shape: tuple[int, int]
    tile: tuple[int, int]
    planes: int

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-self.shape[0] // self.tile[0]), -(-self.shape[1] // self.tile[1])

    def numbers(self, block: Block) -> Array:
        """Numbers of the tiles of a block in the order of the file, (planes, rows, cols) of tiles.

        Raises ValueError unless the block consists of whole tiles.
        """
        top, left = block.row // self.tile[0], block.col // self.tile[1]
        down, right = self.tiles
        bottom, last = -(-(block.row + block.height) // self.tile[0]), -(-(block.col + block.width) // self.tile[1])
        covered = (
            top * self.tile[0],
            left * self.tile[1],
            min(bottom * self.tile[0], self.shape[0]),
            min(last * self.tile[1], self.shape[1]),
        )
        if covered != (block.row, block.col, block.row + block.height, block.col + block.width):
            raise ValueError(f"{block} does not consist of whole tiles of {self.tile}")
        planes = np.arange(self.planes)[:, None, None] * (down * right)
        return planes + np.arange(top, bottom)[:, None] * right + np.arange(left, last)

    def nonzero(self, shape: tuple[int, ...], values: Array) -> Array:
        """Which tiles (planes, rows, cols), of that shape, of a block (bands, rows, cols) hold anything but 0."""
        _, down, right = shape
        rows, cols = (np.arange(count) * size for count, size in zip((down, right), self.tile, strict=True))
        by_row = np.logical_or.reduceat(values != 0, rows, axis=1)
        found = np.logical_or.reduceat(by_row, cols, axis=2)
        return found if self.planes > 1 else np.logical_or.reduce(found, axis=0, keepdims=True)


def octets(values: Array) -> memoryview:
    """The bytes of a contiguous array."""
    return memoryview(values.view(np.uint8).reshape(-1)) if values.size else memoryview(b"")  # type: ignore[arg-type]


def directory(content: Any) -> Directory:
    """The lists of the first image, from the bytes of a file or of its beginning; ValueError where it has none."""
    try:
        order: Literal["<", ">"] = "<" if content[:2] == b"II" else ">"
        big = struct.unpack_from(f"{order}H", content, 2)[0] == 43
        (place,) = struct.unpack_from(f"{order}Q" if big else f"{order}I", content, 8 if big else 4)
        count_type, entry_type, room = ("Q", "HHQ", 8) if big else ("H", "HHI", 4)
        (entries,) = struct.unpack_from(order + count_type, content, place)
        place += struct.calcsize(order + count_type)
        found = {}
        for _ in range(entries):
            tag, kind, count = struct.unpack_from(order + entry_type, content, place)
            place += struct.calcsize(order + entry_type)
            if tag in OFFSETS + SIZES:
                dtype = np.dtype(WORDS[kind]).newbyteorder(order)
                start = place
                if count * dtype.itemsize > room:
                    (start,) = struct.unpack_from(order + ("Q" if big else "I"), content, place)
                found["offsets" if tag in OFFSETS else "sizes"] = Words(start, dtype, count)
            place += room
        return Directory(**found)
    except (KeyError, TypeError, struct.error) as error:
        raise ValueError(f"no whole TIFF: {error}") from None
