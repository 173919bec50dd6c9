"""Figures of traffic: time gaps, fuel and energy, string stability. Pure, differentiable, SI units.

Shapes: rates are elementwise over ``[..., n]``; sums over time run along the first dimension.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from idm_env.validation import one_of

_CRUISE = (0.1569, 2.450e-2, -7.415e-4, 5.975e-5)
_ACCELERATION = (0.07224, 9.681e-2, 1.075e-3)
_GASOLINE = 0.745
"""Density (g/mL), about the middle of what EN 228 allows."""
CO2 = 2.31
"""CO₂ of gasoline (g/mL): 69.3 g/MJ, 44.3 MJ/kg (IPCC 2006 Guidelines, volume 2, tables 1.2, 1.4), 0.752 kg/L."""
_STANDING = (0.1, 0.01)
"""Speed (m/s) and acceleration (m/s²) below which an engine idles in the CIRCLES model."""


def time_gap(gap: Tensor, speed: Tensor, slowest: float = 1.0) -> Tensor:
    """Return the time gap ``gap / max(v, slowest)`` (s): finite at standstill."""
    return gap / speed.clamp_min(slowest)


def time_to_collision(gap: Tensor, closing: Tensor) -> Tensor:
    """Return ``gap / closing`` (s) where the closing speed ``v − v_lead`` (m/s) is above 0, elsewhere infinity.

    The time until two vehicles touch if neither changes its speed, 0 for those that do; gap in metres, elementwise.
    J. C. Hayward 1972, "Near-miss determination through use of a scale of danger", Highway Research Record 384, 24.
    """
    near = closing > 0.0
    return torch.where(near, gap.clamp_min(0.0) / torch.where(near, closing, 1.0), torch.inf)


def drac(gap: Tensor, closing: Tensor) -> Tensor:
    """Return the deceleration rate to avoid a crash (m/s²): ``closing² / (2 gap)`` where closing, elsewhere 0.

    By which a follower stops closing just before he touches; gaps (m) count as at least 1 cm, elementwise.
    D. F. Cooper, N. Ferguson 1976, "Traffic studies at T-junctions", Traffic Engineering and Control 17(7), 306.
    """
    return torch.relu(closing).square() / (2.0 * gap.clamp_min(0.01))


def post_encroachment_time(front: Tensor, length: Tensor, area: tuple[float, float], dt: float) -> Tensor:
    """Return the time (s) from when one vehicle has left a conflict area until the other enters it; shape ``(…)``.

    Where two ways cross or merge: ``front`` ``(time, …, 2)`` is each vehicle's place along its own way (m), ``area``
    where the stretch that both ways share begins and ends on it (m), ``length`` ``(…, 2)`` in metres; rows are ``dt``
    (s) apart, between which places are linear. Below 0 both were there at once; NaN where either does not pass. No
    feature or reward term: it is known only when the second has come.
    B. L. Allen, B. T. Shin, P. J. Cooper 1978, "Analysis of traffic conflicts and collisions", Transportation Research
    Record 667, 67.
    """

    def passed(place: Tensor, mark: float) -> Tensor:
        crossing = (place[:-1] < mark) & (place[1:] >= mark)
        row = crossing.to(torch.int8).argmax(0, keepdim=True)
        before, after = place.gather(0, row)[0], place.gather(0, row + 1)[0]
        return torch.where(crossing.any(0), dt * (row[0] + (mark - before) / (after - before)), torch.nan)

    enters, leaves = passed(front, area[0]), passed(front - length, area[1])
    first = enters[..., 0] <= enters[..., 1]
    gap = torch.where(first, enters[..., 1] - leaves[..., 0], enters[..., 0] - leaves[..., 1])
    return torch.where(enters.isnan().any(-1), torch.nan, gap)


def fuel(speed: Tensor, accel: Tensor, model: str = "kamal") -> Tensor:
    """Return the fuel rate of a passenger car (mL/s) by one of ``FUELS``: ``"kamal"`` or ``"circles"``.

    ValueError for another model, with a suggestion.
    """
    return FUELS[one_of("fuel_model", model, FUELS)](speed, accel)


def kamal_fuel(speed: Tensor, accel: Tensor) -> Tensor:
    """Return the fuel rate of a passenger car (mL/s) on a level road.

    ``b0 + b1 v + b2 v² + b3 v³ + max(a, 0) (c0 + c1 v + c2 v²)``: Kamal, Mukai, Murata, Kawabe 2013, IEEE Trans.
    Control Syst. Technol. 21(3), 831. Braking uses what cruising at that speed does.
    """
    b0, b1, b2, b3 = _CRUISE
    c0, c1, c2 = _ACCELERATION
    cruise = b0 + speed * (b1 + speed * (b2 + speed * b3))
    return cruise + torch.relu(accel) * (c0 + speed * (c1 + speed * c2))


def circles_fuel(speed: Tensor, accel: Tensor) -> Tensor:
    """Return the fuel rate of a midsize sedan of 1743 kg (mL/s) on a level road.

    In g/s, with ``P(v) = p0 + p1 v + p2 v²`` and ``Q(v) = q1 v``: ``c0 + c1 v + c3 v³ + P a + Q max(a, −P/(2Q))²``, so
    that harder braking never costs more; a is at most what the engine gives, ``min(3.92, 49.0/v − 1.4e-4 v²)``. At
    least idling up to 5.07 m/s, at least 0 beyond, and none there while braking by ``a ≤ −0.157 − 3.8e-4 v − 2.3e-4
    v²``, where the fuel is cut off: a jump, of which gradients know nothing.

    Simplified model ``midBase``, version 1.0 (2023), of the CIRCLES project's energy team: Khoudari, Almatrudi,
    Ramadan, Carpio, Yao, Butts, Bayen, Lee, Seibold, github.com/CIRCLES-consortium/CIRCLES-ENERGY-MODELS. Grams become
    millilitres of gasoline of 0.745 kg/L.
    """
    idle, cut_speed = 0.1271, 5.07
    v = speed.clamp_min(0.0)
    a = torch.minimum(accel, (48.9891 / v.clamp_min(1.0) - 0.00013964 * v * v).clamp_max(3.9218))
    slope = 0.23956 + v * (0.0080592 + v * 0.0027737)
    bend = 0.050556 * v
    hardest = torch.maximum(a, -slope / (2.0 * bend.clamp_min(1e-9)))
    rate = 0.19829 + v * (0.021122 + 2.7801e-5 * v * v) + slope * a + bend * hardest * hardest
    rate = torch.maximum(rate, torch.where(v <= cut_speed, idle, 0.0))
    braking = a <= -0.15742 - v * (0.00037876 + 0.00022957 * v)
    rate = torch.where((v > cut_speed) & braking, 0.0, rate)
    slowest, softest = _STANDING
    return torch.where((v < slowest) & (a.abs() < softest), idle, rate) / _GASOLINE


FUELS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"kamal": kamal_fuel, "circles": circles_fuel}
"""Published models of fuel; they differ, so figures of fuel name theirs."""


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
