"""rasters: tiles that are decoded here have the values that GDAL finds in them, or are left to GDAL."""

import os
import struct
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rasterio
import zstandard
from small_scene import read_raster, write_raster

from tscorr import rasters
from tscorr.errors import InputError
from tscorr.grid import Block, blocks
from tscorr.rasters import tiff
from tscorr.rasters.decoding import Decoder

SHAPE, TILE = (300, 420), 128
WHOLE = Block(0, 0, *SHAPE)
TYPES = ["uint8", "int8", "int16", "uint16", "uint32", "int64", "float32", "float64"]


def values_of(dtype, bands=3):
    """Smooth with noise, and the ends of the range."""
    limits = np.finfo(dtype) if np.dtype(dtype).kind == "f" else np.iinfo(dtype)
    rng = np.random.default_rng(5)
    smooth = np.add.outer(np.arange(SHAPE[0]), np.arange(SHAPE[1])) % 100
    values = (smooth + rng.integers(0, 9, (bands, *SHAPE))).astype(dtype)
    values[:, 7, 3:5] = limits.min, limits.max
    if np.dtype(dtype).kind == "f":
        values[0, 9] = np.nan
    return values


def written(path, values, **profile):
    """A raster of tiles of 128 x 128 pixels, with ZSTD where nothing else is said."""
    profile = {"blockxsize": TILE, "blockysize": TILE, "compress": "zstd", **profile}
    return write_raster(path, values, **profile)


@contextmanager
def decoder_of(path):
    """What decodes it here, or None."""
    try:
        decode = Decoder(rasters.describe(path))
    except ValueError:
        yield None
    else:
        yield decode
        decode.close()


@pytest.mark.parametrize("compress", ["zstd", "none"])
@pytest.mark.parametrize("interleave", ["band", "pixel"])
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("predicted", [False, True])
def test_values_are_those_that_gdal_finds(tmp_path, compress, interleave, dtype, predicted):
    floating = np.dtype(dtype).kind == "f"
    predictor = {"predictor": 3 if floating else 2} if predicted and compress == "zstd" else {}
    path = written(tmp_path / "x.tif", values_of(dtype), compress=compress, interleave=interleave, **predictor)
    too_small = np.dtype(dtype).itemsize == 1 and interleave == "band"
    by_bytes = floating and predicted and compress == "zstd" and (dtype == "float64" or interleave == "pixel")
    expected = read_raster(path)
    with decoder_of(path) as decode, rasters.Reader(rasters.describe(path)) as reader:
        assert (decode is None) == (too_small or by_bytes)
        for block in (
            WHOLE,
            Block(0, 0, TILE, TILE),
            Block(TILE, 2 * TILE, TILE, 420 - 2 * TILE),
            Block(30, 20, 250, 360),
            Block(5, 6, 7, 8),
        ):
            there = expected[:, *block.slices]
            np.testing.assert_array_equal(reader.read(block), there)
            np.testing.assert_array_equal(reader.read(block, 2), there[1])
            np.testing.assert_array_equal(reader.read(block, [3, 1]), there[[2, 0]])
            if decode is not None and block.height > 100:
                np.testing.assert_array_equal(decode(block), there)
                np.testing.assert_array_equal(decode(block, [1, 2, 3]), there)
                assert decode(block, [3, 1]) is None
                assert (decode(block, 2) is None) == (interleave == "pixel")


def test_many_threads_find_what_one_finds(tmp_path):
    values = values_of("float32", bands=1)
    path = written(tmp_path / "x.tif", values, predictor=3)
    todo = list(blocks(SHAPE, (TILE, TILE))) * 8
    with rasters.Reader(rasters.describe(path)) as reader, ThreadPoolExecutor(8) as pool:
        for block, found in zip(todo, pool.map(lambda block: reader.read(block, 1), todo), strict=True):
            np.testing.assert_array_equal(found, values[0, *block.slices])


@pytest.mark.parametrize(
    "profile",
    [
        {"compress": "deflate"},
        {"compress": "lzw", "predictor": 2},
        {"endianness": "big"},
        {"endianness": "big", "compress": "none"},
        {"blockxsize": 16, "blockysize": 16},
        {"tiled": False, "blockysize": 64},
        {"nbits": 12, "compress": "none"},
    ],
    ids=str,
)
def test_what_is_stored_otherwise_is_left_to_gdal(tmp_path, profile):
    values = values_of("uint16") % 4096
    path = written(tmp_path / "x.tif", values, **profile)
    with decoder_of(path) as decode, rasters.Reader(rasters.describe(path)) as reader:
        assert decode is None
        np.testing.assert_array_equal(reader.read(WHOLE), values)


def test_tiles_that_are_not_stored_are_zero(tmp_path):
    path = tmp_path / "x.tif"
    profile = {"tiled": True, "blockxsize": TILE, "blockysize": TILE, "compress": "zstd", "sparse_ok": True}
    shape = {"height": SHAPE[0], "width": SHAPE[1], "count": 1, "dtype": "uint16"}
    transform = rasterio.Affine(0.5, 0, 0, 0, -0.5, 0)
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:28992", transform=transform, **shape, **profile) as file:
        file.write(np.full((TILE, TILE), 7, np.uint16), 1, window=rasterio.windows.Window(0, 0, TILE, TILE))
    expected = np.zeros(SHAPE, np.uint16)
    expected[:TILE, :TILE] = 7
    with rasters.Reader(rasters.describe(path)) as reader:
        np.testing.assert_array_equal(reader.read(WHOLE, 1), expected)


