"""Rasters, names and texts from an unknown hand: refused by name before a pixel is read, and shown as plain text."""

import json
import os
import re
import struct
import subprocess
import sys
import time
from collections import Counter
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

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
    write_inputs,
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


KINDS_OF_TIFF = {}, {"bigtiff": "yes"}, {"endianness": "big"}, {"bigtiff": "yes", "endianness": "big"}


@pytest.mark.parametrize("profile", KINDS_OF_TIFF, ids=str)
@pytest.mark.parametrize(("number", "text"), [(NODATA, "blank"), (-3, "no")])
def test_a_nodata_value_that_is_no_number_is_refused(tmp_path, profile, number, text):
    path = write_image(tmp_path / "image.tif", nodata=number, **profile)
    path.write_bytes(path.read_bytes().replace(f"{number}\0".encode(), f"{text}\0".encode()))
    assert re.search(rf"image\.tif has the nodata value '{text}'; allowed is a number", planned(tmp_path))


@pytest.mark.parametrize("profile", KINDS_OF_TIFF, ids=str)
def test_a_nodata_value_of_zero_is_a_number(tmp_path, profile):
    assert rasters.describe(write_image(tmp_path / "image.tif", nodata=0, **profile)).nodata == 0


# Mutated files.

PROCESSES, CASES = 2, 1100


def fuzzed(folder, first):
    """A process of mutated cases, started."""
    command = [sys.executable, Path(__file__).with_name("fuzzing.py"), folder / f"from{first}", first, CASES]
    stderr = (folder / f"stderr{first}").open("w")
    return subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=stderr, text=True), stderr


def test_mutated_headers_tables_and_configurations_end_in_one_message_or_in_a_result(tmp_path, capsys):
    running = [(first, *fuzzed(tmp_path, first)) for first in range(0, PROCESSES * CASES, CASES)]
    total = Counter()
    for first, process, stderr in running:
        lines = process.communicate()[0].splitlines()
        stderr.close()
        log = (tmp_path / f"stderr{first}").read_text(errors="replace")
        assert process.returncode in {0, 1}, f"ended with {process.returncode} at {lines[-1:]}: {log[-3000:]}"
        summary = json.loads(lines[-1])
        assert summary["bad"] == []
        assert "Traceback" not in log
        assert summary["peak_mb"] < 1000
        total.update(summary["counts"])
    states = Counter(name.split()[-1] for name in total.elements())
    with capsys.disabled():
        sys.stdout.write(f"\n{total.total()} mutated cases: {dict(states)}\n")
    assert total.total() == PROCESSES * CASES >= 2000
    assert min(states["refused"], states["planned"], states["done"]) > 10
    assert len({name.split()[0] for name in total}) == 15


# Names and texts.


@pytest.mark.parametrize(
    "name",
    [
        *("../../x", "/etc/x", "a/b", "a\\b", "", " ", ".", "..", ".hidden", "ends.", "ends ", " begins", "x" * 101),
        *("<script>", "a:b", "what?", "*", "con", "CON", "nul.txt", "Com1", "batch.json", "Index.html"),
        *("a\nb", "a\x1b[31mb", "a\0b", "\u202egnp", "\u200b", "ж" * 51),
    ],
    ids=ascii,
)
def test_a_name_that_is_no_folder_on_some_system_is_refused(tmp_path, name):
    message = planned(tmp_path, name=name)
    assert "a name is a folder on any system" in message
    assert message.isprintable()


@pytest.mark.parametrize("names", [("roofs", "Roofs"), ("straße", "STRASSE"), ("caf\u00e9", "cafe\u0301")], ids=ascii)
def test_names_that_are_one_folder_on_some_system_are_refused(tmp_path, names):
    write_inputs(tmp_path)
    with pytest.raises(TscorrError, match="are one folder; give them a name each"):
        load_config(write_config(tmp_path, *({"name": name} for name in names)))


@pytest.mark.parametrize("key", ["image", "class_map"])
@pytest.mark.parametrize(
    "path", ["a\0b.tif", "a\x1b[2Jb.tif", "x" * 300 + ".tif", "y/" * 1500, "a\nb*.tif"], ids=ascii
)
def test_a_path_that_no_file_can_have_is_refused(tmp_path, key, path):
    message = planned(tmp_path, **{key: path})
    assert "can be of no file; allowed are printable characters" in message
    assert message.isprintable()


MARKUP = "&<i>x</i>\"'[red]{0}"
"""what HTML, SVG, XML, a terminal and a format string would each take for their own"""


@pytest.fixture(scope="module")
def marked_up(tmp_path_factory):
    """Folder of a finished batch whose every name and text is hostile."""
    folder = tmp_path_factory.mktemp("marked up")
    image = write_image(folder / f"a{MARKUP.replace('/', '')}.tif")
    with rasterio.open(image, "r+") as file:
        file.update_tags(NOTE=MARKUP, TIFFTAG_ARTIST=MARKUP)
        for band in file.indexes:
            file.set_band_description(band, f"{MARKUP}{band}")
    write_raster(folder / "class_map.tif", class_map())
    write_raster(folder / "dsm.tif", heights())
    text = json.dumps(MARKUP)
    (folder / "own.toml").write_text(f"[{text}]\nsource = {text}\nt0 = 0.02\nt1 = 0.2\nw = 0.04\nn = 1.7\n")
    products = ["corrected", "flags", "removed", "azimuthal_width"]
    config = write_config(
        folder,
        {"name": "a & b '[red]' {0}%s", "image": image.name},
        {"name": "naïve ж 漢", "image": image.name},
        title=f"{MARKUP}\x1b[2J",
        output={"directory": "out", "products": products},
        materials={"library": ["own.toml"], "classes": {"1": MARKUP, "4": "red_aluminum", "5": "lambertian"}},
    )
    result = batch.run(config)
    assert [scene.error for scene in result.scenes] == ["", ""]
    return folder


