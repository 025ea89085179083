"""Rasters written block by block, and read again before they count as written."""

import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Interleaving, Resampling
from rasterio.errors import RasterioError
from rasterio.shutil import copy as copy_raster

from tscorr.errors import OutputError
from tscorr.grid import Block
from tscorr.rasters import tiff
from tscorr.rasters.encoding import Encoder, Tiles
from tscorr.rasters.header import ENVIRONMENT, RasterInfo, environment, info_of, tile_side
from tscorr.rasters.sound import open_dataset
from tscorr.rasters.stored_tiles import StoredTiles

Array = NDArray[Any]

COG_TILE = 512
ZSTD_LEVEL = 1
"""of what is written once and read often GDAL would have 9, which takes seven times as long for a few per cent"""


def unwatched(path: Path) -> None:
    """Nobody waits for a file."""
    del path


class Writer:
    """One raster being written; any thread may write, each tile once.

    Each thread encodes its own tiles and puts them behind those that are there, by calls of the operating system that
    raise where a disk is full; GDAL, whose writing threads would hide that, writes the header only. `close` reads
    every byte of the tiles again and compares it with what was written.
    """

    def __init__(self, path: Path, profile: dict[str, Any], like: RasterInfo, layer: "Layer") -> None:
        self.path = path
        self._sparse = layer.sparse
        self._lock = threading.Lock()
        self._written: list[Stretch] = []
        self._sample: tuple[Block, int] | None = None
        rows, cols = like.shape
        options = _fitting_predictor(
            {
                **profile,
                "driver": "GTiff",
                "height": rows,
                "width": cols,
                "count": len(layer.names),
                "dtype": layer.dtype,
                "crs": like.grid.crs,
                "transform": like.grid.transform,
                "nodata": layer.nodata,
                "bigtiff": "if_safer",
                "sparse_ok": True,
                **({} if layer.palette is None else {"photometric": "palette"}),
            },
            layer,
        )
        try:
            with environment(), rasterio.open(path, "w", **options) as dataset:
                _describe(dataset, layer, like)
                planes = dataset.count if dataset.interleaving == Interleaving.band else 1
                self._layout = tiff.Layout(dataset.shape, dataset.block_shapes[0], planes)
            header = tiff.bytes_of(path.read_bytes())
            self._places = tiff.directory(header)
            self._coded = self._places.coded(header)
            self._file = os.open(path, os.O_RDWR)
            if layer.palette is not None:
                self._colour(layer.palette)
        except (RasterioError, OSError, ValueError) as error:
            raise OutputError(f"{path} cannot be written: {error}") from None
        self._end = path.stat().st_size
        self._offsets, self._sizes = self._places.offsets.of(header), self._places.sizes.of(header)
        self._encoder = Encoder(options, self._layout, tiled=bool(options.get("tiled")))

    def _colour(self, palette: Array) -> None:
        """Write the palette in place of the greys that GDAL wrote: value by value it takes 30 ms to take one."""
        words = self._places.palette
        assert words is not None
        light = 257 * palette.T.astype(words.dtype)  # 255 is 65535
        write_at(self._file, tiff.octets(np.ascontiguousarray(light)), words.start)

    def write(self, block: Block, values: Array) -> None:
        """Write a block of whole tiles (bands, rows, cols)."""
        numbers = self._layout.numbers(block)
        used = self._layout.nonzero(numbers.shape, values).ravel() if self._sparse else np.ones(numbers.size, np.bool_)
        if not used.any():
            return
        try:
            encoded = self._encoder(values)
        except RasterioError as error:
            raise OutputError(f"{self.path} cannot be written: {error}") from None
        self._put(numbers.ravel()[used], encoded if used.all() else encoded.of(used))
        with self._lock:
            if self._sample is None:
                tile = self._first_tile(block)
                self._sample = tile, checksum(np.ascontiguousarray(values[:, : tile.height, : tile.width]).data)

    def copies(self, tiles: StoredTiles) -> bool:
        """Whether `copy` may take the tiles of that file: here, too, their bytes hold their values."""
        return tiles.coded == self._coded

    def copy(self, block: Block, stored: StoredTiles, source: Block) -> None:
        """Write the tiles of a block of an image, `source`, as those of a block of this file."""
        self._put(self._layout.numbers(block).ravel(), stored.tiles(source))
        if self._sample is None:
            assert stored.decode is not None
            sample = self._first_tile(block), checksum(stored.decode(self._first_tile(source)).data)
            with self._lock:
                self._sample = self._sample or sample

    def _first_tile(self, block: Block) -> Block:
        rows, cols = self._layout.tile
        return Block(block.row, block.col, min(rows, block.height), min(cols, block.width))

    def _put(self, numbers: Array, tiles: Tiles) -> None:
        """Write encoded tiles of these numbers behind those that are there."""
        with self._lock:
            start, self._end = self._end, self._end + len(tiles.data)
        try:
            write_at(self._file, tiles.data, start)
        except OSError as error:
            raise OutputError(f"{self.path} cannot be written: {error}") from None
        written = Stretch(start, len(tiles.data), checksum(tiles.data))
        with self._lock:
            self._written.append(written)
            self._offsets[numbers], self._sizes[numbers] = start + tiles.offsets, tiles.sizes

    def abandon(self) -> None:
        """Close without a check; what was written will be deleted."""
        os.close(self._file)

    def close(self, final: Callable[[Path], None] = unwatched) -> RasterInfo:
        """Close; what the header says. Raises OutputError unless every block reads back as it was written.

        final : called once the file does not change any more, before it is read.
        """
        try:
            for words, numbers in ((self._places.offsets, self._offsets), (self._places.sizes, self._sizes)):
                write_at(self._file, tiff.octets(numbers.astype(words.dtype)), words.start)
            final(self.path)
            whole = (self._sparse or bool(self._sizes.all())) and all(
                checksum(read_at(self._file, stretch)) == stretch.checksum for stretch in self._written
            )
        except OSError as error:
            raise OutputError(f"{self.path} does not read back as written: {error}; is the disk full?") from None
        finally:
            os.close(self._file)
        info = self._read_by_gdal() if whole else None
        if info is None:
            raise OutputError(f"{self.path} does not read back as written; is the disk full?")
        return info

    def _read_by_gdal(self) -> RasterInfo | None:
        """The header, which is whole too if a tile comes out of the file as it went in; None where it does not."""
        if self._sample is None and not self._sparse:
            return None
        zeros = np.zeros(0, np.uint8)
        block, expected = self._sample or (Block(0, 0, 0, 0), checksum(zeros))
        try:
            with environment(), open_dataset(self.path, ours=True) as dataset:
                as_written = checksum(dataset.read(window=block.window).data) == expected
                return info_of(dataset, self.path, ours=True) if as_written else None
        except RasterioError:
            return None


