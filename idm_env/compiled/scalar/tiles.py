"""A program printed for tiles of lanes and rings: rows of a workspace, and phases that run over them.

The loops are ``kernels/lane_loops.py``, which contain no equation: they call what is printed here, and are told where
in the workspace everything is.
"""

from __future__ import annotations

from functools import cached_property

from idm_env.compiled.scalar.graph import Leaf, Node, inputs_of
from idm_env.compiled.scalar.program import PHASES, Program
from idm_env.compiled.scalar.source import Constants, Write, assignments, body, function, row


class TileText:
    """The printed half of a compiled rollout of lanes or rings."""

    def __init__(self, program: Program, *, ring: bool, flags: tuple[str, ...]) -> None:
        self.program = program
        self.constants = Constants()
        self._rows: list[str] = []
        self.ring = ring
        p = program
        self._back = {phase: p.backward(phase) for phase in PHASES}
        self.signals = len(p.sense)
        self._begin("STATE", [row(Leaf(n)) for n in p.states])
        self._begin("ON", [f"ON_{row(Leaf(n))}" for n in p.moving])
        self._begin("STATIC", [row(Leaf(n)) for n in (*p.statics, *p.parameters)])
        self._begin("HOISTED", [row(Leaf(n)) for n in p.constants_of_time])
        self._begin("GRADIENT", [f"ON_{row(Leaf(n))}" for n in p.parameters])
        self._begin("ON_HOISTED", [f"ON_{row(Leaf(n))}" for n in p.constants_of_time])
        self.numbers = tuple(n for n in p.inputs if n not in flags)
        self.flags = tuple(n for n in p.inputs if n in flags)
        self._begin("INPUT", [row(Leaf(n)) for n in (*self.numbers, *self.flags)])
        self._begin("ON_INPUT", [f"ON_{row(Leaf(n))}" for n in self.numbers])
        neighbours = {s for phase in PHASES for s in p.neighbours(self._read(phase))}
        self._neighbours = sorted(self._chain(neighbours), key=lambda s: (abs(s.shift), s))
        self._begin("SIGNAL", [row(Leaf(f"signal {i}")) for i in range(self.signals)])
        self._begin("ON_SIGNAL", [f"ON_{row(Leaf(f'signal {i}'))}" for i in range(self.signals)])
        self._begin("RECALLED", [row(r.slot) for r in p.recalls])
        self._begin("ON_RECALLED", [f"ON_{row(r.slot)}" for r in p.recalls])
        self._begin("AGO", [row(Leaf(f"ago {i}")) for i in range(len(p.recall))])
        self._begin(
            "OTHER", ["DISPLACEMENT", "ON_DISPLACEMENT", "SCRATCH", "SCRATCH_TOO", *(row(s) for s in self._neighbours)]
        )
        self._rows += [f"SENT_{row(s)}" for phase in PHASES for s in self._back[phase].sent]
        self._rows = list(dict.fromkeys([*self._rows, "SEEDED"]))

    def _begin(self, group: str, names: list[str]) -> None:
        self._groups = {**getattr(self, "_groups", {}), group: (len(self._rows), len(names))}
        self._rows += names

    def _read(self, phase: str) -> list[Node]:
        return [*self.program.outputs(phase), *self._back[phase].nodes]

    @staticmethod
    def _chain(slots: set[Leaf]) -> set[Leaf]:
        """Add the nearer vehicles over which a number is handed on to those further away."""
        chain = set()
        for s in slots:
            sign = 1 if s.shift > 0 else -1
            chain |= {Leaf(s.name, sign * k) for k in range(1, abs(s.shift) + 1)}
        return chain

    # -- where things are ----------------------------------------------------------------------------------------

    def at(self, name: str) -> int:
        """Return the number of a row."""
        return self._rows.index(name)

    @property
    def rows(self) -> int:
        """Number of rows of a workspace."""
        return len(self._rows)

    def group(self, name: str) -> int:
        """Return the first row of a group."""
        return self._groups[name][0]

    def indices(self, names: tuple[str, ...]) -> tuple[int, ...]:
        """Return the places of states."""
        return tuple(self.program.states.index(n) for n in names)

    @cached_property
    def read(self) -> tuple[str, ...]:
        """States whose value before a step matters to what a rollout returns."""
        nodes = [n for phase in PHASES for n in self.program.outputs(phase)]
        read = {s.name for s in inputs_of(nodes)} | {"position"}
        return tuple(n for n in self.program.states if n in read)

    def looks(self) -> dict[str, list[tuple[int, int, int]]]:
        """Return, by phase, the copies to make before it: (1 from the leader, −1 from behind; row to fill; source)."""
        fixed = [s for s in self._neighbours if s.name in self.program.statics]
        copies = {"static": self._looks(fixed)}
        rows = set(fixed)
        for phase in PHASES:
            near = [s for s in self._chain_of(phase) if s not in rows]
            if phase != "close":
                rows |= set(near)
            copies[phase] = self._looks(near)
        return copies

    def _looks(self, slots: list[Leaf]) -> list[tuple[int, int, int]]:
        copies = []
        for s in slots:
            step = 1 if s.shift > 0 else -1
            copies.append((step, self.at(self._row(s)), self.at(self._row(Leaf(s.name, s.shift - step)))))
        return copies

    def sends(self) -> dict[str, list[tuple[int, int, int]]]:
        """Return, by phase, the adjoints to send after it: (shift, row that is sent, row of the adjoint it adds to)."""
        return {
            phase: [
                (s.shift, self.at(f"SENT_{row(s)}"), self.at(f"ON_{self._row(Leaf(s.name))}"))
                for s in self._back[phase].sent
            ]
            for phase in PHASES
        }

    def _chain_of(self, phase: str) -> list[Leaf]:
        slots = self._chain(set(self.program.neighbours(self._read(phase))))
        return [s for s in self._neighbours if s in slots]

    # -- text ----------------------------------------------------------------------------------------------------

    def text(self, *, backward: bool) -> tuple[str, tuple[str, ...]]:
        """Return rows and phases as text, and the names of the phases that there are.

        ``constants.values`` are complete once both texts were made; those of the forward text come first.
        """
        phases = self._back_phases() if backward else self._phases()
        phases = {name: phase for name, phase in phases.items() if phase[1]}
        rows = assignments((name, f"{i} * ROW") for i, name in enumerate(self._rows))
        compiler = "swift" if backward else "exact"
        functions = [
            function(name, doc, body(writes, self._read_slot, self.constants), compiler)
            for name, (doc, writes) in phases.items()
        ]
        return "\n\n".join([rows, *functions]), tuple(phases)

    def _phases(self) -> dict[str, tuple[str, list[Write]]]:
        p = self.program
        hoist = dict(zip(p.constants_of_time, p.hoist, strict=True))
        return {
            name: (doc, [Write(f"w[{row(Leaf(n))} + j]", node) for n, node in named.items()])
            for name, doc, named in (
                ("hoist", "What depends on parameters alone.", hoist),
                ("sense", "Signals that the past keeps.", p.named("sense")),
                ("recall", "How many steps ago somebody looks back to.", p.named("recall")),
                ("respond", "Motion and memories after the step.", p.named("respond")),
                ("close", "Gaps after the step.", p.named("close")),
            )
        }

    def _back_phases(self) -> dict[str, tuple[str, list[Write]]]:
        hoist = [Write(f"w[ON_{row(s)} + j]", x, adds=True) for s, x in self.program.hoist_backward().items()]
        phases = {"hoist_back": ("Adjoint of what depends on parameters alone.", hoist)}
        for phase in PHASES:
            back = self._back[phase]
            # An adjoint that only passes through stays where it is.
            passing = {s for s, x in back.assigned.items() if x is self.program.graph.input(f"on {s.name}")}
            writes = [Write(f"w[ON_{self._row(s)} + j]", x) for s, x in back.assigned.items() if s not in passing]
            writes += [Write(f"w[ON_{self._row(s)} + j]", x, adds=True) for s, x in back.added.items()]
            writes += [Write(f"w[SENT_{row(s)} + j]", x) for s, x in back.sent.items()]
            phases[f"{phase}_back"] = (f"Adjoint of {phase}.", writes)
        return phases

    def _row(self, slot: Leaf) -> str:
        # By the time that gaps are closed, positions are those after the step.
        return row(Leaf("position") if slot == Leaf("position after") else slot)

    def _read_slot(self, slot: Leaf) -> str:
        if slot.name.startswith("on "):
            return f"w[ON_{row(Leaf(slot.name[3:]))} + j]"
        return f"w[{self._row(slot)} + j]"