class Tags(HTMLParser):
    """All tags of a page; the tag <i> is in use only with attributes."""

    def __init__(self, page):
        super().__init__()
        self.open, self.texts = Counter(), []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.open[tag, bool(attrs)] += 1

    def handle_data(self, data):
        self.texts.append(data)


def test_no_text_from_outside_is_markup_in_a_page(marked_up):
    pages = sorted((marked_up / "out").rglob("*.html"))
    assert len(pages) == 3
    for path in pages:
        page = path.read_text(encoding="utf-8")
        tags = Tags(page)
        assert tags.open["i", False] == 0, path
        assert any("<i>x</i>" in text for text in tags.texts), path
        for drawing in re.findall(r"<svg.*?</svg>", page, re.DOTALL):
            assert "<i>" not in drawing
    index = (marked_up / "out" / "index.html").read_text(encoding="utf-8")
    links = [unquote(unescape(link)) for link in re.findall(r'href="([^"]*report\.html)"', index)]
    assert all((marked_up / "out" / link).is_file() for link in links)
    assert len(links) == 2


def test_pages_name_a_batch_and_its_scenes_as_they_are_called(marked_up):
    texts = Tags((marked_up / "out" / "index.html").read_text(encoding="utf-8")).texts
    assert any("a & b '[red]' {0}%s" in text for text in texts)
    assert any("naïve ж 漢" in text for text in texts)


def test_hostile_texts_come_back_from_json_and_from_tags_as_they_were(marked_up):
    for path in (marked_up / "out").rglob("*.json"):
        json.loads(path.read_text(encoding="utf-8"))
    scene = marked_up / "out" / "naïve ж 漢"
    report = json.loads((scene / "report.json").read_text(encoding="utf-8"))
    assert MARKUP in report["materials"]
    assert report["bands"][0] == f"{MARKUP}1"
    corrected = rasters.describe(scene / "corrected.tif")
    assert corrected.tags["NOTE"] == MARKUP
    assert corrected.names[1] == f"{MARKUP}2"
    assert (scene / "quicklook.png").read_bytes().startswith(b"\x89PNG")


def test_stac_of_hostile_texts_is_valid_and_its_links_lead_to_the_files(marked_up):
    import pystac

    out = marked_up / "out"
    collection = pystac.Collection.from_file(str(out / "collection.json"))
    paths = [out / unquote(link.href) for link in collection.get_links("item")]
    items = [pystac.Item.from_file(str(path)) for path in paths]
    assert {item.id for item in items} == {"a & b '[red]' {0}%s", "naïve ж 漢"}
    for item in items:
        assert all((out / item.id / unquote(asset.href)).is_file() for asset in item.assets.values())


def test_nothing_is_written_outside_of_the_output_folder(marked_up):
    made = {path.name for path in marked_up.iterdir()}
    image = f"a{MARKUP.replace('/', '')}.tif"
    assert made == {"city.toml", "class_map.tif", "dsm.tif", "own.toml", "out", image}
    scenes = {path.name for path in (marked_up / "out").iterdir() if path.is_dir() and not path.name.startswith(".")}
    assert scenes == {"a & b '[red]' {0}%s", "naïve ж 漢"}


def run_cli(*arguments):
    """A process of the command line with a terminal's width."""
    command = [sys.executable, "-m", "tscorr", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def test_a_terminal_is_not_obeyed_by_names_and_values(marked_up, tmp_path):
    done = run_cli("run", marked_up / "city.toml")
    assert done.returncode == 0
    text = "\x1b[2J[bold red]"
    (tmp_path / "city.toml").write_text(f'title = 1\n[scenes]\n"{text.replace(chr(27), chr(92) + "u001b")}" = 3\n')
    refused = run_cli("plan", tmp_path / "city.toml")
    assert refused.returncode == 2
    (tmp_path / "own.toml").write_text(
        f"[tiles]\nsource = {json.dumps(text)}\nt0 = 0.02\nt1 = 0.2\nw = 0.04\nn = 1.7\n"
    )
    listed = run_cli("materials", "--library", tmp_path / "own.toml")
    assert "[2J[bold red]" in listed.stdout
    for shown in (done.stdout, done.stderr, refused.stderr, listed.stdout):
        assert "\x1b" not in shown
        assert "Traceback" not in shown


def test_the_progress_of_a_scene_shows_its_name_and_not_its_markup(capsys):
    from types import SimpleNamespace

    from tscorr.cli.scenes import progress_bars

    scene = SimpleNamespace(name="[/bold]a[red]", image=SimpleNamespace(shape=(2, 3)))
    with progress_bars(enabled=True) as progress:
        progress(scene)(6)
    assert "[/bold]a[red]" in capsys.readouterr().err
