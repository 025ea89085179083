"""Every compiled function has a twin in plain numpy, and equals it on a grid that is hard on purpose.

The oracle is the reference in longdouble, itself held to 50 digits by test_10_reference.py.
"""

import inspect
import os
import subprocess
import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from tscorr import kernels, reference
from tscorr.angles import unit_vector
from tscorr.correction import BlockInputs, Corrector, Rules, Stored, oracle
from tscorr.materials import Material, material

LONG = np.longdouble
TWINS = vars(reference) | {"correct_block": oracle.correct_block}
NAMES = sorted(
    name
    for name, value in vars(kernels).items()
    if isinstance(value, Dispatcher) and not name.startswith("_") and value.__module__.startswith(kernels.__name__)
)
INDICES = [(1.5, 0.0), (1.48, 0.25), (1.77, 0.25), (0.2, 3.4), (4.0, 0.5), (1.0000001, 0.0), (1.0001, 1e-6)]
"""n, k: a dielectric, Table 1, a metal, a high index, two that are hardly there"""


def hard_vectors():
    """Sun, view and normal (3, n): nadir, specular +- 1e-7 rad, grazing, back-facing, in the plane and across."""
    zeniths = [0.0, 1e-3, 10, 45, 60, 75, 85, 89, 95]
    sun, view = [], []
    for theta_i, theta_r, phi in product(zeniths, zeniths, [0, 90, 179, 180]):
        sun.append(unit_vector(theta_i, 180.0))
        view.append(unit_vector(theta_r, 180.0 - phi))
    for theta_i, off in product([0, 20, 45, 70, 85], [-1e-7, 0, 1e-7]):
        for along, across in ((off, 0), (0, off), (off, off)):
            sun.append(unit_vector(theta_i, 180.0))
            view.append(unit_vector(theta_i + np.rad2deg(along), np.rad2deg(across)))
    sun, view = np.array(sun).T, np.array(view).T
    rng = np.random.default_rng(8)
    count = sun.shape[1]
    normal = np.tile([[0.0], [0.0], [1.0]], count)
    tilted = unit_vector(rng.uniform(0, 60, count), rng.uniform(0, 360, count))
    both = [np.hstack(pair) for pair in ((sun, sun), (view, view), (normal, tilted))]
    undefined = np.abs(both[0] + both[1]).max(axis=0) < 1e-3  # source and viewer face to face: no facet
    return [vectors[:, ~undefined] for vectors in both]


@pytest.fixture(scope="module")
def angles():
    """Geometry of the hard vectors: by the kernel, and by the reference in longdouble."""
    vectors = hard_vectors()
    ours = np.array([kernels.geometry(*(tuple(v[:, j]) for v in vectors)) for j in range(vectors[0].shape[1])]).T
    return ours, reference.geometry(*(v.astype(LONG) for v in vectors))


def largest(name, error):
    """The largest error of a function, printed for `pytest -s`."""
    worst = float(np.max(error))
    print(f"{name}: largest error {worst:.1e}")  # noqa: T201 - the table of errors is a product of this test
    return worst


def test_every_compiled_function_has_a_twin():
    assert set(NAMES) >= {"attenuation", "correct_block", "facet_distribution", "fresnel", "geometry", "specular"}
    assert [name for name in NAMES if not inspect.isfunction(TWINS.get(name))] == []


def test_every_twin_is_compared_here():
    compared = {name for name in NAMES if f"def test_{name}" in inspect.getsource(sys.modules[__name__])}
    assert compared == set(NAMES)


def test_geometry(angles):
    """Absolute errors; of alpha in rad and times cos_l, since the half vector is short where both are grazing.

    Vectors in float64 hold no more. Alpha means nothing below the surface.
    """
    ours, truth = angles
    above = (truth.cos_i > 0) & (truth.cos_r > 0)
    for key, found in zip(truth._fields, ours, strict=True):
        short = truth.cos_l if key == "alpha" else 1
        assert largest(f"geometry.{key}", (np.abs(found - getattr(truth, key)) * short)[above]) < 5e-16


def test_facet_distribution(angles):
    alpha = np.abs(angles[0][3])
    for w in (0.01, 0.0362, 0.153, 1.0):
        truth = reference.facet_distribution(alpha.astype(LONG), LONG(w))
        found = np.array([kernels.facet_distribution(a, w) for a in alpha])
        kept = truth > 1e-300
        amplified = 1 + (w * np.rad2deg(alpha[kept])) ** 2
        assert largest("facet_distribution", np.abs(found[kept] / truth[kept] - 1) / amplified) < 5e-16


@pytest.mark.parametrize(("n", "k"), INDICES)
def test_fresnel(angles, n, k):
    cos_l = np.minimum(1, angles[0][2])
    truth = reference.fresnel(cos_l.astype(LONG), LONG(n), LONG(k))
    found = np.array([kernels.fresnel(c, n, k) for c in cos_l])
    assert largest("fresnel", np.abs(found / truth - 1)) < 2e-15


