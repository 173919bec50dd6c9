"""An open lane: vehicle 0 is in front and has nobody ahead."""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.roads.base import Road
from idm_env.types import FAR


@dataclass(frozen=True)
class Lane(Road):
    """Independent open lanes, one per batch row; lanes of unequal length are padded with absent vehicles."""

    def ahead(self, x: Tensor) -> Tensor:
        """Return the leader's x; the front vehicle its own."""
        return torch.cat((x[..., :1], x[..., :-1]), dim=-1)

    def back(self, x: Tensor) -> Tensor:
        """Return the follower's x; the last vehicle its own."""
        return torch.cat((x[..., 1:], x[..., -1:]), dim=-1)

    def led(self, x: Tensor) -> Tensor:
        """Return 0 for the front vehicle, 1 for the others."""
        return (torch.arange(x.shape[-1], device=x.device) > 0).to(x.dtype)

    def gaps(self, position: Tensor, length: Tensor, circumference: Tensor | float | None = None) -> Tensor:
        """Return ``position[i−1] − length[i−1] − position[i]`` (m). ValueError for a circumference."""
        if circumference is not None:
            raise ValueError(f"an open lane has no circumference, and {circumference} was given. Use Ring().")
        return torch.where(self.led(position) > 0, self.ahead(position) - self.ahead(length) - position, FAR)
