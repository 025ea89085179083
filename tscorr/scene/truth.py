"""Residual glare of a synthetic scene, whose truth is known."""

import numpy as np

from tscorr import rasters
from tscorr.grid import blocks
from tscorr.scene.plan import Scene

LEAST_SHARE = 0.05


def residual_glare(scene: Scene, corrected: rasters.RasterInfo) -> dict[str, float | None] | None:
    """RMS error of the image and of its correction against the truth, and their ratio; None without a truth.

    Over the bands of valid, sunlit pixels without a saturated band whose true specular share exceeds 5 % in
    any band. Reflectance factors.
    """
    truth = scene.settings.truth
    if truth is None:
        return None
    diffuse, sunlit = rasters.describe(truth.diffuse), rasters.describe(truth.sunlit)
    scale, offset = (np.array(values)[:, None, None] for values in (scene.stored.scale, scene.stored.offset))
    before = after = 0.0
    count = 0
    with (
        rasters.Reader(scene.image) as image,
        rasters.Reader(corrected) as result,
        rasters.Reader(diffuse) as true,
        rasters.Reader(sunlit) as light,
    ):
        for block in blocks(scene.image.shape, (512, 2048)):
            stored, wanted = image.read(block), true.read(block).astype(float)
            valid = (light.read(block, 1) == 1) & (stored != scene.stored.nodata).all(axis=0)
            if scene.stored.saturation is not None:
                valid &= (stored < np.array(scene.stored.saturation)[:, None, None]).all(axis=0)
            seen = stored * scale + offset
            specular = seen - wanted
            valid &= (specular > LEAST_SHARE * seen).any(axis=0)
            kept = result.read(block)
            valid &= (kept != scene.stored.nodata).all(axis=0)  # uncorrectable = "nodata" claims nothing
            left = kept * scale + offset - wanted
            before += float((specular[:, valid] ** 2).sum())
            after += float((left[:, valid] ** 2).sum())
            count += int(valid.sum())
    pixels = max(1, count * scene.image.bands)
    ratio = float(np.sqrt(after / before)) if before > 0 else None
    return {
        "pixels": count,
        "rms_before": np.sqrt(before / pixels),
        "rms_after": np.sqrt(after / pixels),
        "ratio": ratio,
    }
