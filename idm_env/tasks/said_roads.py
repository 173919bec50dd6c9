"""What a user says of an open road: classes of drivers, tables of trips, speed limits, closed lanes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from idm_env.effects import Effect, LaneClosure, SpeedLimit
from idm_env.effects.road_rules import EVERY_LANE
from idm_env.model_file import nested
from idm_env.tasks import trip_table as table
from idm_env.tasks.checks import at_least
from idm_env.validation import one_of, shown

STANDS = 0.5
"""Below this speed (m/s) a vehicle stands."""
ALWAYS = 1e9
"""Since when and until when (s) where nothing is said."""


class DriverClass(NamedTuple):
    """A class of drivers: its share of those who enter, the length of its vehicles (m), what differs of parameters."""

    share: float
    length: float
    parameters: Mapping[str, Mapping[str, float]]


def classes_of(given: Mapping[str, Any] | None, usual: float) -> dict[str, DriverClass]:
    """Return the classes by name; ValueError, in one line, for what cannot be."""
    classes = {}
    for name, entry in (given or {}).items():
        if not isinstance(entry, Mapping):
            raise ValueError(f"classes.{name} = {shown(entry)} must give share, length (m) and parameters.")
        for key in entry:
            one_of(f"classes.{name}", key, ("share", "length", "parameters"))
        length = at_least(f"classes.{name}.length", entry.get("length", usual), 0.1, "m", 100.0)
        parameters = nested(entry.get("parameters") or {}, f"classes.{name}.parameters")
        classes[str(name)] = DriverClass(entry.get("share", 0.0), length, parameters)
    table.shares("classes", {name: x.share for name, x in classes.items()})
    return classes


def _stretch(where: str, entry: Any, keys: Sequence[str], lanes: int) -> tuple[float, float, float]:
    """Return lane (−1 for all), beginning and end (m) of what is said of a stretch."""
    if not isinstance(entry, Mapping):
        raise ValueError(f"{where} = {shown(entry)} must give {', '.join(keys)}.")
    for key in entry:
        one_of(where, key, keys)
    lane = entry.get("lane")
    if lane is not None and not (isinstance(lane, int) and not isinstance(lane, bool) and 0 <= lane < lanes):
        raise ValueError(f"{where}.lane = {shown(lane)} does not exist: this road has lanes 0 to {lanes - 1}.")
    begin = at_least(f"{where}.begin", entry.get("begin", 0.0), 0.0, "m", 1e6)
    end = at_least(f"{where}.end", entry.get("end", 1e6), 0.0, "m", 1e6)
    return float(EVERY_LANE if lane is None else lane), begin, end


class Loop(NamedTuple):
    """A detector: a loop across a lane at a place (m), which tells of every so many seconds."""

    name: str
    lane: int
    place: float
    every: float


def loops_of(detectors: Any, lanes: int, length: float, dt: float) -> tuple[Loop, ...]:
    """Return detectors; ValueError, in one line, for what cannot be."""
    loops = []
    for i, detector in enumerate(detectors):
        where = f"detectors[{i}]"
        lane = int(_stretch(where, detector, ("lane", "place", "every", "name"), lanes)[0])
        if lane == EVERY_LANE or "place" not in detector:
            raise ValueError(f"{where} = {shown(detector)} must give lane and place (m).")
        place = at_least(f"{where}.place", detector["place"], 0.1, "m", length)
        every = at_least(f"{where}.every", detector.get("every", 30.0), dt, "s", 1e6)
        if abs(every / dt - round(every / dt)) > 1e-6:
            raise ValueError(f"{where}.every = {every:g} s must be whole steps of {dt:g} s.")
        loops.append(Loop(str(detector.get("name", f"lane {lane} at {place:g} m")), lane, place, every))
    return tuple(loops)


def rules_of(limits: Any, closures: Any, lanes: int) -> tuple[Effect, ...]:
    """Return the effects of speed limits and closed lanes; ValueError, in one line, for what cannot be."""
    rules: list[Effect] = []
    zones = []
    for i, entry in enumerate(limits):
        where = _stretch(f"limits[{i}]", entry, ("lane", "begin", "end", "speed"), lanes)
        if "speed" not in entry:
            raise ValueError(f"limits[{i}] has no speed (m/s).")
        zones.append((*where, at_least(f"limits[{i}].speed", entry["speed"], 0.1, "m/s", 100.0)))
    if zones:
        rules.append(SpeedLimit(zones=tuple(zones)))
    rows = []
    for i, entry in enumerate(closures):
        where = _stretch(f"closures[{i}]", entry, ("lane", "begin", "end", "since", "until"), lanes)
        if where[0] == EVERY_LANE:
            raise ValueError(f"closures[{i}] must name one lane.")
        since, until = (float(entry.get(name, usual)) for name, usual in (("since", -ALWAYS), ("until", ALWAYS)))
        rows.append((*where, since, until))
    _leaves_a_way(rows, lanes)
    if rows:
        rules.append(LaneClosure(closures=tuple(rows)))
    return tuple(rules)


def _leaves_a_way(rows: Sequence[tuple[float, ...]], lanes: int) -> None:
    """Raise ValueError where all lanes are closed at one place and time."""
    for _, place, _, _, _ in rows:
        for _, _, _, time, _ in rows:
            shut = {k for k, a, b, since, until in rows if a <= place < b and since <= time < until}
            if len(shut) >= lanes:
                raise ValueError(
                    f"closures: all {lanes} lanes are closed at {place:g} m at {max(time, 0.0):g} s. Leave one open."
                )


def lengths(kinds: Sequence[str], classes: Mapping[str, DriverClass], usual: float) -> list[float]:
    """Return the length (m) of every slot's vehicle."""
    return [classes[kind].length if kind else usual for kind in kinds]


def with_classes(
    values: dict[str, dict[str, Tensor]], kinds: Sequence[str], classes: Mapping[str, DriverClass],
    factors: Mapping[tuple[str, str], Tensor],
) -> dict[str, dict[str, Tensor]]:  # fmt: skip
    """Return the parameters in which those of a class have its numbers, times a factor for each vehicle, if any.

    ValueError for a parameter that is not there.
    """
    result = {effect: dict(part) for effect, part in values.items()}
    for name, group in classes.items():
        mine = torch.tensor([kind == name for kind in kinds])
        for effect, part in group.parameters.items():
            for parameter, number in part.items():
                old = result.get(effect, {}).get(parameter)
                if old is None:
                    raise ValueError(f"classes.{name}: parameter '{effect}.{parameter}' does not exist here.")
                new = torch.full((len(kinds),), float(number), dtype=old.dtype, device=old.device)
                new = new * factors.get((effect, parameter), 1.0)
                result[effect][parameter] = torch.where(mine.to(old.device), new, old)
    return result
