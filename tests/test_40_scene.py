"""scene: from files to files, against the ray-traced truth of Delft and against geometry done by hand."""

import hashlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tomli_w
from affine import Affine
from rasterio.enums import Resampling
from rasterio.shutil import copy as copy_raster
from rasterio.warp import reproject, transform
from small_scene import (
    BANDS,
    CELL,
    CRS,
    GROUND,
    METAL,
    NODATA,
    NORTH,
    SCALE,
    SHAPE,
    TILE,
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
from tscorr.correction import PixelFlag, SpecularState, specular_state

ROOT = Path(__file__).parents[1]
DELFT = ROOT / "samples" / "delft"
VIEWS = "forward", "nadir", "line"
PAPER = json.loads((Path(__file__).parent / "data" / "paper_values.json").read_text())
SHADOW = PixelFlag.SELF_SHADOW | PixelFlag.CAST_SHADOW


class Result:
    """What a run wrote for one scene, and what it was made of."""

    def __init__(self, scene, folder, image):
        self.report = scene.report
        self.folder = folder / scene.name
        self.image = read_raster(image)
        self.rasters = {path.stem: read_raster(path) for path in self.folder.glob("*.tif")}

    @property
    def corrected(self):
        return self.rasters["corrected"]

    @property
    def removed(self):
        return self.rasters["removed"]

    @property
    def mask(self):
        return self.rasters["flags"][0]


def run(config, **options):
    """The result of the only scene of a configuration."""
    settings = tomllib.loads(config.read_text())
    outcome = batch.run(config, **options)
    assert [scene.error for scene in outcome.scenes] == [""]
    return Result(outcome.scenes[0], outcome.folder, config.parent / settings["scenes"][0]["image"])


# Delft, whose truth was ray traced by another program.


def delft_config(folder, surface, *, names=VIEWS, image=None, workers=2):
    """The shipped configuration with another surface and other outputs."""
    values = tomllib.loads((ROOT / "configs" / "delft.toml").read_text())
    configs = ROOT / "configs"
    values["output"] = {"directory": "out", "quicklook": False}
    values["run"] = {"workers": workers}
    values["materials"]["library"] = [str(configs / path) for path in values["materials"]["library"]]
    values["scenes"] = [scene for scene in values["scenes"] if scene["name"] in names]
    for scene in values["scenes"]:
        scene.pop("truth")
        scene["image"] = str(image or configs / scene["image"])
        scene["class_map"] = str(configs / scene["class_map"])
        if "trajectory" in scene["view"]:
            scene["view"]["trajectory"] = str(configs / scene["view"]["trajectory"])
        scene["surface"] = surface
    path = folder / "delft.toml"
    path.write_text(tomli_w.dumps(values))
    return path


TRUE_NORMALS = {
    "kind": "normals",
    "path": str(DELFT / "truth" / "normals.tif"),
    "heights": str(DELFT / "dsm.tif"),
}
ROOF_PLANES = {"kind": "roof_planes", "path": str(DELFT / "dsm_noisy.tif")}


def delft_results(folder, surface):
    outcome = batch.run(delft_config(folder, surface))
    return {
        scene.name: Result(scene, outcome.folder, DELFT / f"{scene.name}.tif")
        for scene in outcome.scenes
        if scene.state == "done"
    }


@pytest.fixture(scope="module")
def with_true_normals(tmp_path_factory):
    return delft_results(tmp_path_factory.mktemp("true_normals"), TRUE_NORMALS)


@pytest.fixture(scope="module")
def with_roof_planes(tmp_path_factory):
    return delft_results(tmp_path_factory.mktemp("roof_planes"), ROOF_PLANES)


@pytest.fixture(scope="module")
def delft():
    """Class map, sunlit mask, normals, heights, and the reflectance without glare of each view."""
    truth = DELFT / "truth"
    return {
        "classes": read_raster(DELFT / "class_map.tif")[0],
        "sunlit": read_raster(truth / "shadow.tif")[0] == 1,
        "normals": read_raster(truth / "normals.tif").astype(float),
        "heights": read_raster(DELFT / "dsm.tif")[0].astype(float),
        **{view: read_raster(truth / f"diffuse_{view}.tif").astype(float) for view in VIEWS},
    }


def residual_glare(result, diffuse, sunlit):
    """RMS(corrected - truth) / RMS(input - truth) where more than 5 % of the light was glare."""
    seen, corrected = result.image * SCALE, result.corrected * SCALE
    valid = sunlit & (result.image != NODATA).all(axis=0) & (result.image < 9000).all(axis=0)
    glare = valid & ((seen - diffuse) / np.where(valid, seen, 1) > 0.05).any(axis=0)
    assert glare.sum() > 50_000
    return np.sqrt(((corrected - diffuse)[:, glare] ** 2).sum() / ((seen - diffuse)[:, glare] ** 2).sum())


@pytest.mark.parametrize("view", VIEWS)
def test_with_true_normals_three_percent_of_the_glare_are_left_at_most(with_true_normals, delft, view):
    assert residual_glare(with_true_normals[view], delft[view], delft["sunlit"]) <= 0.03


@pytest.mark.parametrize("view", VIEWS)
def test_with_roof_planes_of_a_noisy_dsm_a_fifth_of_the_glare_is_left_at_most(with_roof_planes, delft, view):
    assert residual_glare(with_roof_planes[view], delft[view], delft["sunlit"]) <= 0.20


def vectors_to(position, points):
    vectors = np.asarray(position)[:, None, None] - points
    return vectors / np.linalg.norm(vectors, axis=0)


def delft_specular(delft, view):
    """Reflectance factor of the specular part in full light (bands, rows, cols), by the sample's own README."""
    rows, cols = delft["classes"].shape
    x, y = np.meshgrid(84664 + (np.arange(cols) + 0.5) * 0.5, 447719 - (np.arange(rows) + 0.5) * 0.5)
    points = np.stack([x, y, delft["heights"]])
    zenith, azimuth = np.deg2rad([39.4398, 224.6822])  # of the grid
    s = np.array([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)])
    if view == "line":
        along = np.deg2rad(132)
        track = np.array([np.sin(along), np.cos(along)])
        start = np.array([84769.033, 447873.159])
        abeam = start[:, None, None] + track[:, None, None] * np.tensordot(track, points[:2] - start[:, None, None], 1)
        v = np.stack([*abeam, np.full_like(x, 520.0)]) - points
        v /= np.linalg.norm(v, axis=0)
    else:
        frame = json.loads((DELFT / "cameras.json").read_text())["frames"][view]
        v = vectors_to((frame["x"], frame["y"], frame["z"]), points)
    n = delft["normals"]
    h = s[:, None, None] + v
    h /= np.linalg.norm(h, axis=0)
    cos_i, cos_r = np.tensordot(s, n, 1), (v * n).sum(axis=0)
    n_h, cos_l = np.clip((n * h).sum(axis=0), -1, 1), (v * h).sum(axis=0)
    lit = (cos_i > 0.01) & (cos_r > 0.01)
    cos_i, cos_r = np.where(lit, cos_i, 1), np.where(lit, cos_r, 1)
    g = np.minimum(1, 2 * n_h * np.minimum(cos_i, cos_r) / cos_l)
    alpha = np.rad2deg(np.arccos(n_h))
    library = tomllib.loads((DELFT / "materials.toml").read_text())
    lobe = np.zeros_like(alpha)
    names = tomllib.loads((ROOT / "configs" / "delft.toml").read_text())["materials"]["classes"]
    for value, name in names.items():
        m = library[name]
        index = m["n"] - 1j * m["k"]
        cos_t = np.sqrt(1 - (1 - cos_l**2) / index**2)
        r_s = (cos_l - index * cos_t) / (cos_l + index * cos_t)
        r_p = (index * cos_l - cos_t) / (index * cos_l + cos_t)
        fresnel = (np.abs(r_s) ** 2 + np.abs(r_p) ** 2) / 2
        f = m["t1"] * fresnel * g * np.exp(-((m["w"] * alpha) ** 2)) / (cos_i * cos_r)
        lobe = np.where(delft["classes"] == int(value), f, lobe)
    direct = np.array([0.80, 0.84, 0.875, 0.89, 0.915])[:, None, None]
    return np.where(lit, np.pi * direct * lobe * cos_i / np.cos(zenith), 0)


