"""What the commands share: one way to fail, arguments that several take, tables on the terminal."""

import functools
import gc
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from tscorr.errors import ConfigError, OutputError, TscorrError, printable

BAD_USAGE = 2
SIGNALLED = 128
"""exit code of a stop by signal, less the number of the signal"""


PICTURES = ".png", ".svg", ".pdf"


def can_be_written(option: str, path: Path | None, suffixes: Sequence[str] = ()) -> None:
    """Raise OutputError, before any work, where a file to be written has no folder or a suffix that is not allowed."""
    if path is None:
        return
    if suffixes and path.suffix.lower() not in suffixes:
        raise OutputError(f"{option} {path} cannot be written; allowed are files that end in {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise OutputError(f"{option} {path} cannot be written: {path.parent} is not a folder")


class Stopped(KeyboardInterrupt):
    """SIGTERM: a polite kill, after which everything is cleared up as after Ctrl-C."""


@contextmanager
def stoppable() -> Iterator[None]:
    """SIGTERM raises `Stopped` meanwhile."""

    def stop(*_: object) -> None:
        raise Stopped

    if threading.current_thread() is not threading.main_thread():  # which is the only one that hears signals
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def warnings_told() -> Iterator[None]:
    """Warnings on stderr, and nothing less, whatever a program that calls this one does with its log."""
    console = logging.StreamHandler(sys.stderr)
    console.setLevel(logging.WARNING)
    console.setFormatter(logging.Formatter("tscorr: %(message)s"))
    log = logging.getLogger("tscorr")
    log.addHandler(console)
    before, log.propagate = log.propagate, False
    try:
        yield
    finally:
        log.propagate = before
        log.removeHandler(console)


def with_clear_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command whose errors are one message on stderr and an exit code."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            with stoppable(), warnings_told():
                return command(*args, **kwargs)
        except TscorrError as error:
            for line in str(error).splitlines():
                click.echo(f"tscorr: {line}", err=True)
            sys.exit(BAD_USAGE)
        except KeyboardInterrupt as error:
            number = signal.SIGTERM if isinstance(error, Stopped) else signal.SIGINT
            what = "terminated" if number == signal.SIGTERM else "interrupted"
            rest = "with --overwrite again" if kwargs.get("overwrite") else "the rest is done by the next run"
            click.echo(f"tscorr: {what}; what was finished stays, {rest}", err=True)
            sys.exit(SIGNALLED + number)

    return wrapped


COMPILING = "tscorr: compiling what no run on this machine has needed before: up to half a minute"


@contextmanager
def compilation_told(*, enabled: bool = True) -> Iterator[None]:
    """One line on stderr when the first function is compiled; what an earlier run has compiled is not.

    From then on the garbage collector leaves alone what there was: the modules, which stay, and which it would search
    again and again while numba makes its many objects, for a fifth of the time. Afterwards it has them back: what it
    never sees again OpenImageIO takes for lost when Python ends, and says so in forty lines.
    """
    from numba.core.event import RecordingListener, install_listener

    class Teller(RecordingListener):  # type: ignore[misc] # numba has no types
        def on_start(self, event: object) -> None:
            if not self.buffer:
                gc.freeze()
                if enabled:
                    click.echo(COMPILING, err=True)
            super().on_start(event)

    try:
        with install_listener("numba:compile", Teller()):
            yield
    finally:
        gc.unfreeze()


config_argument = click.argument("config", type=click.Path(exists=True, dir_okay=False, path_type=Path))
form_option = click.option(
    "--form", type=click.Choice(["full", "simplified"]), default="full", help="simplified: without the factor G."
)
library_option = click.option(
    "--library",
    "libraries",
    multiple=True,
    metavar="FILE",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Another material file.",
)


def without_log_of_rubbish(fault: Any) -> None:
    """Python's report of a fault that cannot be raised, but for one: GDAL quotes the rubbish of a broken file.

    rasterio's log cannot decode that; the error itself is raised and told.
    """
    if fault.object != "rasterio._env.log_error":
        sys.__unraisablehook__(fault)


def percent(share: float | None) -> str:
    """A share as text."""
    if share is None:
        return "-"
    return f"{100 * share:.1f} %"


def print_table(rows: Sequence[Sequence[str]], left: int = 2) -> None:
    """Columns side by side, the first `left` to the left, numbers to the right."""
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        cells = [
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        click.echo("  ".join(cells).rstrip())


def number(option: str, text: str, allowed: str) -> float:
    """The number that an option was given as text."""
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{option} = {text!r}; allowed is {allowed}") from None
