"""Rasters, names and texts from an unknown hand: refused by name before a pixel is read, and shown as plain text."""

import re
import struct
import time

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy as copy_raster
from small_scene import (
    NODATA,
    SHAPE,
    class_map,
    heights,
    image_values,
    write_config,
    write_image,
    write_raster,
)

from tscorr import batch, rasters
from tscorr.config import load_config
from tscorr.errors import InputError, TscorrError

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

KINDS = {1: "B", 2: "B", 3: "H", 4: "I", 12: "d"}
"""TIFF's types of numbers, for struct"""


def tiff(path, *pages):
    """A TIFF of directories alone: each page a dict of tags, tag: (type, values); nothing is stored of the pixels."""
    content = b"II*\0" + struct.pack("<I", 8)
    for page, tags in enumerate(pages):
        start = len(content)
        data_at = start + 2 + 12 * len(tags) + 4
        entries, data = b"", b""
        for tag, (kind, values) in sorted(tags.items()):
            packed = struct.pack(f"<{len(values)}{KINDS[kind]}", *values)
            entries += struct.pack("<HHI", tag, kind, len(values))
            if len(packed) <= 4:
                entries += packed.ljust(4, b"\0")
            else:
                entries += struct.pack("<I", data_at + len(data))
                data += packed + b"\0" * (len(packed) % 2)
        following = data_at + len(data) if page + 1 < len(pages) else 0
        content += struct.pack("<H", len(tags)) + entries + struct.pack("<I", following) + data
    path.write_bytes(content)
    return path


def page(rows, cols, tile=(16, 16), *, kind=0, bits=(8,), sample_format=1):
    """Tags of a tiled page; kind: 0 an image, 1 an overview, 4 a mask."""
    tags = {254: kind, 256: cols, 257: rows, 259: 1, 262: 1, 277: len(bits), 322: tile[1], 323: tile[0]}
    tags |= {324: 8, 325: 16}
    many = {258: (3, bits), 339: (3, (sample_format,) * len(bits))}
    return {tag: (4, (value,)) for tag, value in tags.items()} | many


PLACE = {
    33550: (12, (0.5, 0.5, 0.0)),
    33922: (12, (0.0, 0.0, 0.0, 84664.0, 447719.0, 0.0)),
    34735: (3, (1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 28992)),
}
"""GeoTIFF tags of the small scene"""


def forged(path, *pages):
    """A TIFF that lies where the small scene does."""
    return tiff(path, {**pages[0], **PLACE}, *pages[1:])


def with_envi(folder, header, values=None):
    """An ENVI file of the small scene whose header is changed: its path."""
    path = folder / "x.img"
    (image_values()[0] if values is None else values).tofile(path)
    rows, cols = SHAPE
    keys = {
        "samples": cols,
        "lines": rows,
        "bands": 1,
        "header offset": 0,
        "data type": 2,
        "interleave": "bsq",
        "byte order": 0,
        "map info": "{UTM, 1, 1, 500000, 5000000, 0.5, 0.5, 31, North, WGS-84}",
        **header,
    }
    (folder / "x.hdr").write_text("ENVI\n" + "\n".join(f"{key} = {value}" for key, value in keys.items()) + "\n")
    return path


def with_sidecar(suffix, *pages):
    """A function that writes an honest raster with a forged file beside it."""

    def make(folder):
        path = write_raster(folder / "x.tif", image_values()[0])
        tiff(folder / f"x.tif{suffix}", *pages)
        return path

    return make


def with_vrt_for_overviews(folder):
    path = write_raster(folder / "x.tif", image_values()[0])
    secret = write_raster(folder / "secret.tif", image_values()[0, ::2, ::2])
    copy_raster(secret, folder / "x.vrt", driver="VRT")
    (folder / "x.vrt").rename(folder / "x.tif.ovr")
    return path


