"""The benchmark: times, errors, and whether the errors are as small as is said."""

import os
import platform
from dataclasses import asdict
from typing import Any

import numpy as np

from tscorr import __version__
from tscorr.bench.errors import measure, promise, repeatable
from tscorr.bench.forms import simplified_errors
from tscorr.bench.scene import BANDS, SCALE, nanoseconds_per_pixel, stored_errors
from tscorr.bench.variants import VARIANTS, Variant

DIFFERING_VALUES, DIFFERING_FLAGS = 5e-4, 1e-5
"""fractions of stored values and of flags in which "fast" may differ from "exact"; a value by one step at most"""


def bench(*, quick: bool = False, seed: int = 0) -> dict[str, Any]:
    """Run time and error of every variant, as the JSON that `tscorr bench --json` writes.

    quick : a coarse search and short timings, a few seconds; else about two minutes. The first call compiles.
    Keys: "machine"; "variants", a list of "name", "ns_per_pixel", "ns_per_pixel_and_band",
    "max_relative_error", "rms_relative_error" (of reflectances above 1e-6 and above the variant's
    threshold), "max_absolute_reflectance_error" (of reflectances up to 1), "max_absolute_brdf_error" [sr^-1],
    "worst_input" (where the error is largest against its bound), "bound", "error_over_bound", "inputs_tried",
    and "stored" where the variant corrects images; "simplified_form": what leaving out G does.
    """
    shape, rounds = ((128, 512), 3) if quick else ((512, 512), 11)
    times = nanoseconds_per_pixel(VARIANTS, shape, rounds)
    return {
        "machine": machine(),
        "variants": [_entry(variant, times[variant.name], quick=quick, seed=seed) for variant in VARIANTS],
        "simplified_form": simplified_errors(5.0 if quick else 1.0),
    }


def broken_promises(result: dict[str, Any]) -> list[str]:
    """What a result of `bench` finds worse than it is said to be, a sentence each; empty if all holds."""
    broken = []
    for entry in result["variants"]:
        name, stored = entry["name"], entry.get("stored")
        if not entry["error_over_bound"] <= 1:
            worst = entry["worst_input"]
            broken.append(
                f"{name}: the error {worst['error']:.3g} of the reflectance {worst['removed']:.6g} is "
                f"{entry['error_over_bound']:.3g} times its bound, {entry['bound']}"
            )
        if stored is not None and not (
            stored["most_steps"] <= 1
            and stored["differing"] <= DIFFERING_VALUES
            and stored["flags"] <= DIFFERING_FLAGS
        ):
            broken.append(
                f"{name}: stored values differ from the exact ones by up to {stored['most_steps']} steps, in a "
                f"fraction {stored['differing']:.2g} of the values, flags in {stored['flags']:.2g}; allowed are 1 "
                f"step, {DIFFERING_VALUES:g} and {DIFFERING_FLAGS:g}"
            )
    return broken


def machine() -> dict[str, Any]:
    """Where it was measured, and with which versions."""
    import numba

    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "tscorr": __version__,
        "digits_of_the_truth": int(np.finfo(np.longdouble).precision),
    }


def _entry(variant: Variant, nanoseconds: float, *, quick: bool, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    errors = measure(variant, rng, count=100 if quick else 2500, rounds=4 if quick else 25)
    entry: dict[str, Any] = {
        "name": variant.name,
        "ns_per_pixel": nanoseconds,
        "ns_per_pixel_and_band": nanoseconds if variant.precision == "angles" else nanoseconds / BANDS,
        "max_relative_error": errors.max_relative,
        "rms_relative_error": errors.rms_relative,
        "max_absolute_reflectance_error": errors.max_absolute,
        "max_absolute_brdf_error": errors.max_absolute / np.pi,
        "worst_input": repeatable(errors.worst),
        "bound": promise(variant),
        "error_over_bound": errors.worst.excess,
        "inputs_tried": errors.tried,
    }
    if variant.precision in {"fast", "reference"} and variant.negligible_reflectance == 0:
        exact = Variant("", variant.form, "exact")
        entry["stored"] = {
            "step": SCALE,
            **asdict(stored_errors(variant, exact, (128, 512) if quick else (1024, 1024), seed)),
        }
    return entry
