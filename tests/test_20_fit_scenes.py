"""fit.scenes: from samples made with the parameters of the paper, roofs of unequal brightness, and noise."""

import numpy as np
import pytest

from tscorr import reference
from tscorr.errors import ConfigError, InputError
from tscorr.fit import save_materials
from tscorr.fit.images import ImageSamples, merged
from tscorr.fit.scenes import BRIGHTNESS, SceneFitSettings, _Errors, _model, fit_samples
from tscorr.fit.solver import normal_incidence
from tscorr.materials import load_materials, material

UM = (0.475, 0.56, 0.668, 0.84)
T0 = {
    "roof_tile": (0.015, 0.0245, 0.06, 0.075),
    "red_concrete": (0.0125, 0.0192, 0.046, 0.053),
    "red_aluminum": (0.0085, 0.0101, 0.07, 0.12),
}
BETA = np.array([0.8, 0.84, 0.875, 0.915])[:, None]
SUN_UP = np.cos(np.deg2rad(40))


def truth(name):
    """t0 a band, t1, w, n, k, t1 F0 of a material of the paper; k is 0.25 for all."""
    m = material(name)
    t1, w, n, k = m.t1[0], m.w[0], m.n[0], m.k[0]
    return np.array(T0[name]), t1, w, n, k, t1 * float(normal_incidence(np.array(n), np.array(k))[0])


def samples(
    name, count=4000, *, seed=1, roofs=60, brightness=0.15, noise=1.0, tilted_deg=0.0, t1=None, least_tilt=0.0
):
    """Pixels of roofs, each of one brightness within +-`brightness`, as the README of the sample describes them.

    tilted_deg : 1 sigma of an error of the incidence and exitance that the samples state.
    """
    rng = np.random.default_rng(seed)
    t0, strength, w, n, k, _ = truth(name)
    incidence, exitance = rng.uniform(5, 65, 3 * count), rng.uniform(5, 65, 3 * count)
    phi = 180 - 90 * rng.random(3 * count) ** 2
    geometry = reference.geometry_from_angles(incidence, exitance, phi)
    kept = np.flatnonzero(np.rad2deg(geometry.alpha) >= least_tilt)[:count]
    incidence, exitance, phi = incidence[kept], exitance[kept], phi[kept]
    geometry = reference.Geometry(*(part[kept] for part in geometry))
    roof = rng.integers(0, roofs, len(kept))
    factor = rng.uniform(1 - brightness, 1 + brightness, roofs)[roof]
    plane, sky_view = geometry.cos_i / SUN_UP, rng.uniform(0.85, 1, len(kept))
    direct = BETA * plane
    diffuse = direct + (1 - BETA) * sky_view
    lobe = reference.specular(geometry, w, n, k)
    r = np.pi * (factor * t0[:, None] * diffuse + direct * (strength if t1 is None else t1) * lobe)
    r = r + noise * (0.0005 + 0.003 * r) * rng.standard_normal(r.shape)
    return ImageSamples(
        name=name,
        incidence_deg=np.abs(incidence + tilted_deg * rng.standard_normal(len(kept))),
        exitance_deg=np.abs(exitance + tilted_deg * rng.standard_normal(len(kept))),
        relative_azimuth_deg=phi,
        reflectance_factor=r,
        direct=direct,
        diffuse=diffuse,
        roof=roof.astype(float),
        wavelength_um=UM,
    )


