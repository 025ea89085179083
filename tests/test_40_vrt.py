"""scene: `corrected = "vrt"` holds the values of `corrected = "file"`, and reads of the image only what it must."""

import json
import shutil

import numpy as np
import pytest
import rasterio
from rasterio.warp import Resampling
from small_scene import (
    BANDS,
    GROUND,
    NODATA,
    SCALE,
    SHAPE,
    TILE,
    class_map,
    image_values,
    read_raster,
    small_scene,
    write_config,
    write_image,
    write_inputs,
    write_raster,
)

from tscorr import batch, publish
from tscorr.errors import ConfigError
from tscorr.rasters import Reader

STEEP = {
    "surface": {"kind": "flat"},
    "sun": {"zenith_deg": 50.0, "azimuth_deg": 180.0},
    "view": {"kind": "constant", "zenith_deg": 3.0, "azimuth_deg": 90.0},
}
"""flat ground, a right angle's quarter off the mirror"""


def run(config, **options):
    """The folder and the report of the only scene of a configuration."""
    (scene,) = batch.run(config, **options).scenes
    assert scene.error == ""
    return scene.folder, scene.report


def both(folder, *scenes, products=("corrected", "flags", "removed"), output=None, **sections):
    """The folder of a scene as a VRT, and as a file."""
    folders = []
    for kind in ("vrt", "file"):
        values = {"directory": f"out/{kind}", "quicklook": False, "corrected": kind, "products": list(products)}
        config = write_config(folder, *scenes, output=values | (output or {}), **sections)
        folders.append(run(config)[0])
    return folders


def dark_and_void(dtype, nodata):
    """Values with nodata, with pixels darker than their glare, saturated and beyond correction."""
    values = (image_values(np.float32) * {"float32": SCALE, "uint8": 1 / 40}.get(dtype, 1)).astype(dtype)
    values[:, 8, 8:12] = values.dtype.type(values.max() / 100)
    values[1, 9, 9] = values.max() * 1.2
    if nodata is not None:
        values[:, 12:14, 8:28] = nodata
        values[0, 15, 8:12] = nodata
    return values


@pytest.mark.parametrize("policy", ["best", "keep"])
@pytest.mark.parametrize(
    ("dtype", "nodata"),
    [
        ("int16", NODATA),
        ("int16", None),
        ("uint16", 0),
        ("uint16", 65535),
        ("uint8", 255),
        ("float32", None),
        ("float32", -9999.0),
        ("float32", float("nan")),
    ],
)
def test_a_vrt_holds_the_values_of_the_file(tmp_path, dtype, nodata, policy):
    write_inputs(tmp_path)
    values = dark_and_void(dtype, nodata)
    write_image(tmp_path / "image.tif", values, nodata=nodata)
    scale = {"float32": 1.0, "uint8": 0.004}.get(dtype, SCALE)
    scene = {"scale": scale, "saturation": float(np.nanmax(values))}
    vrt, file = both(tmp_path, scene, correction={"uncorrectable": policy})
    assert not (vrt / "corrected.tif").exists()
    assert not (file / "corrected.vrt").exists()
    for name in ("flags", "removed"):
        assert read_raster(vrt / f"{name}.tif").tobytes() == read_raster(file / f"{name}.tif").tobytes()
    with rasterio.open(vrt / "corrected.vrt") as one, rasterio.open(file / "corrected.tif") as other:
        assert one.read().tobytes() == other.read().tobytes()
        assert (one.read() != values).any()
        np.testing.assert_array_equal(one.read_masks(), other.read_masks())
        for key in ("crs", "transform", "dtypes", "scales", "offsets", "descriptions", "colorinterp"):
            assert getattr(one, key) == getattr(other, key), key
        np.testing.assert_equal(one.nodata, other.nodata)
        assert one.tags() == other.tags()
        for band in one.indexes:
            for domain in (None, "IMAGERY"):
                assert one.tags(band, ns=domain) == other.tags(band, ns=domain)


