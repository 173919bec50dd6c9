"""Task ``follow``: one controlled vehicle smooths the traffic behind a recorded leader (the I-24 work)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from idm_env import metrics
from idm_env.effects import IDM, Brakes, Effect
from idm_env.roads import Lane, Road
from idm_env.tasks.base import Ended, EnvState, RewardRange
from idm_env.tasks.checks import Range
from idm_env.tasks.crash import floored
from idm_env.tasks.features import FEATURES, Feature, feature
from idm_env.tasks.random import Draw
from idm_env.tasks.recorded import BehindHeadTask, Leaders, made_up_leader, recorded_leaders, starts
from idm_env.types import Params
from idm_env.validation import one_of

HORIZON = 1000
SEEN = (feature("speed", 40.0, 0.0, 100.0), feature("lead_speed", 40.0, 0.0, 100.0), FEATURES["gap"])
"""What an agent behind a record observes, here and in ``replay``: speeds up to 100 m/s, gaps up to 1000 m."""
KNEE, LOWEST, HIGHEST = -2.0, -4.0, 1.0
"""Reward from which it saturates, and what it never leaves without ``lag_weight``."""
_NEAREST, _FARTHEST, _SHORTEST = 7.0, 120.0, 1.0
_CLOSING = 20.0
"""Difference of speeds (m/s) up to which losing or gaining ground counts."""
_GALLONS_PER_HOUR = 0.951
"""1 mL/s in US gallons per hour."""


def headway_penalty(gap: Tensor, speed: Tensor) -> Tensor:
    """Return 0 … 1, elementwise: how far a gap (m) is below 7 m, above 120 m, or a time gap below 1 s.

    The source takes 1 at any violation. Here it rises over 1 m, 10 m and 0.2 s, so that it has a gradient; a deeper
    violation counts 1 as in the source.
    """
    near = _NEAREST - gap
    far = (gap - _FARTHEST) / 10.0
    short = (_SHORTEST - metrics.time_gap(gap, speed)) / 0.2
    return torch.maximum(torch.maximum(near, far), short).clamp(0.0, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowTask(BehindHeadTask):
    """A controlled vehicle and five IDM followers behind a recorded leader (vehicle 0).

    After Lichtlé, Vinitsky, Nice, Seibold, Work, Bayen 2022, "Deploying traffic smoothing cruise controllers learned
    from trajectory data", ICRA, and its public code: Δt 0.1 s, horizon 1000, humans with a = 1.3, b = 2, v0 = 45, T =
    1, s0 = 2, everybody in equilibrium at the start.

    Observation, per agent: ``v/40, v_lead/40, gap/100`` (m/s and m; raw: without the scales).
    Reward, per agent: ``1 − w fuel − 0.002 u² − 2 p``; w is ``fuel_weight``, 0.1 in the source, fuel the mean rate of
    the agent and everybody behind it (US gallons per hour; the source's own energy model is not public, ``fuel_model``
    stands in), u its command (m/s²), p in [0, 1] the violation of headways: gap below 7 m or above 120 m, time gap
    below 1 s; less ``lag_weight`` times what the agent is slower than its leader (m/s, within ±20): over an episode
    that is the ground that it has lost, as long as no step saturates. Below −2 it saturates towards −4 (``floored``).
    Terminated where vehicles touch, which pays ``−crash_cost`` instead: 5001 by default, more with ``lag_weight``, so
    that a crash is worse than any survival (``idm_env.tasks.crash``); the source takes 50. Truncated at the end of the
    record, and after ``max_episode_steps``: 1000, or what the longest record has.

    Args:
        fuel_model: Whose fuel: ``"kamal"`` or ``"circles"`` (``idm_env.metrics.FUELS``).
        fuel_weight: Reward per US gallon per hour: with 0.1 hardly anything is gained by saving.
        lag_weight: Reward per m/s that an agent is slower than its leader; 0 leaves it out. Saving fuel by falling back
            then costs what it takes from others.
        leader: A trajectory file; every leader that somebody follows in it may be drawn. None is the project's own
            made-up trace.
    """

    name: ClassVar[str] = "follow"
    road: ClassVar[Road] = Lane()
    own_effects: ClassVar[tuple[Effect, ...]] = (IDM(), Brakes())
    own_parameters: ClassVar = {
        "idm": {"max_accel": 1.3, "comfort_decel": 2.0, "time_gap": 1.0, "min_gap": 2.0, "desired_speed": 45.0}
    }
    ranges: ClassVar[Mapping[str, Range]] = {"fuel_weight": Range(0.0, 1e6), "lag_weight": Range(0.0, 1e6)}

    vehicles: int = 7
    max_command: float | Sequence[float] = 3.0
    fuel_model: str = "kamal"
    fuel_weight: float = 0.1
    lag_weight: float = 0.0
    leader: str | None = None

    def __post_init__(self) -> None:
        one_of("fuel_model", self.fuel_model, metrics.FUELS)
        super().__post_init__()
        longest = self._longest
        if (self.max_episode_steps or 0) > longest:
            raise ValueError(
                f"max_episode_steps = {self.max_episode_steps} exceeds the {longest} steps of the longest record after "
                f"the warm-up. Take at most {longest}, or a longer record."
            )

    @cached_property
    def _longest(self) -> int:
        """Steps that the longest record has after the warm-up, at least 1."""
        return max(int(self.leaders.steps.max()) - 1 - self.warmup, 1)

    @property
    def usual_steps(self) -> int:
        """1000 steps, or what the longest record has."""
        return min(HORIZON, self._longest)

    @cached_property
    def leaders(self) -> Leaders:
        """The recorded leaders."""
        dt = self.simulator.dt
        return made_up_leader(dt) if self.leader is None else recorded_leaders(str(self.leader), dt)

    @property
    def own_features(self) -> tuple[Feature, ...]:
        """Speeds up to 100 m/s, gaps from an overlap to 1000 m."""
        return SEEN

    @property
    def own_reward_range(self) -> RewardRange:
        """From −4 to 1, more where an agent may catch up."""
        return RewardRange(LOWEST, HIGHEST + _CLOSING * self.lag_weight)

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return a queue in equilibrium behind a drawn stretch of a drawn leader."""
        steps = self.constant("steps", self.leaders.steps, draw.key.device, torch.int64)
        trace, start = starts(draw, steps, self.steps + self.warmup)
        return self._in_equilibrium({"trace": trace, "start": start + self.warmup}, params)

    def _motion(self, episode: Mapping[str, Tensor], step: Tensor, dtype: torch.dtype) -> Tensor:
        motion = self.constant("motion", self.leaders.motion, step.device, dtype)
        return motion[episode["trace"], (episode["start"] + step).clamp(0, motion.shape[1] - 1)]

    def own_reward(self, before: EnvState, command: Tensor, after: EnvState) -> Tensor:
        """Return ``1 − w fuel − 0.002 u² − 2 p − l clip(v_lead − v, ±20)``, saturated below −2."""
        state = after.state
        fuel = metrics.fuel(state.speed, state.accel, self.fuel_model) * _GALLONS_PER_HOUR
        # Running means from the back: of every vehicle and those behind it.
        count = self.constant("count", list(range(self.vehicles, 0, -1)), fuel.device, fuel.dtype)
        behind = fuel.flip(-1).cumsum(-1).flip(-1) / count
        gap, speed = self.pick(state.gap), self.pick(state.speed)
        penalty = headway_penalty(gap, speed)
        reward = 1.0 - self.fuel_weight * self.pick(behind) - 0.002 * command * command - 2.0 * penalty
        if self.lag_weight:
            lag = self.lead_speed(state) - speed
            reward = reward - self.lag_weight * lag.clamp(-_CLOSING, _CLOSING)
        return floored(reward, KNEE, LOWEST)

    def ended(self, world: EnvState) -> Ended:
        """Return whether vehicles have touched, or the record is at its end."""
        ends = super().ended(world)
        steps = self.constant("steps", self.leaders.steps, world.state.step.device, torch.int64)
        over = world.episode["start"] + world.state.step + 1 >= steps[world.episode["trace"]]
        return Ended(ends.terminated, ends.truncated | over.unsqueeze(-1))
