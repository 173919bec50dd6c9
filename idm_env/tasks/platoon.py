"""Task ``platoon``: controlled vehicles among N in an open lane, and disturbances at its head."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Effect
from idm_env.roads import Lane, Road
from idm_env.tasks.base import EnvState
from idm_env.tasks.checks import Range, span
from idm_env.tasks.crash import floored
from idm_env.tasks.features import FEATURES, AgentView, Feature, feature, speed
from idm_env.tasks.random import Draw
from idm_env.tasks.recorded import BehindHeadTask
from idm_env.tasks.reward_terms import REWARD_TERMS, RewardTerm, Transition, headway
from idm_env.types import Params
from idm_env.validation import at_least

_WAVE_STREAM = 21
_WAVES = 3
_KNEE, _LOWEST = -4.0, -8.0


@dataclass(frozen=True, eq=False, kw_only=True)
class PlatoonTask(BehindHeadTask):
    """k controlled vehicles of N behind a head (vehicle 0) whose speed oscillates; damp it, front to back.

    The head drives ``v(t) = v̄ + Σ A_j [cos(ω_j t + φ_j) − cos φ_j e^{−t/10 s}]`` with three waves of drawn periods,
    phases and amplitudes (which sum to ``disturbance``), and starts at v̄ exactly, as everybody does, in equilibrium.
    String stability (Swaroop and Hedrick 1996, IEEE Trans. Autom. Control 41) is ``metrics.amplification`` of the
    speeds.

    Observation, per agent: ``v/30, (v_lead − v)/10, gap/100, (v − v̄)/10`` (m/s and m; raw: without the scales).
    Reward, per agent: ``h (0.3 + 0.4/(1 + ((v_last − v̄)/A)²) + 0.3/(1 + ((v_i − v̄)/A)²))``, A the disturbance, h as
    in ``follow``. ``reward="quadratic"``: ``−((v_i − v̄)² + (v_last − v̄)²) / (2 A²) − 0.1 u² − 2 max(0, 1 − time
    gap / 0.8 s) − max(0, time gap / 4 s − 1)``, saturated from −4 towards −8 (``floored``): the usual costs, and
    bounds on the time gap so that nobody hides far behind. The humans (a = 0.6, b = 1.5, T = 1, s0 = 2, v0 = 30)
    amplify waves of 40–90 s at 10 m/s, by a quarter over ten vehicles. Terminated where vehicles touch. Cut off
    after 3000 steps.

    Args:
        speed: Mean speed v̄ of the head (m/s).
        disturbance: Sum A of the amplitudes (m/s).
        period: Range of the waves' periods (s).
    """

    name: ClassVar[str] = "platoon"
    road: ClassVar[Road] = Lane()
    own_effects: ClassVar[tuple[Effect, ...]] = (IDM(), Brakes())
    own_parameters: ClassVar = {
        "idm": {"max_accel": 0.6, "comfort_decel": 1.5, "time_gap": 1.0, "min_gap": 2.0, "desired_speed": 30.0}
    }
    begins_with: ClassVar[tuple[str, ...]] = ("period",)
    ranges: ClassVar[Mapping[str, Range]] = {
        "speed": Range(0.0, 70.0, "m/s"),
        "disturbance": Range(1e-3, 35.0, "m/s"),
        "period": Range(1.0, 1e4, "s", ends=True),
    }

    vehicles: int = 11
    max_command: float | Sequence[float] = 2.0
    speed: float = 10.0
    disturbance: float = 3.0
    period: float | Sequence[float] = (40.0, 90.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("speed", self.speed, 2.0 * self.disturbance, "m/s")

    @property
    def own_features(self) -> tuple[Feature, ...]:
        """Speeds up to 120 m/s, gaps from an overlap to 1000 m, and ``v − v̄``."""
        own = feature("speed", 30.0, 0.0, 120.0)
        deviation = Feature("deviation", "v − v̄", "m/s", 10.0, -100.0, 100.0, partial(_deviation, self.speed))
        return own, FEATURES["relative_speed"], FEATURES["gap"], deviation

    @property
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """``unit``, and the quadratic costs."""
        own = RewardTerm("steady", "h/(1 + (Δv_i/A)²)", "", 0.0, 1.0, partial(self._steady, self.pick))
        last = RewardTerm("last", "h/(1 + (Δv_last/A)²)", "", 0.0, 1.0, partial(self._steady, _last))
        quadratic = RewardTerm("quadratic", "", "", _LOWEST, 0.0, self._quadratic)
        unit = {last: 0.4, own: 0.3, REWARD_TERMS["headway"]: 0.3}
        return {"unit": unit, "quadratic": {quadratic: 1.0}}

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return a platoon in equilibrium at v̄, with drawn waves ahead of it."""
        like = self.like(params)
        low, high = span("period", self.period, 1.0, "s")
        u = draw.uniforms(_WAVE_STREAM, 3 * _WAVES, like.dtype).view(-1, 3, _WAVES)
        share = u[:, 2] + 0.2
        frequency, amplitude = 2.0 * math.pi / (low + (high - low) * u[:, 0]), share / share.sum(-1, keepdim=True)
        waves = torch.stack((frequency, 2.0 * math.pi * u[:, 1], self.disturbance * amplitude), dim=1)
        return self._in_equilibrium({"waves": waves}, params)

    def _motion(self, episode: Mapping[str, Tensor], step: Tensor, dtype: torch.dtype) -> Tensor:
        frequency, phase, amplitude = episode["waves"].unbind(1)
        # Integers times dt are float32 until they are told otherwise.
        t = (step + self.warmup).to(frequency.dtype).unsqueeze(-1) * self.simulator.dt
        angle, fade = frequency * t + phase, torch.exp(-0.1 * t)
        start = phase.cos()
        moved = (angle.sin() - phase.sin()) / frequency - start * 10.0 * (1.0 - fade)
        position = self.speed * t.squeeze(-1) + (amplitude * moved).sum(-1)
        speed = self.speed + (amplitude * (angle.cos() - start * fade)).sum(-1)
        accel = (amplitude * (-frequency * angle.sin() + 0.1 * start * fade)).sum(-1)
        return torch.stack((position, speed, accel), dim=-1)

    def _steady(self, pick: Callable[[Tensor], Tensor], step: Transition) -> Tensor:
        """Return ``h/(1 + ((v − v̄)/A)²)``, h the headway's term and v a picked speed."""
        return headway(step) / (1.0 + ((pick(step.after.state.speed) - self.speed) / self.disturbance).square())

    def _quadratic(self, step: Transition) -> Tensor:
        """Return minus the quadratic costs of speed and effort, and of time gaps out of bounds."""
        state, command = step.after.state, step.command
        speed, last = self.pick(state.speed), _last(state.speed)
        off, off_last = speed - self.speed, last - self.speed
        time_gap = self.pick(state.gap) / speed.clamp_min(1.0)
        close, far = 2.0 * torch.relu(1.0 - time_gap / 0.8), torch.relu(time_gap / 4.0 - 1.0)
        reward = -(off * off + off_last * off_last) / (2.0 * self.disturbance**2) - 0.1 * command * command
        return floored(reward - close - far, _KNEE, _LOWEST)


def _last(x: Tensor) -> Tensor:
    """Return the last vehicle's entry, ``(…, 1)``."""
    return x[..., -1:]


def _deviation(mean: float, view: AgentView) -> Tensor:
    """Return ``v − v̄`` (m/s)."""
    return speed(view) - mean