class Stretch(NamedTuple):
    """Bytes that were written in one go: where, how many, and their checksum."""

    start: int
    size: int
    checksum: int


def checksum(data: Any) -> int:
    """Sum of the 64-bit words of a contiguous buffer and of the bytes behind them.

    At the speed of the memory; what a disk loses shows in it, what someone wants to hide does not.
    """
    octets = np.frombuffer(data, np.uint8)
    words = octets.size // 8 * 8
    return int(octets[:words].view(np.uint64).sum()) + int(octets[words:].sum())


def write_at(file: int, data: memoryview, start: int) -> None:
    """Write all of a buffer at a place of a file; OSError where it does not fit the disk."""
    done = 0
    while done < len(data):
        done += os.pwrite(file, data[done:], start + done)


def read_at(file: int, stretch: Stretch) -> bytes:
    """The bytes of a stretch, fewer where the file ends before."""
    return os.pread(file, stretch.size, stretch.start)


def _describe(dataset: Any, layer: "Layer", like: RasterInfo) -> None:
    """Give a new raster the names, tags, colours, scales and units of its layer."""
    dataset.update_tags(**{**(like.tags if layer.of_image else {}), **layer.tags})
    for index, name in enumerate(layer.names, start=1):
        dataset.set_band_description(index, name)
        if layer.of_image:
            for domain, tags in like.band_tags[index - 1].items():
                if domain:
                    dataset.update_tags(index, ns=domain, **tags)
                else:
                    dataset.update_tags(index, **tags)
    if layer.of_image and like.colors and ColorInterp.palette not in like.colors:
        dataset.colorinterp = like.colors  # else GDAL takes the fourth of four bytes for transparency
    if layer.scales is not None:
        dataset.scales, dataset.offsets = layer.scales, layer.offsets
    if layer.units is not None:
        dataset.units = layer.units