def misclassified(good, other, share, seed=2):
    """Samples, a share of which show another material."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(good)) < share
    r = np.where(wrong, other.reflectance_factor[:, rng.permutation(len(other))], good.reflectance_factor)
    return ImageSamples(**{**{name: getattr(good, name) for name in ImageSamples.__slots__}, "reflectance_factor": r})


@pytest.mark.parametrize("name", T0)
def test_a_material_is_recovered(name):
    t0, _, w, n, _, p = truth(name)
    found = fit_samples(samples(name))
    assert found.converged
    assert found.warnings == ()
    assert found.material.w[0] == pytest.approx(w, rel=0.003)
    assert found.t1_f0 == pytest.approx(p, rel=0.006)
    assert found.material.n[0] == pytest.approx(n, abs=0.03)
    np.testing.assert_allclose(found.material.t0, t0, rtol=0.05)  # 0.087 / sqrt(60) of brightness, times some


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_pixels_of_a_wrong_class_hardly_matter(share):
    _, _, w, n, _, p = truth("red_concrete")
    found = fit_samples(misclassified(samples("red_concrete"), samples("red_aluminum", seed=5), share))
    assert found.material.w[0] == pytest.approx(w, rel=0.005)
    assert found.t1_f0 == pytest.approx(p, rel=0.01)
    assert found.material.n[0] == pytest.approx(n, abs=0.03)


def test_the_brightness_of_roofs_does_not_become_glare():
    even, uneven = (fit_samples(samples("roof_tile", brightness=b, noise=0.2)) for b in (0.0, 0.3))
    assert uneven.material.w[0] == pytest.approx(even.material.w[0], rel=2e-3)
    assert uneven.t1_f0 == pytest.approx(even.t1_f0, rel=2e-3)


def test_errors_are_those_of_the_scatter():
    """z = (found - true) / sigma over independent cities; the mean square of unit normals is 1 +- sqrt(2 / 16)."""
    t0, t1, w, n, _, p = truth("red_concrete")
    cities = [fit_samples(samples("red_concrete", 1000, seed=seed, roofs=40)) for seed in range(16)]
    true = np.array([*t0, t1, w, n])
    z = np.array(
        [([*c.material.t0, c.material.t1[0], c.material.w[0], c.material.n[0]] - true) / c.sigma for c in cities]
    )
    z_p = np.array([(c.t1_f0 - p) / c.t1_f0_sigma for c in cities])
    square = np.mean(z**2, axis=0)
    assert np.all((square > 0.3) & (square < 2.5)), square
    assert 0.3 < np.mean(z_p**2) < 2.5


def test_one_band_is_enough_where_roofs_are_alike():
    _, _, w, _, _, p = truth("red_concrete")
    several = samples("red_concrete", brightness=0.03)
    one = ImageSamples(
        **{
            **{name: getattr(several, name) for name in ImageSamples.__slots__},
            **{name: getattr(several, name)[:1] for name in ("reflectance_factor", "direct", "diffuse")},
            "wavelength_um": (),
        }
    )
    found = fit_samples(one)
    assert found.material.w[0] == pytest.approx(w, rel=0.03)
    assert found.t1_f0 == pytest.approx(p, rel=0.05)
    assert found.material.wavelength_um == ()


def test_the_simplified_form_is_fitted_as_such():
    settings = SceneFitSettings(form="simplified")
    _, _, w, _, _, _ = truth("red_aluminum")
    found = fit_samples(samples("red_aluminum"), settings)  # made with G: a narrow lobe hardly feels it
    assert "simplified model" in found.material.source
    assert found.material.w[0] == pytest.approx(w, rel=0.01)
    assert found.material.w[0] != fit_samples(samples("red_aluminum")).material.w[0]


def test_partials_are_those_of_the_model():
    few, settings = samples("roof_tile", 50), SceneFitSettings()
    x = np.array([*T0["roof_tile"], 0.017, 0.0362, 1.77])
    partials = _model(x, few, settings)[1]
    for place, value in enumerate(x):
        step = np.zeros_like(x)
        step[place] = 1e-5 * value
        difference = (_model(x + step, few, settings)[0] - _model(x - step, few, settings)[0]) / (2e-5 * value)
        np.testing.assert_allclose(partials[..., place], difference, rtol=2e-6, atol=1e-9)


def test_whitening_is_the_root_of_the_inverse_covariance():
    few = samples("roof_tile", 20)
    t0 = np.array(T0["roof_tile"])
    errors = _Errors.about(few, few.reflectance_factor, t0)
    root = np.stack([errors.whitened(np.broadcast_to(unit[:, None], (4, 20))) for unit in np.eye(4)])
    for place in range(20):
        sigma = 0.0005 + 0.003 * few.reflectance_factor[:, place]
        d = np.pi * t0 * few.diffuse[:, place]
        covariance = np.diag(sigma**2) + BRIGHTNESS**2 * np.outer(d, d)
        half = root[:, :, place].T
        np.testing.assert_allclose(half @ covariance @ half.T, np.eye(4), atol=1e-9)


def test_what_is_doubtful_is_said():
    def said(**changes):
        return " ".join(fit_samples(samples("red_aluminum", **changes)).warnings)

    assert "no peak stands out" in said(t1=0.0)
    assert "no sample near the peak" in said(least_tilt=8.0)
    assert "seen in 3 places only" in said(roofs=3)
    assert "the normals err by a good part of the lobe's width" in said(tilted_deg=4.0)


def test_too_few_samples_and_wrong_settings_are_refused():
    with pytest.raises(InputError, match="99 samples of roof_tile; at least 100"):
        fit_samples(samples("roof_tile", 99))
    with pytest.raises(ConfigError, match="form = 'halved'"):
        SceneFitSettings(form="halved")
    with pytest.raises(ConfigError, match="k = -1"):
        SceneFitSettings(k=-1)
    good = {name: getattr(samples("roof_tile", 100), name) for name in ImageSamples.__slots__}
    with pytest.raises(InputError, match=r"direct has the shape \(3, 100\); allowed is \(4, 100\)"):
        ImageSamples(**{**good, "direct": good["direct"][:3]})
    with pytest.raises(InputError, match="4 bands and 0 wavelengths"):
        ImageSamples(**{**good, "wavelength_um": ()})


def test_samples_of_several_images_are_joined():
    parts = [samples("roof_tile", 100, seed=seed) for seed in (1, 2)]
    both = merged(parts)
    assert len(both) == 200
    assert both.source == "samples, samples"
    np.testing.assert_array_equal(both.reflectance_factor[:, 100:], parts[1].reflectance_factor)
    np.testing.assert_array_equal(both.at(np.array([150])).incidence_deg, parts[1].incidence_deg[50:51])


def test_the_material_file_holds_what_was_fitted(tmp_path):
    found = fit_samples(samples("red_concrete"))
    save_materials([found.material], tmp_path / "m.toml")
    loaded = load_materials(tmp_path / "m.toml")["red_concrete"]
    for name in ("t0", "t1", "w", "n", "k", "wavelength_um", "covariance", "zenith_range_deg", "source"):
        assert getattr(loaded, name) == getattr(found.material, name), name
    covariance = np.array(loaded.covariance)
    assert np.all(np.linalg.eigvalsh(covariance / np.sqrt(np.outer(*[np.diag(covariance)] * 2))) > 0)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), found.sigma[[2, 4, 5, 6]])
    assert covariance[1, 3] < -0.9 * np.sqrt(covariance[1, 1] * covariance[3, 3])  # as every fit with k held


def test_the_summary_says_the_numbers():
    found = fit_samples(samples("roof_tile"))
    text = found.summary()
    for part in ("roof_tile: tscorr fit of scenes samples: full model, 60 roofs", "4000 samples", "t1 F0", "0.84 um"):
        assert part in text
    assert f"w {found.material.w[0]:.4g}" in text