def test_reports_and_items_are_those_of_the_file(tmp_path):
    write_inputs(tmp_path)
    write_raster(tmp_path / "diffuse.tif", image_values(np.float32) * 0.5 * SCALE)
    write_raster(tmp_path / "sunlit.tif", np.ones(SHAPE, np.uint8))
    truth = {"truth": {"diffuse": "diffuse.tif", "sunlit": "sunlit.tif"}}
    vrt, file = both(tmp_path, truth, output={"quicklook": True})
    one, other = (json.loads((folder / "report.json").read_text()) for folder in (vrt, file))
    for key in ("pixels", "materials", "skipped", "residual_glare"):
        assert one[key] == other[key], key
    one, other = (json.loads((folder / "item.json").read_text())["assets"] for folder in (vrt, file))
    assert one["corrected"] == other["corrected"] | {"href": "./corrected.vrt", "type": "application/xml"}
    assert (vrt / "quicklook.png").stat().st_size > 1000
    assert publish.damaged(vrt) == []
    assert "corrected.vrt" in json.loads((vrt / "manifest.json").read_text())["outputs"]


def test_what_was_removed_is_written_though_not_asked_for(tmp_path):
    write_inputs(tmp_path)
    folder, _ = both(tmp_path, products=["corrected", "flags"])
    assert {path.suffix for path in folder.glob("*.*") if path.stem in {"corrected", "removed"}} == {".vrt", ".tif"}


