"""Laws and behaviour of the correction, through `tscorr.correct` and the `Corrector` beneath it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tscorr
from tscorr import PixelFlag, Rules, SpecularState, specular_state
from tscorr.angles import unit_vector
from tscorr.correction import SINGLE_FLAGS, BlockInputs, Corrector, Stored, add_tally, class_rows, new_tally
from tscorr.errors import InputError
from tscorr.materials import Material, material

TABLE = json.loads((Path(__file__).parent / "data/paper_values.json").read_text())
DTYPES = {"uint8": 1 / 250, "int16": 1e-4, "uint16": 1e-4, "float32": 1.0}
"""types of images and a scale that suits them"""
PEAK = unit_vector(40.0, 180.0), unit_vector(42.0, 0.0)
"""sun and view: two degrees off the mirror, a degree off the peak"""
NEGLIGIBLE, CORRECTED, UNCORRECTABLE, NOT_ASSESSED = SpecularState
CITY = {1: "roof_tile", 2: "red_concrete", 3: "red_aluminum", 5: "lambertian"}
"""class 4 has no material"""


def city(dtype, rows=23, cols=150, bands=3):
    """Image, classes, sun, view and normals of roofs of all slopes, some in the peak."""
    rng = np.random.default_rng(11)
    reflectance = 10 ** rng.uniform(-2, -0.05, (bands, rows, cols))
    image = reflectance / DTYPES[dtype]
    image = image.astype(dtype) if dtype == "float32" else np.rint(image).astype(dtype)
    normal = unit_vector(rng.uniform(0, 45, (rows, cols)), rng.uniform(0, 360, (rows, cols)))
    view = unit_vector(rng.uniform(0, 50, (rows, cols)), rng.uniform(0, 360, (rows, cols)))
    return image, rng.integers(1, 6, (rows, cols)), PEAK[0], view, normal


def one_pixel(value=0.6, surface="red_concrete", *, sun=PEAK[0], view=PEAK[1], normal=None, bands=1, **options):
    """Correct one pixel of `bands` bands; its value, what was removed, its flags and its state."""
    image = np.broadcast_to(np.asarray(value, np.float32).reshape(-1, 1, 1), (bands, 1, 1))
    result = tscorr.correct(image, np.ones((1, 1), int), {1: surface}, sun, view, normal, **options)
    flags = PixelFlag(int(result.flags[0, 0]))
    values = result.corrected[:, 0, 0], result.removed[:, 0, 0]
    return *values, flags & ~PixelFlag.SPECULAR_STATE, SpecularState(int(specular_state(result.flags)[0, 0]))


def same(a, b):
    """Whether two results are equal bit for bit."""
    return all(x.tobytes() == y.tobytes() for x, y in ((a.corrected, b.corrected), (a.removed, b.removed))) and (
        a.flags.tobytes() == b.flags.tobytes()
    )


# What is removed


@pytest.mark.parametrize("row", TABLE["corrections"], ids=lambda row: row["material"])
@pytest.mark.parametrize("precision", ["fast", "exact", "reference"])
def test_subtraction_of_the_50_digit_table(row, precision):
    """R - B; where the table's result is below zero, the pixel is clipped and called uncorrectable."""
    sun, view = unit_vector(float(row["theta_i"]), 180.0), unit_vector(float(row["theta_r"]), 180 - float(row["phi"]))
    rules = Rules(precision=precision, direct_fraction=(float(row["beta"]),))
    bright = 8.0
    corrected, removed, flags, state = one_pixel(bright, row["material"], sun=sun, view=view, rules=rules)
    assert removed[0] == pytest.approx(float(row["specular_R"]), rel=5e-6, abs=1e-6)
    assert corrected[0] == np.float32(bright) - removed[0]
    assert (flags, state) == (0, CORRECTED)
    corrected, removed, flags, state = one_pixel(row["R"], row["material"], sun=sun, view=view, rules=rules)
    assert float(row["subtract"]) < 0
    assert (corrected[0], removed[0]) == (0, np.float32(row["R"]))
    assert (flags, state) == (PixelFlag.CLIPPED, UNCORRECTABLE)


