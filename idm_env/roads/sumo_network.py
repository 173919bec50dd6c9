"""SUMO's networks (``.net.xml``) as tables of links, moves and signals: every lane for cars is a link.

A connection is a move. Its foes and the moves that go first are those of its junction's ``request``: bit i from the
right of ``foes`` and ``response`` stands for request i, which belongs to entry i of the junction's ``intLanes``.
Lengths in m, limits in m/s, times in s. Source: SUMO's documentation, *Networks/SUMO Road Networks*.
"""

from collections import Counter
from itertools import combinations, groupby
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from idm_env import validation
from idm_env.roads import sumo_files
from idm_env.roads.sumo_files import name, number, text


class NetworkTables(NamedTuple):
    """Columns of links and of moves as ``Network.from_tables`` takes them, signals, and counts of omissions by kind.

    ``plans`` are rows of name, durations (s), states and offset (s).
    """

    links: dict[str, list[Any]]
    moves: dict[str, list[Any]]
    plans: list[tuple[str, tuple[float, ...], tuple[str, ...], float]]
    skipped: Counter[str]


def read_tables(path: Path) -> NetworkTables:
    """Return the tables of a network. ValueError, in one line that names the element, for one that cannot be used."""
    reader = _Reader(path)
    for element in sumo_files.elements(path, ("net",)):
        if element.tag in ("edge", "tlLogic", "junction", "connection"):
            getattr(reader, f"add_{element.tag.lower()}")(element)
    if not reader.links["name"]:
        raise ValueError(f"{path.name} has no lane for cars. Give a network of roads.")
    return reader.tables()


def is_for_cars(lane: Element) -> bool:
    """Return whether a lane's permissions let passenger cars in."""
    allowed, refused = lane.get("allow", "").split(), lane.get("disallow", "").split()
    return not {"all", "passenger"} & {*refused} and (not allowed or bool({"all", "passenger"} & {*allowed}))


