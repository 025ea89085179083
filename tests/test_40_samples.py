"""scene.samples: what is gathered from images, and the materials of Delft found again from a wrong library."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from small_scene import BANDS, GROUND, METAL, NODATA, SHAPE, TILE, class_map, image_values, small_scene, write_image

from tscorr import batch, reference
from tscorr.config import load_config
from tscorr.errors import InputError
from tscorr.fit.solver import normal_incidence
from tscorr.grid import blocks
from tscorr.materials import load_materials
from tscorr.scene import samples
from tscorr.scene.samples import fit_scenes, gather

ROOT = Path(__file__).parents[1]
DELFT = ROOT / "samples" / "delft"
TRUE = load_materials(DELFT / "materials.toml")
ROOFS = ("delft_roof_tile", "delft_red_concrete", "delft_blue_concrete", "delft_red_aluminum")
TRUE_NORMALS = {"kind": "normals", "path": str(DELFT / "truth/normals.tif"), "heights": str(DELFT / "dsm.tif")}
NOISY_DSM = {"kind": "roof_planes", "path": str(DELFT / "dsm_noisy.tif")}


def delft(folder, surface, library="generic.toml"):
    """The three views of Delft with a library in which every material with a peak is the same."""
    config = tomllib.loads((ROOT / "configs/delft.toml").read_text(encoding="utf-8"))
    generic = {"t0": 0.05, "t1": 0.5, "w": 0.06, "n": 1.5, "k": 0.25}
    names = {name: generic if material.has_peak else {**generic, "t1": 0.0} for name, material in TRUE.items()}
    (folder / "generic.toml").write_text(tomli_w.dumps(names), encoding="utf-8")
    config["materials"]["library"] = [str(library)]
    for scene in config["scenes"]:
        del scene["truth"]
        scene["surface"] = surface
        scene["image"] = str(DELFT / Path(scene["image"]).name)
        scene["class_map"] = str(DELFT / "class_map.tif")
        if "trajectory" in scene["view"]:
            scene["view"]["trajectory"] = str(DELFT / "trajectory.csv")
    path = folder / "delft.toml"
    path.write_text(tomli_w.dumps(config), encoding="utf-8")
    return path


def planned(path):
    return batch.plan(load_config(path))


@pytest.fixture(scope="module")
def with_true_normals(tmp_path_factory):
    return planned(delft(tmp_path_factory.mktemp("true"), TRUE_NORMALS))


def errors(result, name):
    """Relative errors of w and of t1 F0."""
    true = TRUE[name]
    p = true.t1[0] * float(normal_incidence(np.array(true.n[0]), np.array(true.k[0]))[0])
    return result.material.w[0] / true.w[0] - 1, result.t1_f0 / p - 1


def test_true_normals_give_the_materials_back(with_true_normals, tmp_path):
    fitted = fit_scenes(with_true_normals, tmp_path / "fitted.toml")
    for name in ROOFS:
        w, p = errors(fitted.results[name], name)
        assert abs(w) < 0.005, (name, w)
        assert abs(p) < 0.01, (name, p)
        assert fitted.results[name].material.n[0] == pytest.approx(TRUE[name].n[0], abs=0.03)
        np.testing.assert_allclose(fitted.results[name].material.t0, TRUE[name].t0, rtol=0.05)
        assert fitted.results[name].warnings == ()
    assert "delft_grass" not in fitted.results  # the library knows it without a peak
    written = load_materials(tmp_path / "fitted.toml")
    assert set(written) == set(fitted.results)
    config = delft(tmp_path, NOISY_DSM, tmp_path / "fitted.toml")
    text = config.read_text(encoding="utf-8").replace('= "delft_grass"', '= "lambertian"')
    config.write_text(text, encoding="utf-8")
    assert planned(config)[0].materials[0][0] == written["delft_roof_tile"]


def test_planes_from_a_noisy_surface_model_do_nearly_as_well(tmp_path):
    fitted = fit_scenes(planned(delft(tmp_path, NOISY_DSM)))
    for name in ROOFS:
        w, p = errors(fitted.results[name], name)
        assert abs(w) < 0.01, (name, w)
        assert abs(p) < 0.02, (name, p)


def test_samples_obey_the_model_of_the_ray_tracer(with_true_normals):
    """Less the true glare, and over the light on them, they are t0 times a factor within 0.85 to 1.15."""
    for name, found in gather(with_true_normals, per_stratum=20).items():
        true = TRUE[name].at(found.wavelength_um)
        lobe = reference.specular(found.geometry, true.w[0], true.n[0], true.k[0])
        rest = found.reflectance_factor - np.pi * found.direct * true.t1[:, None] * lobe
        factor = np.median(rest / (np.pi * found.diffuse * true.t0[:, None]), axis=0)
        assert np.mean((factor > 0.84) & (factor < 1.16)) > 0.985, name
        assert len(found) > 500


def test_rare_tilts_count_as_much_as_common_ones(with_true_normals):
    found = gather(with_true_normals, per_stratum=20)["delft_red_aluminum"]
    count = np.bincount(np.rad2deg(found.geometry.alpha).astype(int), minlength=90)
    assert count.max() == 3 * 20
    assert np.all(count[6:30] >= 2 * 20 - 1)


def test_blocks_and_workers_do_not_matter(with_true_normals, monkeypatch):
    whole = gather(with_true_normals[:1], per_stratum=20)
    monkeypatch.setattr(samples, "units_of", lambda scene: list(blocks(scene.image.shape, (100, 90)))[::-1])
    monkeypatch.setattr(samples, "workers_of", lambda _: 2)
    cut = gather(with_true_normals[:1], per_stratum=20)
    for name, found in whole.items():
        np.testing.assert_array_equal(cut[name].reflectance_factor, found.reflectance_factor)
        np.testing.assert_allclose(cut[name].incidence_deg, found.incidence_deg, atol=1e-4)


def test_the_seed_chooses_other_pixels(with_true_normals):
    one, same, other = (
        gather(with_true_normals[:1], per_stratum=5, seed=seed)["delft_roof_tile"].reflectance_factor
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert other.shape != one.shape or np.any(other != one)


# A small scene, all of whose pixels can be counted.


def flat_scene(folder, values, **changes):
    """The small scene on flat ground, so that every pixel is lit and seen."""
    path = small_scene(folder, {"surface": {"kind": "flat"}, **changes})
    write_image(folder / "image.tif", values)
    return planned(path)


def inner(value):
    """How many pixels of a class have only their own kind around them, by their rectangles in small_scene."""
    rows, cols = np.nonzero(class_map() == value)
    return (np.ptp(rows) - 1) * (np.ptp(cols) - 1)


def test_pixels_amid_their_class_and_valid_in_every_band_are_taken(tmp_path):
    values = image_values()
    values[0, 10, 10] = NODATA
    values[BANDS - 1, 30, 40] = 9000
    found = gather(flat_scene(tmp_path, values, saturation=9000), per_stratum=10**6)
    assert set(found) == {"roof_tile", "red_aluminum"}
    assert len(found["roof_tile"]) == inner(TILE) - 1
    assert len(found["red_aluminum"]) == inner(METAL) - 1
    wanted = np.sort(values[:, 6:20, 6:30][:, 1:-1, 1:-1].reshape(BANDS, -1)[1] * 1e-4)
    missing = values[1, 10, 10] * 1e-4
    found_values = np.sort(np.append(found["roof_tile"].reflectance_factor[1], missing))
    np.testing.assert_allclose(found_values, wanted)
    np.testing.assert_allclose(found["roof_tile"].incidence_deg, 40, atol=1e-4)
    np.testing.assert_allclose(found["roof_tile"].relative_azimuth_deg, 180, atol=0.01)
    np.testing.assert_allclose(found["roof_tile"].direct, 1, atol=1e-6)
    np.testing.assert_allclose(found["roof_tile"].diffuse, 1, atol=1e-6)


def test_uncertain_classes_are_not_taken(tmp_path):
    from small_scene import write_raster

    confidence = np.full(SHAPE, 0.9, np.float32)
    confidence[6:13] = 0.2
    write_raster(tmp_path / "confidence.tif", confidence)
    found = gather(flat_scene(tmp_path, image_values(), class_confidence="confidence.tif"), per_stratum=10**6)
    assert len(found["roof_tile"]) == 6 * 22  # rows 13 to 18 of 6 to 19, columns 7 to 28


def test_the_irradiance_plane_and_the_direct_fraction_are_heeded(tmp_path):
    path = small_scene(
        tmp_path,
        {"direct_fraction": [0.7, 0.8, 0.9]},
        materials={
            "classes": {str(TILE): "roof_tile", str(METAL): "red_aluminum", str(GROUND): "lambertian"},
            "settings": {"red_aluminum": {"irradiance_plane": "facet"}},
        },
    )
    found = gather(planned(path), per_stratum=10**6)
    np.testing.assert_allclose(found["red_aluminum"].direct[:, 0], [0.7, 0.8, 0.9])
    np.testing.assert_allclose(found["red_aluminum"].diffuse, 1)


def test_materials_that_are_not_enabled_are_left_alone(tmp_path):
    classes = {str(TILE): "roof_tile", str(METAL): "red_aluminum", str(GROUND): "lambertian"}
    settings = {"roof_tile": {"enabled": False}}
    path = small_scene(tmp_path, materials={"classes": classes, "settings": settings})
    assert set(gather(planned(path))) == {"red_aluminum"}


def test_scenes_of_other_bands_are_refused(tmp_path):
    path = small_scene(tmp_path, {"name": "a"}, {"name": "b", "wavelength_um": [0.5, 0.6, 0.7]})
    with pytest.raises(InputError, match=r"scenes 'a' and 'b' have bands at \(0.475, 0.56, 0.668\) and \(0.5"):
        gather(planned(path))


def test_a_city_without_samples_is_refused_and_nothing_written(tmp_path):
    path = small_scene(tmp_path)
    write_image(tmp_path / "image.tif", np.full((BANDS, *SHAPE), NODATA, np.int16))
    with pytest.raises(InputError, match="no material can be fitted: red_aluminum: left out, 0 samples; roof_tile"):
        fit_scenes(planned(path), tmp_path / "m.toml")
    assert not (tmp_path / "m.toml").exists()