def test_fresnel_of_nothing():
    assert kernels.fresnel(0.5, 1.0, 0.0) == 0
    assert kernels.fresnel(0.0, 1.5, 0.2) == pytest.approx(1, rel=1e-15)


def test_attenuation(angles):
    lit = np.minimum(*angles[0][:2]) > 0
    cosines = angles[0][:3, lit]
    truth = reference.attenuation(*cosines.astype(LONG))
    found = np.array([kernels.attenuation(*triple) for triple in cosines.T])
    assert largest("attenuation", np.abs(found / truth - 1)) < 1e-15


@pytest.mark.parametrize("simplified", [False, True])
@pytest.mark.parametrize(("w", "n", "k"), [(0.0362, 1.77, 0.25), (0.153, 1.73, 0.25), (0.1, 0.2, 3.4)])
def test_specular(angles, w, n, k, simplified):
    geometry = angles[0]
    long_geometry = reference.Geometry(*geometry.astype(LONG))
    truth = reference.specular(long_geometry, LONG(w), LONG(n), LONG(k), simplified=simplified)
    found = np.array([kernels.specular(tuple(one), w, n, k, simplified) for one in geometry.T])
    np.testing.assert_array_equal(np.isnan(found), np.isnan(truth))
    kept = truth > 1e-300
    contract = 16 * np.finfo(float).eps * (1 + (w * np.rad2deg(geometry[3][kept])) ** 2)
    assert largest("specular, of its contract", np.abs(found[kept] / truth[kept] - 1) / contract) < 1


SURFACES = (
    material("roof_tile"),
    material("red_aluminum"),
    material("lambertian"),
    Material("metal", (0.002,), (2.0,), (0.1,), (0.2,), (3.4,)),
    Material("two", (0.02, 0.03), (0.5, 0.7), (0.06, 0.08), (1.5, 1.6), (0.25,), wavelength_um=(0.5, 0.8)),
)
UINT16 = Stored(dtype=np.dtype(np.uint16), scale=(1e-4,) * 3, offset=(0.0,) * 3, nodata=0.0, saturation=(9500.0,) * 3)
FLOAT32 = Stored(dtype=np.dtype(np.float32), scale=(1.0,) * 3, offset=(0.0,) * 3, nodata=float("nan"))
SETTINGS = [
    {},
    {"form": "simplified"},
    {"irradiance_plane": "facet", "uncorrectable": "keep", "uncorrectable_share": 0.3},
    {"uncorrectable": "nodata", "uncorrectable_share": 0.3, "direct_fraction": (0.8, 0.9, 0.95)},
]


def hard_block(stored, rows=24, cols=300):
    """A block of the hard vectors and of random ones, with shadows, gaps and saturated pixels."""
    rng = np.random.default_rng(9)
    size = rows * cols
    hard = hard_vectors()
    count = hard[0].shape[1]
    sun = np.tile(unit_vector(40.0, 150.0)[:, None], size)
    view = unit_vector(rng.uniform(0, 60, size), rng.uniform(0, 360, size))
    normal = unit_vector(rng.uniform(0, 50, size), rng.uniform(0, 360, size))
    upright = hard[0][2] > 0.01
    kept = np.count_nonzero(upright)
    assert kept < size / 2 < count * 8
    for field, values in zip((sun, view, normal), hard, strict=True):
        field[:, :kept] = values[:, upright]
    reflectance = 10 ** rng.uniform(-2.5, 0, (3, size))
    image = reflectance / np.array(stored.scale)[:, None]
    if stored.dtype.kind == "u":
        image = np.clip(np.rint(image), 1, 10000)
    image[:, rng.random(size) < 0.02] = stored.nodata
    shape = rows, cols
    return BlockInputs(
        image=image.reshape(3, *shape).astype(stored.dtype),
        material=rng.integers(0, len(SURFACES) + 1, shape).astype(np.uint8),
        sun=sun.reshape(3, *shape),
        view=view.reshape(3, *shape),
        normal=normal.reshape(3, *shape),
        shadowed=rng.random(shape) < 0.05,
        hidden=rng.random(shape) < 0.05,
        unreliable=rng.random(shape) < 0.1,
        low_confidence=rng.random(shape) < 0.1,
    )


def corrected_block(precision, stored, settings, **options):
    rules = Rules(precision=precision, **settings)
    entries = [(surface, surface.at([0.55, 0.6, 0.7]), rules) for surface in SURFACES]
    return Corrector(entries, stored, **options)(hard_block(stored))