@pytest.mark.parametrize("precision", ["fast", "exact"])
def test_the_plane_that_the_reflectance_refers_to(precision):
    """On the horizontal plane the lobe of a tilted facet is scaled by cos(incidence) / cos(solar zenith)."""
    normal = unit_vector(25.0, 200.0)
    view = 2 * (PEAK[0] @ normal) * normal - PEAK[0]
    removed = {
        plane: one_pixel(8.0, view=view, normal=normal, rules=Rules(irradiance_plane=plane, precision=precision))[1]
        for plane in ("horizontal", "facet")
    }
    ratio = (PEAK[0] @ normal) / PEAK[0][2]
    assert abs(ratio - 1) > 0.2
    np.testing.assert_allclose(removed["horizontal"] / removed["facet"], ratio, rtol=3e-6)


def test_the_simplified_form_takes_more():
    directions = {"sun": unit_vector(20.0, 180.0), "view": unit_vector(68.0, 0.0)}
    full, simplified = (one_pixel(0.9, **directions, rules=Rules(form=form))[1] for form in ("full", "simplified"))
    cos_i, cos_r, cos_l = np.cos(np.deg2rad([20, 68, 44]))
    g = min(1, min(cos_i, cos_r) * (cos_i + cos_r) / cos_l**2)
    assert g < 0.97
    np.testing.assert_allclose(full, g * simplified, rtol=1e-5)


def test_scale_and_offset_say_what_stored_values_mean():
    plain = one_pixel(0.6)[1]
    scaled = one_pixel(0.6 * 50 + 20, scale=0.02, offset=-0.4)
    np.testing.assert_allclose(scaled[1] * 0.02, plain, rtol=1e-5)
    assert scaled[3] == CORRECTED


# Laws


@pytest.mark.parametrize("dtype", DTYPES)
def test_without_a_peak_nothing_changes_bit_for_bit(dtype):
    image, classes, sun, view, normal = city(dtype)
    dull = Material("dull", (0.1,), (0.0,), (0.08,), (1.5,), (0.25,))
    result = tscorr.correct(image, classes, dict.fromkeys(range(1, 6), dull), sun, view, normal, scale=DTYPES[dtype])
    assert result.corrected.tobytes() == image.tobytes()
    assert not result.removed.any()
    assert not result.flags.any()


@pytest.mark.parametrize(
    ("dtype", "precision"),
    [*((dtype, "fast") for dtype in DTYPES), ("uint16", "exact"), ("float32", "exact"), ("float32", "reference")],
)
def test_input_minus_removed_is_corrected(dtype, precision):
    """Exactly, in stored values; and nothing gets brighter or falls below zero."""
    image, classes, sun, view, normal = city(dtype)
    original = image.copy()
    rules = Rules(precision=precision)
    result = tscorr.correct(image, classes, CITY, sun, view, normal, scale=DTYPES[dtype], rules=rules)
    assert image.tobytes() == original.tobytes()
    assert result.corrected.dtype == result.removed.dtype == image.dtype
    np.testing.assert_array_equal(image - result.removed, result.corrected)
    assert np.all(result.removed >= 0)
    assert np.all(result.corrected >= 0)
    touched = result.removed.any(axis=0)
    assert 0.05 < touched.mean() < 0.95
    assert set(specular_state(result.flags)[touched]) == {CORRECTED, UNCORRECTABLE}
    assert set(np.unique(specular_state(result.flags))) == set(SpecularState)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "settings", [{}, {"form": "simplified", "irradiance_plane": "facet", "uncorrectable": "keep"}]
)
def test_skipping_changes_nothing(dtype, settings):
    image, classes, sun, view, normal = city(dtype)
    classes = np.sort(classes, axis=1)  # chunks of one material, so that some can be skipped
    arguments = (image, classes, CITY, sun, view, normal)
    skip, all_ = (
        tscorr.correct(*arguments, scale=DTYPES[dtype], rules=Rules(**settings), skip=skip) for skip in (True, False)
    )
    assert same(skip, all_)


def test_far_from_the_peak_chunks_are_skipped():
    """The skipping above is not idle: aluminium seen far from its mirror is never computed."""
    image, classes, sun, _, _ = city("uint16")
    corrector = corrector_of("uint16")
    inputs = BlockInputs(
        image=image,
        material=np.full(classes.shape, 3, np.uint8),
        sun=sun.reshape(3, 1, 1),
        view=unit_vector(50.0, 180.0).reshape(3, 1, 1),
        normal=np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1),
    )
    assert corrector(inputs).tally.out_of_lobe[0] == classes.size


