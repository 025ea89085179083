"""A mask of a whole scene at one bit a pixel, in a file: memory does not grow with the scene."""

import os
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from tscorr.grid import Block

Mask = NDArray[np.bool_]


class BitMask:
    """True everywhere at first; `narrow` clears pixels, `read` answers for blocks, which may reach outside.

    shape : (rows, cols) of the scene. file : a bit for each pixel, row by row, set where it was cleared.
    Any thread may narrow it, and then any read it. Close it to close its file.
    """

    def __init__(self, shape: tuple[int, int], file: BinaryIO) -> None:
        self._shape = shape
        self._row_bytes = -(-shape[1] // 8)
        self._file = file
        self._lock = threading.Lock()

    @classmethod
    def new(cls, shape: tuple[int, int], folder: Path) -> Self:
        """A mask in a nameless file on the disk of a folder; OSError where it cannot be made."""
        file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed with the mask
        mask = cls(shape, file)
        file.truncate(shape[0] * mask._row_bytes)
        return mask

    @classmethod
    def load(cls, path: Path, shape: tuple[int, int]) -> Self:
        """A mask as `save` wrote it."""
        return cls(shape, path.open("rb"))

    def save(self, path: Path) -> None:
        """Write the mask to a file with a name."""
        self._file.seek(0)
        with path.open("wb") as file:
            shutil.copyfileobj(self._file, file)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def narrow(self, block: Block, mask: Mask) -> None:
        """Keep of a block only what `mask` (rows, cols) says; what lies outside the scene is ignored.

        OSError where the disk is full.
        """
        top, left = max(block.row, 0), max(block.col, 0)
        bottom = min(block.row + block.height, self._shape[0])
        right = min(block.col + block.width, self._shape[1])
        if top >= bottom or left >= right:
            return
        first, last = left // 8, -(-right // 8)
        cleared = np.zeros((bottom - top, (last - first) * 8), np.bool_)
        cleared[:, left - first * 8 : right - first * 8] = ~mask[
            top - block.row : bottom - block.row, left - block.col : right - block.col
        ]
        packed = np.packbits(cleared, axis=1)
        with self._lock:
            bits = self._rows(top, bottom)
            bits[:, first:last] |= packed
            self._file.seek(top * self._row_bytes)
            self._file.write(bits.data)
            self._file.flush()

    def read(self, block: Block) -> Mask:
        """The mask of a block, (rows, cols); beyond the scene it goes on as at the nearest pixel."""
        rows, cols = self._shape
        top, left = max(block.row, 0), max(block.col, 0)
        bottom, right = min(block.row + block.height, rows), min(block.col + block.width, cols)
        first, last = left // 8, -(-right // 8)
        bits = np.unpackbits(self._rows(top, bottom)[:, first:last], axis=1)[:, left - first * 8 : right - first * 8]
        beyond = (
            (top - block.row, block.row + block.height - bottom),
            (left - block.col, block.col + block.width - right),
        )
        return np.pad(bits == 0, beyond, mode="edge") if np.any(beyond) else bits == 0

    def _rows(self, top: int, bottom: int) -> NDArray[Any]:
        """The bits of whole rows: uint8 (rows, bytes)."""
        size = (bottom - top) * self._row_bytes
        octets = bytearray(os.pread(self._file.fileno(), size, top * self._row_bytes))
        return np.frombuffer(octets, np.uint8).reshape(bottom - top, self._row_bytes)