@pytest.mark.parametrize("settings", SETTINGS, ids=["default", "simplified", "keep", "nodata"])
@pytest.mark.parametrize("stored", [UINT16, FLOAT32], ids=["uint16", "float32"])
@pytest.mark.parametrize("precision", ["fast", "exact"])
def test_correct_block(precision, stored, settings):
    """Integers differ by one step in at most 5 of 10 000 values, and so do flags at the thresholds."""
    ours, truth = corrected_block(precision, stored, settings), corrected_block("reference", stored, settings)
    if stored.dtype.kind == "u":
        difference = np.abs(ours.removed.astype(int) - truth.removed)
        same_state = ours.flags == truth.flags
        assert difference[:, same_state].max() <= 1
        assert np.mean(difference > 0) < 5e-4
    else:
        compared = (ours.flags == truth.flags) & ~np.isnan(truth.corrected)
        found, expected = ours.removed[compared], truth.removed[compared]
        last_digit = np.spacing(expected + truth.corrected[compared])
        error = np.maximum(0, np.abs(found - expected) - last_digit) / np.maximum(expected, 1e-9)
        assert largest(f"correct_block, {precision}", error) < (3e-5 if precision == "fast" else 1e-7)
    assert np.mean(ours.flags != truth.flags) < 5e-4
    states = {int(state) for state in np.unique((truth.flags >> 6) & 3)}
    assert states == {0, 1, 2, 3}
    assert np.abs(ours.tally.states - truth.tally.states).max() <= 3
    for key in ("incidence", "tilt", "share"):
        found, expected = getattr(ours.tally, key), getattr(truth.tally, key)
        assert np.abs(np.cumsum(found - expected, axis=1)).max() <= 12, key
    np.testing.assert_allclose(ours.tally.removed, truth.tally.removed, rtol=1e-3, atol=2**32 * 1e-3)
    np.testing.assert_allclose(ours.tally.extremes, truth.tally.extremes, atol=3e-3)


UNSURE = {"direct_fraction": (0.8,), "direct_fraction_sigma": (0.02,)}
EXTRAS = {
    "uncertainty": UNSURE,
    "sky": {"sky_specular": True, **UNSURE},
    "average": {"average_normals": True},
    "ratio": {"method": "ratio", "sky_specular": True, "form": "simplified", **UNSURE},
    "reference": {"method": "reference", "sky_specular": True, "uncorrectable": "nodata", **UNSURE},
}


@pytest.mark.parametrize("settings", EXTRAS.values(), ids=EXTRAS)
def test_correct_block_with_extras(settings):
    """Values and flags as above; sigma to 1 % in 99.9 % of the values: polynomials, and a kink of G."""
    stored = replace(UINT16, noise=((0.0005, 0.003),), direction_sigma_deg=0.2)
    results = {}
    for precision in ("fast", "reference"):
        rng = np.random.default_rng(5)
        entries = [(s, s.at([0.55, 0.6, 0.7]), Rules(precision=precision, **settings)) for s in SURFACES]
        inputs = hard_block(stored)
        shape = inputs.material.shape
        weight = np.where(rng.random(shape) < 0.3, rng.random(shape), 1).astype(np.float32)
        sigma = rng.uniform(0, 2, shape).astype(np.float32)
        corrector = Corrector(entries, stored, uncertainty=True, weighted=True)
        results[precision] = corrector(replace(inputs, weight=weight, normal_sigma_deg=sigma))
    ours, truth = results["fast"], results["reference"]
    same = ours.flags == truth.flags
    assert np.mean(~same) < 5e-4
    difference = np.abs(ours.removed.astype(int) - truth.removed)
    assert difference[:, same].max() <= 1
    assert np.mean(difference > 0) < 5e-4
    np.testing.assert_array_equal(np.isnan(ours.sigma), np.isnan(truth.sigma))
    compared = np.isfinite(truth.sigma) & same
    error = np.abs(ours.sigma[compared] / truth.sigma[compared] - 1)
    assert np.quantile(error, 0.999) < 0.01
    assert error.max() < 0.15
    assert np.abs(ours.tally.states - truth.tally.states).max() <= 3


SCRIPT = """
import hashlib, sys
sys.path.insert(0, {folder!r})
import test_10_twins as twins
for stored in (twins.UINT16, twins.FLOAT32):
    for precision in ("fast", "exact"):
        result = twins.tiny_block(precision, stored)
        arrays = [result.corrected, result.removed, result.flags, result.tally.states, result.tally.removed]
        print(hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest())
"""


def tiny_block(precision, stored):
    rules = Rules(precision=precision)
    entries = [(surface, surface.at([0.55, 0.6, 0.7]), rules) for surface in SURFACES]
    whole = hard_block(stored)
    piece = {key: None if value is None else value[..., 10:12, :140].copy() for key, value in vars_of(whole)}
    return Corrector(entries, stored)(BlockInputs(**piece))


def vars_of(inputs):
    return [(key, getattr(inputs, key)) for key in BlockInputs.__slots__]


@pytest.fixture(scope="module")
def digests():
    """Digests of the tiny blocks by mode: compiled, and interpreted."""

    def run(disable):
        script = SCRIPT.format(folder=os.path.dirname(__file__))  # noqa: PTH120 - a string for a script
        env = os.environ | {"NUMBA_DISABLE_JIT": disable}
        return subprocess.run(
            [sys.executable, "-c", script], env=env, check=True, capture_output=True, text=True
        ).stdout.split()

    return {disable: run(disable) for disable in "01"}


def test_the_interpreter_gives_the_same_bytes(digests):
    assert len(digests["0"]) == 4
    assert digests["1"] == digests["0"]
