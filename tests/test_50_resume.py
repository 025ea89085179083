"""Resume by content: exactly the scenes are computed again whose values a change can touch."""

import json
import os
import re
import shutil

import numpy as np
import pytest
from small_scene import SHAPE, TILE, heights, write_config, write_image, write_inputs, write_raster

from tscorr import batch
from tscorr.batch import local
from tscorr.errors import ConfigError
from tscorr.scene import correct

LIBRARY = """
[tiles]
t0 = 0.02
t1 = {t1}
w = 0.04
n = 1.7
"""
UNUSED = """
[not_used]
t0 = 0.03
t1 = 0.1
w = 0.03
n = 1.5
"""
OUTPUT = {"directory": "out", "quicklook": False, "products": ["corrected", "flags", "azimuthal_width"]}
MATERIALS = {"library": ["own.toml"], "classes": {str(TILE): "tiles", "2": "roof_tile"}}


def write(folder, *, a=None, b=None, **sections):
    """The configuration of two scenes, b with an image and a class map of its own, and some keys changed."""
    own = {"name": "b", "image": "b.tif", "class_map": "b_classes.tif"}
    sections = {"output": OUTPUT, "materials": MATERIALS, **sections}
    return write_config(folder, {"name": "a", **(a or {})}, {**own, **(b or {})}, **sections)


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Two scenes and their results: the folder, and a copy of it as it was at first."""
    folder = tmp_path_factory.mktemp("city")
    write_inputs(folder)
    for copied, original in (("b.tif", "image.tif"), ("b_classes.tif", "class_map.tif")):
        shutil.copy(folder / original, folder / copied)
    (folder / "own.toml").write_text(LIBRARY.format(t1=0.2))
    assert batch.run(write(folder)).exit_code == 0
    shutil.copytree(folder, folder.with_name("saved"))
    return folder


@pytest.fixture
def city(published):
    """The folder of the two scenes, for one test."""
    shutil.rmtree(published)
    shutil.copytree(published.with_name("saved"), published)
    return published


@pytest.fixture
def computed(monkeypatch):
    """Names of the scenes that a run sets out to compute; it does not compute them."""
    names = []

    def note(scene, _):
        names.append(scene.name)
        return json.loads((correct.target_of(scene) / "report.json").read_text())

    monkeypatch.setattr(local, "correct_scene", note)
    return names


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ({}, ""),
        ({"title": "another title"}, ""),
        ({"run": {"workers": 1}}, ""),
        ({"run": {"memory_limit_mb": 1000}}, ""),
        ({"model": {"form": "full"}}, ""),  # the default
        ({"model": {"form": "simplified"}}, "ab"),
        ({"model": {"precision": "exact"}}, "ab"),
        ({"correction": {"uncorrectable_share": 0.5}}, "ab"),
        ({"correction": {"max_zenith_deg": 60.0}}, "ab"),
        ({"materials": {**MATERIALS, "settings": {"tiles": {"form": "simplified"}}}}, "ab"),
        ({"materials": {**MATERIALS, "settings": {"tiles": {"enabled": False}}}}, "ab"),
        ({"materials": {**MATERIALS, "classes": {str(TILE): "lambertian"}}}, "ab"),
        ({"output": {**OUTPUT, "compression": "zstd"}}, "ab"),
        ({"output": {**OUTPUT, "format": "cog"}}, "ab"),
        ({"output": {**OUTPUT, "quicklook": True}}, "ab"),
        ({"output": {**OUTPUT, "products": ["corrected", "flags", "azimuthal_width", "angles"]}}, "ab"),
        ({"output": {**OUTPUT, "products": ["flags", "corrected"]}}, ""),  # all that is wanted is there
        ({"a": {"direct_fraction": 0.5}}, "a"),
        ({"a": {"shadows": False}}, "a"),
        ({"b": {"sun": {"zenith_deg": 41.0, "azimuth_deg": 180.0}}}, "b"),
        ({"b": {"view": {"kind": "constant", "zenith_deg": 40.0, "azimuth_deg": 1.0}}}, "b"),
        ({"b": {"surface": {"kind": "flat"}}}, "b"),
        ({"b": {"class_map": "class_map.tif"}}, "b"),
        ({"b": {"saturation": 9000}}, "b"),
    ],
    ids=str,
)
def test_a_changed_setting_concerns_the_scenes_that_it_touches(city, computed, change, again):
    batch.run(write(city, **change))
    assert "".join(sorted(computed)) == again


def change_the_image_of_b(folder):
    write_image(folder / "b.tif", np.full((3, *SHAPE), 4000, np.int16))


def change_the_classes_of_b(folder):
    write_raster(folder / "b_classes.tif", np.full(SHAPE, TILE, np.uint8))


def change_the_heights_of_both(folder):
    write_raster(folder / "dsm.tif", heights() + np.float32(0.25))


def touch_the_image_of_a(folder):
    os.utime(folder / "image.tif")


def change_a_material(folder):
    (folder / "own.toml").write_text(LIBRARY.format(t1=0.3))


def change_a_material_of_no_class(folder):
    (folder / "own.toml").write_text("# a remark\n" + LIBRARY.format(t1=0.2) + UNUSED)


def show_the_image_of_a_in_a_gis(folder):
    statistics = '<MDI key="STATISTICS_MEAN">4500</MDI>'
    band = f'<PAMRasterBand band="1"><Metadata>{statistics}</Metadata></PAMRasterBand>'
    (folder / "image.tif.aux.xml").write_text(f"<PAMDataset>{band}</PAMDataset>")


def give_the_image_of_a_another_scale(folder):
    band = '<PAMRasterBand band="1"><Scale>2e-4</Scale></PAMRasterBand>'
    (folder / "image.tif.aux.xml").write_text(f"<PAMDataset>{band}</PAMDataset>")


def lose_an_output_of_b(folder):
    (folder / "out/b/flags.tif").unlink()


def cut_an_output_of_a(folder):
    os.truncate(folder / "out/a/report.html", 1000)


def lose_the_manifest_of_a(folder):
    (folder / "out/a/manifest.json").unlink()


def flip_a_bit_of_the_manifest_of_b(folder):
    path = folder / "out/b/manifest.json"
    path.write_text(path.read_text().replace("corrected.tif", "corrected.tig"))


@pytest.mark.parametrize(
    ("change", "again"),
    [
        (change_the_image_of_b, "b"),
        (change_the_classes_of_b, "b"),
        (change_the_heights_of_both, "ab"),
        (touch_the_image_of_a, "a"),
        (change_a_material, "ab"),
        (change_a_material_of_no_class, ""),
        (show_the_image_of_a_in_a_gis, ""),
        (give_the_image_of_a_another_scale, "a"),
        (lose_an_output_of_b, "b"),
        (cut_an_output_of_a, "a"),
        (lose_the_manifest_of_a, "a"),
        (flip_a_bit_of_the_manifest_of_b, "b"),
    ],
)
def test_a_changed_file_concerns_the_scenes_that_it_touches(city, computed, change, again):
    change(city)
    batch.run(write(city))
    assert "".join(sorted(computed)) == again


def test_another_version_computes_everything_again(city, computed, monkeypatch):
    monkeypatch.setattr(correct, "__version__", "9.9")
    batch.run(write(city), workers=1)  # more would do them side by side
    assert computed == ["a", "b"]


def test_overwrite_computes_what_is_asked_for_again(city, computed):
    batch.run(write(city), scenes=["b"], overwrite=True)
    assert computed == ["b"]


def test_what_was_computed_again_is_then_current(city):
    change_the_image_of_b(city)
    assert [scene.state for scene in batch.run(write(city)).scenes] == ["current", "done"]
    assert [scene.state for scene in batch.run(write(city)).scenes] == ["current", "current"]


def test_a_result_of_one_material_does_not_take_the_place_of_a_whole_one_unasked(city):
    config = write(city)
    with pytest.raises(ConfigError) as caught:
        batch.run(config, materials=["tiles"])
    first, second = str(caught.value).splitlines()
    assert re.fullmatch(rf"scene 'a': {city}/out/a holds the result of all materials; .*overwrite.*", first)
    assert second.startswith("scene 'b': ")
    assert [scene.state for scene in batch.run(config).scenes] == ["current", "current"]
    result = batch.run(config, scenes=["a"], materials=["tiles"], overwrite=True)
    assert [scene.state for scene in result.scenes] == ["done"]
    assert [scene.state for scene in batch.run(config, scenes=["a"], materials=["tiles"]).scenes] == ["current"]
    assert [scene.state for scene in batch.run(config).scenes] == ["done", "current"]


def test_an_input_that_changes_while_a_scene_is_computed_fails_the_scene(city):
    def growing(scene):
        def pixels(_):
            if scene.name == "a":
                os.utime(city / "image.tif", (1, 1))

        return pixels

    config = write(city)
    before = (city / "out/a/manifest.json").read_bytes()
    result = batch.run(config, overwrite=True, progress=growing)
    assert [scene.state for scene in result.scenes] == ["failed", "done"]
    error = result.scenes[0].error
    assert error == f"the input {city}/image.tif has changed while the scene was computed; run again once it is whole"
    assert (city / "out/a/manifest.json").read_bytes() == before


def test_an_input_that_is_taken_away_while_a_scene_is_computed_fails_the_scene(city):
    def losing(_):
        return lambda _: (city / "b_classes.tif").unlink(missing_ok=True)

    result = batch.run(write(city), overwrite=True, progress=losing)
    assert [scene.state for scene in result.scenes] == ["done", "failed"]
    assert "b_classes.tif" in result.scenes[1].error
