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
from tscorr.errors import InputError, MaterialError

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
    known = {"np": np, **{public: getattr(tscorr, public) for public in tscorr.__all__}}
    tests = doctest.DocTestFinder(recurse=False).find(function, name, globs=known)
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
    ],
)
def test_what_correct_refuses(arguments, message):
    with pytest.raises((InputError, MaterialError), match=message):
        tscorr.correct(*arguments)


@pytest.mark.parametrize("scale", [0.0, -1e-4, np.nan])
def test_correct_refuses_a_scale_that_is_none(scale):
    with pytest.raises(InputError, match=r"scale = .*; allowed is a number above 0"):
        tscorr.correct(IMAGE, CLASSES, TILE, *PEAK, scale=scale)
