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

NONE, ZSTD = 1, 50000
"""the codecs"""
LEAST_BYTES = 1 << 15
"""of a tile, below which GDAL is faster"""
LEAST_SHARE = 0.5
"""of the tiles that a block lies in, below which GDAL, which keeps tiles for the next block, is asked for it"""
UNKNOWN_SIZE = -1


class Decoder:
    """Decodes blocks of one GeoTIFF of tiles without compression or with ZSTD; any thread may ask.

    Raises ValueError where its tiles are stored in any other way, which is GDAL's matter then, and OSError where it
    cannot be read. Close it to close its file.
    """

    def __init__(self, info: RasterInfo) -> None:
        self._bands, self._dtype = info.bands, info.dtype
        self._samples = info.bands if info.profile["interleave"] == "pixel" else 1
        self._shape = *info.tile, self._samples
        self._bytes = int(np.prod(self._shape)) * info.dtype.itemsize
        if self._bytes < LEAST_BYTES:
            raise ValueError(f"the tiles of {info.path} are too small")
        self._tiles = StoredTiles(info, wanted=self._is_known)
        (codec,), (predictor,) = (self._tiles.coded[1][tag] for tag in (tiff.CODEC, tiff.PREDICTOR))
        self._is_compressed = codec == ZSTD
        self._fill = DECODED[predictor if self._is_compressed else 1]  # a predictor is a codec's

    def _is_known(self, coded: tiff.Coded) -> bool:
        """Whether tiles that are coded so are decoded here."""
        order, tags = coded
        predictors = {1, 2, 3} if self._dtype == np.float32 and self._samples == 1 else {1, 2}
        return (
            np.dtype(f"{order}u2").isnative
            and tags[tiff.CODEC] in ({NONE}, {ZSTD})
            and tags[tiff.PREDICTOR] in [{predictor} for predictor in predictors]
            and tags[tiff.BITS] == {8 * self._dtype.itemsize}
            and tags[tiff.SAMPLES] == {self._bands}
            and tags[tiff.FILL_ORDER] == tags[tiff.MEANING] == {1}
            and tags[tiff.TILE_COLS] == {self._shape[1]}
        )

    def __call__(self, block: Block, bands: int | Sequence[int] | None = None) -> Array | None:
        """Values (bands, rows, cols) of a block, or of one band (rows, cols), from 1 on.

        None where only some of them are asked for, but for one whose tiles hold no other, and where the file does not
        hold what it should: GDAL says what is wrong.
        """
        all_bands = bands is None or (not isinstance(bands, int) and [*bands] == [*range(1, self._bands + 1)])
        if not all_bands and not (isinstance(bands, int) and self._samples == 1):
            return None
        whole = self._tiles.layout.whole_tiles(block)
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
            self._fill_from(tile, values[first : first + self._samples], top, left)
        return values[0] if isinstance(bands, int) else values

    def _fill_from(self, tile: Array, values: Array, top: int, left: int) -> None:
        """Fill a block from a tile, which may begin above or left of it."""
        if top >= 0 and left >= 0:
            self._fill(values, top, left, tile)
            return
        decoded = np.empty((self._samples, *tile.shape[:2]), self._dtype)
        self._fill(decoded, 0, 0, tile)
        part = decoded[:, max(0, -top) : values.shape[1] - top, max(0, -left) : values.shape[2] - left]
        top, left = max(0, top), max(0, left)
        values[:, top : top + part.shape[1], left : left + part.shape[2]] = part

    def _content(self, number: int, decompressor: ZstdDecompressor) -> bytes | None:
        """The bytes of a tile before they were compressed, or None where they are not as many as it has."""
        try:
            content = self._tiles.content(number)
            if self._is_compressed:
                if frame_content_size(content) not in {UNKNOWN_SIZE, self._bytes}:
                    return None
                content = decompressor.decompress(content, max_output_size=self._bytes)
        except ZstdError:
            return None
        return content if len(content) == self._bytes else None

    def close(self) -> None:
        """Close the file."""
        self._tiles.close()


def is_worth_it(info: RasterInfo, block: Block) -> bool:
    """Whether a block is so large a part of the tiles that it lies in that these may be decoded for it alone."""
    whole = tiff.Layout(info.shape, info.tile, 1).whole_tiles(block)
    return block.height * block.width >= LEAST_SHARE * whole.height * whole.width


def _fill_values(values: Array, top: int, left: int, tile: Array) -> None:
    """Fill values (samples, rows, cols) from a pixel on from a tile (rows, cols, samples), as far as both reach."""
    for sample, plane in enumerate(values):
        part = plane[top : top + tile.shape[0], left : left + tile.shape[1]]
        part[:] = tile[: part.shape[0], : part.shape[1], sample]


def _fill_sums(values: Array, top: int, left: int, tile: Array) -> None:
    """The same of predictor 2 (`set_sums`)."""
    from tscorr.rasters.compiled import set_sums

    unsigned = np.dtype(f"u{values.itemsize}")
    set_sums(values.view(unsigned), top, left, tile.view(unsigned))


def _fill_sums_of_bytes(values: Array, top: int, left: int, tile: Array) -> None:
    """The same of predictor 3 (`set_sums_of_bytes`)."""
    from tscorr.rasters.compiled import set_sums_of_bytes

    octets = tile.view(np.uint8).reshape(len(tile), -1)
    set_sums_of_bytes(values[0].view(np.uint32), top, left, octets, np.empty(octets.shape[1], np.uint8))


DECODED: dict[int, Callable[[Array, int, int, Array], None]] = {1: _fill_values, 2: _fill_sums, 3: _fill_sums_of_bytes}
"""what fills values from a tile as it was compressed, by the predictor; `encoding.PREDICTED` undone"""
