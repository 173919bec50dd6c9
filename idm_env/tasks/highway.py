"""Task ``highway``: drive on among drivers who change lanes, on a ring of several lanes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Effect, Mobil
from idm_env.roads import Lanes
from idm_env.tasks.base import EnvState
from idm_env.tasks.checks import Range
from idm_env.tasks.features import FEATURES, Feature
from idm_env.tasks.lanes import PACE, LanesTask
from idm_env.tasks.random import Draw
from idm_env.tasks.reward_terms import RewardTerm
from idm_env.types import Params

_PLACE_STREAM = 31


@dataclass(frozen=True, eq=False, kw_only=True)
class HighwayTask(LanesTask):
    """On a ring of lanes agents accelerate; lanes change by MOBIL, or by ``lane_commands=True``.

    After ``highway-v0`` of HighwayEnv (Leurent 2018, https://github.com/Farama-Foundation/HighwayEnv), on a ring, so
    that traffic stays as dense as it begins. Desired speeds differ between drivers by up to ``spread`` either way.
    Agents act as ``LanesTask`` says. It pays an agent's own speed, not traffic's, for which ``open_highway``, ``merge``
    and ``bottleneck`` are.

    Observation, per agent: own speed and lane, the leader's relative speed and gap; then, as HighwayEnv's kinematics,
    of each of the ``seen`` nearest vehicles in any lane, nearest first: 1 if there is one within 200 m, how far ahead
    it is (m; negative behind), how many lanes to the left, and its speed relative to the own one (m/s). Scales: 20 m/s,
    one lane, 100 m, 10 m/s.
    Reward, per agent: ``0.9 v/40 + 0.1 (1 − (u/u_max)²)``, v its speed (at most 40 m/s) and u its command. Terminated
    where vehicles touch. Cut off after 3000 steps.

    Args:
        lanes_count: Number of lanes.
        length: Length of the ring (m).
    """

    name: ClassVar[str] = "highway"
    own_effects: ClassVar[tuple[Effect, ...]] = (IDM(), Mobil(), Brakes())
    own_parameters: ClassVar = {
        "idm": {"max_accel": 1.5, "comfort_decel": 2.0, "time_gap": 1.2, "min_gap": 2.0, "desired_speed": 30.0}
    }

    ranges: ClassVar[Mapping[str, Range]] = {"lanes_count": Range(2, 100, whole=True), "length": Range(10.0, 1e6, "m")}

    vehicles: int = 50
    lanes_count: int = 4
    length: float = 1000.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._room < self.vehicle_length + 1.0:
            raise ValueError(
                f"{self.vehicles} vehicles of {self.vehicle_length:g} m and a metre each do not fit {self.lanes_count} "
                f"lanes of {self.length:g} m. Take fewer vehicles or a longer ring."
            )

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The ring of several lanes."""
        return Lanes(self.lanes_count, ring=float(self.length))

    @property
    def _room(self) -> float:
        """Length of road for each vehicle of the fullest lane (m)."""
        return self.length / -(-self.vehicles // self.lanes_count)

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return vehicles spread evenly over the lanes, each up to a quarter of its room aside, at their pace."""
        like = self.like(params)
        aside = draw.uniforms(_PLACE_STREAM, self.vehicles, like.dtype) - 0.5
        index = torch.arange(self.vehicles, device=like.device)
        rank = torch.div(index, self.lanes_count, rounding_mode="floor")
        free = self._room - self.vehicle_length
        position = -(rank * self._room).to(like.dtype) + 0.5 * free * aside
        speed = torch.full_like(position, min(0.5 * free, 20.0))
        step, lane = torch.full((len(position),), -self.warmup, device=like.device), index % self.lanes_count
        state = self.simulator.state(position, speed, params, length=self.vehicle_length, step=step, lane=lane)
        return EnvState(state, {})

    @property
    def features_of_self(self) -> tuple[Feature, ...]:
        """As in ``LanesTask``, and the leader's relative speed and gap: a nearest vehicle need not be on one's lane."""
        return (*super().features_of_self, FEATURES["relative_speed"], FEATURES["gap"])

    def apart(self, ahead: Tensor) -> Tensor:
        """Return differences of positions (m) as distances round the ring, the shorter way."""
        return (ahead + 0.5 * self.length).remainder(self.length) - 0.5 * self.length

    @property
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """``unit``."""
        return {"unit": PACE}
