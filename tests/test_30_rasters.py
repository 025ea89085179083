"""rasters: what a header says, values laid over another grid, and files that are whole or an error."""

import os
import struct
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import rasterio.crs
from affine import Affine
from rasterio.enums import ColorInterp, Resampling
from rasterio.shutil import copy as copy_raster
from rasterio.warp import transform as transform_points
from scipy.ndimage import map_coordinates
from small_scene import BANDS, CELL, CRS, NORTH, SHAPE, WEST, image_values, write_image, write_raster

from tscorr import rasters
from tscorr.errors import InputError, OutputError
from tscorr.grid import Block, Grid, blocks
from tscorr.rasters import tiff

WHOLE = Block(0, 0, *SHAPE)
NAN = float("nan")
UTM = "EPSG:32631"


def grid(west=WEST, north=NORTH, cell=CELL, shape=SHAPE, crs=CRS):
    return Grid(rasterio.crs.CRS.from_user_input(crs), Affine(cell, 0, west, 0, -cell, north), shape)


def hostile_tiff(path, side=60000):
    """A TIFF of some 150 bytes that declares one tile of `side` x `side` pixels."""
    entries = [(256, 4, side), (257, 4, side), (258, 3, 8), (259, 3, 1), (262, 3, 1), (277, 3, 1)]
    entries += [(322, 4, side), (323, 4, side), (324, 4, 8), (325, 4, 16)]
    directory = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + struct.pack("<I", 0))
    return path


# What a header says.


def test_describe_tells_what_the_header_says(tmp_path):
    info = rasters.describe(write_image(tmp_path / "image.tif"))
    assert (info.bands, info.shape, info.dtype, info.nodata, info.tile) == (BANDS, SHAPE, np.int16, -9999, (16, 16))
    assert info.scales == (1e-4,) * BANDS
    assert info.wavelengths_um == (0.475, 0.56, 0.668)
    assert info.fwhm_um == (0.02,) * BANDS
    assert info.names[1] == "band at 0.56 um"
    assert info.tags["FLIGHT"] == "7"
    assert info.grid == grid()


def test_wavelengths_are_read_from_plain_band_tags_in_their_unit(tmp_path):
    path = write_raster(tmp_path / "x.tif", image_values())
    with rasterio.open(path, "r+") as file:
        for band, (value, unit) in enumerate([("475", "Nanometers"), ("0.56", "Micrometers"), ("668", "")], start=1):
            file.update_tags(band, wavelength=value, wavelength_units=unit)
    assert rasters.describe(path).wavelengths_um == pytest.approx((0.475, 0.56, 0.668))


def test_wavelengths_are_read_from_an_envi_header(tmp_path):
    path = tmp_path / "x.img"
    transform = Affine(CELL, 0, WEST, 0, -CELL, NORTH)
    profile = {"driver": "ENVI", "count": 2, "height": 5, "width": 4, "dtype": "uint16", "crs": CRS}
    with rasterio.open(path, "w", transform=transform, **profile) as file:
        file.write(np.ones((2, 5, 4), np.uint16))
    header = tmp_path / "x.hdr"
    header.write_text(header.read_text() + "wavelength units = Nanometers\nwavelength = {475, 560}\n")
    assert rasters.describe(path).wavelengths_um == pytest.approx((0.475, 0.56))


def test_wavelengths_of_only_some_bands_are_no_wavelengths(tmp_path):
    path = write_raster(tmp_path / "x.tif", image_values())
    with rasterio.open(path, "r+") as file:
        file.update_tags(1, ns="IMAGERY", CENTRAL_WAVELENGTH_UM="0.5")
    assert rasters.describe(path).wavelengths_um is None


@pytest.mark.parametrize(
    ("dtype", "value", "holds"),
    [
        ("uint16", -9999, False),
        ("int16", -9999, True),
        ("uint8", 255, True),
        ("uint8", 256, False),
        ("uint8", 0.5, False),
        ("uint8", NAN, False),
        ("float32", NAN, True),
        ("float32", 1e300, False),
        ("float32", -9999, True),
    ],
)
def test_whether_a_pixel_can_hold_a_nodata_value(dtype, value, holds):
    assert rasters.can_hold(np.dtype(dtype), value) == holds


