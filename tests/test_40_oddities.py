"""scene: inputs that are unusual and right, each of which once went wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from small_scene import (
    CELL,
    METAL,
    NORTH,
    SHAPE,
    WEST,
    heights,
    image_values,
    read_raster,
    small_scene,
    write_config,
    write_image,
    write_inputs,
    write_raster,
)

from tscorr import batch, rasters
from tscorr.config import load_config
from tscorr.errors import ConfigError, InputError, OutputError
from tscorr.scene import run as scene_run
from tscorr.scene import strips
from tscorr.scene.survey import HeightSurvey


def run(config):
    """The folder of the only scene of a configuration."""
    (scene,) = batch.run(config, overwrite=True).scenes
    assert scene.error == ""
    return scene.folder


@pytest.mark.parametrize("kind", ["dsm", "roof_planes"])
@pytest.mark.parametrize(("scale", "offset"), [(0.01, 0.0), (0.01, -20.0), (0.5, 3.0)])
def test_scale_and_offset_of_a_surface_model_are_heeded(tmp_path, kind, scale, offset):
    stored = np.round((heights() - offset) / scale)
    config = small_scene(tmp_path, {"surface": {"kind": kind, "path": "dsm.tif"}})
    write_raster(tmp_path / "dsm.tif", (stored * scale + offset).astype(np.float32))
    plain = {name: read_raster(run(config) / f"{name}.tif") for name in ("corrected", "flags")}
    path = write_raster(tmp_path / "dsm.tif", stored.astype(np.int16))
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (scale,), (offset,)
    for name, values in plain.items():
        np.testing.assert_array_equal(read_raster(run(config) / f"{name}.tif"), values)


@pytest.mark.parametrize(("void", "dtype"), [(-9999, np.float32), (32767, np.int16), (3.4e38, np.float32)])
def test_heights_that_stand_for_none_must_be_said_to(tmp_path, void, dtype):
    config = small_scene(tmp_path)
    values = heights().astype(dtype)
    values[5:9, 5:9] = void
    path = write_raster(tmp_path / "dsm.tif", values)
    with pytest.raises(
        InputError, match=r"dsm\.tif has a height of .* m; allowed are -1000 to 10000\. If that .*nodata = "
    ):
        batch.plan(load_config(config))
    with rasterio.open(path, "r+") as file:
        file.nodata = void
    assert batch.plan(load_config(config))


@pytest.mark.parametrize("kind", ["dsm", "roof_planes"])
def test_a_small_surface_model_in_a_large_image(tmp_path, kind):
    """It lies between the places where the surface is surveyed."""
    size, first = 1600, 270
    write_image(tmp_path / "image.tif", np.full((3, size, size), 4000, np.int16), blockxsize=256, blockysize=256)
    write_raster(tmp_path / "class_map.tif", np.full((size, size), METAL, np.uint8), blockxsize=256, blockysize=256)
    place = {"west": WEST + first * CELL, "north": NORTH - first * CELL}
    write_raster(tmp_path / "dsm.tif", np.full((160, 160), 10.0, np.float32), **place)
    folder = run(write_config(tmp_path, {"surface": {"kind": kind, "path": "dsm.tif"}}))
    unreliable = read_raster(folder / "flags.tif")[0] >> 11 & 1
    assert unreliable[:first].all()
    assert not unreliable[first + 20 : first + 140, first + 20 : first + 140].any()


@pytest.mark.parametrize("width", [2400, 1400, 300])
def test_noise_is_that_of_the_part_that_a_surface_model_covers(tmp_path, width):
    rows = 2400
    values = 10 + np.random.default_rng(1).normal(0, 0.05, (rows, width))
    dsm = write_raster(tmp_path / "dsm.tif", values.astype(np.float32), blockxsize=256, blockysize=256)
    image = rasters.describe(write_raster(tmp_path / "image.tif", np.zeros((rows, rows), np.uint8)))
    with rasters.Reader(rasters.describe(dsm), image.grid, fill=float("nan"), margin=512) as reader:
        survey = HeightSurvey(reader, image.shape, 0.0)
        assert survey.noise_m == pytest.approx(0.05, rel=0.05)
        assert survey.level_m == pytest.approx(10, abs=0.01)


def test_a_picture_of_an_image_of_long_strips(tmp_path):
    """Whose blocks have fewer rows than the picture takes one of."""
    shape = 200, 60000
    path = write_raster(tmp_path / "image.tif", np.full((3, *shape), 4000, np.uint16), tiled=False, blockysize=1)
    with rasterio.open(path, "r+") as file:
        file.scales = (1e-4,) * 3
    write_raster(tmp_path / "class_map.tif", np.full(shape, METAL, np.uint8), blockxsize=256, blockysize=256)
    scene = {"surface": {"kind": "flat"}, "wavelength_um": [0.45, 0.55, 0.65]}
    folder = run(write_config(tmp_path, scene, output={"directory": "out", "quicklook": True}))
    assert (folder / "quicklook.png").exists()


def test_truth_is_compared_where_image_and_truth_have_values(tmp_path):
    write_inputs(tmp_path)
    values = (image_values() * 1e-4).astype(np.float32)
    diffuse = np.full_like(values, 0.2)
    write_raster(tmp_path / "sunlit.tif", np.ones(SHAPE, np.uint8))
    scene = {"truth": {"diffuse": "diffuse.tif", "sunlit": "sunlit.tif"}}
    output = {"directory": "out", "quicklook": False, "products": ["corrected", "flags", "uncertainty"]}
    reports = []
    for missing in (False, True):
        if missing:
            values[0, 30, 40] = diffuse[1, 31, 40] = np.nan
        write_raster(tmp_path / "image.tif", values)
        write_raster(tmp_path / "diffuse.tif", diffuse)
        folder = run(write_config(tmp_path, scene, output=output))
        reports.append(json.loads((folder / "report.json").read_text())["residual_glare"])
    whole, part = reports
    assert part["pixels"] == whole["pixels"] - 2
    assert part["rms_before"] == pytest.approx(whole["rms_before"], rel=0.01)


def test_a_class_map_that_has_no_value_to_spare_is_refused(tmp_path):
    write_inputs(tmp_path)
    classes = {str(value): "lambertian" for value in range(256)}
    with pytest.raises(ConfigError, match=r"\[materials.classes\] names every uint8 value"):
        batch.plan(load_config(write_config(tmp_path, materials={"classes": classes})))
    classes.pop("7")
    assert batch.plan(load_config(write_config(tmp_path, materials={"classes": classes})))


def test_writers_are_closed_where_a_later_one_cannot_be_opened(tmp_path, monkeypatch):
    config, writer_of = small_scene(tmp_path), scene_run.writer_of
    run(config)

    def failing(scene, folder, name, strip=None):
        if name == "removed":
            raise OutputError("no room")
        return writer_of(scene, folder, name, strip)

    monkeypatch.setattr(scene_run, "writer_of", failing)
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        assert batch.run(config, overwrite=True).scenes[0].error == "no room"
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.mark.parametrize("content", ['{"type": "Feature"}', "", "[]"])
def test_what_others_put_beside_results_does_not_stop_the_overview(tmp_path, content):
    config = small_scene(tmp_path, {"name": "a"}, {"name": "b"})
    batch.run(config)
    (tmp_path / "out/other").mkdir()
    (tmp_path / "out/other/item.json").write_text(content)
    (tmp_path / "out/b/report.json").write_text("")
    assert batch.run(config, scenes=["a"], overwrite=True).exit_code == 0
    links = json.loads((tmp_path / "out/collection.json").read_text())["links"]
    assert {link["href"] for link in links if link["rel"] == "item"} == {"./a/item.json", "./b/item.json"}


def test_strips_of_a_scene_whose_name_goes_on_are_kept(tmp_path):
    write_inputs(tmp_path)
    longer, shorter = batch.plan(load_config(write_config(tmp_path, {"name": "roof.2"}, {"name": "roof"})))
    kept, cleared = (strips.Strips(scene, 0.001) for scene in (longer, shorter))
    for cut in (kept, cleared):
        strips.prepare(cut)
    strips.clear(shorter)
    assert (kept.folder.exists(), cleared.folder.exists()) == (True, False)
    with pytest.raises(OutputError, match=r"masks of shadows in .* are gone"):
        strips.correct_strip(cleared, 0)
