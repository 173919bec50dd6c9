"""Trips as a table: who departs when, on which lane, how fast, of which class of drivers, and where to.

A table is anything with columns (a ``DataFrame``, or a mapping of sequences), rows, or the path of a CSV file.
``idm_env.types.Trips.from_table`` reads the first three columns:

===============  =======================================================================================================
``depart``       when the trip begins (s), from 0 on; of one lane in any order
``lane``         lane on which it enters, 0 on the right
``speed``        speed that it asks for at the entry (m/s); 20 where the column is missing
``class``        name of its class of drivers; empty, or without the column: a plain one
``destination``  name of where it leaves; empty, or without the column: at the end of the road
===============  =======================================================================================================
"""

import csv
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch

from idm_env.tasks.checks import FLOW, Key, Range, by_name, entry
from idm_env.types import ENTRY_SPEED, Trips
from idm_env.validation import at_least, finite, nearest, shown, whole

COLUMNS = ("depart", "lane", "speed", "class", "destination")
_MOST_TRIPS = 100_000
FIRST, SECOND = 0.7548776662466927, 0.5698402909980532
"""Multiples of each are evenly spread, and go neither with each other nor with those by which desired speeds are."""


class TripTable(NamedTuple):
    """A checked table of trips, in the order of departure."""

    depart: tuple[float, ...]
    lane: tuple[int, ...]
    speed: tuple[float, ...]
    kind: tuple[str, ...]
    destination: tuple[str, ...]


def read(given: Any) -> TripTable:
    """Return a table from columns, rows or a CSV file; ValueError, in one line, for what is none."""
    columns = _columns(given)
    for name in columns:
        if name not in COLUMNS:
            raise ValueError(f"trips: column {shown(name)} is unknown.{nearest(str(name), COLUMNS)}")
    trips = Trips.from_table(columns, torch.float64)
    departs = [float(x) for x in columns["depart"]]
    order = sorted(range(len(departs)), key=departs.__getitem__)
    none = [""] * len(departs)
    kind, destination = (tuple(_name(columns.get(n, none)[i]) for i in order) for n in ("class", "destination"))
    depart, lane, speed = (tuple(x.tolist()) for x in (trips.departs, trips.lane, trips.speed))
    return TripTable(depart, lane, speed, kind, destination)


def _columns(source: Any) -> dict[str, list[Any]]:
    if isinstance(source, (str, Path)):
        source = _rows_of(source)
    if isinstance(source, Sequence) and not isinstance(source, str | bytes):
        if not source or not all(isinstance(row, Mapping) for row in source):
            raise ValueError(f"trips = {shown(source)} must be rows of {', '.join(COLUMNS)}, columns, or a CSV file.")
        names = dict.fromkeys(name for row in source for name in row)
        return {str(name): [row.get(name) for row in source] for name in names}
    try:
        header = list(getattr(source, "columns", source))
        _once("trips", header)
        if any(isinstance(source[name], str | bytes) for name in header):
            raise TypeError
        return {str(name): list(source[name]) for name in header}
    except (TypeError, KeyError, IndexError):
        raise ValueError(f"trips = {shown(source)} must be a table, rows of it, or a CSV file.") from None


def _rows_of(path: str | Path) -> list[dict[str, Any]]:
    """Return the rows of a CSV file. ValueError, in one line, for what is none, or for a column that is there twice."""
    where = f"trips = {shown(str(path))}"
    try:
        if not Path(path).is_file():
            raise ValueError(f"{where} is not a file. Give the path of a CSV file, or rows.")
        text = Path(path).read_text(encoding="utf-8-sig")  # Excel begins with a mark
        rows = csv.DictReader(text.splitlines(), restkey="beyond the header")
        _once(where, rows.fieldnames or ())
        return list(rows)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{where} is not CSV in UTF-8 that can be read: {error}. Save it as such.") from None


def _once(where: str, header: Sequence[Any]) -> None:
    if twice := next((name for name in header if list(header).count(name) > 1), None):
        raise ValueError(f"{where}: column {shown(twice)} is there twice. Remove one.")


def _name(value: Any) -> str:
    missing = value is None or (not isinstance(value, str) and str(value) in ("nan", "<NA>"))
    return "" if missing else str(value)


