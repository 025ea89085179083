"""Colours against colour-science's own integration, pictures against an independent PNG reader."""

import subprocess
import sys
import threading
import tracemalloc
from functools import cache

import numpy as np
import pytest
from matplotlib.image import imread  # Pillow

from tscorr import eye, quicklook
from tscorr.errors import InputError, OutputError

DELFT_UM = [0.475, 0.560, 0.668, 0.717, 0.840]
DELFT_FWHM_UM = [0.02, 0.02, 0.01, 0.01, 0.04]
SIXTY_UM = np.linspace(0.4, 1.0, 60)
NM = np.arange(360.0, 831.0)

BAND_SETS = {
    "delft": (DELFT_UM, DELFT_FWHM_UM),
    "delft without widths": (DELFT_UM, None),
    "delft, one width unknown": (DELFT_UM, [0.02, np.nan, 0.01, 0.0, 0.04]),
    "three": ([0.475, 0.560, 0.668], None),
    "three, descending and wide": ([0.61, 0.54, 0.46], [0.08, 0.09, 0.08]),
    "sixty": (SIXTY_UM, np.full(60, 0.012)),
    "sixty without widths": (SIXTY_UM, None),
    "twice the same": ([0.45, 0.55, 0.55, 0.65], np.full(4, 0.02)),
    "one": ([0.55], [0.3]),
    "one near-infrared": ([0.84], None),
    "four infrared": ([0.84, 1.2, 1.6, 2.2], None),
    "unknown": ([np.nan] * 4, None),
    "two unknown": ([np.nan] * 2, None),
}


