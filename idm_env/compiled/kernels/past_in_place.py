"""A simulator's step that reads the past where it lies: an array that steps add to, without the present in front.

Shapes: the past is ``(rows, vehicles, slots, signals)``, newest step first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from idm_env.delay_buffer import PAST, seeing, signals
from idm_env.step import CarFollowingStep
from idm_env.types import Scene, State


class PastInPlace:
    """The past as a step reads it: where it lies, without the present in front; ``now`` is what the step adds."""

    def __init__(self, buffer: Tensor, dt: float) -> None:
        self.buffer, self.dt = buffer, dt
        self.now: Tensor | None = None

    def at(self, scene: Scene, seconds: Tensor) -> Scene:
        """Return the scene of some seconds ago, as ``History.at``."""
        now, past = torch.stack(torch.broadcast_tensors(*signals(scene)), dim=-1), self.buffer
        steps = (seconds / self.dt).expand(now.shape[:-1])
        whole = steps.detach().floor().clamp(0, past.shape[-2] - 1)

        def signals_of(step: Tensor) -> Tensor:
            index = (step - 1).clamp(min=0)[..., None, None].expand(*now.shape[:-1], 1, now.shape[-1])
            return torch.where((step == 0).unsqueeze(-1), now, past.gather(-2, index).squeeze(-2))

        newer, older = signals_of(whole.long()), signals_of(whole.long() + 1)
        return seeing(scene, list((newer + (steps - whole).unsqueeze(-1) * (older - newer)).unbind(-1)))

    def pushed(self, scene: Scene) -> Tensor:
        """Note the present; who has recorded the step puts it in front."""
        self.now = torch.stack(torch.broadcast_tensors(*signals(scene)), dim=-2)
        return self.buffer


@dataclass(frozen=True)
class Stepper(CarFollowingStep):
    """A simulator whose step reads a past where it lies."""

    looked: list[PastInPlace] = field(default_factory=list)

    def _history(self, state: State) -> Any:
        if PAST in state.memory:
            self.looked[:] = [PastInPlace(state.memory[PAST], self.dt)]
            return self.looked[0]
        return None
