"""preflight: what a batch needs is looked at before any pixel, and all that is missing is told at once."""

import os
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime

import numpy as np
import pytest
from small_scene import (
    BANDS,
    CELL,
    SHAPE,
    TILE,
    WEST,
    read_raster,
    small_scene,
    write_config,
    write_image,
    write_inputs,
    write_raster,
)

from tscorr import batch
from tscorr.batch import preflight
from tscorr.config import load_config
from tscorr.errors import ConfigError, InputError, OutputError
from tscorr.scene import forecast


@pytest.fixture
def no_pixels(monkeypatch):
    """Fails where a scene is computed."""
    monkeypatch.setattr(batch.local, "correct_scene", lambda *_: pytest.fail("work started"))


def problems(config, error=InputError, **options):
    """The lines of what `run` says before it starts."""
    with pytest.raises(error) as caught:
        batch.run(config, **options)
    assert type(caught.value) is error
    return str(caught.value).splitlines()


@pytest.mark.usefixtures("no_pixels")
def test_everything_that_is_wrong_is_told_at_once(tmp_path):
    write_inputs(tmp_path)
    write_raster(tmp_path / "percent.tif", np.full(SHAPE, 80, np.uint8))
    write_raster(tmp_path / "one_band.tif", np.ones(SHAPE, np.float32))
    (tmp_path / "file").write_text("x")
    config = write_config(
        tmp_path,
        {"name": "a", "image": "nix.tif"},
        {"name": "b", "class_map": "no_classes.tif", "class_confidence": "percent.tif", "sun": None},
        {"name": "c", "truth": {"diffuse": "one_band.tif", "sunlit": "one_band.tif"}, "scale": [1.0, 2.0]},
        {"name": "d"},
        output={"directory": "file/out"},
        materials={"classes": {"1": "roof_tyle", "2": "lambertian"}},
    )
    told = problems(config)
    wanted = [
        "[materials.classes] 1: no material 'roof_tyle' (did you mean 'roof_tile'?)",
        f"scene 'a': {tmp_path}/nix.tif does not exist",
        f"scene 'b': {tmp_path}/no_classes.tif does not exist",
        f"scene 'b': the class confidence {tmp_path}/percent.tif holds values from 80 to 80; allowed are 0 to 1",
        f"scene 'c': the truth {tmp_path}/one_band.tif has 1 bands of {SHAPE}; allowed are {BANDS} of {SHAPE}",
        "scene 'c': scale has 2 values; the image",
        f"[output] directory = {tmp_path}/file/out: {tmp_path}/file is not a folder",
    ]
    assert [line[: len(start)] for line, start in zip(told, wanted, strict=True)] == wanted


def test_a_stored_scale_makes_a_confidence_in_per_cent_right(tmp_path):
    write_inputs(tmp_path)
    write_raster(tmp_path / "percent.tif", np.full(SHAPE, 80, np.uint8))
    import rasterio

    with rasterio.open(tmp_path / "percent.tif", "r+") as file:
        file.scales = (0.01,)
    assert batch.plan(load_config(write_config(tmp_path, {"class_confidence": "percent.tif"})))


@pytest.mark.usefixtures("no_pixels")
def test_a_disk_that_is_too_small_is_told_with_the_estimate(tmp_path, monkeypatch, caplog):
    config = small_scene(tmp_path, {"name": "a"}, {"name": "b"})
    stored = min((tmp_path / "image.tif").stat().st_size, SHAPE[0] * SHAPE[1] * BANDS * 2)
    pixel = BANDS * 2 + 2 + BANDS * 2 + 2 / 8  # corrected, flags and removed, two masks
    raw = SHAPE[0] * SHAPE[1] * pixel + forecast.BESIDE_BYTES
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda _: usage._replace(free=2 * stored - 1))
    (line,) = problems(config, OutputError)
    assert f"the results need {2 * stored / 1e6:.1f} MB on the disk of {tmp_path}" in line
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda _: usage._replace(free=int(2 * raw) - 1))
    batch.plan(load_config(config), to_run=True)
    assert "the results may need up to" in caplog.text
    caplog.clear()
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda _: usage._replace(free=int(2 * raw)))
    batch.plan(load_config(config), to_run=True)
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("values", "keys", "told"),
    [
        (np.full((BANDS, *SHAPE), 3000, np.uint16), {}, True),
        (np.full((BANDS, *SHAPE), 1, np.uint16), {"scale": 1.0}, False),
        (np.full((BANDS, *SHAPE), 3000, np.uint16), {"scale": 1e-4}, False),
        (np.full((BANDS, *SHAPE), 0.3, np.float32), {}, False),
    ],
)
def test_whole_numbers_without_a_scale_are_doubted(tmp_path, caplog, values, keys, told):
    write_inputs(tmp_path)
    write_raster(tmp_path / "image.tif", values)
    batch.plan(load_config(write_config(tmp_path, {"name": "a", **keys}, {"name": "b", **keys})))
    wanted = f"the image {tmp_path}/image.tif, like 1 more, holds {values.dtype} values and no scale"
    assert (wanted in caplog.text) == told == (caplog.text != "")


