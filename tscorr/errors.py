"""What can go wrong, as a tree.

TscorrError
 ├── ConfigError      the settings ask for something that cannot be
 ├── MaterialError    a material or a material library is not usable
 ├── InputError       an input file or array is not what it should be
 └── OutputError      a result could not be written or published

Every message names the thing, its value, what is allowed, and the file.
"""

from collections.abc import Iterable
from difflib import get_close_matches


class TscorrError(Exception):
    """Any error that tscorr raises on purpose; its text is fit for the user's eyes."""


class ConfigError(TscorrError):
    """The settings ask for something that cannot be."""


class MaterialError(TscorrError):
    """A material or a material library is not usable."""


class InputError(TscorrError):
    """An input file or array is not what it should be."""


class OutputError(TscorrError):
    """A result could not be written or published."""


def nearest(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` for the known word most like `word`, or nothing where none is alike."""
    matches = get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{matches[0]}'?)" if matches else ""
