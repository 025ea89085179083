"""What a batch of many small scenes costs beyond their pixels: `python tests/benchmarks/many_scenes.py --scenes 400`.

Scenes of 512 x 512 pixels lie in flight lines that overlap by a quarter, over one surface model and one class map.
Times are of the processor, so that other programs do not lengthen them. Work is reading, geometry,
kernel, writing and hashing; report is the scene's page and picture; overhead is the rest of the batch: planning, files
opened and described, manifests, overlaps, the pages of the batch. The last column is the wall time of one worker over
that of two.
"""

import resource
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest import mock

import click
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from small_scene import CELL, NORTH, SCALE, SCENE, WEST, write_config, write_raster

from tscorr import batch, publish
from tscorr.scene import correct, pictures
from tscorr.scene.run import Pipeline, Sums, silent

SIDE, STEP, ACROSS = 512, 384, 20
"""pixels of a scene, from one scene to the next, and scenes in a line"""
COUNTED = (
    (correct, "summary", "report_s"),
    (correct, "page", "report_s"),
    (correct, "draw_quicklook", "report_s"),
    (pictures, "_light", "report_s"),  # in threads of its own
    (publish, "digest", "work_s"),
    (Pipeline, "_close", "work_s"),  # reads what was written, in threads of its own
)
"""functions whose time is no overhead, and what it counts as"""


def write_scenes(folder, number, *, side=SIDE, products=None, quicklook=True):
    """Images, one surface model and one class map for all; the path of the configuration."""
    step = side * STEP // SIDE
    down, across = -(-number // ACROSS), min(number, ACROSS)
    rng = np.random.default_rng(7)
    shape = (down - 1) * step + side, (across - 1) * step + side
    tiles = {"blockxsize": 256, "blockysize": 256}
    classes = np.full(shape, 5, np.uint8)
    classes[(np.arange(shape[0]) // 24 % 3 == 0)[:, None] & (np.arange(shape[1]) // 32 % 2 == 0)] = 1
    write_raster(folder / "class_map.tif", classes, **tiles)
    write_raster(folder / "dsm.tif", np.where(classes == 1, 4, 1).astype(np.float32), **tiles)
    values = rng.integers(3000, 6000, (4, side, side)).astype(np.uint16)
    scenes = []
    for place in range(number):
        row, col = divmod(place, ACROSS)
        name = f"line{row:02d}_{col:02d}"
        west, north = WEST + col * step * CELL, NORTH - row * step * CELL
        moved = np.roll(values, 7 * place, axis=1)
        path = write_raster(folder / f"{name}.tif", moved, west=west, north=north, **tiles)
        scenes.append({"name": name, "image": path.name, "scale": SCALE})
    output = {"directory": "out", "quicklook": quicklook}
    output |= {} if products is None else {"products": list(products)}
    return write_config(folder, *({**SCENE, **scene} for scene in scenes), output=output, run={"workers": 1})


class Footprint:
    """Memory, open files and threads of this process, looked at when a scene starts."""

    def __init__(self):
        self.rss_mb, self.files, self.threads, self.yardstick = [], [], [], []
        self.report_s = self.work_s = 0.0
        self._lock = threading.Lock()

    def __call__(self, scene):
        """The `progress` of a batch."""
        del scene
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.rss_mb.append(pages * resource.getpagesize() / 1e6)
        self.files.append(sum(1 for _ in Path("/proc/self/fd").iterdir()))
        self.threads.append(threading.active_count())
        start = time.process_time()
        sum(number * number for number in range(10000))
        self.yardstick.append(time.process_time() - start)
        return silent

    @property
    def slowness(self):
        """How much longer the same computation took on average than at best: what other programs cost this one."""
        return float(np.mean(self.yardstick) / np.min(self.yardstick))

    def counting(self, function, total):
        """The same function, whose processor time is added to `report_s` or `work_s`; any thread may call it."""

        def counted(*args, **kwargs):
            start = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                with self._lock:
                    setattr(self, total, getattr(self, total) + time.thread_time() - start)

        return counted

    def growth_mb(self, warm_up):
        """Memory that a scene adds, as the slope over all scenes after the first ones. [MB]"""
        seen = self.rss_mb[warm_up:]
        return float(np.polyfit(np.arange(len(seen)), seen, 1)[0])


@contextmanager
def processor_time(self, part):
    """In place of `Sums.timed`: time of a thread on a processor, which other programs do not lengthen."""
    start = time.thread_time()
    try:
        yield
    finally:
        self.seconds[part] += time.thread_time() - start


def measured(config, **options):
    """Run a batch: its result, its footprint, and work and overhead a scene. [ms of processor time at its best]"""
    footprint = Footprint()
    with ExitStack() as patches:
        patches.enter_context(mock.patch.object(Sums, "timed", processor_time))
        for module, name, total in COUNTED:
            counted = footprint.counting(getattr(module, name), total)
            patches.enter_context(mock.patch.object(module, name, counted))
        start = time.process_time()
        result = batch.run(config, progress=footprint, **options)
        total = time.process_time() - start
    stages = "read", "geometry", "kernel", "write"
    work = footprint.work_s + sum(scene.report["seconds"][stage] for scene in result.scenes for stage in stages)
    a_scene = 1e3 / len(result.scenes) / footprint.slowness
    return result, footprint, a_scene * work, a_scene * (total - work - footprint.report_s)


def seconds(config, workers):
    """Wall time of a batch."""
    start = time.perf_counter()
    batch.run(config, overwrite=True, workers=workers)
    return time.perf_counter() - start


@click.command()
@click.option("--scenes", "numbers", default=[20, 100, 400], multiple=True, show_default=True)
@click.option("--profile", is_flag=True, help="Where the time of the last batch goes.")
def main(numbers, profile):
    """Print work and overhead a scene, and what grows."""
    click.echo(
        "products          scenes  work ms  report ms  overhead ms  again ms  MB a scene  files  threads  slow  1 / 2"
    )
    kinds = {"default": {}, "corrected, flags": {"products": ("corrected", "flags"), "quicklook": False}}
    for (name, options), number in ((kind, number) for kind in kinds.items() for number in numbers):
        with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
            config = write_scenes(Path(folder), number, **options)
            batch.run(config, scenes=["line00_00"])
            if profile:
                import cProfile
                import pstats

                with cProfile.Profile(time.process_time) as profiler:
                    measured(config, overwrite=True)
                pstats.Stats(profiler).sort_stats("cumulative").print_stats(90)
                continue
            _, footprint, work, overhead = measured(config, overwrite=True)
            start = time.process_time()
            batch.run(config)
            again = 1e3 * (time.process_time() - start) / number / footprint.slowness
            report = 1e3 * footprint.report_s / number / footprint.slowness
            gain = seconds(config, workers=1) / seconds(config, workers=2)
        grown = footprint.files[-1] - footprint.files[1], max(footprint.threads) - footprint.threads[1]
        click.echo(
            f"{name:<16}  {number:6}  {work:7.1f}  {report:9.1f}  {overhead:11.1f}  {again:8.1f}  "
            f"{footprint.growth_mb(min(10, number // 2)):10.3f}  {grown[0]:+5}  {grown[1]:+7}  "
            f"{footprint.slowness:4.2f}  {gain:5.2f}"
        )


if __name__ == "__main__":
    main()
