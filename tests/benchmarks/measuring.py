"""Times that mean something on a shared machine: interleaved rounds, medians, ratios."""

import gc
import json
import resource
import statistics
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Times:
    """Wall and CPU seconds of each round, of all threads."""

    wall: tuple[float, ...]
    cpu: tuple[float, ...]

    @property
    def wall_s(self):
        return statistics.median(self.wall)

    @property
    def cpu_s(self):
        return statistics.median(self.cpu)


class Spent(NamedTuple):
    """Wall and CPU seconds of some work, of all threads."""

    wall: float
    cpu: float


def spent(work, *args):
    """What some work took of this process, or what it says itself that it took elsewhere."""
    before, start = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    result = work(*args)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF)
    if isinstance(result, Spent):
        return result
    return Spent(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


class Elsewhere:
    """Work that is done by a process of its own, which stays the same; only what it does is timed, not its start."""

    def __init__(self, work):
        self._work = work
        self._process = None

    def __call__(self, *args):
        return self._submit(spent, self._work, *args)

    def untimed(self, *args, **kwargs):
        """What the work returns."""
        return self._submit(self._work, *args, **kwargs)

    def _submit(self, *args, **kwargs):
        if self._process is None:
            self._process = ProcessPoolExecutor(1, get_context("spawn"))
        return self._process.submit(*args, **kwargs).result()


@dataclass(frozen=True)
class Ratio:
    """One line of the table: the median of the ratios of the rounds, and what it may be at most, or at least."""

    name: str
    wall: float
    cpu: float | None = None
    most: float | None = None
    least: float | None = None

    @property
    def verdict(self):
        if self.most is None and self.least is None:
            return ""
        kept = self.wall <= self.most if self.most is not None else self.wall >= self.least
        return "" if kept else "MISSED"


def interleaved(cases, rounds):
    """Times of each of some functions, by name, called in turn; before several rounds one warms up, uncounted."""
    walls, cpus = {name: [] for name in cases}, {name: [] for name in cases}
    for number in range(0 if rounds > 1 else 1, rounds + 1):
        for name, work in cases.items():
            gc.collect()
            took = spent(work)
            if number > 0:
                walls[name].append(took.wall)
                cpus[name].append(took.cpu)
    return {name: Times(tuple(walls[name]), tuple(cpus[name])) for name in cases}


def ratio(name, over, under, **bar):
    """The ratio of two series of times of the same rounds."""
    walls, cpus = (
        [a / b for a, b in zip(getattr(over, key), getattr(under, key), strict=True)] for key in ("wall", "cpu")
    )
    return Ratio(name, statistics.median(walls), statistics.median(cpus), **bar)


def peak_mb(config):
    """The most memory of a process of its own that runs a configuration. [MB]

    As Linux tells it of that process alone; getrusage begins with what its parent had.
    """
    code = (
        "import re, sys; from pathlib import Path; from tscorr import batch\n"
        "outcome = batch.run(sys.argv[1], overwrite=True).scenes[0]\n"
        "assert outcome.state == 'done', outcome.error\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])"
    )
    result = subprocess.run([sys.executable, "-c", code, str(config)], capture_output=True, text=True, check=True)
    return float(result.stdout) / 1e3


def table(ratios):
    """The lines of the table as text."""
    lines = [f"{'':58}{'wall':>8}{'cpu':>8}{'bar':>10}"]
    for line in ratios:
        bar = f"<= {line.most:g}" if line.most is not None else f">= {line.least:g}" if line.least is not None else ""
        cpu = "" if line.cpu is None else f"{line.cpu:.2f}"
        lines.append(f"{line.name:58}{line.wall:8.2f}{cpu:>8}{bar:>10} {line.verdict}".rstrip())
    return "\n".join(lines)


def as_json(ratios):
    """The same for a program."""
    keys = ("name", "wall", "cpu", "most", "least")
    return json.dumps([{key: getattr(line, key) for key in keys} for line in ratios], indent=1) + "\n"
