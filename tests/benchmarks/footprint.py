"""What tscorr weighs and how fast it starts: `python tests/benchmarks/footprint.py`.

MB of each package that `pip install tscorr` brings, with what that brings; start of some commands as multiples of the
start of Python alone (time of the processor, the best of several interleaved runs), and the heavy packages that each
command loads.
"""

import re
import resource
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import click

ROOT = Path(__file__).parent.parent.parent
HEAVY = (
    *("numpy", "numba", "scipy", "pandas", "pvlib", "rasterio", "pydantic", "rich"),
    *("matplotlib", "PIL", "colour", "OpenImageIO"),
)
START = "import sys\nfrom tscorr.cli import cli\ntry: cli({!r}, prog_name='tscorr')\nexcept SystemExit: pass\n"
STARTS = {
    "python": "import sys\n",
    "import tscorr": "import sys, tscorr\n",
    "tscorr --help": START.format(["--help"]),
    "tscorr init --schema": START.format(["init", "--schema"]),
    "tscorr materials": START.format(["materials"]),
    "tscorr plan configs/delft.toml": START.format(["plan", str(ROOT / "configs/delft.toml")]),
}
REPEATS = 5
LARGEST = 12
"""packages that are listed one by one"""


def requirements(package):
    """Names of the packages that one needs, without its extras."""
    lines = distribution(package).requires or ()
    return {re.match(r"[\w.-]+", line)[0] for line in lines if "extra ==" not in line}


def installed(package):
    """The package and all that it brings, as far as it is installed: what is for another platform is not."""
    found, todo = set(), [package]
    while todo:
        name = re.sub(r"[-_.]+", "-", todo.pop()).lower()
        try:
            needed = requirements(name)
        except PackageNotFoundError:
            continue
        if name not in found:
            found.add(name)
            todo += needed
    return found


def megabytes(package):
    """Size of what a package has installed; compiled caches are not counted."""
    files = distribution(package).files or ()
    paths = (Path(file.locate()) for file in files if file.suffix != ".pyc")
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def loaded(code):
    """The heavy packages that a start loads."""
    report = f"{code}print('loaded', *(name for name in {HEAVY!r} if name in sys.modules))\n"
    result = subprocess.run([sys.executable, "-c", report], capture_output=True, text=True, check=True)
    return result.stdout.splitlines()[-1].split()[1:]


def seconds(code):
    """Time of the processor that a start takes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main():
    sizes = {name: megabytes(name) for name in installed("tscorr") - {"tscorr"}}
    ordered = sorted(sizes, key=sizes.get, reverse=True)
    for name in ordered[:LARGEST]:
        click.echo(f"{name:<32}{sizes[name]:7.1f} MB")
    click.echo(f"{len(ordered) - LARGEST} others{sum(sizes[name] for name in ordered[LARGEST:]):>23.1f} MB")
    click.echo(f"{'all':<32}{sum(sizes.values()):7.1f} MB")
    times = [{name: seconds(code) for name, code in STARTS.items()} for _ in range(REPEATS)]
    best = {name: min(run[name] for run in times) for name in STARTS}
    for name, code in STARTS.items():
        click.echo(f"{name:<32}{best[name] / best['python']:7.1f} x python  {' '.join(loaded(code))}")


if __name__ == "__main__":
    main()
