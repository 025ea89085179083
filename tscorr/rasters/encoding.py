"""Blocks as the bytes of tiles: each is encoded where it was computed, so that threads share the work of a codec."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.io import MemoryFile

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

    options : creation options of the file. layout : how it is cut. tiled : whether into tiles, not strips.
    """

    def __init__(self, options: dict[str, Any], layout: tiff.Layout, *, tiled: bool) -> None:
        self._options = {key: options[key] for key in SHARED if key in options}
        self._layout = layout
        self._tiled = tiled
        self._plain = options.get("compress") in {None, "none"}

    @contextmanager
    def __call__(self, values: Array) -> Iterator[Tiles]:
        """The tiles of a block (bands, rows, cols); they last as long as the context."""
        if self._plain:
            yield self._copied(values)
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

    def _copied(self, values: Array) -> Tiles:
        """Tiles without a codec."""
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
        size = tile_rows * tile_cols * tiles.itemsize * (bands if by_pixel else 1)
        sizes = np.full(tiles.size * tiles.itemsize // size, size)
        if rows % tile_rows:  # strips: the last of a file has only the rows that there are
            sizes.reshape(-1, down)[:, -1] = size // tile_rows * (rows % tile_rows)
        return Tiles(tiff.octets(tiles), np.arange(sizes.size) * size, sizes)
