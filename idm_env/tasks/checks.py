"""Checks of tasks' keyword arguments: one line that names the value, the rule and the cure."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from os import PathLike
from typing import Any, NamedTuple, TypeVar

from idm_env.effects import registry
from idm_env.jobs import trust
from idm_env.model_file import nested
from idm_env.validation import at_least, finite, nearest, shown, whole

T = TypeVar("T")
_WEAKEST, _STRONGEST = 1e-3, 100.0


class Range(NamedTuple):
    """Where an option of a task may lie, ends included, in its unit; a whole number, one number, two ends, or several.

    Above are values for which nobody has a use, and that would take time and memory without an end.
    """

    low: float
    high: float
    unit: str = ""
    whole: bool = False
    ends: bool = False
    several: bool = False

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError, in one line, for what lies outside or is no such number."""
        if self.several and isinstance(value, Sequence) and not isinstance(value, str | bytes):
            for i, one in enumerate(value):
                at_least(f"{name}[{i}]", one, self.low, self.unit, self.high)
        elif self.whole:
            whole(name, value, int(self.low), int(self.high))
        elif self.ends:
            span(name, value, self.low, self.unit, self.high)
        else:
            at_least(name, value, self.low, self.unit, self.high)


FLOW = Range(1.0, 1e5, "vehicles an hour")


class Key(NamedTuple):
    """What one key of a nested keyword takes, a range or a check, and its usual value.

    Without a ``usual`` value it must be given. None stands for what the road decides, where that is usual.
    """

    kind: Range | Callable[[str, Any], object]
    usual: Any = ...


def _listed(keys: Mapping[str, Key]) -> str:
    """Return the names of keys with their units, as a sentence lists them."""
    units = {name: key.kind.unit for name, key in keys.items() if isinstance(key.kind, Range) and key.kind.unit}
    return " and ".join(", ".join(f"{x} ({units[x]})" if x in units else x for x in keys).rsplit(", ", 1))