def test_removal_grows_with_t1_and_keeps_its_shape():
    """Without the clipping of dark pixels, twice the t1 takes twice as much away."""
    image, classes, sun, view, normal = city("float32")
    image += 8
    surface = material("red_concrete")
    once, twice = (
        tscorr.correct(image, classes, {2: replace(surface, t1=(t1,))}, sun, view, normal).removed for t1 in (0.5, 1.0)
    )
    both = (once > 0.01) & (twice > 0.01)
    assert both.any()
    np.testing.assert_allclose(twice[both], 2 * once[both], rtol=1e-4)


# Flags, one by one

LOW_SUN = unit_vector(88.0, 180.0)
AWAY = unit_vector(60.0, 0.0)
"""normal of a slope that faces away from a sun in the south"""


@pytest.mark.parametrize("precision", ["fast", "exact", "reference"])
@pytest.mark.parametrize(
    ("arguments", "flags", "state"),
    [
        ({"value": np.nan}, PixelFlag.NODATA, NOT_ASSESSED),
        ({"value": np.inf}, PixelFlag.NODATA, NOT_ASSESSED),
        ({"value": -np.inf}, PixelFlag.NODATA, NOT_ASSESSED),
        ({"value": 7.0, "nodata": 7.0}, PixelFlag.NODATA, NOT_ASSESSED),
        ({"normal": AWAY}, PixelFlag.SELF_SHADOW, NOT_ASSESSED),
        ({"sun": unit_vector(95.0, 180.0)}, PixelFlag.SELF_SHADOW, NOT_ASSESSED),
        ({"shadowed": True}, PixelFlag.CAST_SHADOW, NOT_ASSESSED),
        ({"hidden": True}, PixelFlag.NOT_VIEWED, NOT_ASSESSED),
        ({"normal": unit_vector(60.0, 180.0)}, PixelFlag.NOT_VIEWED, NOT_ASSESSED),
        ({"sun": LOW_SUN, "surface": "grazing"}, PixelFlag.GRAZING, NOT_ASSESSED),
        ({"view": unit_vector(76.0, 0.0)}, PixelFlag.GRAZING, NOT_ASSESSED),
        ({"view": unit_vector(76.0, 0.0), "surface": "grazing"}, PixelFlag(0), CORRECTED),
        ({"surface": "steep"}, PixelFlag.GRAZING, NOT_ASSESSED),
        ({"shadowed": True, "hidden": True}, PixelFlag.CAST_SHADOW | PixelFlag.NOT_VIEWED, NOT_ASSESSED),
        ({"view": unit_vector(50.0, 180.0)}, PixelFlag(0), NEGLIGIBLE),
        ({"surface": "lambertian", "shadowed": True, "normal": AWAY}, PixelFlag(0), NEGLIGIBLE),
        ({}, PixelFlag(0), CORRECTED),
        ({"value": 0.2}, PixelFlag.CLIPPED, UNCORRECTABLE),
        ({"value": 0.0}, PixelFlag.CLIPPED, UNCORRECTABLE),
        ({"saturation": 0.5}, PixelFlag.SATURATED, UNCORRECTABLE),
        ({"saturation": 0.5, "view": unit_vector(50.0, 180.0)}, PixelFlag.SATURATED, NEGLIGIBLE),
        ({"saturation": 0.5, "shadowed": True}, PixelFlag.SATURATED | PixelFlag.CAST_SHADOW, NOT_ASSESSED),
    ],
)
def test_flags_and_state_of_a_pixel(arguments, flags, state, precision):
    """Bits 0 to 5 make a pixel not assessed; else it may be negligible, then uncorrectable, then corrected."""
    surfaces = {
        "grazing": replace(material("red_concrete"), zenith_range_deg=(0.0, 90.0)),
        "steep": replace(material("red_concrete"), zenith_range_deg=(41.0, 75.0)),
    }
    surface = arguments.get("surface", "red_concrete")
    corrected, removed, found, found_state = one_pixel(
        **{"value": 0.9} | arguments | {"surface": surfaces.get(surface, surface)}, rules=Rules(precision=precision)
    )
    assert (found, found_state) == (flags, state)
    if state in {NEGLIGIBLE, NOT_ASSESSED} or flags & PixelFlag.SATURATED:
        np.testing.assert_array_equal(corrected, np.float32(arguments.get("value", 0.9)))
        assert removed[0] == 0


