"""Networks of our own: grids, a crossing, a roundabout and a figure eight, with foes and priorities from geometry.

A road is one way, of one lane or, in grids, of several from right to left; traffic keeps to the right. One turns right
from the right lane, left from the left one, and goes on from each. Where roads meet, a way through is a Bézier curve.
Two ways from different roads are foes where they end on the same road or come nearer than ``WIDTH``. Points in m.
Foes and yields are netgenerate's for the same grid; of two oncoming left turns it takes the one or the other first.
"""

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from idm_env import validation
from idm_env.roads.sumo_network import NetworkTables

WIDTH = 3.0
"""Ways through a junction that come nearer than a vehicle's width and a metre (m) are foes; lanes are 3.2 m apart."""
OFFSET, RADIUS = 1.6, 7.2
"""From the middle of a street to a lane, and from that of a junction to where its lanes end (m), as netgenerate's."""
TURN_ACCEL, FREE_TURN = 5.5, math.radians(15.0)
"""A turn by θ over L metres has the limit √(a L / (θ − 15°)), SUMO's rule for turns (a in m/s²)."""
STRAIGHT = math.radians(45.0)
CONTROLS = ("signals", "priority", "right_before_left", "none")
"""What rules at junctions; ``none``: nobody goes first, and foes still do not meet."""


class _Way(NamedTuple):
    """A way through a junction: roads, lane, points ``(k, 2)``, turn to the left and heading (rad), rank and phase."""

    start: str
    end: str
    lane: int
    points: np.ndarray
    turn: float
    heading: float
    rank: int
    phase: int


class Streets:
    """Roads by name, and the ways through their junctions, until all is made tables of."""

    def __init__(self, limit: float, control: str) -> None:
        self.limit = validation.in_interval("limit", float(limit), 0.5, 100.0, "m/s")
        self.control = validation.one_of("control", control, CONTROLS)
        self.roads: dict[str, list[np.ndarray]] = {}
        self.junctions: list[tuple[str, list[_Way]]] = []

    def add_road(self, name: str, *lanes: Any) -> None:
        """Add a road with each of its lanes along points ``(k, 2)``."""
        self.roads[name] = [np.asarray(points, float) for points in lanes]

    def add_street(self, names: tuple[str, str], ends: Any, radii: tuple[float, float], lanes: int) -> None:
        """Add both roads of a straight street between two junctions of some radii."""
        for name, (a, b), (near, far) in zip(names, (ends, ends[::-1]), (radii, radii[::-1]), strict=True):
            a, b = np.asarray(a, float), np.asarray(b, float)
            along = (b - a) / np.linalg.norm(b - a)
            sides = [OFFSET * k * np.array([along[1], -along[0]]) for k in range(2 * lanes - 1, 0, -2)]
            self.add_road(name, *([a + near * along + side, b - far * along + side] for side in sides))

    def join(self, junction: str, pairs: Mapping[tuple[str, str], tuple[int, int]]) -> None:
        """Add a junction: pairs of roads that it leads from and to, each with a rank (the higher first) and a phase."""
        ways = []
        for (start, end), (rank, phase) in pairs.items():
            for lane, ((*_, a, b), (c, d, *_)) in enumerate(zip(self.roads[start], self.roads[end], strict=True)):
                first, last = (math.atan2(*(q - p)[::-1]) for p, q in ((a, b), (c, d)))
                turn = (last - first + math.pi) % (2.0 * math.pi) - math.pi
                if lane == (len(self.roads[start]) - 1 if turn > STRAIGHT else 0 if turn < -STRAIGHT else lane):
                    ways.append(_Way(start, end, lane, _bend(b, first, c, last), turn, first, rank, phase))
        self.junctions.append((junction, ways))

    def tables(self, green: float = 42.0, amber: float = 3.0) -> NetworkTables:
        """Return the tables of all; signals show every phase ``green`` seconds and ``amber`` (s)."""
        columns = ("name", "length", "limit", "inner", "edge", "shape", "right", "left")
        links: dict[str, list[Any]] = {key: [] for key in columns}
        keys = ("start", "end", "path", "foes", "yields", "signal", "index")
        moves: dict[str, list[Any]] = {key: [] for key in keys}
        plans = []
        for name, lanes in self.roads.items():
            names = [None, *(f"{name}_{k}" for k in range(len(lanes))), None]
            for points, right, own, left in zip(lanes, names, names[1:], names[2:], strict=False):
                _add(links, (own, _length(points), self.limit, False, name, points, right, left))
        for junction, ways in self.junctions:
            first, has_signal = len(moves["start"]), self.control == "signals" and len({way.phase for way in ways}) > 1
            for i, way in enumerate(ways):
                edge, length, excess = f":{junction}_{i}", _length(way.points), abs(way.turn) - FREE_TURN
                limit = math.sqrt(TURN_ACCEL * length / excess) if excess > 0.0 else math.inf
                _add(links, (f"{edge}_0", length, min(self.limit, limit), True, edge, way.points, None, None))
                foes = [j for j, other in enumerate(ways) if _conflict(way, other)]
                yields = [first + j for j in foes if self._goes_first(ways[j], way, j < i)]
                signal = (junction, i) if has_signal else (None, None)
                start, end = f"{way.start}_{way.lane}", f"{way.end}_{way.lane}"
                _add(moves, (start, end, [f"{edge}_0"], [first + j for j in foes], yields, *signal))
            if has_signal:
                plans.append((junction, *_phases(ways, green, amber), 0.0))
        return NetworkTables(links, moves, plans, Counter())

    def _goes_first(self, other: _Way, mine: _Way, earlier: bool) -> bool:
        """Return whether one of two foes goes before the other."""
        if self.control == "none":
            return False
        if self.control == "signals" and other.phase != mine.phase:
            return False  # they are never open together
        if self.control == "priority" and other.rank != mine.rank:
            return other.rank > mine.rank
        bearing = (other.heading - mine.heading) % (2.0 * math.pi)
        if abs(bearing - math.pi) < STRAIGHT:  # oncoming: whoever turns left waits, of two the later in the list
            return mine.turn > STRAIGHT and (other.turn < STRAIGHT or earlier)
        return self.control == "right_before_left" and bearing < math.pi