@pytest.mark.parametrize(
    ("values", "keys", "middle"),
    [
        (np.full((BANDS, *SHAPE), 37.0, np.float32), {}, "37"),
        (np.full((BANDS, *SHAPE), 3000, np.int16), {"scale": 0.01}, "30"),
        (np.full((BANDS, *SHAPE), 0.5, np.float32), {"quantity": "brdf"}, "1.57"),
        (np.full((BANDS, *SHAPE), 1.4, np.float32), {}, None),
        (np.full((BANDS, *SHAPE), np.nan, np.float32), {}, None),
    ],
)
def test_an_image_brighter_than_white_is_doubted(tmp_path, caplog, values, keys, middle):
    write_inputs(tmp_path)
    write_raster(tmp_path / "image.tif", values)
    batch.plan(load_config(write_config(tmp_path, {"name": "a", **keys}, {"name": "b", **keys})))
    told = "" if middle is None else f"the image {tmp_path}/image.tif shows reflectance factors about {middle}, and 1"
    assert caplog.text.count(told or "reflectance factors") == (middle is not None)


@pytest.mark.parametrize(("saturation", "told"), [(0.9, True), (2999.0, True), (65535.0, False), (None, False)])
def test_a_saturation_that_half_of_the_image_exceeds_is_doubted(tmp_path, caplog, saturation, told):
    write_inputs(tmp_path)
    write_raster(tmp_path / "image.tif", np.full((BANDS, *SHAPE), 3000, np.uint16))
    keys = {"scale": 1e-4} | ({} if saturation is None else {"saturation": saturation})
    batch.plan(load_config(write_config(tmp_path, keys)))
    assert (
        (f"half of the middle of the image {tmp_path}/image.tif is saturated" in caplog.text)
        == told
        == (caplog.text != "")
    )


