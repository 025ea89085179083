"""Commands to start with an image, and the ways to call all of them: as a rasterio plug-in, completed by a shell."""

import json
import os
import re
import subprocess
import sys
import tomllib
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner
from jsonschema import Draft202012Validator
from matplotlib.image import imread  # Pillow
from rasterio.rio.main import main_group
from small_scene import (
    CRS,
    NORTH,
    TILE,
    WAVELENGTHS,
    WEST,
    read_raster,
    small_scene,
    write_image,
    write_inputs,
    write_raster,
)

from tscorr.cli import cli
from tscorr.config import FILL_IN, Config, template
from tscorr.config.scenes import SURFACES, VIEWS, Scene, Sun, Truth
from tscorr.correction import SpecularState, specular_state

ROOT = Path(__file__).parent.parent


def tscorr(*arguments):
    """The result of a command; stdout and stderr apart."""
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


# A configuration to start from.


def filled(text):
    """A configuration with the three values that a user fills in: the camera mirrors the sun off flat ground."""
    assert text.count(FILL_IN) == 4  # one is in the head, which says what to do
    values = {
        f'1 = "{FILL_IN}"': f'{TILE} = "roof_tile"',
        f'time = "{FILL_IN}"': "time = 2024-06-20T11:42:00Z",
        f'position = "{FILL_IN}"': f"position = [{WEST + 16:.1f}, {NORTH + 300:.1f}, 500.0]",
    }
    for empty, value in values.items():
        assert text.count(empty) == 1
        text = text.replace(empty, value)
    return text


def test_init_writes_a_configuration_that_runs_after_three_values(tmp_path):
    write_inputs(tmp_path)
    config = tmp_path / "city.toml"
    result = tscorr("init", tmp_path / "image.tif", "-o", config)
    assert (result.exit_code, result.stderr) == (0, "")
    assert f"tscorr plan {config}" in result.stdout
    text = config.read_text()
    assert "48 rows, 64 columns, 3 bands of int16; EPSG:28992" in text
    config.write_text(filled(text))
    result = tscorr("run", config, "-q")
    assert (result.exit_code, result.stderr) == (0, "")
    states = specular_state(read_raster(tmp_path / "out/image/flags.tif")[0])
    assert np.count_nonzero(states == SpecularState.CORRECTED) > 100


def test_until_they_are_filled_in_the_values_are_named(tmp_path):
    write_inputs(tmp_path)
    config = tmp_path / "city.toml"
    tscorr("init", tmp_path / "image.tif", "-o", config)
    result = tscorr("plan", config)
    assert result.exit_code == 2
    assert "sun.time = 'FILL IN'" in result.stderr
    assert "view.position = 'FILL IN'" in result.stderr
    config.write_text(filled(config.read_text()).replace('"roof_tile"', f'"{FILL_IN}"'))
    assert "no material 'FILL IN'" in tscorr("plan", config).stderr


def test_init_names_every_key_of_a_scene():
    """Those of its tables too, whatever their kind."""
    text = template("image.tif", "class_map.tif", "city")
    keys = {key for table in (Scene, Sun, Truth, *VIEWS.values(), *SURFACES.values()) for key in table.model_fields}
    assert {key for key in keys if not re.search(rf"\b{key}\b", text)} == set()
    assert "None" not in text


def test_init_overwrites_nothing_and_names_what_is_wrong(tmp_path, monkeypatch):
    write_image(tmp_path / "image.tif")
    monkeypatch.chdir(tmp_path)
    assert tscorr("init", "image.tif").exit_code == 0
    before = (tmp_path / "image.toml").read_bytes()
    again = tscorr("init", "image.tif")
    assert (again.exit_code, again.stderr) == (
        2,
        "tscorr: image.toml exists and is not overwritten; name another by -o\n",
    )
    assert (tmp_path / "image.toml").read_bytes() == before
    assert "IMAGE is missing" in tscorr("init").stderr
    assert "cannot be read" in tscorr("init", "image.toml", "-o", "x.toml").stderr
    assert "x.toml cannot be written" in tscorr("init", "image.tif", "-o", "nix/x.toml").stderr
    assert not (tmp_path / "x.toml").exists()


def test_paths_of_a_new_configuration_start_at_its_folder(tmp_path):
    for folder in ("flights", "maps", "configs"):
        (tmp_path / folder).mkdir()
    write_image(tmp_path / "flights/a.tif")
    write_image(tmp_path / "maps/b.tif")
    config = tmp_path / "configs/city.toml"
    tscorr("init", tmp_path / "flights/a.tif", "--class-map", tmp_path / "maps/b.tif", "-o", config)
    (scene,) = tomllib.loads(config.read_text())["scenes"]
    assert (scene["image"], scene["class_map"]) == ("../flights/a.tif", "../maps/b.tif")


