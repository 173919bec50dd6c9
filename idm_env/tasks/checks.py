"""Checks of tasks' keyword arguments: one line that names the value, the rule and the cure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from idm_env.checks import at_least, finite, shown, whole
from idm_env.config import nested

__all__ = ["KeywordError", "agents_of", "at_least", "limits_of", "span", "whole"]

_WEAKEST = 1e-3


class KeywordError(TypeError, ValueError):
    """A keyword that does not exist: a TypeError as for any call, and a ValueError as for any value of a YAML file."""


def span(name: str, value: Any, low: float, unit: str) -> tuple[float, float]:
    """Return a range from one number or from ``[lowest, highest]``."""
    ends = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value, value]
    told = f" ({unit})" if unit else ""
    if len(ends) != 2:
        raise ValueError(f"{name} = {shown(value)} must be one number or [lowest, highest]{told}.")
    first, last = (at_least(name, end, low, unit) for end in ends)
    if first > last:
        raise ValueError(f"{name} = {shown(value)} must rise: write [{last:g}, {first:g}]{told}.")
    return first, last


def ranges_of(randomise: Mapping[str, Any] | None) -> dict[tuple[str, str], tuple[float, float]]:
    """Return what episodes draw parameters from, by effect and name."""
    found = {}
    for effect, part in nested(randomise or {}, "randomise").items():
        for name, value in part.items():
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise ValueError(f"randomise.{effect}.{name} = {shown(value)} must be [lowest, highest].")
            found[effect, name] = span(f"randomise.{effect}.{name}", value, -math.inf, "")
    return found


def limits_of(max_command: Any) -> tuple[float, float]:
    """Return the accelerations (m/s²) that actions of −1 and 1 command, from one number or from both."""
    if isinstance(max_command, Sequence) and not isinstance(max_command, str):
        ends = [finite("max_command", x, "m/s²") for x in max_command]
        if len(ends) != 2 or ends[0] > -_WEAKEST or ends[1] < _WEAKEST:
            raise ValueError(
                f"max_command = {shown(list(max_command))} must be one number, or [hardest braking, strongest "
                "acceleration] with a braking below 0 and an acceleration above 0, such as [-4.5, 2.6] (m/s²)."
            )
        return ends[0], ends[1]
    top = at_least("max_command", max_command, _WEAKEST, "m/s²")
    return -top, top


def count_of(controlled: Any, free: int) -> int:
    """Return how many of ``free`` vehicles ``"all"``, a fraction (0 to 1, at least one vehicle) or a number means."""
    if controlled == "all":
        return max(1, free)
    if isinstance(controlled, float):
        if not 0.0 < controlled <= 1.0:
            raise ValueError(f"controlled = {controlled} must be a fraction above 0 and up to 1, a number, or 'all'.")
        return max(1, round(controlled * free))
    if isinstance(controlled, str):
        raise ValueError(f"controlled = {shown(controlled)} must be 'all', a number, a fraction or a list of vehicles.")
    return whole("controlled", controlled, 1)


def agents_of(controlled: Any, vehicles: int, first: int) -> tuple[int, ...]:
    """Return the indices of the controlled vehicles: spread evenly for what ``count_of`` takes, as given for a list."""
    free = vehicles - first
    if isinstance(controlled, Sequence) and not isinstance(controlled, str):
        chosen = tuple(sorted(whole("controlled", i, 0) for i in controlled))
        if not chosen or len(set(chosen)) < len(chosen):
            raise ValueError(f"controlled = {shown(list(controlled))} must name at least one vehicle, and none twice.")
        if chosen[0] < first or chosen[-1] >= vehicles:
            raise ValueError(
                f"controlled = {shown(list(controlled))} must lie in {first} … {vehicles - 1}; lower ones are recorded."
            )
        return chosen
    count = count_of(controlled, free)
    if count > free:
        raise ValueError(
            f"controlled = {count} exceeds the {free} vehicles that can be controlled of {vehicles}. "
            "Control fewer or take more vehicles."
        )
    return tuple(first + i * free // count for i in range(count))