@pytest.mark.parametrize("view", VIEWS)
def test_what_is_removed_is_the_specular_part_of_the_model(with_true_normals, delft, view):
    result, expected = with_true_normals[view], delft_specular(delft, view)
    corrected = specular_state(result.mask) == SpecularState.CORRECTED
    assert corrected.sum() > 100_000
    error = np.abs(result.removed * SCALE - expected)
    bound = 0.5 * SCALE + 0.01 * expected + 2e-6  # a stored step, and 0.004 degrees that the sun moves over the scene
    assert np.mean((error <= bound)[:, corrected]) > 0.9999


@pytest.mark.parametrize("view", VIEWS)
def test_no_pixel_outside_the_lobes_is_changed(with_true_normals, delft, view):
    result = with_true_normals[view]
    outside = (delft_specular(delft, view) < 0.98 * SCALE / 2).all(axis=0)
    assert outside.mean() > 0.4
    assert not result.removed[:, outside].any()
    np.testing.assert_array_equal(result.corrected[:, outside], result.image[:, outside])


@pytest.mark.parametrize("kind", ["with_true_normals", "with_roof_planes"])
@pytest.mark.parametrize("view", VIEWS)
def test_input_less_removed_is_corrected_and_what_was_not_corrected_is_untouched(request, kind, view):
    result = request.getfixturevalue(kind)[view]
    image, removed, corrected = (values.astype(int) for values in (result.image, result.removed, result.corrected))
    np.testing.assert_array_equal(image - removed, corrected)
    assert removed.min() >= 0
    state = specular_state(result.mask)
    kept = (state == SpecularState.NEGLIGIBLE) | (state == SpecularState.NOT_ASSESSED)
    assert not removed[:, kept].any()
    assert not removed[image == 9000].any()  # saturated
    np.testing.assert_array_equal((image == NODATA).any(axis=0), (result.mask & PixelFlag.NODATA) != 0)
    assert np.all(corrected[image == NODATA] == NODATA)