def test_every_alternative_of_a_new_configuration_is_a_valid_one():
    text = filled(template("a.tif", "c.tif", 'a "quoted" title'))
    kinds = {"view": {"frame"}, "surface": {"flat"}, "sun": {None}}
    for line in re.findall(r"^# ((?:view|surface|sun) = .*)$", text, flags=re.MULTILINE):
        key = line.split()[0]
        scene = Config.model_validate(tomllib.loads(re.sub(rf"^{key} = .*$", line, text, flags=re.MULTILINE))).scenes[
            0
        ]
        kinds[key].add(getattr(getattr(scene, key), "kind", None))
    assert kinds == {"view": set(VIEWS), "surface": set(SURFACES), "sun": {None}}


def test_a_new_configuration_holds_every_key_with_its_default():
    config = Config.model_validate(tomllib.loads(filled(template("a.tif", "c.tif", "a"))))
    bare = Config.model_validate(
        {"materials": config.materials.model_dump(include={"classes"}), "scenes": [config.scenes[0].model_dump()]}
    )
    assert config.model_copy(update={"title": ""}) == bare
    text = template("a.tif", "c.tif", "a")
    for section in (Config.model_fields[name].annotation for name in ("output", "model", "correction", "run")):
        for key in section.model_fields:
            assert re.search(rf"^(# )?{key} = .*# \w+", text, flags=re.MULTILINE), key


# The schema for editors.


@pytest.fixture(scope="module")
def schema():
    return json.loads(tscorr("init", "--schema").stdout)


def as_json(value):
    """What an editor makes of TOML: dates are text."""
    if isinstance(value, dict):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, list):
        return [as_json(item) for item in value]
    return value.isoformat() if isinstance(value, datetime) else value


def test_the_schema_is_one_and_takes_what_we_ship(schema):
    Draft202012Validator.check_schema(schema)
    validator = Draft202012Validator(schema)
    for path in (ROOT / "configs").glob("*.toml"):
        validator.validate(as_json(tomllib.loads(path.read_text())))


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [("output", "formt", "cog"), ("output", "format", "jpeg"), ("correction", "uncorrectable_share", 2)],
)
def test_the_schema_refuses_what_the_program_refuses(schema, table, key, value):
    good = as_json(tomllib.loads(filled(template("a.tif", "c.tif", "a"))))
    validator = Draft202012Validator(schema)
    assert validator.is_valid(good)
    good[table][key] = value
    assert not validator.is_valid(good)


# Pictures of an image.


@pytest.fixture
def grey(tmp_path):
    """An image of 18 % reflectance in the visible, and 50 % in the near infrared."""
    path = write_raster(
        tmp_path / "grey.tif",
        np.array([1800, 1800, 1800, 5000], np.int16)[:, None, None] + np.zeros((4, 30, 50), np.int16),
    )
    with rasterio.open(path, "r+") as file:
        file.scales = (1e-4,) * 4
        for band, um in enumerate((*WAVELENGTHS, 0.84), start=1):
            file.update_tags(band, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=str(um), FWHM_UM="0.02")
    return path


def test_quicklook_shows_18_percent_as_grey_0461(grey, tmp_path):
    result = tscorr("quicklook", grey, "-o", tmp_path / "x.png", "--exposure", 1)
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.strip().endswith("x.png: shown: 475 nm, 560 nm, 668 nm; not shown: 840 nm; exposure 1")
    np.testing.assert_allclose(imread(tmp_path / "x.png")[..., :3], 0.461, atol=0.003)


def test_quicklook_exposes_the_bright_parts_near_white(grey, tmp_path):
    assert "exposure 5" in tscorr("quicklook", grey, "-o", tmp_path / "x.png").stdout  # 0.9 / 0.18
    tscorr("quicklook", grey, "-o", tmp_path / "half.png", "--exposure", 0.5)
    np.testing.assert_allclose(imread(tmp_path / "half.png")[..., :3], 0.3320, atol=0.003)  # IEC 61966-2-1 of 0.09


def test_quicklook_writes_linear_light_as_exr(grey, tmp_path):
    from OpenImageIO import ImageInput

    for exposure, light in ((None, 0.18), (2, 0.36)):
        options = [] if exposure is None else ["--exposure", exposure]
        assert tscorr("quicklook", grey, "-o", tmp_path / "x.exr", *options).exit_code == 0
        written = ImageInput.open(str(tmp_path / "x.exr"))
        np.testing.assert_allclose(written.read_image("float"), light, rtol=1e-3)
        written.close()