def test_flags_of_the_inputs_are_kept():
    """What is known before the correction: the class's confidence everywhere, the rest only where a peak may be."""
    shape = 1, 4
    everywhere = np.ones(shape, bool)
    inputs = BlockInputs(
        image=np.array([[[0.9, 0.9, np.nan, 0.9]]], np.float32),
        material=np.array([[1, 2, 1, 0]], np.uint8),
        sun=PEAK[0].reshape(3, 1, 1),
        view=PEAK[1].reshape(3, 1, 1),
        normal=np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1),
        shadowed=everywhere,
        hidden=everywhere,
        unreliable=everywhere,
        low_confidence=everywhere,
    )
    surfaces = [material("roof_tile"), material("lambertian")]
    stored = Stored(dtype=np.dtype(np.float32), scale=(1.0,), offset=(0.0,))
    result = Corrector([(surface, surface.at(), Rules()) for surface in surfaces], stored)(inputs)
    doubt = PixelFlag.LOW_CONFIDENCE
    not_assessed = NOT_ASSESSED << 6
    expected = [
        doubt | PixelFlag.NORMAL_UNRELIABLE | PixelFlag.CAST_SHADOW | PixelFlag.NOT_VIEWED | not_assessed,
        doubt,
        doubt | PixelFlag.NODATA | not_assessed,
        doubt | PixelFlag.NO_MATERIAL | not_assessed,
    ]
    np.testing.assert_array_equal(result.flags, [expected])
    np.testing.assert_array_equal(result.tally.states, [[0, 0, 0, 1], [0, 0, 0, 2], [1, 0, 0, 0]])


def test_bits_of_the_flags():
    names = ["NODATA", "NO_MATERIAL", "SELF_SHADOW", "CAST_SHADOW", "NOT_VIEWED", "GRAZING"]
    names += ["SATURATED", "CLIPPED", "UNCERTAIN", "NORMAL_UNRELIABLE", "LOW_CONFIDENCE"]
    bits = [0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12]
    assert [(flag.name, flag.value) for flag in SINGLE_FLAGS] == [
        (name, 1 << bit) for name, bit in zip(names, bits, strict=True)
    ]
    np.testing.assert_array_equal(specular_state(np.array([0, 64, 128, 192, 0x1F3F], np.uint16)), [0, 1, 2, 3, 0])


def test_a_class_without_material_is_left_alone():
    result = tscorr.correct(np.full((1, 3), 0.9, np.float32), [[1, 7, -1]], {1: "red_concrete"}, *PEAK)
    np.testing.assert_array_equal(specular_state(result.flags), [[CORRECTED, NOT_ASSESSED, NOT_ASSESSED]])
    np.testing.assert_array_equal(result.flags & PixelFlag.NO_MATERIAL, [[0, 2, 2]])
    assert np.all(result.removed[0, 1:] == 0)


def test_a_disabled_material_is_left_alone():
    corrected, _, flags, state = one_pixel(0.9, rules=Rules(enabled=False))
    assert (corrected[0], flags, state) == (np.float32(0.9), 0, NEGLIGIBLE)


# Thresholds


def test_the_zenith_limits():
    """85 degrees for the full form, 70 for the simplified, the setting before both, the material within all."""
    wide = replace(material("red_concrete"), zenith_range_deg=(0.0, 90.0))
    for limit, rules, surface in (
        (85, Rules(), wide),
        (70, Rules(form="simplified"), wide),
        (50, Rules(max_zenith_deg=50.0), wide),
        (75, Rules(max_zenith_deg=89.0), material("red_concrete")),
    ):
        for zenith, grazing in ((limit - 0.01, False), (limit + 0.01, True)):
            for sun, view in ((zenith, 20.0), (20.0, zenith)):
                directions = {"sun": unit_vector(sun, 180.0), "view": unit_vector(view, 0.0)}
                assert bool(one_pixel(9.0, surface, **directions, rules=rules)[2] & PixelFlag.GRAZING) is grazing