@pytest.mark.parametrize("kind", ["with_true_normals", "with_roof_planes"])
@pytest.mark.parametrize("view", VIEWS)
def test_shadow_flags_are_those_of_the_ray_tracer(request, delft, kind, view):
    result = request.getfixturevalue(kind)[view]
    asked = (delft["classes"] >= 1) & (delft["classes"] <= 5) & ((result.mask & PixelFlag.NODATA) == 0)
    shadow = (result.mask & SHADOW) != 0
    assert np.mean((shadow != delft["sunlit"])[asked]) >= 0.97


@pytest.mark.parametrize("view", VIEWS)
def test_the_report_counts_what_the_flags_say(with_roof_planes, view):
    result = with_roof_planes[view]
    pixels = result.report["pixels"]
    state = specular_state(result.mask)
    assert pixels["total"] == state.size
    for member in SpecularState:
        assert pixels[member.name.lower()] == np.count_nonzero(state == member)
    for flag in (PixelFlag.NODATA, PixelFlag.NO_MATERIAL, PixelFlag.CAST_SHADOW, PixelFlag.SATURATED):
        assert pixels[flag.name.lower()] == np.count_nonzero(result.mask & flag)


@pytest.fixture(scope="module")
def forward_otherwise(tmp_path_factory):
    """The forward view by one worker, from a copy of the image in strips, pixel by pixel."""
    folder = tmp_path_factory.mktemp("strips")
    image = folder / "forward.tif"
    copy_raster(DELFT / "forward.tif", image, driver="GTiff", interleave="pixel", compress="lzw", blockysize=24)
    return run(delft_config(folder, ROOF_PLANES, names=["forward"], image=image, workers=1))


@pytest.mark.parametrize("product", ["corrected", "flags", "removed"])
def test_neither_workers_nor_tiles_change_a_value(with_roof_planes, forward_otherwise, product):
    np.testing.assert_array_equal(forward_otherwise.rasters[product], with_roof_planes["forward"].rasters[product])


def test_neither_workers_nor_tiles_change_the_report(with_roof_planes, forward_otherwise):
    one, other = (dict(result.report) for result in (with_roof_planes["forward"], forward_otherwise))
    for key in ("pixels", "materials", "heading", "simplified", "view", "sun"):
        assert one[key] == other[key]


# Small scenes, whose answer is known by hand.


