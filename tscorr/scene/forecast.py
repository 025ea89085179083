"""What a scene would cost and skip: the content of `tscorr plan`."""

from typing import Any

import numpy as np

from tscorr import publish
from tscorr.correction import Corrector, class_rows
from tscorr.scene.correct import resume_key, target_of, view_samples
from tscorr.scene.plan import Scene
from tscorr.scene.run import units_of, workers_of

PRODUCT_BYTES = {"flags": 2, "azimuthal_width": 4, "angles": 36}
IMPORTS_MB = 220.0


def forecast(scene: Scene) -> dict[str, Any]:
    """Shares of the materials, blocks with nothing to correct, disk and memory; reads the class map only."""
    peaks = Corrector(scene.materials, scene.stored).peaks
    counts = np.zeros(len(scene.materials) + 1, np.int64)
    cut = units_of(scene)
    idle = 0
    with scene.classes() as classes:
        for block in cut:
            in_block = np.bincount(class_rows(classes.read(block, 1), scene.rows).ravel(), minlength=len(counts))
            counts += in_block
            idle += not in_block[peaks].any()
    rows, cols = scene.image.shape
    total = rows * cols
    image_bytes = scene.image.bands * scene.image.dtype.itemsize
    per_pixel = sum(PRODUCT_BYTES.get(product, image_bytes) for product in scene.config.output.products)
    largest = max(block.height * block.width for block in cut)
    per_worker = largest * (2 * image_bytes + 60) / 1e6
    zenith, _ = view_samples(scene)
    zenith = zenith[np.isfinite(zenith)]
    return {
        "scene": scene.name,
        "image": scene.image.path.name,
        "rows": rows,
        "cols": cols,
        "bands": scene.image.bands,
        "sun": {"zenith_deg": scene.sun.zenith_deg, "azimuth_deg": scene.sun.azimuth_deg},
        "view_zenith_deg": [float(np.quantile(zenith, q)) for q in (0, 0.5, 1)] if zenith.size else None,
        "materials": {
            surface.name: float(counts[row] / total) for row, (surface, _, _) in enumerate(scene.materials, start=1)
        },
        "no_material": float(counts[0] / total),
        "blocks": len(cut),
        "blocks_no_specular_material": idle,
        "disk_mb": total * per_pixel / 1e6,
        "memory_mb": IMPORTS_MB + workers_of(scene) * per_worker,
        "current": publish.is_current(target_of(scene), resume_key(scene)),
    }
