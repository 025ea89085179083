"""Run time against a copy of the image, memory and growth: `python tests/benchmarks/against_copy.py [--json FILE]`.

G   GDAL's copy of the image alone: 2 threads, swath of a row of tiles at least; by a process of its own, like
    gdal_translate, so that how a run sets up its memory does not help it.
N   our pipeline with all inputs and outputs and without geometry and kernel: read, write, check, hash, publish.
run all of it; products corrected and flags, without quicklook and shadows where not said otherwise.

Every ratio is the median over interleaved rounds, of wall and of CPU time (the better one to trust on a machine that
others use too). Prints the bars beside them.
"""

import argparse
import shutil
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import rasterio
from city import CELL_M, Lattice, make_city, make_sparse_classes, profile_of, write_config
from measuring import Elsewhere, Ratio, as_json, interleaved, peak_mb, ratio, table
from rasterio.shutil import copy as copy_raster

from tscorr import batch, publish
from tscorr.correction import class_rows
from tscorr.scene import correct
from tscorr.scene.run import Pipeline
from tscorr.terrain import shadows
from tscorr.terrain.normals import horn_normals

RUN_OVER_COPY = {"none": 1.3, "deflate": 1.45, "zstd": 1.9}
FLAT_OVER_COPY = {"none": 1.15, "deflate": 1.2, "zstd": 1.4}
DEFAULTS = {"products": ("corrected", "flags", "removed"), "quicklook": True, "shadows": True}
MEMORY_MB = 450.0


def run(config):
    """Correct the one scene of a configuration; its report. Its inputs are hashed again, as by a new process."""
    publish._KNOWN.clear()
    (outcome,) = batch.run(config, overwrite=True).scenes
    assert outcome.state == "done", outcome.error
    return outcome.report


def gdal_copy(image):
    """G."""
    with rasterio.open(image) as file:
        codec = file.compression.name if file.compression else "none"
        interleave, (tile, _), row_bytes = file.interleaving.name, file.block_shapes[0], file.width * file.count * 2
    options = {**profile_of(codec, interleave, tile), "num_threads": 2, "bigtiff": "if_safer"}
    for key in ("crs", "transform", "driver"):
        options.pop(key)
    target = image.with_name("copy.tif")
    with rasterio.Env(GDAL_SWATH_SIZE=2 * tile * row_bytes, GDAL_NUM_THREADS=2, GDAL_CACHEMAX=256 << 20):
        copy_raster(image, target, driver="GTiff", **options)
    target.unlink()


copied_by_gdal = Elsewhere(gdal_copy)
cities = Elsewhere(make_city)
"""in a process of its own, since what it takes would count against the memory limit of the runs"""


def copied_block(self, block):
    """What N does instead of `Pipeline.block`: the same files, nothing computed."""
    rows = class_rows(self.classes.read(block, 1), self.scene.rows)
    image = self.image.read(block)
    self.ground.surface.heights(block.padded(1))
    layers = {"corrected": image, "flags": rows.astype(np.uint16)[None]}
    for name, writer in self.writers.items():
        writer.write(block, layers[name])
    return rows.size


@contextmanager
def unpublished():
    """A run that neither hashes nor checks nor flushes what it wrote."""
    with ExitStack() as patches:
        for name, value in (
            ("tscorr.publish.digest", lambda *_: ""),
            ("tscorr.publish.os.fsync", lambda _: None),
            ("tscorr.rasters.writing.checksum", lambda _: 0),
            ("tscorr.rasters.writing.read_at", lambda *_: b""),
        ):
            patches.enter_context(mock.patch(name, value))
        yield


def n_run(config):
    """N."""
    with mock.patch.object(Pipeline, "block", copied_block):
        run(config)


def bare_run(config):
    """A run without its publishing."""
    with unpublished():
        run(config)


class Bench:
    """The scenes that are made when they are asked for, in a folder of their own, and how often they are timed."""

    def __init__(self, folder, size, pairs):
        self.folder, self.size, self.pairs = folder, size, pairs

    @contextmanager
    def city(self, rows=None, cols=None, **options):
        """The image of a city, deleted afterwards: they are large."""
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        try:
            yield cities.untimed(folder, rows or self.size, cols or rows or self.size, **options)
        finally:
            shutil.rmtree(folder)

    def timed(self, **cases):
        return interleaved(cases, self.pairs)


