"""Uncertainty, methods, sky and confidence of scenes on disk; and the claim of Delft against its truth."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from small_scene import (
    NODATA,
    SCALE,
    SHAPE,
    TILE,
    class_map,
    image_values,
    read_raster,
    small_scene,
    write_raster,
)

from tscorr import batch
from tscorr.config import load_config
from tscorr.correction import PixelFlag, SpecularState, specular_state
from tscorr.errors import InputError
from tscorr.materials import builtin_materials
from tscorr.scene.plan import plan_scene

ROOT = Path(__file__).parents[1]
NOISE = [0.001, 0.01]
PRODUCTS = {
    "output": {"directory": "out", "quicklook": False, "products": ["corrected", "flags", "removed", "uncertainty"]}
}


def run(config):
    """The folder of the only scene of a run, and its report."""
    outcome = batch.run(config)
    assert [scene.state for scene in outcome.scenes] == ["done"], outcome.scenes[0]
    return outcome.folder / outcome.scenes[0].name, outcome.scenes[0].report


def plan(path):
    """The only scene of a configuration, checked."""
    config = load_config(path)
    return plan_scene(config.scenes[0], config, dict(builtin_materials()))


def corrected_places(folder):
    return specular_state(read_raster(folder / "flags.tif")[0]) == SpecularState.CORRECTED


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    return run(small_scene(folder, correction={"image_noise": NOISE}, **PRODUCTS))


def test_uncertainty_is_a_raster_in_reflectance(small):
    """Never below the noise, which it is where nothing was removed; nan without data; its tags name the choice."""
    folder, _ = small
    with rasterio.open(folder / "uncertainty.tif") as file:
        sigma, tags = file.read(), file.tags()
        assert file.dtypes == ("float32",) * 3
        assert file.scales == (1.0,) * 3
        assert np.isnan(file.nodata)
    assert "roof_tile: errors of a fit with k held" in tags["TSCORR_COVARIANCE"]
    noise = NOISE[0] + NOISE[1] * image_values() * SCALE
    done = corrected_places(folder)
    np.testing.assert_allclose(
        sigma[:, ~done & (read_raster(folder / "removed.tif") == 0).all(axis=0)],
        noise[:, ~done & (read_raster(folder / "removed.tif") == 0).all(axis=0)],
        rtol=1e-5,
    )
    assert np.all(sigma >= noise * (1 - 1e-5))
    assert np.median(sigma[:, done] / noise[:, done]) > 1.05


def test_the_report_says_how_sure(small):
    folder, report = small
    sigma, done = read_raster(folder / "uncertainty.tif"), corrected_places(folder)
    done |= specular_state(read_raster(folder / "flags.tif")[0]) == SpecularState.UNCORRECTABLE
    tiles = done & (class_map() == TILE)
    known = report["materials"]["roof_tile"]["uncertainty"]
    assert report["uncertainty_evaluated"]
    assert known["covariance"] == "synthetic"
    assert known["sigma"]["p50"] == pytest.approx(np.median(sigma[:, tiles]), rel=0.05)
    assert known["sigma"]["p95"] == pytest.approx(np.quantile(sigma[:, tiles], 0.95), rel=0.05)
    flags = read_raster(folder / "flags.tif")[0]
    assert report["pixels"]["uncertain"] == np.count_nonzero(flags & PixelFlag.UNCERTAIN)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "How sure the result is" in page


def test_nothing_of_it_where_nobody_asks(tmp_path):
    folder, report = run(small_scene(tmp_path))
    assert not (folder / "uncertainty.tif").exists()
    assert report["materials"]["roof_tile"]["uncertainty"] is None
    assert not np.any(read_raster(folder / "flags.tif")[0] & PixelFlag.UNCERTAIN)
    assert "How sure the result is" not in (folder / "report.html").read_text(encoding="utf-8")


def test_independent_errors_are_asked_for(tmp_path, small):
    """The upper bound is several times what the fit left, and named."""
    correction = {"image_noise": NOISE, "material_covariance": "independent"}
    folder, report = run(small_scene(tmp_path, correction=correction, **PRODUCTS))
    assert report["materials"]["roof_tile"]["uncertainty"]["covariance"] == "independent"
    done = corrected_places(folder) & (class_map() == TILE)
    ratio = read_raster(folder / "uncertainty.tif")[:, done] / read_raster(small[0] / "uncertainty.tif")[:, done]
    assert np.median(ratio) > 3


def test_a_pixel_that_is_half_roof_loses_half_the_lobe(tmp_path):
    whole, _ = run(small_scene(tmp_path))
    removed = read_raster(whole / "removed.tif")
    (tmp_path / "half").mkdir()
    config = small_scene(tmp_path / "half", {"class_confidence": "confidence.tif"})
    confidence = np.full(SHAPE, 0.5, np.float32)
    confidence[:, :20] = 0.25
    write_raster(tmp_path / "half" / "confidence.tif", confidence)
    folder, _ = run(config)
    both = corrected_places(whole) & corrected_places(folder)
    assert both.sum() > 100
    np.testing.assert_allclose(
        read_raster(folder / "removed.tif")[:, both], (removed * confidence)[:, both], atol=1.01
    )
    low = (read_raster(folder / "flags.tif")[0] & PixelFlag.LOW_CONFIDENCE) != 0
    np.testing.assert_array_equal(low, confidence < 0.5)


def test_ratio_needs_the_diffuse_part_of_every_band(tmp_path):
    with pytest.raises(
        InputError, match=r"needs t0 of every band, but that of material 'roof_tile' is known at 0.55 um"
    ):
        plan(small_scene(tmp_path, correction={"method": "ratio"}))


def test_reference_adds_back_and_keeps_the_sum(tmp_path):
    """Away from the peak level tiles get brighter; removed is signed, and input - removed is corrected."""
    view = {"kind": "constant", "zenith_deg": 40.0, "azimuth_deg": 180.0}
    folder, _ = run(small_scene(tmp_path, {"view": view}, correction={"method": "reference"}))
    removed, corrected = read_raster(folder / "removed.tif"), read_raster(folder / "corrected.tif")
    np.testing.assert_array_equal(image_values() - removed, corrected)
    tiles = corrected_places(folder) & (class_map() == TILE)
    assert tiles.any()
    assert np.all(corrected != NODATA)


@pytest.fixture(scope="module")
def delft(tmp_path_factory):
    """One view of configs/delft_uncertainty.toml."""
    config = load_config(ROOT / "configs" / "delft_uncertainty.toml")
    output = config.output.model_copy(update={"directory": str(tmp_path_factory.mktemp("delft")), "quicklook": False})
    outcome = batch.run(config.model_copy(update={"output": output, "scenes": config.scenes[1:2]}))
    return outcome.folder / "nadir", outcome.scenes[0].report


def test_two_thirds_of_the_errors_of_delft_are_within_the_claim(delft):
    """68 % within 1 sigma of the truth, +- 8 %, over the bands of the corrected pixels; the histogram adds up."""
    folder, report = delft
    coverage = report["coverage"]
    assert 0.60 <= coverage["within_1_sigma"] <= 0.76
    flags = read_raster(folder / "flags.tif")[0]
    assert coverage["values"] == 5 * np.count_nonzero(specular_state(flags) == SpecularState.CORRECTED)
    assert sum(coverage["histogram"]["share"]) == pytest.approx(1)
    error = read_raster(folder / "corrected.tif") * 1e-4 - read_raster(ROOT / "samples/delft/truth/diffuse_nadir.tif")
    done = specular_state(flags) == SpecularState.CORRECTED
    within = np.abs(error[:, done]) <= read_raster(folder / "uncertainty.tif")[:, done]
    assert coverage["within_1_sigma"] == pytest.approx(within.mean(), abs=1e-3)
    written = json.loads((folder / "report.json").read_text(encoding="utf-8"))["coverage"]
    assert written["within_2_sigma"] == coverage["within_2_sigma"]
