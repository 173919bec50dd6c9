"""One recorded step as phases over rows, forwards and backwards: what every compiled loop is printed from.

Phases of a step are ``sense`` (signals, which the loop puts into the past), ``recall`` (how many steps ago somebody
looks back to; the loop fetches those signals), ``respond`` (motion and memories) and ``close`` (gaps, from everybody's
displacement). Before a phase its loop copies neighbours' numbers beside one's own; after a phase of the
adjoint it sends what fell on a neighbour's number to that neighbour. ``hoist`` computes, once for many steps, what
depends on parameters alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from idm_env.compiled.scalar.derive import adjoint
from idm_env.compiled.scalar.graph import STATIC, Graph, Leaf, Node, hoisted, inputs_of, ordered, replaced
from idm_env.compiled.scalar.record import Recording

STATICS = ("led", "leads", "ends", "length", "present")
"""What holds for a whole rollout and is no parameter; ``present`` only where no record changes it."""

PHASES = ("sense", "recall", "respond", "close")


class Recall(NamedTuple):
    """A signal of the past: its slot, which of the ``ago`` it is looked up at, and the number of the signal."""

    slot: Leaf
    ago: int
    signal: int


@dataclass(frozen=True)
class Backward:
    """The adjoint of one phase: what is assigned, what is added, and what goes to neighbours, by slot."""

    assigned: dict[Leaf, Node]
    added: dict[Leaf, Node]
    sent: dict[Leaf, Node]

    @property
    def nodes(self) -> list[Node]:
        """Return every node that is computed."""
        return [*self.assigned.values(), *self.added.values(), *self.sent.values()]


class Program:
    """The phases of one recorded step, with the names of all that they carry, read and change."""

    def __init__(self, recording: Recording) -> None:
        self.graph = graph = recording.graph
        respond, close = dict(recording.respond), dict(recording.close)
        everything = [*recording.sense, *respond.values(), *close.values()]
        if Leaf("step") in inputs_of(everything):
            respond["step"] = graph.add(graph.input("step"), graph.constant(1.0))
        names = [f"{phase} {name}" for phase, nodes in (("respond", respond), ("close", close)) for name in nodes]
        nodes = [*recording.sense, *respond.values(), *close.values()]
        nodes, self.recalls, times = recalled(graph, nodes)
        cut, self.hoist = hoisted(graph, [*nodes, *times])
        self.recall = cut[len(nodes) :]
        self.sense = cut[: len(recording.sense)]
        rest = dict(zip(names, cut[len(self.sense) :], strict=False))
        self.respond = {name: rest[f"respond {name}"] for name in respond}
        self.close = {name: rest[f"close {name}"] for name in close}

    # -- what there is -------------------------------------------------------------------------------------------

    @cached_property
    def memories(self) -> tuple[str, ...]:
        """Memories of effects, as states."""
        return tuple(name for name in self.respond if name.startswith("memory of "))

    @cached_property
    def states(self) -> tuple[str, ...]:
        """What a step carries over, beside the past."""
        more = [name for name in ("present", "step") if name in self.respond or name in self.close]
        return ("gap", "speed", "position", "accel", *self.memories, *more)

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """States that have derivatives."""
        return tuple(name for name in self.states if name not in ("present", "step"))

    @cached_property
    def slots(self) -> list[Leaf]:
        """Everything that some phase reads."""
        return inputs_of([*self.hoist, *(node for phase in PHASES for node in self.outputs(phase))])

    @cached_property
    def statics(self) -> tuple[str, ...]:
        """What holds for the whole rollout and is no parameter."""
        return tuple(n for n in STATICS if n not in self.states and any(slot.name == n for slot in self.slots))

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Full names of the parameters that are read."""
        return tuple(dict.fromkeys(s.name for s in self.slots if "." in s.name))

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """What is given anew at every step."""
        return tuple(dict.fromkeys(s.name for s in self.slots if s.name.endswith(" now")))

    @property
    def constants_of_time(self) -> tuple[str, ...]:
        """Names of the hoisted rows."""
        return tuple(f"hoisted{i}" for i in range(len(self.hoist)))

    def outputs(self, phase: str) -> list[Node]:
        """Return the results of a phase."""
        return list(self.named(phase).values())

    def named(self, phase: str) -> dict[str, Node]:
        """Return the results of a phase, by name."""
        return {
            "sense": {f"signal {i}": node for i, node in enumerate(self.sense)},
            "recall": {f"ago {i}": node for i, node in enumerate(self.recall)},
            "respond": self.respond,
            "close": self.close,
        }[phase]

    def neighbours(self, nodes: Sequence[Node]) -> list[Leaf]:
        """Return the slots of other vehicles that some nodes read, nearest first."""
        return sorted((s for s in inputs_of(nodes) if s.shift), key=lambda s: (abs(s.shift), s))

    @cached_property
    def reach(self) -> int:
        """How many vehicles away a step looks."""
        return max((abs(s.shift) for s in self.slots), default=1)

    # -- backwards -----------------------------------------------------------------------------------------------

    def backward(self, phase: str) -> Backward:
        """Return the adjoint of one phase; nothing flows through how long ago something was."""
        if phase == "recall":
            return Backward({}, {}, {})
        nodes = {name: node for name, node in self.named(phase).items() if self._flows(name)}
        seeds = [self.graph.input(f"on {name}") for name in nodes]
        parts = adjoint(self.graph, list(nodes.values()), seeds)
        assigned: dict[Leaf, Node] = {Leaf(name): self.graph.constant(0.0) for name in nodes if name in self.moving}
        added: dict[Leaf, Node] = {}
        sent: dict[Leaf, Node] = {}
        for node, g in parts.items():
            slot = node.label
            assert isinstance(slot, Leaf)
            if not self._flows(slot.name):
                continue
            if slot.shift:
                sent[slot] = g
            elif slot in assigned or slot.name.endswith(" now") or slot.name.split()[0] in ("displacement", "recalled"):
                assigned[slot] = g
            else:
                added[slot] = g
        return Backward(assigned, added, sent)

    def hoist_backward(self) -> dict[Leaf, Node]:
        """Return what falls on the parameters from the hoisted rows."""
        seeds = [self.graph.input(f"on {name}", level=STATIC) for name in self.constants_of_time]
        parts = adjoint(self.graph, self.hoist, seeds)
        return {node.label: g for node, g in parts.items() if isinstance(node.label, Leaf)}

    def _flows(self, name: str) -> bool:
        """Whether derivatives are carried to what has this name."""
        return name not in ("present", "step", *STATICS)

    @cached_property
    def needed_backward(self) -> tuple[str, ...]:
        """States that the adjoint reads."""
        nodes = [node for phase in PHASES for node in self.backward(phase).nodes]
        read = {slot.name for slot in inputs_of([*nodes, *self.recall])}
        return tuple(name for name in self.states if name in read)

    @cached_property
    def needed_again(self) -> tuple[str, ...]:
        """States that must be known to compute those of ``needed_backward``, and the past, once more."""
        nodes = {**self.respond, **self.close}
        states = set(self.needed_backward) | {s.name for s in inputs_of(self.sense)} & set(self.states)
        while True:
            read = {s.name for name in states for s in inputs_of([nodes[name]])}
            if "displacement" in read:
                read |= {s.name for s in inputs_of([nodes["displacement"]])}
            if "position after" in read:
                read |= {"position"}
            more = states | (read & set(self.states))
            if more == states:
                return tuple(name for name in self.states if name in states)
            states = more


def recalled(
    graph: Graph, nodes: list[Node], name: str = "recalled {signal} of {ago}"
) -> tuple[list[Node], list[Recall], list[Node]]:
    """Put inputs in place of the signals of the past; return them with what is looked up, and how long ago each is.

    ``name`` names an input by its ``signal``, by how long ``ago`` it is, or by its ``number``.
    """
    times: list[Node] = []
    recalls: list[Recall] = []
    places: dict[Node, Node] = {}
    for node in ordered(nodes):
        if node.op == "past":
            assert isinstance(node.label, int)
            if node.args[0] not in times:
                times.append(node.args[0])
            ago = times.index(node.args[0])
            slot = Leaf(name.format(signal=node.label, ago=ago, number=len(recalls)))
            places[node] = graph.input(slot.name)
            recalls.append(Recall(slot, ago, node.label))
    return replaced(graph, nodes, places), recalls, times