def with_overviews_elsewhere(folder):
    path = write_raster(folder / "x.tif", image_values()[0])
    (folder / "elsewhere").mkdir()
    secret = write_raster(folder / "elsewhere" / "secret.tif", image_values()[0, ::2, ::2])
    item = f'<MDI key="OVERVIEW_FILE">{secret}</MDI>'
    text = f'<PAMDataset><Metadata domain="OVERVIEWS">{item}</Metadata></PAMDataset>'
    (folder / "x.tif.aux.xml").write_text(text)
    return path


PYTHON_VRT = """<VRTDataset rasterXSize="64" rasterYSize="48">
<SRS>EPSG:28992</SRS><GeoTransform>84664, 0.5, 0, 447719, 0, -0.5</GeoTransform>
<VRTRasterBand dataType="Byte" band="1" subClass="VRTDerivedRasterBand">
<PixelFunctionType>evil</PixelFunctionType><PixelFunctionLanguage>Python</PixelFunctionLanguage>
<PixelFunctionCode><![CDATA[
def evil(*args, **kwargs):
    open("FOLDER/owned", "w")
]]></PixelFunctionCode>
<SimpleSource><SourceFilename relativeToVRT="0">/etc/passwd</SourceFilename></SimpleSource>
</VRTRasterBand></VRTDataset>"""


def python_vrt(folder):
    path = folder / "x.tif"
    path.write_text(PYTHON_VRT.replace("FOLDER", str(folder)))
    return path


def grid_of_text(folder):
    path = folder / "x.asc"
    path.write_text("ncols 5000000\nnrows 9000\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n")
    return path


def placed(**changes):
    """A function that writes a raster whose GeoTIFF tags are changed: scale, tie point."""

    def make(folder):
        tags = {**page(*SHAPE), **PLACE}
        tags |= {{"scale": 33550, "tie": 33922}[key]: (12, values) for key, values in changes.items()}
        return tiff(folder / "x.tif", tags)

    return make