@pytest.mark.parametrize("codec", ["none", "deflate", "zstd"])
def test_tiles_without_glare_are_not_stored(tmp_path, codec):
    write_inputs(tmp_path)
    folder, _ = both(tmp_path, output={"compression": codec})
    with rasterio.open(folder / "removed.tif") as file:
        stored = np.array(
            [
                [
                    file.get_tag_item(f"BLOCK_OFFSET_{col}_{row}", "TIFF", bidx=1) is not None
                    for col in range(SHAPE[1] // 16)
                ]
                for row in range(SHAPE[0] // 16)
            ]
        )
        used = file.read().any(axis=0).reshape(SHAPE[0] // 16, 16, SHAPE[1] // 16, 16).any(axis=(1, 3))
    np.testing.assert_array_equal(stored, used)
    assert 0 < used.sum() < used.size


def test_results_may_be_moved_with_the_image(tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    write_inputs(here)
    both(here)
    expected = read_raster(here / "out/file/roofs/corrected.tif")
    shutil.move(here, tmp_path / "there")
    found = read_raster(tmp_path / "there/out/vrt/roofs/corrected.vrt")
    np.testing.assert_array_equal(found, expected)


def test_a_folder_of_results_behind_a_link(tmp_path):
    write_inputs(tmp_path)
    (tmp_path / "elsewhere/deep/down").mkdir(parents=True)
    (tmp_path / "out").symlink_to(tmp_path / "elsewhere/deep/down")
    vrt, file = both(tmp_path)
    np.testing.assert_array_equal(read_raster(vrt / "corrected.vrt"), read_raster(file / "corrected.tif"))


def test_with_overviews(tmp_path):
    write_inputs(tmp_path)
    vrt, file = both(tmp_path, output={"format": "cog"})
    np.testing.assert_array_equal(read_raster(vrt / "corrected.vrt"), read_raster(file / "corrected.tif"))


def test_decimated_values_are_differences_of_means(tmp_path):
    write_inputs(tmp_path)
    vrt, _ = both(tmp_path)
    with rasterio.open(vrt / "corrected.vrt") as file:
        small = file.read(1, out_shape=(12, 16), resampling=Resampling.average)
        whole = file.read(1).reshape(12, 4, 16, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(small, whole, atol=1.01)


def image_reads(monkeypatch):
    """How many pixels of the image are read, as they are."""
    pixels = []
    read = Reader.read

    def noted(reader, block, bands=None):
        if reader.info.path.name == "image.tif":
            pixels.append(block.height * block.width)
        return read(reader, block, bands)

    monkeypatch.setattr(Reader, "read", noted)
    return pixels


@pytest.mark.parametrize(
    ("nodata", "scene", "units"),
    [
        (None, {}, 1),
        (-1, {}, 10),
        (None, {"saturation": 9000}, 10),
        (None, STEEP, 0),
    ],
    ids=["integers", "nodata", "saturation", "out of reach"],
)
def test_the_image_is_read_only_where_it_must_be(tmp_path, monkeypatch, nodata, scene, units):
    shape = 700, 2500
    classes = np.full(shape, GROUND, np.uint8)
    classes[20:60, 30:90] = TILE
    tiles = {"blockxsize": 256, "blockysize": 256}
    write_raster(tmp_path / "class_map.tif", classes, **tiles)
    write_raster(tmp_path / "dsm.tif", np.ones(shape, np.float32), **tiles)
    values = np.random.default_rng(3).integers(3000, 6000, (BANDS, *shape)).astype(np.int16)
    write_image(tmp_path / "image.tif", values, nodata=nodata, **tiles)
    materials = {"classes": {str(TILE): "red_aluminum", str(GROUND): "lambertian"}}
    output = {"directory": "vrt", "quicklook": False, "corrected": "vrt"}
    roomy = {"memory_limit_mb": 2000}
    config = write_config(tmp_path, scene, output=output, materials=materials, run=roomy)
    pixels = image_reads(monkeypatch)
    folder, report = run(config)
    assert len(pixels) == units
    assert report["skipped"]["blocks"] == 10
    file, _ = run(
        write_config(tmp_path, scene, output=output | {"directory": "f", "corrected": "file"}, materials=materials)
    )
    np.testing.assert_array_equal(read_raster(folder / "flags.tif"), read_raster(file / "flags.tif"))
    np.testing.assert_array_equal(read_raster(folder / "corrected.vrt"), read_raster(file / "corrected.tif"))


def test_a_scene_wholly_in_shadow_needs_no_image(tmp_path, monkeypatch):
    write_inputs(tmp_path)
    write_image(tmp_path / "image.tif", nodata=None)
    dsm = np.ones(SHAPE, np.float32)
    dsm[44:46] = 100.0
    write_raster(tmp_path / "dsm.tif", dsm)
    pixels = image_reads(monkeypatch)
    vrt, _ = both(tmp_path)
    assert len(pixels) == 1  # for the file
    assert (read_raster(vrt / "flags.tif")[0][class_map() == TILE] != 0).all()


def test_a_current_result_is_left_alone_and_another_kind_is_not(tmp_path):
    output = {"directory": "out", "quicklook": False, "corrected": "vrt"}
    config = small_scene(tmp_path, output=output)
    assert [batch.run(config).scenes[0].state for _ in range(2)] == ["done", "current"]
    config = write_config(tmp_path, output=output | {"corrected": "file"})
    assert batch.run(config).scenes[0].state == "done"
    assert not (tmp_path / "out/roofs/corrected.vrt").exists()


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"correction": {"uncorrectable": "nodata"}}, "correction.uncorrectable = 'nodata' cannot be had with"),
        (
            {"materials": {"classes": {"1": "roof_tile"}, "settings": {"roof_tile": {"uncorrectable": "nodata"}}}},
            "materials.settings.roof_tile.uncorrectable = 'nodata' cannot be had with output.corrected = 'vrt'",
        ),
        ({"output": {"corrected": "vrt", "format": "envi"}}, "needs output.format = 'gtiff' or 'cog', not 'envi'"),
        ({"output": {"corrected": "vrt", "products": ["flags"]}}, "needs 'corrected' among the output.products"),
    ],
)
def test_what_no_difference_can_say_is_refused(tmp_path, sections, message):
    with pytest.raises(ConfigError, match=r"city\.toml") as error:
        batch.run(small_scene(tmp_path, **{"output": {"corrected": "vrt"}, **sections}))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_floating_point_whose_nodata_may_be_removed_is_refused(tmp_path):
    write_inputs(tmp_path)
    write_image(tmp_path / "image.tif", image_values(np.float32) * np.float32(SCALE), nodata=0)
    with pytest.raises(ConfigError, match="'vrt' cannot keep the nodata value 0 of the floating-point image"):
        batch.run(write_config(tmp_path, {"scale": 1.0}, output={"corrected": "vrt"}))
