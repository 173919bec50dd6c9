"""Task ``replay_lanes``: a recorded road of several lanes replayed, with any chosen vehicles handed over."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Control, Effect, LaneCommand, Mobil, Replay
from idm_env.roads import End, Lanes
from idm_env.tasks.base import EnvState
from idm_env.tasks.crash import contact
from idm_env.tasks.features import FEATURES, Feature, feature
from idm_env.tasks.lane_scenes import LanesScene, made_up_lanes, recorded_lanes
from idm_env.tasks.lanes import FASTEST, LanesTask
from idm_env.tasks.replay import ReplayTask
from idm_env.tasks.types import Maybe, Normals
from idm_env.types import Inputs, State
from idm_env.validation import one_of

LANE_CHANGES = ("recorded", "drivers")
FIRST_LANES = ("left", "right")


@dataclass(frozen=True, eq=False, kw_only=True)
class ReplayLanesTask(ReplayTask, LanesTask):
    """A demonstration: one run of a file with lanes, its vehicles where their records say, or simulated instead.

    Recorded vehicles enter, leave and change lanes as recorded, and do not react to those that are handed over, who
    follow whoever is ahead of them on their lane, at every step. Which vehicles agents control, where episodes begin,
    rewards, ends and the cost of a crash are as in task ``replay``; agents may command lanes as ``LanesTask`` says.

    Observation, per agent: own speed, lane, the leader's speed (one's own without a leader) and gap (1000 m); then the
    nearest vehicles in any lane as in ``highway``. An agent has crashed, too, where a recorded vehicle drives into it
    from behind or from beside.

    Args:
        data: A trajectory file with a column ``lane``; None is a made-up scene of the project's own.
        runs: The run to replay, as ``["run"]``; None takes the only one.
        lane_changes: ``"recorded"``: vehicles that are handed over change lanes, too, when their record does (with
            ``lane_commands`` agents when they command it); ``"drivers"``: as their drivers want, by MOBIL.
        first_lane: Whether the lane with the lowest number is on the ``"left"``, as in NGSIM, or on the ``"right"``.
    """

    name: ClassVar[str] = "replay_lanes"

    spread: float = 0.0
    lane_changes: str = "recorded"
    first_lane: str = "left"

    def __post_init__(self) -> None:
        one_of("lane_changes", self.lane_changes, LANE_CHANGES)
        one_of("first_lane", self.first_lane, FIRST_LANES)
        if isinstance(self.runs, list | tuple) and len(self.runs) != 1:
            raise ValueError(f"runs = {list(self.runs)} must name one run: runs are different roads.")
        super().__post_init__()

    @property
    def own_effects(self) -> tuple[Effect, ...]:  # type: ignore[override]
        """IDM, and MOBIL where drivers change lanes."""
        return (IDM(), Mobil(), Brakes()) if self.lane_changes == "drivers" else (IDM(), Brakes())

    @property
    def machinery(self) -> tuple[Effect, ...]:  # type: ignore[override]
        """Effects through which agents act, records are replayed, and recorded vehicles want no other lane."""
        return (Control(), LaneCommand(), Replay())

    @cached_property
    def scene(self) -> LanesScene:  # type: ignore[override]
        """The recorded road."""
        dt = self._behaviour.dt
        if self.data is None:
            return made_up_lanes(dt)
        return recorded_lanes(str(self.data), dt, None if self.runs is None else self.runs[0], self.first_lane)

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The road: a lane is where somebody drives on it in the record."""
        ends = [
            End(k, begin=float(low), closed=False, opens=float(low), closes=float(high) + 1.0)
            for k, (low, high) in enumerate(self.scene.extent)
        ]
        return Lanes(len(ends), ends=tuple(ends))

    @property
    def lanes(self) -> tuple[int, ...]:
        """The lane of each slot when the record begins."""
        return tuple(int(k) for k in self.scene.lane[0])

    def lane_at(self, time: Tensor) -> Tensor:
        """Return the recorded lanes ``(n, slots)`` at time steps of the record."""
        lane = self.constant("lane", self.scene.lane, time.device, torch.int64)
        return lane[time.clamp(0, len(lane) - 1)]

    def inputs(self, world: EnvState, command: Maybe, normals: Normals, live: Maybe = None) -> Inputs:
        """Return the inputs of one step, with the record at its end, lanes included where they are recorded."""
        inputs = dict(super().inputs(world, command, normals, live))
        state = world.state
        assert state.present is not None
        free = self.constant("free", self._free, state.speed.device, torch.bool) & (state.present > 0)
        lane = self.lane_at(world.episode["start"] + state.step + 1)
        inputs["replay"] = inputs["replay"]._replace(lane=torch.where(free, -1, lane))
        inputs["lane_command"] = torch.where(free, torch.nan, torch.zeros_like(state.speed))
        return inputs

    def _free(self) -> list[bool]:
        """Return which slots' lanes are not recorded."""
        drivers = self.lane_changes == "drivers"
        agents = self._is_agent()
        return [bool(own) and (drivers or (self.lane_commands and agents[i])) for i, own in enumerate(self._simulated)]

    @property
    def features_of_self(self) -> tuple[Feature, ...]:
        """As in ``LanesTask``, and the leader's speed and gap."""
        return (*super().features_of_self, feature("lead_speed", 20.0, 0.0, FASTEST), FEATURES["gap"])

    @property
    def own_features(self) -> tuple[Feature, ...]:  # type: ignore[override]
        """As in ``LanesTask``."""
        return super(ReplayTask, self).own_features

    def _behind(self, state: State) -> Tensor:
        """Return the gap of whoever follows each vehicle (m), its own where nobody does."""
        return self.road.view(state).back(state.gap)

    def crashed(self, world: EnvState) -> Tensor:
        """Return which agents touch whoever is ahead of or behind them on their lane."""
        state = world.state
        return self.pick(torch.minimum(state.gap, self._behind(state))) <= 0.0

    def crash_reason(self, world: EnvState, row: int, agent: int | None = None) -> str:
        """Return who touched whom: an agent its leader, or a recorded vehicle an agent."""
        state = world.state
        lanes = state.lanes
        assert lanes is not None
        nearest = self.pick(torch.minimum(state.gap, self._behind(state)))[row].detach()
        vehicle = self.agents[int(nearest.argmin()) if agent is None else agent]
        if float(state.gap[row, vehicle].detach()) > 0.0:
            vehicle = int(lanes.follower[row, vehicle])
        seconds, leader = float(state.step[row]) * self.simulator.dt, int(lanes.leader[row, vehicle])
        return contact(self.vehicle_ids, self.agents, vehicle, float(state.gap[row, vehicle].detach()), seconds, leader)
