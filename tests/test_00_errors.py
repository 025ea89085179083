"""The error tree and the hint at a misspelt word."""

import inspect

import pytest

from tscorr import errors
from tscorr.errors import TscorrError, nearest

ERRORS = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, Exception)]


@pytest.mark.parametrize("kind", ERRORS, ids=lambda kind: kind.__name__)
def test_every_error_is_in_the_tree_and_in_its_drawing(kind):
    assert issubclass(kind, TscorrError)
    assert kind.__name__ in errors.__doc__
    assert str(kind("w = -1; allowed is 0 or more")) == "w = -1; allowed is 0 or more"


@pytest.mark.parametrize(
    ("word", "hint"),
    [("rooftile", " (did you mean 'roof_tile'?)"), ("Red_concrete", " (did you mean 'red_concrete'?)"), ("zzz", "")],
)
def test_nearest_names_the_word_most_alike(word, hint):
    assert nearest(word, ["roof_tile", "red_concrete"]) == hint


def test_nearest_takes_any_iterable_and_none():
    assert nearest("phi", iter(("phy", "theta"))) == " (did you mean 'phy'?)"
    assert nearest("phi", ()) == ""
