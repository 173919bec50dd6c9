"""Networks: links that follow one another through junctions, whose moves cross, yield and have signals.

A *link* is one lane between two junctions, or a part of a way through one (``inner``). A *move* leads from one link
through a junction to another. Who is where is state (``types.Journeys``): all here is static.

Shapes: L links, M moves, S signals; indices are whole numbers, −1 stands for none and fills rows. SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from idm_env.roads import streets, sumo_network
from idm_env.roads.base import Road
from idm_env.roads.journeys import Travelled, unlinked
from idm_env.types import LaneState, State
from idm_env.validation import nearest, shown

Array = NDArray[Any]

NONE = -1
"""Index of nothing."""

RED, GREEN, AMBER, YIELD = range(4)
"""What a move is shown: closed; goes first; closed to whoever can stop; open to whoever yields, as without signals."""

LETTERS = dict(zip("ruRGyYgoOs", (RED,) * 3 + (GREEN,) + (AMBER,) * 2 + (YIELD,) * 4, strict=True))
"""Letters of a signal's state, as SUMO writes them, and what they show."""

SHORTEST, SHORTEST_INNER = 1.0, 0.1
"""Least length of a link outside and inside a junction (m)."""


class Plan(NamedTuple):
    """Plan of a signal: phases of some ``durations`` (s) one after another, again and again.

    Phase ``i`` shows the letter ``states[i][index]`` to a move. ``offset`` (s) is when the first phase begins.
    """

    name: str
    durations: tuple[float, ...]
    states: tuple[str, ...]
    offset: float = 0.0


def padded(rows: Sequence[Sequence[int]]) -> Array:
    """Return rows of whole numbers as a table of at least one column, filled with −1."""
    table = np.full((len(rows), max([1, *map(len, rows)])), NONE, np.int32)
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table


def _nothing() -> Array:
    return np.array(NONE, np.int32)


