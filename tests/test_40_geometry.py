"""Whole small scenes with every kind of view and sun, against geometry done by hand from the definition."""

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.warp import transform
from small_scene import CELL, CRS, GROUND, METAL, NORTH, SHAPE, TILE, WEST, read_raster, small_scene, write_raster

from tscorr.angles import angle_between, unit_vector, zenith_azimuth
from tscorr.batch import plan, run
from tscorr.config import load_config
from tscorr.correction import PixelFlag
from tscorr.errors import ConfigError, InputError
from tscorr.grid import Grid, convergences_deg, longitude_latitude
from tscorr.scene.explain import explanation
from tscorr.sun import solar_position

DATA = os.environ.get("TSCORR_TEST_DATA")
ROWS, COLS = SHAPE
PLACE = Grid(rasterio.crs.CRS.from_user_input(CRS), Affine.identity(), SHAPE)
"""for true north and longitudes, which do not depend on pixels"""
TIME = datetime(2024, 5, 15, 11, 0, tzinfo=UTC)
CAMERA = np.array([WEST + 20.0, NORTH - 11.0, 90.0])
"""over the image, so that azimuths go all around it and through north"""
LAYERS = (
    "incidence",
    "exitance",
    "relative",
    "tilt",
    "local",
    "sun_zenith",
    "sun_azimuth",
    "view_zenith",
    "view_azimuth",
)


def ground(cell=CELL, shape=SHAPE):
    """Map coordinates (2, rows, cols) of pixel centres from the image's corner."""
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return np.stack([WEST + cell * (cols + 0.5), NORTH - cell * (rows + 0.5)])


def true_angles(vectors, cell=CELL):
    """Zenith angle and azimuth from true north of vectors in the axes of the grid, each at its own place."""
    zenith, azimuth = zenith_azimuth(vectors)
    x, y = ground(cell, vectors.shape[1:])
    return zenith, (azimuth + convergences_deg(PLACE, x, y)) % 360


def to_camera(cell=CELL, shape=SHAPE):
    """Unit vectors from level ground at 0 m to the camera."""
    away = np.stack([*(CAMERA[:2, None, None] - ground(cell, shape)), np.full(shape, CAMERA[2])])
    return away / np.linalg.norm(away, axis=0)


def write_obs(path, cell=CELL, shape=SHAPE, **profile):
    """An OBS file of the camera, a sun that turns over the image, and a slope that rises to the west."""
    view_zenith, view_azimuth = true_angles(to_camera(cell, shape), cell)
    sun_zenith = np.full(shape, 40.0)
    sun_azimuth = 170 + np.linspace(0, 20, shape[1]) * np.ones(shape)
    slope, aspect = np.full(shape, 12.0), np.full(shape, 90.0)
    vectors = [unit_vector(*a) for a in ((view_zenith, view_azimuth), (sun_zenith, sun_azimuth), (slope, aspect))]
    phase, cos_i = angle_between(vectors[0], vectors[1]), (vectors[2] * vectors[1]).sum(axis=0)
    bands = [100 * sun_zenith, view_azimuth, view_zenith, sun_azimuth, sun_zenith, phase, slope, aspect, cos_i, slope]
    write_raster(path, np.array(bands, np.float32), cell=cell, nodata=-9999, **profile)
    return sun_zenith, sun_azimuth


def angles_of(folder, **changes):
    """The angle layers of the small scene with a flat surface and some keys changed, and its flags."""
    scene = {"surface": {"kind": "flat", "height_m": 0.0}, **changes}
    config = small_scene(
        folder, scene, output={"directory": "out", "quicklook": False, "products": ["angles", "flags"]}
    )
    return layers_of(config)


def planned(config):
    """The scenes of a configuration file, every input checked."""
    return plan(load_config(config))


def layers_of(config):
    outcome = run(config)
    assert [scene.error for scene in outcome.scenes] == [""]
    folder = outcome.folder / outcome.scenes[0].name
    return dict(zip(LAYERS, read_raster(folder / "angles.tif"), strict=True)), read_raster(folder / "flags.tif")[0]


