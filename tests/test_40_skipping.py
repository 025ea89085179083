"""scene: what is skipped changes no value, and is what the report says was skipped."""

import numpy as np
import pytest
import rasterio
from small_scene import (
    BANDS,
    CELL,
    GROUND,
    METAL,
    NODATA,
    NORTH,
    SHAPE,
    TILE,
    UNKNOWN,
    WEST,
    class_map,
    heights,
    image_values,
    read_raster,
    small_scene,
    write_config,
    write_image,
    write_inputs,
    write_raster,
)

from tscorr import batch
from tscorr.config import load_config
from tscorr.rasters import Reader
from tscorr.scene.correct import correct_scene
from tscorr.scene.forecast import forecast

EVERYTHING = ["corrected", "flags", "removed", "azimuthal_width", "angles"]
ALL_SKIPPED = "blocks_no_specular_material", "blocks_out_of_reach", "blocks_shadow_or_nodata"


def run(config):
    """Report and rasters of the only scene of a configuration."""
    (scene,) = batch.run(config, overwrite=True).scenes
    assert scene.error == ""
    return scene.report, {path.stem: read_raster(path) for path in scene.folder.glob("*.tif")}


def with_and_without(folder, *scenes, products=("corrected", "flags", "removed"), **sections):
    """The same scene with `skip` and without, reports first."""
    output = {"directory": "out", "quicklook": False, "products": list(products)}
    results = [
        run(write_config(folder, *scenes, output=output, run={"skip": skip, "memory_limit_mb": 2000}, **sections))
        for skip in (True, False)
    ]
    (skipped, rasters), (whole, others) = results
    assert set(rasters) == set(others) == set(products)
    for name in products:
        assert rasters[name].tobytes() == others[name].tobytes(), name
    for key in ("pixels", "materials", "simplified", "heading", "view", "sun", "quantiles"):
        assert skipped[key] == whole[key], key
    assert not any(whole["skipped"][key] for key in (*ALL_SKIPPED, "pixels_out_of_lobe"))
    return skipped["skipped"]


STEEP = {
    "surface": {"kind": "flat"},
    "sun": {"zenith_deg": 50.0, "azimuth_deg": 180.0},
    "view": {"kind": "constant", "zenith_deg": 5.0, "azimuth_deg": 90.0},
}
"""flat ground, half a right angle off the mirror"""
METAL_ONLY = {"materials": {"classes": {str(METAL): "red_aluminum", str(GROUND): "lambertian"}}}


def straight_line(folder, side_m):
    """A trajectory 500 m up, from south to north, so far east of the scene's western edge."""
    lines = [f"2026-06-21T10:12:{second:02d}Z,{WEST + side_m},{NORTH - 900 + 60 * second},500" for second in range(30)]
    (folder / "line.csv").write_text("utc,x,y,z\n" + "\n".join(lines) + "\n")
    return {"kind": "line", "trajectory": "line.csv"}


