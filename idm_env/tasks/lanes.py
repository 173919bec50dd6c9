"""What tasks on several lanes share: drivers who change lanes, agents who may command them, and what agents see."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from idm_env.effects import Control, Effect, LaneCommand
from idm_env.roads import Lanes
from idm_env.tasks.base import EnvState, Task
from idm_env.tasks.checks import Range
from idm_env.tasks.features import AgentView, Feature, feature
from idm_env.tasks.random import Draw
from idm_env.tasks.reward_terms import REWARD_TERMS, RewardTerm, Transition
from idm_env.tasks.types import Maybe, Normals
from idm_env.types import Inputs, Params, State

FASTEST = 40.0
"""Speed (m/s) up to which an agent is paid and observed."""
FAR_AWAY = 200.0
"""Distance (m) up to which vehicles are observed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LanesTask(Task):
    """Vehicles on several lanes, whose drivers follow IDM and change lanes by MOBIL; agents accelerate.

    An agent commands its acceleration; its vehicle changes lanes as its driver would. With ``lane_commands`` it
    commands that, too, by a second number of the action: above 1/3 to the left, below −1/3 to the right, otherwise to
    stay. A command counts at the next decision, of which there is one a second; what is off the road or unsafe is not
    done but counted (``lane_refusals`` of the info). An action of several agents holds all accelerations, then all
    lanes.

    Args:
        spread: Spread of desired speeds between drivers, as a share.
        seen: How many vehicles an agent observes.
        lane_commands: Whether agents command lanes as well.
        discrete: So many levels of acceleration, evenly spread, instead of any: actions are whole numbers from 0 on
            (``MultiDiscrete``, as HighwayEnv's ``DiscreteAction``); of lanes 0 is to the right, 1 to stay, 2 to the
            left. 0 is continuous.
    """

    ranges: ClassVar[Mapping[str, Range]] = {
        "spread": Range(0.0, 1.0),
        "seen": Range(1, 1000, whole=True),
        "discrete": Range(0, 10_000, whole=True),
    }

    spread: float = 0.2
    seen: int = 4
    lane_commands: bool = False
    discrete: int = 0

    def _check_episode(self) -> None:
        """Check what every task on several lanes says, too."""
        super()._check_episode()
        if self.discrete == 1:
            raise ValueError("discrete = 1 leaves agents no choice. Take at least 2 levels, or 0 for any acceleration.")
        if self.spread >= 1.0:
            raise ValueError(f"spread = {self.spread:g} must be below 1: desired speeds are positive.")

    @property
    def pairs(self) -> int:  # type: ignore[override]
        """Every agent looks at all vehicles, to find the nearest."""
        return len(self.agents) * self.vehicles

    @cached_property
    @abc.abstractmethod
    def road(self) -> Lanes:  # type: ignore[override]
        """The road of several lanes."""

    @property
    def machinery(self) -> tuple[Effect, ...]:  # type: ignore[override]
        """Effects through which agents act."""
        return (Control(), LaneCommand()) if self.lane_commands else (Control(),)

    def reset(self, draw: Draw, params: Params) -> EnvState:
        """Return the worlds at the beginning of an episode, in which nobody has changed lanes yet."""
        world = super().reset(draw, params)
        lanes = world.state.lanes
        assert lanes is not None
        none: Any = {name: torch.zeros_like(lanes.lane) for name in ("changed", "refused", "blocked", "unjudged")}
        return world._replace(state=world.state._replace(lanes=lanes._replace(**none)))

    def info(self, world: EnvState) -> dict[str, Tensor]:
        """Return how often agents' vehicles changed lanes in this episode, and how often they could not."""
        lanes = world.state.lanes
        assert lanes is not None
        return {"lane_changes": self.pick(lanes.changed), "lane_refusals": self.pick(lanes.blocked + lanes.refused)}

    @property
    def commands(self) -> tuple[str, ...]:  # type: ignore[override]
        """Acceleration, and the lane where that is asked for."""
        return ("accel", "lane") if self.lane_commands else ("accel",)

    @property
    def levels(self) -> tuple[int, ...] | None:  # type: ignore[override]
        """Levels of acceleration, and the three of lanes."""
        return (self.discrete, 3)[: len(self.commands)] if self.discrete else None

    def command(self, action: Tensor) -> Tensor:
        """Return the commanded accelerations (m/s²)."""
        return super().command(action[..., : len(self.agents)])

    def safe_command(self, world: EnvState) -> Tensor:
        """Return what the failsafe allows: behind the leader, and before the end of a lane as if somebody stood there.

        Both count, whichever is nearer: a leader may leave the lane.
        """
        highest = super().safe_command(world)
        if not self.road.closed:
            return highest
        state = world.state
        assert state.lanes is not None
        room = self.pick(self.road.closed_at(state.lanes.lane, state.position) - state.position)
        return torch.minimum(highest, self._safe_behind(state, torch.zeros_like(room), room))

    def inputs(self, world: EnvState, command: Maybe, normals: Normals, live: Maybe = None) -> Inputs:
        """Return the inputs of one step, in which lanes are left to the drivers."""
        inputs = super().inputs(world, command, normals, live)
        if self.lane_commands:
            inputs = {**inputs, "lane_command": torch.full_like(world.state.speed, torch.nan)}
        return inputs

    def with_lane_commands(self, inputs: Inputs, action: Maybe, live: Maybe = None) -> Inputs:
        """Return the inputs with the lanes that agents command."""
        if not self.lane_commands or action is None:
            return inputs
        wish = action.detach()[..., len(self.agents) :]
        side = (wish > 1 / 3).to(action.dtype) - (wish < -1 / 3).to(action.dtype)
        if live is not None:
            side = torch.where(live, side, torch.nan)
        slots = self.constant("agents", self.agents, action.device, torch.int64).expand(side.shape)
        return {**inputs, "lane_command": inputs["lane_command"].scatter(-1, slots, side)}

    def params(self, dtype: torch.dtype, device: torch.device | str) -> dict[str, dict[str, Tensor]]:
        """Return checked parameters as tensors, desired speeds spread over drivers where the law has them."""
        values, base = super().params(dtype, device), self.simulator.base.name
        own = values[base]
        if not self.spread or "desired_speed" not in own:
            return values
        values = {**values, base: {**own, "desired_speed": own["desired_speed"] * self.spread_factor(dtype, device)}}
        self.simulator.check(values)
        return values

    def spread_factor(self, dtype: torch.dtype, device: torch.device | str) -> Tensor:
        """Return by how much every driver's desired speed differs from that of all."""
        # Multiples of the golden ratio: evenly spread, whatever their number, and neighbours differ.
        share = (0.618033988749895 * torch.arange(self.vehicles, dtype=torch.float64)) % 1.0
        return (1.0 + self.spread * (2.0 * share - 1.0)).to(dtype=dtype, device=device)

    @property
    def features_of_self(self) -> tuple[Feature, ...]:
        """What an agent observes of itself."""
        return feature("speed", 20.0, 0.0, FASTEST), feature("lane", 1.0, 0.0, float(max(self.road.count - 1, 1)))

    @property
    def own_features(self) -> tuple[Feature, ...]:
        """What is seen of oneself, and of each vehicle nearby: relative to the agent, 0 where there is nobody."""
        last = float(max(self.road.count - 1, 1))
        place = ("there", "", 1.0, 0.0, 1.0), ("ahead", "m", 100.0, -FAR_AWAY, FAR_AWAY)
        each = (*place, ("left", "lanes", 1.0, -last, last), ("speed", "m/s", 10.0, -FASTEST, FASTEST))
        nearby = (
            Feature(f"{name}_{k}", "", unit, scale, low, high, partial(_nearby, i, k))
            for k in range(self.seen)
            for i, (name, unit, scale, low, high) in enumerate(each)
        )
        return (*self.features_of_self, *nearby)

    def apart(self, ahead: Tensor) -> Tensor:
        """Return differences of positions (m) as distances on this road."""
        return ahead

    def nearest(self, state: State) -> tuple[Tensor, ...]:
        """Return presence, distance ahead (m), lanes to the left and relative speed of the ``seen`` nearest vehicles.

        Each ``(…, seen, agents)``, 0 for nobody.
        """
        assert state.lanes is not None
        agents, count = len(self.agents), min(self.seen, max(1, self.vehicles - 1))  # alone: himself, far away
        own = self.constant("agents", self.agents, state.speed.device, torch.int64)
        lane, position = state.lanes.lane.to(state.speed.dtype), state.position.detach()
        away = self.apart(position.unsqueeze(-2) - self.pick(position).unsqueeze(-1)).abs()
        if state.present is not None:
            both = state.present.unsqueeze(-2) * self.pick(state.present).unsqueeze(-1)
            away = torch.where(both > 0, away, torch.inf)
        away = away.scatter(-1, own.view(-1, 1).expand(*away.shape[:-1], 1), torch.inf)
        # Of two that are equally near the one in the first slot comes first, however that is computed.
        near = away.sort(dim=-1, stable=True).indices[..., :count] if self.vehicles > 1 else own.expand_as(away)
        # Vehicles are picked from the state itself: gradients then flow to them, and to no matrix of all pairs.
        which = torch.cat([near[..., k] for k in range(count)], -1)

        def beside(x: Tensor) -> Tensor:
            return x.gather(-1, which).unflatten(-1, (count, agents)) - self.pick(x).unsqueeze(-2)

        in_sight = away.gather(-1, near) <= FAR_AWAY
        present = torch.stack([in_sight[..., k] for k in range(count)], -2).to(lane.dtype)
        others = self.apart(beside(state.position)), beside(lane), beside(state.speed)
        columns = [present, *(x * present for x in others)]
        if count < self.seen:
            columns = [torch.cat((x, x.new_zeros(*x.shape[:-2], self.seen - count, agents)), dim=-2) for x in columns]
        return tuple(columns)


def _nearby(what: int, k: int, view: AgentView) -> Tensor:
    """Return one of what ``LanesTask.nearest`` says of the k-th vehicle, ``(…, agents)``."""
    return view.once(_nearest)[what][..., k, :]


def _nearest(view: AgentView) -> tuple[Tensor, ...]:
    assert isinstance(view.task, LanesTask)
    return view.task.nearest(view.state)


def pace(step: Transition) -> Tensor:
    """Return ``min(v, 40 m/s)/40 m/s``, ``(…, agents)``."""
    return step.task.pick(step.after.state.speed).clamp_max(FASTEST) / FASTEST


PACE = {RewardTerm("pace", "min(v, 40 m/s)/40 m/s", "", 0.0, 1.0, pace): 0.9, REWARD_TERMS["ease"]: 0.1}
"""The reward of an agent among others on several lanes."""
