"""What the header of a raster says, checked before a pixel is read."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import ColorInterp, Interleaving
from rasterio.warp import transform_bounds

from tscorr.errors import InputError
from tscorr.grid import Block, Grid, point_scales
from tscorr.rasters import envi
from tscorr.rasters.envi import PixelByPixel
from tscorr.rasters.sound import GDAL_ERRORS, check_sound, open_dataset

IMAGE_TYPES = ("uint8", "int16", "uint16", "float32")
TILE_BYTES = 8e6
"""what is stored together in new files at most"""
TILE_COLS = 512
ENVIRONMENT = {"GDAL_CACHEMAX": 32 << 20, "GDAL_NUM_THREADS": "1", "GDAL_VRT_ENABLE_PYTHON": "NO"}
"""options for GDAL; rasterio takes the size of its cache in bytes, whatever GDAL's manual says, and it is of the whole
process: where nobody sets it around the reading of many blocks, it grows to a twentieth of the machine's memory"""


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
    bad_bands: tuple[bool, ...] = ()
    """which bands the header marks as bad; empty where it marks none"""
    envi: Mapping[str, str] = field(default_factory=dict)
    """the header of an ENVI file, as GDAL gives it"""
    files: tuple[Path, ...] = ()
    """the raster, and what GDAL reads beside it: header, overviews, mask, world file"""
    ours: bool = False
    """written by this program: may be a VRT"""
    driver: str = ""
    """GDAL's name of the format"""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.grid.shape

    @property
    def pixel_by_pixel(self) -> PixelByPixel | None:
        """How to read an ENVI file that holds all bands of a pixel together; None for any other."""
        return PixelByPixel.of(self.path, self.envi, self.dtype, (*self.shape, self.bands))

    def crop(self, block: Block) -> "RasterInfo":
        """The header that a raster of one block of this one has."""
        return replace(self, grid=self.grid.crop(block))

    @property
    def written_tile(self) -> tuple[int, int]:
        """(rows, cols) that are stored together in a GeoTIFF like this one."""
        return self.profile["blockysize"], self.profile.get("blockxsize", self.shape[1])


_entered = threading.local()


@contextmanager
def environment() -> Iterator[None]:
    """GDAL's options, while files are read and written.

    Held around the work on many files it makes each of them cheaper to open: within another one of the same thread
    nothing is to be done. Where the main thread holds it, the threads that it waits for find the same size of cache.
    """
    if getattr(_entered, "here", False):
        yield
        return
    with rasterio.Env(**ENVIRONMENT):
        _entered.here = True
        try:
            yield
        finally:
            _entered.here = False


@contextmanager
def opened(path: Path, *, ours: bool = False) -> Iterator[Any]:
    """A dataset open for reading; InputError names the file where GDAL cannot."""
    try:
        with environment(), open_dataset(path, ours=ours) as dataset:
            yield dataset
    except GDAL_ERRORS as error:
        raise InputError(f"{path} cannot be read: {reason_of(error, path)}") from None


