"""Task ``follow``: one controlled vehicle smooths the traffic behind a recorded leader (the I-24 work)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from idm_env import metrics
from idm_env.effects import IDM, Brakes, Effect
from idm_env.roads import Lane, Road
from idm_env.tasks.base import Ended, EnvState
from idm_env.tasks.checks import Range, only_with
from idm_env.tasks.crash import floored
from idm_env.tasks.features import FEATURES, Feature, feature
from idm_env.tasks.random import Draw
from idm_env.tasks.recorded import BehindHeadTask, Leaders, made_up_leader, recorded_leaders, starts
from idm_env.tasks.reward_terms import REWARD_TERMS, RewardTerm, Transition, headway, headway_penalty
from idm_env.types import Params
from idm_env.validation import one_of

HORIZON = 1000
SEEN = (feature("speed", 40.0, 0.0, 100.0), feature("lead_speed", 40.0, 0.0, 100.0), FEATURES["gap"])
"""What an agent behind a record observes, here and in ``replay``: speeds up to 100 m/s, gaps up to 1000 m."""
KNEE, LOWEST, HIGHEST = -2.0, -4.0, 1.0
"""Reward from which it saturates, and what it never leaves without ``lag_weight``."""
_CLOSING = 20.0
"""Difference of speeds (m/s) up to which losing or gaining ground counts."""
_GALLONS_PER_HOUR = 0.951
"""1 mL/s in US gallons per hour."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowTask(BehindHeadTask):
    """A controlled vehicle and five IDM followers behind a recorded leader (vehicle 0).

    After Lichtlé, Vinitsky, Nice, Seibold, Work, Bayen 2022, "Deploying traffic smoothing cruise controllers learned
    from trajectory data", ICRA, and its public code: Δt 0.1 s, horizon 1000, humans with a = 1.3, b = 2, v0 = 45, T =
    1, s0 = 2, everybody in equilibrium at the start.

    Observation, per agent: ``v/40, v_lead/40, gap/100`` (m/s and m; raw: without the scales).
    Reward, per agent: ``h (0.3 + 0.4/(1 + ⟨A²⟩/A_0²) + 0.3/(1 + F/F_0))``; h is 1 from 7 m and 1 s to 60 m, and falls
    to 0 at 6 m, 0.8 s and 120 m; ⟨A²⟩ and F are the mean squared acceleration and fuel rate of the agent and
    everybody behind it, A_0 = 0.5 m/s², F_0 = 1 mL/s. ``reward="source"``: ``1 − w fuel − 0.002 u² − 2 p``; w is
    ``fuel_weight``, 0.1 in the source, fuel in US gallons per hour (its own energy model is not public,
    ``fuel_model`` stands in), u in m/s²; less ``lag_weight`` times what the agent is slower than its leader (m/s,
    within ±20). Below −2 it saturates towards −4 (``floored``). The source's price of a crash is ``crash_cost=50``.
    Terminated where vehicles touch, truncated at the end of the record, and after ``max_episode_steps``: 1000, or
    what the longest record has.

    Args:
        fuel_model: Whose fuel: ``"kamal"`` or ``"circles"`` (``idm_env.metrics.FUELS``).
        fuel_weight: Of ``reward="source"``, per US gallon per hour: with 0.1 hardly anything is gained by saving.
        lag_weight: Of ``reward="source"``, per m/s that an agent is slower than its leader; 0 leaves it out. Saving
            fuel by falling back then costs what it takes from others.
        leader: A trajectory file; every leader that somebody follows in it may be drawn. None is the project's own
            made-up trace.
    """

    name: ClassVar[str] = "follow"
    road: ClassVar[Road] = Lane()
    own_effects: ClassVar[tuple[Effect, ...]] = (IDM(), Brakes())
    own_parameters: ClassVar = {
        "idm": {"max_accel": 1.3, "comfort_decel": 2.0, "time_gap": 1.0, "min_gap": 2.0, "desired_speed": 45.0}
    }
    own_features: ClassVar[tuple[Feature, ...]] = SEEN  # type: ignore[override]
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
        only_with(self, "source", ("fuel_weight", "lag_weight"))
        longest = self._longest // self.held
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
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """``unit``, and the source's."""
        smooth = RewardTerm("smooth", "h/(1 + ⟨A²⟩/A_0²)", "", 0.0, 1.0, self._smooth)
        economy = RewardTerm("economy", "h/(1 + F/F_0)", "", 0.0, 1.0, self._economy)
        source = RewardTerm("source", "", "", LOWEST, HIGHEST + _CLOSING * self.lag_weight, self._source)
        return {"unit": {REWARD_TERMS["headway"]: 0.3, smooth: 0.4, economy: 0.3}, "source": {source: 1.0}}

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return a queue in equilibrium behind a drawn stretch of a drawn leader."""
        steps = self.constant("steps", self.leaders.steps, draw.key.device, torch.int64)
        trace, start = starts(draw, steps, self.steps + self.warmup)
        return self._in_equilibrium({"trace": trace, "start": start + self.warmup}, params)

    def _motion(self, episode: Mapping[str, Tensor], step: Tensor, dtype: torch.dtype) -> Tensor:
        motion = self.constant("motion", self.leaders.motion, step.device, dtype)
        return motion[episode["trace"], (episode["start"] + step).clamp(0, motion.shape[1] - 1)]

    def _behind(self, x: Tensor) -> Tensor:
        """Return the mean of ``x``, ``(…, vehicles)``, over each agent and everybody behind it."""
        # Running means from the back: of every vehicle and those behind it.
        count = self.constant("count", list(range(self.vehicles, 0, -1)), x.device, x.dtype)
        return self.pick(x.flip(-1).cumsum(-1).flip(-1) / count)

    def _fuel(self, step: Transition) -> Tensor:
        """Return the mean fuel rate (mL/s) of each agent and everybody behind it."""
        return self._behind(metrics.fuel(step.after.state.speed, step.after.state.accel, self.fuel_model))

    def _smooth(self, step: Transition) -> Tensor:
        """Return ``h/(1 + ⟨A²⟩/A_0²)``, h the headway's term, A_0 = 0.5 m/s²."""
        return headway(step) / (1.0 + self._behind(step.after.state.accel.square()) / 0.25)

    def _economy(self, step: Transition) -> Tensor:
        """Return ``h/(1 + F/F_0)``, h the headway's term, F_0 = 1 mL/s."""
        return headway(step) / (1.0 + self._fuel(step))

    def _source(self, step: Transition) -> Tensor:
        """Return ``1 − w fuel − 0.002 u² − 2 p − l clip(v_lead − v, ±20)``, saturated below −2."""
        state, command = step.after.state, step.command
        gap, speed = self.pick(state.gap), self.pick(state.speed)
        fuel, penalty = self._fuel(step) * _GALLONS_PER_HOUR, headway_penalty(gap, speed)
        reward = 1.0 - self.fuel_weight * fuel - 0.002 * command * command - 2.0 * penalty
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