def ratios(bench, only_codec=None, only_interleave=None):
    """run, N and G; with a surface model and on flat ground."""
    cases = [("none", "pixel"), ("zstd", "pixel"), ("deflate", "pixel"), ("none", "band")]
    for codec, interleave in cases:
        if only_codec not in {None, codec} or only_interleave not in {None, interleave}:
            continue
        name = {"none": "uncompressed", "zstd": "ZSTD 1", "deflate": "DEFLATE 6"}[codec] + f", by {interleave}"
        with bench.city(codec=codec, interleave=interleave) as image:
            dsm, flat = write_config(image), write_config(image, name="flat", flat=True)
            share = lobe_share(dsm)
            times = bench.timed(
                G=partial(copied_by_gdal, image),
                N=partial(n_run, dsm),
                run=partial(run, dsm),
                bare=partial(bare_run, dsm),
                flat=partial(run, flat),
            )
        by_pixel = interleave == "pixel"
        over_copy = RUN_OVER_COPY[codec] if by_pixel else None
        yield Ratio(f"{name}: share of pixels in a lobe", share)
        yield ratio(f"{name}: run / N", times["run"], times["N"], most=1.25 if by_pixel else 1.7)
        yield ratio(f"{name}: run / G", times["run"], times["G"], most=over_copy)
        yield ratio(
            f"{name}: flat run / G", times["flat"], times["G"], most=FLAT_OVER_COPY[codec] if by_pixel else None
        )
        yield ratio(f"{name}: run that is not published / G", times["bare"], times["G"])
        yield ratio(f"{name}: run / run that is not published", times["run"], times["bare"])
        yield Ratio(f"{name}: G, seconds", times["G"].wall_s, times["G"].cpu_s)


def lobe_share(config):
    """Share of the pixels that have something to remove; it also compiles what is to be compiled."""
    pixels = run(config)["pixels"]
    return (pixels["corrected"] + pixels["uncorrectable"]) / pixels["total"]


def defaults(bench):
    """With removed, shadows and quicklook; as cloud-optimised GeoTIFF; and what report and quicklook are of a run."""
    with bench.city(codec="zstd") as image:
        changes = {"plain": {}, "defaults": DEFAULTS, "cog": {"form": "cog"}}
        paths = {name: write_config(image, name=name, **keys) for name, keys in changes.items()}
        runs = {name: partial(run, path) for name, path in paths.items()}
        times = bench.timed(G=partial(copied_by_gdal, image), **runs)
        yield ratio("defaults (removed, shadows, quicklook), ZSTD 1 / G", times["defaults"], times["G"])
        yield ratio("defaults / run, ZSTD 1", times["defaults"], times["plain"])
        yield ratio("COG / run, ZSTD 1", times["cog"], times["plain"], most=3.3)
        for name in ("plain", "defaults"):
            yield Ratio(f"report and quicklook / {name} run, ZSTD 1", report_share(paths[name]), most=0.05)


def difference(bench):
    """Only what was removed, with a VRT that subtracts it; where all tiles have a peak, and where few have."""
    for codec in ("none", "zstd", "deflate"):
        with bench.city(codec=codec) as image:
            few = {"class_map": make_sparse_classes(image, 0.02)}
            configs = {
                name: write_config(image, name=name, **keys)
                for name, keys in {
                    "run": {},
                    "vrt": {"corrected": "vrt"},
                    "few, run": few,
                    "few, vrt": {"corrected": "vrt", **few},
                    "few, flat, vrt": {"corrected": "vrt", "flat": True, **few},
                }.items()
            }
            times = bench.timed(**{name: partial(run, config) for name, config in configs.items()})
        yield ratio(f"vrt / run, {codec}", times["vrt"], times["run"], most=0.7)
        yield ratio(f"2 % of the tiles, vrt / run of all, {codec}", times["few, vrt"], times["run"], most=0.15)
        yield ratio(f"2 % of the tiles, flat, vrt / run of all, {codec}", times["few, flat, vrt"], times["run"])
        yield ratio(f"2 % of the tiles, run / run of all, {codec}", times["few, run"], times["run"])


def report_share(config):
    """Share of a run's time that summary, page and quicklook take."""
    spent = []

    def timed(work):
        def call(*args, **kwargs):
            start = time.perf_counter()
            result = work(*args, **kwargs)
            spent.append(time.perf_counter() - start)
            return result

        return call

    start = time.perf_counter()
    with ExitStack() as patches:
        for name in ("summary", "page", "draw_quicklook", "write_json", "stac_item"):
            patches.enter_context(mock.patch.object(correct, name, timed(getattr(correct, name))))
        run(config)
    return sum(spent) / (time.perf_counter() - start)


def workers(bench):
    """One worker against two, on compressed input."""
    for codec in ("zstd", "deflate"):
        with bench.city(codec=codec) as image:
            one, two = (write_config(image, name=f"{count}", workers=count) for count in (1, 2))
            times = bench.timed(one=partial(run, one), two=partial(run, two))
        yield ratio(f"one worker / two workers, {codec}", times["one"], times["two"], least=1.6)


