"""config: every problem is named with its place, its value and the nearest known key, before any work starts."""

import datetime as dt
import re
from pathlib import Path

import pytest
from small_scene import SCENE, write_config

from tscorr import config
from tscorr.config import load_config
from tscorr.errors import ConfigError

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.toml"))


def problems(path):
    """The lines of the error that a configuration raises."""
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    return str(caught.value).splitlines()


def problem_of(folder, scene=None, **sections):
    """The only line of the error that a changed default configuration raises."""
    (line,) = problems(write_config(folder, scene or {}, **sections))
    assert line.startswith(str(folder / "city.toml"))
    return line


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_every_shipped_configuration_loads_and_its_files_exist(path):
    loaded = load_config(path)
    for scene in loaded.scenes:
        for file in (scene.image, scene.class_map):
            assert Path(file).is_file()
    assert all(Path(library).is_file() for library in loaded.materials.library)


def test_there_is_a_configuration_to_load():
    assert CONFIGS


@pytest.mark.parametrize(
    ("change", "wrong", "place", "meant"),
    [
        ({"ouput": {"directory": "x"}}, "ouput", "the top level", "output"),
        ({"output": {"directry": "x"}}, "directry", "output", "directory"),
        ({"model": {"from": "full"}}, "from", "model", "form"),
        (
            {"correction": {"negligable_reflectance": 1e-4}},
            "negligable_reflectance",
            "correction",
            "negligible_reflectance",
        ),
        ({"run": {"worker": 1}}, "worker", "run", "workers"),
        ({"materials": {"classes": {"1": "a"}, "libary": []}}, "libary", "materials", "library"),
        (
            {"materials": {"classes": {"1": "line"}, "settings": {"line": {"enable": False}}}},
            "enable",
            "materials.settings.line",
            "enabled",
        ),
    ],
)
def test_an_unknown_key_of_a_table_names_the_nearest(tmp_path, change, wrong, place, meant):
    assert f"unknown key '{wrong}' in {place} (did you mean '{meant}'?)" in problem_of(tmp_path, **change)


@pytest.mark.parametrize(
    ("change", "wrong", "place", "meant"),
    [
        ({"clas_map": "x"}, "clas_map", "scene 'roofs'", "class_map"),
        ({"sun": {"zenith_deg": 40.0, "azimuth_deg": 180.0, "tme": 1}}, "tme", "scene 'roofs'.sun", "time"),
        ({"view": {**SCENE["view"], "zenit_deg": 1.0}}, "zenit_deg", "scene 'roofs'.view", "zenith_deg"),
        (
            {"view": {"kind": "frame", "position": [0.0, 0.0, 1.0], "hight_offset_m": 1.0}},
            "hight_offset_m",
            "scene 'roofs'.view",
            "height_offset_m",
        ),
        ({"view": {"kind": "line", "trajectory": "t.csv", "csr": "EPSG:4326"}}, "csr", "scene 'roofs'.view", "crs"),
        ({"surface": {"kind": "flat", "height": 1.0}}, "height", "scene 'roofs'.surface", "height_m"),
        ({"surface": {"kind": "roof_planes", "path": "x", "pth": "y"}}, "pth", "scene 'roofs'.surface", "path"),
        ({"surface": {"kind": "normals", "path": "x", "height": "y"}}, "height", "scene 'roofs'.surface", "heights"),
        ({"truth": {"diffuse": "x", "sunlit": "y", "sunlight": "z"}}, "sunlight", "scene 'roofs'.truth", "sunlit"),
    ],
)
def test_an_unknown_key_of_a_scene_names_the_nearest(tmp_path, change, wrong, place, meant):
    assert f"unknown key '{wrong}' in {place} (did you mean '{meant}'?)" in problem_of(tmp_path, change)


def test_a_key_that_is_like_nothing_known_gets_no_advice(tmp_path):
    assert problem_of(tmp_path, run={"qqqq": 1}).endswith("unknown key 'qqqq' in run")


