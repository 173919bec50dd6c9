"""One driver behind a record, printed: rows of a workspace, and phases that run over them.

The loops are ``kernels/driver_loops.py``, which contain no equation; a ``RowLayout`` tells them where everything is.
"""

from __future__ import annotations

from collections import namedtuple
from functools import cached_property

from idm_env.compiled.scalar.driver import DriverProgram, Tangents
from idm_env.compiled.scalar.graph import Leaf, Node
from idm_env.compiled.scalar.source import Constants, Write, assignments, body, function, row

VALUES = ("hoist", "sense", "respond")
"""Phases of a step, in the order of their addresses."""

TANGENTS = ("fix", "linearise", "carry_sense", "carry")
"""Phases that tangents need beside: once, for all directions of a step, and per direction."""

ADJOINT = ("hoist_back", "sense_back", "respond_back")
"""Adjoints of a step's phases."""


RowLayout = namedtuple(
    "RowLayout",
    "size states n_states statics n_statics records n_records agos n_agos past n_past signals n_signals "
    "blocks block n_blocks tangent_signals n_moving_signals tangent_past on_states n_moving on_parameters "
    "n_parameters on_hoisted n_hoisted on_past on_signals",
)
"""Where a loop finds everything: first indices of groups of rows in the workspace, and how many rows they have.

A direction's tangents are a block of rows of its own: of states (gap and speed first), signals and the past.
"""


def _named(name: str) -> str:
    return row(Leaf(name))


