"""Where pixels are: a grid is one immutable value, blocks cover each pixel once."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.crs import CRS
from rasterio.warp import transform as transform_points
from rasterio.windows import Window

from tscorr.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Block:
    """A rectangle of pixels: first row, first column, and how many of each."""

    row: int
    col: int
    height: int
    width: int

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.height, self.width

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the block in an array of the whole grid."""
        return slice(self.row, self.row + self.height), slice(self.col, self.col + self.width)

    @property
    def window(self) -> Window:
        """The same rectangle as rasterio reads and writes it."""
        return Window(self.col, self.row, self.width, self.height)

    def below(self, rows: int) -> "Block":
        """The block so many rows further down."""
        return Block(self.row + rows, self.col, self.height, self.width)

    def padded(self, margin: int) -> "Block":
        """The block with `margin` pixels more on every side; may reach beyond the grid."""
        return Block(self.row - margin, self.col - margin, self.height + 2 * margin, self.width + 2 * margin)


@dataclass(frozen=True, slots=True)
class Grid:
    """CRS, transform and shape (rows, cols) of a raster; `transform` maps corners (col, row) to (x, y)."""

    crs: CRS | None
    transform: Affine
    shape: tuple[int, int]

    @property
    def cell_size(self) -> tuple[float, float]:
        """Length of a pixel's side along a row and along a column. [units of the CRS]"""
        t = self.transform
        return float(np.hypot(t.a, t.d)), float(np.hypot(t.b, t.e))

    @property
    def is_north_up(self) -> bool:
        """Whether rows run west to east and columns north to south."""
        t = self.transform
        return t.b == 0 and t.d == 0 and t.a > 0 and t.e < 0

    @property
    def center(self) -> tuple[float, float]:
        """Map coordinates of the middle of the grid."""
        x, y = self.xy((self.shape[0] - 1) / 2, (self.shape[1] - 1) / 2)
        return float(x), float(y)

    def xy(self, row: Any, col: Any) -> tuple[Any, Any]:
        """Map coordinates of the centres of pixels (row, col); fractions and arrays are welcome."""
        t = self.transform
        c, r = np.asarray(col, dtype=float) + 0.5, np.asarray(row, dtype=float) + 0.5
        return t.a * c + t.b * r + t.c, t.d * c + t.e * r + t.f

    def rowcol(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Fractional (row, col) of map coordinates; the centre of pixel (0, 0) is (0.0, 0.0)."""
        inverse = ~self.transform
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        col = inverse.a * x + inverse.b * y + inverse.c - 0.5
        row = inverse.d * x + inverse.e * y + inverse.f - 0.5
        return row, col

    def corners(self) -> tuple[Array, Array]:
        """Map coordinates of the four outer corners, in the order of a ring."""
        rows, cols = self.shape
        return self.xy(np.array([0, 0, rows, rows]) - 0.5, np.array([0, cols, cols, 0]) - 0.5)

    def crop(self, block: Block) -> "Grid":
        """The grid of one block of this grid; the block may reach beyond it."""
        t = self.transform
        x, y = self.xy(block.row - 0.5, block.col - 0.5)
        return Grid(self.crs, Affine(t.a, t.b, float(x), t.d, t.e, float(y)), block.shape)


def blocks(shape: tuple[int, int], block_shape: tuple[int, int]) -> Iterator[Block]:
    """Blocks in row order that cover each pixel of `shape` (rows, cols) exactly once."""
    rows, cols = shape
    height, width = block_shape
    for row in range(0, rows, height):
        for col in range(0, cols, width):
            yield Block(row, col, min(height, rows - row), min(width, cols - col))


def longitude_latitude(grid: Grid, x: Any, y: Any) -> tuple[Array, Array]:
    """Longitude and latitude on WGS 84 of map coordinates. [deg]"""
    return reproject(require_crs(grid), CRS.from_epsg(4326), x, y)


def reproject(source: CRS, target: CRS, x: Any, y: Any) -> tuple[Array, Array]:
    """Map coordinates `x`, `y` (any equal shapes) of one CRS in another; x is always east or longitude.

    Raises InputError where a point has no place in the other CRS.
    """
    x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
    if source == target:
        return x.copy(), y.copy()
    try:
        new_x, new_y = transform_points(source, target, x.ravel(), y.ravel())
    except CPLE_BaseError as error:
        raise InputError(
            f"a point from x = {x.min():.1f}, y = {y.min():.1f} to x = {x.max():.1f}, y = {y.max():.1f} of "
            f"{source.to_string()} has no place in {target.to_string()}: {error}"
        ) from None
    return np.reshape(new_x, x.shape), np.reshape(new_y, y.shape)


def convergence_deg(grid: Grid, x: float, y: float) -> float:
    """Meridian convergence of the grid at a point. [deg]

    Positive where grid north lies east of true north, so that
    grid azimuth = true azimuth - convergence. From two points 100 m apart on the meridian.
    """
    return float(convergences_deg(grid, np.array([x]), np.array([y]))[0])


def convergences_deg(grid: Grid, x: Any, y: Any) -> Array:
    """Meridian convergence of the grid at points (any equal shapes), as `convergence_deg`. [deg]"""
    crs = require_crs(grid)
    longitude, latitude = longitude_latitude(grid, x, y)
    half_step = 0.00045  # degrees of latitude: 50 m
    north = np.stack([latitude - half_step, latitude + half_step])
    xs, ys = reproject(CRS.from_epsg(4326), crs, np.stack([longitude, longitude]), north)
    lost = ~np.isfinite(xs + ys).all(axis=0)
    if np.any(lost):
        x, y = np.asarray(x)[lost].flat[0], np.asarray(y)[lost].flat[0]
        raise InputError(f"the CRS {crs.to_string()} has no meridian at x = {x:.1f}, y = {y:.1f}")
    return -np.rad2deg(np.arctan2(xs[1] - xs[0], ys[1] - ys[0]))


def point_scales(grid: Grid) -> tuple[float, float]:
    """How many units of the grid a metre on the ground is, along x and along y, at the grid's centre.

    From two points 50 units away, on the ellipsoid WGS 84. 1.0000 +- 0.001 in UTM; 1 / cos(latitude) in Web Mercator.
    """
    x, y = grid.center
    step = 50.0
    longitude, latitude = longitude_latitude(grid, x + np.array([0.0, step, 0.0]), y + np.array([0.0, 0.0, step]))
    phi = np.deg2rad(latitude[0])
    bent = 1 - ECCENTRICITY2 * np.sin(phi) ** 2
    north = np.deg2rad(latitude[1:] - latitude[0]) * SEMI_MAJOR_M * (1 - ECCENTRICITY2) / bent**1.5
    east = np.deg2rad(longitude[1:] - longitude[0]) * SEMI_MAJOR_M * np.cos(phi) / np.sqrt(bent)
    with np.errstate(divide="ignore"):  # of a CRS in which both points are one
        along_x, along_y = step / np.hypot(east, north)
    return float(along_x), float(along_y)


SEMI_MAJOR_M, ECCENTRICITY2 = 6_378_137.0, 0.0066943799901413
"""of WGS 84"""
NORTH_NODES = 9


@dataclass(frozen=True, slots=True)
class North:
    """Where true north lies over a grid: convergence on a lattice of nodes, bilinear in between.

    nodes : (2, n, n), sine and cosine of the convergence, on nodes from corner to corner of the grid.
    Over 100 km of a UTM or national grid it errs by less than 1e-4 degrees; on a polar grid, 10 km wide and
    50 km from the pole, by less than 0.01.
    """

    nodes: Array
    shape: tuple[int, int]

    def turn(self, block: Block) -> Array:
        """Sine and cosine of the convergence over a block: (2, rows, cols)."""
        last = self.nodes.shape[1] - 1
        down = (np.arange(block.height) + block.row + 0.5) / self.shape[0] * last
        right = (np.arange(block.width) + block.col + 0.5) / self.shape[1] * last
        top, left = (np.clip(np.floor(place), 0, last - 1).astype(int) for place in (down, right))
        down, right = down - top, right - left
        rows = self.nodes[:, top] + down[:, None] * (self.nodes[:, top + 1] - self.nodes[:, top])
        return rows[:, :, left] + right * (rows[:, :, left + 1] - rows[:, :, left])

    def convergence_deg(self, block: Block) -> Array:
        """Meridian convergence over a block: (rows, cols). [deg]"""
        return np.rad2deg(np.arctan2(*self.turn(block)))


def north_of(grid: Grid) -> North:
    """Where true north lies over a grid; upwards where the grid has no CRS."""
    if grid.crs is None:
        convergence = np.zeros((2, 2))
    else:
        rows, cols = (np.linspace(-0.5, size - 0.5, NORTH_NODES) for size in grid.shape)
        convergence = np.deg2rad(convergences_deg(grid, *np.broadcast_arrays(*grid.xy(rows[:, None], cols[None, :]))))
    return North(np.stack([np.sin(convergence), np.cos(convergence)]), grid.shape)


def require_crs(grid: Grid) -> CRS:
    """The CRS of a grid, or an error that says what it is needed for."""
    if grid.crs is None:
        raise InputError("the image has no CRS: place and true north are unknown")
    return grid.crs
