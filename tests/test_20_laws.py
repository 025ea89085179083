"""Laws of physics that hold for any input, by hypothesis."""

from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from tscorr import reference
from tscorr.correction import BlockInputs, Corrector, PixelFlag, Rules, SpecularState, Stored, specular_state
from tscorr.correction.albedo import albedo
from tscorr.materials import Material

EPS = np.finfo(float).eps
FORMS = ("full", "simplified")
quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])

zeniths = st.floats(0, 89.9)
azimuths = st.floats(0, 180)
widths = st.floats(0.01, 5)
indices = st.tuples(st.floats(0.05, 6), st.one_of(st.just(0.0), st.floats(1e-6, 6))).filter(
    lambda nk: nk != (1.0, 0.0)
)
forms = st.sampled_from(FORMS)


def lobe(theta_i, theta_r, phi, w, nk, form="full"):
    """f_spec, and how its rounding grows with the exponent: 1 + (w alpha)^2."""
    angles = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in (theta_i, theta_r, phi)))
    geometry = reference.geometry_from_angles(*angles)
    f_spec = reference.specular(geometry, w, *nk, simplified=form == "simplified")
    return f_spec, 1 + (w * np.rad2deg(geometry.alpha)) ** 2


@quick
@given(zeniths, zeniths, azimuths, widths, indices, forms)
def test_reciprocity(theta_i, theta_r, phi, w, nk, form):
    there, growth = lobe(theta_i, theta_r, phi, w, nk, form)
    back, _ = lobe(theta_r, theta_i, phi, w, nk, form)
    assert abs(there - back) <= 32 * EPS * growth * there + 1e-300


@quick
@given(zeniths, zeniths, azimuths, widths, indices, forms)
def test_symmetry_about_the_principal_plane(theta_i, theta_r, phi, w, nk, form):
    one, growth = lobe(theta_i, theta_r, phi, w, nk, form)
    for other in (-phi, 360 - phi, 360 + phi):
        assert abs(lobe(theta_i, theta_r, other, w, nk, form)[0] - one) <= 1e3 * EPS * growth * one + 1e-300


@quick
@given(zeniths, zeniths, st.tuples(azimuths, azimuths))
def test_attenuation_is_between_0_and_1_and_never_falls_towards_forward_scatter(theta_i, theta_r, phis):
    low, high = sorted(phis)
    g = [reference.attenuation(*reference.geometry_from_angles(theta_i, theta_r, phi)[:3]) for phi in (low, high)]
    assert 0 <= g[0] <= g[1] * (1 + 16 * EPS) <= 1 + 16 * EPS


@quick
@given(st.tuples(zeniths, zeniths), indices)
def test_fresnel_is_between_0_and_1_and_rises_where_it_is_said_to(angles, nk):
    n, k = nk
    flat, steep = (reference.fresnel(np.sin(np.deg2rad(90 - angle)), n, k) for angle in sorted(angles))
    rounding = 8 * EPS / min(1, n * n)  # N^2 - sin^2 cancels beyond the critical angle of n < 1
    assert 0 <= flat <= 1 + rounding
    assert 0 <= steep <= 1 + rounding
    if n >= 1 and ((n - 1) ** 2 + k * k) / ((n + 1) ** 2 + k * k) <= 1 / 3:
        assert flat <= steep * (1 + 32 * EPS)


@quick
@given(st.tuples(st.floats(0, 90), st.floats(0, 90)), st.floats(1e-6, 1e3))
def test_steep_facets_are_never_more_common(tilts, w):
    few, many = (reference.facet_distribution(np.deg2rad(tilt), w) for tilt in sorted(tilts, reverse=True))
    assert 0 <= few <= many <= 1


@quick
@given(zeniths, zeniths, azimuths, widths, indices)
def test_the_simplified_form_is_never_darker(theta_i, theta_r, phi, w, nk):
    assert lobe(theta_i, theta_r, phi, w, nk)[0] <= lobe(theta_i, theta_r, phi, w, nk, "simplified")[0] * (1 + 8 * EPS)


@settings(quick, max_examples=15)
@given(st.floats(0, 89.9), st.floats(0.03, 1), st.floats(1.05, 3))
def test_no_surface_of_a_possible_strength_reflects_more_than_it_receives(theta, w, n):
    open_integral = 8 * np.pi * np.sum(_open(w)) * (np.pi / 2 / 20_000)
    t1 = 1 / open_integral
    m = Material("m", t0=(0.0,), t1=(t1,), w=(w,), n=(n,), k=(0.0,))
    assert 0 <= albedo(m, theta) <= 1


def _open(w):
    alpha = (np.arange(20_000) + 0.5) * (np.pi / 2 / 20_000)
    return np.exp(-((w * np.rad2deg(alpha)) ** 2)) * np.cos(alpha) * np.sin(alpha)


# --- the correction of images -------------------------------------------------------------------------

seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(["fast", "exact", "reference"])


def unit(rng, shape, lowest):
    """Random unit vectors (3, *shape) whose up component is at least `lowest`."""
    up, azimuth = rng.uniform(lowest, 1, shape), rng.uniform(0, 2 * np.pi, shape)
    flat = np.sqrt(1 - up**2)
    return np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), up])