class DriverText:
    """Rows and phases of one program, with tangents along ``directions`` and with the adjoint where wanted."""

    def __init__(
        self, program: DriverProgram, distance: int, *, directions: tuple[str, ...] = (), adjoint: bool = False
    ) -> None:
        self.program = p = program
        self.constants = Constants()
        self.tangents = p.tangents(directions) if directions else Tangents()
        self._distance = distance
        self._rows: list[str] = []
        self._groups: dict[str, tuple[int, int]] = {}
        self._group("states", [_named(n) for n in p.states])
        self._group("statics", [_named(n) for n in p.parameters] + [row(s) for s in p.constants])
        self._group("hoisted", [_named(n) for n in p.constants_of_time])
        self._group("agos", [f"AGO_{i}" for i in range(len(p.agos))])
        self._group("records", [row(s) for s in p.records])
        self._group("past", [f"PAST_{i}" for i in range(len(p.seen))])
        self._group("signals", [f"SIGNAL_{i}" for i in p.signals])
        if adjoint:
            self._group("on_states", [_named(f"on {n}") for n in p.states if n in p.moving])
            self._group("on_parameters", [_named(f"on {n}") for n in p.parameters])
            self._group("on_hoisted", [_named(f"on {n}") for n in p.constants_of_time])
            self._group("on_past", [f"ON_PAST_{i}" for i in range(len(p.seen))])
            self._group("on_signals", [f"ON_SIGNAL_{i}" for i in p.signals])
        self._group("fixed", [_named(f"fixed{i}") for i in range(len(self.tangents.hoist))])
        self._group("slopes", [_named(f"slope {i}") for i in range(len(self.tangents.slopes))])
        block = [_named(f"tangent {n}") for n in p.moving] + [f"SOURCE_{i}" for i in range(self.tangents.targets)]
        block += [f"TANGENT_SIGNAL_{i}" for i in self.tangents.sense]
        block += [f"TANGENT_PAST_{i}" for i, _ in self.moving_past]
        self._block = {name: i for i, name in enumerate(block)}
        self._directions = directions
        self._phases = self._all(adjoint)

    @cached_property
    def moving_past(self) -> list[tuple[int, int]]:
        """What directions see of the past: (place among what is seen, place among moving signals)."""
        moving = list(self.tangents.sense)
        return [(i, moving.index(s)) for i, (s, _) in enumerate(self.program.seen) if s in moving]

    def _group(self, group: str, names: list[str]) -> None:
        self._groups[group] = (len(self._rows), len(names))
        self._rows += names

    @cached_property
    def layout(self) -> RowLayout:
        """Return where everything is."""
        begins = {name: begin * self._distance for name, (begin, _) in self._groups.items()}
        count = {f"n_{name}": many for name, (_, many) in self._groups.items()}
        directions, distance = len(self._directions), self._distance
        block = len(self._block) * distance
        numbers = {
            **begins, **count, "n_parameters": len(self.program.parameters), "n_moving": len(self.program.moving),
            "blocks": len(self._rows) * distance, "block": block, "n_blocks": directions,
            "size": len(self._rows) * distance + directions * block + distance,
            "tangent_signals": (len(self.program.moving) + self.tangents.targets) * distance,
            "n_moving_signals": len(self.tangents.sense),
            "tangent_past": (len(self.program.moving) + self.tangents.targets + len(self.tangents.sense)) * distance,
        }  # fmt: skip
        return RowLayout(*(numbers.get(name, 0) for name in RowLayout._fields))

    @cached_property
    def phases(self) -> tuple[str, ...]:
        """Names of the phases that there are."""
        return tuple(name for name, (_, writes, _) in self._phases.items() if writes)

    @cached_property
    def text(self) -> str:
        """Return rows and phases; ``constants`` are complete then."""
        names = [(name, f"{i} * ROW") for i, name in enumerate(self._rows)]
        names += [(f"OF_{name}", f"{i} * ROW") for name, i in self._block.items()]
        texts = [assignments(names)]
        for name, (doc, writes, compiler) in self._phases.items():
            if writes:
                takes = ("w", "h") if compiler == "beside" else ("w",)
                texts.append(function(name, doc, body(writes, self._read, self.constants), compiler, takes))
        return "\n\n".join(texts)

    def _all(self, adjoint: bool) -> dict[str, tuple[str, list[Write], str]]:
        p, tangents = self.program, self.tangents
        hoist = _writes([(_named(n), x) for n, x in zip(p.constants_of_time, p.hoist, strict=True)])
        hoist += _writes([(f"AGO_{i}", x) for i, x in enumerate(p.agos)])
        slopes = _writes([(_named(f"slope {i}"), x) for i, x in enumerate(tangents.slopes)])
        slopes += [Write(f"w[{self._source(*place)} + j]", x) for place, x in tangents.sources.items()]
        fixed = _writes([(_named(f"fixed{i}"), x) for i, x in enumerate(tangents.hoist)])
        signals = [Write(f"h[OF_TANGENT_SIGNAL_{i} + j]", x) for i, x in tangents.sense.items()]
        carry = [Write(f"h[OF_{_named(f'tangent {n}')} + j]", x) for n, x in tangents.carry.items()]
        phases = {
            "hoist": ("What depends on parameters alone.", hoist, "exact"),
            "sense": ("What the past keeps.", _writes([(f"SIGNAL_{i}", x) for i, x in p.sense.items()]), "exact"),
            "respond": ("States after the step.", _writes([(_named(n), x) for n, x in p.after.items()]), "exact"),
            "fix": ("Slopes that depend on parameters alone.", fixed, "swift"),
            "linearise": ("Slopes of a step.", slopes, "swift"),
            "carry_sense": ("What the past keeps of one direction.", signals, "beside"),
            "carry": ("Tangents of one direction after the step.", carry, "beside"),
        }
        return phases | (self._back() if adjoint else {})

    def _source(self, target: int, direction: int) -> str:
        place = self._block[f"SOURCE_{target}"] + direction * len(self._block)
        return f"{len(self._rows) + place} * ROW"

    def _back(self) -> dict[str, tuple[str, list[Write], str]]:
        p = self.program
        responded = p.respond_back()
        assigned = [(n, responded.pop(n, p.graph.constant(0.0))) for n in p.moving]
        assigned += [(f"past {i}", responded.pop(f"past {i}", p.graph.constant(0.0))) for i in range(len(p.seen))]
        writes = _writes([(_named(f"on {n}"), x) for n, x in assigned])
        return {
            "respond_back": ("Adjoint of respond.", writes + _added(responded), "swift"),
            "sense_back": ("Adjoint of sense.", _added(p.sense_back()), "swift"),
            "hoist_back": ("Adjoint of hoist.", _added(p.hoist_back()), "swift"),
        }

    def _read(self, slot: Leaf) -> str:
        name = row(slot)
        return f"h[OF_{name} + j]" if name in self._block else f"w[{name} + j]"


def _writes(pairs: list[tuple[str, Node]]) -> list[Write]:
    return [Write(f"w[{name} + j]", node) for name, node in pairs]


def _added(nodes: dict[str, Node]) -> list[Write]:
    return [Write(f"w[{_named(f'on {name}')} + j]", node, adds=True) for name, node in nodes.items()]