VIEWS = {
    "constant": lambda _: STEEP["view"],
    "frame": lambda _: {"kind": "frame", "position": [WEST + 40.0, NORTH, 400.0]},
    "line": lambda folder: straight_line(folder, 30.0),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("sun", [STEEP["sun"], {"time": "2026-06-21T08:00:00Z"}])
def test_flat_ground_out_of_reach_is_skipped_and_nothing_changes(tmp_path, view, sun):
    write_inputs(tmp_path)
    scene = {**STEEP, "view": VIEWS[view](tmp_path), "sun": sun}
    skipped = with_and_without(tmp_path, scene, **METAL_ONLY)
    assert skipped["blocks"] == skipped["blocks_out_of_reach"] == 1
    assert skipped["pixels_out_of_lobe"] == (class_map() == METAL).sum()


@pytest.mark.parametrize(
    "scene",
    [
        {"view": {"kind": "constant", "zenith_deg": 50.0, "azimuth_deg": 0.0}},
        {"sun": {"zenith_deg": 86.0, "azimuth_deg": 180.0}},  # GRAZING
        {"surface": {"kind": "dsm", "path": "dsm.tif"}},
    ],
    ids=["mirror", "grazing", "surface model"],
)
def test_what_is_not_certain_is_computed(tmp_path, scene):
    write_inputs(tmp_path)
    assert with_and_without(tmp_path, {**STEEP, **scene}, **METAL_ONLY)["blocks_out_of_reach"] == 0


WIDE = 16, 3585
"""eight blocks, the last of which is one pixel wide"""


def write_wide_inputs(folder):
    """All metal."""
    values = np.random.default_rng(5).integers(3000, 6000, (BANDS, *WIDE)).astype(np.int16)
    write_image(folder / "image.tif", values)
    write_raster(folder / "class_map.tif", np.full(WIDE, METAL, np.uint8))


@pytest.mark.parametrize("glare_px", [0, 2000, 3100, 3584])
def test_of_a_wide_scene_the_blocks_out_of_reach_are_skipped(tmp_path, glare_px):
    """The camera mirrors the sun at the column that is named."""
    write_wide_inputs(tmp_path)
    position = [WEST + CELL * glare_px, NORTH + 800 * np.tan(np.deg2rad(50)), 800.0]
    scene = {**STEEP, "view": {"kind": "frame", "position": position}}
    skipped = with_and_without(tmp_path, scene, **METAL_ONLY)
    assert skipped["blocks"] == 8
    assert 2 <= skipped["blocks_out_of_reach"] <= 6


def test_where_a_line_ends_the_blocks_before_are_skipped_all_the_same(tmp_path):
    """It goes east along the scene and ends above its sixth block; one band has no direct light."""
    write_wide_inputs(tmp_path)
    x = np.linspace(WEST - 200, WEST + 0.8 * WIDE[1] * CELL, 60)
    lines = [f"2026-06-21T10:12:{second:02d}Z,{at},{NORTH - 4},500" for second, at in enumerate(x)]
    (tmp_path / "line.csv").write_text("utc,x,y,z\n" + "\n".join(lines) + "\n")
    scene = {**STEEP, "view": {"kind": "line", "trajectory": "line.csv"}, "direct_fraction": [0.0, 1.0, 1.0]}
    skipped = with_and_without(tmp_path, scene, **METAL_ONLY)
    assert skipped["blocks"] == 8
    assert skipped["blocks_out_of_reach"] == 5


def test_beyond_the_ends_of_a_line_nothing_is_taken_for_seen(tmp_path):
    """The trajectory ends above the scene: rows beyond its end are not viewed, which only the view knows."""
    write_inputs(tmp_path)
    lines = [
        f"2026-06-21T10:12:{second:02d}Z,{WEST + 30},{NORTH - 7.5 - 60 * (14 - second)},500" for second in range(15)
    ]
    (tmp_path / "line.csv").write_text("utc,x,y,z\n" + "\n".join(lines) + "\n")
    view = {"kind": "line", "trajectory": "line.csv"}
    with_and_without(tmp_path, {**STEEP, "view": view}, materials={"classes": {str(TILE): "red_aluminum"}})


class Reads:
    """Which files blocks are read from."""

    def __init__(self, monkeypatch):
        self.names = []
        read = Reader.read

        def noted(reader, block, bands=None):
            self.names.append(reader.info.path.name)
            return read(reader, block, bands)

        monkeypatch.setattr(Reader, "read", noted)


def test_a_scene_without_a_specular_material_is_passed_through_without_its_surface(tmp_path, monkeypatch):
    config = small_scene(
        tmp_path, run={"workers": 1}, materials={"classes": {str(TILE): "roof_tile", "8": "lambertian"}}
    )
    write_raster(tmp_path / "class_map.tif", np.full(SHAPE, GROUND, np.uint8))
    (scene,) = batch.plan(load_config(config))
    reads = Reads(monkeypatch)
    report = correct_scene(scene)
    assert set(reads.names) == {"class_map.tif", "image.tif"}
    np.testing.assert_array_equal(read_raster(tmp_path / "out/roofs/corrected.tif"), image_values())
    assert report["skipped"]["blocks"] == report["skipped"]["blocks_no_specular_material"] == 1


def large_scene(folder, *, roofs, **profile):
    """Two by five units of 512 x 512 pixels, with a roof in each unit that is named; its class map."""
    shape = 700, 2500
    classes = np.full(shape, GROUND, np.uint8)
    for row, col in roofs:
        classes[row : row + 40, col : col + 60] = METAL
    tiles = {"blockxsize": 256, "blockysize": 256}
    values = np.random.default_rng(3).integers(3000, 6000, (BANDS, *shape)).astype(np.int16)
    write_image(folder / "image.tif", values, **tiles, **profile)
    write_raster(folder / "class_map.tif", classes, **tiles)
    write_raster(folder / "dsm.tif", np.where(classes == METAL, 5, 1).astype(np.float32), **tiles)
    return classes, values


def test_the_surface_is_read_only_where_a_specular_material_is(tmp_path):
    classes, _ = large_scene(tmp_path, roofs=[(20, 30), (600, 2300)])
    skipped = with_and_without(tmp_path, {})
    assert (classes == METAL).any()
    assert skipped["blocks"] == 10
    assert skipped["blocks_no_specular_material"] == 8


@pytest.mark.parametrize(
    ("roof", "parts"), [((20, 30), {(0, 0)}), ((511, 30), {(0, 0), (512, 0)}), ((20, 480), {(0, 0), (0, 512)})]
)
def test_only_heights_that_a_normal_needs_are_read(tmp_path, monkeypatch, roof, parts):
    large_scene(tmp_path, roofs=[])
    classes = read_raster(tmp_path / "class_map.tif")[0]
    row, col = roof
    classes[row : row + 1, col : col + 32] = METAL
    write_raster(tmp_path / "class_map.tif", classes, blockxsize=256, blockysize=256)
    read, places = Reader.read, set()

    def recorded(self, block, bands=None):
        if self.info.path.name == "dsm.tif":
            places.add((block.row, block.col, block.height, block.width))
        return read(self, block, bands)

    monkeypatch.setattr(Reader, "read", recorded)
    with_and_without(tmp_path, {"shadows": False})
    unskipped = {(row, col) for row, col, *_ in places}
    places.clear()
    run(write_config(tmp_path, {"shadows": False}))
    assert places == {(row, col, 512, 512) for row, col in parts}
    assert len(unskipped) > len(parts)


@pytest.mark.parametrize("azimuth_deg", [10.0, 100.0, 190.0, 280.0])
@pytest.mark.parametrize("view", ["frame", "constant"])
def test_sweeps_end_behind_the_last_roof_and_nothing_changes(tmp_path, azimuth_deg, view):
    large_scene(tmp_path, roofs=[(150, 300), (260, 310), (200, 2000)])
    dsm = read_raster(tmp_path / "dsm.tif")[0]
    dsm[:, 295:299], dsm[140:145, :] = 9, 12
    write_raster(tmp_path / "dsm.tif", dsm, blockxsize=256, blockysize=256)
    views = {
        "frame": {"kind": "frame", "position": [WEST + 600.0, NORTH - 100.0, 400.0]},
        "constant": {"kind": "constant", "zenith_deg": 40.0, "azimuth_deg": 0.0},
    }
    scene = {"sun": {"zenith_deg": 60.0, "azimuth_deg": azimuth_deg}, "view": views[view]}
    with_and_without(tmp_path, scene)


def test_a_unit_without_data_is_passed_through(tmp_path):
    write_inputs(tmp_path)
    values = image_values()
    values[1, 26:42, 30:56] = NODATA  # the metal
    values[:, 2, 2] = NODATA
    write_image(tmp_path / "image.tif", values)
    skipped = with_and_without(tmp_path, {}, **METAL_ONLY)
    assert skipped["blocks_shadow_or_nodata"] == 1
    assert skipped["pixels_out_of_lobe"] == 0


def test_a_unit_wholly_in_cast_shadow_is_counted(tmp_path):
    write_inputs(tmp_path)
    dsm = heights()
    dsm[44:46, :] = 100.0  # a wall in the south, where the sun is
    write_raster(tmp_path / "dsm.tif", dsm)
    assert with_and_without(tmp_path, {}, **METAL_ONLY)["blocks_shadow_or_nodata"] == 1


@pytest.mark.parametrize("confidence", [None, "confidence.tif"])
@pytest.mark.parametrize("output", [{}, {"corrected": "vrt"}, {"corrected": "vrt", "format": "cog"}], ids=str)
def test_of_a_unit_without_specular_material_the_class_map_tells_flags_and_sums(tmp_path, output, confidence):
    write_inputs(tmp_path)
    write_image(tmp_path / "image.tif", image_values(np.uint16), nodata=None)
    classes = np.where(class_map() == METAL, GROUND, class_map())  # tiles and a corner that no class names are left
    write_raster(tmp_path / "class_map.tif", classes)
    write_raster(tmp_path / "confidence.tif", np.linspace(0, 1, classes.size, dtype=np.float32).reshape(SHAPE))
    found = []
    for skip in (True, False):
        sections = {"output": {"directory": "out", "quicklook": False, **output}, "run": {"skip": skip}}
        (scene,) = batch.run(
            write_config(tmp_path, {"class_confidence": confidence}, **sections, **METAL_ONLY), overwrite=True
        ).scenes
        assert scene.error == ""
        found.append((scene.report, read_raster(scene.folder / "flags.tif")[0]))
    (skipped, flags), (whole, expected) = found
    np.testing.assert_array_equal(flags, expected)
    unknown = classes != GROUND
    assert (flags[unknown] != 0).all()
    assert (flags[~unknown] == 0).all() == (confidence is None)
    assert skipped["skipped"]["blocks_no_specular_material"] == 1
    for key in ("pixels", "materials"):
        assert skipped[key] == whole[key], key


def random_scene(folder, seed):
    """A scene of random classes, image, directions and rules: the keys of its configuration."""
    rng = np.random.default_rng(seed)
    dtype, nodata = [("int16", NODATA), ("uint16", 0), ("uint16", None), ("uint8", 255)][seed % 4]
    high = 250 if dtype == "uint8" else 9000
    values = rng.integers(1, high, (BANDS, *SHAPE)).astype(dtype)
    if nodata is not None:
        values[:, rng.random(SHAPE) < rng.choice([0.01, 0.5, 1.0], p=[0.6, 0.2, 0.2])] = nodata
    write_image(folder / "image.tif", values, nodata=nodata)
    if dtype == "uint8":
        with rasterio.open(folder / "image.tif", "r+") as file:
            file.scales = (0.004,) * BANDS
    patches = rng.choice([TILE, METAL, GROUND, UNKNOWN, 2], (6, 8), p=rng.dirichlet([1, 1, 1, 1, 1]))
    write_raster(folder / "class_map.tif", np.kron(patches, np.ones((8, 8))).astype(np.uint8))
    dsm = np.kron(rng.choice([1, 4, 8, 30], (6, 8)), np.ones((8, 8))) + rng.normal(0, 0.03, SHAPE)
    dsm[rng.random(SHAPE) < 0.01] = np.nan
    write_raster(folder / "dsm.tif", dsm.astype(np.float32))
    view = [
        {"kind": "constant", "zenith_deg": rng.uniform(0, 60), "azimuth_deg": rng.uniform(0, 360)},
        {"kind": "frame", "position": [WEST + rng.uniform(-300, 300), NORTH + rng.uniform(-300, 300), 300.0]},
        straight_line(folder, rng.uniform(-300, 300)),
    ][seed % 3]
    return {
        "saturation": [None, 0.9 * high][seed % 2],
        "view": view,
        "sun": {"zenith_deg": rng.uniform(5, 80), "azimuth_deg": rng.uniform(0, 360)},
        "surface": [{"kind": "flat"}, {"kind": "dsm", "path": "dsm.tif"}][(seed // 2) % 2],
    }


@pytest.mark.parametrize("seed", range(12))
def test_skipping_changes_no_value_of_any_product(tmp_path, seed):
    scene = random_scene(tmp_path, seed)
    rng = np.random.default_rng(seed)
    classes = {str(TILE): "roof_tile", str(METAL): "red_aluminum", "2": "red_concrete", str(GROUND): "lambertian"}
    keep = {key: name for key, name in classes.items() if rng.random() < 0.7} or {"2": "red_concrete"}
    settings = {
        name: {"precision": "exact", "form": "simplified"} for name in list(keep.values())[:1] if seed % 5 == 0
    }
    products = EVERYTHING if seed % 4 == 3 else EVERYTHING[:3]
    with_and_without(tmp_path, scene, products=products, materials={"classes": keep, "settings": settings})


def test_random_scenes_are_skipped_in_every_way(tmp_path):
    """The property above is not idle."""
    total = dict.fromkeys(ALL_SKIPPED, 0)
    for seed in range(12):
        folder = tmp_path / str(seed)
        folder.mkdir()
        classes = {str(METAL): "red_aluminum", str(GROUND): "lambertian"}
        report, _ = run(write_config(folder, random_scene(folder, seed), materials={"classes": classes}))
        for key in total:
            total[key] += report["skipped"][key]
    assert min(total.values()) > 0, total
    assert sum(total.values()) >= 6


def thresholds(config):
    """Shares of pixels and blocks by threshold, as `tscorr plan` says."""
    (scene,) = batch.plan(load_config(config))
    rows = forecast(scene)["negligible"]
    assert [row["negligible_reflectance"] for row in rows] == sorted(row["negligible_reflectance"] for row in rows)
    return {row["negligible_reflectance"]: (row["pixels"], row["blocks"]) for row in rows}


@pytest.mark.parametrize("negligible", [5e-5, 1e-3, 0.9])
def test_the_plan_says_what_a_threshold_would_skip(tmp_path, negligible):
    """On flat ground the sample sees all of a small scene; the run then does just that."""
    write_inputs(tmp_path)
    scene = {**STEEP, "view": {"kind": "constant", "zenith_deg": 30.0, "azimuth_deg": 0.0}}
    config = write_config(tmp_path, scene, correction={"negligible_reflectance": negligible})
    pixels, blocks = thresholds(config)[negligible]
    report, rasters = run(config)
    assert pixels == np.mean(~rasters["removed"].any(axis=0))
    assert blocks == report["skipped"]["blocks_out_of_reach"]
    assert 0 < pixels < 1 or negligible == 0.9


def test_no_quantile_of_the_share_is_above_the_largest(tmp_path):
    """Whole numbers without a scale, of which next to nothing is removed: less than half a bin of the histogram."""
    write_inputs(tmp_path)
    report, _ = run(write_config(tmp_path, {"scale": 1.0}, **METAL_ONLY, correction={"negligible_reflectance": 0.01}))
    share = report["materials"]["red_aluminum"]["specular_share"]
    assert 0 < share["p50"] <= share["p95"] <= share["max"] < 0.0025


def test_the_plan_of_a_surface_model_looks_at_its_slopes(tmp_path):
    """The gable turns half of the metal away from the camera, and half of it more into the peak or out of it."""
    write_inputs(tmp_path)
    flat = thresholds(write_config(tmp_path, {"surface": {"kind": "flat"}}, **METAL_ONLY))
    sloped = thresholds(write_config(tmp_path, **METAL_ONLY))
    assert flat[1e-3][0] == np.mean(class_map() != METAL)
    assert sloped[5e-3][0] > flat[5e-3][0]
    assert sloped[5e-5][1] == 0