@pytest.mark.parametrize("name", BAND_SETS)
def test_grey_of_18_percent_is_grey_0461(name):
    wavelengths, fwhm = BAND_SETS[name]
    reflectance = np.full((len(wavelengths), 2, 3), 0.18, np.float32)
    rgb = quicklook.true_colour(reflectance, wavelengths, fwhm)
    assert rgb.shape == (2, 3, 3)
    assert rgb.dtype == np.float32
    np.testing.assert_allclose(rgb, 0.461, atol=1e-3)  # IEC 61966-2-1 of 0.18
    np.testing.assert_allclose(rgb, rgb[0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("interpreter", [sys.executable, "/nowhere/python"])
def test_a_picture_changes_nothing_about_how_arrays_are_printed(interpreter):
    script = (
        "import sys, numpy as np; before = np.get_printoptions(); from tscorr.quicklook import rgb_matrix; "
        f"sys.executable = '{interpreter}'; rgb_matrix([0.45, 0.55, 0.65]); print('colour' in sys.modules); "
        "assert np.get_printoptions() == before, np.get_printoptions()"
    )
    said = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    assert said.strip() == str(interpreter != sys.executable)  # colour-science takes 130 MB, and keeps them


def test_tables_of_the_eye_are_the_same_from_another_process_and_from_this_one(monkeypatch):
    asked = eye.eye()
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    for one, two in zip(asked, eye._asked.__wrapped__(), strict=True):
        assert np.array_equal(one, two)


@pytest.mark.parametrize(
    ("wavelengths", "needed"), [((0.45, 0.55, 0.65), True), ((1.2, 1.6, 2.2), False), ((), False)]
)
def test_the_eye_is_asked_ahead_once_where_colours_are_shown(monkeypatch, wavelengths, needed):
    askers, asked = [], threading.Event()

    def fetch():
        askers.append(threading.current_thread())
        asked.set()

    monkeypatch.setattr(eye, "_asked", cache(fetch))
    quicklook.prepare(wavelengths)
    assert asked.wait(10 if needed else 0.1) == needed
    eye.eye()
    quicklook.prepare(wavelengths)
    assert len(askers) == 1
    assert (askers[0] is threading.current_thread()) != needed


def test_exposure_multiplies_linear_light():
    half = quicklook.true_colour(np.full((5, 1, 1), 0.18), DELFT_UM, exposure=0.5)
    full = quicklook.true_colour(np.full((5, 1, 1), 0.09), DELFT_UM)
    np.testing.assert_allclose(half, full, atol=1e-7)


def test_bands_outside_the_visible_are_ignored_and_named():
    matrix = quicklook.rgb_matrix(DELFT_UM, DELFT_FWHM_UM)
    assert matrix.shape == (5, 3)
    assert matrix.dtype == np.float32
    assert quicklook.used_bands(matrix) == [0, 1, 2, 3]
    assert not matrix[4].any()
    note = quicklook.rendering_note(DELFT_UM, matrix)
    assert note == "shown: 475 nm, 560 nm, 668 nm, 717 nm; not shown: 840 nm"
    image = np.full((5, 1, 2), 0.18)
    image[4] = np.nan  # a nan that nobody looks at
    np.testing.assert_allclose(quicklook.true_colour(image, DELFT_UM), 0.461, atol=1e-3)


def test_note_stays_one_line_with_many_bands():
    note = quicklook.rendering_note(SIXTY_UM, quicklook.rgb_matrix(SIXTY_UM))
    assert note == "shown: 38 bands, 400 nm to 776 nm; not shown: 22 bands, 786 nm to 1000 nm"


def colour_checker():
    """Spectra (24, wavelengths) on NM, and their CIE Lab by colour-science."""
    import colour

    spectra = list(colour.SDS_COLOURCHECKERS["ISO 17321-1"].values())
    shape = colour.SpectralShape(380, 780, 5)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    illuminant = colour.SDS_ILLUMINANTS["D65"].copy().align(shape)
    xyz = [
        colour.sd_to_XYZ(spectrum.copy().align(shape), observer, illuminant, method="Integration")
        for spectrum in spectra
    ]
    lab = colour.XYZ_to_Lab(np.array(xyz) / 100)
    return np.array([np.interp(NM, s.wavelengths, s.values) for s in spectra]), lab


def colour_difference(wavelengths_um, band_fwhm_um, fwhm_um):
    """CIE 2000 differences of the colour checker seen through Gaussian bands and `rgb_matrix`."""
    import colour

    spectra, truth = colour_checker()
    centres, widths = np.array(wavelengths_um) * 1000, np.array(band_fwhm_um) * 1000
    response = np.exp(-4 * np.log(2) * ((NM[:, np.newaxis] - centres) / widths) ** 2)
    reflectance = spectra @ (response / response.sum(axis=0))
    linear = reflectance @ quicklook.rgb_matrix(wavelengths_um, fwhm_um).astype(float)
    xyz = colour.RGB_to_XYZ(linear, colour.models.RGB_COLOURSPACE_sRGB)
    return colour.delta_E(truth, colour.XYZ_to_Lab(xyz), method="CIE 2000")


def test_many_bands_give_the_colours_of_colour_science():
    wavelengths = np.linspace(0.385, 0.775, 79)
    fwhm = np.full(79, 0.006)
    assert colour_difference(wavelengths, fwhm, fwhm).max() < 0.1


def test_widths_matter_where_bands_overlap():
    wavelengths, fwhm = [0.46, 0.54, 0.61], [0.08, 0.09, 0.08]  # as a consumer camera on a drone
    blind = colour_difference(wavelengths, fwhm, None)
    aware = colour_difference(wavelengths, fwhm, fwhm)
    assert aware.mean() < 2.0
    assert aware.mean() < blind.mean() / 2


def test_few_narrow_bands_are_better_than_weights_by_response_alone():
    wavelengths, fwhm = DELFT_UM[:4], DELFT_FWHM_UM[:4]
    assert colour_difference(wavelengths, fwhm, fwhm).mean() < 6.0  # observer x response as weights: 9.0


def test_false_colour_shows_the_infrared_as_red():
    matrix = quicklook.rgb_matrix(DELFT_UM, style="false_colour")
    expected = np.zeros((5, 3))
    expected[4, 0] = expected[2, 1] = expected[1, 2] = 1
    np.testing.assert_array_equal(matrix, expected)
    assert quicklook.rendering_note(DELFT_UM, matrix).startswith("shown: 560 nm, 668 nm, 840 nm;")


def test_false_colour_without_infrared_is_refused():
    with pytest.raises(InputError, match="near-infrared"):
        quicklook.rgb_matrix(DELFT_UM[:3], style="false_colour")


def test_unknown_wavelengths_show_the_first_bands():
    np.testing.assert_array_equal(quicklook.rgb_matrix([np.nan] * 4), np.eye(4, 3))
    np.testing.assert_array_equal(quicklook.rgb_matrix([np.nan] * 2), [[1, 1, 1], [0, 0, 0]])
    note = quicklook.rendering_note([np.nan] * 4, quicklook.rgb_matrix([np.nan] * 4))
    assert note == "shown: band 1, band 2, band 3; not shown: band 4"


@pytest.mark.parametrize("wavelengths", [[475, 560, 668], [-0.5], [0.0]])
def test_wavelengths_in_other_units_are_refused(wavelengths):
    with pytest.raises(InputError, match=f"wavelength {wavelengths[0]:g} um"):
        quicklook.rgb_matrix(wavelengths)


def test_one_width_a_band():
    with pytest.raises(InputError, match="2 band widths for 3"):
        quicklook.rgb_matrix([0.45, 0.55, 0.65], [0.02, 0.02])


def test_srgb_is_the_encoding_of_colour_science():
    import colour

    light = np.linspace(-0.1, 1.2, 3 * 500, dtype=np.float32).reshape(20, 25, 3)
    expected = colour.cctf_encoding(np.clip(light, 0, 1), function="sRGB")
    encoded = quicklook.srgb(light)
    assert encoded.dtype == np.float32
    np.testing.assert_allclose(encoded, expected, atol=1e-6)


def test_no_data_is_mid_grey():
    image = np.full((3, 2, 2), 0.9)
    image[1, 0, 1] = np.nan
    rgb = quicklook.true_colour(image, [0.45, 0.55, 0.65])
    np.testing.assert_array_equal(rgb[0, 1], 0.5)
    assert np.isfinite(rgb).all()


def test_memory_does_not_grow_with_the_bands():
    shape = (400, 400)
    frame = 3 * 4 * shape[0] * shape[1]
    matrix = quicklook.rgb_matrix(SIXTY_UM)
    tracemalloc.start()
    rgb = quicklook.srgb(quicklook.linear_rgb((np.full(shape, 0.18, np.float32) for _ in SIXTY_UM), matrix))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(rgb, 0.461, atol=1e-3)
    assert peak < 6 * frame


def test_only_used_bands_need_to_be_read():
    rng = np.random.default_rng(7)
    image = rng.random((5, 4, 6), dtype=np.float32)
    matrix = quicklook.rgb_matrix(DELFT_UM)
    used = quicklook.used_bands(matrix)
    np.testing.assert_array_equal(quicklook.linear_rgb(image[used], matrix[used]), quicklook.linear_rgb(image, matrix))


def test_exposure_leaves_the_brightest_two_percent_to_clip():
    light = np.repeat(np.arange(1.0, 101.0, dtype=np.float32)[:, np.newaxis, np.newaxis] / 500, 3, axis=2)
    light = np.concatenate([light, np.full((20, 1, 3), np.nan, np.float32)])
    assert quicklook.exposure_for(light) == pytest.approx(0.9 / (98.02 / 500), rel=1e-4)


@pytest.mark.parametrize("value", [np.nan, 0.0, -0.1])
def test_exposure_of_darkness_is_one(value):
    assert quicklook.exposure_for(np.full((3, 3, 3), value, np.float32)) == 1.0


FLAG_NAMES = [  # bits as DESIGN's table of flags.tif; states in bits 6 and 7
    (0, "nothing to remove"),
    (1 << 6, "corrected"),
    (2 << 6, "uncorrectable"),
    ((2 << 6) | 256, "uncorrectable"),
    ((1 << 6) | 512 | 1024 | 2048 | 4096, "corrected"),
    ((3 << 6) | 4, "in shadow"),
    ((3 << 6) | 8 | 32, "in shadow"),
    ((1 << 6) | 8, "corrected"),  # sky term in a shadow
    ((3 << 6) | 16, "not viewed, grazing"),
    ((3 << 6) | 32, "not viewed, grazing"),
    ((3 << 6) | 2 | 8, "no material"),
    ((3 << 6) | 1 | 2 | 8, "no data"),
]


@pytest.mark.parametrize(("bits", "name"), FLAG_NAMES)
def test_each_pixel_shows_the_decisive_flag(bits, name):
    classes = quicklook.flag_classes(np.full((2, 2), bits, np.uint16))
    assert [list(quicklook.FLAG_COLOURS)[index] for index in classes.ravel()] == [name] * 4


def test_flag_colours_differ_for_all_eyes():
    assert len(set(quicklook.FLAG_COLOURS.values())) == len(quicklook.FLAG_COLOURS)


def sheet(tmp_path, shape, title="Delft"):
    before = np.full((*shape, 3), 0.3, np.float32) * np.array([1.0, 0.8, 0.6], np.float32)
    path = tmp_path / "sheet.png"
    quicklook.before_after(before, before / 2, np.full(shape, 2 << 6, np.uint16), path, title=title, exposure=1.0)
    picture = imread(path)
    return before, picture


@pytest.mark.parametrize("shape", [(300, 420), (500, 40), (40, 500), (9, 7), (1, 1)])
def test_panels_hold_the_images(tmp_path, shape):
    before, picture = sheet(tmp_path, shape)
    flag = np.array(quicklook.FLAG_COLOURS["uncorrectable"]) / 255
    shades = [quicklook.srgb(before)[0, 0], quicklook.srgb(before / 2)[0, 0]]
    zoom = -(-400 // max(shape))
    for expected in shades:
        hits = np.all(np.abs(picture[..., :3] - expected) < 1.5 / 255, axis=-1)
        rows, cols = np.flatnonzero(hits.any(axis=1)), np.flatnonzero(hits.any(axis=0))
        assert (np.ptp(rows) + 1, np.ptp(cols) + 1) == (shape[0] * zoom, shape[1] * zoom)
        assert hits.sum() == shape[0] * shape[1] * zoom**2
    hue = picture[..., :3] / np.maximum(picture[..., :3].max(axis=-1, keepdims=True), 1e-6)
    flagged = np.all(np.abs(hue - flag / flag.max()) < 0.02, axis=-1)
    assert flagged.sum() >= shape[0] * shape[1] * zoom**2


def test_long_strips_are_stacked(tmp_path):
    _, wide = sheet(tmp_path, (100, 900))
    _, tall = sheet(tmp_path, (900, 100))
    assert wide.shape[1] < 1000 < tall.shape[1]


@pytest.mark.parametrize("title", ["", "x" * 5000, "Zürich\n§ 12"])
def test_any_title_is_welcome(tmp_path, title):
    sheet(tmp_path, (30, 40), title)


@pytest.mark.parametrize("shape", [(300, 420), (500, 40), (40, 500), (9, 7)])
def test_words_are_on_the_sheet_and_inside_it(tmp_path, shape):
    _, picture = sheet(tmp_path, shape, title="A title much longer than any sheet is wide, " * 6)
    dark = picture[..., :3].max(axis=-1) < 0.4
    assert dark[:60].sum() > 200  # the title
    assert dark[-60:].sum() > 50  # the caption
    edges = np.concatenate([dark[0], dark[-1], dark[:, 0], dark[:, -1]])
    assert not edges.any()


def test_shapes_must_agree(tmp_path):
    before = np.zeros((4, 5, 3), np.float32)
    with pytest.raises(InputError, match="shapes differ"):
        quicklook.before_after(before, before, np.zeros((5, 4), np.uint16), tmp_path / "x.png", title="")


def test_png_rounds_to_eight_bits(tmp_path):
    rgb = np.random.default_rng(3).random((17, 13, 3), dtype=np.float32)
    quicklook.write_png(rgb, tmp_path / "x.png")
    np.testing.assert_allclose(imread(tmp_path / "x.png")[..., :3], rgb, atol=0.5001 / 255)
    assert [path.name for path in tmp_path.iterdir()] == ["x.png"]


def test_exr_keeps_linear_light(tmp_path):
    from OpenImageIO import ImageInput

    light = np.random.default_rng(4).random((6, 5, 3), dtype=np.float32) * 4 - 0.5
    light[2, 3] = np.nan
    quicklook.write_exr(light, tmp_path / "x.exr")
    written = ImageInput.open(str(tmp_path / "x.exr"))
    np.testing.assert_allclose(written.read_image("float"), light, rtol=2**-11, atol=1e-7)
    assert str(written.spec().format) == "half"
    assert written.spec().getattribute("oiio:ColorSpace") == "lin_rec709_scene"


@pytest.mark.parametrize("write", [quicklook.write_png, quicklook.write_exr])
def test_a_folder_that_is_not_there_is_named(tmp_path, write):
    path = tmp_path / "missing" / "x.img"
    with pytest.raises(OutputError, match=str(path)):
        write(np.zeros((3, 3, 3), np.float32), path)


@pytest.mark.parametrize("write", [quicklook.write_png, quicklook.write_exr])
@pytest.mark.parametrize("limit", [100, 40_000])
def test_a_full_disk_leaves_the_old_file(tmp_path, write, limit):
    resource = pytest.importorskip("resource")
    path = tmp_path / "x.img"
    path.write_text("old")
    noise = np.random.default_rng(5).random((200, 200, 3), dtype=np.float32)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(OutputError, match=str(path)):
            write(noise, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.img"]


def test_importing_is_cheap():
    heavy = "{'colour', 'OpenImageIO', 'matplotlib', 'rasterio', 'numba', 'scipy'}"
    code = f"import sys, tscorr.quicklook; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