def test_a_band_below_the_threshold_keeps_its_value():
    """Band by band: t1 of the second band is so small that nothing is taken there."""
    surface = Material("two", (0.1,), (1.0, 1e-4), (0.08,), (1.5,), (0.25,), wavelength_um=(0.5, 0.8))
    options = {"bands": 2, "wavelength_um": [0.5, 0.8]}
    removed_at_once = one_pixel(0.9, surface, rules=Rules(negligible_reflectance=0.0), **options)[1]
    assert removed_at_once[1] == pytest.approx(removed_at_once[0] * 1e-4, rel=1e-2)
    between = Rules(negligible_reflectance=float(removed_at_once[1]) * 1.01)
    corrected, removed, _, state = one_pixel(0.9, surface, rules=between, **options)
    assert (corrected[1], removed[1], state) == (np.float32(0.9), 0, CORRECTED)
    assert removed[0] == removed_at_once[0]
    above = Rules(negligible_reflectance=float(removed_at_once[0]) * 1.01)
    assert one_pixel(0.9, surface, rules=above, **options)[3] == NEGLIGIBLE


def test_the_share_above_which_a_pixel_is_uncorrectable():
    amount = float(one_pixel(8.0)[1][0])
    for share, state in ((amount / 0.9 * 1.001, CORRECTED), (amount / 0.9 * 0.999, UNCORRECTABLE)):
        assert one_pixel(0.9, rules=Rules(uncorrectable_share=share))[3] == state


@pytest.mark.parametrize("precision", ["fast", "exact", "reference"])
@pytest.mark.parametrize("policy", ["best", "keep", "nodata"])
def test_uncorrectable_pixels(policy, precision):
    """Three bands: correctable, above the share, saturated. The last is never reduced."""
    rules = Rules(uncorrectable=policy, precision=precision)
    values = np.array([0.9, 0.2, 4.0], np.float32)
    corrected, removed, flags, state = one_pixel(values, bands=3, saturation=3.0, nodata=-1.0, rules=rules)
    assert state == UNCORRECTABLE
    amount = one_pixel(values[0], rules=Rules(precision=precision))[1][0]
    if policy == "best":
        assert flags == PixelFlag.SATURATED | PixelFlag.CLIPPED
        np.testing.assert_array_equal(removed, np.array([amount, values[1], 0], np.float32))
        np.testing.assert_array_equal(corrected, values - removed)
    else:
        assert flags == PixelFlag.SATURATED
        np.testing.assert_array_equal(removed, [0, 0, 0])
        np.testing.assert_array_equal(corrected, values if policy == "keep" else [-1, -1, -1])


def test_saturation_of_one_band_decides_for_all():
    values = np.array([0.9, 0.95], np.float32)
    corrected, removed, flags, state = one_pixel(values, bands=2, saturation=0.95)
    assert (flags, state) == (PixelFlag.SATURATED, UNCORRECTABLE)
    assert corrected[1] == values[1]
    assert removed[0] == one_pixel(values[0])[1][0]


# The ends of the types