def paper_point(material, incidence, exitance):
    """f_spec in the principal plane, to 25 digits."""
    (point,) = (
        point
        for point in PAPER["points"]
        if point["material"] == material
        and point["model"] == "full"
        and float(point["theta_i"]) == incidence
        and float(point["theta_r"]) == exitance
        and float(point["phi"]) == 180
    )
    return float(point["f_spec"])


def test_flat_tiles_lose_what_the_paper_says(tmp_path):
    angles = {
        "sun": {"zenith_deg": 50.0, "azimuth_deg": 200.0},
        "view": {"kind": "constant", "zenith_deg": 50.0, "azimuth_deg": 20.0},
        "surface": {"kind": "flat"},
        "direct_fraction": [1.0, 0.8, 0.5],
    }
    result = run(small_scene(tmp_path, angles))
    expected = np.pi * np.array([1.0, 0.8, 0.5]) * 0.2 * paper_point("roof_tile", 50, 50)
    tiles = class_map() == TILE
    np.testing.assert_array_equal(np.unique(result.removed[:, tiles], axis=1)[:, 0], np.round(expected / SCALE))
    assert np.ptp(result.removed[:, tiles], axis=1).max() == 0


def test_the_ground_has_no_peak_and_an_unnamed_class_no_material(tmp_path):
    result = run(small_scene(tmp_path))
    classes = class_map()
    state = result.mask & ~np.uint16(PixelFlag.NORMAL_UNRELIABLE)
    assert np.all(state[classes == GROUND] == 0)
    assert np.all(state[classes == 9] == PixelFlag.NO_MATERIAL | SpecularState.NOT_ASSESSED << 6)
    untouched = (classes == GROUND) | (classes == 9)
    np.testing.assert_array_equal(result.corrected[:, untouched], result.image[:, untouched])


def test_everything_about_the_image_survives(tmp_path):
    config = small_scene(
        tmp_path, output={"directory": "out", "products": ["corrected", "removed", "flags", "angles"]}
    )
    folder = run(config).folder
    with rasterio.open(tmp_path / "image.tif") as image:
        for name in ("corrected", "removed"):
            with rasterio.open(folder / f"{name}.tif") as result:
                for key in ("crs", "transform", "dtypes", "scales", "descriptions", "block_shapes", "compression"):
                    assert getattr(result, key) == getattr(image, key)
                assert result.tags().items() >= image.tags().items()
                for band in image.indexes:
                    assert result.tags(band, ns="IMAGERY") == image.tags(band, ns="IMAGERY")
                    assert result.tags(band) == image.tags(band)
        with rasterio.open(folder / "corrected.tif") as result:
            assert result.nodata == image.nodata
        for name, dtype, count in (("flags", "uint16", 1), ("angles", "float32", 9)):
            with rasterio.open(folder / f"{name}.tif") as result:
                assert (result.crs, result.transform, result.shape) == (image.crs, image.transform, image.shape)
                assert (result.dtypes[0], result.count) == (dtype, count)


def test_a_scene_folder_holds_what_the_design_promises(tmp_path):
    products = ["corrected", "flags", "removed", "azimuthal_width", "angles"]
    result = run(small_scene(tmp_path, output={"directory": "out", "products": products, "quicklook": True}))
    names = {path.name for path in result.folder.iterdir()}
    rasters = {f"{product}.tif" for product in products}
    assert names >= rasters | {"quicklook.png", "report.json", "report.html", "settings.toml", "manifest.json"}
    assert not any(name.startswith(".") for name in names)
    settings = tomllib.loads((result.folder / "settings.toml").read_text())
    assert settings["correction"]["uncorrectable_share"] == 0.9  # a default filled in
    manifest = json.loads((result.folder / "manifest.json").read_text())
    assert set(manifest["outputs"]) == names - {"manifest.json"}
    inputs = {str(tmp_path / name) for name in ("image.tif", "class_map.tif", "dsm.tif")}
    assert set(manifest["inputs"]) == inputs


def test_a_manifest_holds_sha_256_where_that_is_asked_for(tmp_path):
    config = small_scene(tmp_path, output={"directory": "out", "hash": "sha256", "quicklook": False})
    folder = run(config).folder
    manifest = json.loads((folder / "manifest.json").read_text())
    for place, entries in ((folder, manifest["outputs"]), (tmp_path, manifest["inputs"])):
        for name, entry in entries.items():
            assert entry["sha256"] == hashlib.sha256((place / name).read_bytes()).hexdigest()


