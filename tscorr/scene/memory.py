"""The memory of this process: how much it has used, using it again, and giving back what it does not use."""

import ctypes
import resource
import sys
from pathlib import Path

HEADROOM_MB = 35
"""what is free is given back this long before the limit: the blocks that are worked on grow meanwhile"""
WORTH_MB = 30
"""growth since the last time for which it is worth the while"""

GLIBC_TRIM_THRESHOLD, GLIBC_MMAP_THRESHOLD, GLIBC_ARENA_MAX = -1, -3, -8
"""parameters of its mallopt"""
LARGEST_KEPT_BYTES = 32 << 20
"""of one array; glibc allows no more"""

_left = {"mb": 0.0}
"""what this process took after it gave something back"""


def peak_rss_mb() -> float:
    """The most memory that this process has used so far. [MB]"""
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def share() -> None:
    """Let all threads take their memory from one place, which keeps what they free until `give_back`.

    To be called before they are started; it holds for the whole process. By itself the C library (glibc) has a place
    for each thread, and returns the arrays of each block to the operating system, which clears every page of them when
    the next block asks again: that takes a tenth of a run.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return
    mallopt(GLIBC_ARENA_MAX, 1)
    mallopt(GLIBC_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)
    mallopt(GLIBC_TRIM_THRESHOLD, 1 << 30)


def keep_below(limit_mb: float) -> None:
    """Give back what is free where this process takes nearly as much as it may. [MB]"""
    threshold = max(limit_mb - HEADROOM_MB, _left["mb"] + WORTH_MB)
    if peak_rss_mb() > threshold and rss_mb() > threshold:  # the peak is asked in a hundredth of the time
        give_back()


def give_back() -> None:
    """Return freed memory to the operating system, where the C library (glibc) keeps it.

    Without this what the blocks of one scene took stays beside what its pictures and the next scene take.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError):  # another C library, which need not be told
        return
    _left["mb"] = rss_mb()


def rss_mb() -> float:
    """What this process takes now; 0 where the system does not say. [MB]"""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return 0.0
    return pages * resource.getpagesize() / 1e6