def entry(where: str, given: Any, keys: Mapping[str, Key]) -> dict[str, Any]:
    """Return the values of a nested keyword, with the usual ones of keys that are left out.

    ValueError, in one line, for no mapping, an unknown or a missing key, and a value of a wrong type or out of range.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} = {shown(given)} must be a mapping of {_listed(keys)}.")
    if strange := [name for name in given if name not in keys]:
        like = nearest(shown(strange[0]).strip("'"), keys)
        raise ValueError(f"{where} has an unknown key {shown(strange[0])}.{like}")
    needed = {name: key for name, key in keys.items() if key.usual is ...}
    if needed.keys() - given.keys():
        raise ValueError(f"{where} = {shown(given)} must give {_listed(needed)}.")
    values = {name: given.get(name, key.usual) for name, key in keys.items()}
    for name, (kind, usual) in keys.items():
        if not (values[name] is None and usual is None):
            (kind.check if isinstance(kind, Range) else kind)(f"{where}.{name}", values[name])
    return values


def entries(where: str, given: Any, keys: Mapping[str, Key]) -> list[tuple[str, dict[str, Any]]]:
    """Return the name and the values of every entry of a list, as ``entry`` does. ValueError for no list of such."""
    if not isinstance(given, Sequence) or isinstance(given, str | bytes):
        raise ValueError(f"{where} = {shown(given)} must be a list of mappings of {_listed(keys)}.")
    return [(f"{where}[{i}]", entry(f"{where}[{i}]", one, keys)) for i, one in enumerate(given)]


def text(where: str, value: Any) -> str:
    """Return a text that is not empty. ValueError, in one line, for anything else."""
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{where} = {shown(value)} must be a text that is not empty.")
    return value


def by_name(where: str, given: Any) -> dict[str, Any]:
    """Return a mapping from names. ValueError, in one line, for anything else."""
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} = {shown(given)} must be a mapping from names.")
    return {text(f"{where}: a name", name): value for name, value in given.items()}


def ranges(task: type) -> dict[str, Range]:
    """Return the ranges of all options of a kind of task: its own ``ranges``, and those of what it inherits."""
    return {name: x for kind in reversed(task.__mro__) for name, x in vars(kind).get("ranges", {}).items()}


def in_ranges(task: Any) -> None:
    """Raise ValueError, in one line, for an option that lies outside its range, or for no truth value where one is due.

    None stands for what the task decides, where that is an option's default.
    """
    by_name = ranges(type(task))
    for field in dataclasses.fields(task):
        value = getattr(task, field.name)
        if isinstance(field.default, bool) and not isinstance(value, bool):
            raise ValueError(f"{field.name} = {shown(value)} must be True or False.")
        if field.type in ("str | None", str | None) and not isinstance(value, str | PathLike | None):
            raise ValueError(f"{field.name} = {shown(value)} must be a text.")
        if field.name in by_name and not (value is None and field.default is None):
            by_name[field.name].check(field.name, value)
            if isinstance(value, Real) and not isinstance(value, (int, float)):  # a fraction, or numpy's
                object.__setattr__(task, field.name, int(value) if isinstance(value, Integral) else float(value))


def only_with(task: Any, reward: str, names: Sequence[str]) -> None:
    """Raise ValueError for keywords that differ from their defaults and weigh terms of another reward than is paid."""
    default = {field.name: field.default for field in dataclasses.fields(task)}
    for name in names:
        if getattr(task, name) != default[name] and task.reward != reward:
            raise ValueError(
                f"{name} = {shown(getattr(task, name))} weighs a term of reward = '{reward}', and reward = "
                f"{shown(task.reward)}. Give reward='{reward}', or leave {name} out."
            )


class KeywordError(TypeError, ValueError):
    """A keyword that does not exist: a TypeError as for any call, and a ValueError as for any value of a YAML file."""


def span(name: str, value: Any, low: float, unit: str, high: float = math.inf) -> tuple[float, float]:
    """Return a range from one number or from ``[lowest, highest]``. ValueError for anything else."""
    ends = list(value) if isinstance(value, Sequence) and not isinstance(value, str | bytes) else [value, value]
    suffix = f" ({unit})" if unit else ""
    if len(ends) != 2:
        raise ValueError(f"{name} = {shown(value)} must be one number or [lowest, highest]{suffix}.")
    first, last = (at_least(name, end, low, unit, high) for end in ends)
    if first > last:
        raise ValueError(f"{name} = {shown(value)} must rise: write [{last:g}, {first:g}]{suffix}.")
    return first, last


def ranges_of(randomise: Mapping[str, Any] | None) -> dict[str, tuple[float, float]]:
    """Return what episodes draw parameters from, by full name. ValueError for what is no range."""
    parts = nested({} if randomise is None else randomise, "randomise").items()
    return {f"{e}.{name}": two_ends(f"randomise.{e}.{name}", x) for e, part in parts for name, x in part.items()}


def two_ends(name: str, value: Any) -> tuple[float, float]:
    """Return the ends of a range ``[lowest, highest]``. ValueError for anything else."""
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        raise ValueError(f"{name} = {shown(value)} must be [lowest, highest].")
    return span(name, value, -math.inf, "")


def limits_of(max_command: Any) -> tuple[float, float]:
    """Return the accelerations (m/s²) that actions of −1 and 1 command, from one number or from both.

    ValueError for limits that do not hold 0.
    """
    if isinstance(max_command, Sequence) and not isinstance(max_command, str | bytes):
        ends = [finite("max_command", x, "m/s²") for x in max_command]
        if len(ends) != 2 or not (-_STRONGEST <= ends[0] <= -_WEAKEST and _WEAKEST <= ends[1] <= _STRONGEST):
            raise ValueError(
                f"max_command = {shown(list(max_command))} must be one number, or [hardest braking, strongest "
                f"acceleration] (m/s²), such as [-4.5, 2.6], none beyond {_STRONGEST:g}."
            )
        return ends[0], ends[1]
    top = at_least("max_command", max_command, _WEAKEST, "m/s²", _STRONGEST)
    return -top, top


def count_of(controlled: Any, free: int) -> int:
    """Return how many of ``free`` vehicles ``"all"``, a fraction (0 to 1, at least one vehicle) or a number means.

    ValueError for anything else.
    """
    if isinstance(controlled, str) and controlled == "all":
        return max(1, free)
    if isinstance(controlled, Integral):
        return whole("controlled", controlled, 1)
    if not isinstance(controlled, Real) or not 0.0 < float(controlled) <= 1.0:
        raise ValueError(f"controlled = {shown(controlled)} must be 'all', a number, a fraction up to 1 or a list.")
    return max(1, round(float(controlled) * free))


def agents_of(controlled: Any, vehicles: int, first: int) -> tuple[int, ...]:
    """Return the indices of the controlled vehicles: spread evenly for what ``count_of`` takes, as given for a list.

    ValueError for vehicles that cannot be controlled, none, or one given twice.
    """
    free = vehicles - first
    if isinstance(controlled, Sequence) and not isinstance(controlled, str | bytes):
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
            f"controlled = {shown(count)} exceeds the {free} vehicles that can be controlled of {vehicles}. "
            "Control fewer or take more vehicles."
        )
    return tuple(first + i * free // count for i in range(count))


def one_declared(entry: object, kind: type[T], known: Mapping[str, T], where: str) -> T:
    """Resolve an entry: an instance of ``kind``, a name of the catalogue, or ``file.py:name``.

    ValueError, in one line, for an unknown name, and for the place of code that is not trusted or has no such thing.
    """
    if isinstance(entry, kind):
        return entry
    if not isinstance(entry, str) or ":" not in entry:
        if isinstance(entry, str) and entry in known:
            return known[entry]
        raise ValueError(f"{where}: {shown(entry)} is unknown.{nearest(str(entry), known)}")
    place = entry.rpartition(":")[0]
    if registry.module_at(place) is None and not trust.permission():
        raise ValueError(
            f"{where}: {shown(entry)} is code of {shown(place)}, which is not run unasked. Read it, then give --trust, "
            f"trusted=True in Python, or {trust.VARIABLE}=1."
        )
    member = registry.member(entry, where)[1]
    if not isinstance(member, kind):
        raise ValueError(f"{where}: {shown(entry)} is no {kind.__name__}. Name one that the file declares.")
    return member