def error_deg(layers, name, zenith, azimuth):
    """Largest angle between the layers' directions and given ones."""
    found = unit_vector(layers[f"{name}_zenith"].astype(float), layers[f"{name}_azimuth"].astype(float))
    return float(np.nanmax(angle_between(found, unit_vector(zenith, azimuth))))


FLOAT32_DEG = 4e-5
"""an azimuth of 359 degrees in float32 is right to 1.5e-5"""


def coarse(cell):
    """Angles of the camera at pixel centres of a coarser raster that reaches beyond the image on all sides."""
    rows, cols = int(ROWS * CELL / cell) + 4, int(COLS * CELL / cell) + 4
    west, north = WEST - 2 * cell, NORTH + 2 * cell
    y, x = np.mgrid[:rows, :cols]
    x, y = west + cell * (x + 0.5), north - cell * (y + 0.5)
    away = np.stack([CAMERA[0] - x, CAMERA[1] - y, np.full(x.shape, CAMERA[2])])
    zenith, azimuth = zenith_azimuth(away)
    azimuth = (azimuth + convergences_deg(PLACE, x, y)) % 360
    return zenith, azimuth, {"cell": cell, "west": west, "north": north}


@pytest.mark.parametrize(("cell", "within"), [(0.5, FLOAT32_DEG), (1.0, 5e-4), (3.0, 5e-3)])
def test_angles_of_any_resolution(tmp_path, cell, within):
    """A camera 90 m over the image, whose azimuth takes all values: no break at 0 and none beneath the camera."""
    zenith, azimuth, place = coarse(cell)
    write_raster(tmp_path / "z.tif", zenith.astype(np.float32), **place)
    write_raster(tmp_path / "a.tif", azimuth.astype(np.float32), **place)
    layers, flags = angles_of(tmp_path, view={"kind": "angles", "zenith": "z.tif", "azimuth": "a.tif"})
    assert error_deg(layers, "view", *true_angles(to_camera())) < within
    assert not (flags & PixelFlag.NOT_VIEWED).any()


@pytest.mark.parametrize("tags", [True, False])
def test_landsat_style_angles(tmp_path, tags):
    """Hundredths of degrees in int16, azimuths from -180 to 180; scale in the file, or in the settings."""
    zenith, azimuth, place = coarse(1.0)
    for name, values in (("z.tif", zenith), ("a.tif", (azimuth + 180) % 360 - 180)):
        write_raster(tmp_path / name, np.round(100 * values).astype(np.int16), nodata=-32768, **place)
        if tags:
            with rasterio.open(tmp_path / name, "r+") as file:
                file.scales = (0.01,)
    view = {"kind": "angles", "zenith": "z.tif", "azimuth": "a.tif"}
    if not tags:
        config = small_scene(tmp_path, {"view": view})
        with pytest.raises(InputError, match=r"z.tif and .*a.tif hold zenith angles from .*\(give scale = 0.01\)"):
            planned(config)
        view["scale"] = 0.01
    layers, _ = angles_of(tmp_path, view=view)
    assert error_deg(layers, "view", *true_angles(to_camera())) < 0.008


def test_angles_in_another_crs(tmp_path):
    """Angles on a UTM grid, whose axes are turned by two degrees against the image's: the same directions."""
    utm = "EPSG:32631"
    (x, *_), (y, *_) = transform(CRS, utm, [WEST, WEST], [NORTH, NORTH])
    place = {"crs": utm, "cell": 1.0, "west": x - 10.0, "north": y + 10.0}
    rows, cols = np.mgrid[:50, :60]
    there_x, there_y = place["west"] + cols + 0.5, place["north"] - rows - 0.5
    x, y = (np.reshape(values, rows.shape) for values in transform(utm, CRS, there_x.ravel(), there_y.ravel()))
    zenith, azimuth = zenith_azimuth(np.stack([CAMERA[0] - x, CAMERA[1] - y, np.full(x.shape, CAMERA[2])]))
    azimuth = (azimuth + convergences_deg(PLACE, x, y)) % 360
    write_raster(tmp_path / "z.tif", zenith.astype(np.float32), **place)
    write_raster(tmp_path / "a.tif", azimuth.astype(np.float32), **place)
    layers, flags = angles_of(tmp_path, view={"kind": "angles", "zenith": "z.tif", "azimuth": "a.tif"})
    assert error_deg(layers, "view", *true_angles(to_camera())) < 3e-3
    assert not (flags & PixelFlag.NOT_VIEWED).any()


