"""Edges of shadows: morphology against scipy, light and shadow of hand-made pixels."""

import numpy as np
import pytest
from scipy import ndimage

from tscorr.angles import unit_vector
from tscorr.correction import Rules, Stored
from tscorr.correction.edges import ShadowByBrightness, dilated, rim
from tscorr.materials import Material

SQUARE = np.ones((3, 3), bool)
BANDS_UM = (0.48, 0.56, 0.84)
DIRECT = (0.8, 0.85, 0.9)
SPECTRAL = Material("roof", (0.02, 0.05, 0.08), (0.5,), (0.08,), (1.5,), (0.25,), wavelength_um=(0.48, 0.56, 0.84))
ONE_BAND = Material("tile", (0.05,), (0.5,), (0.08,), (1.5,), (0.25,), wavelength_um=(0.55,))
ANYWHERE = Material("paint", (0.05,), (0.5,), (0.08,), (1.5,), (0.25,))
SUN = unit_vector(40.0, 180.0)
UP = np.array([0.0, 0.0, 1.0])
STORED = Stored(dtype=np.dtype(np.int16), scale=(1e-4,) * 3, offset=(-0.01,) * 3)


@pytest.mark.parametrize("shape", [(3, 3), (3, 9), (12, 17)])
@pytest.mark.parametrize("density", [0.2, 0.9])
def test_dilation_and_rim(shape, density):
    mask = np.random.default_rng(1).random(shape) < density
    inner = slice(1, -1), slice(1, -1)
    grown = ndimage.binary_dilation(mask, SQUARE)
    shrunk = ndimage.binary_erosion(mask, SQUARE, border_value=1)
    np.testing.assert_array_equal(dilated(mask), grown[inner])
    np.testing.assert_array_equal(rim(mask), (grown & ~shrunk)[inner])


def judge(materials=(SPECTRAL,), stored=STORED, **rules):
    settings = Rules(direct_fraction=DIRECT, **rules)
    entries = [(surface, surface.at(BANDS_UM), settings) for surface in materials]
    return ShadowByBrightness.of(entries, stored, BANDS_UM)


def levels(normal=UP, *, horizontal=True):
    """Reflectance (3,) of SPECTRAL in the shade and in full light; PHYSICS section 5, sky view (1 + up) / 2."""
    t0, beta = np.array(SPECTRAL.t0), np.array(DIRECT)
    plane, sky_view = (normal @ SUN / SUN[2], (1 + normal[2]) / 2) if horizontal else (1, 1)
    shade = np.pi * t0 * (1 - beta) * sky_view
    return shade, shade + np.pi * t0 * beta * plane


def settled(by, reflectance, *, shadowed=True, unsure=True, normal=UP, row=1):
    """The verdict on one pixel of these reflectances (3,)."""
    image = np.rint((np.asarray(reflectance) + 0.01) / 1e-4).astype(np.int16).reshape(3, 1, 1)
    one = np.ones((1, 1), bool)
    vectors = (vector.reshape(3, 1, 1) for vector in (SUN, normal))
    return bool(by.settle(one * shadowed, one * unsure, image, one * np.uint8(row), *vectors)[0, 0])


@pytest.mark.parametrize("plane", ["horizontal", "facet"])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (35.0, 180.0), (35.0, 0.0)], ids=["flat", "to the sun", "from the sun"])
@pytest.mark.parametrize("before", [True, False])
def test_light_and_shade(slope, plane, before):
    """An unsure pixel as bright as full light is sunlit, as dark as the sky's share is not, whatever it was before."""
    normal = unit_vector(*slope)
    by = judge(irradiance_plane=plane)
    shade, full = levels(normal, horizontal=plane == "horizontal")
    middle = np.sqrt(shade * full)
    for reflectance, in_shade in ((shade, True), (full, False), (1.05 * middle, False), (0.95 * middle, True)):
        assert settled(by, reflectance, shadowed=before, normal=normal) is in_shade


def test_glare_is_light():
    assert settled(judge(), levels()[1] + 0.5) is False


@pytest.mark.parametrize("reflectance", [0.0, -0.5])
def test_nothing_and_less_is_shade(reflectance):
    """The square of a negative reflectance is not bright."""
    assert settled(judge(), np.full(3, reflectance), shadowed=False) is True


@pytest.mark.parametrize("before", [True, False])
def test_what_is_sure_stays(before):
    shade, full = levels()
    for reflectance in (shade, full):
        assert settled(judge(), reflectance, shadowed=before, unsure=False) is before


def test_most_bands_decide():
    shade, full = levels()
    assert settled(judge(), [full[0], full[1], shade[2]]) is False
    assert settled(judge(), [full[0], shade[1], shade[2]]) is True


@pytest.mark.parametrize("before", [True, False])
def test_where_the_image_cannot_tell_the_shadow_stays(before):
    """Too little direct light, a material of unknown t0 in these bands, no material, a slope that faces away."""
    entry = SPECTRAL, SPECTRAL.at(BANDS_UM), Rules(direct_fraction=(0.4,))
    dim = ShadowByBrightness.of([entry], STORED, BANDS_UM)
    away = unit_vector(70.0, 0.0)
    for by, options in ((dim, {}), (judge((ANYWHERE,)), {}), (judge(), {"row": 0}), (judge(), {"normal": away})):
        for reflectance in (0.01, 0.9):
            assert settled(by, np.full(3, reflectance), shadowed=before, **options) is before


def test_a_material_of_one_wavelength_is_known_in_its_own_band():
    known = ~np.isnan(judge((SPECTRAL, ONE_BAND, ANYWHERE)).diffuse)
    np.testing.assert_array_equal(known, [[0, 0, 0], [1, 1, 1], [0, 1, 0], [0, 0, 0]])
    entries = [(ONE_BAND, ONE_BAND.at(bands=3), Rules())]
    assert np.isnan(ShadowByBrightness.of(entries, STORED, None).diffuse).all()


def test_the_mask_that_went_in_is_not_changed():
    mask = np.array([[True]])
    image = np.full((3, 1, 1), 9000, np.int16)
    vectors = SUN.reshape(3, 1, 1), UP.reshape(3, 1, 1)
    result = judge().settle(mask, np.array([[True]]), image, np.array([[1]]), *vectors)
    assert mask.all()
    assert not result.any()
