"""What the driver sees: delayed, blurred, biased or imagined scenes (hook ``perceive``)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.parameters import Parameter
from idm_env.types import Driver, Imagined, Neighbour, Scene


def _signals(scene: Scene) -> Tensor:
    """Stack what a driver perceives: own speed, then gap, speed and acceleration of each neighbour in the scene."""
    seen = [scene.speed]
    for neighbour in (scene.leader, scene.second_leader, scene.behind):
        if neighbour is not None:
            seen += [neighbour.gap, neighbour.speed, neighbour.accel]
    return torch.stack(torch.broadcast_tensors(*seen), dim=-1)


def _with_signals(scene: Scene, signals: Tensor) -> Scene:
    """Put stacked signals back into a scene; presence is never delayed, so an absent neighbour stays absent."""
    channel = iter(signals.unbind(-1))

    def renew(neighbour: Neighbour | None) -> Neighbour | None:
        return neighbour and Neighbour(next(channel), next(channel), next(channel), neighbour.present)

    speed = next(channel)
    leader = renew(scene.leader)
    assert leader is not None
    return scene._replace(
        speed=speed, leader=leader, second_leader=renew(scene.second_leader), behind=renew(scene.behind)
    )


@dataclass(frozen=True)
class Delay(Effect):
    """Reaction delay: the driver reacts to the scene of τ seconds ago (Treiber, Kesting, Helbing 2006, Physica A 360).

    Every input of the driver, his own speed included, is taken at t − τ, by linear interpolation between steps. The
    interpolation starts from ``floor(τ/Δt)``, so its derivative at τ = 0 is minus the last change, not zero; it has
    kinks at multiples of Δt. ``max_delay`` (s) sets the static length of the buffer.
    """

    kind: ClassVar[str] = "delay"
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("delay", "τ", "s", 0.5, 0.0, 1.5, null=0.0, starts=(0.3, 0.8)),
    )
    max_delay: float = 1.5

    def _slots(self, dt: float) -> int:
        return math.ceil(self.max_delay / dt - 1e-9) + 1

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return a past that equals the present, shape ``(..., vehicles, slots, signals)``."""
        signals = _signals(scene)
        return signals.unsqueeze(-2).expand(*signals.shape[:-1], self._slots(scene.dt), signals.shape[-1])

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene of τ seconds ago."""
        signals = _signals(scene)
        past = torch.cat((signals.unsqueeze(-2), scene.memory[self.name]), dim=-2)
        steps = (p["delay"] / scene.dt).expand(signals.shape[:-1])
        whole = steps.detach().floor().clamp(0, past.shape[-2] - 2)
        index = whole.long()[..., None, None].expand(*signals.shape[:-1], 1, signals.shape[-1])
        newer = past.gather(-2, index).squeeze(-2)
        older = past.gather(-2, index + 1).squeeze(-2)
        return _with_signals(scene, newer + (steps - whole).unsqueeze(-1) * (older - newer))

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Push the true scene of this step."""
        return torch.cat((_signals(scene).unsqueeze(-2), scene.memory[self.name][..., :-1, :]), dim=-2)


@dataclass(frozen=True)
class DeadZone(Effect):
    """Threshold of looming: a closing speed is seen as 0 while ``1.8 |Δv| / s² < θ`` (Wiedemann 1974).

    The step is written ``1 / (1 + (θ/x)^n)`` with x the looming rate and n = ``sharpness``, exactly 1 at θ = 0 and
    differentiable in θ where θ > 0. At θ = 0 the derivative vanishes: search from the ``starts``.
    """

    kind: ClassVar[str] = "dead_zone"
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("threshold", "θ", "rad/s", 0.002, 0.0, 0.02, null=0.0, role="threshold", starts=(0.001, 0.004)),
    )
    sharpness: int = 8

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with small looming removed."""
        closing = scene.speed - scene.leader.speed
        gap = scene.leader.gap.clamp_min(0.1)
        looming = (1.8 * closing.abs() / (gap * gap)).clamp_min(1e-7)
        seen = 1.0 / (1.0 + (p["threshold"] / looming) ** self.sharpness)
        return scene._replace(leader=scene.leader._replace(speed=scene.leader.speed + (1.0 - seen) * closing))


@dataclass(frozen=True)
class GapBias(Effect):
    """A gap seen (or measured) as gap + d metres, wherever there is a leader."""

    kind: ClassVar[str] = "gap_bias"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("bias", "d", "m", 1.0, -5.0, 5.0, null=0.0),)

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with the biased gap."""
        biased = scene.leader.gap + p["bias"] * scene.leader.present
        return scene._replace(leader=scene.leader._replace(gap=biased))


@dataclass(frozen=True)
class ImaginedLeader(Effect):
    """A free gap Δp and closing speed Δv per step in place of the leader's (Son et al. 2024, the paper's filtering).

    Input ``imagined``: an ``Imagined(gap, closing_speed)``. There is always a leader then, be it imagined.
    """

    kind: ClassVar[str] = "imagined"

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with the imagined leader."""
        imagined: Imagined = scene.input(self.name)
        speed = scene.speed - imagined.closing_speed
        return scene._replace(
            leader=Neighbour(imagined.gap, speed, torch.zeros_like(speed), torch.ones_like(scene.leader.present))
        )
