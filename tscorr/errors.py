"""What can go wrong, as a tree.

TscorrError
 ├── ConfigError      the settings ask for something that cannot be
 ├── MaterialError    a material or a material library is not usable
 ├── InputError       an input file or array is not what it should be
 └── OutputError      a result could not be written or published

Every message names the thing, its value, what is allowed, and the file.
"""

from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from typing import Any

LONGEST_LINE = 1000


class TscorrError(Exception):
    """Any error that tscorr raises on purpose; its text is fit for the user's eyes.

    Names and values from files stand in it: control characters are written out, and the middle of a line that
    is too long is left out.
    """

    def __init__(self, message: str) -> None:
        super().__init__("\n".join(_shortened(printable(line)) for line in message.splitlines()))


class ConfigError(TscorrError):
    """The settings ask for something that cannot be."""


class MaterialError(TscorrError):
    """A material or a material library is not usable."""


class InputError(TscorrError):
    """An input file or array is not what it should be."""


class OutputError(TscorrError):
    """A result could not be written or published."""


def printable(text: str) -> str:
    """A text with control characters written out: a terminal obeys some of them."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in text)


def _shortened(line: str) -> str:
    return line if len(line) <= LONGEST_LINE else f"{line[: LONGEST_LINE // 2]} ... {line[-LONGEST_LINE // 2 :]}"


Limits = Mapping[str, tuple[Callable[[Any], Any], str]]
"""by name, how to tell that a value is right, and in words what is allowed"""


def check_values(values: Mapping[str, Any], limits: Limits, error: type[TscorrError]) -> None:
    """Raise the error for the first of the values that is not right, or not even of the right type."""
    for name, (is_right, allowed) in limits.items():
        try:
            right = bool(is_right(values[name]))
        except (TypeError, ValueError, IndexError):
            right = False
        if not right:
            raise error(f"{name} = {values[name]!r}; allowed is {allowed}")


def nearest(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` for the known word most like `word`, or nothing where none is alike."""
    matches = get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{matches[0]}'?)" if matches else ""
