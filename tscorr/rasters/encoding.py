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
        """Tiles that are predicted and compressed."""
        predicted = PREDICTORS[self._options.get("predictor", 1)]
        compressor = ZstdCompressor(level=self._options["zstd_level"])
        tiles, sizes = self._arranged(values)
        parts = [
            compressor.compress(tiff.octets(predicted(tile))[:size])
            for tile, size in zip(tiles, sizes.tolist(), strict=True)
        ]
        return Tiles.joined(parts, np.array([len(part) for part in parts]))

    def _arranged(self, values: Array) -> tuple[Array, Array]:
        """Tiles (tiles, rows, cols, samples) in the order of the file, and how many bytes of each are stored."""
        tile_rows, tile_cols = self._layout.tile
        rows, cols = self._padded(values)
        bands = values.shape[0]
        tile_rows, across = min(tile_rows, rows), cols // tile_cols
        down = -(-rows // tile_rows)
        by_pixel = self._layout.planes == 1
        shape = (
            (1, down, across, tile_rows, tile_cols, bands) if by_pixel else (bands, down, across, tile_rows, tile_cols)
        )
        whole = values.shape[1:] == (down * tile_rows, cols)
        tiles = (np.empty if whole else np.zeros)(shape, values.dtype)
        for band in range(bands):
            plane = tiles[0, ..., band] if by_pixel else tiles[band]
            for i in range(down):
                for j in range(across):
                    part = values[band, i * tile_rows : (i + 1) * tile_rows, j * tile_cols : (j + 1) * tile_cols]
                    plane[i, j, : part.shape[0], : part.shape[1]] = part
        tiles = tiles.reshape(-1, tile_rows, tile_cols, bands if by_pixel else 1)
        sizes = np.full(len(tiles), tiles[0].nbytes)
        if rows % tile_rows:  # strips: the last of a file has only the rows that there are
            sizes.reshape(-1, down)[:, -1] = tiles[0].nbytes // tile_rows * (rows % tile_rows)
        return tiles, sizes


def _differences(tile: Array) -> Array:
    """Predictor 2: each value less its left neighbour's of the same band, modulo the range of the type.

    Source: TIFF 6.0, section 14. Takes and gives (rows, cols, samples).
    """
    found = np.empty_like(tile)
    found[:, 0] = tile[:, 0]
    np.subtract(tile[:, 1:], tile[:, :-1], out=found[:, 1:])
    return found


def _differences_of_bytes(tile: Array) -> Array:
    """Predictor 3: of each row the first bytes of all its numbers, then the second, ..., and differences of all.

    The first byte is the one with the sign. Source: TIFF Technical Note 3, "Floating point predictor". Takes (rows,
    cols, samples) and gives as many bytes.
    """
    rows, cols, samples = tile.shape
    bytes_of = tile.astype(tile.dtype.newbyteorder(">")).view(np.uint8).reshape(rows, cols * samples, -1)
    return _differences(np.ascontiguousarray(bytes_of.transpose(0, 2, 1)).reshape(rows, -1, samples))


PREDICTORS: dict[int, Callable[[Array], Array]] = {1: np.asarray, 2: _differences, 3: _differences_of_bytes}
"""tiles (rows, cols, samples) as they are compressed"""
