"""Drivers' perceptions in the last steps: the buffer that a simulator keeps where an effect looks back.

Shapes: a signal is ``[..., n]``, in its own SI unit; the buffer is ``(..., vehicles, slots, signals)``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from idm_env.types import Neighbour, Scene

PAST = "past"
"""Key of the buffer in ``State.memory``."""


def signals(scene: Scene) -> list[Tensor]:
    """Return a driver's perceptions: own speed, then gap, speed and acceleration of each neighbour in the scene."""
    seen = [scene.speed]
    for neighbour in (scene.leader, scene.second_leader, scene.behind):
        if neighbour is not None:
            seen += [neighbour.gap, neighbour.speed, neighbour.accel]
    return seen


def seeing(scene: Scene, values: list[Tensor]) -> Scene:
    """Return the scene with other signals; presence is never delayed, so an absent neighbour stays absent."""
    channel = iter(values)

    def renew(neighbour: Neighbour | None) -> Neighbour | None:
        return neighbour and Neighbour(next(channel), next(channel), next(channel), neighbour.present)

    speed = next(channel)
    leader = renew(scene.leader)
    assert leader is not None
    return scene._replace(
        speed=speed, leader=leader, second_leader=renew(scene.second_leader), behind=renew(scene.behind)
    )


def slots(seconds: float, dt: float) -> int:
    """Return how many steps before the present a buffer must hold to look back so far."""
    return math.ceil(seconds / dt - 1e-9) + 1


class History(NamedTuple):
    """Signals of the steps before this one, newest first, shape ``(..., vehicles, slots, signals)``, and Δt (s)."""

    buffer: Tensor
    dt: float

    @classmethod
    def beginning(cls, scene: Scene, seconds: float) -> History:
        """Return a past that equals the present; in memory vehicles are innermost, as compiled loops want them."""
        now = torch.stack(torch.broadcast_tensors(*signals(scene)))
        past = now.expand(slots(seconds, scene.dt), *now.shape)
        return cls(past.movedim((0, 1), (-2, -1)), scene.dt)

    def with_present(self, scene: Scene) -> Tensor:
        """Return the buffer with the present in front, one step longer."""
        now = torch.stack(torch.broadcast_tensors(*signals(scene)), dim=-1)
        return torch.cat((now.unsqueeze(-2), self.buffer), dim=-2)

    def at(self, scene: Scene, seconds: Tensor) -> Scene:
        """Return the scene of some seconds ago, by linear interpolation between steps.

        The interpolation starts from ``floor(τ/Δt)``, so its derivative at τ = 0 is minus the last change, not zero; it
        has kinks at multiples of Δt. Beyond the buffer's end the oldest two steps are continued.
        """
        past = self.with_present(scene)
        shape, count = past.shape[:-2], past.shape[-1]
        steps = (seconds / self.dt).expand(shape)
        whole = steps.detach().floor().clamp(0, past.shape[-2] - 2)
        index = whole.long()[..., None, None].expand(*shape, 1, count)
        newer = past.gather(-2, index).squeeze(-2)
        older = past.gather(-2, index + 1).squeeze(-2)
        return seeing(scene, list((newer + (steps - whole).unsqueeze(-1) * (older - newer)).unbind(-1)))

    def pushed(self, scene: Scene) -> Tensor:
        """Return the buffer after this step."""
        return self.with_present(scene)[..., :-1, :]
