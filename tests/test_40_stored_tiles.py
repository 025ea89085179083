"""scene: tiles that nothing is removed from are copied as they are stored, where the codings are the same."""

import os

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy as copy_raster
from small_scene import BANDS, GROUND, METAL, NODATA, read_raster, write_config, write_image, write_raster

from tscorr import batch, rasters
from tscorr.correction import PixelFlag
from tscorr.errors import InputError
from tscorr.grid import Block

SHAPE = 600, 200
SIDE = 64
UNIT = 512, 128
ROOF = slice(20, 60), slice(30, 90)
"""in the first of four units"""
TILED = {"blockxsize": SIDE, "blockysize": SIDE}


@pytest.fixture(autouse=True)
def small_units(monkeypatch):
    """Four units where there would be one."""
    monkeypatch.setattr("tscorr.scene.cutting.UNIT_COLUMNS", UNIT[1])


def write_scene(folder, dtype="int16", nodata=None, **profile):
    """A large image of ground with one roof."""
    classes = np.full(SHAPE, GROUND, np.uint8)
    classes[ROOF] = METAL
    write_raster(folder / "class_map.tif", classes, **TILED)
    write_raster(folder / "dsm.tif", np.ones(SHAPE, np.float32), **TILED)
    values = np.random.default_rng(3).integers(100, 250, (BANDS, *SHAPE)).astype(dtype)
    profile = (TILED if profile.get("tiled", True) else {}) | profile
    factor = np.array(1 if dtype == "uint8" else 30, dtype)
    return write_image(folder / "image.tif", values * factor, nodata=nodata, **profile)


def corrected(folder, name="out", *, skip=True, **output):
    """The corrected image of the scene."""
    output = {"directory": name, "quicklook": False, "products": ["corrected", "flags"], **output}
    (scene,) = batch.run(write_config(folder, output=output, run={"skip": skip, "memory_limit_mb": 2000})).scenes
    assert scene.error == ""
    flags = read_raster(scene.folder / "flags.tif")[0]
    assert (flags[ROOF] & PixelFlag.SPECULAR_STATE).any()
    return scene.folder / "corrected.tif"


