"""Parts of a raster that are kept: the values of a plain reader, each tile decoded once, memory bounded."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from rasterio.enums import Resampling
from small_scene import CELL, NORTH, WEST, write_raster
from test_30_rasters import grid

from tscorr import rasters
from tscorr.errors import InputError
from tscorr.grid import Block, blocks
from tscorr.rasters import kept

SHAPE = 1300, 2300
NAN = float("nan")


@pytest.fixture(scope="module")
def dsm(tmp_path_factory):
    values = np.random.default_rng(20).uniform(0, 9, SHAPE).astype(np.float32)
    values[5, 6] = -9999
    options = {"nodata": -9999, "west": WEST + 7 * CELL, "north": NORTH - 3 * CELL, "compress": "none"}
    path = tmp_path_factory.mktemp("kept") / "dsm.tif"
    return rasters.describe(write_raster(path, values, **options, blockxsize=256, blockysize=256))


def readers(info, *, cell=CELL, kept_bytes=kept.KEPT_BYTES):
    scene = grid(shape=(1200, 2200), cell=cell)
    plain = rasters.Reader(info, scene, resampling=Resampling.bilinear, fill=NAN, margin=64)
    return plain, rasters.KeptReader(plain, kept_bytes), scene


@pytest.mark.parametrize("kept_bytes", [1, 3e6, kept.KEPT_BYTES])
@pytest.mark.parametrize("block_shape", [(512, 2048), (37, 700), (1200, 2200)])
def test_kept_values_are_those_of_the_file(dsm, block_shape, kept_bytes):
    plain, reader, scene = readers(dsm, kept_bytes=kept_bytes)
    with plain:
        for block in blocks(scene.shape, block_shape):
            np.testing.assert_array_equal(reader.read(block.padded(3)), plain.read(block.padded(3), 1))


def test_kept_values_on_another_grid_do_not_depend_on_the_block(dsm):
    plain, reader, scene = readers(dsm, cell=0.7)
    with plain:
        whole = reader.read(Block(0, 0, *scene.shape).padded(2))
        for block in blocks(scene.shape, (511, 700)):
            rows, cols = block.slices
            around = whole[rows.start : rows.stop + 4, cols.start : cols.stop + 4]
            np.testing.assert_array_equal(reader.read(block.padded(2)), around)
        np.testing.assert_allclose(whole[2:-2, 2:-2], plain.read(Block(0, 0, *scene.shape), 1), atol=1e-3)


def test_each_part_is_read_once_though_blocks_overlap_and_threads_share(dsm, monkeypatch):
    plain, reader, scene = readers(dsm)
    asked = Counter()
    read = plain.read

    def counting(block, bands=None):
        asked[block] += 1
        return read(block, bands)

    monkeypatch.setattr(plain, "read", counting)
    with plain, ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda block: reader.read(block.padded(1)), blocks(scene.shape, (512, 512))))
    assert set(asked.values()) == {1}
    assert all((block.row + plain.shift[0]) % 256 == 0 == (block.col + plain.shift[1]) % 256 for block in asked)


def test_what_is_kept_is_bounded(dsm):
    plain, reader, scene = readers(dsm, kept_bytes=5e6)
    with plain:
        for block in blocks(scene.shape, (256, 256)):
            reader.read(block)
            assert sum(part.nbytes for part in reader._parts.values()) <= 5e6
    assert len(reader._locks) == len(reader._parts)


def test_a_part_that_cannot_be_read_is_named_each_time(tmp_path):
    noise = np.random.default_rng(8).uniform(0, 9, (1024, 1024)).astype(np.float32)
    path = write_raster(tmp_path / "cut.tif", noise, blockxsize=256, blockysize=256, compress="none")
    info = rasters.describe(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with rasters.Reader(info) as plain:
        reader = rasters.KeptReader(plain)
        for _ in range(2):
            with pytest.raises(InputError, match=r"cut\.tif cannot be read at rows 512 to 1024, columns 0 to 512"):
                reader.read(Block(600, 0, 10, 10))
