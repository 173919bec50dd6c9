"""One driver behind a record: his step alone, its adjoint, and how tangents are carried through it, as graphs.

Everybody else is a record, so a neighbour's number is a row that a loop fills, and no derivative flows into it. States
are the driver's own gap and speed, and whatever else these depend on: gaps of neighbours among them, where an effect
looks at one. What is true of all drivers at all times (there is a leader, no record moves the driver) is folded in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from idm_env.compiled.scalar.derive import adjoint
from idm_env.compiled.scalar.graph import CONSTANT, DYNAMIC, STATIC, Leaf, Node, hoisted, inputs_of, ordered, replaced
from idm_env.compiled.scalar.program import recalled
from idm_env.compiled.scalar.record import Recording, Untraceable

OWN = ("gap", "speed", "position", "accel")
FIXED_IN_TIME = ("length", "led", "leads")


def neighbours_gap(shift: int) -> str:
    """Return the name of the state that is a neighbour's gap."""
    return f"gap of {abs(shift)} {'ahead' if shift > 0 else 'behind'}"


def shift_of(name: str) -> int:
    """Return whose gap a state is: 0 the driver's own."""
    if name == "gap":
        return 0
    _, _, count, where = name.split()
    return int(count) * (1 if where == "ahead" else -1)


@dataclass
class Tangents:
    """How tangents along some parameters are carried over a step, one direction at a time.

    ``slopes`` are rows that all directions share, ``sources`` rows of one direction, by (target, number of direction);
    ``carry`` gives the tangents of the moving states after the step, ``sense`` those of the moving signals.
    """

    slopes: list[Node] = field(default_factory=list)
    sources: dict[tuple[int, int], Node] = field(default_factory=dict)
    targets: int = 0
    sense: dict[int, Node] = field(default_factory=dict)
    carry: dict[str, Node] = field(default_factory=dict)
    hoist: list[Node] = field(default_factory=list)


