"""Task ``highway``: drive on among drivers who change lanes, on a ring of several lanes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Control, Effect, LaneCommand, Mobil
from idm_env.roads import Lanes, Road
from idm_env.tasks.base import Features, Pay, Task, World
from idm_env.tasks.checks import at_least, whole
from idm_env.tasks.random import Draw
from idm_env.types import Inputs, Params

_PLACE_STREAM = 31
_FASTEST = 40.0
"""Speed (m/s) up to which an agent is paid and observed."""
_FAR = 200.0
"""Distance (m) up to which vehicles are observed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HighwayTask(Task):
    """Vehicles on a ring of several lanes, whose drivers follow IDM and change lanes by MOBIL; agents accelerate.

    After ``highway-v0`` of HighwayEnv (Leurent 2018, https://github.com/Farama-Foundation/HighwayEnv), on a ring, so
    that traffic stays as dense as it begins. Desired speeds differ between drivers by up to ``spread`` either way.

    An agent commands its acceleration; its vehicle changes lanes as its driver would (``mobil``). With
    ``lane_commands`` it commands that, too, by a second number of the action: above 1/3 to the left, below −1/3 to the
    right, otherwise to stay. A command counts at the next decision, of which there is one a second; what is off the
    road or unsafe is not done (``state.links.blocked`` counts it). An action of several agents holds all accelerations,
    then all lanes.

    Observation, per agent, as HighwayEnv's kinematics: own speed and lane; then, of each of the ``seen`` nearest
    vehicles in any lane, nearest first: 1 if there is one within 200 m, how far ahead it is (m; negative behind), how
    many lanes to the left, and its speed relative to the own one (m/s). Scales: 20 m/s, one lane, 100 m, 10 m/s.
    Reward, per agent: ``v/40 − 0.1 (u/u_max)²``, v its speed (at most 40 m/s) and u its command. Terminated where
    vehicles touch, which pays ``−crash_cost`` instead (``idm_env.tasks.crash``). Cut off after 3000 steps.

    Args:
        lanes_count: Number of lanes.
        length: Length of the ring (m).
        spread: Spread of desired speeds between drivers, as a share.
        seen: How many vehicles an agent observes.
        lane_commands: Whether agents command lanes as well.
    """

    name: ClassVar[str] = "highway"
    own_effects: ClassVar[tuple[Effect, ...]] = (IDM(), Mobil(), Brakes())
    own_parameters: ClassVar = {
        "idm": {"max_accel": 1.5, "comfort_decel": 2.0, "time_gap": 1.2, "min_gap": 2.0, "desired_speed": 30.0}
    }

    vehicles: int = 50
    lanes_count: int = 4
    length: float = 1000.0
    spread: float = 0.2
    seen: int = 4
    lane_commands: bool = False

    def __post_init__(self) -> None:
        whole("lanes_count", self.lanes_count, 1)
        whole("seen", self.seen, 1)
        at_least("length", self.length, 10.0, "m")
        at_least("spread", self.spread, 0.0)
        if self.spread >= 1.0:
            raise ValueError(f"spread = {self.spread:g} must be below 1: desired speeds are positive.")
        super().__post_init__()
        if self._room < self.vehicle_length + 1.0:
            raise ValueError(
                f"{self.vehicles} vehicles of {self.vehicle_length:g} m and a metre each do not fit {self.lanes_count} "
                f"lanes of {self.length:g} m. Take fewer vehicles or a longer ring."
            )

    @property
    def road(self) -> Road:  # type: ignore[override]
        """The ring of several lanes."""
        return Lanes(self.lanes_count, ring=float(self.length))

    @property
    def machinery(self) -> tuple[Effect, ...]:  # type: ignore[override]
        """Effects through which agents act."""
        return (Control(), LaneCommand()) if self.lane_commands else (Control(),)

    @property
    def commands(self) -> tuple[str, ...]:
        """Acceleration, and the lane where that is asked for."""
        return ("accel", "lane") if self.lane_commands else ("accel",)

    def command(self, action: Tensor) -> Tensor:
        """Return the commanded accelerations (m/s²)."""
        return super().command(action[..., : len(self.agents)])

    def inputs(
        self, world: World, command: Tensor | None, normals: Mapping[str, Tensor] | None, live: Tensor | None = None
    ) -> Inputs:
        """Return the inputs of one step, in which lanes are left to the drivers."""
        found = super().inputs(world, command, normals, live)
        if self.lane_commands:
            found = {**found, "lane_command": torch.full_like(world.state.speed, torch.nan)}
        return found

    def wishes(self, inputs: Inputs, action: Tensor | None, live: Tensor | None = None) -> Inputs:
        """Return the inputs with the lanes that agents command."""
        if not self.lane_commands or action is None:
            return inputs
        wish = action.detach()[..., len(self.agents) :]
        side = (wish > 1 / 3).to(action.dtype) - (wish < -1 / 3).to(action.dtype)
        if live is not None:
            side = torch.where(live, side, torch.nan)
        slots = self.constant("agents", self.agents, action.device, torch.int64).expand(side.shape)
        return {**inputs, "lane_command": inputs["lane_command"].scatter(-1, slots, side)}

    @property
    def _room(self) -> float:
        """Length of road for each vehicle of the fullest lane (m)."""
        return self.length / -(-self.vehicles // self.lanes_count)

    def params(self, dtype: torch.dtype, device: torch.device | str) -> dict[str, dict[str, Tensor]]:
        """Return checked parameters as tensors, desired speeds spread over drivers."""
        values = super().params(dtype, device)
        # Multiples of the golden ratio: evenly spread, whatever their number, and neighbours differ.
        share = (0.618033988749895 * torch.arange(self.vehicles, dtype=torch.float64)) % 1.0
        factor = (1.0 + self.spread * (2.0 * share - 1.0)).to(dtype=dtype, device=device)
        idm = values["idm"]
        return {**values, "idm": {**idm, "desired_speed": idm["desired_speed"] * factor}}

    @property
    def features(self) -> Features:
        """Own speed and lane, and what is seen of each vehicle nearby."""
        n, last = self.seen, float(self.lanes_count - 1)
        each = [f"{what}_{k}" for k in range(n) for what in ("there", "ahead", "left", "speed")]
        return Features(
            ("speed", "lane", *each),
            (20.0, 1.0, *(1.0, 100.0, 1.0, 10.0) * n),
            (0.0, 0.0, *(0.0, -_FAR, -last, -_FASTEST) * n),
            (_FASTEST, last, *(1.0, _FAR, last, _FASTEST) * n),
        )

    @property
    def pay(self) -> Pay:
        """Rewards of a step lie between −0.1 and 1."""
        return Pay(-0.1, 1.0)

    def begin(self, draw: Draw, params: Params) -> World:
        """Return vehicles spread evenly over the lanes, each up to a quarter of its room aside, at their pace."""
        like = params["idm"]["max_accel"]
        aside = draw.uniforms(_PLACE_STREAM, self.vehicles, like.dtype) - 0.5
        index = torch.arange(self.vehicles, device=like.device)
        rank = torch.div(index, self.lanes_count, rounding_mode="floor")
        free = self._room - self.vehicle_length
        position = -(rank * self._room).to(like.dtype) + 0.5 * free * aside
        speed = torch.full_like(position, min(0.5 * free, 20.0))
        state = self.simulator.state(
            position, speed, params,
            length=self.vehicle_length, step=torch.full((len(position),), -self.warmup, device=like.device),
            lane=index % self.lanes_count,
        )  # fmt: skip
        return World(state, {})

    @cached_property
    def _others(self) -> list[list[int]]:
        return [[j for j in range(self.vehicles) if j != i] for i in self.agents]

    def observe(self, world: World) -> Tensor:
        """Return own speed and lane, and the nearest vehicles."""
        state = world.state
        assert state.links is not None
        others = self.constant("others", self._others, state.speed.device, torch.int64)
        shape = (len(state.speed), *others.shape)

        def of(x: Tensor) -> Tensor:
            return x[:, others.reshape(-1)].view(shape) - self.pick(x).unsqueeze(-1)

        lane = state.links.lane.to(state.speed.dtype)
        ahead = (of(state.position) + 0.5 * self.length).remainder(self.length) - 0.5 * self.length
        left, speed = of(lane), of(state.speed)
        near = ahead.detach().abs().argsort(dim=-1, stable=True)[..., : self.seen]
        features = [self.pick(state.speed), self.pick(lane)]
        nobody = torch.zeros_like(features[0])
        for k in range(self.seen):
            if k >= near.shape[-1]:
                features += [nobody] * 4
                continue
            which = near[..., k : k + 1]
            way, aside, pace = (x.gather(-1, which).squeeze(-1) for x in (ahead, left, speed))
            there = (way.detach().abs() <= _FAR).to(way.dtype)
            features += [there, way * there, aside * there, pace * there]
        return self.clip(features)

    def earned(self, before: World, command: Tensor, after: World) -> Tensor:
        """Return ``v/40 − 0.1 (u/u_max)²``."""
        speed = self.pick(after.state.speed).clamp_max(_FASTEST) / _FASTEST
        hardest = max(abs(limit) for limit in self.command_limits)
        return speed - 0.1 * (command / hardest).square().clamp_max(1.0)
