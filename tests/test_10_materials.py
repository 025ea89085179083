"""Materials: Table 1 of the paper, interpolation to bands, and what is refused."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from tscorr.errors import MaterialError
from tscorr.materials import Material, builtin_materials, find, load_materials, material, parse_materials

TABLE_1 = {
    name: values
    for name, values in json.loads((Path(__file__).parent / "data/paper_values.json").read_text())["materials"].items()
    if "chi2_df" in values
}
PLAIN = "t0 = 0.02\nt1 = 0.5\nw = 0.06\nn = 1.5\n"
SPECTRAL = "wavelength_um = [0.4, 0.6, 1.0]\nt0 = [0.1, 0.2, 0.6]\nt1 = 0.5\nw = 0.06\nn = [1.5, 1.6, 1.4]\nk = 0.1\n"


def one(body, name="paint"):
    return parse_materials(f"[{name}]\n{body}", "city.toml")[name]


def changed(**values):
    """A material file of one plain material with some values replaced or added, in TOML."""
    settings = tomllib.loads(PLAIN) | values
    return "".join(f"{key} = {value}\n" for key, value in settings.items())


@pytest.mark.parametrize("name", TABLE_1)
def test_table_1_of_the_paper(name):
    surface, printed = material(name), TABLE_1[name]
    for key in ("t0", "t1", "w", "n", "k"):
        assert getattr(surface, key) == (float(printed[key]["value"]),), key
        assert surface.sigma[key] == float(printed[key]["sigma"]), key
    assert surface.chi2_dof == printed["chi2_df"]
    assert surface.wavelength_um == (0.55,)
    assert surface.has_peak


def test_the_library_holds_table_1_and_a_lambertian_surface():
    assert set(builtin_materials()) == {*TABLE_1, "lambertian"}
    assert not material("lambertian").has_peak


def test_bands_are_interpolated_linearly():
    bands = one(SPECTRAL).at([0.4, 0.5, 0.6, 0.7, 1.0])
    np.testing.assert_allclose(bands.t0, [0.1, 0.15, 0.2, 0.3, 0.6], rtol=1e-15)
    np.testing.assert_allclose(bands.n, [1.5, 1.55, 1.6, 1.55, 1.4], rtol=1e-15)
    np.testing.assert_array_equal(bands.t1, [0.5] * 5)
    np.testing.assert_array_equal(bands.k, [0.1] * 5)


def test_one_wavelength_serves_every_band():
    np.testing.assert_array_equal(material("roof_tile").at([0.4, 2.5]).t0, [0.0245, 0.0245])
    np.testing.assert_array_equal(material("roof_tile").at(bands=3).w, [0.0362] * 3)


def test_band_centres_of_float32_are_inside():
    """0.4 um as float32 is 0.4000000059, 1.0 exact; a nanometre outside is outside."""
    assert one(SPECTRAL).at(np.array([0.4, 1.0], np.float32)).t0 == pytest.approx([0.1, 0.6])
    assert one(SPECTRAL.replace("0.4,", "0.7000001,").replace("0.6,", "0.8,")).at([0.7]).t0 == pytest.approx([0.1])


@pytest.mark.parametrize("wavelength", [0.399, 1.001, float("nan")])
def test_bands_outside_the_wavelengths_are_refused(wavelength):
    with pytest.raises(MaterialError, match=rf"'paint' \(city.toml\) covers 0.4 to 1 um.* band at {wavelength:g} um"):
        one(SPECTRAL).at([0.5, wavelength])


def test_bands_of_unknown_wavelength_are_refused():
    with pytest.raises(MaterialError, match=r"'paint' \(city.toml\) has 3 wavelengths, but those of the bands"):
        one(SPECTRAL).at(bands=4)


def test_a_file_is_read_with_its_name(tmp_path):
    path = tmp_path / "city.toml"
    path.write_text(
        f"[paint]\n{PLAIN}[tile]\n{SPECTRAL}covariance = {np.eye(4).tolist()}\nzenith_range_deg = [10, 75]\n"
    )
    materials = load_materials(path)
    assert list(materials) == ["paint", "tile"]
    assert materials["paint"] == Material("paint", (0.02,), (0.5,), (0.06,), (1.5,), file=str(path))
    assert materials["paint"].k == (0.0,)
    assert materials["tile"].zenith_range_deg == (10, 75)
    assert materials["tile"].covariance[3] == (0, 0, 0, 1)


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"], ids=["missing", "not text"])
def test_a_file_that_cannot_be_read(tmp_path, content):
    path = tmp_path / "city.toml"
    if content:
        path.write_bytes(content)
    with pytest.raises(MaterialError, match=r"city.toml cannot be read"):
        load_materials(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[paint", "city.toml is not a TOML file"),
        ("paint = 3", r"city.toml \[paint\] is 3; a material is a table"),
        ("[paint]\nt0 = 0.1\nw = 0.1", r"city.toml \[paint\] lacks t1, n"),
        (
            f"[paint]\n{PLAIN}zenith_range = [0, 75]",
            r"'zenith_range' \(did you mean 'zenith_range_deg'\?\)",
        ),
        (f"[paint]\n{PLAIN}name = 'x'", "unknown key 'name'"),
    ],
)
def test_files_that_are_refused(text, message):
    with pytest.raises(MaterialError, match=message):
        parse_materials(text, "city.toml")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"t0": -0.1}, "t0 = -0.1; allowed is at least 0"),
        ({"t0": "nan"}, "t0 = nan; allowed is at least 0"),
        ({"t1": "inf"}, "t1 = inf; allowed is at least 0"),
        ({"t1": "true"}, "t1 = True; allowed is a number or a list"),
        ({"t1": "'big'"}, "t1 = 'big'; allowed is a number or a list"),
        ({"t1": []}, r"t1 = \[\]; allowed is a number or a list"),
        ({"w": 0}, "w = 0.0; allowed is from 1e-6 to 1000 per degree"),
        ({"w": 2000}, "w = 2000.0; allowed is from 1e-6"),
        ({"n": 0}, "n = 0.0; allowed is from 0.001 to 100"),
        ({"k": -0.25}, "k = -0.25; allowed is from 0 to 100"),
        ({"n": 1, "k": 0}, "n - ik = 1 - 0i; allowed is any other index"),
        ({"t0": [0.1, 0.2]}, r"t0 = \[0.1, 0.2\]; allowed is one value or 1, one a wavelength"),
        ({"wavelength_um": [0.4, 0.5], "t0": [0.1, 0.2, 0.3]}, "allowed is one value or 2, one a wavelength"),
        ({"wavelength_um": [0.5, 0.4]}, r"wavelength_um = \[0.5, 0.4\]; allowed is an ascending list"),
        ({"wavelength_um": [0.5, 0.5]}, "allowed is an ascending list"),
        ({"wavelength_um": [475, 560]}, r"wavelength_um = \[475.0, 560.0\]; allowed is 0.1 to 100 um"),
        ({"zenith_range_deg": [75, 0]}, r"zenith_range_deg = \[75, 0\]; allowed is \[low, high\]"),
        ({"zenith_range_deg": [0, 91]}, "zenith_range_deg"),
        ({"zenith_range_deg": [75]}, "zenith_range_deg"),
        ({"sigma": "{ t2 = 0.1 }"}, "sigma.t2 = 0.1; allowed is an error of t0, t1, w, n, k"),
        ({"sigma": "{ t1 = -0.1 }"}, "sigma.t1 = -0.1; allowed is at least 0"),
        ({"sigma": "{ t1 = nan }"}, "sigma.t1 = nan; allowed is at least 0"),
        ({"covariance": [[1, 0], [0, 1]]}, "covariance = of another shape; allowed is 4 x 4"),
    ],
)
def test_values_that_are_refused(values, message):
    """Every message names the material and its file."""
    with pytest.raises(MaterialError, match=rf"paint.*{message}") as caught:
        one(changed(**values))
    assert "city.toml" in str(caught.value)


@pytest.mark.parametrize(
    "values",
    [
        {"zenith_range_deg": 75},
        {"zenith_range_deg": ["low", "high"]},
        {"sigma": 0.1},
        {"sigma": "{ t1 = 'big' }"},
        {"chi2_dof": "'good'"},
        {"source": 3},
        {"covariance": [[1, 0, 0, 0], [0, 1]]},
        {"covariance": 0.1},
        {"covariance": [["a"] * 4] * 4},
    ],
    ids=str,
)
def test_values_of_another_type_are_refused(values):
    with pytest.raises(MaterialError, match=f"paint.*{next(iter(values))}.*allowed is"):
        one(changed(**values))


def test_no_peak_needs_no_index():
    assert one(changed(t1=0, n=1, k=0)).has_peak is False


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(MaterialError, match=r"no material 'rooftile' \(did you mean 'roof_tile'\?\).*red_aluminum"):
        find("rooftile", builtin_materials())