@pytest.mark.parametrize(
    ("scene", "sections", "place", "value"),
    [
        ({"saturation": "bright"}, {}, "scene 'roofs'.saturation = 'bright'", "one a band"),
        ({"scale": [1.0, "x"]}, {}, "scene 'roofs'.scale = [1.0, 'x']", "one a band"),
        ({"sun": {"zenith_deg": 95.0, "azimuth_deg": 0.0}}, {}, "scene 'roofs'.sun.zenith_deg", "95.0"),
        ({"sun": {"zenith_deg": float("nan"), "azimuth_deg": 0.0}}, {}, "scene 'roofs'.sun.zenith_deg", "nan"),
        ({"sun": {"time": "2026-06-21T10:12:00", "zenith_deg": 1.0}}, {}, "scene 'roofs'.sun", "zone"),
        ({"sun": {"zenith_deg": 40.0}}, {}, "scene 'roofs'.sun", "azimuth_deg"),
        (
            {"view": {"kind": "fram", "position": [0, 0, 1]}},
            {},
            "scene 'roofs'.view.kind = 'fram'",
            "did you mean 'frame'",
        ),
        ({"view": {"zenith_deg": 1.0}}, {}, "scene 'roofs'.view", "'kind'"),
        ({"surface": {"kind": "dsms", "path": "x"}}, {}, "scene 'roofs'.surface.kind = 'dsms'", "did you mean 'dsm'"),
        ({"view": {"kind": "frame", "position": [0.0, 1.0]}}, {}, "scene 'roofs'.view.position.2", "is missing"),
        ({"quantity": "radiance"}, {}, "scene 'roofs'.quantity", "'brdf'"),
        ({}, {"model": {"form": "half"}}, "model.form", "'simplified'"),
        ({}, {"run": {"workers": -1}}, "run.workers", "-1"),
        ({}, {"run": {"workers": 1.5}}, "run.workers", "1.5"),
        ({}, {"run": {"workers": True}}, "run.workers = true", "valid integer"),
        ({}, {"run": {"workers": "2"}}, "run.workers = '2'", "valid integer"),
        ({}, {"run": {"skip": "no"}}, "run.skip = 'no'", "valid boolean"),
        ({"shadows": 0}, {}, "scene 'roofs'.shadows = 0", "valid boolean"),
        ({"direct_fraction": True}, {}, "scene 'roofs'.direct_fraction = true", "one a band"),
        ({"direct_fraction": ["0.8", "0.9"]}, {}, "scene 'roofs'.direct_fraction = ['0.8', '0.9']", "one a band"),
        ({"nodata": "0"}, {}, "scene 'roofs'.nodata = '0'", "valid number"),
        ({"view": {"kind": "frame", "position": [0, "1", 2]}}, {}, "scene 'roofs'.view.position.1 = '1'", "number"),
        ({}, {"correction": {"image_noise": [True, 0.1]}}, "correction.image_noise = [True, 0.1]", "such pairs"),
        ({}, {"output": {"products": ["colours"]}}, "output.products.0", "'flags'"),
        ({}, {"correction": {"uncorrectable_share": 2.0}}, "correction.uncorrectable_share", "2.0"),
        ({}, {"correction": {"max_zenith_deg": 90.0}}, "correction.max_zenith_deg", "90"),
        ({}, {"materials": {"classes": {"tiles": "roof_tile"}}}, "materials.classes", "'tiles'"),
        ({}, {"materials": {"classes": {"1": 7}}}, "materials.classes.1", "7"),
    ],
)
def test_a_wrong_value_is_named_with_its_place(tmp_path, scene, sections, place, value):
    line = problem_of(tmp_path, scene, **sections)
    assert f"{tmp_path / 'city.toml'}: {place}" in line
    assert value in line


