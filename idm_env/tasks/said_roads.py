"""What a user says of an open road: classes of drivers, tables of trips, speed limits, closed lanes."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from idm_env.effects import Effect, LaneClosure, SpeedLimit
from idm_env.effects.road_rules import EVERY_LANE
from idm_env.model_file import numbers
from idm_env.roads import Lanes
from idm_env.roads.layout import ENDLESS, WHERE
from idm_env.tasks import trip_table as table
from idm_env.tasks.checks import Key, Range, by_name, entries, entry, text
from idm_env.validation import at_least

STANDS = 0.5
"""Below this speed (m/s) a vehicle stands."""
ALWAYS = 1e9
"""Since when and until when (s) where nothing is said."""


_LANE, _PLACE, _TIME = Range(0, 1000, whole=True), Range(0.0, 1e6, "m"), Range(-ALWAYS, ALWAYS, "s")
_WHERE = {"lane": Key(_LANE), "begin": Key(_PLACE, 0.0), "end": Key(_PLACE, None)}
_LENGTH, _EVERY = Range(0.1, 100.0, "m"), Range(1e-3, 1e6, "s")
KEYS: Mapping[str, Mapping[str, Key]] = {
    "classes": {"share": Key(Range(0.0, 1.0), 0.0), "length": Key(_LENGTH, None), "parameters": Key(by_name, None)},
    "limits": {**_WHERE, "lane": Key(_LANE, None), "speed": Key(Range(0.1, 100.0, "m/s"))},
    "closures": {**_WHERE, "since": Key(_TIME, -ALWAYS), "until": Key(_TIME, ALWAYS)},
    "detectors": {"lane": Key(_LANE), "place": Key(_PLACE), "every": Key(_EVERY, 30.0), "name": Key(text, None)},
}
"""What the keys of nested keywords take; a road's own bounds are narrower."""


class DriverClass(NamedTuple):
    """A class of drivers: its share of those who enter, the length of its vehicles (m), what differs of parameters."""

    share: float
    length: float
    parameters: Mapping[str, Mapping[str, float]]


def classes_of(given: Mapping[str, Any] | None, usual: float) -> dict[str, DriverClass]:
    """Return the classes by name; ValueError, in one line, for what cannot be."""
    classes = {}
    for name, value in by_name("classes", {} if given is None else given).items():
        share, length, parameters = entry(f"classes.{name}", value, KEYS["classes"]).values()
        own = numbers(parameters or {}, f"classes.{name}.parameters")
        classes[name] = DriverClass(share, usual if length is None else length, own)
    table.shares("classes", {name: x.share for name, x in classes.items()})
    return classes


def _lane(where: str, values: Mapping[str, Any], road: Lanes) -> float:
    """Return a lane, −1 for all. ValueError for one that the road does not have."""
    lane = values["lane"]
    if lane is not None and lane >= road.count:
        raise ValueError(f"{where}.lane = {lane} does not exist: this road has lanes 0 to {road.count - 1}.")
    return float(EVERY_LANE if lane is None else lane)


def _stretch(where: str, values: Mapping[str, Any], road: Lanes) -> tuple[float, float, float]:
    """Return lane (−1 for all), beginning and end (m) of a stretch. ValueError for one that is not on the road."""
    length = road.length or ENDLESS
    begin = at_least(f"{where}.begin", values["begin"], 0.0, "m", length)
    end = length if values["end"] is None else at_least(f"{where}.end", values["end"], 0.0, "m", length)
    if not begin < end:
        raise ValueError(f"{where} from {begin:g} m to {end:g} m must end behind its beginning.")
    return _lane(where, values, road), begin, 1e6 if values["end"] is None else end


class Loop(NamedTuple):
    """A detector: a loop across a lane at a place (m), which tells of every so many seconds."""

    name: str
    lane: int
    place: float
    every: float