@dataclass(frozen=True, eq=False)
class Network(Road):
    """The links of a network, the moves between them, and the plans of its signals.

    Links: ``names``, ``length`` (L, m), ``limit`` (L, m/s), ``inner`` (L, whether inside a junction), ``left`` and
    ``right`` (L, the link beside), ``edge`` (of what road a link is a lane), ``shape`` (points (k, 2) in m, for maps).

    Moves: from link ``start`` (M) over the inner links ``path`` (M, P) to link ``end`` (M). ``foes`` (M, F) are moves
    that must not be inside together with it, ``yields`` (M, F) those whose arrivals go first; it is shown the letter
    ``index`` (M) of ``signal`` (M). A move without a path has no gate: its links simply follow one another.

    Positions are local to a link, gaps are along each vehicle's route. Between events everybody drives on, beyond the
    end of his link if need be (``multilane.junctions``). ValueError, in one line, names what cannot be.
    """

    names: tuple[str, ...]
    length: Array
    limit: Array
    start: Array
    end: Array
    path: Array = field(default_factory=_nothing)
    inner: Array = field(default_factory=lambda: np.array(False))
    left: Array = field(default_factory=_nothing)
    right: Array = field(default_factory=_nothing)
    foes: Array = field(default_factory=_nothing)
    yields: Array = field(default_factory=_nothing)
    signal: Array = field(default_factory=_nothing)
    index: Array = field(default_factory=_nothing)
    plans: tuple[Plan, ...] = ()
    edge: tuple[str, ...] = ()
    shape: tuple[Array, ...] = field(default=(), repr=False)
    skipped: Mapping[str, int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        links, moves = len(self.names), len(np.atleast_1d(self.start))
        kinds = {"length": float, "limit": float, "inner": bool}
        for name in ("length", "limit", "inner", "left", "right", "start", "end", "signal", "index"):
            size = links if name in ("length", "limit", "inner", "left", "right") else moves
            self._settle(name, (size,), kinds.get(name, np.int32))
        for name in ("path", "foes", "yields"):
            x = np.asarray(getattr(self, name))
            self._settle(name, (moves, x.shape[-1] if x.ndim > 1 else 1), np.int32)
        for name, value in (("names", tuple(self.names)), ("plans", tuple(self.plans)), ("shape", tuple(self.shape))):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "edge", tuple(self.edge) or self.names)
        _check_links(self)
        _check_moves(self)
        _check_plans(self)

    def _settle(self, name: str, shape: tuple[int, ...], kind: Any) -> None:
        x = np.asarray(getattr(self, name))
        try:
            x = np.ascontiguousarray(np.broadcast_to(x, shape).astype(kind))
        except ValueError:
            raise ValueError(f"network: {name} has shape {x.shape}, and must have {shape}.") from None
        x.flags.writeable = False
        object.__setattr__(self, name, x)

    @classmethod
    def from_tables(
        cls, links: Mapping[str, Sequence[Any]], moves: Mapping[str, Sequence[Any]], plans: Sequence[Plan] = ()
    ) -> Network:
        """Return the network of two tables, in which links and signals are called by name, and moves by their row.

        ``links`` has the columns ``name``, ``length`` (m), ``limit`` (m/s), and may have ``inner``, ``left``,
        ``right``, ``edge`` and ``shape``. ``moves`` has ``start`` and ``end``, and may have ``path`` (names), ``foes``
        and ``yields`` (rows), ``signal`` (name) and ``index``. A name of None is none.

        ValueError for a column or a name that is not known.
        """
        optional = {"inner", "left", "right", "edge", "shape"}, {"path", "foes", "yields", "signal", "index"}
        for kind, table, needed, more in (
            ("links", links, {"name", "length", "limit"}, optional[0]),
            ("moves", moves, {"start", "end"}, optional[1]),
        ):
            if lacks := needed - set(table):
                raise ValueError(f"network: {kind} need a column '{lacks.pop()}'.")
            if unknown := set(table) - needed - more:
                raise ValueError(f"network: {kind} have an unknown column '{(u := unknown.pop())}'.{nearest(u, more)}")
        names = tuple(map(str, links["name"]))
        rows, signals = ({x: i for i, x in enumerate(each)} for each in (names, [p.name for p in plans]))

        def place(what: str, numbers: Mapping[str, int], name: Any) -> int:
            if name is not None and str(name) not in numbers:
                raise ValueError(f"network: {what} {shown(str(name))} does not exist.{nearest(str(name), numbers)}")
            return NONE if name is None else numbers[str(name)]

        columns: dict[str, Any] = {k: links[k] for k in ("length", "limit", "inner", "edge", "shape") if k in links}
        columns |= {k: [place("link", rows, x) for x in links[k]] for k in ("left", "right") if k in links}
        columns |= {k: [place("link", rows, x) for x in moves[k]] for k in ("start", "end")}
        columns |= {k: padded(moves[k]) for k in ("foes", "yields") if k in moves}
        columns["path"] = padded([[place("link", rows, x) for x in row] for row in moves.get("path", [[]])])
        columns["signal"] = [place("signal", signals, x) for x in moves.get("signal", [None])]
        columns["index"] = [NONE if x is None else x for x in moves.get("index", [None])]
        return cls(names, plans=tuple(plans), **columns)

    @classmethod
    def from_sumo(cls, path: str | Path) -> Network:
        """Return the network of a ``.net.xml`` of SUMO: every lane that cars may use is a link.

        ``skipped`` counts what was left out or changed. ValueError, in one line that names the element, for a file that
        cannot be used.
        """
        return cls._from_plain(sumo_network.read_tables(Path(path)))

    @classmethod
    def grid(
        cls, rows: int, columns: int, *, block: float = 200.0, arm: float = 200.0, limit: float = 13.89,
        control: str = "signals", green: float = 42.0, amber: float = 3.0, lanes: int = 1,
    ) -> Network:  # fmt: skip
        """Return so many crossings, ``block`` m apart, around them arms of ``arm`` m; names are netgenerate's.

        Of several ``lanes`` a direction the right one turns right, the left one turns left, and each goes on.

        ``control`` is signals, priority (streets from south to north), right_before_left or none. ValueError for
        numbers that allow no grid.
        """
        return cls._from_plain(streets.grid(rows, columns, block, arm, limit, control, lanes).tables(green, amber))

    @classmethod
    def crossing(cls, **options: Any) -> Network:
        """Return a grid of one crossing, with the options of a grid; ValueError as there."""
        return cls.grid(1, 1, **options)

    @classmethod
    def roundabout(cls, arms: int = 4, *, radius: float = 20.0, arm: float = 200.0, limit: float = 13.89) -> Network:
        """Return a roundabout: ``in0`` to ``ring0`` to ``out1``, counter-clockwise, and the ring goes first.

        ValueError for a radius (m) at which so many arms do not fit.
        """
        return cls._from_plain(streets.roundabout(arms, radius, arm, limit).tables())

    @classmethod
    def figure_eight(cls, *, radius: float = 30.0, limit: float = 13.89, control: str = "priority") -> Network:
        """Return two loops, ``east`` and ``west``, that cross once; who drives eastwards has priority, or nobody.

        ValueError for a radius below 15 m.
        """
        return cls._from_plain(streets.figure_eight(radius, limit, control).tables())

    @classmethod
    def _from_plain(cls, tables: sumo_network.NetworkTables) -> Network:
        network = cls.from_tables(tables.links, tables.moves, [Plan(*plan) for plan in tables.plans])
        object.__setattr__(network, "skipped", dict(tables.skipped))
        return network

    # -- what follows from the tables ----------------------------------------------------------------------------

    @cached_property
    def move_of(self) -> Array:
        """The move that each inner link is a part of (L), −1 outside junctions."""
        moves = np.full(len(self.names) + 1, NONE, np.int32)
        moves[self.path] = np.arange(len(self.path))[:, None]
        return moves[:-1]

    @cached_property
    def follows(self) -> Array:
        """Pairs of links of which one follows the other, or is outside junctions the lane beside it (K, 2), sorted."""
        table = np.concatenate((self.start[:, None], self.path, self.end[:, None]), 1)
        ways = [way[way >= 0].tolist() for way in table]
        ways += [[k, other, k] for k, other in enumerate(self.left.tolist()) if other >= 0 and not self.inner[k]]
        pairs = {pair for way in ways for pair in pairwise(way)}
        return np.array(sorted(pairs), np.int64).reshape(-1, 2)

    def times(self, routes: Array) -> Array:
        """Return the time at the limits on each link of routes ``(R, H)`` (s), 0 where one goes on to that beside."""
        after = np.pad(routes[:, 1:], ((0, 0), (0, 1)), constant_values=NONE)
        aside = (after >= 0) & ((self.left[routes] == after) | (self.right[routes] == after))
        return np.where((routes >= 0) & ~aside, (self.length / self.limit)[routes], 0.0)

    @cached_property
    def cramped(self) -> Array:
        """Whether a link is too short to stop at its end at the limit, in an emergency, and to leave room (L)."""
        return self.length < 15.0 + self.limit**2 / 18.0

    @cached_property
    def shows(self) -> tuple[Array, Array]:
        """Aspects of all phases by index (P, K), and the row of each signal's first phase (S + 1)."""
        rows = [[LETTERS[c] for c in state] for plan in self.plans for state in plan.states]
        return padded(rows), np.cumsum([0, *(len(plan.states) for plan in self.plans)])

    def ever_open(self, move: int) -> bool:
        """Return whether a move may be made at some time."""
        if (s := int(self.signal[move])) < 0:
            return True
        phases = zip(self.plans[s].states, self.plans[s].durations, strict=True)
        return any(LETTERS[state[self.index[move]]] in (GREEN, YIELD) for state, lasts in phases if lasts > 0.0)

    @cached_property
    def circles(self) -> list[list[int]]:
        """Moves without a signal that yield in a circle."""
        move, place = np.nonzero((self.yields >= 0) & (self.signal < 0)[:, None])
        first = self.yields[move, place]
        pairs = np.stack((move, first))[:, self.signal[first] < 0]
        if not pairs.size:
            return []
        from scipy.sparse import coo_array, csgraph  # takes a second

        graph = coo_array((np.ones(pairs.shape[1]), pairs), (len(self.start), len(self.start)))
        parts = csgraph.connected_components(graph, connection="strong")[1]
        return [np.flatnonzero(parts == k).tolist() for k in np.flatnonzero(np.bincount(parts) > 1)]

    def cautions(self) -> tuple[str, ...]:
        """Return, a line each, what may come to a standstill: moves that yield in a circle, or foes of equal right."""
        free, lines = self.signal < 0, []
        for circle in self.circles:
            names = ", ".join(map(self.move_name, circle))
            lines.append(f"moves {names} yield in a circle, and may block one another.")
        for m in np.flatnonzero(free).tolist():
            for f in self.foes[m].tolist():
                equal = f > m and free[f] and f not in self.yields[m] and m not in self.yields[f]
                if equal and self.start[f] != self.start[m]:
                    lines.append(f"moves {self.move_name(m)} and {self.move_name(f)} cross, and neither goes first.")
        return tuple(lines)

    def move_name(self, move: int) -> str:
        """Return the name of a move in errors."""
        return f"{self.names[self.start[move]]}→{self.names[self.end[move]]}"

    # -- a road --------------------------------------------------------------------------------------------------

    @property
    def leaving(self) -> bool:
        """Whether vehicles leave by themselves: at the end of their route."""
        return True

    def lane_state(
        self, position: Tensor, length: Tensor, lane: Tensor | int | None, present: Tensor | None
    ) -> LaneState:
        """Return the state of vehicles that are on their links and go nowhere; ``journeys`` are given by demand."""
        return unlinked(len(self.names), position, lane)

    def view(self, state: State) -> Travelled:
        """Return the network as it is in this state, with everybody's leader along his route."""
        assert state.lanes is not None
        return Travelled(state.lanes, state.position)

    def _refuse(self, *_: object) -> Tensor:
        raise TypeError("networks are seen through a state: road.view(state).")

    ahead = back = led = gaps = _refuse  # type: ignore[assignment]