@pytest.mark.parametrize(
    ("names", "place"),
    [
        ({"name": "north"}, "scene 'north'.sun"),
        ({"name": None, "image": "north.tif"}, "scene 'north.tif'.sun"),
        ({"name": None, "image": None}, "scenes.0.sun"),
        ({"name": 7}, "scenes.0.sun"),
        ({"name": "a\nb"}, r"scene 'a\nb'.sun"),
    ],
)
def test_a_scene_is_called_by_its_name_or_its_image(tmp_path, names, place):
    with pytest.raises(ConfigError) as caught:
        load_config(write_config(tmp_path, {"sun": {"zenith_deg": 40.0}, **names}))
    assert f": {place} = " in str(caught.value)


@pytest.mark.parametrize("key", ["image", "class_map", "view"])
def test_a_missing_key_is_named(tmp_path, key):
    assert problem_of(tmp_path, {key: None}).endswith(f"scene 'roofs'.{key} is missing")


def test_missing_tables_are_named(tmp_path):
    path = tmp_path / "city.toml"
    path.write_text("")
    assert {line.split(": ")[1] for line in problems(path)} == {"materials is missing", "scenes is missing"}


@pytest.mark.parametrize(
    ("change", "home"),
    [
        ({"correction": {"precision": "fast"}}, "model"),
        ({"materials": {"classes": {"1": "line"}, "settings": {"line": {"image_noise": [0, 0]}}}}, "correction"),
        ({"output": {"workers": 2}}, "run"),
    ],
)
def test_a_key_of_another_table_is_sent_there(tmp_path, change, home):
    assert problem_of(tmp_path, **change).endswith(f" (it is a key of [{home}])")


def test_one_pair_of_brackets_is_one_too_few(tmp_path):
    path = tmp_path / "city.toml"
    path.write_text('[materials.classes]\n1 = "roof_tile"\n[scenes]\nimage = "image.tif"\n')
    assert problems(path) == [f"{path}: [scenes] is one table; allowed is one for each scene, headed [[scenes]]"]


def test_results_need_a_folder(tmp_path):
    assert "output.directory = ''" in problem_of(tmp_path, output={"directory": ""})


def test_every_problem_is_listed_at_once(tmp_path):
    path = write_config(tmp_path, {"quantity": "x", "imag": "y"}, model={"form": "z"})
    assert len(problems(path)) == 3


def test_a_file_that_is_no_toml_names_the_line(tmp_path):
    path = tmp_path / "city.toml"
    path.write_text('title = "x"\n[output\n')
    (line,) = problems(path)
    assert str(path) in line
    assert "line 2" in line


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"])
def test_a_file_that_is_missing_or_no_text_is_named(tmp_path, content):
    path = tmp_path / "city.toml"
    if content is not None:
        path.write_bytes(content)
    (line,) = problems(path)
    assert str(path) in line


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    scene = {"surface": {"kind": "normals", "path": "../n.tif", "heights": "h.tif"}, "class_confidence": "c.tif"}
    path = write_config(
        tmp_path / "sub",
        scene,
        output={"directory": "../out"},
        materials={"library": ["../m.toml"], "classes": {"1": "a"}},
    )
    monkeypatch.chdir(tmp_path)
    loaded = load_config(path.relative_to(tmp_path))
    (only,) = loaded.scenes
    assert only.image == str(tmp_path / "sub" / "image.tif")
    assert only.class_confidence == str(tmp_path / "sub" / "c.tif")
    assert only.surface == config.NormalsSettings(
        kind="normals", path=str(tmp_path / "n.tif"), heights=str(tmp_path / "sub" / "h.tif")
    )
    assert loaded.output.directory == str(tmp_path / "out")
    assert loaded.materials.library == [str(tmp_path / "m.toml")]


def test_a_glob_makes_a_scene_of_each_image_and_fills_in_stem_and_parent(tmp_path):
    for name in ("b/two.tif", "a/one.tif", "a/other.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    scene = {
        "name": None,
        "image": "*/*.tif",
        "class_map": "{parent}/{stem}_classes.tif",
        "view": {"kind": "line", "trajectory": "lines/{stem}.csv"},
    }
    scenes = load_config(write_config(tmp_path, scene)).scenes
    assert [item.name for item in scenes] == ["one", "two"]
    assert [item.class_map for item in scenes] == [
        str(tmp_path / "a/one_classes.tif"),
        str(tmp_path / "b/two_classes.tif"),
    ]
    assert scenes[1].view.trajectory == str(tmp_path / "lines/two.csv")


