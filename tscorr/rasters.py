"""Rasters on disk: open and check, align on the fly, read a block, write a block.

GDAL never applies scale and offset; neither does anything here: blocks hold stored values.
"""

import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Interleaving, Resampling
from rasterio.errors import RasterioError
from rasterio.shutil import copy as copy_raster
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_bounds

from tscorr.errors import InputError, OutputError
from tscorr.grid import Block, Grid

Array = NDArray[Any]

DRIVERS = ["GTiff", "ENVI", "HFA", "JP2OpenJPEG", "PNG", "JPEG", "AAIGrid", "EHdr"]
"""formats that are opened; a VRT from an unknown hand may name any file of the machine"""
LARGEST_TILE_BYTES = 256e6
MISALIGNED_PIXELS = 0.01
"""pixels of two grids that are off by less than this coincide"""
COG_TILE = 512
IMAGE_TYPES = ("uint8", "int16", "uint16", "float32")
ENVIRONMENT = {"GDAL_CACHEMAX": 64, "GDAL_NUM_THREADS": "1"}


@dataclass(frozen=True, slots=True)
class RasterInfo:
    """What the header of a raster says. Tuples hold one value a band."""

    path: Path
    grid: Grid
    bands: int
    dtype: np.dtype[Any]
    nodata: float | None
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    names: tuple[str, ...]
    wavelengths_um: tuple[float, ...] | None
    fwhm_um: tuple[float, ...] | None
    tile: tuple[int, int]
    """(rows, cols) that are stored together"""
    profile: dict[str, Any]
    """creation options with which a GeoTIFF like this one is written"""
    tags: dict[str, str]
    band_tags: tuple[dict[str, dict[str, str]], ...]
    """for each band, tags by domain ('' and 'IMAGERY')"""
    colors: tuple[ColorInterp, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.grid.shape


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A dataset open for reading; InputError names the file where GDAL cannot."""
    try:
        with rasterio.Env(**ENVIRONMENT), rasterio.open(path, sharing=False) as dataset:
            if dataset.driver not in DRIVERS:
                allowed = ", ".join(DRIVERS)
                raise InputError(f"{path} is in the format {dataset.driver}; allowed are {allowed}")
            yield dataset
    except RasterioError as error:
        raise InputError(f"{path} cannot be read: {_reason(error, path)}") from None


def describe(path: str | Path) -> RasterInfo:
    """The header of a raster, checked before a pixel is read.

    Raises InputError where the file is missing, is no raster, or declares tiles that no honest file has.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist")
    with opened(path) as dataset:
        dtypes = set(dataset.dtypes)
        if dataset.count < 1 or len(dtypes) != 1:
            raise InputError(f"{path} has bands of the types {sorted(dtypes)}; allowed is one type")
        dtype = np.dtype(dtypes.pop())
        rows, cols = dataset.block_shapes[0]
        at_once = rows * cols * dtype.itemsize
        at_once *= dataset.count if dataset.interleaving == Interleaving.pixel else 1
        if at_once > LARGEST_TILE_BYTES:
            raise InputError(
                f"{path} is stored in tiles of {rows} x {cols} pixels, {at_once / 1e6:.0f} MB each; "
                f"allowed are {LARGEST_TILE_BYTES / 1e6:.0f} MB"
            )
        wavelengths, widths = _wavelengths(dataset)
        return RasterInfo(
            path=path,
            grid=Grid(dataset.crs, dataset.transform, dataset.shape),
            bands=dataset.count,
            dtype=dtype,
            nodata=dataset.nodata if can_hold(dtype, dataset.nodata) else None,
            scales=tuple(dataset.scales),
            offsets=tuple(dataset.offsets),
            names=tuple(name or f"band {i + 1}" for i, name in enumerate(dataset.descriptions)),
            wavelengths_um=wavelengths,
            fwhm_um=widths,
            tile=(rows, cols),
            profile=_profile(dataset),
            tags=dataset.tags(),
            band_tags=tuple({ns: dataset.tags(i, ns=ns) for ns in ("", "IMAGERY")} for i in dataset.indexes),
            colors=tuple(dataset.colorinterp),
        )


def can_hold(dtype: np.dtype[Any], value: float | None) -> bool:
    """Whether a pixel of this type can have the value."""
    if value is None:
        return False
    if dtype.kind in "iu":
        return float(value).is_integer() and np.iinfo(dtype).min <= value <= np.iinfo(dtype).max
    return not np.isfinite(value) or abs(value) <= float(np.finfo(dtype).max)


def _profile(dataset: Any) -> dict[str, Any]:
    """Tiling, interleave and codec of a GeoTIFF; a tiled one with a fast codec for other formats."""
    structure = dataset.tags(ns="IMAGE_STRUCTURE")
    rows, cols = dataset.block_shapes[0]
    profile: dict[str, Any] = {"interleave": "pixel" if dataset.interleaving == Interleaving.pixel else "band"}
    if dataset.driver != "GTiff":
        return {**profile, "tiled": True, "blockxsize": 512, "blockysize": 512, "compress": "zstd"}
    if cols < dataset.width or rows % 16 == 0 == cols % 16:
        profile |= {"tiled": True, "blockxsize": cols, "blockysize": rows}
    else:
        profile |= {"tiled": False, "blockysize": rows}
    codec = structure.get("COMPRESSION", "NONE").lower()
    lossless = {"deflate", "lzw", "zstd", "packbits", "lzma", "none"}
    profile["compress"] = codec if codec in lossless else "deflate"
    if "PREDICTOR" in structure:
        profile["predictor"] = int(structure["PREDICTOR"])
    return profile


def _wavelengths(dataset: Any) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Band centres and widths [um] from the IMAGERY domain, or from the ENVI style tags of the bands."""
    centres, widths = [], []
    for index in dataset.indexes:
        imagery, plain = dataset.tags(index, ns="IMAGERY"), dataset.tags(index)
        centres.append(_length_um(imagery.get("CENTRAL_WAVELENGTH_UM"), "um"))
        if centres[-1] is None:
            centres[-1] = _length_um(plain.get("wavelength"), plain.get("wavelength_units", ""))
        widths.append(_length_um(imagery.get("FWHM_UM"), "um"))
    complete = all(value is not None for value in centres)
    with_widths = complete and all(value is not None for value in widths)
    return (tuple(centres) if complete else None, tuple(widths) if with_widths else None)  # type: ignore[arg-type]


def _length_um(text: str | None, unit: str) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    factors = {
        "um": 1.0,
        "micrometers": 1.0,
        "micrometer": 1.0,
        "nm": 1e-3,
        "nanometers": 1e-3,
        "nanometer": 1e-3,
    }
    return value * factors.get(unit.strip().lower(), 1e-3 if value > 100 else 1.0)


def check_overlap(raster: RasterInfo, image: RasterInfo, what: str) -> None:
    """Raise InputError unless a raster has a CRS and shares ground with the image."""
    if image.grid.crs is None:
        raise InputError(f"the image {image.path} has no CRS; {what} {raster.path} cannot be laid over it")
    if raster.grid.crs is None:
        raise InputError(f"{what} {raster.path} has no CRS; it must say where it is")
    try:
        with rasterio.Env():
            west, south, east, north = transform_bounds(raster.grid.crs, image.grid.crs, *_bounds(raster.grid))
    except Exception as error:  # noqa: BLE001 - rasterio raises PROJ's errors unwrapped
        raise InputError(
            f"{what} {raster.path} is in a CRS that cannot be turned into that of the image {image.path}: "
            f"{str(error).splitlines()[0][:200]}"
        ) from None
    left, bottom, right, top = _bounds(image.grid)
    if not (west < right and east > left and south < top and north > bottom):
        raise InputError(
            f"{what} {raster.path} covers x {west:.0f} to {east:.0f}, y {south:.0f} to {north:.0f}; it does not "
            f"overlap the image {image.path}, x {left:.0f} to {right:.0f}, y {bottom:.0f} to {top:.0f}"
        )


def check_metric(raster: RasterInfo, what: str) -> None:
    """Raise InputError unless the CRS is projected, in metres: slopes and shadows need true lengths."""
    crs = raster.grid.crs
    if crs is None:
        raise InputError(f"{what} {raster.path} has no CRS; allowed is a projected CRS in metres")
    if crs.is_geographic or crs.linear_units_factor[1] != 1.0:
        unit = "degrees" if crs.is_geographic else crs.linear_units
        raise InputError(f"{what} {raster.path} is in {unit}; allowed is a projected CRS in metres")


def _bounds(grid: Grid) -> tuple[float, float, float, float]:
    xs, ys = grid.corners()
    return float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())


class Reader:
    """Blocks of a raster, or of a raster laid over another grid; any thread may read.

    grid       : the grid that blocks are of; None for the raster's own.
    resampling : how values are found on another grid.
    fill       : value outside the raster, and of nodata where `fill` is nan.
    margin     : pixels beyond the grid that a block may reach.
    """

    def __init__(
        self,
        info: RasterInfo,
        grid: Grid | None = None,
        *,
        resampling: Resampling = Resampling.nearest,
        fill: float = 0,
        margin: int = 0,
    ) -> None:
        self.info = info
        self._grid = grid or info.grid
        self._resampling = resampling
        self._fill = fill
        self._margin = margin
        shift = _pixel_shift(info.grid, self._grid)
        self._aligned = shift is not None
        self._shift = shift if shift is not None else (margin, margin)
        self._local = threading.local()
        self._handles: list[Any] = []
        self._lock = threading.Lock()

    def read(self, block: Block, bands: int | None = None) -> Array:
        """Stored values of a block: (bands, rows, cols), or (rows, cols) of one band."""
        try:
            return self._read(block, bands)
        except RasterioError as error:
            place = f"rows {block.row} to {block.row + block.height}, columns {block.col} to {block.col + block.width}"
            raise InputError(f"{self.info.path} cannot be read at {place}: {_reason(error, self.info.path)}") from None

    def _read(self, block: Block, bands: int | None) -> Array:
        dataset = self._dataset()
        row, col = block.row + self._shift[0], block.col + self._shift[1]
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + block.height, dataset.height), min(col + block.width, dataset.width)
        inside = Block(top, left, bottom - top, right - left)
        whole = inside.shape == block.shape
        if whole:
            values = dataset.read(bands, window=inside.window)
        else:
            leading = () if bands is not None else (self.info.bands,)
            values = np.full((*leading, *block.shape), self._fill, self._out_type())
            if inside.height > 0 and inside.width > 0:
                rows, cols = slice(top - row, bottom - row), slice(left - col, right - col)
                values[..., rows, cols] = dataset.read(bands, window=inside.window)
        if np.isnan(self._fill):
            values = values.astype(np.float32, copy=False)
            values[~np.isfinite(values)] = np.nan
            if self.info.nodata is not None:
                values[values == np.float32(self.info.nodata)] = np.nan
        return values

    def _out_type(self) -> np.dtype[Any]:
        return np.dtype(np.float32) if np.isnan(self._fill) else self.info.dtype

    def _dataset(self) -> Any:
        """The handle of the calling thread."""
        if not hasattr(self._local, "dataset"):
            with rasterio.Env(**ENVIRONMENT):
                source = rasterio.open(self.info.path, sharing=False)
                dataset = source if self._aligned else self._warped(source)
            with self._lock:
                self._handles += [dataset] if dataset is source else [dataset, source]
            self._local.dataset = dataset
        return self._local.dataset

    def _warped(self, source: Any) -> Any:
        rows, cols = self._grid.shape
        grid = self._grid.crop(Block(0, 0, rows, cols).padded(self._margin))
        nodata = self.info.nodata if self.info.nodata is not None else self._fill
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


def read_decimated(info: RasterInfo, max_size: int, bands: Sequence[int] | None = None) -> Array:
    """Stored values of a raster (bands, rows, cols), float32, no side longer than `max_size`.

    Averages; nan where nodata or an infinite value is among them; overviews are used where the file has them.
    """
    rows, cols = info.shape
    step = max(1.0, max(rows, cols) / max_size)
    shape = max(1, round(rows / step)), max(1, round(cols / step))
    indexes = list(bands or range(1, info.bands + 1))
    with opened(info.path) as dataset:
        values = dataset.read(indexes, out_shape=(len(indexes), *shape), resampling=Resampling.average, masked=True)
    filled = np.ma.filled(values.astype(np.float32), np.nan)
    filled[~np.isfinite(filled)] = np.nan
    return filled


def read_decimated_flags(info: RasterInfo, max_size: int) -> Array:
    """A flag layer on the pixels of `read_decimated`: (rows, cols), the nearest value."""
    rows, cols = info.shape
    step = max(1.0, max(rows, cols) / max_size)
    with opened(info.path) as dataset:
        return dataset.read(1, out_shape=(max(1, round(rows / step)), max(1, round(cols / step))))


def _reason(error: Exception, path: Path) -> str:
    """GDAL's message without the path that stands before it anyway."""
    text = str(error.__cause__ or error)
    return text.replace(f"{path}: ", "").replace(f"'{path}' ", "").strip()
