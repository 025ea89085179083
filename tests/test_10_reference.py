"""The paper's equations against 50-digit values (tests/data/paper_values.json), and laws of the model."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from tscorr import reference
from tscorr.reference import attenuation, brdf, brdf_gradient, fresnel, geometry, geometry_from_angles, specular

TABLE = json.loads((Path(__file__).parent / "data/paper_values.json").read_text())
POINTS, MATERIALS = TABLE["points"], TABLE["materials"]
LONG = np.longdouble
needs_long = pytest.mark.skipif(np.finfo(LONG).eps == np.finfo(float).eps, reason="longdouble is double here")
PRECISE = [np.float64, pytest.param(LONG, marks=needs_long)]
ANGLES = ("theta_i", "theta_r", "phi")


def column(rows, key, kind):
    """A column of inputs: the decimal strings of the table stand for the nearest double."""
    return np.array([kind(float(row[key])) for row in rows])


def parameters(rows, kind):
    """t0, t1, w, n, k of the material of each row."""
    return [
        np.array([kind(float(MATERIALS[row["material"]][key]["value"])) for row in rows])
        for key in ("t0", "t1", "w", "n", "k")
    ]


def expected(rows, key):
    """A column of results, to all the digits of a longdouble; 0 below the contract's absolute 1e-300."""
    return np.array([LONG(row[key]) if Decimal(row[key]).adjusted() >= -300 else LONG(0) for row in rows])


def evaluate(rows, kind):
    """The quantities of the table, evaluated in one float type."""
    t0, t1, w, n, k = parameters(rows, kind)
    angles = geometry_from_angles(*(column(rows, key, kind) for key in ANGLES))
    f_spec = specular(angles, w, n, k)
    return {
        "alpha_deg": np.rad2deg(angles.alpha),
        "cos_local": angles.cos_l,
        "F": fresnel(angles.cos_l, n, k),
        "G": attenuation(angles.cos_i, angles.cos_r, angles.cos_l),
        "f_spec": f_spec,
        "f_r": brdf(f_spec, t0, t1),
    }


def assert_contract(found, truth, kind):
    """|x - ref| <= 16 eps (1 + (w alpha)^2) |ref| for the lobe, 8 eps |ref| for alpha, F, G; PHYSICS section 2."""
    eps = np.finfo(kind).eps
    w = parameters(POINTS, LONG)[2]
    lobe = 16 * (1 + (w * truth["alpha_deg"]) ** 2)
    for key, values in found.items():
        assert values.dtype == kind, key
        allowed = (lobe if key in {"f_spec", "f_r"} else 8) * eps * np.abs(truth[key])
        least = 1e-300 if kind is not np.float32 else np.finfo(kind).tiny
        excess = np.abs(values - truth[key]) - np.maximum(allowed, least)
        worst = POINTS[int(excess.argmax())]
        assert np.all(excess <= 0), f"{key} of {worst['id']}, {worst['material']}"


@pytest.mark.parametrize("kind", PRECISE)
def test_every_point_of_the_table(kind):
    truth = {key: expected(POINTS, key) for key in ("alpha_deg", "cos_local", "F", "G", "f_spec", "f_r")}
    assert_contract(evaluate(POINTS, kind), truth, kind)


@needs_long
def test_float32_at_its_own_inputs():
    """The table holds for doubles; the reference in longdouble, held to the table above, stands in for float32."""

    def rounded(row):
        return row | {key: str(np.float32(float(row[key]))) for key in ANGLES}

    rows = [rounded(row) for row in POINTS]
    t0, t1, w, n, k = (values.astype(np.float32).astype(LONG) for values in parameters(rows, np.float32))
    angles = geometry_from_angles(*(column(rows, key, np.float32).astype(LONG) for key in ANGLES))
    f_spec = specular(angles, w, n, k)
    truth = {
        "alpha_deg": np.rad2deg(angles.alpha),
        "cos_local": angles.cos_l,
        "F": fresnel(angles.cos_l, n, k),
        "G": attenuation(*angles[:3]),
        "f_spec": f_spec,
        "f_r": brdf(f_spec, t0, t1),
    }
    with np.errstate(under="ignore"):
        assert_contract(evaluate(rows, np.float32), truth, np.float32)


