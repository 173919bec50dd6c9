"""What agents can observe: declared features, in a catalogue that is open.

A feature is a function of an ``AgentView``; it says its unit, the scale that it is divided by, and its bounds. Tasks
declare theirs, and ``observation={"features": [...]}`` chooses others: names of ``FEATURES``, features of one's own,
or ``"my_file.py:my_feature"``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from idm_env import metrics
from idm_env.tasks.types import Agents, EnvState
from idm_env.types import State
from idm_env.validation import one_of, whole

SCALINGS = ("scaled", "raw")
MOST_AHEAD = 100
"""Most vehicles, the agent among them, whose features one agent may observe."""


class AgentView:
    """The traffic as every agent sees it, or as the vehicle does that is ``ahead`` vehicles ahead of it.

    Everything that is asked for has shape ``(…, agents)`` and is 0 for agents that are not on the road.
    """

    def __init__(self, task: Agents, world: EnvState, ahead: int = 0) -> None:
        self.task, self.world, self.ahead = task, world, ahead
        self._known: dict[Any, tuple[Tensor, ...]] = {}

    @property
    def state(self) -> State:
        """The state of the traffic, all vehicles' (``(…, vehicles)``)."""
        return self.world.state

    def own(self, x: Tensor) -> Tensor:
        """Return the vehicle's entry of ``x``, ``(…, vehicles)``."""
        return self.task.there(self.state, self.task.pick(self._moved(x)))

    def leader(self, x: Tensor, nobody: float | None = None) -> Tensor:
        """Return its leader's entry of ``x``, where there is no leader its own or ``nobody``."""
        return self.task.there(self.state, self.task.pick_leader(self.state, self._moved(x), nobody))

    def mean(self, x: Tensor) -> Tensor:
        """Return the mean of ``x`` over all vehicles on the road."""
        present = self.state.present
        if present is None:
            mean = x.mean(-1, keepdim=True)
        else:
            mean = (x * present).sum(-1, keepdim=True) / present.sum(-1, keepdim=True).clamp_min(1.0)
        return self.task.there(self.state, mean.expand(*mean.shape[:-1], len(self.task.agents)))

    def _moved(self, x: Tensor) -> Tensor:
        road = self.task.road.view(self.state)
        for _ in range(self.ahead):
            x = road.ahead(x)
        return x

    def once(self, of: Callable[[AgentView], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Return the entries that several features share: worked out for the first of them."""
        if of not in self._known:
            self._known[of] = of(self)
        return self._known[of]


Read = Callable[[AgentView], Tensor]
"""What an agent observes of a view, in SI units, shape ``(…, agents)``; differentiable where gradients are to flow."""


def part(of: Callable[[AgentView], tuple[Tensor, ...]], k: int, view: AgentView) -> Tensor:
    """Return the k-th entry of ``of``, worked out once for several features."""
    return view.once(of)[k]


@dataclass(frozen=True)
class Feature:
    """One entry of an observation.

    Args:
        name: Name of the entry.
        symbol: As in equations.
        unit: SI unit, empty for numbers without one.
        scale: What it is divided by in a scaled observation: about its usual size.
        low: Lowest value; lower ones are clipped, without a gradient.
        high: Highest value.
        read: How it is read.
    """

    name: str
    symbol: str
    unit: str
    scale: float
    low: float
    high: float
    read: Read

    def __post_init__(self) -> None:
        if not (self.low < self.high and self.scale > 0.0 and callable(self.read)):
            raise ValueError(
                f"feature '{self.name}' (scale {self.scale:g}, from {self.low:g} to {self.high:g}) needs a scale above "
                "0, a low below its high, and a function to read it."
            )


def speed(view: AgentView) -> Tensor:
    """Return v (m/s)."""
    return view.own(view.state.speed)


def accel(view: AgentView) -> Tensor:
    """Return A (m/s²), that of the last step."""
    return view.own(view.state.accel)


def position(view: AgentView) -> Tensor:
    """Return x (m), counted on over laps of a ring."""
    return view.own(view.state.position)


def gap(view: AgentView) -> Tensor:
    """Return s (m), between bumpers."""
    return view.own(view.state.gap)


def headway(view: AgentView) -> Tensor:
    """Return ``s + l_lead`` (m), from front bumper to front bumper."""
    return gap(view) + view.leader(view.state.length)


def time_gap(view: AgentView) -> Tensor:
    """Return ``s/max(v, 1 m/s)`` (s)."""
    return metrics.time_gap(gap(view), speed(view))


def lead_speed(view: AgentView) -> Tensor:
    """Return v_lead (m/s)."""
    return view.leader(view.state.speed)


def relative_speed(view: AgentView) -> Tensor:
    """Return ``v_lead − v`` (m/s)."""
    return lead_speed(view) - speed(view)


def closing_speed(view: AgentView) -> Tensor:
    """Return ``v − v_lead`` (m/s)."""
    return speed(view) - lead_speed(view)


def time_to_collision(view: AgentView) -> Tensor:
    """Return the time to collision (s) with the leader: ``s/(v − v_lead)`` where closing."""
    return metrics.time_to_collision(gap(view), closing_speed(view))


def drac(view: AgentView) -> Tensor:
    """Return the deceleration (m/s²) that avoids a crash: ``(v − v_lead)²/(2 s)`` where closing."""
    return metrics.drac(gap(view), closing_speed(view))


def leader_accel(view: AgentView) -> Tensor:
    """Return A_lead (m/s²), 0 without a leader."""
    return view.leader(view.state.accel, nobody=0.0)


def mean_speed(view: AgentView) -> Tensor:
    """Return the mean speed of all vehicles on the road (m/s)."""
    return view.mean(view.state.speed)


def lane(view: AgentView) -> Tensor:
    """Return the lane, counted from 0 at the right; 0 on a road that has one."""
    lanes = view.state.lanes
    return view.own(torch.zeros_like(view.state.speed) if lanes is None else lanes.lane.to(view.state.speed.dtype))


FEATURES: dict[str, Feature] = {
    each.name: each
    for each in (
        Feature("speed", "v", "m/s", 20.0, 0.0, 100.0, speed),
        Feature("accel", "A", "m/s²", 2.0, -20.0, 20.0, accel),
        Feature("position", "x", "m", 100.0, -1e6, 1e6, position),
        Feature("gap", "s", "m", 100.0, -10.0, 1000.0, gap),
        Feature("headway", "s + l_lead", "m", 100.0, -10.0, 1000.0, headway),
        Feature("time_gap", "s/v", "s", 2.0, -10.0, 100.0, time_gap),
        Feature("lead_speed", "v_lead", "m/s", 20.0, 0.0, 100.0, lead_speed),
        Feature("relative_speed", "v_lead − v", "m/s", 10.0, -100.0, 100.0, relative_speed),
        Feature("closing_speed", "v − v_lead", "m/s", 10.0, -100.0, 100.0, closing_speed),
        Feature("time_to_collision", "TTC", "s", 10.0, 0.0, 100.0, time_to_collision),
        Feature("drac", "DRAC", "m/s²", 2.0, 0.0, 20.0, drac),
        Feature("leader_accel", "A_lead", "m/s²", 2.0, -20.0, 20.0, leader_accel),
        Feature("mean_speed", "⟨v⟩", "m/s", 20.0, 0.0, 100.0, mean_speed),
        Feature("lane", "lane", "", 1.0, 0.0, 100.0, lane),
    )
}


def feature(name: str, scale: float, low: float, high: float) -> Feature:
    """Return a feature of the catalogue with another scale and other bounds."""
    return replace(FEATURES[name], scale=scale, low=low, high=high)


@dataclass(frozen=True)
class ObservedFeature:
    """A feature as an agent observes it: its own, or that of the vehicle that is ``ahead`` vehicles ahead of it."""

    feature: Feature
    ahead: int = 0

    @property
    def name(self) -> str:
        """Name of the entry: ``gap``, and ``gap_ahead_1`` of the leader."""
        return f"{self.feature.name}_ahead_{self.ahead}" if self.ahead else self.feature.name


def chosen(observation: Any, read: Callable[[Any, str], Any]) -> tuple[str, tuple[ObservedFeature, ...] | None]:
    """Return the scaling that ``observation`` asks for, and what is observed; None is the task's own.

    Args:
        observation: ``"scaled"``, ``"raw"``, or ``{"features": [...], "vehicles": 1, "scaling": "scaled"}``.
        read: Returns the feature of an entry.

    Raises:
        ValueError: In one line, for anything else.
    """
    if not isinstance(observation, Mapping):
        return one_of("observation", observation, SCALINGS), None
    for key in observation:
        one_of("observation", key, ("features", "vehicles", "scaling"))
    scaling = one_of("observation.scaling", observation.get("scaling", "scaled"), SCALINGS)
    entries = observation.get("features")
    if entries is None:
        if "vehicles" in observation:
            raise ValueError("observation.vehicles needs observation.features: name them.")
        return scaling, None
    if isinstance(entries, (str, Mapping)) or not isinstance(entries, Sequence) or not entries:
        raise ValueError('observation.features must be a list of at least one, such as ["speed", "gap"].')
    features = [read(each, "observation.features") for each in entries]
    names = [each.name for each in features]
    if len(set(names)) < len(names):
        raise ValueError(f"observation.features = {names} must name none twice.")
    vehicles = whole("observation.vehicles", observation.get("vehicles", 1), 1, MOST_AHEAD)
    return scaling, tuple(ObservedFeature(each, k) for k in range(vehicles) for each in features)