def test_the_angles_are_those_of_the_facets(tmp_path):
    products = ["corrected", "angles"]
    result = run(small_scene(tmp_path, output={"directory": "out", "products": products, "quicklook": False}))
    flat = class_map() == TILE
    south = np.zeros(SHAPE, bool)
    south[36:40, 34:52] = True  # the south face of the gable: 10 degrees towards the sun
    # Grid north lies 0.806 degrees west of true north, so the face does not look quite into the sun.
    sun, view, normal = (
        np.array([np.sin(t) * np.sin(a), np.sin(t) * np.cos(a), np.cos(t)])
        for t, a in np.deg2rad([(40, 180.806), (40, 0.806), (10, 180)])
    )
    along_sun, along_view = sun - (sun @ normal) * normal, view - (view @ normal) * normal
    azimuth = along_sun @ along_view / np.linalg.norm(along_sun) / np.linalg.norm(along_view)
    incidence, exitance, relative = np.rad2deg(np.arccos([sun @ normal, view @ normal, azimuth]))
    #  incidence, exitance, relative azimuth, facet tilt, local angle, solar zenith, azimuth, view zenith, azimuth
    expected = [incidence, exitance, relative, 10, 40, 40, 180, 40, 0]
    angles = result.rasters["angles"]
    np.testing.assert_allclose(np.median(angles[:, south], axis=1), expected, atol=2e-3)
    np.testing.assert_allclose(np.median(angles[:, flat], axis=1), [40, 40, 180, 0, 40, 40, 180, 40, 0], atol=1e-3)


def test_settings_of_one_material_leave_the_others_alone(tmp_path):
    config = small_scene(tmp_path)
    both = run(config)
    tiles, metal = class_map() == TILE, class_map() == METAL
    classes = {str(TILE): "roof_tile", str(METAL): "red_aluminum"}
    off = {"roof_tile": {"enabled": False}}
    result = run(write_config(tmp_path, materials={"classes": classes, "settings": off}))
    assert not result.removed[:, tiles].any()
    np.testing.assert_array_equal(result.removed[:, metal], both.removed[:, metal])
    half = {"roof_tile": {"direct_fraction": 0.5}}
    result = run(write_config(tmp_path, materials={"classes": classes, "settings": half}))
    assert np.abs(result.removed[:, tiles] - both.removed[:, tiles] / 2).max() <= 1
    np.testing.assert_array_equal(result.removed[:, metal], both.removed[:, metal])


def test_only_the_materials_asked_for_are_corrected(tmp_path):
    result = run(small_scene(tmp_path), materials=["red_aluminum"])
    assert not result.removed[:, class_map() == TILE].any()
    assert result.removed[:, class_map() == METAL].any()


@pytest.mark.parametrize("precision", ["exact", "reference"])
def test_every_precision_removes_the_same_to_a_step(tmp_path, precision):
    fast = run(small_scene(tmp_path))
    other = run(write_config(tmp_path, model={"precision": precision}))
    assert np.abs(fast.removed.astype(int) - other.removed).max() <= 1
    np.testing.assert_array_equal(fast.mask, other.mask)


def test_skipping_changes_nothing(tmp_path):
    skipping = run(small_scene(tmp_path))
    computing = run(write_config(tmp_path, run={"skip": False}))
    for product in ("corrected", "removed", "flags"):
        np.testing.assert_array_equal(skipping.rasters[product], computing.rasters[product])


def test_a_brdf_is_pi_times_smaller_than_a_reflectance_factor(tmp_path):
    factor = run(small_scene(tmp_path))
    brdf = run(write_config(tmp_path, {"quantity": "brdf"}))
    tiles = class_map() == TILE
    assert np.abs(brdf.removed[:, tiles] * np.pi - factor.removed[:, tiles]).max() <= np.pi


def test_saturated_values_stay_and_the_other_bands_are_best(tmp_path):
    write_inputs(tmp_path)
    values = image_values()
    values[1, 8, 8] = 9100
    write_image(tmp_path / "image.tif", values)
    result = run(write_config(tmp_path, {"saturation": 9000}))
    assert result.mask[8, 8] & PixelFlag.SATURATED
    assert specular_state(result.mask)[8, 8] == SpecularState.UNCORRECTABLE
    assert result.removed[1, 8, 8] == 0
    assert result.removed[0, 8, 8] > 0