class _Reader:
    """Links, connections, requests and signals of one file, in the order in which they stand."""

    def __init__(self, path: Path) -> None:
        self.path = path
        columns = ("name", "length", "limit", "inner", "edge", "shape", "right", "left")
        self.links: dict[str, list[Any]] = {key: [] for key in columns}
        self.cars: set[str] = set()
        self.following: dict[str, str] = {}
        self.connections: list[tuple[str, str, str, str | None, int, bool]] = []
        self.requests: list[tuple[str, list[str], list[tuple[int, str, str]]]] = []
        self.signals: dict[str, tuple[tuple[float, ...], tuple[str, ...], float]] = {}
        self.skipped: Counter[str] = Counter()

    def add_edge(self, edge: Element) -> None:
        """Add a link for each lane that cars may use; lanes of an edge stand from right to left."""
        function = edge.get("function", "normal")
        if function not in ("normal", "internal"):
            self.skipped[f"edges that are a {function}"] += 1
            return
        right = None
        for lane in edge.iter("lane"):
            if not is_for_cars(lane):
                self.skipped["lanes closed to cars"] += 1
                right = None
                continue
            row = text(lane, "id"), number(lane, "length"), number(lane, "speed"), function == "internal"
            for key, value in zip(self.links, (*row, text(edge, "id"), _points(lane), right, None), strict=True):
                self.links[key].append(value)
            if right is not None:
                self.links["left"][-2] = row[0]
            right = row[0]
            self.cars.add(row[0])

    def add_tllogic(self, logic: Element) -> None:
        """Keep the program that was written last, as SUMO does."""
        signal = text(logic, "id")
        self.skipped["signal programs replaced by a later one"] += signal in self.signals
        self.skipped[f"signals of type {logic.get('type')} run by the clock"] += logic.get("type", "static") != "static"
        phases = list(logic.iter("phase"))
        durations = tuple(number(phase, "duration") for phase in phases)
        if min(durations, default=1.0) <= 0.0:
            raise ValueError(f"signal '{signal}': durations {validation.shown(durations)} s must be above 0.")
        self.signals[signal] = durations, tuple(text(p, "state") for p in phases), number(logic, "offset", 0.0)

    def add_junction(self, junction: Element) -> None:
        """Keep the requests of a junction."""
        rows = [(int(number(r, "index")), text(r, "foes"), text(r, "response")) for r in junction.iter("request")]
        if rows:
            self.requests.append((text(junction, "id"), text(junction, "intLanes").split(), rows))

    def add_connection(self, connection: Element) -> None:
        """Keep a way from a lane to a lane; of one inside a junction, the part that follows."""
        start = f"{text(connection, 'from')}_{text(connection, 'fromLane')}"
        end = f"{text(connection, 'to')}_{text(connection, 'toLane')}"
        via = connection.get("via")
        if start.startswith(":"):
            self.following[start] = via or end
        elif {start, end} <= self.cars:
            if via is None:
                cure = "Build it with netconvert, without --no-internal-links."
                raise ValueError(f"{name(connection)} has no via: {self.path.name} has no internal links. {cure}")
            signal, free = connection.get("tl"), connection.get("pass") in ("true", "1")
            if signal is not None and signal not in self.signals:
                raise ValueError(f'{name(connection)}: tl="{signal}" has no tlLogic. Add its program to the network.')
            self.connections.append((start, end, via, signal, int(number(connection, "linkIndex", -1.0)), free))

    def tables(self) -> NetworkTables:
        """Return the tables; foes and yields are rows of moves."""
        starts, ends, vias, signals, index, _ = zip(*self.connections, strict=True) if self.connections else ((),) * 6
        paths = [self._parts(via, end) for via, end in zip(vias, ends, strict=True)]
        owner = {part: move for move, path in enumerate(paths) for part in path}
        foes, yields = ([list[int]() for _ in starts] for _ in range(2))
        for junction, inner, rows in self.requests:
            for row in rows:
                if not row[0] < len(inner) == len(rows) == len(row[1]) == len(row[2]):
                    needs = f"needs {len(rows)} foes, responses and intLanes, one for each request"
                    raise ValueError(f'<junction id="{junction}">: request {row[0]} {needs}. Build it with netconvert.')
                mine = owner.get(inner[row[0]])
                for lane, foe, first in zip(inner, row[1][::-1], row[2][::-1], strict=True):
                    if mine is not None and lane in owner:  # not of pedestrians, bicycles or trains
                        foes[mine] += [owner[lane]] * (foe == "1")
                        yields[mine] += [owner[lane]] * (first == "1" and not self.connections[mine][-1])
        for one, against in enumerate(foes):  # netgenerate also writes foes of which one alone knows
            for other in against:
                if one not in foes[other]:
                    foes[other].append(one)
                    self.skipped["foes made mutual"] += 1
        merging = sorted(range(len(ends)), key=ends.__getitem__)
        for _, group in groupby(merging, ends.__getitem__):  # an unregulated junction has no foes
            for one, other in combinations(group, 2):
                if starts[other] != starts[one] and other not in foes[one]:
                    foes[one].append(other)
                    foes[other].append(one)
                    self.skipped["pairs of merging moves made foes"] += 1
        plans = [(signal, *self.signals[signal]) for signal in self.signals if signal in signals]
        self.skipped["signals without a move for cars"] += len(self.signals) - len(plans)
        moves = {"start": starts, "end": ends, "path": paths, "foes": foes, "yields": yields}
        columns = {key: list(column) for key, column in {**moves, "signal": signals, "index": index}.items()}
        return NetworkTables(self.links, columns, plans, +self.skipped)

    def _parts(self, via: str, end: str) -> list[str]:
        """Return the inner lanes of a move in order."""
        path = [via]
        while (following := self.following.get(path[-1], end)) != end and len(path) < 10:
            path.append(following)
        return path


def _points(lane: Element) -> np.ndarray:
    """Return a lane's shape, ``(points, 2)`` (m)."""
    try:
        points = [[float(x) for x in point.split(",")[:2]] for point in lane.get("shape", "").split()]
        return np.array(points, float).reshape(-1, 2)
    except ValueError:
        shape = validation.shown(lane.get("shape"))
        raise ValueError(f"{name(lane)}: shape = {shape} must be pairs x,y.") from None
