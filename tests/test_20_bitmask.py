"""Masks of a bit a pixel against masks of a byte."""

import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest

from tscorr.grid import Block
from tscorr.terrain.bitmask import BitMask

SHAPE = 37, 61
BLOCKS = [Block(0, 0, 37, 61), Block(5, 3, 9, 18), Block(-4, -2, 20, 30), Block(30, 50, 12, 40), Block(36, 60, 1, 1)]


@pytest.fixture
def narrowed(tmp_path):
    """A mask that was narrowed by blocks, some of which reach beyond the scene, and what it should hold."""
    rng = np.random.default_rng(4)
    expected = np.ones(SHAPE, np.bool_)
    with closing(BitMask.new(SHAPE, tmp_path)) as mask:
        for block in [*BLOCKS, Block(-9, 0, 5, 61), Block(0, 61, 37, 8)]:
            keep = rng.random(block.shape) < 0.8
            mask.narrow(block, keep)
            for row, col in np.ndindex(SHAPE):
                inside = 0 <= row - block.row < block.height and 0 <= col - block.col < block.width
                expected[row, col] &= not inside or keep[row - block.row, col - block.col]
        yield mask, expected


def around(expected, block):
    """A block of an array that goes on as at its edge."""
    rows = np.clip(np.arange(block.row, block.row + block.height), 0, SHAPE[0] - 1)
    cols = np.clip(np.arange(block.col, block.col + block.width), 0, SHAPE[1] - 1)
    return expected[np.ix_(rows, cols)]


def test_a_new_mask_is_true_everywhere(tmp_path):
    with closing(BitMask.new(SHAPE, tmp_path)) as mask:
        assert mask.read(Block(-1, -1, 39, 63)).all()
    assert not list(tmp_path.iterdir())  # its file has no name that a killed run could leave


@pytest.mark.parametrize("block", BLOCKS)
def test_blocks_of_it_are_those_of_an_array_of_bytes(narrowed, block):
    mask, expected = narrowed
    assert not expected.all()
    np.testing.assert_array_equal(mask.read(block), around(expected, block))


def test_threads_may_narrow_it_side_by_side(tmp_path):
    """Columns that share bytes, each by a thread of its own, many times."""
    columns = [Block(0, col, 37, 1) for col in range(61)] * 20
    with closing(BitMask.new(SHAPE, tmp_path)) as mask, ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda block: mask.narrow(block, np.zeros(block.shape, np.bool_)), columns))
        assert not mask.read(Block(0, 0, *SHAPE)).any()


def test_it_is_the_same_out_of_a_file(narrowed, tmp_path):
    mask, expected = narrowed
    mask.save(tmp_path / "mask.bits")
    with closing(BitMask.load(tmp_path / "mask.bits", SHAPE)) as loaded:
        np.testing.assert_array_equal(loaded.read(Block(0, 0, *SHAPE)), expected)


def test_memory_does_not_grow_with_the_scene(tmp_path):
    block = Block(19_000, 4_000, 64, 64)
    tracemalloc.start()
    try:
        with closing(BitMask.new((20_000, 20_000), tmp_path)) as mask:  # 50 MB
            mask.narrow(block, np.zeros(block.shape, np.bool_))
            assert not mask.read(block).any()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2e6