@pytest.mark.parametrize("precision", ["fast", "exact", "reference"])
@pytest.mark.parametrize(
    ("dtype", "options", "value", "expected", "clipped"),
    [
        ("uint16", {"scale": 1e-4}, 1000, 0, True),
        ("uint16", {"scale": 1e-4, "nodata": 0}, 1000, 1, True),
        ("uint16", {"scale": 1e-4, "nodata": 0}, 1, 1, True),
        ("uint16", {"scale": 1e-4, "nodata": 0}, 0, 0, False),
        ("uint16", {"scale": 1e-4, "nodata": 65535}, 1000, 0, True),
        ("uint16", {"scale": 1e-4, "offset": -0.1}, 2000, 1000, True),
        ("uint16", {"scale": 1e-4, "offset": -0.1}, 900, 900, True),
        ("uint16", {"scale": 1e-4, "offset": 0.1}, 1000, 0, True),
        ("int16", {"scale": 1e-4, "nodata": -9999}, 1000, 0, True),
        ("int16", {"scale": 1e-4, "offset": 0.1}, 1000, -1000, True),
        ("int16", {"scale": 1e-4}, -5, -5, True),
        ("uint8", {"scale": 0.004}, 20, 0, True),
        ("float32", {}, 0.1, 0, True),
        ("float32", {"nodata": 0}, 0.1, np.float32(0.1) - (np.float32(0.1) - np.float32(1e-5)), True),
        ("float32", {"nodata": 0}, 0.0, 0, False),
        ("float32", {"offset": -0.0301}, 0.2, np.float32(0.2) - (np.float32(0.2) - np.float32(0.0301)), True),
    ],
)
def test_what_a_clipped_value_becomes(dtype, options, value, expected, clipped, precision):
    """Reflectance 0, or the type's end; never the value that stands for nodata, and never brighter."""
    image = np.full((1, 1), value, dtype)
    rules = Rules(precision=precision)
    result = tscorr.correct(image, [[1]], {1: "red_concrete"}, *PEAK, rules=rules, **options)
    assert result.corrected[0, 0] == np.array(expected, dtype)
    assert result.corrected[0, 0] == image[0, 0] - result.removed[0, 0]
    assert bool(result.flags[0, 0] & PixelFlag.CLIPPED) is clipped
    assert bool(result.flags[0, 0] & PixelFlag.NODATA) is (not clipped)


@pytest.mark.parametrize("nodata", [-1, 256, 0.5, float("nan")])
def test_a_nodata_value_that_the_type_cannot_hold_is_never_met(nodata):
    """-1 is not 255 of a uint8 image, and 0.5 is not 0."""
    image = np.array([[0, 1, 255]], np.uint8)
    result = tscorr.correct(image, [[1, 1, 1]], {1: "lambertian"}, *PEAK, scale=0.004, nodata=nodata)
    assert not result.flags.any()


def test_to_blank_a_pixel_takes_a_nodata_value():
    with pytest.raises(InputError, match=r"uncorrectable = 'nodata'.* has no nodata value"):
        one_pixel(0.2, rules=Rules(uncorrectable="nodata"))


@pytest.mark.parametrize(
    "options", [{"wavelength_um": [0.5, 0.6, 0.7]}, {"rules": Rules(direct_fraction=(0.8, 0.9, 1.0))}]
)
def test_settings_for_another_number_of_bands_are_refused(options):
    with pytest.raises(InputError, match=r"material 'red_concrete' has .* the image has 2 bands"):
        one_pixel(0.9, bands=2, **options)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16"])
def test_a_corrected_value_never_reads_as_nodata(dtype):
    image, classes, sun, view, normal = city(dtype)
    for nodata in (0, 3, 100):
        result = tscorr.correct(image, classes, CITY, sun, view, normal, scale=DTYPES[dtype], nodata=nodata)
        np.testing.assert_array_equal(result.corrected == nodata, image == nodata)
        assert np.all(result.corrected <= image)


def test_integers_are_rounded_to_the_nearest_step():
    """0.9 as uint16 and as float32: the same amount to half a step."""
    exact = one_pixel(0.9)[1][0]
    result = tscorr.correct(np.full((1, 1), 9000, np.uint16), [[1]], {1: "red_concrete"}, *PEAK, scale=1e-4)
    assert result.removed[0, 0] == np.rint(exact * 1e4)


# Blocks and engines


def corrector_of(dtype, settings=({},) * 4, **options):
    scale = (DTYPES[dtype],) * 3
    stored = Stored(dtype=np.dtype(dtype), scale=scale, offset=(0.0,) * 3)
    surfaces = [material(name) for name in CITY.values()]
    entries = [(surface, surface.at(bands=3), Rules(**s)) for surface, s in zip(surfaces, settings, strict=True)]
    return Corrector(entries, stored, **options)


def city_inputs(dtype):
    image, classes, sun, view, normal = city(dtype)
    rng = np.random.default_rng(12)
    return BlockInputs(
        image=image,
        material=class_rows(classes, {value: row for row, value in enumerate(CITY, start=1)}),
        sun=sun.reshape(3, 1, 1),
        view=view,
        normal=normal,
        shadowed=rng.random(classes.shape) < 0.1,
        hidden=rng.random(classes.shape) < 0.1,
    )


