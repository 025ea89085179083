"""cli: commands, exit codes, and one clear message for everything that can be wrong before work starts."""

import io
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from small_scene import (
    BANDS,
    METAL,
    NODATA,
    SCENE,
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
    write_truncated_image,
)
from test_30_rasters import hostile_tiff

from tscorr.cli import cli
from tscorr.cli.common import COMPILING
from tscorr.correction import PixelFlag


def tscorr(*arguments):
    """The command in this process: exit_code, stdout, stderr."""
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def in_a_shell(*arguments, **options):
    """The command in a process of its own."""
    command = [sys.executable, "-m", "tscorr", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


# Bad input: one message, exit code 2, nothing written.


def changed_scene(**changes):
    """A maker of the default scene with other keys."""
    return lambda folder: small_scene(folder, changes)


def changed_file(write, **changes):
    """A maker of the default scene with one input written anew."""

    def make(folder):
        write_inputs(folder)
        write(folder)
        return write_config(folder, changes)

    return make


def short_trajectory(folder):
    """Ten seconds of flight over the first metres of the scene."""
    lines = [f"2024-05-15T13:30:{second:02d}Z,{WEST + second},447705.0,500.0" for second in range(10)]
    (folder / "track.csv").write_text("\n".join(["utc,x,y,z", *lines]) + "\n")


def two_bands(folder):
    write_image(folder / "image.tif", image_values()[:2])


NARROW = """
[narrow]
wavelength_um = [0.5, 0.6]
t0 = 0.02
t1 = 0.2
w = 0.04
n = 1.7
"""


def narrow_material(folder):
    write_inputs(folder)
    (folder / "narrow.toml").write_text(NARROW)
    return write_config(folder, materials={"library": ["narrow.toml"], "classes": {"1": "narrow"}})


def narrow_material_without_wavelengths(folder):
    config = narrow_material(folder)
    write_raster(folder / "image.tif", image_values())
    return config


def missing_library(folder):
    write_inputs(folder)
    return write_config(folder, materials={"library": ["nix.toml"], "classes": {"1": "roof_tile"}})


def truncated_header(folder):
    path = write_image(folder / "image.tif")
    os.truncate(path, path.stat().st_size // 2)  # the directory was moved to the end when tags were added


BAD = {
    "unknown config key": (
        changed_scene(surfce={"kind": "flat"}),
        ["city.toml", "unknown key 'surfce'", "did you mean 'surface'"],
    ),
    "missing image": (changed_scene(image="nix.tif"), ["roofs", "nix.tif does not exist"]),
    "missing class map": (changed_scene(class_map="nix.tif"), ["nix.tif does not exist"]),
    "missing surface model": (changed_scene(surface={"kind": "dsm", "path": "nix.tif"}), ["nix.tif does not exist"]),
    "missing trajectory": (changed_scene(view={"kind": "line", "trajectory": "nix.csv"}), ["nix.csv"]),
    "missing confidence": (changed_scene(class_confidence="nix.tif"), ["nix.tif does not exist"]),
    "missing truth": (changed_scene(truth={"diffuse": "nix.tif", "sunlit": "nix.tif"}), ["nix.tif does not exist"]),
    "missing library": (missing_library, ["nix.toml cannot be read"]),
    "unknown material": (
        lambda folder: small_scene(folder, materials={"classes": {"1": "roof_tyle"}}),
        ["[materials.classes] 1: no material 'roof_tyle'", "did you mean 'roof_tile'", "red_aluminum"],
    ),
    "wrong band count": (changed_scene(wavelength_um=[0.5, 0.6]), ["2 values", "image.tif has 3 bands"]),
    "wrong count of fractions": (
        changed_file(two_bands, direct_fraction=[0.8, 0.8, 0.9]),
        ["direct_fraction has 3 values", "image.tif has 2 bands"],
    ),
    "wavelength outside a material": (
        narrow_material,
        ["'narrow'", "narrow.toml", "covers 0.5 to 0.6 um", "0.475 um", "image.tif"],
    ),
    "wavelengths in nanometres": (
        changed_scene(wavelength_um=[475, 560, 668]),
        ["wavelength_um = 475", "image.tif", "0.1 to 100 um (550 nm are 0.55 um)"],
    ),
    "negative scale": (changed_scene(scale=-1e-4), ["image.tif has the scale -0.0001", "above 0"]),
    "one class twice": (
        lambda folder: small_scene(folder, materials={"classes": {"1": "roof_tile", "01": "red_aluminum"}}),
        ["city.toml", "materials.classes", "names 1 more than once"],
    ),
    "unknown wavelengths": (narrow_material_without_wavelengths, ["'narrow'", "wavelength_um", "image.tif"]),
    "no overlap of the class map": (
        changed_file(lambda folder: write_raster(folder / "class_map.tif", class_map(), west=10000.0)),
        ["class_map.tif covers x 10000 to 10032", "does not overlap", "image.tif, x 84664 to 84696"],
    ),
    "no overlap of the surface model": (
        changed_file(lambda folder: write_raster(folder / "dsm.tif", heights(), north=460000.0)),
        ["dsm.tif covers", "does not overlap"],
    ),
    "sun below the horizon by time": (
        changed_scene(sun={"time": datetime(2024, 5, 15, 23, tzinfo=UTC)}),
        ["2024-05-15T23:00:00+00:00", "zenith angle of 108", "below 90"],
    ),
    "sun below the horizon": (changed_scene(sun={"zenith_deg": 95.0, "azimuth_deg": 0.0}), ["sun.zenith_deg = 95.0"]),
    "no sun": (changed_scene(sun=None), ["image.tif has no sun"]),
    "camera below the ground": (
        changed_scene(view={"kind": "frame", "position": [84680.0, 447700.0, 3.0]}),
        ["camera at height 3.0 m", "highest point is at 5.0 m"],
    ),
    "trajectory that ends early": (
        changed_file(short_trajectory, view={"kind": "line", "trajectory": "track.csv"}),
        ["track.csv does not cover the scene"],
    ),
    "unknown crs of a view": (
        changed_scene(view={"kind": "frame", "position": [4.0, 52.0, 300.0], "crs": "EPSG:999999"}),
        ["crs = 'EPSG:999999'"],
    ),
    "truncated image header": (changed_file(truncated_header), ["image.tif cannot be read"]),
    "no raster": (changed_file(lambda folder: (folder / "dsm.tif").write_text("text")), ["dsm.tif cannot be read"]),
    "image without a CRS": (
        changed_file(lambda folder: write_image(folder / "image.tif", crs=None)),
        ["image.tif has no CRS"],
    ),
    "class map without a CRS": (
        changed_file(lambda folder: write_raster(folder / "class_map.tif", class_map(), crs=None)),
        ["class_map.tif has no CRS"],
    ),
    "surface model without a CRS": (
        changed_file(lambda folder: write_raster(folder / "dsm.tif", heights(), crs=None)),
        ["dsm.tif has no CRS", "projected CRS in metres"],
    ),
    "surface model in degrees": (
        changed_file(
            lambda folder: write_raster(
                folder / "dsm.tif", heights(), crs="EPSG:4326", west=4.35, north=52.01, cell=1e-5
            )
        ),
        ["dsm.tif is in degrees", "projected CRS in metres"],
    ),
    "class map in a CRS of its own": (
        changed_file(
            lambda folder: write_raster(folder / "class_map.tif", class_map(), crs='LOCAL_CS["x",UNIT["metre",1]]')
        ),
        ["class_map.tif", "CRS"],
    ),
    "surface model without heights": (
        changed_file(lambda folder: write_raster(folder / "dsm.tif", heights() * np.nan)),
        ["dsm.tif holds no heights"],
    ),
    "class map of fractions": (
        changed_file(lambda folder: write_raster(folder / "class_map.tif", class_map().astype("float32"))),
        ["class_map.tif holds float32", "integers"],
    ),
    "class map of two bands": (
        changed_file(lambda folder: write_raster(folder / "class_map.tif", np.stack([class_map()] * 2))),
        ["class_map.tif has 2 bands"],
    ),
    "a class that is nodata": (
        changed_file(lambda folder: write_raster(folder / "class_map.tif", class_map(), nodata=TILE)),
        ["class_map.tif has the nodata value 1"],
    ),
    "surface model of two bands": (
        changed_file(lambda folder: write_raster(folder / "dsm.tif", np.stack([heights()] * 2))),
        ["dsm.tif has 2 bands"],
    ),
    "image of doubles": (
        changed_file(lambda folder: write_raster(folder / "image.tif", image_values(np.float64))),
        ["image.tif holds float64", "int16"],
    ),
    "nodata that no pixel can be": (
        changed_file(lambda folder: write_raster(folder / "image.tif", image_values(np.uint16)), nodata=-1.0),
        ["nodata = -1", "uint16", "image.tif"],
    ),
    "nodata wanted but unknown": (
        lambda folder: (
            (write_inputs(folder), write_raster(folder / "image.tif", image_values()))
            and write_config(folder, correction={"uncorrectable": "nodata"})
        ),
        ["uncorrectable = 'nodata'", "image.tif has no nodata value"],
    ),
    "direct fraction above one": (
        changed_scene(direct_fraction=1.2),
        ["city.toml", "'roofs'.direct_fraction = 1.2", "a share from 0 to 1"],
    ),
}


@pytest.mark.parametrize("command", ["run", "plan"])
@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_a_message_and_nothing_is_written(tmp_path, case, command):
    make, parts = BAD[case]
    config = make(tmp_path)
    before = files(tmp_path)
    result = tscorr(command, config)
    assert result.exit_code == 2
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == (2 if case == "image without a CRS" else 1)  # two inputs cannot be laid over it
    for line in lines:
        assert line.startswith("tscorr: ")
        for part in parts:
            assert part in line
    assert files(tmp_path) == before


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("name", ["image.tif", "class_map.tif", "dsm.tif"])
def test_a_hostile_raster_is_refused_wherever_it_stands(tmp_path, name):
    config = small_scene(tmp_path)
    hostile_tiff(tmp_path / name)
    result = tscorr("run", config)
    assert result.exit_code == 2
    assert f"{name} is stored in tiles of 60000 x 60000 pixels" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", ["unknown crs of a view", "class map in a CRS of its own", "truncated image header"])
def test_in_a_shell_there_is_one_message_too(tmp_path, case):
    result = in_a_shell("run", BAD[case][0](tmp_path))
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("tscorr: ")


def test_a_missing_configuration_and_an_unknown_option_are_bad_usage(tmp_path):
    assert tscorr("run", tmp_path / "nix.toml").exit_code == 2
    assert tscorr("run", small_scene(tmp_path), "--nix").exit_code == 2
    assert tscorr("nix").exit_code == 2


# Bad values inside of rasters are no reason to fail.


def test_nan_and_infinity_do_not_fail_but_are_flagged(tmp_path):
    write_inputs(tmp_path)
    values = image_values(np.float32) / 1e4
    values[0, 8, 8], values[1, 9, 9] = np.nan, np.inf
    write_image(tmp_path / "image.tif", values, nodata=None)
    dsm = heights()
    dsm[34, 40], dsm[36, 45] = np.nan, np.inf
    write_raster(tmp_path / "dsm.tif", dsm)
    result = tscorr("run", write_config(tmp_path, {"scale": 1.0}), "-q")
    assert (result.exit_code, result.stderr) == (0, "")
    flags = read_raster(tmp_path / "out/roofs/flags.tif")[0]
    assert flags[8, 8] & flags[9, 9] & PixelFlag.NODATA
    assert flags[34, 40] & flags[36, 45] & PixelFlag.NORMAL_UNRELIABLE


# What is found out only while working fails the scene.


def test_an_image_cut_short_fails_its_scene_and_leaves_nothing_half_written(tmp_path):
    write_inputs(tmp_path)
    write_truncated_image(tmp_path / "image.tif")
    config = write_config(tmp_path, {"scale": 1e-4})
    assert tscorr("plan", config).exit_code == 0  # the header is whole
    result = in_a_shell("run", config)
    assert result.returncode == 3
    (line,) = result.stderr.replace(f"{COMPILING}\n", "").splitlines()
    assert line.startswith(f"tscorr: scene 'roofs' failed: {tmp_path / 'image.tif'} cannot be read at rows 0 to 48")
    assert "roofs: failed: " in result.stdout
    assert files(tmp_path / "out") == ["batch.json", "batch.log", "index.html"]


def test_one_of_two_scenes_cut_short_is_exit_code_1(tmp_path):
    write_inputs(tmp_path)
    write_truncated_image(tmp_path / "cut.tif")
    config = write_config(tmp_path, {"name": "a", "image": "cut.tif", "scale": 1e-4}, {"name": "b"})
    result = tscorr("run", config)
    assert result.exit_code == 1
    assert (tmp_path / "out" / "b").is_dir()


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="no limit of file size")
def test_a_full_disk_fails_the_scene_and_leaves_nothing_half_written(tmp_path):
    import resource

    write_inputs(tmp_path)
    noise = np.random.default_rng(2).integers(3000, 6000, (BANDS, 256, 256)).astype(np.int16)
    write_image(tmp_path / "image.tif", noise, compress="none", blockxsize=64, blockysize=64)
    write_raster(tmp_path / "class_map.tif", np.full((256, 256), TILE, np.uint8))
    config = write_config(tmp_path, {"surface": {"kind": "flat"}})
    limit = 200_000  # of 393 kB
    result = in_a_shell("run", config, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
    assert result.returncode == 3
    assert "Traceback" not in result.stderr
    assert "tif cannot be written" in result.stdout
    assert not (tmp_path / "out" / "roofs").exists()
    assert not [name for name in files(tmp_path / "out") if name.startswith(".")]


# Commands that do what they are asked.


def test_run_prints_a_table_and_then_that_nothing_is_to_do(tmp_path):
    config = small_scene(tmp_path)
    result = tscorr("run", config)
    assert (result.exit_code, result.stderr.replace(f"{COMPILING}\n", "")) == (0, "")
    header, *rows = result.stdout.splitlines()
    assert header.split() == ["scene", "material", "corrected", "uncorrectable", "share", "p95", "share", "max"]
    tiles = np.count_nonzero(class_map() == TILE)
    assert rows[0].split()[:4] == ["roofs", "roof_tile", str(tiles), "0"]
    assert rows[1].split()[:2] == ["roofs", "red_aluminum"]
    assert rows[-1] == f"results: {tmp_path / 'out'}"
    again = tscorr("run", config)
    assert again.exit_code == 0
    assert "roofs: nothing to do, the result is current" in again.stdout


def test_run_quietly_prints_nothing(tmp_path):
    result = tscorr("run", small_scene(tmp_path), "-q")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")


def test_run_tells_the_residual_glare_where_the_truth_is_known(tmp_path):
    write_inputs(tmp_path)
    truth = image_values().astype(np.float32) / 1e4 - 0.05
    write_raster(tmp_path / "diffuse.tif", truth)
    write_raster(tmp_path / "sunlit.tif", np.ones(SHAPE, np.uint8))
    result = tscorr("run", write_config(tmp_path, {"truth": {"diffuse": "diffuse.tif", "sunlit": "sunlit.tif"}}))
    assert "roofs: residual glare 0.0500 before, " in result.stdout


def test_run_can_be_restricted_to_scenes_and_materials(tmp_path):
    write_inputs(tmp_path)
    config = write_config(tmp_path, {"name": "a"}, {"name": "b"})
    assert tscorr("run", config, "--scene", "b", "--material", "red_aluminum", "--workers", "1").exit_code == 0
    assert not (tmp_path / "out" / "a").exists()
    removed = read_raster(tmp_path / "out/b/removed.tif")
    assert not removed[:, class_map() == TILE].any()
    assert removed[:, class_map() == METAL].any()
    result = tscorr("run", config, "--scene", "c")
    assert result.exit_code == 2
    assert "no scene 'c'" in result.stderr


def test_run_overwrites_when_told(tmp_path):
    config = small_scene(tmp_path)
    tscorr("run", config)
    before = (tmp_path / "out/roofs").stat().st_ino
    tscorr("run", config)
    assert (tmp_path / "out/roofs").stat().st_ino == before
    tscorr("run", config, "--overwrite")
    assert (tmp_path / "out/roofs").stat().st_ino != before


def test_an_interruption_is_exit_code_130(tmp_path, monkeypatch):
    from tscorr import batch

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(batch, "run", interrupted)
    result = tscorr("run", small_scene(tmp_path))
    assert result.exit_code == 130
    assert result.stderr.startswith("tscorr: interrupted")


def test_plan_counts_and_writes_nothing(tmp_path):
    config = small_scene(tmp_path)
    before = files(tmp_path)
    result = tscorr("plan", config, "--json")
    assert result.exit_code == 0
    (scene,) = json.loads(result.stdout)["scenes"]
    classes = class_map()
    assert scene["scene"] == "roofs"
    assert (scene["rows"], scene["cols"], scene["bands"]) == (*SHAPE, BANDS)
    assert scene["materials"]["roof_tile"] == pytest.approx(np.mean(classes == TILE))
    assert scene["no_material"] == pytest.approx(np.mean(classes == 9))
    assert scene["view_zenith_deg"] == pytest.approx([40, 40, 40])
    assert scene["current"] is False
    text = tscorr("plan", config).stdout
    assert f"image.tif, {SHAPE[0]} x {SHAPE[1]} x {BANDS}" in text
    assert "to be computed" in text
    assert files(tmp_path) == before


def test_plan_knows_what_is_current(tmp_path):
    config = small_scene(tmp_path)
    tscorr("run", config)
    assert json.loads(tscorr("plan", config, "--json").stdout)["scenes"][0]["current"] is True
    assert "current: nothing to do" in tscorr("plan", config).stdout


def values_of(text):
    """Name and value of each indented line of `explain`."""
    return {line[2:26].strip(): line[27:].strip() for line in text.splitlines() if line.startswith("  ")}


def test_explain_tells_what_the_run_did(tmp_path):
    config = small_scene(tmp_path)
    tscorr("run", config)
    result = tscorr("explain", config, "--scene", "roofs", "--pixel", 8, 9)
    assert result.exit_code == 0
    known = values_of(result.stdout)
    assert known["class"] == str(TILE)
    assert known["material"].startswith("roof_tile")
    assert [float(angle) for angle in known["sun"].split()[:2]] == pytest.approx([40, 180], abs=1e-3)
    assert float(known["incidence"].split()[0]) == pytest.approx(40, abs=1e-3)
    assert known["state"] == "corrected"
    folder = tmp_path / "out/roofs"
    for band, wavelength in enumerate((0.475, 0.56, 0.668)):
        stored = [read_raster(path)[band, 8, 9] for path in (tmp_path / "image.tif", folder / "removed.tif")]
        corrected = read_raster(folder / "corrected.tif")[band, 8, 9]
        expected = [f"{value * 1e-4:.5f}" for value in (*stored, corrected)]
        assert result.stdout.splitlines()[band - 3].split()[-3:] == expected, wavelength


def test_explain_gives_no_numbers_for_no_data(tmp_path):
    config = small_scene(tmp_path)
    values = image_values()
    values[1, 8, 9] = NODATA
    write_image(tmp_path / "image.tif", values)
    result = tscorr("explain", config, "--scene", "roofs", "--pixel", 8, 9)
    assert "NODATA" in values_of(result.stdout)["set"]
    first, second, third = result.stdout.splitlines()[-3:]
    assert second.endswith("no data")
    assert f"{NODATA * 1e-4:.5f}" not in result.stdout
    assert all(len(line.split()) > 3 for line in (first, third))


def test_explain_invents_no_view(tmp_path):
    """Where nobody knows from where the pixel was seen: no direction, and no model."""
    small_scene(tmp_path)
    zenith = np.full(SHAPE, 40.0, np.float32)
    zenith[8, 9] = np.nan
    write_raster(tmp_path / "z.tif", zenith)
    write_raster(tmp_path / "a.tif", np.zeros(SHAPE, np.float32))
    config = write_config(tmp_path, {"view": {"kind": "angles", "zenith": "z.tif", "azimuth": "a.tif"}})
    unknown, known = (tscorr("explain", config, "--pixel", 8, column).stdout for column in (9, 10))
    assert values_of(unknown)["view"] == values_of(unknown)["seen from"] == "not known"
    assert "NOT_VIEWED" in values_of(unknown)["set"]
    assert ("exitance" in unknown, "exitance" in known) == (False, True)


def test_explain_says_that_a_material_is_switched_off(tmp_path):
    small_scene(tmp_path)
    materials = {"classes": {str(TILE): "roof_tile"}, "settings": {"roof_tile": {"enabled": False}}}
    off = tscorr("explain", write_config(tmp_path, materials=materials), "--pixel", 8, 9)
    assert values_of(off.stdout)["enabled"].startswith("false")


def test_explain_asks_which_scene_only_where_there_are_several(tmp_path):
    small_scene(tmp_path)
    assert tscorr("explain", write_config(tmp_path), "--pixel", 8, 9).exit_code == 0
    result = tscorr("explain", write_config(tmp_path, {"name": "a"}, {"name": "b"}), "--pixel", 8, 9)
    assert result.exit_code == 2
    assert result.stderr == f"tscorr: give --scene: {tmp_path}/city.toml has a, b\n"


def test_explain_writes_nothing(tmp_path):
    config = small_scene(tmp_path)
    before = files(tmp_path)
    assert tscorr("explain", config, "--scene", "roofs", "--pixel", 0, 0).exit_code == 0
    assert files(tmp_path) == before


@pytest.mark.parametrize("pixel", [(48, 0), (0, 64), (-1, 0)])
def test_explain_refuses_a_pixel_outside_of_the_image(tmp_path, pixel):
    result = tscorr("explain", small_scene(tmp_path), "--scene", "roofs", "--pixel", *pixel)
    assert result.exit_code == 2
    assert f"pixel {pixel[0]} {pixel[1]} is outside of the image {tmp_path / 'image.tif'}, 48 x 64" in result.stderr


def test_materials_lists_the_library_and_others(tmp_path):
    result = tscorr("materials")
    assert result.exit_code == 0
    names = [line.split()[0] for line in result.stdout.splitlines()[1:-1]]
    assert set(names) >= {"spectralon_50", "roof_tile", "red_concrete", "blue_concrete", "red_aluminum", "lambertian"}
    (tmp_path / "narrow.toml").write_text(NARROW)
    (line,) = (
        line
        for line in tscorr("materials", "--library", tmp_path / "narrow.toml").stdout.splitlines()
        if "narrow" in line
    )
    assert line.split()[-6:] == ["2", "0.02", "0.2", "0.04", "1.7", "0"]


def test_verify_finds_a_flipped_byte_and_a_lost_file(tmp_path):
    config = small_scene(tmp_path)
    tscorr("run", config)
    good = tscorr("verify", tmp_path / "out")
    assert (good.exit_code, good.stdout) == (0, "1 results, 0 problems\n")
    path = tmp_path / "out/roofs/corrected.tif"
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(content)
    (tmp_path / "out/roofs/flags.tif").unlink()
    bad = tscorr("verify", tmp_path / "out")
    assert bad.exit_code == 1
    assert f"{path} has changed since it was published" in bad.stdout
    assert "flags.tif is missing" in bad.stdout


def test_verify_of_a_folder_without_results_is_bad_usage(tmp_path):
    result = tscorr("verify", tmp_path)
    assert result.exit_code == 2
    assert "holds no manifest.json" in result.stderr


def test_the_settings_written_beside_the_results_make_the_same_results(tmp_path):
    config = small_scene(tmp_path)
    tscorr("run", config)
    first = tmp_path / "out" / "roofs"
    settings = tomllib.loads((first / "settings.toml").read_text())
    assert settings["scenes"][0]["sun"] == SCENE["sun"]
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(first / "settings.toml", again / "city.toml")
    assert tscorr("run", again / "city.toml").exit_code == 0
    for product in ("corrected", "flags", "removed"):
        np.testing.assert_array_equal(
            read_raster(again / "out" / "roofs" / f"{product}.tif"), read_raster(first / f"{product}.tif")
        )


# Starting.

HEAVY = (
    "numpy",
    "numba",
    "scipy",
    "matplotlib",
    "pandas",
    "pvlib",
    "colour",
    "OpenImageIO",
    "rasterio",
    "pydantic",
    "rich",
)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["run", "--help"], ["plan", "--help"]])
def test_help_loads_nothing_heavy(arguments):
    code = (
        "import sys\n"
        "from tscorr.cli import cli\n"
        f"try: cli({arguments!r}, prog_name='tscorr')\n"
        "except SystemExit: pass\n"
        f"print('loaded', *(name for name in {HEAVY!r} if name in sys.modules))\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "loaded"


def test_a_run_with_given_angles_needs_no_pvlib(tmp_path):
    code = (
        "import sys\n"
        "from tscorr.cli import cli\n"
        "try: cli(['run', sys.argv[1], '-q'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "print(*(name for name in ('pvlib', 'pandas', 'colour', 'OpenImageIO', 'rich') if name in sys.modules))\n"
    )
    arguments = [sys.executable, "-c", code, str(small_scene(tmp_path))]
    assert subprocess.run(arguments, capture_output=True, text=True, check=True).stdout.strip() == ""


def test_the_version_is_that_of_the_package_and_is_stamped_into_the_outputs(tmp_path):
    from tscorr import __version__

    assert __version__ in tscorr("--version").stdout
    tscorr("run", small_scene(tmp_path))
    with rasterio.open(tmp_path / "out/roofs/corrected.tif") as file:
        assert file.tags()["TSCORR_VERSION"] == __version__


def test_plan_shows_where_the_glare_is_and_what_lies_beyond_the_class_map(tmp_path):
    """The sensor stands opposite to the sun, as SCENE has it: at 180."""
    config = small_scene(tmp_path)
    write_raster(tmp_path / "class_map.tif", class_map()[:, : SHAPE[1] // 2])
    result = tscorr("plan", config)
    assert "  relative azimuth 180 to 180, median 180 degrees; the glare is at 180\n" in result.stdout
    assert "  surface dsm, cast shadows are looked for\n" in result.stdout
    assert "(outside the class map: 50.0 %, " in result.stdout


def test_all_missing_files_of_a_scene_are_told_at_once(tmp_path):
    config = small_scene(
        tmp_path, {"class_confidence": "sure.tif", "view": {"kind": "line", "trajectory": "line.csv"}}
    )
    for name in ("image.tif", "class_map.tif", "dsm.tif"):
        (tmp_path / name).unlink()
    missing = ("image.tif", "class_map.tif", "sure.tif", "line.csv", "dsm.tif")
    lines = [f"tscorr: scene 'roofs': {tmp_path / name} does not exist" for name in missing]
    assert tscorr("plan", config).stderr.splitlines() == lines


@pytest.mark.parametrize("dtype", [np.uint8, np.int32])
def test_plan_names_the_classes_without_material(tmp_path, dtype):
    config = small_scene(tmp_path)
    values = class_map().astype(dtype)
    values[40:, :8] = 77
    write_raster(tmp_path / "class_map.tif", values)
    shares = {str(value): np.mean(values == value) for value in (77, UNKNOWN)}
    (planned,) = json.loads(tscorr("plan", config, "--json").stdout)["scenes"]
    assert planned["classes_without_material"] == pytest.approx(shares)
    listed = f"class 77: {100 * shares['77']:.1f} %, class {UNKNOWN}: {100 * shares[str(UNKNOWN)]:.1f} %"
    assert f"of the pixels ({listed})\n" in tscorr("plan", config).stdout


def test_plan_and_report_agree_on_the_views():
    planned = json.loads(tscorr("plan", Path(__file__).parent.parent / "configs" / "delft.toml", "--json").stdout)[
        "scenes"
    ][1]
    assert planned["view_zenith_deg"] == pytest.approx([0.0, 11.4, 22.6], abs=0.6)  # the sample's README


@pytest.mark.parametrize(
    ("classes", "keys", "said"),
    [
        ({"7": "roof_tile"}, {}, "roofs: nothing was assessed: no class of [materials.classes] occurs where"),
        ({str(TILE): "roof_tile"}, {"saturation": 0.9}, "roofs: every pixel is saturated: is `saturation` in stored"),
        (
            {str(TILE): "roof_tile"},
            {"view": {"kind": "constant", "zenith_deg": 88.0, "azimuth_deg": 0.0}, "surface": {"kind": "flat"}},
            "roofs: no pixel of roof_tile was assessed; of the scene's 3,072 pixels 336 are GRAZING",
        ),
    ],
)
def test_what_can_hardly_be_meant_is_said(tmp_path, classes, keys, said):
    small_scene(tmp_path)
    result = tscorr("run", write_config(tmp_path, keys, materials={"classes": classes}))
    assert (result.exit_code, said in result.stdout) == (0, True)


def test_a_program_that_logs_everything_hears_of_warnings_only(tmp_path):
    """As rio does, which has this as a plug-in: its handler takes what comes."""
    config = small_scene(tmp_path)
    tscorr("run", config)
    heard = io.StringIO()
    handler = logging.StreamHandler(heard)
    logging.getLogger().addHandler(handler)
    try:
        assert "nothing to do" in tscorr("run", config).stdout
    finally:
        logging.getLogger().removeHandler(handler)
    assert heard.getvalue() == ""
