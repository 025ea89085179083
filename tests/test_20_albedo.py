"""Albedo against an independent integration (paper_values.json, `energy`), and its refusal."""

import json
from pathlib import Path

import numpy as np
import pytest

from tscorr.correction.albedo import albedo, specular_albedo
from tscorr.errors import ConfigError, MaterialError
from tscorr.materials import Material, builtin_materials, material

ENERGY = json.loads((Path(__file__).parent / "data" / "paper_values.json").read_text(encoding="utf-8"))["energy"]
AUTHORITY = 1.5e-5  # relative; at normal incidence, where the integral is one-dimensional, the table errs by 6e-6


@pytest.mark.parametrize("name", ENERGY["specular_dhr"])
def test_albedo_of_the_paper_s_materials(name):
    rows, m = ENERGY["specular_dhr"][name]["by_theta_i"], material(name)
    theta = [float(angle) for angle in rows]
    expected = [row["full"] for row in rows.values()]
    found = m.t1[0] * specular_albedo(theta, w=m.w[0], n=m.n[0], k=m.k[0])
    np.testing.assert_allclose(found, expected, rtol=AUTHORITY)
    np.testing.assert_allclose(albedo(name, theta), np.pi * m.t0[0] + found, rtol=1e-14)


def test_at_normal_incidence_it_is_an_integral_over_the_tilt_alone():
    w, n, k = 0.0362, 1.77, 0.25
    alpha = np.deg2rad((np.arange(400_000) + 0.5) * 45 / 400_000)  # beyond 45 degrees nothing leaves
    index = n - 1j * k
    c = np.cos(alpha)
    q = np.sqrt(index**2 - 1 + c**2)
    r_s, r_p = (c - q) / (c + q), (index**2 * c - q) / (index**2 * c + q)
    fresnel = (np.abs(r_s) ** 2 + np.abs(r_p) ** 2) / 2
    attenuation = np.minimum(1, 2 * np.cos(2 * alpha))  # 2 (n.h)(n.v) / (v.h)
    ring = fresnel * attenuation * np.exp(-((w * np.rad2deg(alpha)) ** 2)) * c * np.sin(alpha)
    expected = 8 * np.pi * ring.sum() * (alpha[1] - alpha[0])
    assert specular_albedo(0.0, w=w, n=n, k=k) == pytest.approx(expected, rel=1e-9)


def test_a_mirror_reflects_what_its_facets_reflect():
    w = 500.0  # narrow: 4 pi F / (2 w^2) cos theta / cos theta with w in 1/rad
    theta = np.array([0.0, 30.0, 60.0, 80.0])
    c = np.cos(np.deg2rad(theta))
    q = np.sqrt(1.5**2 - 1 + c**2)
    fresnel = (((c - q) / (c + q)) ** 2 + ((2.25 * c - q) / (2.25 * c + q)) ** 2) / 2
    expected = 4 * np.pi / np.rad2deg(w) ** 2 * fresnel
    np.testing.assert_allclose(specular_albedo(theta, w=w, n=1.5, k=0.0), expected, rtol=1e-5)


def test_the_full_form_never_reflects_more_than_it_receives():
    theta = np.append(np.linspace(0, 89, 30), [89.9, 89.999])
    for m in builtin_materials().values():
        values = albedo(m, theta)
        assert np.all((values > 0) & (values < 1))


@pytest.mark.parametrize("form", ["simplified", "other"])
def test_the_simplified_form_is_refused_with_the_reason(form):
    with pytest.raises(ConfigError, match=r"grows like 1/cos.*end of section 5"):
        albedo("roof_tile", 30, form=form)


def test_shapes_and_impossible_angles():
    values = albedo("red_concrete", [[0, 50], [90, -1]])
    assert values.shape == (2, 2)
    assert np.isfinite(values[0]).all()
    assert np.isnan(values[1]).all()
    assert np.isnan(albedo("red_concrete", np.nan))
    assert albedo("lambertian", 40) == pytest.approx(0.05 * np.pi, rel=1e-14)


def test_a_material_of_several_wavelengths_needs_one():
    m = Material(
        "m", t0=(0.1, 0.2), t1=(0.0, 0.0), w=(0.05, 0.05), n=(1.5, 1.5), k=(0.0, 0.0), wavelength_um=(0.5, 0.6)
    )
    assert albedo(m, 10, wavelength_um=0.55) == pytest.approx(0.15 * np.pi)
    with pytest.raises(MaterialError, match="wavelength"):
        albedo(m, 10)