def _add(table: Mapping[str, list[Any]], row: tuple[Any, ...]) -> None:
    for column, value in zip(table.values(), row, strict=True):
        column.append(value)


def _phases(ways: list[_Way], green: float, amber: float) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return durations (s) and states: in each phase its ways are open, those that turn left where they may."""
    validation.in_interval("green", float(green), 1.0, 3600.0, "s")
    validation.in_interval("amber", float(amber), 0.1, 60.0, "s")
    durations, states = [], []
    for phase in sorted({way.phase for way in ways}):
        lights = [("Gy", "gy")[way.turn > STRAIGHT] if way.phase == phase else "rr" for way in ways]
        durations += [float(green), float(amber)]
        states += ["".join(light[k] for light in lights) for k in range(2)]
    return tuple(durations), tuple(states)


def _bend(a: np.ndarray, first: float, b: np.ndarray, last: float) -> np.ndarray:
    """Return the Bézier curve ``(25, 2)`` from one point and heading to another, an arc where these allow one."""
    chord, turn = float(np.linalg.norm(b - a)), abs((last - first + math.pi) % (2.0 * math.pi) - math.pi)
    # Control points of an arc by θ lie 4/3 tan(θ/4) r ahead, and its chord is 2 r sin(θ/2).
    reach = chord / 3.0 if turn < 1e-6 else chord * (2.0 / 3.0) * math.tan(turn / 4.0) / math.sin(turn / 2.0)
    p = a + reach * np.array([math.cos(first), math.sin(first)])
    q = b - reach * np.array([math.cos(last), math.sin(last)])
    t = np.linspace(0.0, 1.0, 25)[:, None]
    return (1 - t) ** 3 * a + 3 * t * (1 - t) ** 2 * p + 3 * t**2 * (1 - t) * q + t**3 * b


def _length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _conflict(one: _Way, other: _Way) -> bool:
    """Return whether vehicles on two ways of a junction could meet."""
    if one.start == other.start:
        return False
    apart = np.linalg.norm(one.points[:, None] - other.points[None], axis=-1)
    # Whoever turns may turn beside one who turns onto another lane.
    merges = one.end == other.end and (one.lane == other.lane or min(abs(one.turn), abs(other.turn)) < STRAIGHT)
    return merges or float(apart.min()) < WIDTH


def grid(rows: int, columns: int, block: float, arm: float, limit: float, control: str, lanes: int) -> Streets:
    """Return a grid of so many crossings, ``block`` m apart, with arms of ``arm`` m; names are netgenerate's.

    Crossing ``B0`` is that of the second column and the first row, arms are ``left0``, ``right0``, ``bottom0``,
    ``top0``, and ``A0B0`` leads from ``A0`` to ``B0``. The streets from south to north have priority.

    ValueError for a number that allows no grid.
    """
    rows, columns = validation.whole("rows", rows, 1, 100), validation.whole("columns", columns, 1, 26)
    radius = RADIUS + 2.0 * OFFSET * (validation.whole("lanes", lanes, 1, 4) - 1)
    for key, value in (("block", block), ("arm", arm)):
        validation.in_interval(key, value, 2.0 * radius + 5.0, 1e5, "m")
    streets = Streets(limit, control)
    nodes = {f"{chr(65 + i)}{j}": (arm + i * block, arm + j * block) for i in range(columns) for j in range(rows)}
    arms: dict[str, list[tuple[int, str]]] = {name: [] for name in nodes}
    pairs = [(f"left{j}", f"A{j}") for j in range(rows)] + [(f"bottom{i}", f"{chr(65 + i)}0") for i in range(columns)]
    pairs += [(a, b) for a in nodes for b in (f"{chr(ord(a[0]) + 1)}{a[1:]}", f"{a[0]}{int(a[1:]) + 1}") if b in nodes]
    pairs += [(f"{chr(64 + columns)}{j}", f"right{j}") for j in range(rows)]
    pairs += [(f"{chr(65 + i)}{rows - 1}", f"top{i}") for i in range(columns)]
    for a, b in pairs:
        upright = "bottom" in a or "top" in b or (a in nodes and b in nodes and a[0] == b[0])
        step = np.array([0.0, 1.0] if upright else [1.0, 0.0])
        ends = nodes.get(a) or tuple(nodes[b] - arm * step), nodes.get(b) or tuple(nodes[a] + arm * step)
        streets.add_street((f"{a}{b}", f"{b}{a}"), ends, (radius * (a in nodes), radius * (b in nodes)), lanes)
        for name, neighbour, side in ((a, b, 1 - upright), (b, a, 3 - upright)):
            if name in nodes:
                arms[name].append((side, neighbour))
    for name, roads in arms.items():  # clockwise from the north, from each the right turn first
        ways = [(i, a, b) for i, a in sorted(roads) for j, b in sorted(roads, key=lambda x: (i - x[0]) % 4) if i != j]
        streets.join(name, {(f"{a}{name}", f"{name}{b}"): (1 - i % 2, i % 2) for i, a, b in ways})
    return streets


def roundabout(arms: int, radius: float, arm: float, limit: float) -> Streets:
    """Return a roundabout, driven counter-clockwise: ``in0`` leads to it, ``ring0`` from arm 0 to arm 1, ``out0`` away.

    Vehicles on the ring go first. ValueError for a radius (m) at which its arms do not fit.
    """
    arms = validation.whole("arms", arms, 2, 12)
    validation.in_interval("radius", float(radius), max(12.0, 20.0 * arms / (2.0 * math.pi)), 500.0, "m")
    validation.in_interval("arm", float(arm), 10.0, 1e5, "m")
    streets, half = Streets(limit, "priority"), RADIUS / radius
    angles = [2.0 * math.pi * k / arms for k in range(arms)]
    for k, angle in enumerate(angles):
        out, side = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)]) * OFFSET
        # An arc is as long as its corners are many: 1 m apart.
        t = np.linspace(angle + half, angle + 2.0 * math.pi / arms - half, max(3, round(2.0 * math.pi * radius / arms)))
        streets.add_road(f"ring{k}", radius * np.stack((np.cos(t), np.sin(t)), 1))
        near, far = radius + RADIUS, radius + RADIUS + arm
        streets.add_road(f"in{k}", [far * out + side, near * out + side])
        streets.add_road(f"out{k}", [near * out - side, far * out - side])
    for k in range(arms):
        ring, onward = f"ring{(k - 1) % arms}", f"ring{k}"
        streets.join(f"R{k}", {(ring, onward): (1, 0), (ring, f"out{k}"): (1, 0), (f"in{k}", onward): (0, 0)})
    return streets


def figure_eight(radius: float, limit: float, control: str) -> Streets:
    """Return two loops, ``east`` and ``west``, that cross once: each leads to the other, straight on.

    Vehicles that cross eastwards have priority. A loop is three quarters of a circle of ``radius`` m and two straights
    as long as it, as in Flow (Wu et al. 2017). ValueError for a radius below 15 m.
    """
    validation.in_interval("radius", float(radius), 15.0, 1e4, "m")
    streets = Streets(limit, control)
    t = np.linspace(-0.5 * math.pi, math.pi, max(9, round(1.5 * math.pi * radius)))
    arc = radius * np.stack((1.0 + np.cos(t), 1.0 + np.sin(t)), 1)
    east = np.concatenate(([[RADIUS, 0.0]], arc, [[0.0, RADIUS]]))
    streets.add_road("east", east)
    streets.add_road("west", -east[:, ::-1])
    streets.join("C", {("west", "east"): (1, 0), ("east", "west"): (0, 1)})
    return streets