class DriverProgram:
    """The step of one driver; ``fixed`` are slots that have one value always.

    ``states`` are names, gap and speed first; ``after`` has the states after a step. ``sense`` has what the past
    keeps, by the numbers ``signals``. ``whole`` and ``whole_sense`` are the same with nothing hoisted, and ``hoist``
    depends on parameters alone. ``agos`` are how many steps ago somebody looks, ``seen`` the past as (signal, ago).
    ``Untraceable`` for an effect that looks back by a time that changes under way.
    """

    def __init__(self, recording: Recording, fixed: Mapping[Leaf, float]) -> None:
        self.graph = graph = recording.graph
        self._recording = recording
        names = list(recording.respond)
        assert recording.accel is not None
        nodes = [recording.accel, *recording.respond.values(), *recording.sense]
        self._fixed = {graph.input(*s): graph.constant(v) for s, v in fixed.items()} | self._gaps(nodes)
        nodes = replaced(graph, nodes, self._fixed)
        self._accel, sense = nodes[0], nodes[1 + len(names) :]
        self._respond = dict(zip(names, nodes[1:], strict=False))
        after = self._closure(sense)
        (*whole, self._accel), looks, self.agos = recalled(graph, [*after.values(), self._accel], "past {number}")
        if changing := next((steps for steps in self.agos if steps.level == DYNAMIC), None):
            raise Untraceable(f"effect '{changing.note}' looks back by a time that changes under way")
        self.seen = [(look.signal, look.ago) for look in looks]
        used = sorted({signal for signal, _ in self.seen})
        self.states = tuple(after)
        self.whole = dict(zip(after, whole, strict=True))
        self.whole_sense = [sense[i] for i in used]
        self.signals = tuple(used)
        cut, self.hoist = hoisted(graph, [*whole, *self.whole_sense])
        self.after = dict(zip(after, cut, strict=False))
        self.sense = dict(zip(used, cut[len(after) :], strict=False))

    # -- what a step is ------------------------------------------------------------------------------------------

    def _closure(self, sense: list[Node]) -> dict[str, Node]:
        """Return gap, speed and all states that these depend on, after a step."""
        after: dict[str, Node] = {}
        queue = ["gap", "speed"]
        while queue:
            name = queue.pop(0)
            if name not in after:
                after[name] = self._expression(name)
                nodes = [after[name]]
                nodes += sense if any(n.op == "past" for n in ordered(nodes)) else []
                queue += [s.name for s in inputs_of(nodes) if self._is_state(s)]
        return after

    def _is_state(self, slot: Leaf) -> bool:
        name = slot.name
        return not slot.shift and (name in OWN or name == "step" or name.startswith(("memory of ", "gap of ")))

    def _expression(self, name: str) -> Node:
        graph = self.graph
        if name == "step":
            return graph.add(graph.input("step"), graph.constant(1.0))
        if name == "gap" or name.startswith("gap of "):
            return self._gap(graph.shifted(self._recording.close["gap"], shift_of(name)))
        return self._respond[name]

    def _gaps(self, nodes: Sequence[Node]) -> dict[Node, Node]:
        """Return neighbours' gaps as states."""
        graph = self.graph
        return {
            graph.input("gap", s.shift): graph.input(neighbours_gap(s.shift))
            for s in inputs_of(nodes)
            if s.name == "gap" and s.shift
        }

    def _gap(self, close: Node) -> Node:
        """Return a gap after the step from everybody's motion: the driver's own, and the records'."""
        graph = self.graph
        moved: dict[Node, Node] = self._fixed | self._gaps([close])
        for slot in inputs_of([close]):
            node = graph.input(*slot)
            if slot == Leaf("displacement"):
                moved[node] = self._respond["displacement"]
            elif slot == Leaf("position after"):
                moved[node] = self._respond["position"]
            elif slot.name == "displacement":
                moved[node] = graph.sub(graph.input("position after", slot.shift), graph.input("position", slot.shift))
        return replaced(graph, [close], moved)[0]

    # -- what there is -------------------------------------------------------------------------------------------

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """States that have derivatives: all but the clock and gaps between records."""
        return tuple(n for n in self.states if n != "step" and not n.endswith(" ahead"))

    @cached_property
    def slots(self) -> list[Leaf]:
        """Everything that is read."""
        return inputs_of([*self.whole.values(), *self.whole_sense, *self.agos])

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Full names of the parameters that are read."""
        return tuple(s.name for s in self.slots if "." in s.name)

    @cached_property
    def constants(self) -> tuple[Leaf, ...]:
        """Constants of a whole rollout that are no parameters."""
        return tuple(s for s in self.slots if s.name in FIXED_IN_TIME)

    @cached_property
    def records(self) -> tuple[Leaf, ...]:
        """Values of records and inputs at every step."""
        others = [s for s in self.slots if not self._is_state(s) and s not in self.constants]
        return tuple(s for s in others if "." not in s.name and not s.name.startswith("past "))

    @cached_property
    def constants_of_time(self) -> tuple[str, ...]:
        """Names of the hoisted rows."""
        return tuple(f"hoisted{i}" for i in range(len(self.hoist)))

    # -- backwards -----------------------------------------------------------------------------------------------

    def _flows(self, name: str) -> bool:
        return name in self.moving or name.startswith(("hoisted", "past ")) or "." in name

    def _adjoint(self, nodes: Mapping[str, Node]) -> dict[str, Node]:
        seeds = [self.graph.input(f"on {name}", level=DYNAMIC) for name in nodes]
        parts = adjoint(self.graph, list(nodes.values()), seeds)
        own = {leaf.label: g for leaf, g in parts.items() if isinstance(leaf.label, Leaf) and not leaf.label.shift}
        return {label.name: g for label, g in own.items() if self._flows(label.name)}

    def respond_back(self) -> dict[str, Node]:
        """Return what falls on states, parameters, hoisted rows and the past from the states after a step."""
        return self._adjoint({n: x for n, x in self.after.items() if n in self.moving})

    def sense_back(self) -> dict[str, Node]:
        """Return what falls on them from the signals that the past keeps."""
        return self._adjoint({f"signal {i}": x for i, x in self.sense.items()})

    def hoist_back(self) -> dict[str, Node]:
        """Return what falls on the parameters from the hoisted rows."""
        seeds = [self.graph.input(f"on {name}", level=STATIC) for name in self.constants_of_time]
        parts = adjoint(self.graph, self.hoist, seeds)
        return {leaf.label.name: g for leaf, g in parts.items() if isinstance(leaf.label, Leaf)}

    # -- forwards ------------------------------------------------------------------------------------------------

    def tangents(self, names: tuple[str, ...]) -> Tangents:
        """Return how the tangents along some parameters are carried.

        Most of a step flows through few numbers (the acceleration, new memories). Derivatives are taken up to these and
        beyond them, so that each direction costs a handful of products.
        """
        return _Carrying(self, names).result

    @property
    def narrow(self) -> list[Node]:
        """The few numbers that most of a step flows through, each after those that it needs."""
        memories = [x for n, x in self.whole.items() if n.startswith("memory of ")]
        places = {x for x in (self._accel, *memories) if x.args and x.level == DYNAMIC}
        return [x for x in ordered([*self.whole.values(), self._accel]) if x in places]


class _Carrying:
    """Builds ``Tangents``."""

    def __init__(self, program: DriverProgram, names: tuple[str, ...]) -> None:
        self.program, self.names, self.result = program, names, Tangents()
        self.graph = program.graph
        narrow = program.narrow
        self._inside = {self.graph.input(f"narrow {i}"): x for i, x in enumerate(narrow)}
        self._tangents: dict[str, Node | None] = {}
        self._rows: dict[Node, Node] = {}
        for signal, node in zip(program.signals, program.whole_sense, strict=True):
            along = self._along(node)
            if along is not None:
                self.result.sense[signal] = along
        for i, node in enumerate(narrow):
            self._tangents[f"narrow {i}"] = self._along(node)
        carry = {n: self._along(x) for n, x in program.whole.items() if n in program.moving}
        self.result.carry = {n: x or self.graph.constant(0.0) for n, x in carry.items()}
        self._hoist()

    def _along(self, node: Node) -> Node | None:
        """Return the tangent of a number, from those of states, of the past and of narrow places before it."""
        graph = self.graph
        inner = {x: name for name, x in self._inside.items()}
        if node in inner and inner[node].label.name in self._tangents:  # type: ignore[union-attr]
            return self._tangents[inner[node].label.name]  # type: ignore[union-attr]
        inner.pop(node, None)
        (local,) = replaced(graph, [node], inner)
        total: Node | None = None
        parts = adjoint(graph, [local], [graph.constant(1.0)]) if local.op != "constant" else {}
        leaves = sorted(parts, key=lambda leaf: str(leaf.label))
        slopes = replaced(graph, [parts[leaf] for leaf in leaves], self._inside)
        source = False
        for leaf, slope in zip(leaves, slopes, strict=True):
            slot = leaf.label
            assert isinstance(slot, Leaf)
            if slot.shift or (slope.op == "constant" and slope.label == 0.0):
                continue
            if slot.name in self.names:
                self.result.sources[self.result.targets, self.names.index(slot.name)] = slope
                source = True
                continue
            tangent = self._tangent_of(slot.name)
            if tangent is not None:
                part = graph.mul(self._row(slope), tangent)
                total = part if total is None else graph.add(total, part)
        if source:
            part = graph.input(f"source {self.result.targets}")
            total = part if total is None else graph.add(total, part)
            self.result.targets += 1
        return total

    def _tangent_of(self, name: str) -> Node | None:
        if name.startswith("narrow "):
            return self._tangents[name]
        lasts = name.startswith("past ") and self.program.seen[int(name.split()[1])][0] in self.result.sense
        return self.graph.input(f"tangent {name}") if lasts or name in self.program.moving else None

    def _row(self, slope: Node) -> Node:
        """Return a slope as the loop over directions reads it."""
        if slope.level in (CONSTANT, STATIC) or slope.op == "input":
            return slope
        if slope not in self._rows:
            self._rows[slope] = self.graph.input(f"slope {len(self.result.slopes)}")
            self.result.slopes.append(slope)
        return self._rows[slope]

    def _hoist(self) -> None:
        tangents = self.result
        nodes = [*tangents.slopes, *tangents.sources.values(), *tangents.sense.values(), *tangents.carry.values()]
        cut, tangents.hoist = hoisted(self.graph, nodes, "fixed")
        rest = iter(cut)
        tangents.slopes = [next(rest) for _ in tangents.slopes]
        tangents.sources = {key: next(rest) for key in tangents.sources}
        tangents.sense = {key: next(rest) for key in tangents.sense}
        tangents.carry = {key: next(rest) for key in tangents.carry}