def _check_links(net: Network) -> None:
    links = len(net.names)
    if not links:
        raise ValueError("network: there are no links.")
    if len(set(net.names)) < links:
        double = next(n for i, n in enumerate(net.names) if n in net.names[:i])
        raise ValueError(f"network: link '{double}' is given twice.")
    for name, size in (("edge", len(net.edge)), ("shape", len(net.shape) or links)):
        if size != links:
            raise ValueError(f"network: {name} has {size} entries for {links} links.")
    least = np.where(net.inner, SHORTEST_INNER, SHORTEST)
    for k in np.flatnonzero(~((net.length >= least) & np.isfinite(net.length))):
        raise ValueError(f"link '{net.names[k]}': length = {net.length[k]:g} m must be at least {least[k]:g} m.")
    for k in np.flatnonzero(~((net.limit > 0.0) & np.isfinite(net.limit))):
        raise ValueError(f"link '{net.names[k]}': limit = {net.limit[k]:g} m/s must be above 0.")
    for name, back in (("left", "right"), ("right", "left")):
        others = getattr(net, name)
        _in_range(net, name, others, links, lambda k: f"link '{net.names[k]}'")
        for k in np.flatnonzero(others >= 0):
            if getattr(net, back)[others[k]] != k or net.inner[others[k]] != net.inner[k]:
                raise ValueError(f"link '{net.names[k]}': '{net.names[others[k]]}' is {name} of it, and not it {back}.")


