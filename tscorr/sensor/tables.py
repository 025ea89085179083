"""Tables of positions: CSV whose columns have names."""

import csv
import io
from pathlib import Path

import numpy as np

from tscorr.errors import InputError
from tscorr.texts import read_text, separator

Rows = list[tuple[int, dict[str, str]]]


def read_columns(path: Path, needed: tuple[str, ...], what: str) -> tuple[Rows, list[str]]:
    """Rows by column with their line numbers, and the names of all columns, in lower case.

    Cells may be apart by semicolons too, as some spreadsheets write them.
    Raises InputError where the file cannot be read or lacks a column that is needed.
    """
    text = read_text(path, what)
    reader = csv.DictReader(io.StringIO(text), delimiter=separator(text.partition("\n")[0]))
    try:
        names = [name.strip().lower() for name in reader.fieldnames or []]
        reader.fieldnames = names
        rows = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise InputError(f"the {what} {path} cannot be read: {error}") from None
    missing = [name for name in needed if name not in names]
    if missing:
        raise InputError(f"{path} lacks the column {missing[0]}; it has {', '.join(names)}")
    return rows, names


def number(text: str | None, key: str, path: Path, line: int) -> float:
    """The number of a cell; raises InputError naming file, line and value where it is none."""
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{path} line {line}: {key} = {text!r}; allowed is a number")
    return value
