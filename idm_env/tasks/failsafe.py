"""The failsafe of agents: the safe speed of Krauß, as an acceleration."""

import torch
from torch import Tensor

STANDSTILL = 1.0
"""Gap that the failsafe leaves (m)."""


def safe_accel(
    speed: Tensor,
    lead_speed: Tensor,
    gap: Tensor,
    decel: float | Tensor,
    seconds: float | Tensor,
    dt: float,
    euler: bool,
) -> Tensor:
    """Return the highest acceleration (m/s²), elementwise, that leaves room to stop behind a leader who brakes as hard.

    The safe speed of Krauß 1998 (Microscopic modeling of traffic flow), which SUMO keeps, for one step Δt: the largest
    v' with ``(v + v')/2 Δt + v' τ + v'²/(2b) ≤ s − 1 m + v_lead²/(2b)``, b and τ being ``decel`` (m/s²) and
    ``seconds``. Where it holds at first and no leader brakes harder than b, it can be kept with b for ever: no two
    vehicles touch, and behind a leader of the same speed the time gap is at least τ.
    """
    # Euler moves by the old speed; the speed after the step then costs its half step later.
    way = speed * dt if euler else 0.5 * speed * dt
    half = decel * (seconds + 0.5 * dt)
    room = 2.0 * decel * (gap - STANDSTILL - way) + lead_speed * lead_speed
    # Below the clamp the vehicle must stop at once, whatever the root.
    safe = torch.sqrt((room + half * half).clamp_min(1e-6)) - half
    return (safe - speed) / dt
