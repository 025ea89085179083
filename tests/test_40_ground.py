"""What stands around hides and shades, also beyond the image and across blocks; lengths must be true for it."""

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS
from small_scene import CELL, NORTH, WEST, read_raster, write_config, write_raster

from tscorr.batch import run
from tscorr.correction import PixelFlag
from tscorr.errors import InputError
from tscorr.grid import Grid, longitude_latitude, point_scales

TILE_CLASS = 1
STEEP_DEG = 60.0


def flags_of(folder, heights, shape, margin, view, sun):
    """Flags of level roof tile under a surface model that is wider than the image by a margin. [pixels]"""
    write_raster(folder / "image.tif", np.full((3, *shape), 6000, np.int16))
    write_raster(folder / "class_map.tif", np.full(shape, TILE_CLASS, np.uint8))
    place = {"west": WEST - margin * CELL, "north": NORTH + margin * CELL}
    write_raster(folder / "dsm.tif", heights.astype(np.float32), **place)
    scene = {"scale": 1e-4, "view": view, "sun": sun}
    classes = {"classes": {str(TILE_CLASS): "roof_tile"}}
    outcome = run(write_config(folder, scene, materials=classes)).scenes[0]
    assert outcome.state == "done", outcome.error
    return read_raster(outcome.folder / "flags.tif")[0]


def seen_from_the_east(folder, kind, shape):
    """The settings of a view from the east at some 60 degrees, of each kind, and the files that it needs."""
    rows, cols = shape
    position = [WEST + cols * CELL + 600.0, NORTH - rows * CELL / 2, 600.0 / np.tan(np.deg2rad(STEEP_DEG))]
    if kind == "line":
        lines = [
            f"2024-05-15T11:00:{i:02d}Z,{position[0]},{position[1] + 5 * (i - 20)},{position[2]}" for i in range(40)
        ]
        (folder / "line.csv").write_text("\n".join(["utc,x,y,z", *lines]), encoding="utf-8")
    if kind == "mosaic":
        write_raster(folder / "source.tif", np.ones(shape, np.int16))
        (folder / "cameras.csv").write_text("id,x,y,z\n1," + ",".join(map(str, position)), encoding="utf-8")
    if kind == "angles":
        for name, angle in (("zenith", STEEP_DEG), ("azimuth", 90.0)):
            write_raster(folder / f"{name}.tif", np.full(shape, angle, np.float32))
    return {
        "constant": {"kind": "constant", "zenith_deg": STEEP_DEG, "azimuth_deg": 90.0},
        "frame": {"kind": "frame", "position": position},
        "line": {"kind": "line", "trajectory": "line.csv"},
        "mosaic": {"kind": "mosaic", "index": "source.tif", "cameras": "cameras.csv"},
        "angles": {"kind": "angles", "zenith": "zenith.tif", "azimuth": "azimuth.tif"},
    }[kind]


@pytest.mark.parametrize("kind", ["constant", "frame", "line", "mosaic", "angles"])
def test_a_wall_beyond_the_image_hides_and_shades_what_is_in_it(tmp_path, kind):
    """15 m high, a metre east of the image: 15 tan 60 = 26 m, 52 pixels, of which two are before it."""
    shape, margin = (80, 80), 60
    heights = np.zeros((shape[0] + 2 * margin, shape[1] + 2 * margin))
    heights[:, margin + shape[1] + 2 : margin + shape[1] + 8] = 15.0
    view = seen_from_the_east(tmp_path, kind, shape)
    behind = {"zenith_deg": STEEP_DEG, "azimuth_deg": 270.0}
    hidden = flags_of(tmp_path, heights, shape, margin, view, behind) & PixelFlag.NOT_VIEWED != 0
    assert abs(hidden[40].sum() - 50) <= 2
    assert hidden[40, -40:-1].all()  # beside the last one another, beyond the image, may be seen
    (tmp_path / "other").mkdir()
    view = seen_from_the_east(tmp_path / "other", kind, shape)
    before = {"zenith_deg": STEEP_DEG, "azimuth_deg": 90.0}
    shaded = flags_of(tmp_path / "other", heights, shape, margin, view, before) & PixelFlag.CAST_SHADOW != 0
    assert abs(shaded[40].sum() - 50) <= 2


@pytest.mark.parametrize("kind", ["constant", "angles"])
def test_walls_hide_as_much_wherever_blocks_end(tmp_path, kind):
    """20 m high: 20 tan 60 = 34.6 m, 69 pixels; also where no window of the survey sees the wall."""
    shape, walls = (64, 2600), (320, 512, 1280, 1408, 1920, 2048)
    heights = np.zeros(shape)
    for wall in walls:
        heights[:, wall + 3 : wall + 9] = 20.0
    sun = {"zenith_deg": 20.0, "azimuth_deg": 270.0}
    flags = flags_of(tmp_path, heights, shape, 0, seen_from_the_east(tmp_path, kind, shape), sun)
    hidden = flags[30] & PixelFlag.NOT_VIEWED != 0
    assert all(abs(hidden[wall - 100 : wall + 3].sum() - 69) <= 2 for wall in walls)


@pytest.mark.parametrize(
    ("epsg", "x", "y", "scale"),
    [
        (32631, 500000.0, 5760000.0, 0.9996),  # on the central meridian
        (3857, 0.0, 0.0, 1.0034),  # the sphere of the equatorial radius: 1 along the equator, 1.0067 across
        (28992, 155000.0, 463000.0, 0.9999079),  # at the origin of its stereographic projection
    ],
)
def test_scales_of_projections(epsg, x, y, scale):
    grid = Grid(CRS.from_epsg(epsg), Affine(0.5, 0, x, 0, -0.5, y), (100, 100))
    assert np.mean(point_scales(grid)) == pytest.approx(scale, abs=1e-4)


def test_web_mercator_grows_with_the_latitude():
    grid = Grid(CRS.from_epsg(3857), Affine(0.5, 0, 490000.0, 0, -0.5, 6_620_000.0), (100, 100))
    (_, latitude) = longitude_latitude(grid, *grid.center)
    assert point_scales(grid) == pytest.approx((1 / np.cos(np.deg2rad(latitude)),) * 2, rel=5e-3)


@pytest.mark.parametrize("kind", ["frame", "line", "mosaic"])
@pytest.mark.parametrize(
    ("crs", "west", "north", "cell", "said"),
    [
        ("EPSG:4326", 4.4, 52.0, 1e-5, "is in degrees; allowed is a projected CRS in metres"),
        ("EPSG:2263", 984000.0, 190000.0, 1.0, "foot; allowed is a projected CRS in metres"),
        ("EPSG:3857", 490000.0, 6_620_000.0, 0.5, r"a metre on the ground is 1\.5.*; allowed is .* true to 5 %"),
    ],
)
def test_positions_need_true_lengths(tmp_path, kind, crs, west, north, cell, said):
    place = {"crs": crs, "west": west, "north": north, "cell": cell}
    write_raster(tmp_path / "image.tif", np.full((3, 20, 20), 6000, np.int16), **place)
    write_raster(tmp_path / "class_map.tif", np.full((20, 20), TILE_CLASS, np.uint8), **place)
    view = seen_from_the_east(tmp_path, kind, (20, 20)) | {"crs": "EPSG:4326"}
    config = write_config(
        tmp_path,
        {"scale": 1e-4, "view": view, "surface": {"kind": "flat"}},
        materials={"classes": {str(TILE_CLASS): "roof_tile"}},
    )
    with pytest.raises(InputError, match=f"seen from positions, the image .*{said}"):
        run(config)
