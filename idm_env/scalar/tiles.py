"""A program printed for tiles of lanes and rings: rows of a workspace, and phases that run over them.

The loops are ``kernels/lane_loops.py``, which contain no equation: this prints what they import, and both together are
one file (``library``).
"""

from __future__ import annotations

from idm_env.scalar.graph import Node, Slot, inputs_of
from idm_env.scalar.program import PHASES, Program
from idm_env.scalar.source import Ago, Constants, Write, assignments, function, row


class TileText:
    """The printed half of a compiled rollout of lanes or rings."""

    def __init__(self, program: Program, *, ring: bool, flags: tuple[str, ...]) -> None:
        self.program = program
        self.constants = Constants()
        self._rows: list[str] = []
        self._ring = ring
        p = program
        self._back = {phase: p.backward(phase) for phase in PHASES}
        self.signals = len(p.sense)
        self._begin("STATE", [row(Slot(n)) for n in p.states])
        self._begin("ON", [f"ON_{row(Slot(n))}" for n in p.moving])
        self._begin("STATIC", [row(Slot(n)) for n in (*p.statics, *p.parameters)])
        self._begin("HOISTED", [row(Slot(n)) for n in p.constants_of_time])
        self._begin("GRADIENT", [f"ON_{row(Slot(n))}" for n in p.parameters])
        self._begin("ON_HOISTED", [f"ON_{row(Slot(n))}" for n in p.constants_of_time])
        self.numbers = tuple(n for n in p.inputs if n not in flags)
        self.flags = tuple(n for n in p.inputs if n in flags)
        self._begin("INPUT", [row(Slot(n)) for n in (*self.numbers, *self.flags)])
        self._begin("ON_INPUT", [f"ON_{row(Slot(n))}" for n in self.numbers])
        neighbours = {s for phase in PHASES for s in p.neighbours(self._read(phase))}
        self._neighbours = sorted(self._chain(neighbours), key=lambda s: (abs(s.shift), s))
        self._begin("OTHER", ["DISPLACEMENT", "ON_DISPLACEMENT", "SCRATCH", *(row(s) for s in self._neighbours)])
        self._rows += [f"SENT_{row(s)}" for phase in PHASES for s in self._back[phase].sent]
        self._rows = list(dict.fromkeys([*self._rows, "SEEDED"]))

    def _begin(self, group: str, names: list[str]) -> None:
        self._groups = {**getattr(self, "_groups", {}), group: (len(self._rows), len(names))}
        self._rows += names

    def _read(self, phase: str) -> list[Node]:
        back = self._back[phase]
        return [*self.program.outputs(phase), *back.nodes, *(at for _, at, _ in back.past)]

    @staticmethod
    def _chain(slots: set[Slot]) -> set[Slot]:
        """Add the nearer vehicles over which a number is handed on to those further away."""
        return {
            Slot(s.name, sign * k) for s in slots for sign in [1 if s.shift > 0 else -1] for k in range(1, abs(s.shift) + 1)
        }

    # -- text ----------------------------------------------------------------------------------------------------

    def text(self) -> str:
        """Return rows, counts and functions; ``constants.values`` are complete afterwards."""
        p = self.program
        counts = [
            ("ROWS", len(self._rows)),
            ("RING", self._ring),
            ("STATES", len(p.states)),
            ("MOVING", len(p.moving)),
            ("STATICS", len(p.statics)),
            ("PARAMETERS", len(p.parameters)),
            ("HOISTS", len(p.hoist)),
            ("NUMBERS", len(self.numbers)),
            ("FLAGS", len(self.flags)),
            ("SIGNALS", self.signals),
            ("READ", self._indices(self._states_read())),
            ("TAPED", self._indices(p.needed_backward)),
            ("AGAIN", self._indices(p.needed_again)),
        ]
        rows = [(name, f"{i} * ROW") for i, name in enumerate(self._rows)]
        groups = [(f"{group}_ROWS", f"{begin} * ROW") for group, (begin, _) in self._groups.items()]
        parts = [assignments(counts), assignments(rows), assignments(groups), *self._functions()]
        return "\n\n".join(parts)

    def _states_read(self) -> tuple[str, ...]:
        """States whose value before a step matters, to what a rollout returns."""
        nodes = [n for phase in PHASES for n in self.program.outputs(phase)]
        read = {s.name for s in inputs_of(nodes)} | ({"position"} if "position" in self.program.states else set())
        return tuple(n for n in self.program.states if n in read)

    def _indices(self, names: tuple[str, ...]) -> tuple[int, ...]:
        return tuple(self.program.states.index(n) for n in names)

    def _functions(self) -> list[str]:
        p = self.program
        hoist = [Write(f"w[{row(Slot(n))} + j]", x) for n, x in zip(p.constants_of_time, p.hoist, strict=True)]
        back = [Write(f"w[ON_{row(slot)} + j]", x, adds=True) for slot, x in p.hoist_backward().items()]
        made = [
            self._function("hoist", "Compute what depends on parameters alone.", hoist, "exact"),
            self._function("hoist_back", "Carry adjoints of the hoisted rows to the parameters.", back, "swift"),
            self._look("look_static", "Fill what holds for a whole rollout.", self._static_neighbours()),
        ]
        known = set(self._static_neighbours())
        for phase in PHASES:
            near = [s for s in self._chain_of(phase) if s not in known]
            if phase != "close":
                known |= set(near)
            made.append(self._look(f"look_{phase}", "Copy neighbours' numbers beside one's own.", near))
            made.append(self._forward(phase))
            made.append(self._backward(phase))
            made.append(self._send(phase))
        return made

    def _chain_of(self, phase: str) -> list[Slot]:
        slots = self._chain(set(self.program.neighbours(self._read(phase))))
        return [s for s in self._neighbours if s in slots]

    def _static_neighbours(self) -> list[Slot]:
        fixed = {*self.program.statics}
        return [s for s in self._neighbours if s.name in fixed]

    def _look(self, name: str, doc: str, slots: list[Slot]) -> str:
        lines = [f"@exact\ndef {name}(w, n, size):", f'    """{doc}"""']
        for s in slots:
            step = 1 if s.shift > 0 else -1
            source = Slot(s.name, s.shift - step)
            verb = "look_ahead" if step > 0 else "look_back"
            lines.append(f"    {verb}(w, {self._row(s)}, {self._row(source)}, n, size, RING)")
        return "\n".join([*lines, *([] if slots else ["    return"]), ""])

    def _row(self, slot: Slot) -> str:
        # By the time that gaps are closed, positions are those after the step.
        return row(Slot("position") if slot == Slot("position after") else slot)

    def _read_slot(self, slot: Slot) -> str:
        if slot.name.startswith("on signal "):
            return f"ah[(now * SIGNALS + {slot.name.split()[-1]}) * ROW + j]"
        if slot.name.startswith("on "):
            return f"w[ON_{row(Slot(slot.name[3:]))} + j]"
        return f"w[{self._row(slot)} + j]"

    def _past(self, array: str, signal: int, ago: str) -> str:
        return f"{array}[((now - int({ago})) * SIGNALS + {signal}) * ROW + j]"

    def _function(self, name: str, doc: str, writes: list[Write], compiler: str, arguments: str = "w, m, k") -> str:
        return function(name, arguments, doc, writes, self._read_slot, self._past, self.constants, compiler)

    def _forward(self, phase: str) -> str:
        p = self.program
        if phase == "sense":
            writes = [Write(f"h[(now * SIGNALS + {i}) * ROW + j]", x) for i, x in enumerate(p.sense)]
        else:
            named = p.respond if phase == "respond" else p.close
            writes = [Write(f"w[{self._row(Slot(n))} + j]", x) for n, x in named.items()]
        return self._function(phase, f"Forward: {phase}.", writes, "exact", "w, h, m, k, now")

    def _backward(self, phase: str) -> str:
        back = self._back[phase]
        writes = [Write(f"w[ON_{self._row(s)} + j]", x) for s, x in back.assigned.items()]
        writes += [Write(f"w[ON_{self._row(s)} + j]", x, adds=True) for s, x in back.added.items()]
        writes += [Write(f"w[SENT_{row(s)} + j]", x) for s, x in back.sent.items()]
        writes += [Write(Ago(signal, at), g, adds=True) for signal, at, g in back.past]
        return self._function(f"{phase}_back", f"Adjoint: {phase}.", writes, "swift", "w, h, ah, m, k, now")

    def _send(self, phase: str) -> str:
        lines = [f"@exact\ndef {phase}_send(w, n, size):", '    """Send what fell on neighbours\' numbers to them."""']
        for s in self._back[phase].sent:
            verb = "send_ahead" if s.shift > 0 else "send_back"
            for _ in range(abs(s.shift) - 1):
                lines.append(f"    {verb}(w, SCRATCH, SENT_{row(s)}, n, size, RING)")
                lines.append(f"    replace(w, SENT_{row(s)}, SCRATCH, n)")
            lines.append(f"    {verb}(w, SCRATCH, SENT_{row(s)}, n, size, RING)")
            lines.append(f"    gather(w, ON_{self._row(Slot(s.name))}, SCRATCH, n)")
        return "\n".join([*lines, *([] if self._back[phase].sent else ["    return"]), ""])