@pytest.mark.parametrize(("policy", "value"), [("best", 0), ("keep", 100), ("nodata", NODATA)])
def test_what_becomes_of_pixels_darker_than_their_glare(tmp_path, policy, value):
    write_inputs(tmp_path)
    values = image_values()
    values[:, 8, 8] = 100
    write_image(tmp_path / "image.tif", values)
    result = run(write_config(tmp_path, correction={"uncorrectable": policy}))
    assert specular_state(result.mask)[8, 8] == SpecularState.UNCORRECTABLE
    assert np.all(result.corrected[:, 8, 8] == value)


def test_nan_and_infinity_in_an_image_are_flagged_and_kept(tmp_path):
    write_inputs(tmp_path)
    values = image_values(np.float32) * np.float32(SCALE)
    values[0, 8, 8], values[1, 9, 9], values[2, 10, 10] = np.nan, np.inf, -np.inf
    write_image(tmp_path / "image.tif", values, nodata=None)
    result = run(write_config(tmp_path, {"scale": 1.0}, output={"directory": "out", "quicklook": True}))
    bad = ~np.isfinite(values).all(axis=0)
    np.testing.assert_array_equal((result.mask & PixelFlag.NODATA) != 0, bad)
    np.testing.assert_array_equal(result.corrected[:, bad], values[:, bad])
    assert np.isfinite(result.corrected[:, ~bad]).all()


@pytest.mark.parametrize("kind", ["dsm", "roof_planes"])
def test_nan_and_infinity_in_a_surface_model_are_flagged(tmp_path, kind):
    write_inputs(tmp_path)
    dsm = heights()
    dsm[8:12, 8:12], dsm[34, 40], dsm[36, 45] = np.nan, np.inf, -np.inf
    write_raster(tmp_path / "dsm.tif", dsm)
    result = run(write_config(tmp_path, {"surface": {"kind": kind, "path": "dsm.tif"}}))
    void = ~np.isfinite(dsm)
    assert np.all((result.mask & PixelFlag.NORMAL_UNRELIABLE)[void] != 0)
    far = np.zeros(SHAPE, bool)
    far[8:16, 22:28] = True
    assert not np.any(result.mask[far] & PixelFlag.NORMAL_UNRELIABLE)
    assert np.all(specular_state(result.mask)[far] == SpecularState.CORRECTED)


def test_a_surface_model_that_covers_a_part_is_used_there(tmp_path):
    write_inputs(tmp_path)
    whole = run(write_config(tmp_path))
    write_raster(tmp_path / "dsm.tif", heights()[:, :40])
    result = run(write_config(tmp_path))
    np.testing.assert_array_equal(result.removed[:, :, :36], whole.removed[:, :, :36])
    assert np.all(result.mask[28:40, 42:54] & PixelFlag.NORMAL_UNRELIABLE)


def test_beyond_the_class_map_there_is_no_material(tmp_path):
    write_inputs(tmp_path)
    write_raster(tmp_path / "class_map.tif", np.zeros((20, 20), np.uint8))
    result = run(write_config(tmp_path, materials={"classes": {"0": "roof_tile"}}))
    expected = np.ones(SHAPE, bool)
    expected[:20, :20] = False
    np.testing.assert_array_equal((result.mask & PixelFlag.NO_MATERIAL) != 0, expected)


@pytest.mark.parametrize(("dtype", "scale", "sure"), [("float32", 1.0, 0.5), ("uint8", 0.01, 50)])
def test_doubtful_classes_are_flagged(tmp_path, dtype, scale, sure):
    write_inputs(tmp_path)
    confidence = np.full(SHAPE, sure, dtype)
    confidence[7, 8] = sure * 0.9
    confidence[0, 40] = sure * 0.9  # on the ground, where nothing is corrected
    path = write_raster(tmp_path / "confidence.tif", confidence[:, :60])
    with rasterio.open(path, "r+") as file:
        file.scales = (scale,)
    result = run(write_config(tmp_path, {"class_confidence": "confidence.tif"}))
    expected = confidence < sure
    expected[:, 60:] = True  # nobody says
    np.testing.assert_array_equal((result.mask & PixelFlag.LOW_CONFIDENCE) != 0, expected)
    assert specular_state(result.mask)[7, 8] == SpecularState.CORRECTED


