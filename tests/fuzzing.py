"""Mutated inputs for one process of the fuzz test: `python tests/fuzzing.py FOLDER FIRST COUNT`.

Every case is a seed: it picks a small scene, one of its files (or its configuration) and some mutations of that file,
plans the scene as `tscorr plan` does, and runs some of those that pass. The seed is printed before the case, so that
the last line names the culprit of a crash; the last line of a process that ends well is a JSON table of counts.
"""

import faulthandler
import json
import random
import resource
import shutil
import struct
import sys
import time
import tomllib
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import tomli_w
from small_scene import CELL, NORTH, WAVELENGTHS, WEST, write_config, write_image, write_raster

from tscorr import batch
from tscorr.cli.common import without_log_of_rubbish
from tscorr.config import load_config
from tscorr.errors import TscorrError
from tscorr.scene.forecast import forecast

SHAPE = 32, 32
LIMIT_MB, LIMIT_S, HANGS_S = 1000, 10, 120
RUN_EVERY = 6
"""of the cases that pass the plan"""
NUMBERS = (
    *("0", "1", "-1", "2", "3", "0.5", "-0.0", "255", "65535", "65536", "2147483647", "4294967295", "1e5", "1e-300"),
    *("1e308", "1e999", "-1e308", "nan", "inf", "-inf", "99999999999999999999", "1_000", "0x10", "1,5", "abc", ""),
)
VALUES = (
    *(
        0,
        1,
        -1,
        0.0,
        -0.5,
        1e308,
        float("nan"),
        float("inf"),
        2**31,
        2**63 - 1,
        True,
        False,
        "",
        " ",
        "..",
        "/",
        "nan",
    ),
    *(
        "a" * 5000,
        "\0",
        "\x1b[31m",
        "[bold]x[/bold]",
        "ü\n",
        "{stem}",
        "{0}",
        "*",
        "**/*",
        "[",
        "~",
        "/dev/zero",
        "/proc",
    ),
    *("image.tif", "class_map.tif", "dsm.tif", "EPSG:0", "EPSG:4326", "EPSG:28992", "+proj=nonsense", "roof_tile"),
    *([], [1.0], [1.0] * 3, ["x"], [[]], {}, {"x": 1}, {"kind": "flat"}, {"kind": "obs", "path": "image.tif"}),
)


def small_library():
    """A material of two wavelengths."""
    return """[tiles]
source = "a test"
wavelength_um = [0.4, 0.9]
t0 = [0.02, 0.03]
t1 = 0.2
w = 0.04
n = 1.7
k = 0.25
sigma = { t0 = 0.0003, w = 0.0004 }
zenith_range_deg = [0, 80]
"""


def write_scenes(folder):
    """Files of all the scenes; their configurations by name."""
    rng = np.random.default_rng(5)
    values = rng.integers(3000, 6000, (3, *SHAPE)).astype(np.int16)
    write_image(folder / "image.tif", values)
    classes = np.full(SHAPE, 5, np.uint8)
    classes[4:20, 4:20] = 1
    write_raster(folder / "class_map.tif", classes)
    write_raster(folder / "dsm.tif", rng.normal(1, 0.02, SHAPE).astype(np.float32), nodata=-9999)
    write_raster(folder / "index.tif", rng.integers(1, 3, SHAPE).astype(np.uint16))
    (folder / "tiles.toml").write_text(small_library())
    (folder / "cameras.csv").write_text(
        f"id,x,y,z\n1,{WEST},{NORTH + 900},1000.0\n2,{WEST + 90},{NORTH + 900},1000.0\n"
    )
    times = (f"2026-06-21T10:00:{second:02d}Z,{WEST + 8},{NORTH + 70 - 10 * second},900" for second in range(12))
    (folder / "trajectory.csv").write_text("utc,x,y,z\n" + "\n".join(times) + "\n")
    values.tofile(folder / "image.img")
    header = {
        "samples": SHAPE[1],
        "lines": SHAPE[0],
        "bands": 3,
        "header offset": 0,
        "file type": "ENVI Standard",
        "data type": 2,
        "interleave": "bsq",
        "byte order": 0,
        "map info": f"{{UTM, 1, 1, {WEST}, {NORTH}, {CELL}, {CELL}, 31, North, WGS-84, units=Meters}}",
        "wavelength units": "Micrometers",
        "wavelength": "{" + ", ".join(map(str, WAVELENGTHS)) + "}",
        "reflectance scale factor": 10000,
        "data ignore value": -9999,
    }
    (folder / "image.hdr").write_text("ENVI\n" + "\n".join(f"{key} = {value}" for key, value in header.items()))
    output = {"directory": "out", "quicklook": False, "products": ["corrected", "flags"]}
    sections = {
        "output": output,
        "materials": {"library": ["tiles.toml"], "classes": {"1": "tiles", "5": "lambertian"}},
    }
    flat = {"kind": "flat", "height_m": 1.0}
    envi = {"class_map": "class_envi.tif", "image": "image.img", "surface": flat, "scale": 1e-4}
    write_raster(folder / "class_envi.tif", classes, crs="EPSG:32631")
    view = {"kind": "mosaic", "index": "index.tif", "cameras": "cameras.csv"}
    tiled = {
        "image": "large.tif",
        "class_map": "large_classes.tif",
        "surface": {"kind": "dsm", "path": "large_dsm.tif"},
    }
    zstd = {"compress": "zstd", "blockxsize": 128, "blockysize": 128}
    write_image(folder / "large.tif", values, interleave="pixel", predictor=2, **zstd)
    large = {"compress": "none", "blockxsize": 256, "blockysize": 256, "bigtiff": "yes"}
    write_raster(folder / "large_classes.tif", classes, **large)
    heights = rng.normal(1, 0.02, SHAPE).astype(np.float32)
    write_raster(folder / "large_dsm.tif", heights, predictor=3, bigtiff="yes", **zstd)
    changes = {
        "surface": {},
        "tiled": tiled,
        "line": {"sun": None, "view": {"kind": "line", "trajectory": "trajectory.csv"}, "surface": flat},
        "mosaic": {"view": view, "surface": flat},
        "envi": envi,
    }
    configurations = {}
    for name, change in changes.items():
        path = write_config(folder, {"name": name, **change}, **sections)
        configurations[name] = path.rename(folder / f"{name}.toml")
    return configurations


