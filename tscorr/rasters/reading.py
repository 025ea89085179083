"""Blocks of a raster, or of a raster laid over another grid."""

import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from tscorr.errors import InputError
from tscorr.grid import Block, Grid
from tscorr.rasters.decoding import Decoder, is_worth_it
from tscorr.rasters.header import RasterInfo, environment, opened, reason_of
from tscorr.rasters.sound import GDAL_ERRORS, open_dataset

Array = NDArray[Any]

MISALIGNED_PIXELS = 0.01
"""pixels of two grids that are off by less than this coincide"""


class Reader:
    """Blocks of a raster, or of a raster laid over another grid; any thread may read.

    grid       : the grid that blocks are of; None for the raster's own.
    resampling : how values are found on another grid.
    fill       : value outside the raster, and of nodata where `fill` is nan.
    margin     : pixels beyond the grid that a block may reach.
    scaled     : values are those that the file's scale and offset make of the stored ones; `fill` is nan then.
    """

    def __init__(
        self,
        info: RasterInfo,
        grid: Grid | None = None,
        *,
        resampling: Resampling = Resampling.nearest,
        fill: float = 0,
        margin: int = 0,
        scaled: bool = False,
    ) -> None:
        self.info = info
        self._grid = grid or info.grid
        self._resampling = resampling
        self.fill = fill
        self._margin = margin
        scale, offset = info.scales[0], info.offsets[0]
        self._meaning = (np.float32(scale), np.float32(offset)) if scaled and (scale, offset) != (1, 0) else None
        shift = _pixel_shift(info.grid, self._grid)
        self._aligned = shift is not None
        self.shift = shift if shift is not None else (margin, margin)
        """rows and columns from the first pixel that is stored to the first of the grid"""
        self.tile = info.tile if self._aligned else (1, 1)
        """(rows, cols) that are decoded together"""
        self._local = threading.local()
        self._handles: list[Any] = []
        self._known_decoder: Decoder | None = None
        self._looked_for_decoder = False
        self._lock = threading.Lock()

    def read(self, block: Block, bands: int | Sequence[int] | None = None) -> Array:
        """Values of a block: (bands, rows, cols) of all or some bands, or (rows, cols) of one; from 1 on."""
        try:
            with np.errstate(over="ignore"):  # what float32 cannot hold is no number
                return self._read(block, bands)
        except GDAL_ERRORS as error:
            place = f"rows {block.row} to {block.row + block.height}, columns {block.col} to {block.col + block.width}"
            raise InputError(
                f"{self.info.path} cannot be read at {place}: {reason_of(error, self.info.path)}"
            ) from None

    def _read(self, block: Block, bands: int | Sequence[int] | None) -> Array:
        dataset = self._dataset()
        row, col = block.row + self.shift[0], block.col + self.shift[1]
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + block.height, dataset.height), min(col + block.width, dataset.width)
        inside = Block(top, left, bottom - top, right - left)
        whole = inside.shape == block.shape
        if whole:
            values = self._pixels(dataset, inside, bands)
        else:
            leading = () if isinstance(bands, int) else (self.info.bands if bands is None else len(bands),)
            values = np.full((*leading, *block.shape), self.fill, self._out_type())
            if inside.height > 0 and inside.width > 0:
                rows, cols = slice(top - row, bottom - row), slice(left - col, right - col)
                values[..., rows, cols] = self._pixels(dataset, inside, bands)
        if np.isnan(self.fill):
            values = values.astype(np.float32, copy=False)
            void = ~np.isfinite(values)
            if self.info.nodata is not None:
                void |= values == np.float32(self.info.nodata)
            if void.any():
                values[void] = np.nan
            if self._meaning is not None:
                scale, offset = self._meaning
                values = values * scale + offset
        return values

    def _pixels(self, dataset: Any, inside: Block, bands: int | Sequence[int] | None) -> Array:
        """Stored values of a block that lies inside the raster."""
        if self._aligned and is_worth_it(self.info, inside):
            decode = self._decoder()
            if decode is not None and (values := decode(inside, bands)) is not None:
                return values
        pixels = self.info.pixel_by_pixel if self._aligned and not isinstance(bands, int) else None
        if pixels is None:
            return dataset.read(bands, window=inside.window)
        values = pixels.read(inside)
        return values if bands is None else values[np.array(bands) - 1]

    def _decoder(self) -> Decoder | None:
        """What decodes blocks without GDAL; None where GDAL is to do it."""
        with self._lock:
            if not self._looked_for_decoder:
                self._looked_for_decoder = True
                with suppress(OSError, ValueError):
                    self._known_decoder = Decoder(self.info)
            return self._known_decoder

    def _out_type(self) -> np.dtype[Any]:
        return np.dtype(np.float32) if np.isnan(self.fill) else self.info.dtype

    def _dataset(self) -> Any:
        """The handle of the calling thread."""
        if not hasattr(self._local, "dataset"):
            with environment():
                source = open_dataset(self.info.path, ours=self.info.ours)
                dataset = source if self._aligned else self._warped(source)
            with self._lock:
                self._handles += [dataset] if dataset is source else [dataset, source]
            self._local.dataset = dataset
        return self._local.dataset

    def _warped(self, source: Any) -> Any:
        rows, cols = self._grid.shape
        grid = self._grid.crop(Block(0, 0, rows, cols).padded(self._margin))
        nodata = self.info.nodata if self.info.nodata is not None else self.fill
        # Where its cells are slightly smaller than those of the grid, GDAL widens its bilinear kernel by as
        # little, and unevenly: heights then err by a tenth of a cell times the slope.
        similar = min(self.info.grid.cell_size) > 0.5 * max(grid.cell_size)
        exactly_bilinear = {"XSCALE": 1, "YSCALE": 1} if similar else {}
        return WarpedVRT(
            source,
            crs=grid.crs,
            transform=grid.transform,
            height=grid.shape[0],
            width=grid.shape[1],
            resampling=self._resampling,
            nodata=nodata,
            warp_mem_limit=64,
            **exactly_bilinear,
        )

    def close(self) -> None:
        """Close the handles of all threads."""
        with self._lock:
            for handle in self._handles:
                handle.close()
            self._handles.clear()
            if self._known_decoder is not None:
                self._known_decoder.close()
            self._known_decoder, self._looked_for_decoder = None, False
            self._local = threading.local()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _pixel_shift(raster: Grid, grid: Grid) -> tuple[int, int] | None:
    """Rows and columns from the raster's first pixel to the grid's, or None where pixels do not coincide."""
    if raster.crs != grid.crs:
        return None
    a, b = raster.transform, grid.transform
    rows, cols = grid.shape
    corner_a, corner_b = raster.rowcol(*grid.xy(0, 0)), raster.rowcol(*grid.xy(rows - 1, cols - 1))
    shift = round(float(corner_a[0])), round(float(corner_a[1]))
    drift = (
        np.abs(np.subtract(corner_a, shift)).max(),
        np.abs(np.subtract(corner_b, (shift[0] + rows - 1, shift[1] + cols - 1))).max(),
    )
    same_axes = np.allclose([a.a, a.b, a.d, a.e], [b.a, b.b, b.d, b.e], rtol=1e-6, atol=1e-12)
    return shift if same_axes and max(drift) < MISALIGNED_PIXELS else None