@dataclass(frozen=True, slots=True)
class Layer:
    """What a raster to be written holds; tuples have one value a band."""

    names: tuple[str, ...]
    dtype: str
    nodata: float | None = None
    scales: tuple[float, ...] | None = None
    offsets: tuple[float, ...] | None = None
    units: tuple[str, ...] | None = None
    of_image: bool = False
    """the bands are those of the image: their tags are copied"""
    sparse: bool = False
    """blocks need not be written where all is 0, and tiles of zeros are not stored"""
    tags: Mapping[str, str] = field(default_factory=dict)
    bits: bool = False
    """each bit is a matter of its own, so that the difference of two values means nothing"""
    palette: Array | None = None
    """red, green, blue of each value that the type can hold: uint8 (values, 3)"""


def _fitting_predictor(options: dict[str, Any], layer: Layer) -> dict[str, Any]:
    """Creation options that suit the type: predictor 3 is for floating point, 2 for integers, none for bits.

    Nor for integers that are mostly 0: the others need no more bytes by themselves than as differences, and no work.
    """
    options = dict(options)
    compressed = options.get("compress") in {"deflate", "lzw", "zstd"}
    integers = np.dtype(layer.dtype).kind in "iu"
    if not compressed or layer.bits or (layer.sparse and integers) or options.get("predictor", 1) == 1:
        options.pop("predictor", None)
    else:
        options["predictor"] = 2 if integers else 3
    if options.get("compress") == "zstd":
        options["zstd_level"] = ZSTD_LEVEL
    return options


def make_cog(path: Path, *, bits: bool) -> None:
    """Turn a GeoTIFF into a cloud-optimised one, with overviews of half, a quarter, ... down to one tile.

    bits : as in `Layer`; then an overview has the nearest values, else their means.
    """
    hidden = path.with_name(f".{path.name}.cog")
    try:
        with rasterio.Env(**ENVIRONMENT, ZSTD_LEVEL_OVERVIEW=ZSTD_LEVEL):
            with rasterio.open(path, "r+") as dataset:
                profile, longest = dataset.profile, max(dataset.shape)
                side = tile_side(dataset.count * np.dtype(dataset.dtypes[0]).itemsize)  # its bands stand together
                levels = [2**i for i in range(1, 16) if longest // 2 ** (i - 1) > COG_TILE]
                dataset.build_overviews(levels, Resampling.nearest if bits else Resampling.average)
            options = {"blocksize": side, "overviews": "FORCE_USE_EXISTING" if levels else "NONE"}
            options["compress"] = profile.get("compress", "none")
            if options["compress"] == "zstd":
                options["level"] = ZSTD_LEVEL
            compressed = options["compress"] in {"deflate", "lzw", "zstd"}
            options["predictor"] = "YES" if compressed and not bits else "NO"
            copy_raster(path, hidden, driver="COG", **options)
        hidden.replace(path)
    except RasterioError as error:
        raise OutputError(f"{path} cannot be made a cloud-optimised GeoTIFF: {error}") from None
