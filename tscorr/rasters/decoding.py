"""The bytes of tiles as blocks of values: twin of `encoding`, without GDAL, which takes 1.3 to 2 times as long."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from tscorr.grid import Block
from tscorr.rasters import tiff
from tscorr.rasters.header import RasterInfo
from tscorr.rasters.stored_tiles import StoredTiles

Array = NDArray[Any]

CODEC, BITS, PREDICTOR, TILE_COLS, FILL_ORDER, SAMPLES = 259, 258, 317, 322, 266, 277
NONE, ZSTD = 1, 50000
LEAST_BYTES = 1 << 15
"""of a tile, below which GDAL is faster"""
UNKNOWN_SIZE = -1
LEAST_SHARE = 0.5
"""of the tiles that a block lies in, below which GDAL, which keeps tiles for the next block, is asked for it"""


class Decoder:
    """Decodes blocks of one GeoTIFF without compression or with ZSTD; any thread may ask.

    Raises ValueError where its tiles are stored in any other way: GDAL then does it.
    """

    def __init__(self, info: RasterInfo, tiles: StoredTiles) -> None:
        order, tags = tiles.coded
        planes = tiles.layout.planes
        self._samples = 1 if planes > 1 else info.bands
        self._shape = *info.tile, self._samples
        self._dtype = info.dtype
        self._bytes = int(np.prod(self._shape)) * info.dtype.itemsize
        self._tiles = tiles
        (codec,), (predictor,) = tags[CODEC], tags[PREDICTOR]
        known = (
            order in {"=", "<"}
            and codec in {NONE, ZSTD}
            and tags[BITS] == {8 * info.dtype.itemsize}
            and tags[SAMPLES] == {info.bands}
            and tags[FILL_ORDER] == tags[tiff.MEANING] == {1}
            and tags[TILE_COLS] == {info.tile[1]}
            and predictor in PREDICTED
            and (predictor != 3 or (info.dtype == np.float32 and self._samples == 1))
            and self._bytes >= LEAST_BYTES
        )
        if not known:
            raise ValueError(f"{info.path} is not of the kind that is decoded here")
        self._compressed = codec == ZSTD
        self._put = PREDICTED[predictor]

    def __call__(self, block: Block, bands: int | Sequence[int] | None = None) -> Array | None:
        """Values (bands, rows, cols) of a block, or of one band (rows, cols), from 1 on.

        None where it is a small part of the tiles that it lies in, where only some bands of a tile are asked for, and
        where the file does not hold what it should: GDAL says what is wrong.
        """
        whole = self._tiles.layout.whole_tiles(block)
        few = block.height * block.width < LEAST_SHARE * whole.height * whole.width
        if few or not (bands is None or (isinstance(bands, int) and self._samples == 1)):
            return None
        numbers = self._tiles.layout.numbers(whole)
        numbers = numbers[bands - 1 : bands] if isinstance(bands, int) else numbers
        values = np.empty((len(numbers) * self._samples, *block.shape), self._dtype)
        decompressor = ZstdDecompressor()
        for plane, i, j in np.ndindex(numbers.shape):
            content = self._content(int(numbers[plane, i, j]), decompressor)
            if content is None:
                return None
            tile = np.frombuffer(content, self._dtype).reshape(self._shape)
            first = plane * self._samples
            top, left = whole.row + i * len(tile) - block.row, whole.col + j * tile.shape[1] - block.col
            self._put_part(tile, values[first : first + self._samples], top, left)
        return values[0] if isinstance(bands, int) else values

    def _put_part(self, tile: Array, values: Array, top: int, left: int) -> None:
        """Put a tile into a block, above or left of which it may begin."""
        if top >= 0 and left >= 0:
            self._put(tile, values, top, left)
            return
        decoded = np.empty((self._samples, *tile.shape[:2]), self._dtype)
        self._put(tile, decoded, 0, 0)
        part = decoded[:, max(0, -top) : values.shape[1] - top, max(0, -left) : values.shape[2] - left]
        top, left = max(0, top), max(0, left)
        values[:, top : top + part.shape[1], left : left + part.shape[2]] = part

    def _content(self, number: int, decompressor: ZstdDecompressor) -> bytes | None:
        """The bytes of a tile before they were compressed, or None where they are not as many as it has."""
        try:
            content = self._tiles.content(number)
            if self._compressed:
                if frame_content_size(content) not in {UNKNOWN_SIZE, self._bytes}:
                    return None
                content = decompressor.decompress(content, max_output_size=self._bytes)
        except (OSError, ZstdError):
            return None
        return content if len(content) == self._bytes else None


def tiles_of(info: RasterInfo, decode: Callable[[Block], Array]) -> tuple[StoredTiles | None, Decoder | None]:
    """The tiles of a raster, and what decodes them here: None where it is no TIFF, or of another kind.

    decode : as in `StoredTiles`.
    """
    try:
        tiles = StoredTiles(info, decode)
    except (OSError, ValueError):
        return None, None
    try:
        return tiles, Decoder(info, tiles)
    except ValueError:
        return tiles, None


def _put_values(tile: Array, values: Array, top: int, left: int) -> None:
    """The values of a tile (rows, cols, samples) in their places of a block (samples, rows, cols), from a pixel on."""
    for sample, plane in enumerate(values):
        part = plane[top : top + tile.shape[0], left : left + tile.shape[1]]
        part[:] = tile[: part.shape[0], : part.shape[1], sample]


def _put_sums(tile: Array, values: Array, top: int, left: int) -> None:
    """The same from predictor 2 (`set_sums`)."""
    from tscorr.rasters.compiled import set_sums

    unsigned = np.dtype(f"u{values.itemsize}")
    set_sums(tile.view(unsigned), values.view(unsigned), top, left)


def _put_sums_of_bytes(tile: Array, values: Array, top: int, left: int) -> None:
    """The same from predictor 3 (`set_sums_of_bytes`)."""
    from tscorr.rasters.compiled import set_sums_of_bytes

    octets = tile.view(np.uint8).reshape(len(tile), -1)
    set_sums_of_bytes(octets, np.empty(octets.shape[1], np.uint8), values[0].view(np.uint32), top, left)


PREDICTED: dict[int, Callable[[Array, Array, int, int], None]] = {1: _put_values, 2: _put_sums, 3: _put_sums_of_bytes}
"""put a tile as it was compressed into a block of values, from a pixel on"""