HOSTILE = {
    "a giant tile": (
        lambda folder: forged(folder / "x.tif", page(60000, 60000, (60000, 60000))),
        r"x\.tif is stored in tiles of 60000 x 60000 pixels, 3600 MB each; allowed are 256 MB",
    ),
    "a giant strip of many bands": (
        lambda folder: forged(folder / "x.tif", page(4096, 4096, (4096, 4096), bits=(8,) * 200)),
        r"x\.tif is stored in tiles of 4096 x 4096 pixels, 3355 MB each; allowed are 256 MB",
    ),
    "huge dimensions": (
        lambda folder: forged(folder / "x.tif", page(2_000_000_000, 2_000_000_000, (512, 512))),
        r"x\.tif .*(allowed are 1e\+11 in all|cannot be read)",
    ),
    "a million kilometres of one column": (
        lambda folder: forged(folder / "x.tif", page(2_000_000_000, 1, (16, 16))),
        r"x\.tif has 2000000000 x 1 pixels; allowed are 10000000 a side",
    ),
    "absurdly many bands": (
        lambda folder: forged(folder / "x.tif", page(16, 16, bits=(8,) * 60000)),
        r"x\.tif has 60000 bands; allowed are 4096",
    ),
    "complex numbers": (
        lambda folder: forged(folder / "x.tif", page(16, 16, bits=(64,), sample_format=6)),
        r"x\.tif holds complex64 values; allowed are uint8, ",
    ),
    "complex integers": (
        lambda folder: forged(folder / "x.tif", page(16, 16, bits=(32,), sample_format=5)),
        r"x\.tif holds complex_int16 values; allowed are uint8, ",
    ),
    "no pixels": (lambda folder: forged(folder / "x.tif", page(0, 0)), r"x\.tif cannot be read: "),
    "an overview of one giant tile": (
        lambda folder: forged(folder / "x.tif", page(*SHAPE), page(24, 32, (60000, 60000), kind=1)),
        r"image 2 of .*x\.tif is stored in tiles of 60000 x 60000 pixels, 3600 MB each; allowed are 256 MB",
    ),
    "a mask of one giant tile": (
        lambda folder: forged(folder / "x.tif", page(*SHAPE), page(*SHAPE, (60000, 60000), kind=4)),
        r"image 2 of .*x\.tif is stored in tiles of 60000 x 60000 pixels, 3600 MB each; allowed are 256 MB",
    ),
    "an overview beside it of one giant tile": (
        with_sidecar(".ovr", page(24, 32, (60000, 60000))),
        r"image 1 of .*x\.tif\.ovr is stored in tiles of 60000 x 60000 pixels, 3600 MB each; allowed are 256 MB",
    ),
    "a mask beside it of one giant tile": (
        with_sidecar(".msk", page(*SHAPE, (60000, 60000))),
        r"image 1 of .*x\.tif\.msk is stored in tiles of 60000 x 60000 pixels, 3600 MB each; allowed are 256 MB",
    ),
    "a VRT for overviews": (
        with_vrt_for_overviews,
        r"x\.tif(\.ovr)? (cannot be read: .*; allowed is a file of the format GTiff|draws on)",
    ),
    "overviews in another folder": (
        with_overviews_elsewhere,
        r"x\.tif has its overviews in .*secret\.tif; allowed is x\.tif\.ovr",
    ),
    "a VRT with Python in it": (python_vrt, r"x\.tif cannot be read: it is in none of the formats GTiff, ENVI"),
    "a text grid without its numbers": (grid_of_text, r"x\.asc (has \d+ bytes; .* as in its header|cannot be read)"),
    "ENVI: more samples than there are": (
        lambda folder: with_envi(folder, {"samples": 640}),
        r"x\.img has 6144 bytes; 48 x 640 pixels x 1 bands as in its header are 61440",
    ),
    "ENVI: more lines than there are": (
        lambda folder: with_envi(folder, {"lines": 1_000_000}),
        r"x\.img has 6144 bytes; 1000000 x 64 pixels x 1 bands as in its header are 128000000",
    ),
    "ENVI: an offset beyond the end": (
        lambda folder: with_envi(folder, {"header offset": 10**9}),
        r"x\.img has 6144 bytes; 48 x 64 pixels x 1 bands as in its header are 1000006144",
    ),
    "ENVI: a negative offset": (lambda folder: with_envi(folder, {"header offset": -(10**6)}), r"x\.img "),
    "ENVI: complex numbers": (
        lambda folder: with_envi(folder, {"data type": 6}),
        r"x\.img holds complex64 values; allowed are uint8, ",
    ),
    "ENVI: nodata that is no number": (
        lambda folder: with_envi(folder, {"data ignore value": "none"}),
        r"x\.img has the nodata value 'none'; allowed is a number",
    ),
    "ENVI: a place that is no number": (
        lambda folder: with_envi(folder, {"map info": "{UTM, 1, 1, nan, 5, 1, 1, 31, North}"}),
        r"x\.img has the transform .*nan.*; allowed are finite numbers that give pixels an area",
    ),
    "ENVI: pixels without a size": (
        lambda folder: with_envi(folder, {"map info": "{UTM, 1, 1, 4, 5, 0, 0, 31, North}"}),
        r"x\.img has the transform 0, .*; allowed are finite numbers that give pixels an area",
    ),
    "a place that is no number": (
        placed(tie=(0.0, 0.0, 0.0, float("nan"), 1.0, 0.0)),
        r"x\.tif has the transform .*nan.*; allowed are finite numbers that give pixels an area",
    ),
    "an infinite place": (
        placed(tie=(0.0, 0.0, 0.0, float("inf"), 1.0, 0.0)),
        r"x\.tif has the transform .*inf.*; allowed are finite numbers that give pixels an area",
    ),
    "pixels larger than numbers go": (
        placed(scale=(1e308, 1e308, 0.0)),
        r"x\.tif has the transform 1e\+308.*; allowed are finite numbers that give pixels an area",
    ),
}


