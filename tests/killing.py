"""Trials of runs that are stopped: killed at a step of writing, or by a signal after a while. Run as a script.

A trial starts from an old result of two scenes, a and b, and runs a new configuration of a, which is stopped; what it
left is looked at, and the same run is started again. Each run is a process of its own, forked from this one, which has
imported everything and opened nothing.
"""

import json
import os
import shutil
import signal
import sys
import time
import traceback
from pathlib import Path

import numpy as np

import tscorr
from tscorr import publish
from tscorr.cli import cli
from tscorr.width import width_rows

SCENES = "a", "b"
CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "shutil.rmtree", "os.truncate", "os.link", "os.utime"}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def warm_up():
    """Compile, load and tabulate what a run needs, without a file."""
    cube = np.full((3, 8, 8), 4000, np.int16)
    up = np.array([0.0, 0.0, 1.0])
    tscorr.correct(cube, np.ones((8, 8), int), {1: "roof_tile"}, up, up, scale=1e-4)
    width_rows(tscorr.material("roof_tile"), form="full")


def steps_under(folder, act):
    """Call `act` with the number of each change of the file system below a folder, before it is made."""
    count = 0

    def hook(event, arguments):
        nonlocal count
        writes = event in CHANGES or (event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITING)
        if writes and str(arguments[0]).startswith(str(folder)):
            count += 1
            act(count)

    sys.addaudithook(hook)


def start(config, log, before=None):
    """Process id of a `tscorr run`, whose output goes to a file."""
    child = os.fork()
    if child:
        return child
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    code = 99
    try:
        if before is not None:
            before()
        cli(["run", "-q", str(config)], prog_name="tscorr")
    except SystemExit as end:
        code = end.code
    except BaseException:  # noqa: BLE001 - which the exit below would swallow
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def finish(child):
    """Exit code of a process; less than 0 for a signal."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def look(out, keys):
    """State of each scene: old, new, absent, or what is wrong; and what is left beside them."""
    states = {}
    for name in SCENES:
        target = out / name
        if not target.exists():
            states[name] = "absent"
            continue
        problems = publish.damaged(target)
        states[name] = "; ".join(problems) or keys.get(publish.read_manifest(target)["key"], "of another key")
    for text in ("batch.json", "collection.json"):
        if (out / text).exists():
            json.loads((out / text).read_text())
    hidden = sorted(path.name for path in out.glob(".*"))
    return {"states": states, "hidden": hidden}


def trial(folder, number, keys, *, step=None, after=None, number_of_signal=signal.SIGKILL):
    """One stopped run and the one after it; what was seen."""
    place = folder / f"{number:03d}"
    out = place / "out"
    shutil.copytree(folder / "old", out)
    config = place / "city.toml"
    config.write_text((folder / "new.toml").read_text().replace("@OUT@", str(out)))
    (place / "log").touch()  # a kill may come before the run opens it

    def kill(count):
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)

    child = start(config, place / "log", None if step is None else lambda: steps_under(out, kill))
    if after is not None:
        time.sleep(after)
        os.kill(child, number_of_signal)
    seen = {"trial": number, "step": step, "after": after, "first": finish(child), **look(out, keys)}
    seen["said"] = (place / "log").read_text()
    seen["second"] = finish(start(config, place / "log"))
    return {**seen, "then": look(out, keys), "said_then": (place / "log").read_text()}


def count_steps(folder, place):
    """How many steps an undisturbed run takes, and how long. [s]"""
    place.mkdir()
    shutil.copytree(folder / "old", place / "out")
    config, counted = place / "city.toml", place / "steps"
    config.write_text((folder / "new.toml").read_text().replace("@OUT@", str(place / "out")))
    started = time.monotonic()
    child = start(config, place / "log", lambda: steps_under(place / "out", lambda n: counted.write_text(str(n))))
    assert finish(child) == 0, (place / "log").read_text()
    return int(counted.read_text()), time.monotonic() - started


def main(folder, share, shares, kills, signals, seed):
    """Print a JSON line for each trial: at every step, `kills` at random times, `signals` of the polite ones.

    share, shares : this process does every so many of them.
    """
    folder, share, shares = Path(folder), int(share), int(shares)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background is started to ignore it
    warm_up()
    steps, lasts = count_steps(folder, folder / f"steps{share}")
    keys = {publish.read_manifest(folder / kind / "a")["key"]: kind for kind in ("old", "new")}
    keys[publish.read_manifest(folder / "old" / "b")["key"]] = "same"
    rng = np.random.default_rng(int(seed))
    plans = [{"step": step} for step in range(1, steps + 1)]
    numbers = [signal.SIGKILL] * int(kills) + [signal.SIGINT] * int(signals) + [signal.SIGTERM] * int(signals)
    plans += [{"after": lasts * float(rng.uniform()), "number_of_signal": number} for number in numbers]
    for number, plan in list(enumerate(plans))[share::shares]:
        seen = trial(folder, number, keys, **plan)
        line = json.dumps(seen | {"signal": int(plan.get("number_of_signal", signal.SIGKILL))})
        print(line, flush=True)  # noqa: T201 - read by the test


if __name__ == "__main__":
    main(*sys.argv[1:])