def stored(path):
    """The bytes of each tile of band 1, by its row and column of tiles, found where GDAL says that they are."""
    content = path.read_bytes()
    with rasterio.open(path) as file:
        rows, cols = file.block_shapes[0]
        tiles = {}
        for i, j in np.ndindex(-(-file.height // rows), -(-file.width // cols)):
            place = file.get_tag_item(f"BLOCK_OFFSET_{j}_{i}", "TIFF", bidx=1)
            size = int(file.get_tag_item(f"BLOCK_SIZE_{j}_{i}", "TIFF", bidx=1) or 0)
            tiles[i * rows, j * cols] = content[int(place or 0) :][:size]
    return tiles


def copied(image, result):
    """Which tiles of a result have the bytes that those of the image have; by pixel of the upper left corner."""
    one, other = stored(image), stored(result)
    assert one.keys() == other.keys()
    return {place for place in one if one[place] == other[place]}


def idle_tiles(image):
    """The tiles outside the unit that has the roof."""
    return {(row, col) for row, col in stored(image) if row >= UNIT[0] or col >= UNIT[1]}


LAYOUTS = {
    "deflate 9 by pixel": {"compress": "deflate", "zlevel": 9, "predictor": 2, "interleave": "pixel"},
    "deflate 9 by band": {"compress": "deflate", "zlevel": 9, "interleave": "band"},
    "zstd 19": {"compress": "zstd", "zstd_level": 19, "predictor": 2},
    "bigtiff, bytes": {"compress": "deflate", "zlevel": 9, "bigtiff": "yes", "dtype": "uint8"},
    "strips": {"compress": "deflate", "zlevel": 9, "tiled": False, "blockysize": 8},
    "nodata": {"compress": "deflate", "zlevel": 9, "nodata": NODATA},
}
"""at levels that tscorr does not write at: bytes can be the same by copying only"""


@pytest.mark.parametrize("layout", LAYOUTS)
def test_tiles_without_a_change_are_copied(tmp_path, layout):
    image = write_scene(tmp_path, **LAYOUTS[layout])
    result = corrected(tmp_path)
    assert idle_tiles(image) <= copied(image, result)
    np.testing.assert_array_equal(read_raster(result), read_raster(corrected(tmp_path, "whole", skip=False)))


OTHER_CODINGS = {
    "big-endian": {"endianness": "big"},
    "lossy": {"compress": "jpeg", "dtype": "uint8", "interleave": "pixel", "photometric": "ycbcr"},
    "floats with another predictor": {"dtype": "float32", "compress": "deflate", "predictor": 2},
}


@pytest.mark.parametrize("layout", OTHER_CODINGS)
def test_tiles_of_another_coding_are_decoded(tmp_path, layout):
    image = write_scene(tmp_path, **OTHER_CODINGS[layout])
    result = corrected(tmp_path)
    assert not copied(image, result)
    outside = idle_tiles(image)
    values = read_raster(result)
    for row, col in outside:
        tile = np.s_[:, row : row + SIDE, col : col + SIDE]
        np.testing.assert_array_equal(values[tile], read_raster(image)[tile])


@pytest.mark.parametrize("method", ["sparse", "cog"])
def test_images_of_other_makes_come_out_as_they_are(tmp_path, method):
    """Tiles that are not stored, since all in them is 0; and a file whose tiles stand behind overviews, with marks."""
    image = write_scene(tmp_path)
    values = read_raster(image)
    if method == "sparse":
        values[:, 512:, :128] = 0
        write_image(image, values, nodata=None, sparse_ok=True, **TILED)
        assert b"" in stored(image).values()
    else:
        copy_raster(image, tmp_path / "cog.tif", driver="COG", blocksize=SIDE, overviews="AUTO", compress="deflate")
        (tmp_path / "cog.tif").replace(image)
    result = read_raster(corrected(tmp_path))
    values[:, *ROOF] = result[:, *ROOF]
    np.testing.assert_array_equal(result, values)


def test_a_scene_without_any_change_is_the_image_tile_by_tile(tmp_path):
    image = write_scene(tmp_path, compress="deflate", zlevel=9)
    write_raster(tmp_path / "class_map.tif", np.full(SHAPE, GROUND, np.uint8), **TILED)
    output = {"directory": "out", "quicklook": False}
    (scene,) = batch.run(write_config(tmp_path, output=output)).scenes
    assert scene.error == ""
    assert copied(image, scene.folder / "corrected.tif") == set(stored(image))


def test_a_file_cut_short_is_named(tmp_path):
    image = write_scene(tmp_path)
    info = rasters.describe(image)
    with rasters.Reader(info) as reader, rasters.StoredTiles(info, reader.read) as tiles:
        last = Block(512, 128, 88, 72)
        assert tiles.holds(last)
        os.truncate(image, image.stat().st_size // 2)
        with pytest.raises(InputError, match=r"image\.tif cannot be read: it ends within a tile"):
            tiles.tiles(last)


def test_a_tile_longer_than_any_codec_makes_it_is_not_copied(tmp_path):
    image = write_scene(tmp_path, compress="none", interleave="pixel")
    info = rasters.describe(image)
    content = bytearray(image.read_bytes())
    places = rasters.tiff.directory(rasters.tiff.bytes_of(content))
    sizes = np.frombuffer(content, places.sizes.dtype, places.sizes.length, places.sizes.start)
    sizes[-1] = 2 * sizes[-1]
    image.write_bytes(content)
    with rasters.Reader(info) as reader, rasters.StoredTiles(info, reader.read) as tiles:
        assert tiles.holds(Block(0, 0, *UNIT))
        assert not tiles.holds(Block(512, 128, 88, 72))