def test_a_glob_that_matches_nothing_or_takes_one_name_for_many_is_refused(tmp_path):
    for name in ("one.tif", "two.tif"):
        (tmp_path / name).touch()
    assert "no image matches nix*.tif" in problem_of(tmp_path, {"image": "nix*.tif"})
    assert "the name 'roofs' cannot serve 2 images" in problem_of(tmp_path, {"image": "*.tif"})


@pytest.mark.parametrize("name", ["", "..", " . ", "a/b", "a\\b", "/etc", "x" * 101, "a\nb", "<b>"])
def test_a_name_that_is_no_safe_folder_is_refused(tmp_path, name):
    assert "a name is a folder" in problem_of(tmp_path, {"name": name})


def test_the_stem_of_an_image_must_be_a_safe_name_too(tmp_path):
    assert "a name is a folder" in problem_of(tmp_path, {"name": None, "image": "x" * 101 + ".tif"})


def test_two_scenes_of_one_name_are_refused(tmp_path):
    (line,) = problems(write_config(tmp_path, {"name": None}, {"name": "image"}))
    assert "two scenes are called 'image'" in line


def test_settings_of_a_material_are_read_and_must_be_of_a_used_one(tmp_path):
    classes = {"1": "roof_tile"}
    settings = {"roof_tile": {"form": "simplified", "direct_fraction": [0.7, 0.8], "enabled": False}}
    loaded = load_config(write_config(tmp_path, materials={"classes": classes, "settings": settings}))
    own = loaded.materials.settings["roof_tile"]
    assert (own.form, own.direct_fraction, own.enabled, own.precision) == ("simplified", [0.7, 0.8], False, None)
    line = problem_of(tmp_path, materials={"classes": classes, "settings": {"roof_tyle": {}}})
    assert (
        "[materials.settings.roof_tyle] is for no material of [materials.classes] (did you mean 'roof_tile'?)" in line
    )


def test_any_key_of_model_and_correction_can_be_set_for_one_material():
    of_the_image = {"image_noise", "direction_sigma_deg", "weigh_by_confidence"}
    keys = set(config.Model.model_fields) | set(config.Correction.model_fields) - of_the_image | {"enabled"}
    assert set(config.MaterialSettings.model_fields) == keys


def test_defaults_are_those_of_the_design(tmp_path):
    loaded = load_config(write_config(tmp_path))
    assert loaded.output.products == ["corrected", "flags", "removed"]
    assert (loaded.model.form, loaded.model.precision) == ("full", "fast")
    assert loaded.correction.uncorrectable_share == 0.9
    assert loaded.correction.irradiance_plane == "horizontal"
    assert (loaded.run.workers, loaded.run.skip) == (0, True)
    assert loaded.scenes[0].shadows


def test_messages_speak_of_the_file_and_not_of_the_library(tmp_path):
    (line,) = problems(write_config(tmp_path, {"quantity": 7}))
    assert not re.search("pydantic|https?:", line)


@pytest.mark.parametrize(
    ("sun", "shown"),
    [
        ({"time": dt.time(12)}, "sun.time = 12:00:00; allowed is a date and a time with its zone"),
        ({"time": dt.datetime(2026, 6, 21, 12)}, "sun.time = 2026-06-21 12:00:00; allowed is a date and"),  # noqa: DTZ001 - has no zone
        ({"time": "noon"}, "sun.time = 'noon'; allowed is a date and a time with its zone, like 2026-06-21T10:12:00Z"),
        ({"time": "FILL IN"}, "sun.time = 'FILL IN' is still to be filled in"),
    ],
)
def test_a_wrong_time_is_shown_as_it_was_written(tmp_path, sun, shown):
    assert shown in problem_of(tmp_path, {"sun": sun})
