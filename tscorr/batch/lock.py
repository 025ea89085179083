"""One batch at a time in an output folder.

A small file in the folder names the process that works there. The operating system locks it (flock), and lets go of it
when the process ends, however it ends: a lock whose process is gone never has to be guessed at on one machine.
Network file systems that do not pass locks on to other machines are why the file's time is renewed while the
process lives.
"""

import errno
import fcntl
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tscorr.errors import ConfigError, OutputError

log = logging.getLogger("tscorr")

LOCK = ".tscorr.lock"
RENEWED_S = 20.0
"""the holder renews the time of its file this often"""
ALIVE_S = 120.0
"""a file of another machine that is older than this belongs to nobody"""
NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}
"""what a file system says that cannot lock"""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold an output folder, which is made if it is missing.

    Raises OutputError naming the process that holds it, ConfigError where it cannot be written.
    """
    path = folder / LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _hold(path)
    except OSError as error:
        raise ConfigError(f"[output] directory = {folder} cannot be written: {error.strerror}") from None
    ended = threading.Event()
    renewal = threading.Thread(target=_renew, args=(descriptor, ended), daemon=True)
    try:
        renewal.start()
        yield
    finally:
        ended.set()
        if renewal.ident is not None:  # it was started
            renewal.join()
        with suppress(OSError):  # the folder may have become read-only; a file that nobody locks holds nobody up
            path.unlink()  # before the lock is let go: the next one then makes a file of its own
        os.close(descriptor)


def _hold(path: Path) -> int:
    """The open lock file, held and signed."""
    while True:
        descriptor, ours = os.open(path, os.O_RDWR | os.O_CREAT, 0o644), False
        try:
            _take(descriptor, path)
            ours = _is(descriptor, path)
            if ours:
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps(_myself()).encode(), 0)
                os.fsync(descriptor)  # a cluster's workers read it over the network
                return descriptor
        except BaseException:
            if ours:  # interrupted while it was signed
                path.unlink(missing_ok=True)
            os.close(descriptor)
            raise
        os.close(descriptor)  # its holder removed it while it was being opened


def _take(descriptor: int, path: Path) -> None:
    """Lock the file; OutputError where another process holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(f"{path.parent} is being written by {_who(_holder(descriptor))}: wait for its end") from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        log.warning("the file system of %s has no locks: see that no other batch writes there", path.parent)
    holder, age_s = _holder(descriptor), time.time() - os.fstat(descriptor).st_mtime
    if holder.get("host", socket.gethostname()) != socket.gethostname() and age_s < ALIVE_S:
        raise OutputError(
            f"{path.parent} is being written by {_who(holder)}, which gave a sign of life {age_s:.0f} s ago; if it "
            f"is gone, remove {path}, or wait until the last sign is {ALIVE_S:.0f} s old"
        )


def _is(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one of this name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _myself() -> dict[str, Any]:
    since = datetime.now(UTC).isoformat(timespec="seconds")
    return {"pid": os.getpid(), "host": socket.gethostname(), "since": since}


def _holder(descriptor: int) -> dict[str, Any]:
    """What the file says of its holder; nothing where it says nothing."""
    try:
        holder = json.loads(os.pread(descriptor, 4096, 0))
    except ValueError:
        return {}
    return holder if isinstance(holder, dict) else {}


def _who(holder: dict[str, Any]) -> str:
    pid, host, since = (holder.get(key, "?") for key in ("pid", "host", "since"))
    return f"another batch: process {pid} on {host}, since {since}"


def _renew(descriptor: int, ended: threading.Event) -> None:
    while not ended.wait(RENEWED_S):
        os.utime(descriptor)