def moved(path, target, resampling, *, crs, cell):
    """A raster in another CRS and cell size, by GDAL's own reprojection."""
    with rasterio.open(path) as source:
        xs, ys = transform(source.crs, crs, [WEST - 3, WEST + 37, WEST - 3, WEST + 37], [NORTH + 3, NORTH - 28] * 2)
        west, north = min(xs), max(ys)
        shape = int((north - min(ys)) / cell) + 1, int((max(xs) - west) / cell) + 1
        values = np.full(shape, source.nodata or 0, source.dtypes[0])
        reproject(
            rasterio.band(source, 1),
            values,
            dst_transform=Affine(cell, 0, west, 0, -cell, north),
            dst_crs=crs,
            dst_nodata=source.nodata,
            resampling=resampling,
        )
    return write_raster(target, values, crs=crs, west=west, north=north, cell=cell, nodata=source.nodata)


@pytest.mark.parametrize(("crs", "cell"), [("EPSG:32631", 0.25), ("EPSG:32631", 0.5), ("EPSG:28992", 0.3)])
def test_a_class_map_and_a_surface_model_on_another_grid_give_nearly_the_same(tmp_path, crs, cell):
    write_inputs(tmp_path)
    write_raster(tmp_path / "dsm.tif", heights(), nodata=-9999)
    here = run(write_config(tmp_path))
    moved(tmp_path / "class_map.tif", tmp_path / "classes_there.tif", Resampling.nearest, crs=crs, cell=cell)
    moved(tmp_path / "dsm.tif", tmp_path / "dsm_there.tif", Resampling.bilinear, crs=crs, cell=cell)
    surface = {"kind": "dsm", "path": "dsm_there.tif"}
    there = run(write_config(tmp_path, {"class_map": "classes_there.tif", "surface": surface}))
    difference = np.abs(here.removed.astype(int) - there.removed).max(axis=0)
    inside = np.zeros(SHAPE, bool)  # away from edges of classes and of faces
    for rows, cols in ((slice(8, 18), slice(8, 28)), (slice(29, 31), slice(34, 52)), (slice(37, 39), slice(34, 52))):
        inside[rows, cols] = True
    assert difference[inside].max() <= 10  # of 1000 to 1600; 0.1 degrees of tilt
    assert np.mean(difference > 10) < 0.1


@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (48, 1), (17, 33)])
def test_images_of_any_shape(tmp_path, shape):
    write_inputs(tmp_path)
    rows, cols = shape
    write_image(tmp_path / "image.tif", image_values()[:, :rows, :cols])
    classes = np.full(SHAPE, TILE, np.uint8)
    write_raster(tmp_path / "class_map.tif", classes)
    result = run(write_config(tmp_path))
    assert result.corrected.shape == (BANDS, *shape)


GROWTH = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import numpy as np
from small_scene import *
from tscorr import batch

folder = Path(sys.argv[2])
peaks = []
for side in (2048, 4096):
    write_image(folder / "image.tif", np.full((2, side, side), 4000, np.int16), blockxsize=512, blockysize=512)
    write_raster(folder / "class_map.tif", np.full((side, side), TILE, np.uint8), blockxsize=512, blockysize=512)
    outcome = batch.run(write_config(folder, {"surface": {"kind": "flat"}}))
    assert outcome.scenes[0].state == "done", outcome.scenes[0].error
    peaks.append(outcome.scenes[0].report["peak_rss_mb"])
    del outcome
print(*peaks)
"""


def test_memory_does_not_grow_with_the_image(tmp_path):
    arguments = [sys.executable, "-c", GROWTH, str(Path(__file__).parent), str(tmp_path)]
    result = subprocess.run(arguments, capture_output=True, text=True, check=True)
    small, large = map(float, result.stdout.split())
    assert large < small + 60  # the larger image has 67 MB, 50 MB more than the smaller


def test_the_geometry_of_the_small_scene_is_what_its_tests_assume():
    assert CELL == 0.5
    assert CRS == "EPSG:28992"
    assert {TILE, METAL, GROUND} < set(np.unique(class_map()))