TARGETS = {
    "tiled": ("large.tif", "large_classes.tif", "large_dsm.tif"),
    "surface": ("image.tif", "class_map.tif", "dsm.tif", "tiles.toml", "surface.toml"),
    "line": ("trajectory.csv", "line.toml"),
    "mosaic": ("index.tif", "cameras.csv", "mosaic.toml"),
    "envi": ("image.hdr", "envi.toml"),
}


def mutated_tiff(content, rng):
    """A TIFF with one to four entries or bytes of its directories changed, or cut short."""
    data = bytearray(content)
    big = data[2] == 43
    word, head, size = ("<Q", 8, 20) if big else ("<I", 2, 12)
    count, value = (4, 12) if big else (4, 8)
    (start,) = struct.unpack_from(word, data, 8 if big else 4)
    (entries,) = struct.unpack_from("<Q" if big else "<H", data, start)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = start + head + size * rng.randrange(entries)
        kind = rng.randrange(8)
        if kind < 3:
            limit = 2 ** (64 if big else 32) - 1
            number = rng.choice((0, 1, 2, 3, 7, 8, 16, 255, 1000, 65535, 65536, 2**24, 2**31 - 1, 2**31, limit))
            struct.pack_into(word, data, at + value, number)
        elif kind == 3:
            struct.pack_into(word, data, at + count, rng.choice((0, 1, 2, 3, 1000, 2**31, 2**32 - 1)))
        elif kind == 4:
            struct.pack_into("<H", data, at + 2, rng.randrange(20))
        elif kind == 5:
            struct.pack_into(
                "<H", data, at, rng.choice((254, 256, 257, 258, 259, 277, 284, 317, 322, 339, 33550, 42113))
            )
        elif kind == 6:  # what an entry points to: places, scales, names
            place = struct.unpack_from(word, data, at + value)[0]
            if place + 8 <= len(data):
                number = rng.choice((0.0, float("nan"), float("inf"), 1e308, 1e-308, -1.0, rng.uniform(-1e9, 1e9)))
                struct.pack_into("<d", data, place + 8 * rng.randrange(1 + (len(data) - place - 8) // 64), number)
        else:
            data[rng.randrange(min(start, len(data)), len(data))] = rng.randrange(256)
    return bytes(data[: rng.randrange(len(data))]) if rng.random() < 0.05 else bytes(data)


def mutated_text(content, rng):
    """A text with one to three of its numbers, lines or characters changed."""
    text = content.decode()
    for _ in range(rng.choice((1, 1, 2, 3))):
        lines = text.splitlines(keepends=True) or [""]
        place = rng.randrange(len(lines))
        kind = rng.randrange(7)
        if kind < 3:
            words = lines[place].replace(",", " , ").split(" ")
            words[rng.randrange(len(words))] = rng.choice(NUMBERS)
            lines[place] = " ".join(words)
        elif kind == 3:
            del lines[place]
        elif kind == 4:
            lines.insert(rng.randrange(len(lines) + 1), lines[place])
        elif kind == 5:
            at = rng.randrange(len(lines[place]) + 1)
            extra = rng.choice(
                ("\0", "\x1b", '"', "{", "}", "[", "]", "=", "\r", ",", "\ufeff", "é", "#", "-", "9" * 400)
            )
            lines[place] = lines[place][:at] + extra + lines[place][at:]
        else:
            lines[place] = lines[place][: rng.randrange(len(lines[place]) + 1)]
        text = "".join(lines)
    return text.encode()


def leaves(value, place=()):
    """Places of all values in nested tables."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield (*place, key)
            yield from leaves(item, (*place, key))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from leaves(item, (*place, i))


def mutated_tables(content, rng):
    """A TOML file with one to three of its values changed, deleted or added."""
    tables = tomllib.loads(content.decode())
    for _ in range(rng.choice((1, 1, 2, 3))):
        *way, key = rng.choice(list(leaves(tables)))
        table = tables
        for step in way:
            table = table[step]
        kind = rng.randrange(5)
        if kind < 3:
            table[key] = rng.choice(VALUES)
        elif kind == 3:
            del table[key]
        else:
            table[rng.choice(("crs", "nodata", "scale", "offset", "saturation", "zenith", "x", "height_offset_m"))] = (
                rng.choice(VALUES)
            )
        if not list(leaves(tables)):
            break
    return tomli_w.dumps(tables).encode()


def mutated(path, rng):
    """New content of a file."""
    content = path.read_bytes()
    if path.suffix == ".tif":
        return mutated_tiff(content, rng)
    if path.suffix == ".toml" and rng.random() < 0.7:
        return mutated_tables(content, rng)
    return mutated_text(content, rng)


def outcome_of(config, folder, run):
    """What became of a scene: refused, planned, or run; raises what no user should see."""
    try:
        settings = load_config(config)
        planned = batch.plan(settings)
        for scene in planned:
            forecast(scene)
            scene.close()
    except TscorrError as error:
        check_message(str(error))
        return "refused"
    if not run or not Path(settings.output.directory).is_relative_to(folder):
        return "planned"
    result = batch.run(settings)
    for scene in result.scenes:
        check_message(scene.error)
        if "a fault of tscorr" in scene.error:
            raise AssertionError(scene.error)
    return "done" if result.exit_code == 0 else "failed"


def check_message(message):
    """A message is short and fit for a terminal."""
    lines = message.splitlines()
    assert len(lines) < 60, f"{len(lines)} lines"
    assert all(len(line) < 3000 for line in lines), f"a line of {max(map(len, lines))} letters: {message[:300]}"
    assert all(c.isprintable() for line in lines for c in line), f"unprintable: {message[:300]!r}"


def case(seed, folder, configurations):
    """Run one case; the kind of file that was changed, and what became of it."""
    rng = random.Random(seed)
    name = rng.choices(list(TARGETS), weights=(4, 6, 2, 2, 2))[0]
    target = folder / rng.choice(TARGETS[name])
    honest = target.read_bytes()
    target.write_bytes(mutated(target, rng))
    try:
        return target.name, outcome_of(configurations[name], folder, run=seed % RUN_EVERY == 0)
    finally:
        target.write_bytes(honest)
        shutil.rmtree(folder / "out", ignore_errors=True)
        for extra in folder.glob("*.aux.xml"):
            extra.unlink()


def say(line):
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def peak_mb():
    """The most memory of this process; getrusage would count that of the process which started it."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM")) / 1e3


