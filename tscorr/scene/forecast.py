"""What a scene would cost and skip: the content of `tscorr plan`."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tscorr import rasters
from tscorr.angles import relative_azimuth
from tscorr.correction import Corrector, class_rows
from tscorr.scene.correct import is_current, view_samples
from tscorr.scene.cutting import memory_mb, pixel_bytes, units_of
from tscorr.scene.plan import Scene
from tscorr.scene.products import written_products
from tscorr.scene.thresholds import by_threshold

if TYPE_CHECKING:
    from tscorr.grid import Block

Array = NDArray[Any]

PRODUCT_BYTES = {"flags": 2, "azimuthal_width": 4, "angles": 36}
OUTSIDE = "outside the class map"
OVERVIEWS = 4 / 3
"""size of a raster with its overviews, over that without"""
BESIDE_BYTES = 3e6
"""report, picture and colour table"""
MASK_BYTES = 0.25
"""of a pixel: one bit that says whether the sun sees it, one whether the sensor does; while the scene is worked on"""


def forecast(scene: Scene) -> dict[str, Any]:
    """Shares of the materials, blocks with nothing to correct, disk and memory; reads the class map and samples."""
    peaks = Corrector(scene.materials, scene.stored).peaks
    counts = np.zeros(len(scene.materials) + 1, np.int64)
    cut = units_of(scene)
    present: dict[Block, list[int]] = {}
    unknown: Counter[int] = Counter()
    with scene.classes() as classes:
        outside = classes.fill if rasters.covered_share(scene.class_map, scene.image) < 1 else None
        for block in cut:
            values = classes.read(block, 1)
            material = class_rows(values, scene.rows)
            in_block = np.bincount(material.ravel(), minlength=len(counts))
            unknown.update(_counted(values[material == 0]))
            counts += in_block
            present[block] = [int(row) for row in np.flatnonzero(in_block * peaks)]
    rows, cols = scene.image.shape
    total = rows * cols
    zenith, azimuth = view_samples(scene)
    seen = np.isfinite(zenith)
    relative = relative_azimuth(scene.sun.azimuth_deg, azimuth[seen])
    return {
        "scene": scene.name,
        "image": scene.image.path.name,
        "rows": rows,
        "cols": cols,
        "bands": scene.image.bands,
        "bad_bands": scene.bad_names,
        "sun": {"zenith_deg": scene.sun.zenith_deg, "azimuth_deg": scene.sun.azimuth_deg},
        "view_zenith_deg": _spread(zenith[seen]),
        "relative_azimuth_deg": _spread(relative),
        "surface": scene.settings.surface.kind,
        "shadows": scene.settings.shadows and scene.heights_file is not None,
        "materials": {
            surface.name: float(counts[row] / total) for row, (surface, _, _) in enumerate(scene.materials, start=1)
        },
        "no_material": float(counts[0] / total),
        "classes_without_material": {
            OUTSIDE if value == outside else str(value): count / total for value, count in unknown.most_common()
        },
        "blocks": len(cut),
        "blocks_no_specular_material": sum(not rows for rows in present.values()),
        "negligible": by_threshold(scene, present),
        "disk_mb": disk_bytes(scene)[1] / 1e6,
        "memory_mb": memory_mb(scene),
        "current": is_current(scene),
    }


def _spread(angles_deg: Array) -> list[float] | None:
    """Least, middle and largest; None of none."""
    return [float(np.quantile(angles_deg, q)) for q in (0, 0.5, 1)] if angles_deg.size else None


def _counted(values: Array) -> dict[int, int]:
    """How often each value occurs."""
    if values.dtype == np.uint8:
        counts = np.bincount(values)
        return {int(value): int(counts[value]) for value in np.flatnonzero(counts)}
    return dict(zip(*(found.tolist() for found in np.unique(values, return_counts=True)), strict=True))


def disk_bytes(scene: Scene) -> tuple[float, float]:
    """Least and most that a scene's result takes on the disk, while it is written.

    Least: the corrected image alone, as small as the image is where it keeps its codec. Most: nothing compresses.
    """
    image, output = scene.image, scene.config.output
    pixels = image.shape[0] * image.shape[1]
    image_bytes = pixels * pixel_bytes(image)
    sizes = {name: pixels * size for name, size in PRODUCT_BYTES.items()} | {"uncertainty": 4 * pixels * image.bands}
    products = written_products(scene)
    each = [sizes.get(product, image_bytes) for product in products]
    most = sum(each) * OVERVIEWS + max(each, default=0) if output.format == "cog" else sum(each)
    most += BESIDE_BYTES + MASK_BYTES * pixels
    if "corrected" not in products:
        return 0.0, most
    codec = output.compression or image.profile["compress"]
    least = image_bytes if codec == "none" else min(image_bytes, image.path.stat().st_size)
    return (least if output.compression is None or codec == "none" else 0.0), most


def available_mb() -> float:
    """Memory that the machine could give to a process now; infinite where it does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return float("inf")
    kilobytes = {name: int(value.split()[0]) for name, value in (line.split(":") for line in lines)}
    return (kilobytes["MemAvailable"] + kilobytes["SwapFree"]) / 1e3
