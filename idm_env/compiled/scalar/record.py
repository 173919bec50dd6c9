"""Records one step of a real simulator on scalars: what it senses, how it responds, and what becomes of the gaps.

Nothing here knows an equation. The road is replaced by one that hands out the leader's numbers instead of tensors, the
parameters by names; then ``Simulator.step`` itself runs, once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from idm_env import delay_buffer
from idm_env.compiled.scalar.graph import Graph, Node, TimeStep
from idm_env.compiled.scalar.scalar import Scalar, Unordered as Unordered, Untraceable as Untraceable, static, value_of
from idm_env.roads.base import Road
from idm_env.roads.chains import Chains
from idm_env.roads.ends import Ending
from idm_env.step import CarFollowingStep
from idm_env.types import Motion, Scene, State


@dataclass(frozen=True)
class Form:
    """Signature of a step: inputs (which are boolean), memories, presence. Cache key of a recording.

    ``inputs`` are (effect, fields given, which of them are truth values); ``memories`` are effects that have a memory.
    """

    inputs: tuple[tuple[str, tuple[str, ...], tuple[bool, ...]], ...]
    memories: tuple[str, ...]
    present: bool

    @classmethod
    def of(cls, state: State, inputs: Mapping[str, Any]) -> Form:
        """Return the form of a state and inputs."""
        forms = []
        for effect, value in sorted(inputs.items()):
            fields = {"": value} if isinstance(value, Tensor) else value._asdict()
            parts = {name: x for name, x in fields.items() if x is not None}
            forms.append((effect, tuple(parts), tuple(x.dtype == torch.bool for x in parts.values())))
        memories = tuple(sorted(name for name in state.memory if name != delay_buffer.PAST))
        return cls(tuple(forms), memories, state.present is not None)

    @property
    def flags(self) -> tuple[str, ...]:
        """Names of the inputs that are truth values."""
        return tuple(
            slot_name(effect, name)
            for effect, names, truths in self.inputs
            for name, truth in zip(names, truths, strict=True)
            if truth
        )


def slot_name(effect: str, part: str) -> str:
    """Return the name under which a step reads an input, or one part of it."""
    return f"{effect} {part}".strip() + " now"


@dataclass
class Recording:
    """One step as graphs over slots.

    ``sense`` are the signals that the past keeps (empty where nobody looks back), ``respond`` the motion and memories
    after the step by name, ``close`` the gap, from everybody's displacement, ``begin`` memories before the first step.
    ``accel`` is the acceleration before it is integrated: what most of a step flows through.
    """

    graph: Graph
    sense: list[Node] = field(default_factory=list)
    respond: dict[str, Node] = field(default_factory=dict)
    close: dict[str, Node] = field(default_factory=dict)
    begin: dict[str, Node] = field(default_factory=dict)
    accel: Node | None = None


@dataclass(frozen=True)
class SeenRoad(Ending):
    """A road on which ``ahead`` of an expression is the same expression of the leader."""

    road: Road
    graph: Graph

    def ahead(self, x: Any) -> Any:
        """Return the leader's expression."""
        return Scalar(self.graph, self.graph.shifted(x.node, 1))

    def back(self, x: Any) -> Any:
        """Return the follower's expression."""
        return Scalar(self.graph, self.graph.shifted(x.node, -1))

    def led(self, x: Any) -> Any:
        """Return whether there is a leader."""
        return self._neighbour("led")

    def leads(self, x: Any) -> Any:
        """Return whether there is a follower."""
        return self._neighbour("leads")

    def _neighbour(self, name: str) -> Any:
        return Scalar(self.graph, self.graph.constant(1.0) if self.road.around else self.graph.input(name))

    def room(self) -> Any:
        """Return how far the lane goes on, where lanes end."""
        if not (isinstance(self.road, Chains) and self.road.closed):
            return None
        ends: Any = Scalar(self.graph, self.graph.input("ends"))
        return ends - Scalar(self.graph, self.graph.input("position"))

    def gaps(self, position: Any, length: Any, circumference: Any = None) -> Any:
        """Return gaps from positions. Untraceable for vehicles that come and go on a ring."""
        if self.road.around:
            raise Untraceable("vehicles that come and go on a ring")
        return type(self.road).gaps(self, position, length)  # type: ignore[arg-type]


class Parameters(Mapping[str, Mapping[str, Any]]):
    """Every parameter by name; a look at an effect's parameters also notes that this effect is at work."""

    def __init__(self, simulator: CarFollowingStep, graph: Graph) -> None:
        self._graph = graph
        self._values = {
            e.name: {p.name: static(graph, f"{e.name}.{p.name}") for p in e.parameters} for e in simulator.effects
        }

    def __getitem__(self, effect: str) -> Mapping[str, Any]:
        self._graph.note = effect
        return self._values[effect]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