def describe(path: str | Path, *, ours: bool = False, draws_on: Sequence[Path] = ()) -> RasterInfo:
    """The header of a raster, checked before a pixel is read.

    ours     : a result of this program, which may be a VRT.
    draws_on : files elsewhere that it may draw on.
    Raises InputError where the file is missing, is no raster, or declares what no honest file does.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist")
    if not path.is_file():
        raise InputError(f"{path} is no file; allowed is a raster")
    with opened(path, ours=ours) as dataset:
        check_sound(dataset, path, draws_on)
        return info_of(dataset, path, ours=ours)


def info_of(dataset: Any, path: Path, *, ours: bool) -> RasterInfo:
    """What the header of an open dataset says; see `describe`."""
    dtype = np.dtype(dataset.dtypes[0])
    rows, cols = dataset.block_shapes[0]
    fields = dataset.tags(ns="ENVI") if dataset.driver == "ENVI" else {}
    wavelengths, widths = _wavelengths(dataset, fields)
    return RasterInfo(
        path=path,
        grid=Grid(dataset.crs, dataset.transform, dataset.shape),
        bands=dataset.count,
        dtype=dtype,
        nodata=dataset.nodata if can_hold(dtype, dataset.nodata) else None,
        scales=_scales(dataset, fields),
        offsets=tuple(dataset.offsets),
        names=_names(dataset, fields),
        wavelengths_um=wavelengths,
        fwhm_um=widths,
        tile=(rows, cols),
        profile=_profile(dataset),
        tags=dataset.tags(),
        band_tags=_band_tags(dataset, wavelengths if fields else None, widths if fields else None),
        colors=tuple(dataset.colorinterp),
        bad_bands=envi.bad_bands(fields, dataset.count, path),
        envi=fields,
        files=(path, *(Path(file) for file in dataset.files[1:])),
        ours=ours,
        driver=dataset.driver,
    )


def can_hold(dtype: np.dtype[Any], value: float | None) -> bool:
    """Whether a pixel of this type can have the value."""
    if value is None:
        return False
    if dtype.kind in "iu":
        return float(value).is_integer() and np.iinfo(dtype).min <= value <= np.iinfo(dtype).max
    return not np.isfinite(value) or abs(value) <= float(np.finfo(dtype).max)


def tile_side(pixel_bytes: int) -> int:
    """Side of a square tile whose pixels are so large: 512, or less where many bands stand together."""
    side = int((TILE_BYTES / pixel_bytes) ** 0.5)
    return min(512, max(64, side // 16 * 16))


def tile_rows(pixel_bytes: int) -> int:
    """Rows of a tile of TILE_COLS that a block of all bands can be cut into: less of them where there are many bands.

    Wide and low, since files that are no GeoTIFF hold whole lines together.
    """
    return min(512, max(16, int(TILE_BYTES / pixel_bytes / TILE_COLS) // 16 * 16))


def _profile(dataset: Any) -> dict[str, Any]:
    """Tiling, interleave and codec of a GeoTIFF; a tiled one with a fast codec for other formats."""
    structure = dataset.tags(ns="IMAGE_STRUCTURE")
    rows, cols = dataset.block_shapes[0]
    profile: dict[str, Any] = {"interleave": "pixel" if dataset.interleaving == Interleaving.pixel else "band"}
    if dataset.driver != "GTiff":
        rows = tile_rows(dataset.count * np.dtype(dataset.dtypes[0]).itemsize)
        return {**profile, "tiled": True, "blockxsize": TILE_COLS, "blockysize": rows, "compress": "zstd"}
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


def _names(dataset: Any, fields: Mapping[str, str]) -> tuple[str, ...]:
    """Names of the bands; those of an ENVI header without the wavelengths that GDAL appends."""
    try:
        given = envi.items(fields, "band_names", dataset.count) or dataset.descriptions
    except UnicodeDecodeError:  # then numbers must do
        given = (None,) * dataset.count
    return tuple(name or f"band {i}" for i, name in enumerate(given, start=1))


def _scales(dataset: Any, fields: Mapping[str, str]) -> tuple[float, ...]:
    """Scale of each band; GDAL knows nothing of ENVI's reflectance scale factor."""
    scale = envi.reflectance_scale(fields)
    if scale is not None and all(value == 1 for value in dataset.scales):
        return (scale,) * int(dataset.count)
    return tuple(dataset.scales)


def _band_tags(
    dataset: Any, wavelengths_um: tuple[float, ...] | None, fwhm_um: tuple[float, ...] | None
) -> tuple[dict[str, dict[str, str]], ...]:
    """Tags of each band by domain; with the given wavelengths instead of those that GDAL has rounded.

    Without the statistics that GDAL and QGIS leave there: those of a result would be others.
    """
    tags = tuple({ns: dataset.tags(i, ns=ns) for ns in ("", "IMAGERY")} for i in dataset.indexes)
    for band in tags:
        band[""] = {key: value for key, value in band[""].items() if not key.startswith("STATISTICS_")}
    for key, values in (("CENTRAL_WAVELENGTH_UM", wavelengths_um), ("FWHM_UM", fwhm_um)):
        for band, value in zip(tags, values or (), strict=False):
            band["IMAGERY"][key] = str(value)
    return tags


