"""Residual glare of a synthetic scene, whose truth is known, and whether its errors are as large as claimed."""

from pathlib import Path
from typing import Any

import numpy as np

from tscorr import rasters
from tscorr.correction import SpecularState, specular_state
from tscorr.grid import blocks
from tscorr.scene.plan import Scene

LEAST_SHARE = 0.05
EDGES = np.linspace(-4, 4, 33)
"""of the histogram of errors in units of sigma; what lies beyond is in its last bins"""


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
            valid = (light.read(block, 1) == 1) & scene.stored.has_data(stored) & np.isfinite(wanted).all(axis=0)
            if scene.stored.saturation is not None:
                valid &= (stored < np.array(scene.stored.saturation)[:, None, None]).all(axis=0)
            seen = stored * scale + offset
            specular = seen - wanted
            valid &= (specular > LEAST_SHARE * seen).any(axis=0)
            kept = result.read(block)
            valid &= scene.stored.has_data(kept)  # uncorrectable = "nodata" claims nothing
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


def coverage(scene: Scene, folder: Path) -> dict[str, Any] | None:
    """Errors of the corrected values against the truth in units of their claimed sigma; None without both.

    Over all bands of the corrected pixels (state 1) that are not saturated and have a truth. Of right claims 68 %
    lie within 1 sigma, 95 % within 2.
    """
    truth = scene.settings.truth
    if truth is None:
        return None
    names = ("corrected", "flags", "uncertainty")
    known = [file for name in names if (file := rasters.result(folder, name, scene.image)) is not None]
    if len(known) < len(names):
        return None
    scale, offset = (np.array(values)[:, None, None] for values in (scene.stored.scale, scene.stored.offset))
    counts, within, total = np.zeros(EDGES.size - 1, np.int64), np.zeros(2, np.int64), 0
    diffuse = rasters.describe(truth.diffuse)
    with (
        rasters.Reader(known[0]) as corrected,
        rasters.Reader(known[1]) as flags,
        rasters.Reader(known[2]) as uncertainty,
        rasters.Reader(diffuse) as true,
    ):
        for block in blocks(scene.image.shape, (512, 2048)):
            wanted = true.read(block).astype(float)
            valid = specular_state(flags.read(block, 1)) == SpecularState.CORRECTED
            valid &= np.isfinite(wanted).all(axis=0)
            if diffuse.nodata is not None:
                valid &= (wanted != diffuse.nodata).all(axis=0)
            error = (corrected.read(block) * scale + offset - wanted)[:, valid]
            sigma = uncertainty.read(block)[:, valid].astype(float)
            ratio = (error / np.where(sigma > 0, sigma, np.nan))[sigma > 0]
            counts += np.histogram(np.clip(ratio, EDGES[0], EDGES[-1]), EDGES)[0]
            within += [np.count_nonzero(np.abs(ratio) <= limit) for limit in (1, 2)]
            total += ratio.size
    share = within / total if total else np.full(2, np.nan)
    return {
        "values": total,
        "within_1_sigma": float(share[0]) if total else None,
        "within_2_sigma": float(share[1]) if total else None,
        "histogram": {"edges": EDGES.tolist(), "share": (counts / max(total, 1)).tolist()},
    }
