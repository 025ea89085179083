"""How a scene is cut into blocks: small enough for the memory, enough of them for the workers."""

import os

from tscorr import rasters
from tscorr.grid import Block, blocks
from tscorr.scene.pictures import lights_mb
from tscorr.scene.plan import Scene

UNIT_COLUMNS = 512
"""wider blocks are fewer, and leave the processor's cache between one step and the next"""
WHOLE_LINES_COLUMNS = 2048
"""the same where whole lines of the image are read, whatever is wanted of them"""
STRIPE_COLUMNS = 6144
BASE_MB = 340
"""memory of the process before the first block, and of what does not grow with blocks nor differ between scenes"""
COPIES = 5
"""an image block and what is made of it, at most, in blocks of the image's own size"""
GEOMETRY_BYTES = 48
"""vectors, angles and masks of a pixel"""
LAYER_BYTES = {"angles": 100, "azimuthal_width": 100}
"""what the layers that are asked for add to that, with what they are made of"""
SIGMA_BYTES = 10
"""the same of the uncertainty, for each band"""
COG_MB = 70
"""what GDAL takes to make one file cloud-optimised"""
MOST_WORKERS = 4


def pixel_bytes(image: rasters.RasterInfo) -> int:
    """Bytes of a pixel of the image, all bands."""
    return image.bands * image.dtype.itemsize


def work_bytes(scene: Scene) -> int:
    """Memory that the work on a pixel takes at most; as measured: `tests/benchmarks/against_copy.py --only memory`."""
    products = scene.config.output.products
    layers = sum(size for name, size in LAYER_BYTES.items() if name in products)
    sigma = SIGMA_BYTES * scene.image.bands if "uncertainty" in products else 0
    return COPIES * pixel_bytes(scene.image) + GEOMETRY_BYTES + layers + sigma


def units_of(scene: Scene, strip: Block | None = None, workers: int | None = None) -> list[Block]:
    """Blocks that a scene, or a strip of it, is cut into: whole tiles of the rasters that are written.

    Stripe by stripe, under the memory limit of the configuration where so many workers have a block each. Results do
    not depend on the cut; memory and speed do. A block is never less than a tile, whatever the limit.
    """
    image = scene.image if strip is None else scene.image.crop(strip)
    rows, cols = image.shape
    tile_rows, tile_cols = image.written_tile
    room = _room_mb(scene) * 1e6 / (workers or workers_of(scene)) / work_bytes(scene)  # pixels
    unit_cols = UNIT_COLUMNS if scene.image.pixel_by_pixel is None else WHOLE_LINES_COLUMNS
    widest = cols if tile_cols >= cols else max(1, unit_cols // tile_cols) * tile_cols
    width = min(widest, max(1, int(room / tile_rows / tile_cols)) * tile_cols)
    height = max(1, min(int(room / min(width, cols)), 512) // tile_rows) * tile_rows
    stripe = max(width, STRIPE_COLUMNS // width * width)
    cut = [
        Block(block.row, first + block.col, block.height, block.width)
        for first in range(0, cols, stripe)
        for block in blocks((rows, min(stripe, cols - first)), (height, width))
    ]
    return cut if strip is None else [block.below(strip.row) for block in cut]


def wanted_workers(scene: Scene) -> int:
    """Threads that may work on blocks at a time, of a whole batch: as configured, or all cores up to a few."""
    return scene.config.run.workers or min(MOST_WORKERS, len(os.sched_getaffinity(0)))


def workers_of(scene: Scene) -> int:
    """Threads that may work on the blocks of a scene: no more than the memory limit feeds."""
    rows, cols = map(min, scene.image.tile, scene.image.shape)
    tile_mb = rows * cols * work_bytes(scene) / 1e6
    return max(1, min(wanted_workers(scene), int(_room_mb(scene) / tile_mb)))


def _room_mb(scene: Scene) -> float:
    """Memory that the limit of the configuration leaves to blocks."""
    return scene.config.run.memory_limit_mb - BASE_MB - lights_mb(scene)


def threads_of(scene: Scene) -> int:
    """Threads that the scene has blocks for."""
    return min(workers_of(scene), len(units_of(scene)))


def closing_threads(scene: Scene) -> int:
    """Rasters that are finished at a time, of those that GDAL rewrites no more than the memory limit feeds."""
    fed = int(_room_mb(scene) / COG_MB) if scene.config.output.format == "cog" else MOST_WORKERS
    return max(1, min(threads_of(scene), fed))


def scene_mb(scene: Scene) -> float:
    """Memory that a scene adds to that of the process: the blocks which are worked on at a time, and its picture."""
    largest = max(block.height * block.width for block in units_of(scene))
    return threads_of(scene) * largest * work_bytes(scene) / 1e6 + lights_mb(scene)


def memory_mb(scene: Scene) -> float:
    """Memory that the process takes with a scene, about: what does not grow with blocks, and a block a worker."""
    return BASE_MB + scene_mb(scene)