def test_a_nodata_value_that_no_pixel_can_have_is_none(tmp_path):
    path = write_raster(tmp_path / "x.tif", image_values(np.uint16), nodata=9999)
    path.write_bytes(path.read_bytes().replace(b"9999\0", b"1e99\0"))
    assert rasters.describe(path).nodata is None


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=f"{tmp_path / 'nix.tif'} does not exist"):
        rasters.describe(tmp_path / "nix.tif")


def test_a_file_that_is_no_raster_is_named(tmp_path):
    path = tmp_path / "x.tif"
    path.write_text("not a raster")
    with pytest.raises(InputError, match=str(path)):
        rasters.describe(path)


def test_a_vrt_is_refused_since_it_may_name_any_file(tmp_path):
    write_image(tmp_path / "image.tif")
    copy_raster(tmp_path / "image.tif", tmp_path / "image.vrt", driver="VRT")
    with pytest.raises(InputError, match=r"image\.vrt cannot be read: it is in none of the formats GTiff"):
        rasters.describe(tmp_path / "image.vrt")


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_tiff_that_declares_an_enormous_tile_is_refused_before_anything_is_read(tmp_path):
    path = hostile_tiff(tmp_path / "hostile.tif")
    start = time.perf_counter()
    with pytest.raises(InputError, match=f"{path} is stored in tiles of 60000 x 60000 pixels, 3600 MB each"):
        rasters.describe(path)
    assert time.perf_counter() - start < 2  # reading one pixel of it takes 54 s and 14 GB


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_large_honest_tile_is_accepted(tmp_path):
    assert rasters.describe(hostile_tiff(tmp_path / "large.tif", side=16000)).tile == (16000, 16000)


# Values laid over another grid.


def test_the_same_grid_is_read_as_stored(tmp_path):
    values = image_values()
    info = rasters.describe(write_image(tmp_path / "image.tif", values))
    block = Block(5, 7, 20, 30)
    with rasters.Reader(info) as reader:
        np.testing.assert_array_equal(reader.read(block), values[:, *block.slices])
        np.testing.assert_array_equal(reader.read(block, 2), values[1][block.slices])


def test_an_aligned_raster_is_read_by_its_shift_and_filled_beyond_its_edge(tmp_path):
    values = image_values(np.uint8)[0]
    path = write_raster(tmp_path / "x.tif", values, west=WEST + 3 * CELL, north=NORTH - 2 * CELL)
    with rasters.Reader(rasters.describe(path), grid(), fill=7) as reader:
        result = reader.read(Block(-1, -2, SHAPE[0] + 4, SHAPE[1] + 8), 1)
    expected = np.full((SHAPE[0] + 4, SHAPE[1] + 8), 7, np.uint8)
    expected[3 : 3 + SHAPE[0], 5 : 5 + SHAPE[1]] = values[: SHAPE[0] + 1, : SHAPE[1] + 3]
    np.testing.assert_array_equal(result, expected)


def test_heights_beyond_the_edge_and_without_data_are_nan(tmp_path):
    values = np.ones(SHAPE, np.float32)
    values[2, 3], values[4, 5], values[6, 7] = -9999, np.inf, np.nan
    info = rasters.describe(write_raster(tmp_path / "dsm.tif", values, nodata=-9999))
    with rasters.Reader(info, fill=NAN) as reader:
        result = reader.read(WHOLE.padded(1), 1)
    expected = np.pad(np.ones(SHAPE), 1, constant_values=np.nan)
    expected[3, 4] = expected[5, 6] = expected[7, 8] = np.nan
    np.testing.assert_array_equal(result, expected)
    assert result.dtype == np.float32


def test_a_block_wholly_beyond_the_edge_is_filled(tmp_path):
    info = rasters.describe(write_image(tmp_path / "image.tif"))
    with rasters.Reader(info, fill=3) as reader:
        assert np.all(reader.read(Block(-40, 0, 20, 10)) == 3)
        assert np.all(reader.read(Block(0, 100, 20, 10), 1) == 3)