def memory(bench):
    """Peak memory of a square image, of one six times as wide, and of many bands. [MB]"""
    shapes = {
        "square": {"rows": bench.size, "cols": bench.size},
        "six times as wide": {"rows": bench.size // 8, "cols": 6 * bench.size},
        "60 bands, by band, tiles of 128": {"rows": bench.size // 5, "bands": 60, "interleave": "band", "tile": 128},
        "300 bands, by band, tiles of 64": {"rows": bench.size // 10, "bands": 300, "interleave": "band", "tile": 64},
        "300 bands, by pixel, tiles of 64": {"rows": bench.size // 10, "bands": 300, "tile": 64},
    }
    for name, shape in shapes.items():
        with bench.city(codec="zstd", **shape) as image:
            yield Ratio(f"peak memory, {name}, MB", peak_mb(write_config(image)), most=MEMORY_MB)
            if name in {"square", "six times as wide"}:
                yield Ratio(
                    f"peak memory, {name}, defaults, MB", peak_mb(write_config(image, **DEFAULTS)), most=MEMORY_MB
                )


def growth(bench):
    """Time of a pixel in images of several sizes; of a value in images of many bands."""
    per_pixel = {}
    for part in (0.2, 0.5, 1.0, 2.0):
        side = int(bench.size * part)
        with bench.city(rows=side, codec="zstd") as image:
            config = write_config(image)
            per_pixel[side] = bench.timed(run=partial(run, config))["run"]
        least = per_pixel[min(per_pixel)]
        of_least = (min(per_pixel) / side) ** 2
        times = per_pixel[side]
        yield Ratio(
            f"time of a pixel, {side} / {min(per_pixel)} columns",
            *(of_least * a / b for a, b in ((times.wall_s, least.wall_s), (times.cpu_s, least.cpu_s))),
        )
    value = per_pixel[bench.size].cpu_s / bench.size**2 / 4
    for bands, side in ((60, bench.size // 5), (300, bench.size // 10)):
        with bench.city(rows=side, bands=bands, interleave="band", codec="zstd", tile=64) as image:
            config = write_config(image)
            times = bench.timed(run=partial(run, config))["run"]
        yield Ratio(f"CPU time of a value, {bands} / 4 bands", times.cpu_s / side**2 / bands / value)


def sight(bench):
    """Sweeps for cast shadow and view occlusion against normals of the same surface model, one thread."""
    side = min(bench.size, 4096)
    heights = Lattice(side, side).strip(0, side, side)[1]
    cells = {"cell_x_m": CELL_M, "cell_y_m": CELL_M}
    middle, height_m = side * CELL_M / 2, side * CELL_M * 0.6

    def swept(make):
        sweep, visible = make(), np.ones(heights.shape, bool)
        for strip in sweep.strips(512):
            visible[strip.slices] &= sweep(strip, heights[strip.slices])

    def sun(azimuth_deg):
        azimuth = np.deg2rad(azimuth_deg)
        return shadows.DirectionSweep((side, side), [np.sin(azimuth), np.cos(azimuth), 1.2], **cells)

    cases = {f"cast shadow, sun at {azimuth} deg": partial(sun, azimuth) for azimuth in range(0, 360, 45)}
    start, end = (middle, -2 * middle, height_m), (middle + 0.3 * middle, 0.0, height_m)
    cases["occlusion of a line"] = partial(shadows.LineSweep, (side, side), start, end, **cells)
    cases["occlusion of a frame"] = partial(shadows.FrameSweep, (side, side), (middle, -middle, height_m), **cells)
    sweeps = {name: partial(swept, make) for name, make in cases.items()}
    times = bench.timed(normals=partial(horn_normals, heights, **cells), **sweeps)
    for name in cases:
        yield ratio(f"{name} / normals", times[name], times["normals"], most=20 if "frame" in name else 5)


SECTIONS = {
    "ratios": ratios,
    "defaults": defaults,
    "difference": difference,
    "workers": workers,
    "memory": memory,
    "growth": growth,
    "sight": sight,
}


def measure(folder, *, size, pairs, only=tuple(SECTIONS), **of_ratios):
    """The lines of some sections, as they come."""
    bench = Bench(folder, size, pairs)
    for name in only:
        yield from SECTIONS[name](bench, **(of_ratios if name == "ratios" else {}))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=10_000, help="rows and columns of the image")
    parser.add_argument("--pairs", type=int, default=5, help="rounds that count")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--codec", choices=("none", "zstd", "deflate"), help="of the section 'ratios'")
    parser.add_argument("--interleave", choices=("pixel", "band"), help="of the section 'ratios'")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()), help="a fast disk with some GB")
    parser.add_argument("--json", type=Path, help="write the ratios to this file too")
    options = parser.parse_args()
    lines = []
    for line in measure(
        options.folder,
        size=options.size,
        pairs=options.pairs,
        only=options.only,
        only_codec=options.codec,
        only_interleave=options.interleave,
    ):
        lines.append(line)
        sys.stdout.write(table([line]).splitlines()[1] + "\n")
        sys.stdout.flush()
    sys.stdout.write("\n" + table(lines) + "\n")
    if options.json:
        options.json.write_text(as_json(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