@pytest.mark.parametrize("kind", PRECISE)
def test_fresnel_table(kind):
    """The cosine goes in with the digits of the type; the angle that it came from is in longdouble."""
    rows = TABLE["fresnel"]
    cosine = np.sin(np.deg2rad(90 - column(rows, "theta", LONG)))
    n, k = column(rows, "n", kind), column(rows, "k", kind)
    truth = expected(rows, "F")
    found = fresnel(cosine.astype(kind), n, k)
    slope = np.abs(fresnel(cosine * (1 + LONG(1e-6)), n.astype(LONG), k.astype(LONG)) - truth) / LONG(1e-6)
    eps = np.finfo(kind).eps
    assert np.all(np.abs(found - truth) <= eps * (8 * truth + slope)), "slope: the rounding of the cosine itself"


@pytest.mark.parametrize(("cos_l", "n", "k", "value"), [(0.0, 1.5, 0.25, 1), (0.0, 0.2, 3.4, 1), (0.3, 1.0, 0.0, 0)])
def test_fresnel_at_its_ends(cos_l, n, k, value):
    assert fresnel(np.float64(cos_l), n, k) == pytest.approx(value, rel=1e-15)
    assert fresnel(np.float64(1), n, k) == pytest.approx(((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2), rel=1e-15)


def test_gradient_table():
    rows = TABLE["jacobian"]
    _, t1, w, n, k = parameters(rows, float)
    angles = geometry_from_angles(*(column(rows, key, float) for key in ANGLES))
    gradient = brdf_gradient(angles, t1, w, n, k)
    for key in gradient._fields:
        np.testing.assert_allclose(getattr(gradient, key), column(rows, f"d_{key}", float), rtol=1e-13, err_msg=key)


def test_simplified_form_has_no_attenuation():
    rng = np.random.default_rng(4)
    angles = geometry_from_angles(*rng.uniform(0, [[85], [85], [180]], (3, 1000)))
    g = attenuation(*angles[:3])
    assert np.any(g < 0.5)
    full, simplified = (specular(angles, 0.08, 1.48, 0.25, simplified=form) for form in (False, True))
    np.testing.assert_allclose(full, g * simplified, rtol=1e-15)


def test_where_attenuation_is_one():
    """PHYSICS section 1: G rises with phi; G = 1 at 180 iff 3 max - min <= 180, at 0 iff 3 max + min <= 180."""
    theta_i, theta_r = (
        values.ravel() for values in np.meshgrid(np.arange(1, 89.5), np.arange(1.25, 89.5), indexing="ij")
    )
    most, least = np.maximum(theta_i, theta_r), np.minimum(theta_i, theta_r)

    def g_at(phi):
        return attenuation(*geometry_from_angles(theta_i, theta_r, np.full_like(theta_i, phi))[:3])

    np.testing.assert_array_equal(g_at(180) == 1, 3 * most - least <= 180)
    np.testing.assert_array_equal(g_at(0) == 1, 3 * most + least <= 180)
    rising = np.array([g_at(phi) for phi in range(0, 181, 5)])
    assert np.all(np.diff(rising, axis=0) >= -1e-15)
    assert attenuation(*geometry_from_angles(60.0, 60.0, 0.0)[:3]) == pytest.approx(0.5, rel=1e-15)


def test_claims_of_the_paper_about_facet_angles():
    for geometry_deg, alpha in next(c for c in TABLE["claims"] if c["id"] == "alpha_examples")["ours"].items():
        angles = geometry_from_angles(*(float(angle) for angle in geometry_deg.split(",")))
        assert np.rad2deg(angles.alpha) == pytest.approx(alpha, rel=1e-12)
    weaker = next(c for c in TABLE["claims"] if c["id"] == "weaker_off_plane")["ours"]
    for material, (off_plane, in_plane) in weaker.items():
        t0, t1, w, n, k = (values[0] for values in parameters([{"material": material}], float))
        for geometry_deg, value in (((65, 65, 170), off_plane), ((65, 75, 180), in_plane)):
            f_spec = specular(geometry_from_angles(*map(float, geometry_deg)), w, n, k)
            assert brdf(f_spec, t0, t1) == pytest.approx(value, abs=6e-7)


def test_reciprocity():
    rng = np.random.default_rng(5)
    theta_i, theta_r, phi = rng.uniform(0, [[89], [89], [180]], (3, 1000))
    there = specular(geometry_from_angles(theta_i, theta_r, phi), 0.05, 1.6, 0.3)
    back = specular(geometry_from_angles(theta_r, theta_i, phi), 0.05, 1.6, 0.3)
    np.testing.assert_allclose(there, back, rtol=1e-14, atol=1e-300)


@pytest.mark.parametrize("material", TABLE["energy"]["specular_dhr"])
@pytest.mark.parametrize("form", ["full", "simplified"])
def test_directional_albedo(material, form):
    """The lobe integrated over all directions of view, against the table's own quadrature."""
    _, _, w, n, k = (values[0] for values in parameters([{"material": material}], float))
    nodes, weights = np.polynomial.legendre.leggauss(160)
    theta_r, phi = 45 * (nodes + 1), 90 * (nodes + 1)
    solid = np.deg2rad(45) * weights * np.sin(np.deg2rad(theta_r)) * np.cos(np.deg2rad(theta_r))
    turn = 2 * np.deg2rad(90) * weights
    t1 = float(MATERIALS[material]["t1"]["value"])
    t0 = float(MATERIALS[material]["t0"]["value"])
    for theta_i in (0.0, 50.0, 70.0):
        angles = geometry_from_angles(np.float64(theta_i), theta_r[:, None], phi[None, :])
        f_spec = specular(angles, w, n, k, simplified=form == "simplified")
        albedo = np.pi * t0 + t1 * solid @ f_spec @ turn
        truth = TABLE["energy"]["specular_dhr"][material]["by_theta_i"][f"{theta_i:.0f}"][f"albedo_{form}"]
        assert albedo == pytest.approx(truth, rel=2e-3)
        assert albedo < 1


def unit_vectors(theta, phi):
    """float64 vectors (3, n) about z of angles in degrees, rounded once, from longdouble."""
    theta, phi = np.deg2rad(LONG(1) * theta), np.deg2rad(LONG(1) * phi)
    vectors = np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta) + 0 * phi
    return np.stack(vectors).astype(float)