@pytest.mark.parametrize(("year", "told"), [(1899, True), (1900, False), (2024, False), (2101, True)])
def test_a_sun_of_no_year_of_aerial_images_is_doubted(tmp_path, caplog, year, told):
    write_inputs(tmp_path)
    time = datetime(year, 6, 21, 12, tzinfo=UTC)
    batch.plan(load_config(write_config(tmp_path, {"sun": {"time": time}})))
    assert (f"scene 'roofs': the sun is that of the year {year}" in caplog.text) == told == (caplog.text != "")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("dsm", "the rest is taken to be level, and flagged NORMAL_UNRELIABLE"),
        ("class_map", "the rest has no material"),
    ],
)
def test_what_covers_a_part_of_the_image_is_told_with_the_part(tmp_path, caplog, name, told):
    config = small_scene(tmp_path)
    path = tmp_path / f"{name}.tif"
    write_raster(path, read_raster(path)[:, :, SHAPE[1] // 2 :], west=WEST + SHAPE[1] // 2 * CELL)
    batch.plan(load_config(config))
    assert f"{path} covers 50 % of the image {tmp_path}/image.tif: {told}" in caplog.text


def test_normals_without_heights_are_told_to_show_no_shadows(tmp_path, caplog):
    small_scene(tmp_path)
    write_raster(tmp_path / "normals.tif", np.stack([np.zeros(SHAPE), np.zeros(SHAPE), np.ones(SHAPE)]).astype("f4"))
    surface = {"kind": "normals", "path": "normals.tif"}
    batch.plan(load_config(write_config(tmp_path, {"surface": surface | {"heights": "dsm.tif"}})))
    assert caplog.text == ""
    batch.plan(load_config(write_config(tmp_path, {"surface": surface, "shadows": False})))
    assert caplog.text == ""
    batch.plan(load_config(write_config(tmp_path, {"surface": surface})))
    assert "scene 'roofs': normals without heights show no cast shadows" in caplog.text


def test_normals_that_point_into_the_ground_are_doubted(tmp_path, caplog):
    config = small_scene(tmp_path, {"surface": {"kind": "normals", "path": "normals.tif"}, "shadows": False})
    for up, doubted in ((1, False), (-1, True)):
        level = np.stack([np.zeros(SHAPE), np.zeros(SHAPE), np.full(SHAPE, up)]).astype(np.float32)
        write_raster(tmp_path / "normals.tif", level)
        batch.plan(load_config(config))
        assert (f"the normals {tmp_path}/normals.tif points down" in caplog.text) == doubted


def test_the_settings_of_a_result_do_not_write_into_it(tmp_path):
    (scene,) = batch.run(small_scene(tmp_path)).scenes
    before = {path: path.read_bytes() for path in scene.folder.iterdir()}
    (line,) = problems(scene.folder / "settings.toml", ConfigError)
    assert line.startswith(f"[output] directory = {scene.folder}/out lies in the published result {scene.folder}, ")
    assert {path: path.read_bytes() for path in scene.folder.iterdir()} == before
    elsewhere = tmp_path / "again.toml"
    shutil.copy(scene.folder / "settings.toml", elsewhere)
    assert batch.run(elsewhere, overwrite=True).exit_code == 0


def test_what_is_done_and_what_is_replaced_needs_no_disk(tmp_path, monkeypatch):
    config = small_scene(tmp_path, {"name": "a"}, {"name": "b"})
    batch.run(config)
    usage = shutil.disk_usage(tmp_path)
    stored = (tmp_path / "image.tif").stat().st_size
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda _: usage._replace(free=0))
    assert batch.run(config).exit_code == 0  # all is current
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda _: usage._replace(free=stored))
    assert batch.run(config, overwrite=True).exit_code == 0  # one new result beside the old ones at a time


def test_an_estimate_of_the_disk_bounds_what_is_written(tmp_path):
    every = ["corrected", "flags", "removed", "uncertainty", "azimuthal_width", "angles"]
    for kind in ("gtiff", "cog"):
        folder = tmp_path / kind
        folder.mkdir()
        output = {"directory": "out", "quicklook": False, "products": every, "format": kind, "compression": "none"}
        write_image(folder / "image.tif", np.full((BANDS, 512, 512), 4000, np.int16))
        write_raster(folder / "class_map.tif", np.full((512, 512), TILE, np.uint8))
        config = write_config(folder, {"surface": None}, output=output)
        (scene,) = batch.plan(load_config(config))
        least, most = forecast.disk_bytes(scene)
        batch.run(config)
        written = sum(path.stat().st_size for path in (folder / "out/roofs").iterdir())
        assert least <= written <= most


@pytest.mark.usefixtures("no_pixels")
def test_an_image_whose_blocks_do_not_fit_into_the_limit_is_told(tmp_path):
    write_image(tmp_path / "image.tif", np.full((3, 2048, 2048), 4000, np.int16), blockxsize=2048, blockysize=2048)
    write_raster(tmp_path / "class_map.tif", np.full((64, 64), TILE, np.uint8), cell=16.0)
    config = write_config(tmp_path, {"surface": None}, run={"memory_limit_mb": 400})
    (line,) = problems(config, ConfigError)
    wanted_mb = int(re.search(r"takes about (\d+) MB", line)[1])
    said = f"scene 'roofs' takes about {wanted_mb} MB of memory, since the image {tmp_path}/image.tif is stored in"
    assert line.startswith(f"{said} blocks of 2048 x 2048 pixels; [run] memory_limit_mb = 400: allow more")
    assert wanted_mb > 600
    allowed = write_config(tmp_path, {"surface": None}, run={"memory_limit_mb": wanted_mb + 1})
    assert batch.plan(load_config(allowed), to_run=True)


