"""Rasters written block by block, and read again before they count as written."""

import threading
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.shutil import copy as copy_raster

from tscorr.errors import OutputError
from tscorr.grid import Block
from tscorr.rasters.header import ENVIRONMENT, RasterInfo

Array = NDArray[Any]

COG_TILE = 512


class Writer:
    """One raster being written; any thread may write, each block once.

    `close` reads every block again and compares it with what was written: GDAL's threads hide a full disk.
    """

    def __init__(self, path: Path, profile: dict[str, Any], like: RasterInfo, layer: "Layer") -> None:
        self.path = path
        self._lock = threading.Lock()
        self._written: dict[Block, int] = {}
        bands = len(layer.names)
        rows, cols = like.shape
        options = {
            **profile,
            "driver": "GTiff",
            "height": rows,
            "width": cols,
            "count": bands,
            "dtype": layer.dtype,
            "crs": like.grid.crs,
            "transform": like.grid.transform,
            "nodata": layer.nodata,
            "bigtiff": "if_safer",
            "num_threads": "all_cpus",
        }
        try:
            with rasterio.Env(**ENVIRONMENT):
                self._dataset = rasterio.open(path, "w", **_fitting_predictor(options, np.dtype(layer.dtype)))
                self._describe(layer, like)
        except RasterioError as error:
            raise OutputError(f"{path} cannot be written: {error}") from None

    def _describe(self, layer: "Layer", like: RasterInfo) -> None:
        dataset = self._dataset
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

    def write(self, block: Block, values: Array) -> None:
        """Write a block (bands, rows, cols)."""
        values = np.ascontiguousarray(values)
        try:
            with self._lock:
                self._dataset.write(values, window=block.window)
                self._written[block] = zlib.crc32(values.data)
        except RasterioError as error:
            raise OutputError(f"{self.path} cannot be written: {error}") from None

    def abandon(self) -> None:
        """Close without a check; what was written will be deleted."""
        with self._lock, suppress(RasterioError):
            self._dataset.close()

    def close(self) -> None:
        """Close, and raise OutputError unless every block reads back as it was written."""
        try:
            with self._lock:
                self._dataset.close()
            with rasterio.Env(**ENVIRONMENT), rasterio.open(self.path, sharing=False) as dataset:
                for block, checksum in self._written.items():
                    if zlib.crc32(dataset.read(window=block.window).data) != checksum:
                        raise OutputError(f"{self.path} does not read back as written at {block}; is the disk full?")
        except RasterioError as error:
            raise OutputError(f"{self.path} does not read back as written: {error}; is the disk full?") from None


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
    tags: Mapping[str, str] = field(default_factory=dict)


def _fitting_predictor(options: dict[str, Any], dtype: np.dtype[Any]) -> dict[str, Any]:
    """Creation options that suit the type: predictor 3 is for floating point, 2 for integers."""
    options = dict(options)
    compressed = options.get("compress") in {"deflate", "lzw", "zstd"}
    if not compressed or options.get("predictor", 1) == 1:
        options.pop("predictor", None)
    else:
        options["predictor"] = 2 if dtype.kind in "iu" else 3
    if options.get("compress") == "zstd":
        options["zstd_level"] = 1
    return options


def make_cog(path: Path, resampling: Resampling) -> None:
    """Turn a GeoTIFF into a cloud-optimised one, with overviews of half, a quarter, ... down to one tile."""
    hidden = path.with_name(f".{path.name}.cog")
    try:
        with rasterio.Env(**ENVIRONMENT):
            with rasterio.open(path, "r+") as dataset:
                profile, longest = dataset.profile, max(dataset.shape)
                levels = [2**i for i in range(1, 16) if longest // 2 ** (i - 1) > COG_TILE]
                dataset.build_overviews(levels, resampling)
            options = {"blocksize": COG_TILE, "overviews": "FORCE_USE_EXISTING" if levels else "NONE"}
            options["compress"] = profile.get("compress", "none")
            options["predictor"] = "YES" if options["compress"] in {"deflate", "lzw", "zstd"} else "NO"
            copy_raster(path, hidden, driver="COG", **options)
        hidden.replace(path)
    except RasterioError as error:
        raise OutputError(f"{path} cannot be made a cloud-optimised GeoTIFF: {error}") from None