def test_a_tenth_of_a_pixel_is_another_grid_but_a_thousandth_is_not(tmp_path):
    values = np.arange(SHAPE[0] * SHAPE[1], dtype=np.float32).reshape(SHAPE)
    for shift, exact in ((0.001, True), (0.1, False)):
        info = rasters.describe(write_raster(tmp_path / "x.tif", values, west=WEST + shift * CELL))
        with rasters.Reader(info, grid(), resampling=Resampling.bilinear, fill=NAN) as reader:
            assert np.array_equal(reader.read(WHOLE, 1), values) == exact


@pytest.mark.parametrize("cell", [0.2, 0.35, 1.7])
def test_classes_on_another_resolution_are_the_nearest(tmp_path, cell):
    rows, cols = int(24 / cell), int(32 / cell)
    classes = np.random.default_rng(3).integers(1, 250, (rows, cols)).astype(np.uint8)
    path = write_raster(tmp_path / "c.tif", classes, cell=cell)
    with rasters.Reader(rasters.describe(path), grid()) as reader:
        result = reader.read(WHOLE, 1)
    row = (np.arange(SHAPE[0]) + 0.5) * CELL / cell
    col = (np.arange(SHAPE[1]) + 0.5) * CELL / cell
    inside = np.ix_(row < rows, col < cols)
    expected = np.zeros(SHAPE, np.uint8)
    expected[inside] = classes[np.ix_(row[row < rows].astype(int), col[col < cols].astype(int))]
    clear = np.minimum(row % 1, 1 - row % 1)[:, None] > 1e-6
    clear = clear & (np.minimum(col % 1, 1 - col % 1) > 1e-6)
    np.testing.assert_array_equal(result[clear], expected[clear])
    assert clear.mean() > 0.5


def test_heights_on_another_resolution_are_bilinear(tmp_path):
    heights = np.random.default_rng(4).uniform(0, 9, (40, 50)).astype(np.float32)
    path = write_raster(tmp_path / "dsm.tif", heights, cell=0.8, west=WEST - 3.1, north=NORTH + 2.3)
    with rasters.Reader(rasters.describe(path), grid(), resampling=Resampling.bilinear, fill=NAN) as reader:
        result = reader.read(WHOLE, 1)
    row = ((np.arange(SHAPE[0]) + 0.5) * CELL + 2.3) / 0.8 - 0.5
    col = ((np.arange(SHAPE[1]) + 0.5) * CELL + 3.1) / 0.8 - 0.5
    expected = map_coordinates(heights, np.meshgrid(row, col, indexing="ij"), order=1)
    np.testing.assert_allclose(result, expected, atol=1e-5)


@pytest.fixture
def utm_points():
    """UTM coordinates of the pixels of the image's grid, each (rows, cols)."""
    x, y = np.broadcast_arrays(*grid().xy(np.arange(SHAPE[0])[:, None], np.arange(SHAPE[1])[None]))
    east, north = transform_points(
        rasterio.crs.CRS.from_user_input(CRS), rasterio.crs.CRS.from_user_input(UTM), x.ravel(), y.ravel()
    )
    return np.reshape(east, SHAPE), np.reshape(north, SHAPE)


