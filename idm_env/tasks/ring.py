"""Task ``ring``: dissolve the stop-and-go wave on a ring road (Flow's wave attenuation)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Effect
from idm_env.roads import Ring, Road
from idm_env.tasks.base import EnvState, Task
from idm_env.tasks.checks import Range, span
from idm_env.tasks.features import Feature, feature
from idm_env.tasks.random import Draw
from idm_env.tasks.reward_terms import REWARD_TERMS, RewardTerm, Transition
from idm_env.tasks.types import Maybe, Normals
from idm_env.types import Command, Inputs, Params, State
from idm_env.validation import at_least, one_of, shown

STARTS = ("uniform", "wave")
SCALES = (5.0, 1.0, 10.0)
"""Of speed, relative speed (m/s) and headway (m) in an observation: what they are about in a grown wave."""
_LENGTH_STREAM, _SHOCK_STREAM = 1, 2
_MOST_SHOCKS = 32
_FASTEST = 40.0
"""Speed (m/s) up to which a vehicle's own is observed and the mean is paid."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RingTask(Task):
    """21 human drivers and one controlled vehicle (or k of N) on a ring, after Sugiyama et al. 2008, New J. Phys. 10.

    The benchmark is WaveAttenuationPOEnv of Flow (Wu, Kreidieh, Parvate, Vinitsky, Bayen 2017, arXiv 1710.05465),
    with its figures: length from 220–270 m, Δt 0.1 s, horizon 3000, IDM v0 = 30, T = 1, a = 1, b = 1.5, δ = 4, s0 = 2,
    noise 0.2, command ±1 m/s². In the warm-up, 1500 steps in which a wave grows (Flow: 750), everybody is a human
    driver. Once a minute a human brakes, so that waves come again; ``configs/ring.yaml`` is Flow's task to the letter.

    Observation, per agent: ``v/5, (v_lead − v)/1, headway/10`` (m/s, m/s, m), headway from front bumper to front
    bumper; raw: without the scales. Flow divides by 15, 15 and 270, so that its entries vary by 0.04, 0.004 and 0.002.
    Speeds are clipped to 40 m/s, their difference to ±20 m/s, headways to −10 m … the longest ring.
    Reward, the same for all agents: ``0.9 ⟨min(v/v*, 1)⟩ + 0.1 (1 − (u/u_max)²)``, over all vehicles after the step,
    ``v* = (mean gap − 2 m)/1 s`` the speed at which these drivers keep equal gaps. ``reward="flow"``: ``4 mean(v)/20 −
    4 |u|`` (v at most 40 m/s, u in m/s²). Further terms: ``reward={"speed": 0.2, "effort": -4.0, "tailgating": -2.0}``.
    Terminated where vehicles touch.

    Args:
        length: Circumference (m), or ``[lowest, highest]`` to be drawn for every episode.
        start: ``"uniform"``: equal gaps, standing. ``"wave"``: gaps and speeds in a wave, for a developed one with less
            warm-up.
        shock: Deceleration (m/s²) with which a human driver brakes now and then, whatever is ahead: as hard as the
            brakes allow, by a command in place of the driver's acceleration; 0 is no shock.
        shock_every: Once in every so many seconds of an episode, at a drawn time, a drawn human driver brakes.
        shock_after: Times from the beginning of the episode to shocks (s) in place of drawn ones, such as [60, 120].
        shock_seconds: How long each lasts (s), in whole steps.
        shock_vehicle: Who brakes; None is drawn, or with ``shock_after`` the human opposite the first agent, half the
            ring away (or the next one behind, where that is an agent too).
    """

    name: ClassVar[str] = "ring"
    road: ClassVar[Road] = Ring()
    own_effects: ClassVar[tuple[Effect, ...]] = (IDM(), Brakes())
    own_parameters: ClassVar = {
        "idm": {"max_accel": 1.0, "comfort_decel": 1.5, "time_gap": 1.0, "min_gap": 2.0, "desired_speed": 30.0}
    }

    begins_with: ClassVar[tuple[str, ...]] = ("length", "start")
    ranges: ClassVar[Mapping[str, Range]] = {
        "length": Range(1.0, 1e6, "m", ends=True),
        "shock": Range(0.0, 100.0, "m/s²"),
        "shock_every": Range(1.0, 1e6, "s"),
        "shock_after": Range(0.0, 1e6, "s", several=True),
        "shock_seconds": Range(0.0, 1e4, "s"),
        "shock_vehicle": Range(0, 100_000, whole=True),
    }

    length: float | Sequence[float] = (220.0, 270.0)
    noise: float = 0.2
    warmup: int = 1500
    start: str = "uniform"
    shock: float = 4.0
    shock_every: float = 60.0
    shock_after: float | Sequence[float] | None = None
    shock_seconds: float = 2.0
    shock_vehicle: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        shortest, _ = span("length", self.length, 1.0, "m")
        if self.vehicles * (self.vehicle_length + 0.5) > shortest:
            raise ValueError(
                f"{self.vehicles} vehicles of {self.vehicle_length:g} m and half a metre each do not fit a ring of "
                f"{shortest:g} m. Take fewer vehicles or a longer ring."
            )
        one_of("start", self.start, STARTS)
        at_least("shock_seconds", self.shock_seconds, self.simulator.dt, "s")
        at_least("shock_every", self.shock_every, self.shock_seconds, "s")
        explicit = self.shock_after is not None
        if explicit and (any(y - x < self.shock_seconds for x, y in pairwise(self.shocks)) or not self.shocks):
            raise ValueError(
                f"shock_after = {shown(self.shock_after)} must be a time, or several, each at least shock_seconds = "
                f"{self.shock_seconds:g} s after the one before, such as [60, 120]."
            )
        if (self.shock and explicit) or self.shock_vehicle is not None:
            self._check_shocked()

    def _check_shocked(self) -> None:
        """Check that a human driver brakes."""
        if len(self.agents) == self.vehicles:
            raise ValueError(
                f"shock = {self.shock:g} m/s² needs a human driver, and agents control all {self.vehicles} vehicles. "
                "Control fewer, or leave shock out."
            )
        vehicle = self.shock_vehicle
        if vehicle is not None and (vehicle >= self.vehicles or vehicle in self.agents):
            raise ValueError(
                f"shock_vehicle = {vehicle} must be a human driver of vehicles 0 … {self.vehicles - 1}; agents control "
                f"{', '.join(map(str, self.agents))}."
            )

    @property
    def shocks(self) -> tuple[float, ...]:
        """The times that are given at which a human driver brakes (s)."""
        after = self.shock_after
        return () if after is None else tuple(after) if isinstance(after, Sequence) else (after,)

    def _shocks(self, draw: Draw) -> dict[str, Tensor]:
        """Return, of every shock of an episode, its first step and who brakes, each ``(environments, shocks)``."""
        device, dt = draw.key.device, self.simulator.dt
        humans = torch.tensor([i for i in range(self.vehicles) if i not in self.agents], device=device)
        if not self.shock or not len(humans):
            return {}
        if self.shocks:
            first = torch.tensor([round(t / dt) for t in self.shocks], device=device).expand(len(draw.key), -1)
            return {"shock_step": first.contiguous(), "shock_who": torch.full_like(first, self.shocked)}
        count = min(_MOST_SHOCKS, math.ceil(self.steps * dt / self.shock_every))
        when, who = draw.uniforms(_SHOCK_STREAM, 2 * count, torch.float64).split(count, -1)
        begin = (torch.arange(count, device=device) + when) * self.shock_every - when * self.shock_seconds
        who = humans[(who * len(humans)).long()] if self.shock_vehicle is None else torch.full_like(who, self.shocked)
        return {"shock_step": (begin / dt).long(), "shock_who": who.long()}

    @cached_property
    def shocked(self) -> int:
        """The vehicle that brakes where there is a shock."""
        if self.shock_vehicle is not None:
            return self.shock_vehicle
        opposite = self.agents[0] + self.vehicles // 2
        behind = ((opposite + i) % self.vehicles for i in range(self.vehicles))
        return next(i for i in behind if i not in self.agents)

    @property
    def own_features(self) -> tuple[Feature, ...]:
        """Own speed, that of the leader relative to it, and the headway."""
        longest = span("length", self.length, 1.0, "m")[1]
        return (
            feature("speed", SCALES[0], 0.0, _FASTEST),
            feature("relative_speed", SCALES[1], -20.0, 20.0),
            feature("headway", SCALES[2], -10.0, longest + 10.0),
        )

    @property
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """``unit``, and Flow's."""
        low, high = self.command_limits
        flow = {REWARD_TERMS["speed"]: 0.2, replace(REWARD_TERMS["effort"], high=max(-low, high)): -4.0}
        return {"unit": {EVEN: 0.9, REWARD_TERMS["ease"]: 0.1}, "flow": flow}

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return rings of drawn lengths: standing at equal gaps, or in a wave."""
        like = self.like(params)
        low, high = span("length", self.length, 1.0, "m")
        length = low + (high - low) * draw.uniforms(_LENGTH_STREAM, 1, like.dtype)
        place = torch.arange(self.vehicles, dtype=like.dtype, device=length.device) / self.vehicles
        free = length / self.vehicles - self.vehicle_length
        shift, speed = torch.zeros_like(length), torch.zeros_like(length)
        if self.start == "wave":
            # Gaps free · (1 + A cos 2πi/N): their sum is the ring's, and positions are its running sum.
            amplitude = 0.75
            ripple = torch.cos(2.0 * math.pi * place)
            shift = amplitude * free * (ripple.cumsum(-1) - ripple)
            speed = (free * (1.0 + amplitude * ripple.roll(1, -1)) - 2.0).clamp_min(0.0)
        position = -place * length - shift
        speed = speed.expand_as(position).contiguous()
        step = torch.full((len(length),), -self.warmup, device=like.device)
        around: dict[str, Any] = {"length": self.vehicle_length, "circumference": length.squeeze(-1)}
        return EnvState(self.simulator.state(position, speed, params, step=step, **around), self._shocks(draw))

    @cached_property
    def _leaders(self) -> tuple[int, ...]:
        return tuple((i - 1) % self.vehicles for i in self.agents)

    def pick_leader(self, state: State, x: Tensor, nobody: float | None = None) -> Tensor:
        """Return each agent's leader's entry of ``x``: on a ring there always is one, in the slot before."""
        if len(self._leaders) == 1:
            return x[..., self._leaders[0] : self._leaders[0] + 1]
        return x.index_select(-1, self.constant("leaders", self._leaders, x.device, torch.int64))

    def inputs(self, world: EnvState, command: Maybe, normals: Normals, live: Maybe = None) -> Inputs:
        """Return the inputs of one step: those of every task, and the command of the human who brakes."""
        inputs = super().inputs(world, command, normals, live)
        if "shock_step" not in world.episode:
            return inputs
        step, lasts = world.state.step.unsqueeze(-1), round(self.shock_seconds / self.simulator.dt)
        vehicle = self.constant("vehicle", range(self.vehicles), step.device, torch.int64)
        first, who = world.episode["shock_step"], world.episode["shock_who"]
        now = [
            (step >= first[:, k : k + 1]) & (step < first[:, k : k + 1] + lasts) & (vehicle == who[:, k : k + 1])
            for k in range(first.shape[-1])
        ]
        control, brakes = inputs["control"], reduce(torch.logical_or, now)
        return {**inputs, "control": Command(torch.where(brakes, -self.shock, control.accel), control.active | brakes)}


def even(step: Transition) -> Tensor:
    """Return ``⟨min(v/v*, 1)⟩`` over all vehicles, ``(…, 1)``, ``v* = (mean gap − 2 m)/1 s``: 1 without waves."""
    state = step.after.state
    best = (state.gap.mean(-1, keepdim=True) - 2.0).clamp_min(0.5)
    return (state.speed / best).clamp_max(1.0).mean(-1, keepdim=True)


EVEN = RewardTerm("even", "⟨min(v/v*, 1)⟩", "", 0.0, 1.0, even)
