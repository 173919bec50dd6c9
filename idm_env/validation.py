"""Checks of users' values, numbers first: one line that names the value, the rule and the cure."""

import difflib
import math
import numbers
import reprlib
from collections.abc import Iterable
from typing import Any

MOST_LISTED = 12
"""Words that an error lists; of more it names those that are nearest."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 2
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60


def shown(value: Any) -> str:
    """Return a value as an error text may show it: never longer than a line, whatever it is."""
    try:
        return " ".join(_SHORT.repr(value).split("\n"))
    except (ValueError, RecursionError):  # Python writes no whole number of more than 4300 digits
        return f"a very large {type(value).__name__}"


def nearest(word: str, words: Iterable[str]) -> str:
    """Return ' Did you mean …?' for the nearest known word; when none is near, all words, or the best of many."""
    words, word = list(dict.fromkeys(words)), word[:200]
    # A name cut short is nearer than one misspelled.
    longer = [k for k in words if len(word) > 2 and k.startswith(word)]
    close = longer if len(longer) == 1 else difflib.get_close_matches(word, words, n=1, cutoff=0.5)
    if not close and "." in word:
        close = difflib.get_close_matches(word.split(".")[-1], [k.split(".")[-1] for k in words], n=1, cutoff=0.4)
        close = [k for k in words if close and k.split(".")[-1] == close[0]][:1]
    if close:
        return f" Did you mean '{close[0]}'?"
    if len(words) > MOST_LISTED:
        like = difflib.get_close_matches(word, words, n=MOST_LISTED // 2, cutoff=0.0)
        return f" Of {len(words)} known ones the nearest are {', '.join(like)}."
    return f" Known: {', '.join(sorted(words)) or 'none'}."


def one_of(name: str, value: Any, words: Iterable[str]) -> str:
    """Return a value that is one of some words. ValueError for any other."""
    words = list(words)
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{name} = {shown(value)} is unknown.{nearest(str(shown(value)).strip(chr(39)), words)}")
    return value


def whole(name: str, value: Any, low: int, high: int | None = None) -> int:
    """Return a whole number of at least ``low``, and at most ``high``. ValueError for any other."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise ValueError(f"{name} = {shown(value)} must be a whole number.")
    number = int(value)
    if number < low:
        raise ValueError(f"{name} = {shown(value)} must be at least {low}.")
    if high is not None and number > high:
        raise ValueError(f"{name} = {shown(value)} must be at most {high}.")
    return number


def finite(name: str, value: Any, unit: str = "") -> float:
    """Return a finite number. ValueError for any other."""
    try:
        if not isinstance(value, bool) and isinstance(value, numbers.Real) and math.isfinite(value):
            return float(value)
    except OverflowError:  # a whole number beyond 1e308
        pass
    raise ValueError(f"{name} = {shown(value)} must be a finite number{' of ' + unit if unit else ''}.")


def at_least(name: str, value: Any, low: float, unit: str = "", high: float = math.inf) -> float:
    """Return a finite number of at least ``low``, and at most ``high``. ValueError for any other."""
    number = finite(name, value, unit)
    if not low <= number <= high:
        bound = f"at least {low:g}" if number < low else f"at most {high:g}"
        raise ValueError(f"{name} = {number:g}{' ' + unit if unit else ''} must be {bound}.")
    return number


def in_interval(name: str, value: Any, low: float, high: float, unit: str = "") -> float:
    """Return a number in ``[low, high]``; only a bound that is infinite lets an infinite number through.

    ValueError for any other.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        unit = f" {unit}" if unit else ""
        number = f"{value:g}" if isinstance(value, float) else shown(value)
        raise ValueError(f"{name} = {number}{unit} is outside [{low:g}, {high:g}]{unit}.")
    return float(value)