def test_void_angles_are_flagged_and_nan(tmp_path):
    """A hole of nodata, and a raster that ends within the image: not viewed, and no other nan."""
    zenith, azimuth = true_angles(to_camera())
    zenith[10:20, 10:20] = -1
    write_raster(tmp_path / "z.tif", zenith[:, :50].astype(np.float32), nodata=-1)
    write_raster(tmp_path / "a.tif", azimuth[:, :50].astype(np.float32))
    layers, flags = angles_of(tmp_path, view={"kind": "angles", "zenith": "z.tif", "azimuth": "a.tif"})
    void = np.zeros(SHAPE, np.bool_)
    void[10:20, 10:20] = void[:, 50:] = True
    for name, layer in layers.items():
        of_view = name not in {"incidence", "sun_zenith", "sun_azimuth"}
        np.testing.assert_array_equal(np.isnan(layer), void & of_view, err_msg=name)
    peaked = np.zeros(SHAPE, np.bool_)
    peaked[6:20, 6:30] = peaked[26:42, 30:56] = True
    np.testing.assert_array_equal((flags & PixelFlag.NOT_VIEWED) != 0, void & peaked)


def test_angles_on_two_grids_are_refused(tmp_path):
    write_raster(tmp_path / "z.tif", np.ones(SHAPE, np.float32))
    write_raster(tmp_path / "a.tif", np.ones(SHAPE, np.float32), cell=1.0)
    config = small_scene(tmp_path, {"view": {"kind": "angles", "zenith": "z.tif", "azimuth": "a.tif"}})
    with pytest.raises(InputError, match=r"z.tif and .*a.tif have different grids; allowed is one for both"):
        planned(config)


@pytest.mark.parametrize("driver", ["GTiff", "ENVI"])
def test_view_sun_and_slope_from_an_obs_file(tmp_path, driver):
    """No `sun` in the settings: directions to sensor and sun, and the normals, are those of the file."""
    sun = write_obs(tmp_path / "x_obs.tif")
    name = "x_obs.tif"
    if driver == "ENVI":
        name = "x_obs"
        with rasterio.open(tmp_path / "x_obs.tif") as file:
            profile = {**file.profile, "driver": "ENVI", "interleave": "bil"}
            for key in ("tiled", "blockxsize", "blockysize", "compress"):
                profile.pop(key, None)
            with rasterio.open(tmp_path / name, "w", **profile) as envi:
                envi.write(file.read())
    obs = {"kind": "obs", "path": name}
    layers, flags = angles_of(tmp_path, view=obs, sun=None, surface=obs)
    assert error_deg(layers, "view", *true_angles(to_camera())) < FLOAT32_DEG
    assert error_deg(layers, "sun", *sun) < FLOAT32_DEG
    incidence = angle_between(unit_vector(*sun), unit_vector(np.full(SHAPE, 12.0), np.full(SHAPE, 90.0)))
    np.testing.assert_allclose(layers["incidence"], incidence, atol=FLOAT32_DEG)
    assert not (flags & (PixelFlag.NOT_VIEWED | PixelFlag.NORMAL_UNRELIABLE)).any()


def test_an_obs_file_of_another_order_is_refused(tmp_path):
    write_obs(tmp_path / "x_obs.tif")
    values = read_raster(tmp_path / "x_obs.tif")
    write_raster(tmp_path / "y_obs.tif", values[[0, 2, 1, 4, 3, 5, 6, 7, 8, 9]])
    write_raster(tmp_path / "z_obs.tif", values[:3])
    for name, message in (("y_obs.tif", "zenith stands before azimuth"), ("z_obs.tif", "has 3 bands; allowed are 10")):
        config = small_scene(tmp_path, {"view": {"kind": "obs", "path": name}, "sun": None})
        with pytest.raises(InputError, match=rf"{name}.*{message}"):
            planned(config)