def city(seed, *, dtype=np.float32, bands=2, shape=(3, 47)):
    """A random block: inputs, stored meaning and two materials."""
    rng = np.random.default_rng(seed)
    integer = np.dtype(dtype).kind in "iu"
    scale = 1e-4 if integer else 1.0
    stored = Stored(dtype=np.dtype(dtype), scale=(scale,) * bands, offset=(0.0,) * bands)
    image = (rng.uniform(0, 0.6, (bands, *shape)) / scale).astype(dtype)
    materials = [
        Material(
            f"m{i}",
            t0=(0.02,),
            t1=(10 ** rng.uniform(-2, 1),),
            w=(10 ** rng.uniform(-2, 0.5),),
            n=(rng.uniform(1.1, 3),),
            k=(rng.choice([0.0, 0.25, 3.0]),),
        )
        for i in range(2)
    ]
    block = BlockInputs(
        image=image,
        material=rng.integers(0, 3, shape).astype(np.uint8),
        sun=unit(rng, (1, 1), 0.2),
        view=unit(rng, shape, 0.2),
        normal=unit(rng, shape, 0.4),
    )
    return block, stored, materials


def run(block, stored, materials, **rules):
    bands = len(stored.scale)
    corrector = Corrector([(m, m.at(bands=bands), Rules(**rules)) for m in materials], stored)
    return corrector(replace(block, image=block.image.copy()))


@quick
@given(seeds, kinds, forms, st.sampled_from([np.float32, np.uint16]))
def test_light_is_only_ever_removed(seed, precision, form, dtype):
    block, stored, materials = city(seed, dtype=dtype)
    result = run(block, stored, materials, precision=precision, form=form)
    assert np.all(result.corrected <= block.image)
    assert np.all(result.corrected >= 0)
    assert np.all(result.removed >= 0)
    rounding = 0 if dtype == np.uint16 else np.spacing(block.image)
    assert np.all(np.abs(block.image.astype(float) - result.removed - result.corrected) <= rounding)
    untouched = (result.removed == 0).all(axis=0)
    np.testing.assert_array_equal(result.corrected[:, untouched], block.image[:, untouched])
    assessed = specular_state(result.flags) != SpecularState.NOT_ASSESSED
    assert not result.removed[:, ~assessed].any()


@quick
@given(seeds, kinds, forms)
def test_without_a_specular_part_nothing_changes_bit_for_bit(seed, precision, form):
    block, stored, materials = city(seed)
    dull = [replace(m, t1=(0.0,)) for m in materials]
    result = run(block, stored, dull, precision=precision, form=form)
    assert result.corrected.tobytes() == block.image.tobytes()
    assert not result.removed.any()
    known = np.where(block.material == 0, PixelFlag.NO_MATERIAL | 3 << 6, 0)
    np.testing.assert_array_equal(result.flags, known)


@quick
@given(seeds, kinds, forms, st.floats(-np.pi, np.pi))
def test_turning_everything_about_the_vertical_changes_nothing(seed, precision, form, angle):
    block, stored, materials = city(seed)

    def turned(vector):
        x, y, z = vector
        return np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z])

    other = replace(block, sun=turned(block.sun), view=turned(block.view), normal=turned(block.normal))
    before, after = (run(b, stored, materials, precision=precision, form=form) for b in (block, other))
    bound = np.maximum(4e-6, 4e-5 * before.removed)  # two roundings of float32, and values at a threshold
    negligible = 5e-5 * (1 + 1e-4)
    at_a_threshold = np.maximum(before.removed, after.removed) <= negligible
    assume(np.array_equal(before.flags, after.flags))
    assert np.all((np.abs(before.removed - after.removed) <= bound) | at_a_threshold)


@quick
@given(seeds, kinds, st.floats(0, 1))
def test_what_is_removed_is_in_proportion_to_the_direct_light(seed, precision, beta):
    block, stored, materials = city(seed)
    bright = replace(block, image=block.image + np.float32(1e4))  # nothing is clipped or uncorrectable
    never = {"precision": precision, "negligible_reflectance": 0.0}
    whole, part = (run(bright, stored, materials, direct_fraction=(b,), **never) for b in (1.0, beta))
    tolerance = 1.5 * np.spacing(np.float32(1e4))
    np.testing.assert_allclose(part.removed, beta * whole.removed, rtol=1e-5, atol=tolerance)


@quick
@given(seeds, forms)
def test_the_precisions_agree_within_their_bounds(seed, form):
    block, stored, materials = city(seed)
    never = {"form": form, "negligible_reflectance": 1e-30}
    dark = replace(block, image=np.zeros_like(block.image))
    dim = replace(stored, offset=(1e6, 1e6))  # a stored 0 far from black keeps the digits of what is removed
    fast, exact, truth = (
        run(dark, dim, materials, precision=precision, **never) for precision in ("fast", "exact", "reference")
    )
    bound = np.maximum(1e-6, 1e-5 * exact.removed)
    same = fast.flags == exact.flags
    assert np.mean(same) > 0.98
    assert np.all(np.abs(fast.removed - exact.removed)[:, same] <= bound[:, same])
    np.testing.assert_allclose(truth.removed, exact.removed, rtol=3e-7, atol=1e-12)
    np.testing.assert_array_equal(truth.flags, exact.flags)
