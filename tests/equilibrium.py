"""The speed that drivers keep where all have one gap."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from idm_env.types import FAR


def equilibrium_speed(gap: Tensor, driver: Mapping[str, Tensor]) -> Tensor:
    """Return the speed at which IDM drivers with this gap do not accelerate (m/s), by bisection in [0, v0].

    Solves ``1 − (v/v0)⁴ = ((s0 + v T)/s)²``; 0 where the gap is not above s0. ``driver`` holds ``min_gap``,
    ``time_gap`` and ``desired_speed`` as in ``params["idm"]``.
    """
    with torch.no_grad():
        low = torch.zeros_like(gap)
        high = driver["desired_speed"].expand_as(gap).clone()
        for _ in range(60):
            middle = 0.5 * (low + high)
            ratio = (driver["min_gap"] + middle * driver["time_gap"]) / gap.clamp(0.1, FAR)
            free = 1.0 - (middle / driver["desired_speed"]) ** 4.0 > ratio * ratio
            low, high = torch.where(free, middle, low), torch.where(free, high, middle)
        return 0.5 * (low + high)