def flows(where: str, given: Any) -> dict[int, list[tuple[float, float]]]:
    """Return of every lane the times (s) since which so many vehicles an hour depart, in the order of lanes.

    ValueError, in one line, for no mapping from lanes, a lane twice, or what is neither a number nor steps that rise.
    """
    if not isinstance(given, Mapping) or not given:
        raise ValueError(f"{where} = {shown(given)} must give vehicles an hour for lanes, such as {{1: 1500}}.")
    result: dict[int, list[tuple[float, float]]] = {}
    for key, value in given.items():
        lane = whole(f"{where}: a lane", int(key) if isinstance(key, str) and key.isdecimal() else key, 0, 1000)
        one = f"{where} of lane {lane}"
        if lane in result:
            raise ValueError(f"{one} is given twice. Remove one.")
        steps = value if isinstance(value, Sequence) and not isinstance(value, str | bytes) else [[0.0, value]]
        if not steps or not all(isinstance(x, Sequence) and len(x) == 2 for x in steps):
            raise ValueError(f"{one} = {shown(value)} must be a number, or steps such as [[0, 800], [300, 1600]].")
        result[lane] = [
            (at_least(f"{one}: time", t, 0.0, "s"), at_least(one, x, 0.0, FLOW.unit, 1e5)) for t, x in steps
        ]
        if any(later[0] <= step[0] for step, later in pairwise(result[lane])):
            raise ValueError(f"{one} = {shown(value)} must rise in time.")
    return dict(sorted(result.items()))


KEYS = {"per_hour": Key(flows), "seconds": Key(Range(0.0, 1e9, "s"), 600.0)}
KEYS |= {"seed": Key(Range(0, 1e18, whole=True), 0), "speed": Key(Range(1.0, 100.0, "m/s"), ENTRY_SPEED)}
KEYS |= {"classes": Key(by_name, None), "destinations": Key(by_name, None)}
"""What ``trips`` takes in place of a table: the arguments of ``table``."""


def table(
    per_hour: Mapping[int, Any], seconds: float = 600.0, *, seed: int = 0, speed: float = ENTRY_SPEED,
    classes: Mapping[str, float] | None = None, destinations: Mapping[str, float] | None = None,
) -> dict[str, list[Any]]:  # fmt: skip
    """Return a table of trips, as columns, with demand by lane and time.

    ``per_hour`` gives for every lane that is entered vehicles an hour, one number or ``[[from_s, number], …]``;
    headways are half of the mean, and an exponential half. ``classes`` and ``destinations`` are shares of names.
    ValueError, in one line, for what is no number of at least 0, for shares above 1, and for too many trips.
    """
    entry("trips", locals(), KEYS)
    demand = flows("trips.per_hour", per_hour)
    most = seconds * sum(max(x for _, x in steps) for steps in demand.values()) / 3600.0
    if most > _MOST_TRIPS:
        raise ValueError(f"trips.seconds = {seconds:g} s lets {most:.3g} vehicles depart, of at most {_MOST_TRIPS}.")
    generator = torch.Generator().manual_seed(int(seed))
    rows = []
    for lane, steps in demand.items():
        time = 0.0
        while time <= seconds:
            flow = next((x for begin, x in reversed(steps) if begin <= time), 0.0)
            if flow > 0.0:
                wait = float(torch.empty(()).exponential_(generator=generator))
                time += 3600.0 / flow * 0.5 * (1.0 + wait)
                rows += [(time, lane)] if time <= seconds else []
            else:
                time = next((begin for begin, x in steps if begin > time and x > 0.0), math.inf)
    if not rows:
        raise ValueError(f"per_hour = {shown(dict(per_hour))} lets nobody depart within {seconds:g} s.")
    rows.sort()
    who = torch.rand(2, len(rows), generator=generator).tolist()
    kind, place = _of_shares("classes", classes or {}, who[0]), _of_shares("destinations", destinations or {}, who[1])
    times, lanes = [time for time, _ in rows], [lane for _, lane in rows]
    return {"depart": times, "lane": lanes, "speed": [speed] * len(rows), "class": kind, "destination": place}


def shares(name: str, given: Mapping[str, float]) -> None:
    """Raise ValueError for shares below 0, or above 1 in all."""
    for key, share in by_name(name, given).items():
        if not 0.0 <= finite(f"{name}.{key}", share) <= 1.0:
            raise ValueError(f"{name}.{key} = {share:g} must be a share from 0 to 1.")
    if sum(given.values()) > 1.0 + 1e-9:
        raise ValueError(f"{name}: shares of {sum(given.values()):g} in all must not exceed 1.")


def _of_shares(name: str, portions: Mapping[str, float], numbers: Sequence[float]) -> list[str]:
    """Return the names that numbers from 0 to 1 mean, '' for what is left."""
    shares(name, portions)
    ends, names = list(accumulate(portions.values())), [*portions, ""]
    return [names[bisect_right(ends, x)] for x in numbers]


def spread(name: str, given: Mapping[str, float], count: int, by: float = FIRST) -> list[str]:
    """Return the names of so many slots, evenly spread by their shares."""
    return _of_shares(name, given, [(by * (i + 1)) % 1.0 for i in range(count)])


__all__ = ["COLUMNS", "SECOND", "TripTable", "read", "spread", "table"]