def _wavelengths(dataset: Any, fields: Mapping[str, str]) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Band centres and widths [um] from an ENVI header, the IMAGERY domain, or ENVI style tags of the bands."""
    unit = fields.get("wavelength_units", "")
    centres, widths = (
        [_length_um(text, unit) for text in envi.items(fields, key, dataset.count) or ()]
        for key in ("wavelength", "fwhm")
    )
    if not centres:
        for index in dataset.indexes:
            imagery, plain = dataset.tags(index, ns="IMAGERY"), dataset.tags(index)
            centres.append(_length_um(imagery.get("CENTRAL_WAVELENGTH_UM"), "um"))
            if centres[-1] is None:
                centres[-1] = _length_um(plain.get("wavelength"), plain.get("wavelength_units", ""))
            widths.append(_length_um(imagery.get("FWHM_UM"), "um"))
    complete = all(value is not None for value in centres)
    with_widths = complete and len(widths) > 0 and all(value is not None for value in widths)
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
        west, south, east, north = _bounds_over(raster.grid, image.grid)
    except Exception as error:  # noqa: BLE001 - rasterio raises PROJ's errors unwrapped
        raise InputError(
            f"{what} {raster.path} is in a CRS that cannot be turned into that of the image {image.path}: "
            f"{str(error).splitlines()[0][:200]}"
        ) from None
    left, bottom, right, top = _bounds(image.grid)
    if not (west < right and east > left and south < top and north > bottom):
        digits = 4 if image.grid.crs.is_geographic else 0
        raise InputError(
            f"{what} {raster.path} covers x {west:.{digits}f} to {east:.{digits}f}, y {south:.{digits}f} to "
            f"{north:.{digits}f}; it does not overlap the image {image.path}, x {left:.{digits}f} to "
            f"{right:.{digits}f}, y {bottom:.{digits}f} to {top:.{digits}f}"
        )


def covered_share(raster: RasterInfo, image: RasterInfo) -> float:
    """Which part of the image's extent lies within that of a raster that passed `check_overlap`."""
    if raster.grid == image.grid or raster.grid.crs is None:
        return 1.0
    west, south, east, north = _bounds_over(raster.grid, image.grid)
    left, bottom, right, top = _bounds(image.grid)
    width, height = min(east, right) - max(west, left), min(north, top) - max(south, bottom)
    area = (right - left) * (top - bottom)
    return max(width, 0.0) * max(height, 0.0) / area if area > 0 else 1.0


def _bounds_over(grid: Grid, image: Grid) -> tuple[float, float, float, float]:
    """West, south, east and north of a grid in the CRS of the image's."""
    with rasterio.Env():
        west, south, east, north = transform_bounds(grid.crs, image.crs, *_bounds(grid))
    return west, south, east, north


def check_metric(raster: RasterInfo, what: str) -> None:
    """Raise InputError unless the CRS is projected, in metres, as heights are."""
    crs = raster.grid.crs
    if crs is None:
        raise InputError(f"{what} {raster.path} has no CRS; allowed is a projected CRS in metres")
    if crs.is_geographic or crs.linear_units_factor[1] != 1.0:
        unit = "degrees" if crs.is_geographic else crs.linear_units
        raise InputError(f"{what} {raster.path} is in {unit}; allowed is a projected CRS in metres")


TRUE_TO = 0.05
"""of lengths; 0.001 in UTM and national grids, 0.03 in those of continents, 0.5 in Web Mercator at 48 degrees"""


def check_true_lengths(image: RasterInfo, why: str) -> None:
    """Raise InputError unless a metre of the image's CRS is a metre on the ground; `why` says what needs that."""
    check_metric(image, f"{why} the image")
    for scale in point_scales(image.grid):
        if not abs(scale - 1) <= TRUE_TO:
            raise InputError(
                f"{why} the image {image.path} is in {str(image.grid.crs).split('[')[0]}, where a metre on the "
                f"ground is {scale:.3f}; allowed is a projected CRS whose metres are true to 5 %, such as UTM"
            )


def _bounds(grid: Grid) -> tuple[float, float, float, float]:
    xs, ys = grid.corners()
    return float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())


def reason_of(error: Exception, path: Path) -> str:
    """GDAL's message without the path that stands before it anyway."""
    text = str(error.__cause__ or error)
    return text.replace(f"{path}: ", "").replace(f"'{path}' ", "").strip()
