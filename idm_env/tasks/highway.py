"""Task ``highway``: drive on among drivers who change lanes, on a ring of several lanes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

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

_PLACE_STREAM, _COUNT_STREAM = 31, 32


@dataclass(frozen=True, eq=False, kw_only=True)
class HighwayTask(LanesTask):
    """On a ring of lanes agents accelerate; lanes change by MOBIL, or by ``lane_commands=True``.

    After ``highway-v0`` of HighwayEnv (Leurent 2018, https://github.com/Farama-Foundation/HighwayEnv), on a ring, so
    that traffic stays as dense as it begins; its own form is ``vehicles=50, lanes_count=4``. Desired speeds differ
    between drivers by up to ``spread`` either way. ``randomise={"vehicles": [18, 26]}`` draws how many there are: as
    many slots as the highest, of which the last ones of an episode stay empty (absent, as on the open roads).
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

    own_rewards: ClassVar[Mapping[str, Mapping[RewardTerm, float]]] = {"unit": PACE}  # type: ignore[override]
    can_draw: ClassVar[tuple[str, ...]] = ("vehicles",)
    ranges: ClassVar[Mapping[str, Range]] = {"lanes_count": Range(2, 100, whole=True), "length": Range(10.0, 1e6, "m")}

    vehicles: int = 20
    warmup: int = 100
    lanes_count: int = 2
    length: float = 1000.0

    def __post_init__(self) -> None:
        if isinstance(self.randomise, Mapping) and "vehicles" in self.randomise:
            object.__setattr__(self, "vehicles", self._counts[1])
        super().__post_init__()
        if self.agents[-1] >= self._counts[0]:
            raise ValueError(
                f"randomise.vehicles = {list(self._counts)} leaves vehicle {self.agents[-1]} out, which is an agent. "
                f"Control vehicles below {self._counts[0]}, or draw more."
            )
        if self.length / -(-self.vehicles // self.lanes_count) < self.vehicle_length + 1.0:
            raise ValueError(
                f"{self.vehicles} vehicles of {self.vehicle_length:g} m and a metre each do not fit {self.lanes_count} "
                f"lanes of {self.length:g} m. Take fewer vehicles or a longer ring."
            )

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The ring of several lanes."""
        return Lanes(self.lanes_count, ring=float(self.length))

    @cached_property
    def _counts(self) -> tuple[int, int]:
        """The fewest and the most vehicles of an episode."""
        low, high = self._demands.get("vehicles", (self.vehicles, self.vehicles))
        return int(low), int(high)

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return vehicles spread evenly over the lanes, each up to a quarter of its room aside, at their pace."""
        like = self.like(params)
        aside = draw.uniforms(_PLACE_STREAM, self.vehicles, like.dtype) - 0.5
        index = torch.arange(self.vehicles, device=like.device)
        rank = torch.div(index, self.lanes_count, rounding_mode="floor")
        low, high = self._counts
        count = low + (draw.uniforms(_COUNT_STREAM, 1, torch.float64) * (high + 1 - low)).long()
        fullest = (count / self.lanes_count).ceil().double()
        room = torch.full_like(fullest, self.length) / fullest
        half = 0.5 * (room - self.vehicle_length)
        position = -(rank * room.float()).to(like.dtype) + half.to(like.dtype) * aside
        speed = half.clamp_max(20.0).to(like.dtype).expand_as(position).contiguous()
        step, lane = torch.full((len(position),), -self.warmup, device=like.device), index % self.lanes_count
        present = (index < count).to(like.dtype) if "vehicles" in self._demands else None
        around: dict[str, Any] = {"length": self.vehicle_length, "lane": lane, "present": present}
        return EnvState(self.simulator.state(position, speed, params, step=step, **around), {})

    @property
    def features_of_self(self) -> tuple[Feature, ...]:
        """As in ``LanesTask``, and the leader's relative speed and gap: a nearest vehicle need not be on one's lane."""
        return (*super().features_of_self, FEATURES["relative_speed"], FEATURES["gap"])

    def apart(self, ahead: Tensor) -> Tensor:
        """Return differences of positions (m) as distances round the ring, the shorter way."""
        return (ahead + 0.5 * self.length).remainder(self.length) - 0.5 * self.length
