"""A mask of a whole scene at one bit a pixel."""

from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tscorr.grid import Block

Mask = NDArray[np.bool_]


class BitMask:
    """True everywhere at first; `narrow` clears pixels, `read` answers for blocks, which may reach outside."""

    def __init__(self, shape: tuple[int, int], bits: NDArray[Any] | None = None) -> None:
        self._shape = shape
        self._bits = np.full((shape[0], -(-shape[1] // 8)), 255, np.uint8) if bits is None else bits

    def save(self, path: Path) -> None:
        """Write the mask as an array of bytes."""
        np.save(path, self._bits)

    @classmethod
    def load(cls, path: Path, shape: tuple[int, int]) -> Self:
        """A mask as `save` wrote it; of the file, only what is asked for is read."""
        return cls(shape, np.load(path, mmap_mode="r"))

    def narrow(self, block: Block, mask: Mask) -> None:
        """Keep of a block only what `mask` (rows, cols) says; what lies outside the scene is ignored."""
        top, left = max(block.row, 0), max(block.col, 0)
        bottom = min(block.row + block.height, self._shape[0])
        right = min(block.col + block.width, self._shape[1])
        if top >= bottom or left >= right:
            return
        first, last = left // 8, -(-right // 8)
        whole = np.ones((bottom - top, (last - first) * 8), np.bool_)
        whole[:, left - first * 8 : right - first * 8] = mask[
            top - block.row : bottom - block.row, left - block.col : right - block.col
        ]
        self._bits[top:bottom, first:last] &= np.packbits(whole, axis=1)

    def read(self, block: Block) -> Mask:
        """The mask of a block, (rows, cols); beyond the scene it goes on as at the nearest pixel."""
        rows, cols = self._shape
        top, left = max(block.row, 0), max(block.col, 0)
        bottom, right = min(block.row + block.height, rows), min(block.col + block.width, cols)
        first, last = left // 8, -(-right // 8)
        bits = np.unpackbits(self._bits[top:bottom, first:last], axis=1)[:, left - first * 8 : right - first * 8]
        beyond = (
            (top - block.row, block.row + block.height - bottom),
            (left - block.col, block.col + block.width - right),
        )
        return np.pad(bits.astype(np.bool_), beyond, mode="edge")
