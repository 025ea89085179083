"""The functions for notebooks: their examples, against the paper's table, and what they refuse."""

import doctest
import inspect
import json
from pathlib import Path

import numpy as np
import pytest
from small_scene import small_scene

import tscorr
from tscorr.angles import unit_vector
from tscorr.errors import ConfigError, InputError, MaterialError

TABLE = json.loads((Path(__file__).parent / "data/paper_values.json").read_text())
PAPER = [name for name, values in TABLE["materials"].items() if "chi2_df" in values]
PEAK = unit_vector(40.0, 180.0), unit_vector(42.0, 0.0)


FUNCTIONS = [name for name in tscorr.__all__ if inspect.isfunction(getattr(tscorr, name))]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with what the examples name."""
    small_scene(tmp_path).rename(tmp_path / "city.toml")
    (tmp_path / "samples").symlink_to(Path(__file__).parent.parent / "samples")
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_has_an_example_that_is_right(name):
    function = getattr(tscorr, name)
    tests = doctest.DocTestFinder(recurse=False).find(function, name, globs={})
    result = doctest.DocTestRunner().run(tests[0])
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.parametrize("name", PAPER)
def test_brdf_of_the_paper(name):
    """50-digit values; 16 eps (1 + (w alpha)^2) of the specular part is far below 1e-12."""
    points = [point for point in TABLE["points"] if point["material"] == name]
    angles = [np.array([float(point[key]) for point in points]) for key in ("theta_i", "theta_r", "phi")]
    truth = np.array([float(point["f_r"]) for point in points])
    assert len(points) > 10
    np.testing.assert_allclose(tscorr.brdf(name, *angles), truth, rtol=1e-12)


def test_brdf_broadcasts_and_has_edges():
    values = tscorr.brdf("roof_tile", 50, [[0.0], [50.0], [90.0]], [0.0, 180.0], form="simplified")
    assert values.shape == (3, 2)
    assert np.all(np.isnan(values[2]))
    spectral = tscorr.Material("two", (0.1, 0.3), (0.0,), (0.1,), (1.5,), wavelength_um=(0.5, 0.7))
    assert tscorr.brdf(spectral, 0, 0, 0, wavelength_um=0.6) == pytest.approx(0.2)
    with pytest.raises(MaterialError, match="wavelengths"):
        tscorr.brdf(spectral, 0, 0, 0)


def test_dataarrays_come_back_as_they_went_in():
    xarray = pytest.importorskip("xarray")
    places = {"band": [475, 560], "y": [3.0, 2.0, 1.0], "x": [0.5, 1.0, 1.5, 2.0]}
    image = xarray.DataArray(IMAGE, places, ("band", "y", "x"), name="flight", attrs={"units": "1"})
    classes = xarray.DataArray(CLASSES, {key: places[key] for key in "yx"}, ("y", "x"))
    plain, labelled = tscorr.correct(IMAGE, CLASSES, TILE, *PEAK), tscorr.correct(image, classes, TILE, *PEAK)
    for key in ("corrected", "removed"):
        expected = image.copy(data=getattr(plain, key))
        xarray.testing.assert_identical(getattr(labelled, key), expected)
    xarray.testing.assert_identical(labelled.flags, classes.rename("flight").copy(data=plain.flags))
    single = tscorr.correct(image[0], classes, TILE, *PEAK)
    xarray.testing.assert_identical(single.corrected, labelled.corrected[0])
    assert plain.removed.any()


def test_public_names_are_there():
    assert all(hasattr(tscorr, name) for name in tscorr.__all__)
    assert set(tscorr.__all__) <= set(dir(tscorr))
    with pytest.raises(AttributeError, match="no attribute 'brfd'"):
        _ = tscorr.brfd


IMAGE, CLASSES = np.full((2, 3, 4), 0.9, np.float32), np.ones((3, 4), int)
TILE = {1: "roof_tile"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((IMAGE.astype(np.int64), CLASSES, TILE, *PEAK), "an image of int64; allowed are uint8"),
        ((IMAGE.astype(complex), CLASSES, TILE, *PEAK), "an image of complex128"),
        ((IMAGE, CLASSES[:2], TILE, *PEAK), r"shape \(2, 3, 4\) and classes of shape \(2, 4\) do not fit"),
        ((IMAGE[0, 0], CLASSES, TILE, *PEAK), r"shape \(4,\) and classes of shape \(3, 4\) do not fit"),
        ((IMAGE, CLASSES * 1.0, TILE, *PEAK), "a class map holds float64 values; allowed are integers"),
        ((IMAGE, CLASSES, TILE, PEAK[0] * 2, PEAK[1]), "sun holds vectors of length 2; allowed is 1"),
        ((IMAGE, CLASSES, TILE, PEAK[0], [0, 1]), r"view has the shape \(2,\); allowed are \(3,\) and \(3, 3, 4\)"),
        ((IMAGE, CLASSES, TILE, *PEAK, np.ones((3, 4, 3))), r"normal has the shape \(3, 4, 3\)"),
        ((IMAGE, CLASSES, {1: "rooftile"}, *PEAK), r"no material 'rooftile' \(did you mean 'roof_tile'\?\)"),
        ((IMAGE, CLASSES, {1: 7}, *PEAK), "materials holds 1: 7; allowed is an integer: a Material, or its name"),
        ((IMAGE, CLASSES, {"1": "roof_tile"}, *PEAK), "materials holds '1': 'roof_tile'; allowed is an integer"),
    ],
)
def test_what_correct_refuses(arguments, message):
    with pytest.raises((InputError, MaterialError), match=message):
        tscorr.correct(*arguments)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("scale", "x", "a number above 0"),
        ("offset", np.inf, "a number"),
        ("nodata", "none", "a number"),
        ("saturation", np.nan, "a number"),
        ("image_noise", 0.1, "a, b, none below 0"),
        ("image_noise", (0.1, -1), "a, b, none below 0"),
        ("direction_sigma_deg", -1, "an angle from 0 to 45"),
    ],
)
def test_correct_refuses_numbers_that_mean_nothing(name, value, allowed):
    with pytest.raises(InputError, match=f"{name} = .*; allowed is {allowed}"):
        tscorr.correct(IMAGE, CLASSES, TILE, *PEAK, **{name: value})


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        (
            "shadowed",
            np.zeros((2, 2), bool),
            r"shadowed is bool of the shape \(2, 2\); allowed are numbers of \(3, 4\)",
        ),
        ("hidden", np.zeros((2, 2), bool), r"hidden is bool of the shape \(2, 2\)"),
        ("weight", np.full((3, 4), 1.5), "weight holds 1.5; allowed is 0 to 1"),
        ("weight", np.full((3, 4), np.nan), "weight holds nan; allowed is 0 to 1"),
        ("weight", "x", "weight is <U1"),
        ("shadowed", np.full((3, 4), 0.5), "shadowed holds 0.5; allowed is true and false"),
        ("hidden", np.full((3, 4), np.nan), "hidden holds nan; allowed is true and false"),
        ("normal_sigma_deg", -1.0, "normal_sigma_deg holds -1; allowed is 0 to 45"),
        ("normal_sigma_deg", np.full((3, 4), 50.0), "normal_sigma_deg holds 50; allowed is 0 to 45"),
    ],
)
def test_correct_refuses_fields_that_mean_nothing(name, values, message):
    with pytest.raises(InputError, match=message):
        tscorr.correct(IMAGE, CLASSES, TILE, *PEAK, **{name: values})


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("form", "simple", r"'full', 'simplified' \(did you mean 'simplified'\?\)"),
        ("method", "substract", r"'subtract', 'ratio', 'reference' \(did you mean 'subtract'\?\)"),
        ("uncorrectable", None, "'best', 'keep', 'nodata'"),
        ("sky_specular", "no", "True, False"),
        ("direct_fraction", (1.2,), "a share from 0 to 1, or a list"),
        ("direct_fraction", 1.2, "a share from 0 to 1, or a list"),
        ("direct_fraction", (), "a share from 0 to 1, or a list"),
        ("uncorrectable_share", 0, "a share above 0"),
        ("max_zenith_deg", 91, "an angle above 0, up to 90"),
        ("negligible_reflectance", np.nan, "a number from 0"),
        ("reference", (30.0, 80.0, 0.0), "two zenith angles from 0 to 75"),
        ("reference", (30.0,), "two zenith angles from 0 to 75"),
        ("normal_sigma_deg", "5", "an angle from 0 to 45"),
    ],
)
def test_rules_refuse_what_they_do_not_know(name, value, allowed):
    with pytest.raises(ConfigError, match=f"{name} = .*; allowed (is|are) {allowed}"):
        tscorr.Rules(**{name: value})


def test_masked_pixels_have_no_data():
    masked = np.ma.masked_array(IMAGE, mask=np.zeros(IMAGE.shape, bool))
    masked[:, 0, 1] = np.ma.masked
    result = tscorr.correct(masked, CLASSES, TILE, *PEAK)
    assert result.flags[0, 1] & tscorr.PixelFlag.NODATA
    assert np.isnan(result.corrected[:, 0, 1]).all()
    plain = tscorr.correct(IMAGE, CLASSES, TILE, *PEAK)
    np.testing.assert_array_equal(result.corrected[:, 1:], plain.corrected[:, 1:])
    counts = (masked * 1e4).astype(np.uint16)
    with pytest.raises(InputError, match="an image of uint16 has masked values; give the nodata"):
        tscorr.correct(counts, CLASSES, TILE, *PEAK, scale=1e-4)
    assert tscorr.correct(counts, CLASSES, TILE, *PEAK, scale=1e-4, nodata=0).corrected[0, 0, 1] == 0


@pytest.mark.parametrize("nodata", [-9999, 70000, 1.5, float("nan")])
def test_nodata_of_masked_integers_must_be_one(nodata):
    masked = np.ma.masked_greater((IMAGE * 1e4).astype(np.uint16), 1)
    with pytest.raises(InputError, match=r"nodata = .*; allowed is a value that uint16 can hold"):
        tscorr.correct(masked, CLASSES, TILE, *PEAK, nodata=nodata, scale=1e-4)


def test_masked_classes_are_no_material():
    classes = np.ma.masked_array(CLASSES, mask=CLASSES == 0)
    classes[1, 2] = np.ma.masked
    flags = tscorr.correct(IMAGE, classes, TILE, *PEAK).flags
    assert np.argwhere(flags & tscorr.PixelFlag.NO_MATERIAL).tolist() == [[1, 2]]


def test_other_coordinates_are_refused():
    xarray = pytest.importorskip("xarray")
    image = xarray.DataArray(IMAGE, dims=("band", "y", "x"), coords={"y": [3, 2, 1]})
    classes = xarray.DataArray(CLASSES, dims=("y", "x"), coords={"y": [1, 2, 3]})
    with pytest.raises(InputError, match="classes and the image have different coordinates y; align them first"):
        tscorr.correct(image, classes, TILE, *PEAK)
    tscorr.correct(image, classes.assign_coords(y=[3, 2, 1]), TILE, *PEAK)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: tscorr.material(None), "asked for as None; allowed is the name of one"),
        (lambda: tscorr.azimuthal_width(None, 30), "asked for as None; allowed is the name of one"),
        (
            lambda: tscorr.brdf("roof_tile", [10, 20], [1, 2, 3], 180),
            "incidence, exitance and relative azimuth: .*shape",
        ),
        (lambda: tscorr.brdf("roof_tile", "x", 3, 180), "incidence, exitance and relative azimuth: could not convert"),
        (
            lambda: tscorr.brdf("roof_tile", 10, 10, 180, wavelength_um=550),
            r"wavelength_um = \[550\]; allowed is 0.1 to",
        ),
        (lambda: tscorr.correct(IMAGE, CLASSES, ["roof_tile"], *PEAK), "materials is a mapping"),
        (lambda: tscorr.correct(IMAGE, CLASSES, TILE, *PEAK, rules={}), "rules are Rules"),
        (
            lambda: tscorr.correct(IMAGE, CLASSES, TILE, *PEAK, wavelength_um=(500, 600)),
            "wavelength_um = .*; allowed is",
        ),
        (lambda: tscorr.correct(IMAGE[:0], CLASSES, TILE, *PEAK), "do not fit"),
        (lambda: tscorr.correct(IMAGE, CLASSES, TILE, [np.nan] * 3, PEAK[1]), "sun is nan everywhere"),
        (lambda: tscorr.specular_state([0.5]), "flags are float64; allowed are integers"),
        (lambda: tscorr.run(None), "asked for as None; allowed is the path of a file"),
        (lambda: tscorr.Material("a", ("x",), (0.1,), (0.1,), (1.5,)), "t0 = .*; allowed are numbers"),
    ],
)
def test_what_means_nothing_is_refused_in_words(call, message):
    with pytest.raises(tscorr.TscorrError, match=message):
        call()


@pytest.mark.usefixtures("folder")
def test_one_name_serves_where_several_may_be_given():
    result = tscorr.run("city.toml", scenes="roofs", materials="roof_tile")
    assert [scene.name for scene in result.scenes] == ["roofs"]
    assert len(repr(result)) < 500
    with pytest.raises(ConfigError, match="workers = -1"):
        tscorr.run("city.toml", workers=-1)


def test_angles_below_zero_have_no_brdf():
    assert np.isnan(tscorr.brdf("roof_tile", [-50, 50], [50, -50], 180)).all()


def test_numbers_make_a_material():
    assert tscorr.Material("a", 0.1, 0.2, 0.05, 1.5, wavelength_um=0.55).t1 == (0.2,)


def test_rules_take_one_share_for_all_bands_and_plain_directions():
    plain = tscorr.Rules(direct_fraction=0.8, method="reference", reference=(30.0, 5.0, 90.0))
    assert plain.direct_fraction == (0.8,)
    assert plain.reference.relative_azimuth_deg == 90.0
    assert tscorr.correct(IMAGE, CLASSES, TILE, *PEAK, rules=plain).corrected.shape == IMAGE.shape


def test_a_form_that_is_none_is_refused_everywhere():
    with pytest.raises(ConfigError, match="form = 'half'; allowed are 'full' and 'simplified'"):
        tscorr.brdf("roof_tile", 50, 50, 180, form="half")
    with pytest.raises(ConfigError, match="form = 'half'; allowed are 'full' and 'simplified'"):
        tscorr.azimuthal_width("roof_tile", 50, form="half")


def test_widths_take_names_as_brdf_does():
    angles = [30.0, 50.0, 65.0]
    named = tscorr.azimuthal_width("roof_tile", angles)
    np.testing.assert_array_equal(named, tscorr.azimuthal_width(tscorr.material("roof_tile"), angles))
    with pytest.raises(MaterialError, match=r"no material 'rooftile' \(did you mean 'roof_tile'\?\)"):
        tscorr.azimuthal_width("rooftile", 30)


@pytest.mark.parametrize("scale", [0.0, -1e-4, np.nan])
def test_correct_refuses_a_scale_that_is_none(scale):
    with pytest.raises(InputError, match=r"scale = .*; allowed is a number above 0"):
        tscorr.correct(IMAGE, CLASSES, TILE, *PEAK, scale=scale)
