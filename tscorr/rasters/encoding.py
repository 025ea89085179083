"""Blocks as the bytes of tiles: each is encoded where it was computed, so that threads share the work of a codec."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.io import MemoryFile
from zstandard import ZstdCompressor

from tscorr.rasters import tiff

Array = NDArray[Any]

SHARED = ("driver", "count", "dtype", "interleave", "compress", "predictor", "zstd_level", "zlevel")
"""creation options that decide what the bytes of a tile are"""


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

    ZSTD without GDAL, which takes 1.6 times as long for a block, since it copies it four times.

    options : creation options of the file. layout : how it is cut. tiled : whether into tiles, not strips.
    """

    def __init__(self, options: dict[str, Any], layout: tiff.Layout, *, tiled: bool) -> None:
        self._options = {key: options[key] for key in SHARED if key in options}
        self._layout = layout
        self._tiled = tiled
        self._codec = options.get("compress") or "none"

    @contextmanager
    def __call__(self, values: Array) -> Iterator[Tiles]:
        """The tiles of a block (bands, rows, cols); they last as long as the context."""
        if self._codec == "none":
            tiles, sizes = self._arranged(values)
            yield Tiles(tiff.octets(tiles), np.arange(len(tiles)) * tiles[0].nbytes, sizes)
            return
        if self._codec == "zstd":
            yield self._zstd(values)
            return
        rows, cols = self._padded(values)
        cut: dict[str, Any] = {"tiled": False, "blockysize": min(self._layout.tile[0], rows)}
        if self._tiled:
            cut = {"tiled": True, "blockysize": self._layout.tile[0], "blockxsize": self._layout.tile[1]}
        with MemoryFile() as memory:
            anywhere = Affine.scale(2)  # a file without a place is worth a warning to rasterio
            with memory.open(**self._options, **cut, height=rows, width=cols, transform=anywhere) as dataset:
                dataset.write(values, window=rasterio.windows.Window(0, 0, values.shape[2], values.shape[1]))
            content = memoryview(memory.getbuffer())
            read = tiff.bytes_of(content)
            places = tiff.directory(read)
            offsets, sizes = places.offsets.of(read), places.sizes.of(read)
            first, last = int(offsets.min()), int((offsets + sizes).max())
            yield Tiles(content[first:last], offsets - first, sizes)

    def _padded(self, values: Array) -> tuple[int, int]:
        """Rows and columns of the whole tiles that a block fills; the last strip of a file is never padded."""
        rows, cols = values.shape[1:]
        if not self._tiled:
            return rows, cols
        tile_rows, tile_cols = self._layout.tile
        return -(-rows // tile_rows) * tile_rows, -(-cols // tile_cols) * tile_cols

    def _zstd(self, values: Array) -> Tiles:
        """Tiles that are predicted and compressed, each at once, as long as the processor has it at hand."""
        put = PREDICTED[self._options.get("predictor", 1)]
        compressor = ZstdCompressor(level=self._options["zstd_level"])
        tile, parts = self._empty(values, 1)[0], []
        for plane, (top, left), stored in self._cut(values):
            if plane.shape[1] - top < tile.shape[0] or plane.shape[2] - left < tile.shape[1]:
                tile[:] = 0
            parts.append(compressor.compress(tiff.octets(put(plane, top, left, tile))[:stored]))
        return Tiles.joined(parts, np.array([len(part) for part in parts]))

    def _arranged(self, values: Array) -> tuple[Array, Array]:
        """Tiles (tiles, rows, cols, samples) in the order of the file, and how many bytes of each are stored."""
        cut = list(self._cut(values))
        tiles = self._empty(values, len(cut))
        for tile, (plane, (top, left), _) in zip(tiles, cut, strict=True):
            _lay(plane, top, left, tile)
        return tiles, np.array([stored for *_, stored in cut])

    def _empty(self, values: Array, count: int) -> Array:
        """Tiles (tiles, rows, cols, samples) for a block; zeros where it does not fill all of them."""
        rows, cols = self._padded(values)
        shape = min(self._layout.tile[0], rows), self._layout.tile[1], len(values) if self._layout.planes == 1 else 1
        return (np.empty if values.shape[1:] == (rows, cols) else np.zeros)((count, *shape), values.dtype)

    def _cut(self, values: Array) -> Iterator[tuple[Array, tuple[int, int], int]]:
        """The tiles of a block in the order of the file.

        Of each the values (samples, rows, cols) that it is cut from, row and column of its first pixel there, and how
        many bytes of it are stored: of strips the last of a file has only the rows that there are.
        """
        tile_rows, tile_cols = self._layout.tile
        for plane in (values,) if self._layout.planes == 1 else values[:, np.newaxis]:
            for top in range(0, values.shape[1], tile_rows):
                rows = tile_rows if self._tiled else min(tile_rows, values.shape[1] - top)
                for left in range(0, values.shape[2], tile_cols):
                    yield plane, (top, left), rows * tile_cols * len(plane) * values.itemsize


def _lay(values: Array, top: int, left: int, tile: Array) -> Array:
    """The values (samples, rows, cols) from a pixel on in their places of a tile (rows, cols, samples)."""
    rows, cols, samples = tile.shape
    for sample in range(samples):
        part = values[sample, top : top + rows, left : left + cols]
        tile[: part.shape[0], : part.shape[1], sample] = part
    return tile


def _put_differences(values: Array, top: int, left: int, tile: Array) -> Array:
    """Predictor 2 of a tile (`set_differences`)."""
    from tscorr.rasters.compiled import set_differences

    unsigned = np.dtype(f"u{values.itemsize}")
    set_differences(np.ascontiguousarray(values).view(unsigned), top, left, tile.view(unsigned))
    return tile


def _put_differences_of_bytes(values: Array, top: int, left: int, tile: Array) -> Array:
    """Predictor 3: of each row the first bytes of all its numbers, then the second, ..., and differences of all.

    The first byte is the one with the sign. Source: TIFF Technical Note 3, "Floating point predictor".
    """
    rows, cols, samples = _lay(values, top, left, tile).shape
    octets = tile.astype(tile.dtype.newbyteorder(">")).view(np.uint8).reshape(rows, cols * samples, -1)
    sorted_octets = np.ascontiguousarray(octets.transpose(0, 2, 1)).reshape(rows, -1, samples)
    found = np.empty_like(sorted_octets)
    found[:, 0] = sorted_octets[:, 0]
    np.subtract(sorted_octets[:, 1:], sorted_octets[:, :-1], out=found[:, 1:])
    return found


PREDICTED: dict[int, Callable[[Array, int, int, Array], Array]] = {
    1: _lay,
    2: _put_differences,
    3: _put_differences_of_bytes,
}
"""values (samples, rows, cols) from a pixel on, as what is compressed of a tile (rows, cols, samples)"""