def piece(inputs, rows, cols):
    """A copy of a part of a block; constant vectors stay (3, 1, 1)."""
    values = {name: getattr(inputs, name) for name in BlockInputs.__slots__}
    return BlockInputs(
        **{
            name: value if value is None or value.shape[-2:] == (1, 1) else value[..., rows, cols].copy()
            for name, value in values.items()
        }
    )


@pytest.mark.parametrize("dtype", ["uint16", "float32"])
@pytest.mark.parametrize("tile", [(1, 1000), (7, 64), (5, 129)], ids=str)
def test_how_a_scene_is_cut_changes_nothing(dtype, tile):
    """Results and sums are the same bytes for any blocks, also where only every second row is counted."""
    corrector = corrector_of(dtype, tally_stride=2)
    inputs = city_inputs(dtype)
    whole = corrector(piece(inputs, slice(None), slice(None)))
    corrected, removed, flags = (np.zeros_like(a) for a in (whole.corrected, whole.removed, whole.flags))
    total = new_tally(5, 3)
    for row in range(0, flags.shape[0], tile[0]):
        for col in range(0, flags.shape[1], tile[1]):
            where = slice(row, row + tile[0]), slice(col, col + tile[1])
            part = corrector(piece(inputs, *where), first_row=row)
            corrected[:, *where], removed[:, *where], flags[where] = part.corrected, part.removed, part.flags
            add_tally(total, part.tally)
    assert corrected.tobytes() == whole.corrected.tobytes()
    assert removed.tobytes() == whole.removed.tobytes()
    assert flags.tobytes() == whole.flags.tobytes()
    for name, sums in total._asdict().items():
        if name != "out_of_lobe":  # whether a chunk is skipped depends on the chunk
            np.testing.assert_array_equal(sums, getattr(whole.tally, name), err_msg=name)


def test_where_no_image_was_read_flags_and_sums_are_the_same():
    corrector, inputs = corrector_of("uint16"), city_inputs("uint16")
    inputs.material[:3] = 0
    known = replace(inputs, shadowed=None, hidden=None)
    unread = replace(known, image=np.empty((0, *inputs.material.shape), np.uint16))
    read, told = corrector.passed_through(known), corrector.passed_through(unread)
    none = PixelFlag.NO_MATERIAL | SpecularState.NOT_ASSESSED << 6
    np.testing.assert_array_equal(told.flags, np.where(inputs.material == 0, none, 0))
    np.testing.assert_array_equal(told.flags, read.flags)
    for name, sums in read.tally._asdict().items():
        np.testing.assert_array_equal(getattr(told.tally, name), sums, err_msg=name)


def test_the_tally_counts_every_pixel():
    result = corrector_of("uint16")(city_inputs("uint16"))
    states, counts = specular_state(result.flags), result.tally.states
    assert counts.sum() == states.size
    np.testing.assert_array_equal(counts.sum(axis=0), np.bincount(states.ravel(), minlength=4))
    removed = result.removed.astype(float).sum(axis=(1, 2)) * 1e-4
    np.testing.assert_allclose(result.tally.removed.sum(axis=0) / 2.0**32, removed, rtol=1e-6)
    assessed = counts[1:4, :3].sum()
    assert result.tally.incidence.sum() == result.tally.tilt.sum() == assessed
    assert result.tally.share.sum() == counts[:, 1:3].sum()


def test_precision_may_differ_by_material():
    """Each material comes out as if its precision were everyone's."""
    precisions = ["fast", "exact", "reference", "fast"]
    inputs = city_inputs("uint16")
    mixed = corrector_of("uint16", [{"precision": p} for p in precisions])(piece(inputs, slice(None), slice(None)))
    for precision in set(precisions):
        alone = corrector_of("uint16", [{"precision": precision}] * 4)(piece(inputs, slice(None), slice(None)))
        mine = np.isin(inputs.material, [0, *(row for row, p in enumerate(precisions, start=1) if p == precision)])
        np.testing.assert_array_equal(mixed.corrected[:, mine], alone.corrected[:, mine])
        np.testing.assert_array_equal(mixed.removed[:, mine], alone.removed[:, mine])
        np.testing.assert_array_equal(mixed.flags[mine], alone.flags[mine])
    np.testing.assert_array_equal(mixed.tally.states.sum(axis=1), np.bincount(inputs.material.ravel(), minlength=5))