def hard_angles(most_zenith):
    """theta_i, theta_r, phi: random, in the principal plane, near the mirror, near the normal."""
    rng = np.random.default_rng(6)
    theta_i, theta_r = rng.uniform(0, most_zenith, (2, 6000))
    phi = rng.uniform(0, 180, 6000)
    phi[::3] = 180
    phi[1::6] = 0
    theta_r[::4] = np.minimum(most_zenith, theta_i[::4] + 10 ** rng.uniform(-9, 0, 1500))
    theta_i[5::7] = 10 ** rng.uniform(-9, 0, theta_i[5::7].size)
    return theta_i, theta_r, phi


def test_geometry_from_vectors():
    """Up to 85 degrees of zenith, alpha comes back to 3e-13 rad, the cosines to 5e-16."""
    theta_i, theta_r, phi = hard_angles(85)
    truth = geometry_from_angles(*(angle.astype(LONG) for angle in (theta_i, theta_r, phi)))
    normal = np.array([0.0, 0.0, 1.0])[:, None]
    found = geometry(unit_vectors(theta_i, 0 * phi), unit_vectors(theta_r, phi), normal)
    for key, bound in (("cos_i", 5e-16), ("cos_r", 5e-16), ("cos_l", 5e-16), ("alpha", 3e-13)):
        assert np.abs(getattr(found, key) - getattr(truth, key)).max() < bound, key


def test_turning_all_vectors_together_changes_nothing():
    rng = np.random.default_rng(7)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    sun, view = (unit_vectors(rng.uniform(0, 80, 500), rng.uniform(0, 360, 500)) for _ in range(2))
    normal = np.array([0.0, 0.0, 1.0])[:, None]
    before, after = geometry(sun, view, normal), geometry(rotation @ sun, rotation @ view, rotation @ normal)
    np.testing.assert_allclose(after, before, atol=1e-13)


def test_below_the_horizon_there_is_no_value():
    assert np.isnan(specular(geometry_from_angles(95.0, 30.0, 180.0), 0.05, 1.5, 0.2))
    assert np.isnan(specular(geometry_from_angles(30.0, 90.0, 180.0), 0.05, 1.5, 0.2))
    assert np.isnan(geometry_from_angles(90.0, 90.0, 180.0).alpha)


@pytest.mark.parametrize("kind", [np.float32, *PRECISE])
def test_every_equation_keeps_its_float_type(kind):
    one = np.ones(3, kind)
    angles = geometry_from_angles(40 * one, 50 * one, 170 * one)
    vectors = geometry(*(np.array([[0], [s], [c]], kind) for s, c in ((0.6, 0.8), (-0.6, 0.8), (0, 1))))
    w, n, k = kind(0.08), kind(1.48), kind(0.25)
    results = [*angles, *vectors, specular(angles, w, n, k), reference.facet_distribution(angles.alpha, w)]
    results += [*reference.fresnel_gradient(angles.cos_l, n, k), *brdf_gradient(angles, kind(1), w, n, k)]
    assert {values.dtype for values in results} == {np.dtype(kind)}