@pytest.mark.skipif(DATA is None, reason="TSCORR_TEST_DATA names no folder")
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_the_single_pixel_of_aviris_3(tmp_path):
    """ENVI without a CRS: an image, its class map and its OBS file of one pixel."""
    obs = Path(str(DATA)) / "aviris3-obs/AV320250308t200738_obs.img"
    config = small_scene(
        tmp_path,
        {"view": {"kind": "obs", "path": str(obs)}, "sun": None, "surface": {"kind": "obs", "path": str(obs)}},
        output={"directory": "out", "quicklook": False, "products": ["angles", "flags"]},
    )
    values = np.full((3, 1, 1), 4000, np.int16)
    for name, pixel in (("image.tif", values), ("class_map.tif", np.full((1, 1), TILE, np.uint8))):
        with rasterio.open(
            tmp_path / name, "w", driver="GTiff", height=1, width=1, count=len(pixel.reshape(-1)), dtype=pixel.dtype
        ) as file:
            file.write(pixel.reshape(-1, 1, 1))
    layers, _ = layers_of(config)
    expected = {
        "view_azimuth": 244.3386536,
        "view_zenith": 14.4152308,
        "sun_azimuth": 186.3010101,
        "sun_zenith": 40.2688179,
    }
    for name, value in expected.items():
        assert layers[name][0, 0] == pytest.approx(value, abs=1e-4)
    assert 2 * layers["local"][0, 0] == pytest.approx(34.498077, abs=0.005)
    assert layers["incidence"][0, 0] == pytest.approx(np.rad2deg(np.arccos(0.7628986835)), abs=0.05)


def test_a_mosaic_of_two_cameras(tmp_path):
    """The west of the image from one camera and the east from another, given in degrees and above the ellipsoid."""
    places = np.array([[WEST - 40.0, NORTH, 300.0], [WEST + 60.0, NORTH - 60.0, 320.0]])
    longitude, latitude = transform(CRS, "EPSG:4326", places[:, 0], places[:, 1])
    lines = [f"{i},{longitude[k]!r},{latitude[k]!r},{places[k, 2] + 43.0}" for k, i in ((1, 12), (0, 5))]
    (tmp_path / "cameras.csv").write_text("\n".join(["id,x,y,z", *lines]))
    index = np.full(SHAPE, 5, np.uint16)
    index[:, 32:], index[:3] = 12, 0
    write_raster(tmp_path / "index.tif", index, nodata=0, west=WEST + 0.2, north=NORTH - 0.2)  # 0.4 pixels aside
    view = {
        "kind": "mosaic",
        "index": "index.tif",
        "cameras": "cameras.csv",
        "crs": "EPSG:4326",
        "height_offset_m": -43.0,
    }
    layers, _ = angles_of(tmp_path, view=view)
    camera = np.where((index == 5)[None], places[0][:, None, None], places[1][:, None, None])
    away = np.stack([*(camera[:2] - ground()), camera[2]])
    assert error_deg(layers, "view", *true_angles(away)) < 2e-4  # PROJ comes back to half a millimetre
    np.testing.assert_array_equal(np.isnan(layers["view_zenith"]), index == 0)
    index[20, 20] = 77
    index[:] = np.where(index == 5, 77, index)
    write_raster(tmp_path / "index.tif", index, nodata=0)
    with pytest.raises(InputError, match=r"index.tif holds camera 77; .*cameras.csv has 2 cameras, from 5 to 12"):
        planned(small_scene(tmp_path, {"view": view}))


def write_flight(path, seconds=600.0, samples=400):
    """A slow airship: over the small image from west to east in so many seconds, 300 m up, its times uneven."""
    share = np.sort(np.random.default_rng(8).uniform(-0.2, 1.2, samples))
    rows = [
        f"{(TIME + timedelta(seconds=float(seconds * s))).isoformat()},{WEST + 32.0 * s!r},{NORTH - 12.0!r},300.0"
        for s in share.tolist()
    ]
    path.write_text("\n".join(["utc,x,y,z", *rows]))