def frame(size):
    """ZSTD of so many bytes, of which the header says how many they are."""
    return zstandard.ZstdCompressor().compress(bytes(size))


def with_first_tile(path, content):
    """A raster of one band whose first tile has other bytes, at the end of the file."""
    written(path, values_of("uint16", bands=1))
    whole = bytearray(path.read_bytes())
    places = tiff.directory(tiff.bytes_of(whole))
    for words, number in ((places.offsets, len(whole)), (places.sizes, len(content))):
        np.frombuffer(whole, words.dtype, words.length, words.start)[0] = number
    path.write_bytes(whole + content)
    return path


FIRST = Block(0, 0, TILE, TILE)
TILE_BYTES = TILE * TILE * 2


@pytest.mark.parametrize("content", [frame(40), b"no ZSTD", frame(TILE_BYTES)[:-3]], ids=["short", "other", "cut"])
def test_a_tile_that_is_not_what_it_should_be_is_an_error_that_names_the_file(tmp_path, content):
    path = with_first_tile(tmp_path / "x.tif", content)
    with (
        rasters.Reader(rasters.describe(path)) as reader,
        pytest.raises(InputError, match=r"x\.tif cannot be read at rows 0 to 128, columns 0 to 128"),
    ):
        reader.read(FIRST, 1)


@pytest.mark.parametrize("size", [TILE_BYTES + 1, 10**9])
def test_no_more_is_made_of_a_tile_than_it_has(tmp_path, size):
    path = with_first_tile(tmp_path / "x.tif", frame(size))
    with decoder_of(path) as decode, rasters.Reader(rasters.describe(path)) as reader:
        assert decode(FIRST, 1) is None
        np.testing.assert_array_equal(reader.read(FIRST, 1), read_raster(path)[0][FIRST.slices])


@pytest.mark.parametrize("compress", ["none", "zstd"])
def test_a_file_that_is_cut_short_while_it_is_read_is_named(tmp_path, compress):
    path = written(tmp_path / "x.tif", values_of("uint16", bands=1), compress=compress)
    with rasters.Reader(rasters.describe(path)) as reader:
        reader.read(FIRST, 1)
        os.truncate(path, path.stat().st_size - 1000)
        with pytest.raises(InputError, match=r"x\.tif cannot be read at rows 256"):
            reader.read(Block(256, 384, 44, 36), 1)


def entries_of(content):
    """Where the entries of the first directory of a BigTIFF stand, by tag."""
    (start,) = struct.unpack_from("<Q", content, 8)
    (entries,) = struct.unpack_from("<Q", content, start)
    places = range(start + 8, start + 8 + 20 * entries, 20)
    return {struct.unpack_from("<H", content, place)[0]: place for place in places}


@pytest.mark.parametrize(("dtype", "predictor"), [("uint16", 2), ("float32", 3)])
def test_a_predictor_without_a_codec_means_nothing(tmp_path, dtype, predictor):
    path = written(tmp_path / "x.tif", values_of(dtype, bands=1), compress="none", bigtiff="yes", interleave="pixel")
    content = bytearray(path.read_bytes())
    places = entries_of(content)
    table = sorted(places.values())
    struct.pack_into("<HHQQ", content, places[284], 317, 3, 1, predictor)  # bands of one: together or apart
    sorted_by_tag = sorted(bytes(content[place : place + 20]) for place in table)
    sorted_by_tag.sort(key=lambda entry: struct.unpack_from("<H", entry)[0])
    content[table[0] : table[-1] + 20] = b"".join(sorted_by_tag)
    path.write_bytes(content)
    with decoder_of(path) as decode, rasters.Reader(rasters.describe(path)) as reader:
        assert decode is not None
        np.testing.assert_array_equal(reader.read(WHOLE, 1), values_of(dtype, bands=1)[0])


def test_lists_at_places_that_no_file_has_are_left_to_gdal(tmp_path):
    path = written(tmp_path / "x.tif", values_of("uint16", bands=1), bigtiff="yes")
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, entries_of(content)[324] + 12, 2**64 - 1)
    path.write_bytes(content)
    with (
        rasters.Reader(rasters.describe(path)) as reader,
        pytest.raises(InputError, match=r"x\.tif cannot be read at rows 0 to 128"),
    ):
        reader.read(FIRST, 1)


def test_a_reader_that_need_not_decode_opens_no_second_file(tmp_path):
    path = written(tmp_path / "x.tif", values_of("uint16"), compress="deflate")
    fine = written(tmp_path / "y.tif", values_of("uint16"))
    before = len(list(Path("/proc/self/fd").iterdir()))
    with rasters.Reader(rasters.describe(path)) as left, rasters.Reader(rasters.describe(fine)) as pixel:
        left.read(WHOLE)
        pixel.read(Block(3, 3, 1, 1))
        assert len(list(Path("/proc/self/fd").iterdir())) == before + 2


def test_a_directory_of_very_many_entries_is_not_looked_through():
    content = b"MM\0+" + bytes(4) + (16).to_bytes(8, "big") + (10**6).to_bytes(8, "big") + bytes(2 * 10**7)
    with pytest.raises(ValueError, match="no whole TIFF: 1000000 entries in its directory"):
        tiff.directory(tiff.bytes_of(content))