def loops_of(detectors: Any, road: Lanes, dt: float) -> tuple[Loop, ...]:
    """Return detectors; ValueError, in one line, for what cannot be."""
    loops = []
    for where, values in entries("detectors", detectors, KEYS["detectors"]):
        lane = int(_lane(where, values, road))
        place = at_least(f"{where}.place", values["place"], 0.1, "m", road.length or ENDLESS)
        every = at_least(f"{where}.every", values["every"], dt, "s")
        if abs(every / dt - round(every / dt)) > 1e-6:
            raise ValueError(f"{where}.every = {every:g} s must be whole steps of {dt:g} s.")
        loops.append(Loop(values["name"] or f"lane {lane} at {place:g} m", lane, place, every))
    return tuple(loops)


def rules_of(limits: Any, closures: Any, road: Lanes) -> tuple[Effect, ...]:
    """Return the effects of speed limits and closed lanes; ValueError, in one line, for what cannot be."""
    zones, rows = list[tuple[float, ...]](), list[tuple[float, ...]]()
    for where, values in entries("limits", limits, KEYS["limits"]):
        zones.append((*_stretch(where, values, road), float(values["speed"])))
    for where, values in entries("closures", closures, KEYS["closures"]):
        since, until = float(values["since"]), float(values["until"])
        if not since < until:
            raise ValueError(f"{where} from {since:g} s to {until:g} s must end after its beginning.")
        rows.append((*_stretch(where, values, road), since, until))
    for time in sorted({row[3] for row in rows}):
        _leaves_a_way([row[:3] for row in rows if row[3] <= time < row[4]], road, time)
    rules = (SpeedLimit(zones=tuple(zones)), LaneClosure(closures=tuple(rows)))
    return tuple(rule for rule, needed in zip(rules, (zones, rows), strict=True) if needed)


def _leaves_a_way(closed: Sequence[tuple[float, ...]], road: Lanes, time: float) -> None:
    """Raise ValueError where nobody comes from the beginning of the road to an end of it, at a time (s).

    Lane by lane and from place to place (m) where something changes: who is on lanes that go on, and may change to one.
    """
    table = {name: road.table(name) for name in WHERE}
    begins, opens, closes, stops, leaves = table.values()
    places = {x for column in (*table.values(), *(row[1:] for row in closed)) for x in column if x > 0.0}
    reached = {k for k in range(road.count) if begins[k] <= 0.0}
    for place in sorted({0.0, *places}):
        if any(place >= leaves[k] for k in reached):
            return
        lanes = {k for k in range(road.count) if begins[k] <= place < stops[k]}
        lanes -= {int(k) for k, begin, end in closed if begin <= place < end}
        sideways = {k for k in lanes if opens[k] <= place < closes[k]}
        reached &= lanes
        for k in (*sorted(sideways), *sorted(sideways, reverse=True)):  # one way, and back
            if {k - 1, k + 1} & reached & sideways:
                reached.add(k)
        if not reached:
            raise ValueError(f"closures: nobody gets past {place:g} m at {max(time, 0.0):g} s. Leave a way on.")


def with_classes(
    values: dict[str, dict[str, Tensor]],
    kinds: Sequence[str],
    classes: Mapping[str, DriverClass],
    factors: Mapping[str, Tensor],
) -> dict[str, dict[str, Tensor]]:
    """Return the parameters in which those of a class have its numbers, times a factor for each vehicle, if any.

    ``factors`` are by full name. ValueError for a parameter that is not there.
    """
    result = {effect: dict(part) for effect, part in values.items()}
    for name, group in classes.items():
        mine = torch.tensor([kind == name for kind in kinds])
        for effect, part in group.parameters.items():
            for parameter, number in part.items():
                old = result.get(effect, {}).get(parameter)
                if old is None:
                    raise ValueError(f"classes.{name}: parameter '{effect}.{parameter}' does not exist here.")
                new = torch.full((len(kinds),), number, dtype=old.dtype, device=old.device)
                new = new * factors.get(f"{effect}.{parameter}", 1.0)
                result[effect][parameter] = torch.where(mine.to(old.device), new, old)
    return result
