"""Drivers who are not the same from second to second: noise and drift, from normals that are drawn beforehand.

Every effect here takes one standard normal ξ per vehicle and step as its input, so that a step stays a function:
gradients by its parameters are pathwise, and two drivers compared on the same normals differ by what they are. Drift is
an Ornstein–Uhlenbeck process n of unit variance with the memory time τ, by its exact law over a step Δt::

    n' = e^(−Δt/τ) n + √(1 − e^(−2Δt/τ)) ξ

It begins at its mean, 0, unless ``Simulator.state`` is given a seed, and what an effect does with it is null at σ = 0.
"""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene


@dataclass(frozen=True)
class Noise(Effect):
    """White acceleration noise ``+ σ ξ``."""

    kind = "noise"
    sees_truth = True
    draws = True
    declared = (Parameter("sigma", "σ", "m/s²", 0.1, 0.0, 2.0, null=0.0),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return σ ξ (m/s²)."""
        return p["sigma"] * scene.input(self.name)


def _memory_time(default: float) -> Parameter:
    return Parameter("memory_time", "τ", "s", default, 0.1, 600.0, role="shape")


def _level(effect: Any, scene: Scene, p: P) -> Tensor:
    """Return n of this step, from that of the step before and ξ."""
    decay = torch.exp(-scene.dt / p["memory_time"])
    level: Tensor = decay * scene.memory[effect.name] + torch.sqrt(1.0 - decay * decay) * scene.input(effect.name)
    return level


class _Drifting:
    """Part of an effect that has n for its memory ``(…, vehicles)``."""

    draws = True

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return n = 0."""
        return torch.zeros_like(scene.speed)

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return n."""
        return _level(self, scene, p)


@dataclass(frozen=True)
class AccelNoise(_Drifting, Effect):  # type: ignore[misc]
    """Drifting acceleration ``+ σ n``: what a driver does beside what the scene asks for, for about τ."""

    kind = "accel_noise"
    sees_truth = True
    title = "drifting acceleration"
    equation = "+ σ n, dn = −n dt/τ + √(2/τ) dW"
    wording = ("", "drivers accelerate by something beside the scene that wanders in time")
    looks_like = ("perception_noise", "wander")
    told_by = "free traffic, where neither a time gap nor a perceived gap matters"
    acts_on = "acceleration"
    declared = (Parameter("sigma", "σ", "m/s²", 0.1, 0.0, 2.0, null=0.0), _memory_time(2.0))

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return σ n (m/s²)."""
        return p["sigma"] * _level(self, scene, p)


@dataclass(frozen=True)
class Wander(_Drifting, Effect):  # type: ignore[misc]
    """A parameter of the driver that wanders about his own: ``T e^(σ n)``, or v0 or s0 likewise (``of``).

    The process is that of errors of perception (Treiber, Kesting, Helbing 2006, Physica A 360), here on a parameter.
    """

    kind = "wander"
    sources = (PUBLICATIONS["treiber_2006"],)
    rank = 5
    title = "wandering style"
    equation = "T e^(σ n), dn = −n dt/τ + √(2/τ) dW"
    wording = ("", "drivers' time gap wanders about its mean")
    looks_like = ("accel_noise", "perception_noise", "time_gap over time")
    told_by = "the same driver at low and high speed: a time gap acts by the speed, an acceleration not"
    acts_on = "time_gap"
    declared = (Parameter("sigma", "σ", "1", 0.2, 0.0, 1.5, null=0.0), _memory_time(20.0))
    of: Literal["time_gap", "desired_speed", "min_gap"] = "time_gap"

    @property
    def name(self) -> str:
        """``wander`` for the time gap, else ``wander_`` and the parameter."""
        return self.kind if self.of == "time_gap" else f"{self.kind}_{self.of}"

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the parameter in force."""
        factor = torch.exp(p["sigma"] * _level(self, scene, p))
        return driver._replace(**{self.of: getattr(driver, self.of) * factor})


@dataclass(frozen=True)
class PerceptionNoise(_Drifting, Effect):  # type: ignore[misc]
    """Errors of what the driver sees of the leader: the gap as ``s e^(σ n)``, or the closing speed as ``Δv + σ s n``.

    The human-driver model has both, with σ = 0.05 and 0.01/s and τ = 20 s (Treiber, Kesting, Helbing 2006, Physica A
    360): two effects here, of independent n, one per ``signal``. Without a leader there is no error.
    """

    kind = "perception_noise"
    sources = (PUBLICATIONS["treiber_2006"],)
    title = "drifting errors of perception"
    equation = "s e^(σ n) or Δv + σ s n, dn = −n dt/τ + √(2/τ) dW"
    wording = ("", "drivers misjudge the gap or the closing speed, for a while each time")
    looks_like = ("wander", "accel_noise")
    told_by = "standstill and slow traffic: a misjudged gap matters there, a wandering time gap does not"
    acts_on = "gap"
    signal: Literal["gap", "closing_speed"] = "gap"

    @property
    def name(self) -> str:
        """``perception_noise`` for the gap, ``perception_noise_closing_speed`` for the closing speed."""
        return self.kind if self.signal == "gap" else f"{self.kind}_{self.signal}"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """σ, relative for the gap and in 1/s for the closing speed, and τ."""
        sigma = (
            Parameter("sigma", "σ", "1", 0.05, 0.0, 0.5, null=0.0)
            if self.signal == "gap"
            else Parameter("sigma", "σ", "1/s", 0.01, 0.0, 0.5, null=0.0)
        )
        return (sigma, _memory_time(20.0))

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with the misjudged leader."""
        leader = scene.leader
        error = p["sigma"] * _level(self, scene, p) * leader.present
        if self.signal == "gap":
            return scene._replace(leader=leader._replace(gap=leader.gap * torch.exp(error)))
        return scene._replace(leader=leader._replace(speed=leader.speed - error * leader.gap))


DRIFTS: tuple[Effect, ...] = (Wander(), Wander(of="desired_speed"), AccelNoise(), PerceptionNoise())
"""Sorts of drift that records of followers can tell apart."""