def test_heights_in_another_crs_are_those_of_the_place(tmp_path, utm_points):
    east, north = utm_points
    west, top, cell = east.min() - 5, north.max() + 5, 0.4
    shape = (int(np.ptp(north) + 10) * 5 // 2, int(np.ptp(east) + 10) * 5 // 2)
    columns, rows = west + (np.arange(shape[1]) + 0.5) * cell, top - (np.arange(shape[0]) + 0.5) * cell
    plane = 0.5 * (columns - west)[None] + 0.25 * (top - rows)[:, None]
    path = write_raster(tmp_path / "dsm.tif", plane.astype(np.float32), crs=UTM, west=west, north=top, cell=cell)
    info = rasters.describe(path)
    with rasters.Reader(info, grid(), resampling=Resampling.bilinear, fill=NAN, margin=4) as reader:
        result = reader.read(WHOLE, 1)
        beyond = reader.read(WHOLE.padded(4), 1)
    expected = 0.5 * (east - west) + 0.25 * (top - north)
    np.testing.assert_allclose(result, expected, atol=1e-4)
    np.testing.assert_array_equal(beyond[4:-4, 4:-4], result)
    assert np.isfinite(beyond).all()


def test_classes_in_another_crs_are_those_of_the_place(tmp_path, utm_points):
    east, north = utm_points
    west, top, cell = east.min() - 2, north.max() + 2, 1.3
    classes = np.random.default_rng(5).integers(1, 250, (30, 40)).astype(np.uint8)
    path = write_raster(tmp_path / "c.tif", classes, crs=UTM, west=west, north=top, cell=cell)
    with rasters.Reader(rasters.describe(path), grid()) as reader:
        result = reader.read(WHOLE, 1)
    row, col = (top - north) / cell, (east - west) / cell
    away = np.minimum.reduce([row % 1, 1 - row % 1, col % 1, 1 - col % 1]) > 0.02
    np.testing.assert_array_equal(result[away], classes[row.astype(int), col.astype(int)][away])
    assert away.mean() > 0.8


def test_beyond_a_warped_raster_there_is_the_fill(tmp_path):
    classes = np.full((10, 10), 5, np.uint8)
    path = write_raster(tmp_path / "c.tif", classes, cell=0.7)
    with rasters.Reader(rasters.describe(path), grid(), fill=201) as reader:
        result = reader.read(WHOLE, 1)
    assert np.all(result[:13, :13] == 5)
    assert np.all(result[15:] == 201)
    assert np.all(result[:, 15:] == 201)


@pytest.mark.parametrize("cell", [CELL, 0.7])
def test_many_threads_read_the_same_values_as_one(tmp_path, cell):
    values = np.random.default_rng(6).integers(0, 9999, (2, 320, 320)).astype(np.int16)
    path = write_raster(tmp_path / "x.tif", values, cell=cell)
    wanted = grid(shape=(300, 300))
    todo = list(blocks(wanted.shape, (37, 53))) * 3
    with rasters.Reader(rasters.describe(path), wanted) as alone:
        expected = [alone.read(block) for block in todo]
    with rasters.Reader(rasters.describe(path), wanted) as reader, ThreadPoolExecutor(8) as pool:
        for result, value in zip(pool.map(reader.read, todo), expected, strict=True):
            np.testing.assert_array_equal(result, value)


def test_a_truncated_file_is_named_with_the_place(tmp_path):
    noise = np.random.default_rng(8).integers(0, 30000, (1, 256, 256)).astype(np.int16)
    path = write_raster(tmp_path / "cut.tif", noise, blockxsize=64, blockysize=64)
    os.truncate(path, path.stat().st_size // 2)
    with (
        rasters.Reader(rasters.describe(path)) as reader,
        pytest.raises(InputError, match=rf"{path} cannot be read at rows 192 to 256, columns 0 to 256: "),
    ):
        reader.read(Block(192, 0, 64, 256))


def test_a_file_that_vanishes_is_named(tmp_path):
    path = write_image(tmp_path / "image.tif")
    reader = rasters.Reader(rasters.describe(path))
    path.unlink()
    with pytest.raises(InputError, match=str(path)):
        reader.read(Block(0, 0, 4, 4))


# Checks that two rasters fit.


def test_rasters_that_do_not_overlap_are_refused_with_both_extents(tmp_path):
    image = rasters.describe(write_image(tmp_path / "image.tif"))
    far = rasters.describe(write_image(tmp_path / "far.tif", west=10000.0))
    with pytest.raises(InputError, match=r"the map .*far\.tif covers x 10000 to 10032, .* overlap .*image\.tif"):
        rasters.check_overlap(far, image, "the map")
    rasters.check_overlap(image, image, "the map")


@pytest.mark.parametrize("crs", [None, 'LOCAL_CS["a hall",UNIT["metre",1]]'])
def test_a_raster_of_no_or_of_an_unrelated_crs_is_refused(tmp_path, crs):
    image = rasters.describe(write_image(tmp_path / "image.tif"))
    other = rasters.describe(write_image(tmp_path / "other.tif", crs=crs))
    with pytest.raises(InputError, match=r"the map .*other\.tif .* CRS"):
        rasters.check_overlap(other, image, "the map")


@pytest.mark.parametrize(("crs", "said"), [("EPSG:4326", "in degrees"), ("EPSG:2263", "foot"), (None, "no CRS")])
def test_a_surface_model_must_be_in_metres(tmp_path, crs, said):
    info = rasters.describe(write_raster(tmp_path / "dsm.tif", np.ones(SHAPE, np.float32), crs=crs))
    with pytest.raises(InputError, match=f"{said}.*; allowed is a projected CRS in metres"):
        rasters.check_metric(info, "the surface model")


# Decimated reading.


def test_a_decimated_raster_is_the_mean_of_its_valid_pixels(tmp_path):
    values = np.random.default_rng(9).integers(0, 5000, (2, 64, 96)).astype(np.int16)
    values[0, :4, :4] = -9999  # a whole cell of no data
    values[1, 8, 8] = -9999
    info = rasters.describe(write_raster(tmp_path / "x.tif", values, nodata=-9999))
    result = rasters.read_decimated(info, 24)
    masked = np.ma.masked_equal(values, -9999).reshape(2, 16, 4, 24, 4)
    expected = masked.mean(axis=(2, 4)).filled(np.nan)
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, expected, atol=0.51)  # GDAL rounds the mean of integers
    np.testing.assert_array_equal(rasters.read_decimated(info, 24, [2])[0], result[1])


def test_a_raster_that_is_small_enough_is_not_decimated(tmp_path):
    values = image_values(np.float32)
    info = rasters.describe(write_raster(tmp_path / "x.tif", values))
    np.testing.assert_array_equal(rasters.read_decimated(info, 64), values)


def test_an_infinite_value_is_no_value_when_decimated(tmp_path):
    values = np.ones((1, 64, 64), np.float32)
    values[0, 5, 5], values[0, 40, 40] = np.inf, -np.inf
    info = rasters.describe(write_raster(tmp_path / "x.tif", values))
    result = rasters.read_decimated(info, 16)[0]
    assert np.isnan(result[1, 1])
    assert np.isnan(result[10, 10])
    assert np.count_nonzero(np.isnan(result)) == 2


def test_samples_of_a_small_raster_are_all_of_it(tmp_path):
    values = np.random.default_rng(14).uniform(0, 9, (64, 96)).astype(np.float32)
    values[3, 4], values[5, 6] = np.nan, -9999
    info = rasters.describe(write_raster(tmp_path / "x.tif", values, nodata=-9999))
    samples = rasters.read_samples(info, 3, 32)
    finite = np.delete(values.ravel(), [3 * 96 + 4, 5 * 96 + 6])
    np.testing.assert_array_equal(np.sort(samples), np.sort(finite))


@pytest.mark.parametrize("tile", [16, 64, 128])
def test_samples_of_a_large_raster_are_spread_over_it_and_decode_few_tiles(tmp_path, tile):
    rows, cols = np.indices((700, 900)).astype(np.float32)
    shape = {"blockxsize": tile, "blockysize": tile}
    row, col = (
        rasters.read_samples(rasters.describe(write_raster(tmp_path / "x.tif", axis, **shape)), 4, 32)
        for axis in (rows, cols)
    )
    assert row.size == 16 * 32 * 32
    for places, length in ((row, 700), (col, 900)):
        assert places.min() == 0
        assert places.max() >= length - 1 - tile
        quarters = np.bincount((places * 4 // length).astype(int), minlength=4)
        assert quarters.min() > 0
    tiles = set(zip((row // tile).tolist(), (col // tile).tolist(), strict=True))
    assert len(tiles) <= 16 * max(1, 3 * 3 if tile < 32 else 1)


def test_decimated_flags_are_flags_that_exist(tmp_path):
    flags = np.random.default_rng(10).choice(np.array([1, 64, 2050], np.uint16), (64, 96))
    info = rasters.describe(write_raster(tmp_path / "x.tif", flags))
    result = rasters.read_decimated_flags(info, 24)
    assert result.shape == (16, 24)
    assert set(np.unique(result)) <= {1, 64, 2050}


# Writing.


def layer_of(info, **changes):
    """A layer that holds the bands of an image."""
    layer = rasters.Layer(
        names=info.names,
        dtype=info.dtype.name,
        nodata=info.nodata,
        scales=info.scales,
        offsets=info.offsets,
        of_image=True,
        tags={"TSCORR_PRODUCT": "copy"},
    )
    return replace(layer, **changes)


def copied(info, path, block_shape=(16, 32)):
    """A copy of an image, block by block through Reader and Writer."""
    writer = rasters.Writer(path, info.profile, info, layer_of(info))
    with rasters.Reader(info) as reader:
        for block in blocks(info.shape, block_shape):
            writer.write(block, reader.read(block))
    writer.close()
    return rasters.describe(path)


@pytest.mark.parametrize(
    ("dtype", "profile"),
    [
        ("int16", {"compress": "deflate", "predictor": 2}),
        ("uint8", {"compress": "lzw", "nodata": 255}),
        ("uint16", {"compress": "zstd", "interleave": "pixel", "nodata": 0}),
        ("float32", {"compress": "deflate", "predictor": 3, "nodata": NAN}),
        ("float32", {"compress": "packbits"}),
        ("int16", {"compress": "none", "interleave": "pixel"}),
        ("int16", {"tiled": False, "blockxsize": None, "blockysize": 8, "compress": "deflate"}),
    ],
)
def test_values_and_everything_about_them_survive_a_round_trip(tmp_path, dtype, profile):
    path = write_image(tmp_path / "image.tif", image_values(dtype), **profile)
    with rasterio.open(path, "r+") as file:
        file.offsets = (0.01, 0.02, 0.03)
    info = rasters.describe(path)
    copy = copied(info, tmp_path / "copy.tif", (16, SHAPE[1]))
    with rasterio.open(path) as before, rasterio.open(copy.path) as after:
        np.testing.assert_array_equal(after.read(), before.read())
        for name in (
            "crs",
            "transform",
            "dtypes",
            "scales",
            "offsets",
            "descriptions",
            "interleaving",
            "block_shapes",
        ):
            assert getattr(after, name) == getattr(before, name), name
        np.testing.assert_equal(after.nodata, before.nodata)
        assert after.compression == before.compression
        assert after.block_shapes == before.block_shapes
        assert after.tags().items() >= before.tags().items()
        assert after.tags()["TSCORR_PRODUCT"] == "copy"
        for band in before.indexes:
            assert after.tags(band) == before.tags(band)
            assert after.tags(band, ns="IMAGERY") == before.tags(band, ns="IMAGERY")
    assert copy.wavelengths_um == info.wavelengths_um


def test_a_lossy_codec_becomes_a_lossless_one(tmp_path):
    path = write_raster(tmp_path / "x.tif", image_values(np.uint8), compress="jpeg")
    copy = copied(rasters.describe(path), tmp_path / "copy.tif")
    with rasterio.open(path) as before, rasterio.open(copy.path) as after:
        assert after.compression.name == "deflate"
        np.testing.assert_array_equal(after.read(), before.read())


@pytest.mark.parametrize("last", [ColorInterp.undefined, ColorInterp.alpha], ids=str)
def test_four_bytes_a_pixel_keep_the_meaning_of_the_fourth(tmp_path, last):
    values = np.random.default_rng(1).integers(1, 255, (4, *SHAPE)).astype(np.uint8)
    path = write_raster(tmp_path / "x.tif", values, photometric="minisblack")
    with rasterio.open(path, "r+") as file:
        file.colorinterp = (ColorInterp.gray, ColorInterp.undefined, ColorInterp.undefined, last)
    copy = copied(rasters.describe(path), tmp_path / "copy.tif")
    with rasterio.open(path) as before, rasterio.open(copy.path) as after:
        assert after.colorinterp == before.colorinterp


def test_a_layer_of_its_own_has_no_tags_of_the_image(tmp_path):
    info = rasters.describe(write_image(tmp_path / "image.tif"))
    layer = rasters.Layer(names=("angle",), dtype="float32", nodata=NAN, units=("degree",), tags={"A": "b"})
    writer = rasters.Writer(tmp_path / "x.tif", info.profile, info, layer)
    writer.write(WHOLE, np.ones((1, *SHAPE), np.float32))
    writer.close()
    with rasterio.open(tmp_path / "x.tif") as file:
        assert file.units == ("degree",)
        assert "FLIGHT" not in file.tags()
        assert file.tags()["A"] == "b"
        assert file.descriptions == ("angle",)


def half_written(path, **profile):
    """A writer that wrote one of the two blocks of an image, the values, and a function that writes the other."""
    info = rasters.describe(write_image(path.with_name("image.tif"), **profile))
    writer = rasters.Writer(path, info.profile, info, layer_of(info))
    values = image_values()
    upper, lower = Block(0, 0, 16, 64), Block(16, 0, 32, 64)
    writer.write(upper, values[:, *upper.slices])
    return writer, values, lambda: writer.write(lower, values[:, *lower.slices])


@pytest.mark.parametrize("interleave", ["band", "pixel"])
@pytest.mark.parametrize("codec", ["none", "deflate", "zstd"])
def test_a_file_that_loses_some_bytes_does_not_pass(tmp_path, codec, interleave):
    path = tmp_path / "copy.tif"
    writer, _, finish = half_written(path, compress=codec, interleave=interleave)
    finish()
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.seek(size - size // 3)
        file.write(bytes(16))
    with pytest.raises(OutputError, match=rf"{path} does not read back as written; is the disk full"):
        writer.close()


def test_a_file_that_lacks_a_block_does_not_pass(tmp_path):
    writer, *_ = half_written(tmp_path / "copy.tif")
    with pytest.raises(OutputError, match=r"copy\.tif does not read back as written"):
        writer.close()


def test_a_file_whose_header_is_lost_does_not_pass(tmp_path):
    path = tmp_path / "copy.tif"
    writer, _, finish = half_written(path)
    finish()
    with path.open("r+b") as file:
        file.write(bytes(64))
    with pytest.raises(OutputError, match=r"copy\.tif does not read back as written"):
        writer.close()


def test_blocks_that_cut_tiles_are_refused(tmp_path):
    writer, values, _ = half_written(tmp_path / "copy.tif")
    with pytest.raises(ValueError, match=r"Block\(row=16, .* does not consist of whole tiles of \(16, 16\)"):
        writer.write(Block(16, 0, 20, 64), values[:, 16:36])
    writer.abandon()


@pytest.mark.parametrize("compress", ["none", "deflate", "lzw", "zstd", "packbits"])
@pytest.mark.parametrize("interleave", ["band", "pixel"])
@pytest.mark.parametrize("cut", ["tiles", "strips"])
def test_tiles_that_reach_over_the_edge_are_as_gdal_writes_them(tmp_path, compress, interleave, cut):
    values = np.random.default_rng(12).integers(0, 900, (BANDS, 41, 57)).astype(np.uint16)
    tiles = {} if cut == "tiles" else {"tiled": False, "blockysize": 16}
    path = write_raster(tmp_path / "x.tif", values, compress=compress, interleave=interleave, **tiles)
    info = rasters.describe(path)
    width = 32 if cut == "tiles" else 57
    for block_shape in ((16, width), (41, 57)):
        copy = copied(info, tmp_path / "copy.tif", block_shape)
        with rasterio.open(copy.path) as after:
            np.testing.assert_array_equal(after.read(), values)
            assert after.block_shapes[0] == info.tile


@pytest.mark.parametrize("compress", ["zstd", "deflate"])
@pytest.mark.parametrize("dtype", ["uint8", "int8", "int16", "uint32", "int64", "float32", "float64"])
@pytest.mark.parametrize("predicted", [False, True])
@pytest.mark.parametrize("interleave", ["band", "pixel"])
@pytest.mark.parametrize("cut", ["tiles", "strips"])
def test_gdal_decodes_what_is_predicted_and_compressed_here(tmp_path, compress, dtype, predicted, interleave, cut):
    limits = np.finfo(dtype) if np.dtype(dtype).kind == "f" else np.iinfo(dtype)
    values = np.random.default_rng(14).uniform(-0.4, 0.4, (BANDS, 41, 57)) * float(limits.max) + float(limits.max) / 2
    values = values.astype(dtype)
    values[:, 3, :2] = limits.min, limits.max
    tiles = {} if cut == "tiles" else {"tiled": False, "blockysize": 16}
    predictor = {"predictor": 3 if np.dtype(dtype).kind == "f" else 2} if predicted else {}
    path = write_raster(tmp_path / "x.tif", values, compress=compress, interleave=interleave, **tiles, **predictor)
    copy = copied(rasters.describe(path), tmp_path / "copy.tif", (16, 32 if cut == "tiles" else 57))
    with rasterio.open(copy.path) as after:
        np.testing.assert_array_equal(after.read(), values)
        assert after.tags(ns="IMAGE_STRUCTURE").get("PREDICTOR", "1") == str(predictor.get("predictor", 1))


def test_many_threads_write_the_file_that_one_writes(tmp_path):
    values = np.random.default_rng(13).integers(0, 900, (BANDS, 320, 320)).astype(np.uint16)
    info = rasters.describe(write_raster(tmp_path / "x.tif", values, compress="zstd"))
    writer = rasters.Writer(tmp_path / "copy.tif", info.profile, info, layer_of(info))
    with ThreadPoolExecutor(8) as pool:
        todo = list(blocks(info.shape, (32, 48)))
        list(pool.map(lambda block: writer.write(block, values[:, *block.slices]), todo))
    writer.close()
    with rasterio.open(tmp_path / "copy.tif") as file:
        np.testing.assert_array_equal(file.read(), values)


@pytest.mark.parametrize("bigtiff", ["yes", "no"])
@pytest.mark.parametrize("endianness", ["big", "little"])
@pytest.mark.parametrize("tile", [16, 64])
def test_places_of_tiles_are_those_that_gdal_names(tmp_path, bigtiff, endianness, tile):
    options = {"bigtiff": bigtiff, "endianness": endianness, "blockxsize": tile, "blockysize": tile}
    path = write_raster(tmp_path / "x.tif", image_values(), interleave="band", **options)
    content = path.read_bytes()
    read = tiff.bytes_of(content)
    places = tiff.directory(read)
    with rasterio.open(path) as file:
        layout = tiff.Layout(file.shape, (tile, tile), BANDS)
        named = {
            what: [
                int(file.get_tag_item(f"BLOCK_{what}_{j}_{i}", "TIFF", bidx=band))
                for band in file.indexes
                for i, j in np.ndindex(layout.tiles)
            ]
            for what in ("OFFSET", "SIZE")
        }
    assert places.offsets.of(read).tolist() == named["OFFSET"]
    assert places.sizes.of(read).tolist() == named["SIZE"]
    np.testing.assert_array_equal(layout.numbers(WHOLE).ravel(), np.arange(len(named["SIZE"])))


@pytest.mark.parametrize("content", [b"", b"II*\0", b"GIF89a..........", b"II*\0\x08\0\0\0\0\0\0\0"])
def test_what_is_no_tiff_has_no_places(content):
    with pytest.raises(ValueError, match="no whole TIFF"):
        tiff.directory(tiff.bytes_of(content))


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    info = rasters.describe(write_image(tmp_path / "image.tif"))
    with pytest.raises(OutputError, match="nix"):
        rasters.Writer(tmp_path / "nix" / "x.tif", info.profile, info, layer_of(info))


FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from tscorr import rasters
from tscorr.errors import OutputError
from tscorr.grid import blocks

info = rasters.describe(sys.argv[1])
limit = int(sys.argv[3])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
layer = rasters.Layer(names=info.names, dtype=info.dtype.name, of_image=True)
try:
    writer = rasters.Writer(Path(sys.argv[2]), info.profile, info, layer)
    with rasters.Reader(info) as reader:
        for block in blocks(info.shape, (64, 64)):
            writer.write(block, reader.read(block))
    writer.close()
except OutputError as error:
    print("caught", error)
else:
    print("silent")
"""


@pytest.mark.parametrize("compress", ["none", "deflate"])
@pytest.mark.parametrize("share", [0.01, 0.5, 0.98])
def test_a_file_that_does_not_fit_the_disk_is_never_taken_for_whole(tmp_path, compress, share):
    noise = np.random.default_rng(2).integers(0, 30000, (1, 512, 512)).astype(np.int16)
    path = write_raster(tmp_path / "x.tif", noise, blockxsize=64, blockysize=64, compress=compress)
    limit = int(share * path.stat().st_size)
    arguments = [sys.executable, "-c", textwrap.dedent(FULL_DISK), path, tmp_path / "out.tif", str(limit)]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert result.stdout.startswith("caught"), result.stderr
    assert str(tmp_path / "out.tif") in result.stdout
