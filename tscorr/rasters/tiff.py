"""Where a TIFF keeps its tiles or strips: what lets whole ones be written, and moved, as bytes.

TIFF 6.0 and BigTIFF. All tags are GDAL's work; only what the two lists of places and sizes and a palette hold is
changed here.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tscorr.grid import Block

Array = NDArray[Any]
Read = Callable[[int, int], Any]
"""bytes of a file: from where, and how many; fewer where it ends before"""
Coded = tuple[str, dict[int, set[int]]]
"""order of the bytes as numpy writes it, and the numbers of each tag of CODING"""

OFFSETS, SIZES = (273, 324), (279, 325)
"""tags of strips and of tiles"""
BITS, CODEC, MEANING, FILL_ORDER, SAMPLES, PREDICTOR, TILE_COLS = 258, 259, 262, 266, 277, 317, 322
CODING = {
    BITS: "bits of a sample",
    CODEC: "codec",
    MEANING: "meaning of the samples",
    FILL_ORDER: "order of bits",
    SAMPLES: "samples of a pixel",
    278: "rows of a strip",
    284: "bands together or apart",
    PREDICTOR: "predictor",
    TILE_COLS: "columns of a tile",
    323: "rows of a tile",
    339: "kind of number",
}
"""tags that decide what values the bytes of a tile stand for"""
PALETTE = 320
MOST_SAMPLES = 1 << 16
MOST_NUMBERS = dict.fromkeys(CODING, MOST_SAMPLES) | {PALETTE: 3 << 16}
"""in the tags that do not have one for each tile"""
PLAIN = {0, 1, 2, 3}
"""meanings that change no value: grey, white to black, colours, a palette"""
MOST_ENTRIES = 4096
WORDS = {3: "u2", 4: "u4", 16: "u8"}
"""the types that these tags may have"""


class Words(NamedTuple):
    """A list of whole numbers in a file: where it starts, the type of its numbers, and how many."""

    start: int
    dtype: np.dtype[Any]
    length: int

    def of(self, read: Read) -> Array:
        """The numbers; ValueError where the file does not hold them."""
        try:
            octets = read(self.start, self.length * self.dtype.itemsize)
        except OverflowError as error:
            raise ValueError(f"no whole TIFF: {error}") from None
        return np.frombuffer(octets, self.dtype, self.length).astype(np.int64)


class Directory(NamedTuple):
    """Where the first image of a TIFF says where its tiles are, how long, and how they are coded."""

    offsets: Words
    sizes: Words
    coding: dict[int, Words]
    """the tags of CODING that it has"""
    palette: Words | None
    """red of all values, green of all, blue of all; 65535 is full light"""

    def coded(self, read: Read) -> Coded:
        """How bytes become values, equal for equal codings: their order, and the numbers of each tag of CODING.

        1 stands for a tag that is missing, as TIFF has it.
        """
        numbers = {tag: set(self.coding[tag].of(read).tolist()) if tag in self.coding else {1} for tag in CODING}
        return self.offsets.dtype.byteorder, numbers | ({MEANING: {1}} if numbers[MEANING] <= PLAIN else {})


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
        if self.whole_tiles(block) != block:
            raise ValueError(f"{block} does not consist of whole tiles of {self.tile}")
        rows, cols = self.tile
        down, across = self.tiles
        below, right = -(-(block.row + block.height) // rows), -(-(block.col + block.width) // cols)
        planes = np.arange(self.planes)[:, None, None] * (down * across)
        return planes + np.arange(block.row // rows, below)[:, None] * across + np.arange(block.col // cols, right)

    def whole_tiles(self, block: Block) -> Block:
        """The block of whole tiles that another one lies in, as far as the raster goes."""
        rows, cols = self.tile
        top, left = block.row // rows * rows, block.col // cols * cols
        bottom = min(-(-(block.row + block.height) // rows) * rows, self.shape[0])
        right = min(-(-(block.col + block.width) // cols) * cols, self.shape[1])
        return Block(top, left, bottom - top, right - left)

    def nonzero(self, shape: tuple[int, ...], values: Array) -> Array:
        """Which tiles (planes, rows, cols), of that shape, of a block (bands, rows, cols) hold anything but 0."""
        found = np.zeros(shape, np.bool_)
        tile_rows, tile_cols = self.tile
        for plane, i, j in np.ndindex(shape):
            window = np.s_[i * tile_rows : (i + 1) * tile_rows, j * tile_cols : (j + 1) * tile_cols]
            tile = values[plane, *window] if self.planes > 1 else values[:, *window]
            # Some rows mostly tell; and the largest and the least take a fraction of the time of tile.any().
            found[plane, i, j] = any(rows.max() != 0 or rows.min() != 0 for rows in (tile[..., ::16, :], tile))
        return found


def octets(values: Array) -> memoryview:
    """The bytes of a contiguous array."""
    return memoryview(values.view(np.uint8).reshape(-1)) if values.size else memoryview(b"")  # type: ignore[arg-type]


def bytes_of(content: Any) -> Read:
    """How to read a file that is in memory."""
    return lambda start, size: content[start : start + size]


def directory(read: Read, tiles: int | None = None) -> Directory:
    """The lists of the first image of a file; ValueError where it has none, or of another number of tiles."""
    try:
        found: dict[int, Words] = {}
        order, room, entries = _entries(read)
        for tag, kind, count, place in entries:
            if tag in (*OFFSETS, *SIZES, *MOST_NUMBERS) and tag not in found:  # the first counts
                dtype = np.dtype(WORDS[kind]).newbyteorder(order)
                sane = count <= MOST_NUMBERS[tag] if tag in MOST_NUMBERS else tiles in {None, count}
                if not sane:
                    raise ValueError(f"no whole TIFF: {count} numbers in tag {tag}")
                found[tag] = Words(_start(read, order, room, place, count * dtype.itemsize), dtype, count)
        strips_or_tiles = 0 if OFFSETS[0] in found else 1
        offsets, sizes = found.pop(OFFSETS[strips_or_tiles]), found.pop(SIZES[strips_or_tiles])
        palette = found.pop(PALETTE, None)
        return Directory(offsets, sizes, found, palette)
    except (KeyError, OverflowError, struct.error) as error:
        raise ValueError(f"no whole TIFF: {error}") from None


def text(read: Read, tag: int, most: int) -> str | None:
    """The text of a tag of the first image, no longer than that; None where it has none."""
    try:
        order, room, entries = _entries(read)
        for found, _, length, place in entries:
            if found == tag:
                octets = bytes(read(_start(read, order, room, place, length), min(length, most)))
                return octets.rstrip(b"\0 ").decode("latin-1")
    except (OverflowError, ValueError, struct.error):
        pass
    return None


def _entries(read: Read) -> tuple[Literal["<", ">"], int, Iterator[tuple[int, int, int, int]]]:
    """The directory of the first image: order of bytes, room for a value in an entry, and its entries.

    Of each the tag, the type, how many values, and where these stand if there is room, else where it says where.
    """
    order: Literal["<", ">"] = "<" if bytes(read(0, 2)) == b"II" else ">"
    (version,) = _numbers(read, 2, f"{order}H")
    if version not in {42, 43}:
        raise ValueError(f"no whole TIFF: of version {version}")
    big = version == 43
    (place,) = _numbers(read, 8 if big else 4, f"{order}Q" if big else f"{order}I")
    count_type, entry_type, room = ("Q", "HHQ", 8) if big else ("H", "HHI", 4)
    (entries,) = _numbers(read, place, order + count_type)
    if entries > MOST_ENTRIES:
        raise ValueError(f"no whole TIFF: {entries} entries in its directory")
    head = struct.calcsize(order + entry_type)
    first = place + struct.calcsize(order + count_type)
    places = (first + number * (head + room) for number in range(entries))
    return order, room, ((*_numbers(read, at, order + entry_type), at + head) for at in places)


def _start(read: Read, order: str, room: int, place: int, size: int) -> int:
    """Where so many bytes of an entry's values stand."""
    return place if size <= room else int(_numbers(read, place, order + ("Q" if room == 8 else "I"))[0])


def _numbers(read: Read, start: int, types: str) -> tuple[Any, ...]:
    return struct.unpack(types, read(start, struct.calcsize(types)))
