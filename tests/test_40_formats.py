"""Formats in and out: ENVI files byte by byte as their headers say, GeoTIFFs of every layout, all types."""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rio_cogeo.cogeo import cog_validate
from small_scene import CELL, NORTH, TILE, UNKNOWN, WEST, write_config, write_image, write_raster

from tscorr import batch, publish, rasters
from tscorr.correction import PixelFlag, SpecularState, specular_state
from tscorr.errors import InputError, OutputError
from tscorr.grid import Block, blocks
from tscorr.quicklook import FLAG_COLOURS, flag_palette
from tscorr.scene.styles import flag_style

UTM = "EPSG:32631"
SHAPE = 9, 14
TYPES = {"uint8": 1, "int16": 2, "float32": 4, "uint16": 12}
"""ENVI's number of each type"""
SCALES = {"uint8": 200.0, "int16": 10000.0, "uint16": 10000.0, "float32": 1.0}
"""stored value of reflectance 1"""
AXES = {"bsq": (0, 1, 2), "bil": (1, 0, 2), "bip": (1, 2, 0)}
"""order of (bands, rows, cols) in the file"""


def values_of(dtype, bands=3):
    """Reflectance factors of 0.3 to 0.6, as stored."""
    stored = np.random.default_rng(5).uniform(0.3, 0.6, (bands, *SHAPE)) * SCALES[dtype]
    return stored.astype(dtype)


def write_envi(path, values, interleave="bsq", *, order="<", offset=0, **fields):
    """An ENVI file written by hand; `fields` are more lines of its header."""
    bands, rows, cols = values.shape
    lines = {
        "samples": cols,
        "lines": rows,
        "bands": bands,
        "header offset": offset,
        "file type": "ENVI Standard",
        "data type": TYPES[values.dtype.name],
        "interleave": interleave,
        "byte order": int(order == ">"),
        "map info": f"{{UTM, 1, 1, {WEST}, {NORTH}, {CELL}, {CELL}, 31, North, WGS-84}}",
        **{key.replace("_", " "): text for key, text in fields.items()},
    }
    path.with_suffix(".hdr").write_text("ENVI\n" + "".join(f"{key} = {text}\n" for key, text in lines.items()))
    stored = np.transpose(values, AXES[interleave]).astype(values.dtype.newbyteorder(order))
    path.write_bytes(bytes(offset) + stored.tobytes())
    return path


@dataclass
class Envi:
    """An ENVI file read by hand."""

    values: np.ndarray
    header: dict[str, str] = field(default_factory=dict)

    def numbers(self, key):
        return [float(text) for text in self.header[key].strip("{}").split(",")]


def read_envi(path):
    text = path.with_suffix(".hdr").read_text()
    header = {
        key.strip(): value.strip() for key, value in re.findall(r"^(.+?) *= *(\{[^}]*\}|.*)$", text, re.MULTILINE)
    }
    rows, cols, bands = (int(header[key]) for key in ("lines", "samples", "bands"))
    dtype = {number: name for name, number in TYPES.items()}[int(header["data type"])]
    order = AXES[header["interleave"]]
    shape = np.array((bands, rows, cols))[list(order)]
    stored = np.frombuffer(path.read_bytes(), np.dtype(dtype).newbyteorder("<")).reshape(shape)
    return Envi(np.transpose(stored, np.argsort(order)), header)


