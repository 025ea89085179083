"""Time the kernel, one thread, on blocks in memory: `python tests/benchmarks/kernel.py [--quick] [--json FILE]`.

Processor times of rounds that alternate, so that ratios hold on a busy machine too; images of uint16, roofs of 32
pixels of five materials. Without the histograms of the report, which are taken of few rows where a scene is large.

numpy_over_kernel : the equations in numpy float64 against the kernel, all pixels active; at least 20
coherent_over_all : a tenth of the roofs active, against all of them; at most 0.45
extra_band_ns     : of each band from 4 to 60; at most 2, where copying a band's values takes 0.2
for information   : kernel_over_memcpy (of the image), exact_over_kernel, tally_over_kernel (with the histograms)
"""

import argparse
import json
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from tscorr.bench.scene import ROOF, SCALE, City
from tscorr.correction import BlockInputs, Corrector, Rules, Stored

NO_HISTOGRAMS = 10**9


@dataclass(frozen=True, slots=True)
class Case:
    """A block and what corrects it."""

    corrector: Corrector
    inputs: BlockInputs

    def seconds(self):
        """Processor time of correcting the block once."""
        fresh = replace(self.inputs, image=self.inputs.image.copy())
        start = time.thread_time()
        self.corrector(fresh, first_row=1, want_removed=False)
        return time.thread_time() - start


def case(side, *, bands=4, active=1.0, precision="fast", tally_stride=NO_HISTOGRAMS):
    """A square block of a city, wholly or in part of materials that have a peak."""
    shape = side, side - 12  # bands at powers of two would share their places in the caches
    city, rng = City.build(shape), np.random.default_rng(1)
    stored = Stored(dtype=np.dtype(np.uint16), scale=(SCALE,) * bands, offset=(0.0,) * bands)
    roofs = rng.random((-(-side // ROOF),) * 2) < active
    mask = np.kron(roofs, np.ones((ROOF, ROOF), np.uint8))[: shape[0], : shape[1]]
    inputs = city.block(stored, rng)
    entries = [(m, m.at(bands=bands), Rules(precision=precision)) for m in city.materials]
    corrector = Corrector(entries, stored, tally_stride=tally_stride)
    return Case(corrector, replace(inputs, material=inputs.material * mask))


def seconds_of_copy(image):
    """Processor time of copying an image."""
    copy = np.empty_like(image)
    copy[:] = image  # pages are there
    start = time.thread_time()
    copy[:] = image
    return time.thread_time() - start


def measured(side, rounds):
    """Median nanoseconds a pixel of each case, and the ratios."""
    cases = {
        "kernel": case(side),
        "coherent": case(side, active=0.1),
        "bands_60": case(side, bands=60),
        "tally": case(side, tally_stride=1),
        "exact": case(side, precision="exact"),
        "numpy": case(side, precision="reference"),
    }
    seconds = {name: [] for name in (*cases, "memcpy")}
    for one in cases.values():
        one.seconds()  # compiles
    for _ in range(rounds):
        for name, one in cases.items():
            seconds[name].append(one.seconds())
        seconds["memcpy"].append(seconds_of_copy(cases["kernel"].inputs.image))
    pixels = cases["kernel"].inputs.material.size
    ns = {name: 1e9 * statistics.median(values) / pixels for name, values in seconds.items()}
    ratios = {
        "numpy_over_kernel": ns["numpy"] / ns["kernel"],
        "coherent_over_all": ns["coherent"] / ns["kernel"],
        "extra_band_ns": (ns["bands_60"] - ns["kernel"]) / 56,
        "kernel_over_memcpy": ns["kernel"] / ns["memcpy"],
        "exact_over_kernel": ns["exact"] / ns["kernel"],
        "tally_over_kernel": ns["tally"] / ns["kernel"],
    }
    return {"side_px": side, "rounds": rounds, "ns_per_pixel": ns, "ratios": ratios}


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small block, one round: proves that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers here")
    options = parser.parse_args(arguments)
    result = measured(64, 1) if options.quick else measured(512, 9)
    for name, value in result["ns_per_pixel"].items():
        click.echo(f"{name:20s} {value:8.1f} ns a pixel")
    for name, value in result["ratios"].items():
        click.echo(f"{name:20s} {value:8.2f}")
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
