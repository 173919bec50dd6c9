"""Reactions to vehicles and signals other than the leader's gap and speed (hook ``accelerate``).

Where the neighbour is missing each of these is exactly absent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.idm import interaction
from idm_env.parameters import Parameter
from idm_env.types import Adjacent, Driver, Scene


@dataclass(frozen=True)
class SecondLeader(Effect):
    """Anticipation over two leaders: ``(1 − w) (s*₁/s₁)² + w (s*₂/(s₂/2))²`` in place of ``(s*₁/s₁)²``.

    Source: Treiber, Kesting, Helbing 2006, Physica A 360, 71; s₂ is the bumper gap to the second leader (m).
    """

    kind: ClassVar[str] = "second_leader"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("weight", "w", "1", 0.3, -0.5, 1.0, null=0.0),)
    needs: ClassVar[frozenset[str]] = frozenset({"second_leader"})

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the difference that the second leader makes (m/s²)."""
        second = scene.second_leader
        assert second is not None
        first_term = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed)
        second_term = interaction(driver, scene.speed, 0.5 * second.gap, second.speed)
        return driver.max_accel * p["weight"] * second.present * (first_term - second_term)


@dataclass(frozen=True)
class LeaderAcceleration(Effect):
    """Feed-forward of the leader's acceleration, ``+ c a_lead``, as in adaptive and cooperative cruise control.

    It is measured or sent, not perceived: a driver's delay does not hold it up. Down a platoon quick changes are
    multiplied by c from vehicle to vehicle, so that beyond |c| = 1 they grow without end: it is not string stable.
    """

    kind: ClassVar[str] = "leader_acceleration"
    sees_truth: ClassVar[bool] = True
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", "c", "1", 0.4, -0.95, 0.95, null=0.0),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return c a_lead (m/s²)."""
        return p["gain"] * scene.leader.accel * scene.leader.present


@dataclass(frozen=True)
class BrakeLight(Effect):
    """Reaction to the leader's braking only, ``+ c min(a_lead, 0)``."""

    kind: ClassVar[str] = "brake_light"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", "c", "1", 0.5, -1.0, 2.0, null=0.0),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return c min(a_lead, 0) (m/s²)."""
        return -p["gain"] * torch.relu(-scene.leader.accel) * scene.leader.present


@dataclass(frozen=True)
class Follower(Effect):
    """Pressure from behind: ``+ c a min(((s0 + v T)/s_behind)², cap)``; s_behind is the follower's gap (m)."""

    kind: ClassVar[str] = "follower"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", "c", "1", 0.15, -0.5, 1.0, null=0.0),)
    needs: ClassVar[frozenset[str]] = frozenset({"behind"})
    cap: float = 4.0

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the push (m/s²)."""
        behind = scene.behind
        assert behind is not None
        ratio = (driver.min_gap + scene.speed * driver.time_gap) / behind.gap.clamp_min(0.1)
        pressure = (ratio * ratio).clamp_max(self.cap)
        return p["gain"] * driver.max_accel * pressure * behind.present


@dataclass(frozen=True)
class Lateral(Effect):
    """Friction with the adjacent lane: ``− c max(v − v_adjacent, 0) exp(−|dx| / reach)``.

    Input ``lateral``: an ``Adjacent(distance, speed, present)`` for every vehicle. ``reach`` in metres.
    """

    kind: ClassVar[str] = "lateral"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", "c", "1/s", 0.1, -0.5, 1.0, null=0.0),)
    reach: float = 25.0

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the friction (m/s²)."""
        beside: Adjacent = scene.input(self.name)
        nearness = torch.exp(-beside.distance.abs() / self.reach) * beside.present
        return -p["gain"] * torch.relu(scene.speed - beside.speed) * nearness
