"""The kernel compiled by another process, while this one compiles the geometry and begins with it.

numba compiles one function at a time in a process, and the kernel is half of what a first run compiles. The two
processes meet in numba's cache on the disk. Where the other one fails, this one compiles, as it would have anyway.
"""

import gc
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tscorr import kernels
from tscorr.interpreter import another

_at_work: "list[subprocess.Popen[bytes]]" = []
"""the process that compiles, if one does: scenes that are done side by side wait for the same"""
_starting = threading.Lock()


@contextmanager
def compiling(calls: Callable[[], Sequence[tuple[Any, ...]]]) -> Iterator[Callable[[], None]]:
    """Have `correct_block` compiled for the types of the arguments of some calls; what comes back waits until it is.

    That is nothing where this cache has had a kernel, of whatever types: then the calls are not even asked for.
    Leaving the context ends the process that it started; who waits for it then goes on.
    """
    with _starting:
        own = _compiler(calls()) if not _at_work and _is_new() else None
        if own is not None:
            _at_work.append(own)
        process = next(iter(_at_work), None)
    try:
        yield lambda: _wait(process)
    finally:
        if own is not None:
            own.kill()
            own.wait()
            _at_work.remove(own)


def _is_new() -> bool:
    """Whether the cache has never had a kernel."""
    stats = getattr(kernels.correct_block, "stats", None)  # plain Python has none, where numba is switched off
    return stats is not None and not any(Path(stats.cache_path).glob("*.correct_block-*.nbi"))


def _compiler(calls: Sequence[tuple[Any, ...]]) -> "subprocess.Popen[bytes] | None":
    if not calls:
        return None
    nobody = subprocess.DEVNULL
    try:
        with tempfile.TemporaryFile() as content:
            pickle.dump(calls, content)
            content.seek(0)
            return subprocess.Popen(**another("tscorr.correction.ahead"), stdin=content, stdout=nobody, stderr=nobody)
    except OSError:
        return None


def _wait(process: "subprocess.Popen[bytes] | None") -> None:
    from numba.core.event import trigger_event

    if process is not None and process.poll() is None:
        with trigger_event("numba:compile", data={"dispatcher": kernels.correct_block}):  # who listens, hears of it
            process.wait()


if __name__ == "__main__":
    gc.disable()  # it would search the many objects of numba again and again, and this process does not last
    for arguments in pickle.load(sys.stdin.buffer):  # noqa: S301 - of the process that started this one
        kernels.correct_block(*arguments)
