"""Parts of a raster that neighbouring blocks share, read once and kept for a while."""

import threading
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tscorr.grid import Block
from tscorr.rasters.reading import Reader

Array = NDArray[Any]

PART_ROWS, PART_COLS = 512, 512
"""about the size of a part, in whole tiles of the file where they are not larger"""
KEPT_BYTES = 44e6
"""three rows of parts under a stripe of blocks: those above, under and below the blocks that are worked on"""


class KeptReader:
    """Reads one band of a raster in parts of whole tiles and keeps the last ones; any thread may read.

    Blocks with an apron reach into the tiles of their neighbours: without this each tile is decoded three times.
    """

    def __init__(self, reader: Reader, kept_bytes: float = KEPT_BYTES) -> None:
        self.info = reader.info
        self._reader = reader
        self._kept_bytes = kept_bytes
        self._parts: OrderedDict[tuple[int, int], Array] = OrderedDict()
        self._bytes = 0
        self._locks: dict[tuple[int, int], threading.Lock] = {}
        self._lock = threading.Lock()
        tile_rows, tile_cols = reader.tile
        self._rows, self._cols = max(1, PART_ROWS // tile_rows) * tile_rows, max(1, PART_COLS // tile_cols) * tile_cols
        if self._rows * self._cols > 8 * PART_ROWS * PART_COLS:  # strips of a wide raster, or enormous tiles
            self._rows, self._cols = PART_ROWS, PART_COLS
        self._first_row, self._first_col = (-shift for shift in reader.shift)

    def read(self, block: Block) -> Array:
        """Values (rows, cols) of a block, which may reach beyond the grid."""
        top, left = block.row - self._first_row, block.col - self._first_col
        values: Array | None = None
        for i in range(top // self._rows, -(-(top + block.height) // self._rows)):
            for j in range(left // self._cols, -(-(left + block.width) // self._cols)):
                part = self._part(i, j)
                down, right = i * self._rows - top, j * self._cols - left
                if values is None:
                    values = np.empty(block.shape, part.dtype)
                rows = slice(max(down, 0), min(down + self._rows, block.height))
                cols = slice(max(right, 0), min(right + self._cols, block.width))
                values[rows, cols] = part[rows.start - down : rows.stop - down, cols.start - right : cols.stop - right]
        assert values is not None
        return values

    def _part(self, i: int, j: int) -> Array:
        """One part, read by the first thread that asks for it while the others wait."""
        with self._lock:
            own = self._locks.setdefault((i, j), threading.Lock())
        with own:
            with self._lock:
                if (i, j) in self._parts:
                    self._parts.move_to_end((i, j))
                    return self._parts[i, j]
            row, col = i * self._rows + self._first_row, j * self._cols + self._first_col
            part = self._reader.read(Block(row, col, self._rows, self._cols), 1)
            with self._lock:
                self._parts[i, j] = part
                self._bytes += part.nbytes
                while self._bytes > self._kept_bytes and len(self._parts) > 1:
                    oldest, dropped = self._parts.popitem(last=False)
                    self._locks.pop(oldest, None)
                    self._bytes -= dropped.nbytes
            return part