def warm_up(folder, configurations):
    """Every scene as it is, and every type of image: kernels are compiled before the clock runs."""
    for config in configurations.values():
        assert outcome_of(config, folder, run=True) == "done", config
    for dtype in (np.uint8, np.uint16, np.float32):
        write_image(folder / "image.tif", np.full((3, *SHAPE), 200, dtype), nodata=0)
        assert outcome_of(configurations["surface"], folder, run=True) == "done", dtype
    write_scenes(folder)
    shutil.rmtree(folder / "out")


def seconds_of(seed, folder, configurations, counts):
    """Run a case and count what became of it; the time that this process worked on it. [s]"""
    start = time.process_time()
    file, state = case(seed, folder, configurations)
    counts[f"{file} {state}"] += 1
    return time.process_time() - start


def main(folder, first, number):
    """All cases of this process; the exit code says whether one of them was not as it should be."""
    sys.unraisablehook = without_log_of_rubbish
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", message="Dataset has no geotransform")
    resource.setrlimit(resource.RLIMIT_AS, (6_000_000_000, 6_000_000_000))
    folder.mkdir(parents=True, exist_ok=True)
    configurations = write_scenes(folder)
    warm_up(folder, configurations)
    counts, bad, slowest = Counter(), [], 0.0
    for seed in range(first, first + number):
        say(f"seed {seed}")
        faulthandler.dump_traceback_later(HANGS_S, exit=True)
        before = peak_mb()
        try:
            seconds = seconds_of(seed, folder, configurations, counts)
            if seconds > LIMIT_S:  # once more: a kernel may have been compiled
                seconds = seconds_of(seed, folder, configurations, Counter())
            slowest = max(slowest, seconds)
            if seconds > LIMIT_S:
                bad.append(f"seed {seed}: {seconds:.1f} s")
        except BaseException as error:  # noqa: BLE001 - all that a case raises is what the test is for
            bad.append(f"seed {seed}: {type(error).__name__}: {error}"[:600])
        if peak_mb() > LIMIT_MB >= before:
            bad.append(f"seed {seed}: {peak_mb():.0f} MB")
    faulthandler.cancel_dump_traceback_later()
    say(json.dumps({"counts": counts, "bad": bad, "slowest_s": slowest, "peak_mb": peak_mb()}))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))