@pytest.mark.parametrize(("make", "message"), HOSTILE.values(), ids=HOSTILE.keys())
def test_a_hostile_header_is_refused_by_name_before_a_pixel_is_read(tmp_path, make, message):
    path = make(tmp_path)
    start = time.perf_counter()
    with pytest.raises(InputError, match=message) as caught:
        rasters.describe(path)
    assert time.perf_counter() - start < 2
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "owned").exists()


def test_honest_overviews_and_masks_are_accepted(tmp_path):
    path = write_raster(tmp_path / "x.tif", image_values()[0])
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4])
        file.write_mask(np.full(SHAPE, 255, np.uint8))
    assert rasters.describe(path).files == (path,)
    beside = write_raster(tmp_path / "y.tif", image_values()[0])
    with rasterio.Env(TIFF_USE_OVR=True, GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(beside, "r+") as file:
        file.build_overviews([2])
        file.write_mask(np.full(SHAPE, 255, np.uint8))
    assert {file.name for file in rasters.describe(beside).files} == {"y.tif", "y.tif.ovr", "y.tif.msk"}


def test_a_folder_or_a_pipe_is_no_raster(tmp_path):
    import os

    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(InputError, match=f"{path} is no file; allowed is a raster"):
            rasters.describe(path)


def planned(folder, **scene):
    """The error of planning a small scene with some of its files or keys changed."""
    write_raster(folder / "dsm.tif", heights())
    for name, write in (("image.tif", write_image), ("class_map.tif", lambda p: write_raster(p, class_map()))):
        if not (folder / name).exists():
            write(folder / name)
    with pytest.raises(TscorrError) as caught:
        batch.plan(load_config(write_config(folder, scene)))
    return str(caught.value)


@pytest.mark.parametrize("scale", [0.0, float("nan"), float("inf")])
def test_a_scale_in_the_file_that_makes_no_numbers_is_refused(tmp_path, scale):
    path = write_image(tmp_path / "image.tif")
    with rasterio.open(path, "r+") as file:
        file.scales = (1e-4, scale, 1e-4)
    assert re.search(rf"image\.tif has the scale {scale:g}; allowed .* give scale = ", planned(tmp_path))


@pytest.mark.parametrize("offset", [float("nan"), float("inf")])
def test_an_offset_in_the_file_that_makes_no_numbers_is_refused(tmp_path, offset):
    path = write_image(tmp_path / "image.tif")
    with rasterio.open(path, "r+") as file:
        file.offsets = (0.0, offset, 0.0)
    assert re.search(rf"image\.tif has the offset {offset:g}; allowed .* give offset = ", planned(tmp_path))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_class_map_of_fractions_is_refused(tmp_path, dtype):
    write_raster(tmp_path / "class_map.tif", class_map().astype(dtype))
    assert re.search(r"class_map\.tif holds float\d\d values; allowed are integers", planned(tmp_path))


@pytest.mark.parametrize("profile", [{}, {"bigtiff": "yes"}, {"endianness": "big"}], ids=str)
@pytest.mark.parametrize(("number", "text"), [(NODATA, "blank"), (-3, "no")])
def test_a_nodata_value_that_is_no_number_is_refused(tmp_path, profile, number, text):
    path = write_image(tmp_path / "image.tif", nodata=number, **profile)
    path.write_bytes(path.read_bytes().replace(f"{number}\0".encode(), f"{text}\0".encode()))
    assert re.search(rf"image\.tif has the nodata value '{text}'; allowed is a number", planned(tmp_path))


@pytest.mark.parametrize("profile", [{}, {"bigtiff": "yes"}, {"endianness": "big"}], ids=str)
def test_a_nodata_value_of_zero_is_a_number(tmp_path, profile):
    assert rasters.describe(write_image(tmp_path / "image.tif", nodata=0, **profile)).nodata == 0
