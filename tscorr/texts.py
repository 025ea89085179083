"""Small text files from outside: whole, of a size that fits into memory, and UTF-8."""

from pathlib import Path

from tscorr.errors import InputError, TscorrError

LARGEST_TEXT_BYTES = 100e6


def separator(heading: str) -> str:
    """What stands between the cells of a CSV with this line of names: some spreadsheets write semicolons."""
    return ";" if ";" in heading else ","


def read_text(path: Path, what: str, error: type[TscorrError] = InputError) -> str:
    """The text of a file without a byte order mark; `what` it is and `error` are for messages.

    A pipe or a device is no file: it may never end.
    """
    try:
        if path.exists() and not path.is_file():
            raise error(f"the {what} {path} is no file; allowed is a text")
        if (size := path.stat().st_size) > LARGEST_TEXT_BYTES:
            raise error(f"the {what} {path} has {size / 1e6:.0f} MB; allowed are {LARGEST_TEXT_BYTES / 1e6:.0f} MB")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as reason:
        raise error(f"the {what} {path} cannot be read: {reason}") from None