def test_the_sun_moves_while_the_scanner_passes(tmp_path):
    """Ten minutes over the image: each column has the sun of its own second, within 0.001 degrees of SPA."""
    write_flight(tmp_path / "flight.csv")
    layers, _ = angles_of(tmp_path, view={"kind": "line", "trajectory": "flight.csv"}, sun=None)
    x, y = ground()
    longitude, latitude = longitude_latitude(PLACE, x, y)
    for row, col in ((0, 0), (10, 17), (47, 40), (30, 63)):
        time = TIME + timedelta(seconds=float((x[row, col] - WEST) / 32.0 * 600))
        zenith, azimuth = solar_position(time, latitude[row, col], longitude[row, col])
        found = unit_vector(
            layers["sun_zenith"][row, col].astype(float), layers["sun_azimuth"][row, col].astype(float)
        )
        assert angle_between(found, unit_vector(zenith, azimuth)) < 0.001
    assert np.ptp(layers["sun_azimuth"]) > 3
    away = np.stack([np.zeros(SHAPE), NORTH - 12.0 - y, np.full(SHAPE, 300.0)])
    assert error_deg(layers, "view", *true_angles(away)) < 1e-4


def test_explain_tells_when_a_pixel_was_seen(tmp_path):
    write_flight(tmp_path / "flight.csv")
    config = small_scene(tmp_path, {"view": {"kind": "line", "trajectory": "flight.csv"}, "sun": None})
    scenes = planned(config)
    lines = explanation(scenes[0], 10, 32)
    assert lines["pixel"]["seen at"].startswith("2024-05-15T11:05:04.6")
    assert lines["pixel"]["seen from"] == f"x {WEST + 16.25:.2f}, y {NORTH - 12:.2f}, height 300.00 m"


def test_a_line_of_several_needs_its_times(tmp_path):
    """There and back over the scene: refused with both times, taken with `start` and `end`."""
    write_flight(tmp_path / "flight.csv")
    header, *lines = (tmp_path / "flight.csv").read_text().split("\n")
    back = []
    for line in reversed(lines):
        time, rest = line.split(",", 1)
        there = datetime.fromisoformat(time)
        back.append(f"{(TIME + timedelta(seconds=3000) - (there - TIME)).isoformat()},{rest}")
    (tmp_path / "flight.csv").write_text("\n".join([header, *lines, *back]))
    view = {"kind": "line", "trajectory": "flight.csv"}
    with pytest.raises(
        InputError, match=r"flight.csv passes the scene twice, at 11:0\d:\d\d and at 11:\d\d:\d\d; give"
    ):
        planned(small_scene(tmp_path, {"view": view, "sun": None}))
    view["end"] = TIME + timedelta(seconds=900)
    planned(small_scene(tmp_path, {"view": view, "sun": None}))
    with pytest.raises(ConfigError, match="allowed is an end after the start"):
        planned(small_scene(tmp_path, {"view": {**view, "start": view["end"]}, "sun": None}))


def test_a_sun_must_come_from_somewhere(tmp_path):
    with pytest.raises(ConfigError, match=r"image.tif has no sun: give sun = \{ time"):
        planned(small_scene(tmp_path, {"sun": None}))


def test_the_files_of_a_view_are_inputs_of_the_scene(tmp_path):
    """They are hashed, so that a changed flight or angle raster is corrected anew."""
    write_flight(tmp_path / "flight.csv")
    write_obs(tmp_path / "x_obs.tif")
    (tmp_path / "cameras.csv").write_text("id,x,y,z\n1,84000,447000,900\n")
    write_raster(tmp_path / "index.tif", np.ones(SHAPE, np.uint8))
    write_raster(tmp_path / "a.tif", np.full(SHAPE, 30.0, np.float32))
    views = [
        ({"kind": "line", "trajectory": "flight.csv"}, {"flight.csv"}),
        ({"kind": "obs", "path": "x_obs.tif"}, {"x_obs.tif"}),
        ({"kind": "angles", "zenith": "a.tif", "azimuth": "a.tif"}, {"a.tif"}),
        ({"kind": "mosaic", "index": "index.tif", "cameras": "cameras.csv"}, {"index.tif", "cameras.csv"}),
    ]
    for view, files in views:
        scene = planned(small_scene(tmp_path, {"view": view}))[0]
        assert files <= {path.name for path in scene.inputs}


