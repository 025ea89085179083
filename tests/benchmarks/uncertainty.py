"""What the uncertainty costs: `python tests/benchmarks/uncertainty.py`; its time over that of the kernel without it.

Processor time of one thread, rounds that alternate, so that ratios hold on a busy machine too. A block of a city of
five materials in memory, whose roofs are 32 pixels wide, corrected as a run corrects it; without the histograms of
the report, which large scenes take of few rows. "city": every pixel is assessed; "a quarter": a quarter of the roofs.
The first ratio is with what was removed asked for in both arms, the second in neither, as a run does by default.
Last, what a run adds for the report: the sums of the uncertainty, of all rows.
"""

import statistics
import time
from dataclasses import replace

import numpy as np

from tscorr.bench.scene import ROOF, City
from tscorr.correction import BlockInputs, Corrector, Rules, Stored
from tscorr.correction.sigmas import SigmaTally

NO_TALLY = 10**9
SIDE, ROUNDS = 512, 15


def inputs_of(city: City, stored: Stored, rng: np.random.Generator, share: float) -> BlockInputs:
    """A block of the city of which a share has a material, and normals with an error of their own."""
    block = city.block(stored, rng)
    kept = rng.random((-(-SIDE // ROOF),) * 2) < share
    mask = kept.repeat(ROOF, axis=0).repeat(ROOF, axis=1)[:SIDE, :SIDE]
    sigma = rng.uniform(0.05, 0.5, mask.shape).astype(np.float32)
    return replace(block, material=block.material * mask, normal_sigma_deg=sigma)


def seconds(corrector: Corrector, inputs: BlockInputs, *, want_removed: bool) -> float:
    """Processor time of one block."""
    fresh = replace(inputs, image=inputs.image.copy())
    start = time.thread_time()
    corrector(fresh, want_removed=want_removed)
    return time.thread_time() - start


def seconds_of_sums(corrector: Corrector, inputs: BlockInputs) -> float:
    """Processor time of the sums over one block."""
    result = corrector(replace(inputs, image=inputs.image.copy()))
    start = time.thread_time()
    SigmaTally(len(corrector.names) + 1).add(result.sigma, result.flags, inputs.material)
    return time.thread_time() - start


def main() -> None:
    """Print a line for each kind of block."""
    city, rng = City.build((SIDE, SIDE)), np.random.default_rng(1)
    for bands in (4, 12):
        stored = Stored(
            dtype=np.dtype(np.uint16), scale=(1e-4,) * bands, offset=(0.0,) * bands, noise=((0.0005, 0.003),)
        )
        rules = Rules(direct_fraction=(0.9,), direct_fraction_sigma=(0.02,))
        entries = [(surface, surface.at(bands=bands), rules) for surface in city.materials]
        plain, asked = (
            Corrector(entries, stored, tally_stride=NO_TALLY, uncertainty=uncertainty) for uncertainty in (False, True)
        )
        for name, share in (("city", 1.0), ("a quarter", 0.25)):
            inputs = inputs_of(city, stored, rng, share)
            rounds = [
                (
                    *(seconds(arm, inputs, want_removed=True) for arm in (plain, asked)),
                    *(seconds(arm, inputs, want_removed=False) for arm in (plain, asked)),
                    seconds_of_sums(asked, inputs),
                )
                for _ in range(ROUNDS + 1)
            ][1:]
            without, asked_for, *_, sums = (
                1e9 * statistics.median(times) / SIDE**2 for times in zip(*rounds, strict=True)
            )
            ratios = (statistics.median(each[i + 1] / each[i] for each in rounds) for i in (0, 2))
            line = f"{bands:2d} bands, {name:9s}  {without:6.1f} ns  {asked_for:6.1f} ns a pixel"
            print(line, *(f" ratio {ratio:.2f}" for ratio in ratios), f" sums {sums:5.1f} ns")  # noqa: T201 - a script


if __name__ == "__main__":
    main()