def _in_range(net: Network, name: str, values: Array, count: int, who: Any) -> None:
    outside = (values < NONE) | (values >= count)
    for row in np.flatnonzero(outside.any(-1) if values.ndim > 1 else outside):
        worst = int(np.atleast_1d(values[row])[np.atleast_1d(outside[row])][0])
        raise ValueError(f"{who(row)}: {name} = {worst} does not exist; there are {count}, from 0 on.")


def _check_moves(net: Network) -> None:
    moves, links = len(net.start), len(net.names)
    for name, count in (("start", links), ("end", links), ("path", links), ("signal", len(net.plans))):
        _in_range(net, name, getattr(net, name), count, lambda m: f"move {m}")
    for name in ("foes", "yields"):
        _in_range(net, name, getattr(net, name), moves, lambda m: f"move {net.move_name(m)}")
    for m in range(moves):
        who, way = f"move {net.move_name(m)}", net.path[m][net.path[m] >= 0]
        if min(net.start[m], net.end[m]) < 0 or net.inner[net.start[m]] or net.inner[net.end[m]]:
            raise ValueError(f"{who}: must begin and end on links that are not inside a junction.")
        for k in way[(net.move_of[way] != m) | ~net.inner[way]]:
            raise ValueError(f"{who}: link '{net.names[k]}' of its path must be inside a junction, and of this move.")
        for f in net.foes[m][net.foes[m] >= 0]:
            if f == m or m not in net.foes[f]:
                raise ValueError(f"{who}: its foe {net.move_name(f)} must be another move, and have it as a foe.")
        if m in net.yields[m]:
            raise ValueError(f"{who}: yields to itself.")
        if not len(way) and (net.signal[m] >= 0 or net.foes[m].max() >= 0 or net.yields[m].max() >= 0):
            raise ValueError(f"{who}: has foes or a signal, and no inner link. Give its path.")
    for k in np.flatnonzero(np.bincount(net.end, minlength=links) > 1):
        merging = np.flatnonzero(net.end == k).tolist()
        for m, other in pairwise(sorted(merging, key=lambda m: net.start[m])):
            if net.start[m] == net.start[other]:
                raise ValueError(f"move {net.move_name(m)} is given twice.")
        for m in merging:
            for other in set(merging) - {m, *net.foes[m].tolist()}:
                raise ValueError(f"moves {net.move_name(m)} and {net.move_name(other)} merge, and must be foes.")


def _check_plans(net: Network) -> None:
    for s, plan in enumerate(net.plans):
        who = f"signal '{plan.name}'"
        if not plan.states or len(plan.states) != len(plan.durations):
            raise ValueError(f"{who}: {len(plan.durations)} durations for {len(plan.states)} states.")
        if not (all(0.0 <= d < np.inf for d in plan.durations) and any(plan.durations) and np.isfinite(plan.offset)):
            rule = "must be numbers from 0 on, not all 0, its offset a number"
            raise ValueError(f"{who}: durations {shown(plan.durations)} s {rule}.")
        if wrong := set("".join(plan.states)) - set(LETTERS):
            raise ValueError(f"{who}: letter '{min(wrong)}' of a state is unknown. Known: {' '.join(LETTERS)}.")
        mine = np.flatnonzero(net.signal == s)
        for state in plan.states:
            for m in mine[(net.index[mine] < 0) | (net.index[mine] >= len(state))]:
                shows = f"move {net.move_name(m)} is shown number {net.index[m]}, from 0 on"
                raise ValueError(f"{who}: state {shown(state)} has {len(state)} letters, and {shows}.")