class _Past:
    """The past as numbers that a loop looks up: how many steps ago, and which signal."""

    def __init__(self, recording: Recording, seconds: float, dt: float) -> None:
        self._recording = recording
        self._slots, self._dt = TimeStep(delay_buffer.slots(seconds, dt)), dt

    def at(self, scene: Scene, seconds: Any) -> Scene:
        graph = self._recording.graph
        steps = seconds / self._dt
        whole = steps.detach().floor().clamp(0, self._slots - 1)
        share = (steps - whole).node
        newer, older = whole.node, graph.add(whole.node, graph.constant(1.0))
        values = []
        for i, _ in enumerate(delay_buffer.signals(scene)):
            a, b = graph.node("past", newer, label=i, level=2), graph.node("past", older, label=i, level=2)
            values.append(Scalar(graph, graph.add(a, graph.mul(share, graph.sub(b, a)))))
        return delay_buffer.seeing(scene, values)  # type: ignore[arg-type]

    def pushed(self, scene: Scene) -> Any:
        self._recording.sense = [x.node for x in delay_buffer.signals(scene)]  # type: ignore[attr-defined]
        return scene.speed


@dataclass(frozen=True)
class _Recorder(CarFollowingStep):
    recording: Recording | None = None

    def _history(self, state: State) -> Any:
        assert self.recording is not None
        return _Past(self.recording, self.looks_back, self.dt) if self.looks_back else None

    def _respond(self, state: State, inputs: Any, params: Any) -> Any:
        accel, scene, driver = super()._respond(state, inputs, params)
        assert self.recording is not None
        self.recording.accel = value_of(self.recording.graph, accel)
        return accel, scene, driver

    def _gaps(self, state: State, motion: Motion) -> Any:
        # Gaps need the displacement of two vehicles: a graph of their own, from displacements that are known by then.
        assert self.recording is not None
        graph, now = self.recording.graph, self.recording.respond
        graph.note = ""

        now["displacement"] = value_of(graph, motion.displacement)
        leaves: Any = Scalar(graph, graph.input("displacement")), Scalar(graph, graph.input("position after"))
        if motion.present is not state.present:
            self.recording.close["present"] = value_of(graph, motion.present)
        return super()._gaps(state, motion._replace(displacement=leaves[0], position=leaves[1]))


def record(simulator: CarFollowingStep, form: Form, graph: Graph | None = None) -> Recording:
    """Return one step of the simulator as graphs, in ``graph`` where one is given.

    The memories of ``form`` at their beginning are graphs, too (``begin``).
    ``Untraceable`` names the effect and the function for which that cannot be done.
    """
    # A search tries what it likes, and effects that are switched off there must leave nothing behind.
    judged = graph is None
    graph = Graph() if graph is None else graph
    recording = Recording(graph)
    road, dt = SeenRoad(simulator.road, graph), TimeStep(simulator.dt)
    recorder = _Recorder(road, simulator.effects, dt, simulator.integration, recording=recording)
    state = state_of(form, graph)
    params = Parameters(recorder, graph)
    try:
        after = recorder.step(state, inputs_of_form(form, graph), params)  # type: ignore[arg-type]
        suspects = tuple(dict.fromkeys(graph.suspects)) if judged else ()
        scene, driver = recorder.scene(state, {}), recorder._following.driver(params[recorder._following.name])  # type: ignore[arg-type]
        for effect in simulator.effects:
            if effect.name in form.memories:
                held = effect.initial_memory(scene, driver, params[effect.name])  # type: ignore[arg-type]
                recording.begin[effect.name] = value_of(graph, held)
    except Untraceable:
        raise
    except Exception as error:  # an effect may do anything with what it takes for a tensor; the torch path judges it
        raise Untraceable(
            f"effect '{graph.note}' does what cannot be recorded: {' '.join(str(error).split())}"
        ) from error
    for name in ("position", "speed", "accel"):
        recording.respond[name] = value_of(graph, getattr(after, name))
    for node in suspects:  # a limit or a maximum further on may lose NaN
        speed = recording.respond["speed"]
        recording.respond["speed"] = graph.select(graph.compare("ne", node, node), node, speed)
    for name in form.memories:
        recording.respond[f"memory of {name}"] = value_of(graph, after.memory[name])
    recording.close["gap"] = value_of(graph, after.gap)
    return recording


def state_of(form: Form, graph: Graph) -> State:
    """Return a state of names."""

    def read(name: str) -> Any:
        return Scalar(graph, graph.input(name))

    memory = {name: read(f"memory of {name}") for name in form.memories}
    numbers = {name: read(name) for name in ("position", "speed", "accel", "gap", "length", "step")}
    return State(**numbers, present=read("present") if form.present else None, memory=memory)


def inputs_of_form(form: Form, graph: Graph) -> dict[str, Any]:
    """Return inputs of names."""
    inputs: dict[str, Any] = {}
    for effect, fields, truths in form.inputs:
        values: dict[str, Any] = {}
        for name, truth in zip(fields, truths, strict=True):
            node = graph.input(slot_name(effect, name))
            values[name] = Scalar(graph, graph.compare("gt", node, graph.constant(0.5)) if truth else node)
        inputs[effect] = values[""] if "" in values else _Parts(values)
    return inputs


class _Parts:
    """An input of several parts: whatever was not given is None, as in the tuples that effects know."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)

    def __getattr__(self, name: str) -> Any:
        return self._values.get(name)

    def __iter__(self) -> Iterator[Any]:
        return iter(self._values.values())