@pytest.mark.usefixtures("no_pixels")
@pytest.mark.parametrize("limit_mb", [128, 300, 340])
def test_a_limit_below_what_any_scene_takes_is_told_as_such(tmp_path, limit_mb):
    small_scene(tmp_path)
    (line,) = problems(write_config(tmp_path, run={"memory_limit_mb": limit_mb}), ConfigError)
    assert re.fullmatch(
        rf"scene 'roofs' takes about 34\d MB of memory, as any scene does; \[run\] memory_limit_mb = {limit_mb}: "
        "allow more",
        line,
    )


@pytest.mark.usefixtures("no_pixels")
def test_a_machine_without_memory_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(preflight, "available_mb", lambda: 100.0)
    (line,) = problems(small_scene(tmp_path), OutputError)
    assert line.startswith("scene 'roofs' takes at least 3")
    assert line.endswith("MB of memory; 100 MB are available")


def test_the_machine_says_how_much_memory_it_has():
    assert 10 < forecast.available_mb() < 1e9


def read_only(folder):
    """Make a folder that nobody can write to, root neither; skip where that cannot be."""
    if os.geteuid() != 0:
        folder.chmod(0o555)
        return lambda: folder.chmod(0o755)
    if shutil.which("chattr") is None or subprocess.run(["chattr", "+i", folder], check=False).returncode:
        pytest.skip("as root a folder is only read-only where chattr works")
    return lambda: subprocess.run(["chattr", "-i", folder], check=True)


@pytest.mark.usefixtures("no_pixels")
def test_a_folder_that_cannot_be_written_is_told_even_to_root(tmp_path):
    config = small_scene(tmp_path)
    (tmp_path / "out").mkdir()
    undo = read_only(tmp_path / "out")
    try:
        (line,) = problems(config, ConfigError)
    finally:
        undo()
    assert line.startswith(f"[output] directory = {tmp_path}/out: {tmp_path}/out cannot be written: ")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_folder_that_becomes_read_only_fails_the_scene_and_the_next_run_makes_good(tmp_path):
    config = small_scene(tmp_path)
    undo = []
    result = batch.run(config, progress=lambda _: lambda _: undo.append(read_only(tmp_path / "out")))
    undo[0]()
    assert result.exit_code == 3
    assert "roofs cannot be published" in result.scenes[0].error
    assert not (tmp_path / "out" / "roofs").exists()
    assert batch.run(config).exit_code == 0
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")] == []


LIMITED = """
import resource, sys
from tscorr.cli import cli

resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
cli(["run", "-q", sys.argv[2]])
"""


def on_a_file_size_limit(config, _):
    """A run that can write no file of more than 300 kB."""
    return subprocess.run(
        [sys.executable, "-c", LIMITED, "300000", config], capture_output=True, text=True, check=False
    )


def on_a_small_disk(config, folder):
    """A run on a file system of 600 kB."""
    folder.mkdir(exist_ok=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=600k", "tscorr", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("a file system can only be mounted by root")
    try:
        command = [sys.executable, "-m", "tscorr", "run", "-q", config]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert [path.name for path in folder.iterdir() if path.name.startswith(".") or path.is_dir()] == []
        return result
    finally:
        subprocess.run(["umount", folder], check=True)


@pytest.mark.parametrize("full", [on_a_file_size_limit, on_a_small_disk])
def test_a_disk_that_fills_up_fails_the_scene_and_leaves_nothing(tmp_path, full):
    noise = np.random.default_rng(3).integers(3000, 6000, (3, 256, 256)).astype(np.int16)
    write_image(tmp_path / "image.tif", noise)
    write_raster(tmp_path / "class_map.tif", np.full((256, 256), TILE, np.uint8))
    config = write_config(tmp_path, {"surface": None}, output={"directory": "out", "compression": "deflate"})
    result = full(config, tmp_path / "out")
    assert result.returncode == 3
    assert "Traceback" not in result.stderr
    lines = result.stderr.splitlines()  # some are of libtiff and libpng, which speak for themselves
    (failed,) = (line for line in lines if line.startswith("tscorr: scene 'roofs' failed: "))
    assert (
        "cannot be written" in failed or "does not read back as written" in failed or "cannot be published" in failed
    )
    assert not (tmp_path / "out" / "roofs").exists()
    assert batch.run(config).exit_code == 0