def corrected(folder, image, scene=None, **output):
    """The folder of the result of an image of which the left half is tiles and the rest of no known class."""
    classes = np.full(SHAPE, UNKNOWN, np.uint8)
    classes[:, : SHAPE[1] // 2] = TILE
    write_raster(folder / "class_map.tif", classes, crs=UTM)
    settings = {"image": image.name, "surface": None, **(scene or {})}
    options = {"directory": "out", "quicklook": False, "format": "gtiff", **output}
    outcome = batch.run(write_config(folder, settings, output=options)).scenes[0]
    assert outcome.state == "done", outcome.error
    assert publish.damaged(outcome.folder) == []
    return outcome.folder


def check(image, result, removed):
    """Tiles lost something in every band, everything else is bit-identical, and the removed amount says how much."""
    left = SHAPE[1] // 2
    assert (result.shape, result.dtype) == (image.shape, image.dtype)
    np.testing.assert_array_equal(result[:, :, left:], image[:, :, left:])
    assert np.all(result[:, :, :left] < image[:, :, :left])
    np.testing.assert_array_equal(image - removed, result)


# ENVI out.


@pytest.mark.parametrize("interleave", AXES)
@pytest.mark.parametrize("dtype", TYPES)
def test_envi_goes_in_and_out(tmp_path, dtype, interleave):
    values = values_of(dtype)
    fields = {
        "wavelength_units": "Nanometers",
        "wavelength": "{450.25, 550.5, 650.75}",
        "fwhm": "{9.5, 10.25, 11}",
        "band_names": "{deep blue, green, red}",
        "reflectance_scale_factor": SCALES[dtype],
        "data_ignore_value": 0,
        "sensor_type": "HyMap",
    }
    image = write_envi(tmp_path / "image.dat", values, interleave, **fields)
    folder = corrected(tmp_path, image, format="envi")
    result, removed = read_envi(folder / "corrected.dat"), read_envi(folder / "removed.dat")
    check(values, result.values, removed.values)
    for file in (result, removed):
        assert file.header["interleave"] == interleave
        assert file.numbers("wavelength") == [450.25, 550.5, 650.75]
        assert file.numbers("fwhm") == [9.5, 10.25, 11.0]
        assert file.header["wavelength units"] == "Nanometers"
        assert re.split(r",\s*", file.header["band names"].strip("{}\n")) == ["deep blue", "green", "red"]
        assert float(file.header.get("reflectance scale factor", 1)) == SCALES[dtype]
        assert file.header["sensor type"] == "HyMap"
        assert file.header["tscorr scene"] == "roofs"
    assert float(result.header["data ignore value"]) == 0
    assert "data ignore value" not in removed.header
    flags = read_envi(folder / "flags.dat").values[0]
    assert np.all(specular_state(flags[:, : SHAPE[1] // 2]) == SpecularState.CORRECTED)
    assert not list(folder.glob("*.aux.xml"))


@pytest.mark.parametrize("interleave", AXES)
def test_envi_and_geotiff_of_one_image_get_the_same_correction(tmp_path, interleave):
    values = values_of("int16")
    for name in ("tif", "envi"):
        (tmp_path / name).mkdir()
    tif = write_raster(tmp_path / "tif/image.tif", values, crs=UTM)
    with rasterio.open(tif, "r+") as file:
        file.scales = (1e-4,) * 3
    image = write_envi(tmp_path / "envi/image.dat", values, interleave, reflectance_scale_factor=10000)
    for output in ("gtiff", "envi"):
        results = []
        for path in (tif, image):
            folder = corrected(path.parent, path, format=output, directory=f"out_{output}")
            with rasterio.open(rasters.result(folder, "corrected").path) as file:
                results.append(file.read())
        np.testing.assert_array_equal(*results)
        check(values, results[0], values - results[0])


def test_a_geotiff_becomes_envi_with_everything_that_a_header_can_hold(tmp_path):
    image = write_image(tmp_path / "image.tif", values_of("int16"), crs=UTM, interleave="pixel")
    products = ["corrected", "removed", "flags", "angles", "azimuthal_width"]
    folder = corrected(tmp_path, image, format="envi", products=products)
    result = read_envi(folder / "corrected.dat")
    assert result.header["interleave"] == "bip"
    assert result.numbers("wavelength") == [0.475, 0.56, 0.668]
    assert result.numbers("fwhm") == [0.02] * 3
    assert result.header["wavelength units"] == "Micrometers"
    assert result.header["reflectance scale factor"] == "10000"
    assert result.header["description"].strip("{} \n") == "corrected.dat"
    info, before = rasters.describe(folder / "corrected.dat"), rasters.describe(image)
    for key in ("grid", "dtype", "nodata", "scales", "offsets", "names", "wavelengths_um", "fwhm_um"):
        assert getattr(info, key) == getattr(before, key), key
    with rasterio.open(folder / "angles.dat") as file:
        assert file.descriptions[:3] == ("incidence", "exitance", "relative_azimuth")
        assert np.isnan(file.nodata)
        np.testing.assert_allclose(file.read(1), 40, atol=1e-3)  # the sun over flat ground


@pytest.mark.parametrize(
    ("scales", "offsets"),
    [((0.5, 0.25, 0.125), (0.0, 0.0, 0.0)), ((1e-4,) * 3, (0.25,) * 3), ((1 / 3,) * 3, (0.0,) * 3)],
)
def test_scales_that_one_factor_cannot_tell_are_gains_and_offsets(tmp_path, scales, offsets):
    like = rasters.describe(write_image(tmp_path / "image.tif", values_of("int16"), crs=UTM))
    layer = rasters.Layer(("a", "b", "c"), "int16", scales=scales, offsets=offsets)
    writer = rasters.EnviWriter(tmp_path / "x.dat", like, layer)
    writer.write(Block(0, 0, *SHAPE), values_of("int16"))
    writer.close()
    info = rasters.describe(tmp_path / "x.dat")
    assert (info.scales, info.offsets) == (scales, offsets)


@pytest.mark.parametrize("interleave", AXES)
def test_blocks_of_any_shape_make_one_envi_file(tmp_path, interleave):
    values = values_of("int16", bands=5)
    like = rasters.describe(write_envi(tmp_path / "image.dat", values, interleave))
    for shape in ((2, 3), (4, SHAPE[1]), (SHAPE[0], 5), SHAPE):
        writer = rasters.EnviWriter(tmp_path / "x.dat", like, rasters.Layer(like.names, "int16"))
        with ThreadPoolExecutor(4) as pool:
            todo = list(blocks(SHAPE, shape))
            list(pool.map(writer.write, todo, [values[:, *block.slices] for block in todo]))
        writer.close()
        np.testing.assert_array_equal(read_envi(tmp_path / "x.dat").values, values)
        assert (tmp_path / "x.dat").read_bytes() == (tmp_path / "image.dat").read_bytes()


@pytest.mark.parametrize("damage", ["cut", "changed", "header"])
def test_an_envi_file_that_lost_bytes_does_not_pass(tmp_path, damage):
    like = rasters.describe(write_envi(tmp_path / "image.dat", values_of("int16"), "bip"))
    writer = rasters.EnviWriter(tmp_path / "x.dat", like, rasters.Layer(like.names, "int16"))
    for block in blocks(SHAPE, (5, SHAPE[1])):
        writer.write(block, values_of("int16")[:, *block.slices])
    if damage == "header":
        (tmp_path / "x.hdr").write_text("ENVI\n")
    else:
        content = (tmp_path / "x.dat").read_bytes()
        content = content[:-40] if damage == "cut" else content[:-100] + bytes(8) + content[-92:]
        (tmp_path / "x.dat").write_bytes(content)
    with pytest.raises(OutputError, match=r"x\.dat does not read back as written; is the disk full"):
        writer.close()


def test_a_full_disk_fails_an_envi_file(tmp_path):
    resource = pytest.importorskip("resource")
    like = rasters.describe(write_envi(tmp_path / "image.dat", values_of("int16"), "bil"))
    writer = rasters.EnviWriter(tmp_path / "x.dat", like, rasters.Layer(like.names, "int16"))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, before[1]))
    try:
        with pytest.raises(OutputError, match=r"x\.dat cannot be written"):
            writer.write(Block(0, 0, *SHAPE), values_of("int16"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    writer.abandon()


# ENVI in.


def test_an_envi_header_is_read_whole(tmp_path):
    path = write_envi(
        tmp_path / "image.dat",
        values_of("uint16"),
        wavelength_units="Micrometers",
        wavelength="{0.45025, 0.55, 0.65}",
        fwhm="{0.0095, 0.01, 0.011}",
        bbl="{1, 0, 1}",
        reflectance_scale_factor="5000",
    )
    info = rasters.describe(path)
    assert info.wavelengths_um == (0.45025, 0.55, 0.65)
    assert info.fwhm_um == (0.0095, 0.01, 0.011)
    assert info.bad_bands == (False, True, False)
    assert info.scales == (1 / 5000,) * 3


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "many", ""])
def test_a_scale_factor_that_means_nothing_is_none(tmp_path, text):
    assert (
        rasters.describe(write_envi(tmp_path / "x.dat", values_of("uint16"), reflectance_scale_factor=text)).scales
        == (1.0,) * 3
    )


@pytest.mark.parametrize("interleave", AXES)
@pytest.mark.parametrize(("order", "offset"), [("<", 0), (">", 0), ("<", 10), (">", 128)])
def test_blocks_of_an_envi_file_are_its_pixels(tmp_path, interleave, order, offset):
    values = values_of("float32", bands=5)
    info = rasters.describe(write_envi(tmp_path / "x.dat", values, interleave, order=order, offset=offset))
    with rasters.Reader(info) as reader:
        block = Block(2, 3, 4, 7)
        pixels = reader.read(block)
        np.testing.assert_array_equal(pixels, values[:, *block.slices])
        assert pixels.dtype.isnative
        assert pixels.flags.c_contiguous
        np.testing.assert_array_equal(reader.read(block, 4), values[3][block.slices])
        beyond = reader.read(Block(-1, -1, *SHAPE))
        np.testing.assert_array_equal(beyond[:, 1:, 1:], values[:, :-1, :-1])


@pytest.mark.parametrize("interleave", AXES)
def test_an_envi_file_decimated_is_the_mean_of_its_valid_pixels(tmp_path, interleave):
    values = values_of("float32", bands=4)[:, :8, :12]
    values[1, :2, :2], values[2, 3, 3], values[3, 0, 0] = -9, -9, np.inf
    info = rasters.describe(write_envi(tmp_path / "x.dat", values, interleave, data_ignore_value=-9))
    masked = np.ma.masked_equal(values, -9).reshape(4, 4, 2, 6, 2)
    expected = masked.mean(axis=(2, 4)).filled(np.nan)
    expected[3, 0, 0] = np.nan
    np.testing.assert_allclose(rasters.read_decimated(info, 6), expected, rtol=1e-6)
    np.testing.assert_allclose(rasters.read_decimated(info, 6, [3, 1]), expected[[2, 0]], rtol=1e-6)


def test_a_file_of_pixels_that_shrinks_is_named(tmp_path):
    path = write_envi(tmp_path / "x.dat", values_of("int16"), "bip")
    with rasters.Reader(rasters.describe(path)) as reader:
        path.write_bytes(path.read_bytes()[:-1])
        with pytest.raises(InputError, match=rf"{path} ends before row 9"):
            reader.read(Block(0, 0, *SHAPE))


# Bad bands.


@pytest.mark.parametrize("output", ["gtiff", "envi"])
@pytest.mark.parametrize("junk", [-9999, 32767])
def test_bad_bands_are_left_as_they_are_and_decide_nothing(tmp_path, output, junk):
    """Nodata or saturated all over, and at a wavelength that the material is not known at."""
    (tmp_path / "library.toml").write_text(
        "[narrow_tile]\nsource = 'test'\nwavelength_um = [0.4, 0.7]\nt0 = [0.02, 0.02]\nt1 = 0.2\nw = 0.0362\n"
        "n = 1.77\nk = 0.25\n"
    )
    values = values_of("int16", bands=4)
    values[[0, 2]] = junk
    fields = {
        "wavelength_units": "Nanometers",
        "wavelength": "{350, 450, 1400, 650}",
        "bbl": "{0, 1, 0, 1}",
        "reflectance_scale_factor": 10000,
        "data_ignore_value": -9999,
    }
    image = write_envi(tmp_path / "image.dat", values, "bil", **fields)
    folder = corrected(tmp_path, image, {"saturation": [100, 20000, 100, 20000]}, format=output)
    with rasterio.open(rasters.result(folder, "corrected").path) as file:
        result = file.read()
    with rasterio.open(rasters.result(folder, "removed").path) as file:
        removed = file.read()
    np.testing.assert_array_equal(result[[0, 2]], values[[0, 2]])
    assert not removed[[0, 2]].any()
    check(values[[1, 3]], result[[1, 3]], removed[[1, 3]])
    good = tmp_path / "good"
    good.mkdir()
    tif = write_raster(good / "image.tif", values[[1, 3]], crs=UTM)
    with rasterio.open(tif, "r+") as file:
        file.scales = (1e-4,) * 2
    expected = corrected(good, tif)
    with rasterio.open(expected / "corrected.tif") as file:
        np.testing.assert_array_equal(file.read(), result[[1, 3]])
    with rasterio.open(expected / "flags.tif") as one, rasterio.open(rasters.result(folder, "flags").path) as other:
        np.testing.assert_array_equal(one.read(), other.read())
    if output == "envi":
        assert read_envi(folder / "corrected.dat").numbers("bbl") == [0, 1, 0, 1]


@pytest.mark.parametrize("bbl", ["{0, 1}", "{1, 1, 1, 1}", "{good, bad, good}"])
def test_a_list_of_bad_bands_that_is_of_another_image_is_refused(tmp_path, bbl):
    image = write_envi(tmp_path / "image.dat", values_of("int16"), bbl=bbl)
    said = rf"image\.dat: bbl = .*{bbl[1:-1]}.*; allowed is 0 or 1 for each of the 3 bands"
    with pytest.raises(InputError, match=said):
        corrected(tmp_path, image)


def test_an_image_of_bad_bands_only_is_refused(tmp_path):
    image = write_envi(tmp_path / "image.dat", values_of("int16"), bbl="{0, 0, 0}")
    with pytest.raises(InputError, match=r"image\.dat marks every band as bad"):
        corrected(tmp_path, image)


# GeoTIFF.


@pytest.mark.parametrize("interleave", ["band", "pixel"])
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("bands", [1, 3])
def test_geotiffs_keep_type_and_layout(tmp_path, dtype, interleave, bands):
    values = values_of(dtype, bands)
    image = write_raster(tmp_path / "image.tif", values, crs=UTM, interleave=interleave, BIGTIFF="YES")
    folder = corrected(tmp_path, image, {"scale": 1 / SCALES[dtype]})
    with rasterio.open(image) as before, rasterio.open(folder / "corrected.tif") as after:
        with rasterio.open(folder / "removed.tif") as removed:
            check(values, after.read(), removed.read())
        assert after.block_shapes == before.block_shapes
        assert bands == 1 or after.interleaving == before.interleaving


@pytest.mark.parametrize(
    ("output", "name"),
    [
        ({}, "corrected.tif"),
        ({"format": "cog"}, "corrected.tif"),
        ({"format": "envi"}, "corrected.dat"),
        ({"corrected": "vrt"}, "corrected.vrt"),
    ],
)
def test_statistics_of_the_image_are_not_those_of_the_result(tmp_path, output, name):
    image = write_raster(tmp_path / "image.tif", values_of("int16"), crs=UTM)
    with rasterio.open(image, "r+") as file:
        file.update_tags(1, STATISTICS_MAXIMUM="9000", sensor="left")
    with rasterio.open(corrected(tmp_path, image, {"scale": 1e-4}, **output) / name) as result:
        tags = result.tags(1)
    assert not [key for key in tags if key.startswith("STATISTICS")]
    assert tags.get("sensor") == ("left" if name != "corrected.dat" else None)


@pytest.mark.parametrize("output", ["gtiff", "cog", "envi"])
@pytest.mark.parametrize("interleave", ["bip", "pixel"])
def test_three_hundred_bands(tmp_path, output, interleave):
    values = values_of("uint16", 300)
    if interleave == "bip":
        image = write_envi(tmp_path / "image.dat", values, interleave)
    else:
        image = write_raster(tmp_path / "image.tif", values, crs=UTM, interleave=interleave)
    folder = corrected(tmp_path, image, {"scale": 1e-4}, format=output)
    with (
        rasterio.open(rasters.result(folder, "corrected").path) as result,
        rasterio.open(rasters.result(folder, "removed").path) as removed,
    ):
        check(values, result.read(), removed.read())


@pytest.mark.parametrize("dtype", TYPES)
def test_cloud_optimised_results_pass_the_strict_validator(tmp_path, dtype):
    image = write_raster(tmp_path / "image.tif", values_of(dtype), crs=UTM)
    products = ["corrected", "removed", "flags", "angles", "azimuthal_width"]
    folder = corrected(tmp_path, image, {"scale": 1 / SCALES[dtype]}, format="cog", products=products)
    files = sorted(folder.glob("*.tif"))
    assert [file.stem for file in files] == sorted(products)
    for file in files:
        valid, errors, warnings = cog_validate(file, strict=True)
        assert (valid, errors, warnings) == (True, [], [])


# Flags as a map.


def test_flags_have_a_colour_table_and_a_legend_of_what_occurs(tmp_path):
    image = write_raster(tmp_path / "image.tif", values_of("int16"), crs=UTM)
    for output in ("gtiff", "cog"):
        folder = corrected(tmp_path, image, {"scale": 1e-4}, format=output, directory=output)
        with rasterio.open(folder / "flags.tif") as file:
            table, flags = file.colormap(1), file.read(1)
            assert file.colorinterp == (ColorInterp.palette,)
        colours = {name: (*colour, 255) for name, colour in FLAG_COLOURS.items()}
        corrected_value, unknown_value = 1 << 6, (3 << 6) | PixelFlag.NO_MATERIAL
        assert table[corrected_value] == colours["corrected"]
        assert table[unknown_value] == colours["no material"]
        assert table[unknown_value | PixelFlag.NODATA] == colours["no data"]
        assert len(table) == 1 << 16
        assert np.array_equal([table[value][:3] for value in range(1 << 16)], flag_palette())
        entries = ET.parse(folder / "flags.qml").getroot().iter("paletteEntry")
        legend = {int(entry.get("value")): (entry.get("label"), entry.get("color")) for entry in entries}
        assert set(legend) == set(np.unique(flags).tolist())
        assert legend[corrected_value] == ("corrected", "#009e73")
        assert legend[unknown_value] == ("no material", "#cc79a7")


def test_a_legend_names_the_flags_that_no_colour_tells():
    (entry,) = ET.fromstring(flag_style([(1 << 6) | PixelFlag.CLIPPED])).iter("paletteEntry")
    assert entry.get("label") == "corrected: CLIPPED"


@pytest.mark.parametrize("interleave", AXES)
def test_a_block_of_many_bands_fits_the_memory_limit(tmp_path, interleave):
    """300 bands of 16 bits: a tile of 512 x 512 would be 157 MB, and five copies of it are made."""
    image = write_envi(tmp_path / "x.dat", np.ones((300, 20, 600), np.int16), interleave)
    assert rasters.describe(image).written_tile == (16, 512)
