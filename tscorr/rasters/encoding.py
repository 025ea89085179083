"""Blocks as the bytes of tiles: each is encoded where it was computed, so that threads share the work of a codec."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise, repeat
from typing import Any, NamedTuple

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from rasterio.io import MemoryFile
from zstandard import ZstdCompressor

from tscorr.rasters import tiff

Array = NDArray[Any]

Cut = tuple[Array, tuple[int, int], int]
"""of a tile the values (samples, rows, cols) that it is cut from, row and column of its first pixel there, and how
many bytes of it are stored"""
ANYWHERE = Affine.scale(2)
"""a file without a place is worth a warning to rasterio"""


class Tiles(NamedTuple):
    """Encoded tiles, one behind the other; offsets into `data` and sizes, in bytes, in the order of the layout."""

    data: memoryview
    offsets: Array
    sizes: Array

    def of(self, used: Array) -> "Tiles":
        """Some of the tiles: bool (tiles,)."""
        sizes = self.sizes[used]
        places = zip(self.offsets[used], sizes, strict=True)
        return Tiles.joined((self.data[start : start + size] for start, size in places), sizes)

    @classmethod
    def joined(cls, parts: Iterable[Any], sizes: Array) -> "Tiles":
        """Tiles of these bytes, each as long as `sizes` says."""
        return cls(memoryview(b"".join(parts)), np.cumsum(sizes) - sizes, sizes)


class Encoder:
    """Encodes blocks of whole tiles for one file.

    Tiles are cut out and predicted here, in one pass, and codecs are given bytes: ZSTD's own library, or GDAL, which
    given values would copy them four times before it encodes them.

    options : creation options of the file. layout : how it is cut. tiled : whether into tiles, not strips.
    """

    def __init__(self, options: Mapping[str, Any], layout: tiff.Layout, *, tiled: bool) -> None:
        self._codec = options.get("compress") or "none"
        self._levels = {key: options[key] for key in ("zlevel", "zstd_level") if key in options}
        self._put = PREDICTED[options.get("predictor", 1)]
        self._layout = layout
        self._tiled = tiled

    def __call__(self, values: Array) -> Tiles:
        """The tiles of a block (bands, rows, cols)."""
        cut = list(self._cut(values))
        if self._codec == "zstd":
            compressor = ZstdCompressor(level=self._levels["zstd_level"])
            again = repeat(self._empty(values, 1)[0])  # each is compressed while the processor has it at hand
            parts = [compressor.compress(tile) for tile in self._filled(cut, again)]
            return Tiles.joined(parts, np.array([len(part) for part in parts]))
        tiles = self._empty(values, len(cut))
        sizes = np.array([len(tile) for tile in self._filled(cut, tiles)])
        if self._codec == "none":
            return Tiles(tiff.octets(tiles), np.arange(len(tiles)) * tiles[0].nbytes, sizes)
        return self._by_gdal(tiles, sizes)

    def _by_gdal(self, tiles: Array, sizes: Array) -> Tiles:
        """Tiles (tiles, rows, cols, samples) as GDAL compresses the strips of a file of bytes, as wide as a tile."""
        row_bytes, parts, stored_sizes = tiles[0, 0].nbytes, [], []
        same = np.flatnonzero(np.diff(sizes, prepend=-1, append=-1))  # the last strip of a file is shorter
        for first, last in pairwise(same.tolist()):
            rows = int(sizes[first]) // row_bytes
            lines = np.ascontiguousarray(tiles[first:last, :rows]).view(np.uint8).reshape(1, -1, row_bytes)
            shape = {"count": 1, "height": lines.shape[1], "width": row_bytes, "blockysize": rows}
            with MemoryFile() as memory:
                with memory.open(
                    driver="GTiff", dtype="uint8", compress=self._codec, transform=ANYWHERE, **self._levels, **shape
                ) as dataset:
                    dataset.write(lines)
                content = memoryview(memory.getbuffer())
                read = tiff.bytes_of(content)
                places = tiff.directory(read)
                stored_sizes.append(places.sizes.of(read))
                stored = zip(places.offsets.of(read), stored_sizes[-1], strict=True)
                parts.append(b"".join(content[start : start + size] for start, size in stored))
        return Tiles.joined(parts, np.concatenate(stored_sizes))

    def _filled(self, cut: Iterable[Cut], tiles: Iterable[Array]) -> Iterator[memoryview]:
        """The bytes to compress of each tile of a block, which is put into the next of the given ones."""
        for (plane, (top, left), stored), tile in zip(cut, tiles, strict=False):
            if plane.shape[1] - top < tile.shape[0] or plane.shape[2] - left < tile.shape[1]:
                tile[:] = 0
            self._put(plane, top, left, tile)
            yield tiff.octets(tile)[:stored]

    def _empty(self, values: Array, count: int) -> Array:
        """Memory for so many tiles (tiles, rows, cols, samples) of a block."""
        rows, cols = self._layout.tile
        rows = rows if self._tiled else min(rows, values.shape[1])
        return np.empty((count, rows, cols, len(values) if self._layout.planes == 1 else 1), values.dtype)

    def _cut(self, values: Array) -> Iterator[Cut]:
        """The tiles of a block in the order of the file; the last strip of one has only the rows that there are."""
        tile_rows, tile_cols = self._layout.tile
        for plane in (values,) if self._layout.planes == 1 else values[:, np.newaxis]:
            for top in range(0, values.shape[1], tile_rows):
                rows = tile_rows if self._tiled else min(tile_rows, values.shape[1] - top)
                for left in range(0, values.shape[2], tile_cols):
                    yield plane, (top, left), rows * tile_cols * len(plane) * values.itemsize


def _put_values(values: Array, top: int, left: int, tile: Array) -> None:
    """The values (samples, rows, cols) from a pixel on in their places of a tile (rows, cols, samples)."""
    rows, cols, samples = tile.shape
    for sample in range(samples):
        part = values[sample, top : top + rows, left : left + cols]
        tile[: part.shape[0], : part.shape[1], sample] = part


def _put_differences(values: Array, top: int, left: int, tile: Array) -> None:
    """Predictor 2 of a tile (`set_differences`)."""
    from tscorr.rasters.compiled import set_differences

    unsigned = np.dtype(f"u{values.itemsize}")
    set_differences(np.ascontiguousarray(values).view(unsigned), top, left, tile.view(unsigned))


def _put_differences_of_bytes(values: Array, top: int, left: int, tile: Array) -> None:
    """Predictor 3: of each row the first bytes of all its numbers, then the second, ..., and differences of all.

    The first byte is the one with the sign. Source: TIFF Technical Note 3, "Floating point predictor".
    """
    _put_values(values, top, left, tile)
    rows, cols, samples = tile.shape
    octets = tile.astype(tile.dtype.newbyteorder(">")).view(np.uint8).reshape(rows, cols * samples, -1)
    sorted_octets = np.ascontiguousarray(octets.transpose(0, 2, 1)).reshape(rows, -1, samples)
    found = tile.view(np.uint8).reshape(sorted_octets.shape)
    found[:, 0] = sorted_octets[:, 0]
    np.subtract(sorted_octets[:, 1:], sorted_octets[:, :-1], out=found[:, 1:])


PREDICTED: dict[int, Callable[[Array, int, int, Array], None]] = {
    1: _put_values,
    2: _put_differences,
    3: _put_differences_of_bytes,
}
"""put values (samples, rows, cols) from a pixel on into a tile (rows, cols, samples), as what is compressed of it"""
