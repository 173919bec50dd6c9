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

from __future__ import annotations

import csv
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import torch

from idm_env.types import ENTRY_SPEED, Trips
from idm_env.validation import finite, nearest, shown

COLUMNS = ("depart", "lane", "speed", "class", "destination")
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
        if not Path(source).is_file():
            raise ValueError(f"trips = {shown(str(source))} is not a file. Give the path of a CSV file, or rows.")
        try:
            table = csv.DictReader(Path(source).read_text(encoding="utf-8").splitlines())
            header = list(table.fieldnames or ())
            if twice := next((name for name in header if header.count(name) > 1), None):
                raise ValueError(f"trips = {shown(str(source))}: column {shown(twice)} is there twice. Remove one.")
            source = list(table)
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"trips = {shown(str(source))} is not CSV in UTF-8: {error}. Save it as such.") from None
    if isinstance(source, Sequence) and not isinstance(source, str):
        if not source or not all(isinstance(row, Mapping) for row in source):
            raise ValueError(f"trips = {shown(source)} must be rows of {', '.join(COLUMNS)}, columns, or a CSV file.")
        names = dict.fromkeys(name for row in source for name in row)
        return {str(name): [row.get(name) for row in source] for name in names}
    try:
        return {str(name): list(source[name]) for name in getattr(source, "columns", source)}
    except (TypeError, KeyError, IndexError):
        raise ValueError(f"trips = {shown(source)} must be a table, rows of it, or a CSV file.") from None


def _name(value: Any) -> str:
    return "" if value is None or value != value else str(value)


def table(
    per_hour: Mapping[int, Any], seconds: float, *, seed: int = 0, speed: float = ENTRY_SPEED,
    classes: Mapping[str, float] | None = None, destinations: Mapping[str, float] | None = None,
) -> dict[str, list[Any]]:  # fmt: skip
    """Return a table of trips, as columns, with demand by lane and time.

    ``per_hour`` gives for every lane that is entered vehicles an hour, one number or ``[[from_s, number], …]``;
    headways are half of the mean, and an exponential half. ``classes`` and ``destinations`` are shares of names.
    ValueError, in one line, for what is no number of at least 0, or for shares above 1.
    """
    finite("seconds", seconds, "s")
    generator = torch.Generator().manual_seed(seed)
    rows = []
    for key, flow in sorted(per_hour.items(), key=lambda x: int(x[0])):
        steps = [[0.0, flow]] if isinstance(flow, (int, float)) else [list(x) for x in flow]
        for begin, number in steps:
            if not (math.isfinite(begin) and 0.0 <= number <= 1e5):
                raise ValueError(f"per_hour = {shown(number)} of lane {key} must be from 0 to 100000 vehicles an hour.")
        time = 0.0
        while True:
            now = next((x for begin, x in reversed(steps) if begin <= time), 0.0)
            if now <= 0.0:
                time = next((begin for begin, x in steps if begin > time and x > 0.0), math.inf)
                if time > seconds:
                    break
                continue
            wait = float(torch.empty(()).exponential_(generator=generator))
            time += 3600.0 / now * 0.5 * (1.0 + wait)
            if time > seconds:
                break
            rows.append((time, int(key)))
    if not rows:
        raise ValueError(f"per_hour = {shown(dict(per_hour))} lets nobody depart within {seconds:g} s.")
    rows.sort()
    who = torch.rand(2, len(rows), generator=generator).tolist()
    return {
        "depart": [time for time, _ in rows], "lane": [lane for _, lane in rows], "speed": [speed] * len(rows),
        "class": _of_shares("classes", classes or {}, who[0]),
        "destination": _of_shares("destinations", destinations or {}, who[1]),
    }  # fmt: skip


def shares(name: str, given: Mapping[str, float]) -> None:
    """Raise ValueError for shares below 0, or above 1 in all."""
    for key, share in given.items():
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