SUNS = {
    "zenith": (0.0, 0.0),
    "horizon": (89.999, 90.0),
    "north": (40.0, 360.0),
    "just west of north": (40.0, 359.9999),
}


@pytest.mark.parametrize("sun", SUNS)
@pytest.mark.parametrize(
    ("crs", "west", "north"),
    [(CRS, WEST, NORTH), ("EPSG:32756", 334000.0, 6252000.0), ("EPSG:3413", 300000.0, -900000.0)],
    ids=["delft", "sydney", "arctic"],
)
def test_nothing_is_nan_at_the_extremes(tmp_path, sun, crs, west, north):
    """Towers of 300 m, a camera straight above one of them; the sun at the zenith, at the horizon, in the north."""
    place = {"crs": crs, "west": west, "north": north}
    config = small_scene(
        tmp_path,
        {
            "view": {"kind": "frame", "position": [west + 8.25, north - 6.25, 301.0]},
            "sun": dict(zip(("zenith_deg", "azimuth_deg"), SUNS[sun], strict=True)),
        },
        output={"directory": "out", "quicklook": False, "products": ["corrected", "flags", "angles"]},
    )
    rng = np.random.default_rng(9)
    heights = np.where(rng.random(SHAPE) < 0.05, np.float32(300), np.float32(0)).astype(np.float32)
    heights[12, 16] = 300
    write_raster(tmp_path / "dsm.tif", heights, **place)
    write_raster(tmp_path / "image.tif", rng.integers(3000, 6000, (3, *SHAPE)).astype(np.int16), **place)
    write_raster(tmp_path / "class_map.tif", rng.choice([TILE, METAL, GROUND], SHAPE).astype(np.uint8), **place)
    layers, flags = layers_of(config)
    for name, layer in layers.items():
        assert np.isfinite(layer).all(), name
    assert error_deg(layers, "sun", *np.reshape(SUNS[sun], (2, 1, 1))) < FLOAT32_DEG
    assert flags.any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (48, 1)])
@pytest.mark.parametrize("kind", ["frame", "line", "angles", "obs", "mosaic"])
def test_images_of_one_row_or_pixel(tmp_path, shape, kind):
    write_flight(tmp_path / "flight.csv")
    write_obs(tmp_path / "x_obs.tif")
    write_raster(tmp_path / "a.tif", np.full(shape, 30.0, np.float32))
    write_raster(tmp_path / "index.tif", np.ones(shape, np.uint8))
    (tmp_path / "cameras.csv").write_text(f"id,x,y,z\n1,{WEST},{NORTH},900\n")
    view = {
        "frame": {"kind": "frame", "position": [WEST, NORTH, 500.0]},
        "line": {"kind": "line", "trajectory": "flight.csv"},
        "angles": {"kind": "angles", "zenith": "a.tif", "azimuth": "a.tif"},
        "obs": {"kind": "obs", "path": "x_obs.tif"},
        "mosaic": {"kind": "mosaic", "index": "index.tif", "cameras": "cameras.csv"},
    }[kind]
    sun = None if kind in {"line", "obs"} else {"zenith_deg": 40.0, "azimuth_deg": 180.0}
    config = small_scene(
        tmp_path,
        {"view": view, "sun": sun},
        output={"directory": "out", "quicklook": True, "products": ["corrected", "flags", "removed", "angles"]},
    )
    write_raster(tmp_path / "image.tif", np.full((3, *shape), 4000, np.int16))
    write_raster(tmp_path / "class_map.tif", np.full(shape, TILE, np.uint8))
    write_raster(tmp_path / "dsm.tif", np.full(shape, 1.0, np.float32))
    layers, _ = layers_of(config)
    assert all(np.isfinite(layer).all() for layer in layers.values())