def test_quicklook_in_false_colour_shows_the_infrared_as_red(grey, tmp_path):
    result = tscorr("quicklook", grey, "-o", tmp_path / "x.png", "--false-colour", "--exposure", 1)
    assert "shown: 560 nm, 668 nm, 840 nm" in result.stdout
    colour = imread(tmp_path / "x.png")[..., :3]
    np.testing.assert_allclose(colour[..., 0], 0.7354, atol=0.003)  # IEC 61966-2-1 of 0.5
    np.testing.assert_allclose(colour[..., 1:], 0.461, atol=0.003)


@pytest.mark.parametrize("exposure", ["nan", "inf"])
def test_an_exposure_is_a_number(grey, tmp_path, exposure):
    result = tscorr("quicklook", grey, "-o", tmp_path / "x.png", "--exposure", exposure)
    assert result.exit_code == 2
    assert f"exposure = {exposure}; allowed is a number above 0" in result.stderr


def test_quicklook_refuses_what_it_cannot_draw(grey, tmp_path):
    write_image(tmp_path / "rgb.tif")
    cases = {
        (grey, "x.jpg"): "ends in '.jpg'; allowed are .png and .exr",
        (grey, "nix/x.png"): "nix/x.png",
        (tmp_path / "rgb.tif", "x.png", "--false-colour"): "near-infrared",
    }
    for (image, output, *options), message in cases.items():
        result = tscorr("quicklook", image, "-o", tmp_path / output, *options)
        assert result.exit_code == 2
        assert message in result.stderr
        assert not (tmp_path / output).exists()
    tscorr("quicklook", tmp_path / "rgb.tif", "-o", tmp_path / "own.png")
    before = (tmp_path / "own.png").read_bytes()
    assert "is the image itself" in tscorr("quicklook", tmp_path / "own.png", "-o", tmp_path / "own.png").stderr
    assert (tmp_path / "own.png").read_bytes() == before


PEAK = """
import re, sys
from pathlib import Path
from tscorr.scene.pictures import draw_image

def peak_mb():
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1e3

draw_image(Path(sys.argv[1]), Path(sys.argv[2]), max_px=512)
first = peak_mb()
draw_image(Path(sys.argv[3]), Path(sys.argv[2]), max_px=512)
print(peak_mb() - first)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read as Linux tells it")
@pytest.mark.parametrize("interleave", ["band", "pixel"])
def test_quicklook_of_an_enormous_image_needs_little_memory(tmp_path, interleave):
    """Of 20000 x 20000 pixels, 2.4 GB: what it takes beyond a small image's picture of the same size. [MB]"""
    for name, size in (("small.tif", 600), ("large.tif", 20000)):
        profile = {"driver": "GTiff", "count": 3, "height": size, "width": size, "dtype": "uint16", "crs": CRS}
        profile |= {"tiled": True, "blockxsize": 512, "blockysize": 512, "sparse_ok": True, "interleave": interleave}
        with rasterio.open(
            tmp_path / name, "w", transform=Affine(0.5, 0, WEST, 0, -0.5, NORTH), compress="deflate", **profile
        ) as file:
            file.write(np.full((3, 512, 512), 1800, np.uint16), window=((0, 512), (0, 512)))
    arguments = [sys.executable, "-c", PEAK, tmp_path / "small.tif", tmp_path / "x.png", tmp_path / "large.tif"]
    result = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert float(result.stdout) < 120
    assert imread(tmp_path / "x.png").shape[:2] == (512, 512)


# Other ways to call.


def test_rio_has_the_commands_as_a_plug_in(tmp_path):
    config = small_scene(tmp_path)
    result = CliRunner().invoke(main_group, ["tscorr", "run", str(config)])
    assert result.exit_code == 0
    assert "roof_tile" in result.stdout
    assert (tmp_path / "out/roofs/corrected.tif").exists()
    assert CliRunner().invoke(main_group, ["tscorr", "plan", str(tmp_path / "nix.toml")]).exit_code == 2


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_commands_and_options(shell):
    environment = {**os.environ, "_TSCORR_COMPLETE": f"{shell}_source"}
    command = [sys.executable, "-m", "tscorr"]
    script = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert "_TSCORR_COMPLETE" in script
    words = {"COMP_WORDS": "tscorr run --over", "COMP_CWORD": "2" if shell != "fish" else "--over"}
    environment |= {"_TSCORR_COMPLETE": f"{shell}_complete", **words}
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert "--overwrite" in answer