def test_what_is_removed_need_not_be_asked_for():
    inputs = city_inputs("uint16")
    asked, not_asked = (
        corrector_of("uint16")(piece(inputs, slice(None), slice(None)), want_removed=want) for want in (True, False)
    )
    assert not_asked.removed is None
    assert asked.corrected.tobytes() == not_asked.corrected.tobytes()


def test_which_materials_have_peaks():
    corrector = corrector_of("uint16", [{}, {"enabled": False}, {"precision": "exact"}, {}])
    np.testing.assert_array_equal(corrector.peaks, [False, True, False, True, False])


def test_more_materials_than_a_byte_can_name():
    surface = material("roof_tile")
    stored = Stored(dtype=np.dtype(np.uint16), scale=(1.0,), offset=(0.0,))
    with pytest.raises(InputError, match="255 materials; allowed are 254"):
        Corrector([(surface, surface.at(), Rules())] * 255, stored)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int64"])
def test_rows_of_classes(dtype):
    classes = np.array([[0, 1], [7, 100]], dtype)
    np.testing.assert_array_equal(class_rows(classes, {1: 1, 100: 2, 300: 3, -1: 4}), [[0, 1], [0, 2]])
    with pytest.raises(InputError, match="holds float64 values; allowed are integers"):
        class_rows(classes.astype(float), {1: 1})


# Shapes and layouts


@pytest.mark.parametrize("shape", [(1, 0, 0), (2, 0, 7), (2, 7, 0), (1, 1, 1), (3, 5, 129), (1, 3, 257)], ids=str)
def test_sizes(shape):
    image = np.full(shape, 0.9, np.float32)
    result = tscorr.correct(image, np.ones(shape[1:], int), {1: "red_concrete"}, *PEAK)
    assert result.corrected.shape == result.removed.shape == shape
    assert result.flags.shape == shape[1:]
    np.testing.assert_array_equal(result.removed, one_pixel(0.9)[1][0])


def test_one_band_without_an_axis():
    result = tscorr.correct(np.full((4, 5), 0.9, np.float32), np.ones((4, 5), int), {1: "red_concrete"}, *PEAK)
    assert result.corrected.shape == result.removed.shape == result.flags.shape == (4, 5)


@pytest.mark.parametrize("layout", ["fortran", "strided", "reversed", "big-endian", "read-only", "list"])
def test_layouts(layout):
    image, classes, sun, view, normal = city("uint16", rows=6, cols=10)
    change = {
        "fortran": np.asfortranarray,
        "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2],
        "reversed": lambda a: a[..., ::-1].copy()[..., ::-1],
        "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
        "read-only": lambda a: np.broadcast_to(a, a.shape),
        "list": lambda a: a.tolist() if a.dtype.kind == "f" else a,
    }[layout]
    plain = tscorr.correct(image, classes, CITY, sun, view, normal, scale=1e-4)
    changed = tscorr.correct(*map(change, (image, classes)), CITY, *map(change, (sun, view, normal)), scale=1e-4)
    assert same(plain, changed)
    assert changed.corrected.flags.c_contiguous


def test_float64_is_taken_as_float32():
    image, classes, sun, view, normal = city("float32", rows=6, cols=10)
    result = tscorr.correct(image.astype(float), classes, CITY, sun, view, normal)
    assert same(result, tscorr.correct(image, classes, CITY, sun, view, normal))


@pytest.mark.parametrize("precision", ["fast", "exact", "reference"])
@pytest.mark.parametrize("zenith", [60.0, 80.0, 84.9])
def test_a_mirror_overflows_nothing(zenith, precision):
    """Window glass at its peak sends back some 10^6 of a white surface: more steps than 32 bits hold."""
    glass = Material("glass", (0.02,), (6500.0,), (5.0,), (1.5,), (0.0,))
    directions = unit_vector(zenith, 180.0), unit_vector(zenith, 0.0)
    image = np.full((1, 1), 2000, np.uint16)
    result = tscorr.correct(image, [[1]], {1: glass}, *directions, scale=1e-4, rules=Rules(precision=precision))
    assert (result.corrected[0, 0], result.removed[0, 0]) == (0, 2000)
    assert result.flags[0, 0] == PixelFlag.CLIPPED | UNCORRECTABLE << 6