def read_samples(info: RasterInfo, most: int, side: int) -> Array:
    """Values of band 1 that are spread over a raster, float32 (pixels,), those that are not finite or nodata left out.

    All of them where it is small; else of most x most windows of side x side pixels, each in one tile if that holds
    it, so that few tiles are decoded.
    """
    axes = [
        [(0, length)]
        if length <= most * side
        else [(_in_tile(round((length - side) * i / (most - 1)), side, tile), side) for i in range(most)]
        for length, tile in zip(info.shape, info.tile, strict=True)
    ]
    with Reader(info, fill=float("nan"), scaled=True) as reader:
        windows = [Block(row, col, height, width) for row, height in axes[0] for col, width in axes[1]]
        values = np.concatenate([reader.read(window, 1).ravel() for window in windows])
    return values[np.isfinite(values)]


def middle_value(info: RasterInfo, side: int, nodata: float | None, band: int = 1) -> float:
    """Median of a band over side x side pixels in the middle of a raster, without `nodata`; nan of none."""
    rows, cols = info.shape
    part = Block(max(0, (rows - side) // 2), max(0, (cols - side) // 2), min(side, rows), min(side, cols))
    with opened(info.path, ours=info.ours) as dataset:
        values = dataset.read(band, window=part.window)
    values = values[np.isfinite(values) & (values != nodata)]
    return float(np.median(values)) if values.size else float("nan")


def _in_tile(first: int, side: int, tile: int) -> int:
    """The first pixel of a run of `side`, moved back so that the run does not leave its tile."""
    return min(first, max(first // tile * tile, (first // tile + 1) * tile - side)) if side <= tile else first
