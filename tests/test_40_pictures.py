"""scene: the picture of before and after, gathered from blocks, is that of the files."""

import numpy as np
import pytest
from small_scene import (
    GROUND,
    METAL,
    NODATA,
    SHAPE,
    TILE,
    image_values,
    write_config,
    write_image,
    write_inputs,
    write_raster,
)

from tscorr import batch
from tscorr.config import load_config
from tscorr.quicklook import linear_rgb, rgb_matrix, used_bands
from tscorr.rasters import describe, read_decimated
from tscorr.scene import pictures
from tscorr.scene.run import Pipeline

COARSE = SHAPE[1] // 4
CLASSES = {str(TILE): "roof_tile", str(METAL): "red_aluminum", str(GROUND): "lambertian"}


def gathered(folder, monkeypatch, *, side=COARSE, unit=32, **sections):
    """Before and after as the blocks of the scene showed them, and the same from the files."""
    monkeypatch.setattr(pictures, "PICTURE_PX", side)
    monkeypatch.setattr("tscorr.scene.cutting.UNIT_COLUMNS", unit)
    config = write_config(folder, output={"directory": "out", "quicklook": True}, **sections)
    (scene,) = batch.plan(load_config(config))
    target = folder / "files"
    target.mkdir()
    pipeline = Pipeline(scene, target)
    pipeline.run(lambda _: None)
    matrix = rgb_matrix(scene.wavelengths_um or [np.nan] * scene.image.bands, scene.image.fwhm_um)
    return pipeline.lights.images(matrix), [
        read(scene, path, side) for path in (scene.image.path, target / "corrected.tif")
    ]


def read(scene, path, side):
    """Linear light of the means of a file, nan where a band has none."""
    matrix = rgb_matrix(scene.wavelengths_um, scene.image.fwhm_um)
    used = used_bands(matrix)
    values = read_decimated(describe(path), side, [band + 1 for band in used])
    scaled = [
        layer * scene.stored.scale[band] + scene.stored.offset[band] for band, layer in zip(used, values, strict=True)
    ]
    return linear_rgb(scaled, matrix[used])


@pytest.mark.parametrize("unit", [16, 32, 64])
@pytest.mark.parametrize("classes", [CLASSES, {"7": "roof_tile", str(GROUND): "lambertian"}], ids=["glare", "none"])
def test_the_gathered_picture_is_that_of_the_files(tmp_path, monkeypatch, unit, classes):
    write_inputs(tmp_path)
    values = image_values()
    values[:, 20:30, 5:21] = NODATA
    write_image(tmp_path / "image.tif", values)
    both, files = gathered(tmp_path, monkeypatch, unit=unit, materials={"classes": classes})
    for found, expected in zip(both, files, strict=True):
        assert np.isnan(found).any()
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    changed = not np.array_equal(*both, equal_nan=True)
    assert changed == (classes is CLASSES)


def test_what_is_not_decoded_for_the_correction_is_seen_too(tmp_path, monkeypatch):
    """Without nodata, tiles that stay as they are would be copied unread."""
    write_inputs(tmp_path)
    write_image(tmp_path / "image.tif", nodata=None)
    both, files = gathered(tmp_path, monkeypatch, unit=16)
    for found, expected in zip(both, files, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_of_large_images_some_rows_tell(tmp_path, monkeypatch):
    """16 pixels a cell: every fourth row. Rows are constant in fours here, so that nothing is lost."""
    write_inputs(tmp_path)
    values = np.repeat(image_values()[:, ::4], 4, axis=1)
    write_image(tmp_path / "image.tif", values)
    (before, _), (expected, _) = gathered(tmp_path, monkeypatch, side=4)
    np.testing.assert_allclose(before, expected, rtol=1e-5)


def test_floats_that_are_not_finite_are_no_data(tmp_path, monkeypatch):
    write_inputs(tmp_path)
    values = image_values(np.float32) * np.float32(1e-4)
    values[1, 3, 3], values[0, 40, 40] = np.nan, np.inf
    write_raster(tmp_path / "image.tif", values)
    (before, _), _ = gathered(tmp_path, monkeypatch)
    assert np.isfinite(before).all()
    good = np.isfinite(values).all(axis=0)[:4, :4]
    expected = linear_rgb([band[:4, :4][good].mean(keepdims=True) for band in values], np.eye(3, dtype=np.float32))
    np.testing.assert_allclose(before[0, 0], expected[0], rtol=1e-5)
