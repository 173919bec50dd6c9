"""A closed ring: the leader of vehicle 0 is the last vehicle."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.roads.base import Road
from idm_env.types import State
from idm_env.validation import at_least


@dataclass(frozen=True)
class Ring(Road):
    """Independent rings, one per batch row. Positions are unwrapped: they grow without end, lap after lap.

    ``circumference`` (m) is needed only where a state is made: gaps are state afterwards. A tensor of one per batch row
    can be given there instead. ValueError for a circumference that is no number of at least 1 m.
    """

    circumference: float | None = None
    around: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.circumference is not None:
            at_least("Ring: circumference", self.circumference, 1.0, "m", 1e9)

    def ahead(self, x: Tensor) -> Tensor:
        """Return the leader's x."""
        return torch.cat((x[..., -1:], x[..., :-1]), dim=-1)

    def back(self, x: Tensor) -> Tensor:
        """Return the follower's x."""
        return torch.cat((x[..., 1:], x[..., :1]), dim=-1)

    def lap(self, state: State) -> Tensor | None:
        """Return ``Σ (gap + length)`` (m): what rings were made with, whichever each of them is."""
        return (state.gap + state.length).sum(-1)

    def led(self, x: Tensor) -> Tensor:
        """Return 1 for all: on a ring everybody has a leader, be it himself."""
        return torch.ones(x.shape[-1], dtype=x.dtype, device=x.device)

    def gaps(self, position: Tensor, length: Tensor, circumference: Tensor | float | None = None) -> Tensor:
        """Return ``position[i−1] − length[i−1] − position[i]``, plus the circumference for vehicle 0 (m).

        ValueError if the vehicles are longer than the ring.
        """
        around = self.circumference if circumference is None else circumference
        if around is None:
            raise ValueError("a ring needs its circumference (m): Ring(230.0) or state(…, circumference=230.0).")
        around = torch.as_tensor(around, dtype=position.dtype, device=position.device)
        total = length.expand_as(position).sum(-1)
        if bool((total >= around).any()):
            raise ValueError(
                f"{position.shape[-1]} vehicles of {float(total.max()):g} m in all do not fit a ring of "
                f"{float(around.min()):g} m. Take fewer vehicles or a longer ring."
            )
        first = torch.arange(position.shape[-1], device=position.device) == 0
        return self.ahead(position) - self.ahead(length) - position + torch.where(first, around[..., None], 0.0)
