"""Figures of traffic: time gaps, fuel and energy, equilibrium and string stability. Pure, differentiable, SI units."""

from __future__ import annotations

import torch
from torch import Tensor

from idm_env.types import FAR

_CRUISE = (0.1569, 2.450e-2, -7.415e-4, 5.975e-5)
_ACCELERATION = (0.07224, 9.681e-2, 1.075e-3)


def time_gap(gap: Tensor, speed: Tensor, slowest: float = 1.0) -> Tensor:
    """Return the time gap ``gap / max(v, slowest)`` (s): finite at standstill."""
    return gap / speed.clamp_min(slowest)


def fuel(speed: Tensor, accel: Tensor) -> Tensor:
    """Return the fuel rate of a passenger car (mL/s).

    ``b0 + b1 v + b2 v² + b3 v³ + max(a, 0) (c0 + c1 v + c2 v²)``: Kamal, Mukai, Murata, Kawabe 2013, IEEE Trans.
    Control Syst. Technol. 21(3), 831. Braking uses what cruising at that speed does.
    """
    b0, b1, b2, b3 = _CRUISE
    c0, c1, c2 = _ACCELERATION
    cruise = b0 + speed * (b1 + speed * (b2 + speed * b3))
    return cruise + torch.relu(accel) * (c0 + speed * (c1 + speed * c2))


def fuel_per_100_km(speed: Tensor, accel: Tensor) -> Tensor:
    """Return litres per 100 km of one vehicle over time (first dimension): ``100 Σ fuel / Σ v``."""
    return 100.0 * fuel(speed, accel).sum(0) / speed.sum(0).clamp_min(1e-6)


def traction_energy(speed: Tensor, accel: Tensor, dt: float, *, rolling: float = 0.015, drag: float = 4e-4) -> Tensor:
    """Return the specific energy at the wheels over time (J/kg): ``Σ max(v (a + g c_r + c v²), 0) Δt``, time first.

    ``rolling`` c_r (1) and ``drag`` c (1/m) are those of a car; braking gives nothing back.
    """
    return torch.relu(speed * (accel + 9.81 * rolling + drag * speed * speed)).sum(0) * dt


def amplification(speed: Tensor, head: int = 0) -> Tensor:
    """Return the gain of every vehicle over vehicle ``head``: the ratio of their speeds' standard deviations over time.

    ``speed`` has shape ``(time, …, vehicles)``. A platoon is string stable (in the sense of the root mean square of
    speed, Swaroop and Hedrick 1996, IEEE Trans. Autom. Control 41) where the gain does not rise from front to back.
    """
    spread = speed.std(0, correction=0)
    return spread / spread[..., head : head + 1].clamp_min(1e-6)


def string_stable(speed: Tensor, head: int = 0) -> Tensor:
    """Return whether the last vehicle disturbs its speed no more than ``head`` does; bool, shape ``(…)``."""
    return amplification(speed, head)[..., -1] <= 1.0


def equilibrium_speed(gap: Tensor, driver: dict[str, Tensor], exponent: float = 4.0) -> Tensor:
    """Return the speed at which IDM drivers with this gap do not accelerate (m/s), by bisection in [0, v0].

    Solves ``1 − (v/v0)^δ = ((s0 + v T)/s)²``; 0 where the gap is not above s0. ``driver`` holds ``min_gap``,
    ``time_gap`` and ``desired_speed`` as in ``params["idm"]``.
    """
    with torch.no_grad():
        low = torch.zeros_like(gap)
        high = driver["desired_speed"].expand_as(gap).clone()
        for _ in range(60):
            middle = 0.5 * (low + high)
            wanted = (driver["min_gap"] + middle * driver["time_gap"]) / gap.clamp(0.1, FAR)
            free = 1.0 - (middle / driver["desired_speed"]) ** exponent > wanted * wanted
            low, high = torch.where(free, middle, low), torch.where(free, high, middle)
        return 0.5 * (low + high)
