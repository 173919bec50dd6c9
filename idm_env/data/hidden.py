"""The hidden effects of the synthetic data: equations of acceleration, in numpy, independent of the simulator's code.

Base: a [1 − (v/v0)⁴ − (s*/s)²] with s* = s0 + max(0, v T + v Δv / (2 √(ab))) (Treiber, Hennecke, Helbing 2000). Every
effect below changes one thing in it; sources are named in `idm_env.effects`.
"""

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.81
HARDEST_BRAKING = 9.0
MEMORY_TIME_S = 120.0
ZONE_M = (800.0, 1500.0)
SHIFT_TIME_S = 100.0
REFERENCE_SPEED = 20.0
SIGN_WIDTH = 0.3
RELAXATION_TIME_S = 15.0
TREND_TIME_S = 6.0
TREND_MPS = 3.0
DIPS_M = (500.0, 1000.0, 1400.0, 2000.0, 2600.0)
BENDS_PER_M = {400.0: 1 / 80, 900.0: -1 / 120, 1500.0: 1 / 60, 2100.0: -1 / 90, 2700.0: 1 / 70}
"""Where bends are, and their curvature, to the left positive."""
PRESSURE_CAP = 4.0
REACH_M = 25.0


@dataclass(frozen=True)
class HiddenStrength:
    """An effect's strength: its symbol, and the values that count as middle and as half of it."""

    symbol: str
    middle: float
    half: float


_STRENGTHS = {"delay": ("tau_s", 0.5, 0.25), "lag": ("tau_s", 0.5, 0.25), "second_leader": ("weight", 0.35, 0.175)}
_STRENGTHS |= {"leader_acceleration": ("gain", 0.4, 0.2), "brake_light": ("gain", 0.6, 0.3)}
_STRENGTHS |= {"asymmetry": ("k", 0.3, 0.15), "power_limit": ("watt_per_kg", 12.0, 18.0)}
_STRENGTHS |= {"drag": ("per_m", 5e-4, 2.5e-4), "speed_dependent_gap": ("s1_m", 5.0, 2.5), "memory": ("beta", 0.8, 0.4)}
_STRENGTHS |= {"follower": ("gain", 0.15, 0.075), "dead_zone": ("rad_per_s", 0.002, 0.001)}
_STRENGTHS |= {"action_point": ("mps2", 0.3, 0.15), "grade": ("steepest_slope", 0.04, 0.02)}
_STRENGTHS |= {"speed_zone": ("factor", 0.6, 0.8), "regime_shift": ("k", 0.35, 0.175), "lateral": ("per_s", 0.1, 0.05)}
_STRENGTHS |= {"gap_bias": ("bias_m", 1.5, 0.75), "speed_time_gap": ("k", -0.4, -0.2)}
_STRENGTHS |= {"set_point_asymmetry": ("k", 0.2, 0.1), "relaxation": ("beta", 0.7, 0.35)}
_STRENGTHS |= {"gap_stiffness": ("w", 0.5, 0.7), "speed_profile": ("depth", 0.6, 0.4)}
_STRENGTHS |= {"curve_speed": ("mps2", 2.0, 3.0), "leader_trend": ("kappa", 0.75, 0.87)}
EFFECTS: dict[str, HiddenStrength] = {name: HiddenStrength(*row) for name, row in _STRENGTHS.items()}
"""Every effect of the catalogue. ``gap_bias`` changes the measured gap, not the motion."""


@dataclass(frozen=True)
class Drivers:
    """Parameters of the followers, arrays [runs, followers], SI units."""

    time_gap: np.ndarray
    min_gap: np.ndarray
    max_accel: np.ndarray
    comfort_decel: np.ndarray
    desired_speed: np.ndarray


@dataclass(frozen=True)
class View:
    """Surroundings of the followers at one moment, arrays [runs, followers]; NaN where there is no such vehicle."""

    time: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    gap: np.ndarray
    lead_speed: np.ndarray
    second_gap: np.ndarray
    second_speed: np.ndarray
    gap_behind: np.ndarray
    beside_distance: np.ndarray
    beside_speed: np.ndarray
    memory: np.ndarray
    lead_accel: np.ndarray
    habit: np.ndarray
    lead_level: np.ndarray


def slope(position: np.ndarray, steepest: float) -> np.ndarray:
    """Return the road's slope (rise over run) at positions in m: two waves, together at most `steepest`."""
    return steepest * (0.6 * np.sin(2 * np.pi * position / 730.0) + 0.4 * np.sin(2 * np.pi * position / 1170.0 + 1.0))


def dips(position: np.ndarray, depth: float) -> np.ndarray:
    """Return the desired speed at positions in m relative to that elsewhere: five dips by `depth`, about 200 m long."""
    return 1.0 - depth * np.max([np.exp(-(((position - x) / 80.0) ** 2)) for x in DIPS_M], axis=0)


def curvature(position: np.ndarray) -> np.ndarray:
    """Return the road's curvature (1/m) at positions in m."""
    return np.sum([k * np.exp(-(((position - x) / 80.0) ** 2)) for x, k in BENDS_PER_M.items()], axis=0)


def desired_accel(
    view: View, seen: tuple[np.ndarray, np.ndarray, np.ndarray], drivers: Drivers, on: dict[str, float]
) -> np.ndarray:
    """Return the followers' wanted accelerations (m/s²), but for the leader's acceleration and the vehicle's limits.

    Args:
        view: The true scene.
        seen: Gap, speed and leader's speed as the driver sees them: those of a delay ago.
        drivers: Parameters.
        on: Strength by name of every effect at work.
    """
    gap, speed, lead_speed = seen
    closing = speed - lead_speed
    if "dead_zone" in on:
        closing = np.where(1.8 * np.abs(closing) / np.maximum(gap, 0.1) ** 2 < on["dead_zone"], 0.0, closing)
    time_gap, top = _adapted(view, drivers, on)
    desired = _desired_gap(speed, closing, time_gap, drivers)
    if "speed_dependent_gap" in on:
        desired = desired + on["speed_dependent_gap"] * np.sqrt(np.maximum(speed, 0.0) / top)
    if "gap_stiffness" in on:
        equilibrium = (drivers.min_gap + speed * time_gap) / np.sqrt(1 - np.clip(speed / top, 0.0, 0.95) ** 4)
        desired = desired * np.clip(np.maximum(gap, 0.1) / equilibrium, 0.05, 20.0) ** (1 - on["gap_stiffness"])
    interaction = (desired / np.maximum(gap, 0.1)) ** 2
    if "second_leader" in on:
        behind_two = _desired_gap(speed, speed - view.second_speed, time_gap, drivers)
        other = (behind_two / np.maximum(view.second_gap / 2, 0.1)) ** 2
        weight = on["second_leader"]
        interaction = np.where(np.isnan(other), interaction, (1 - weight) * interaction + weight * other)
    accel = drivers.max_accel * (1 - (speed / top) ** 4 - interaction)
    if "follower" in on:
        pressure = ((drivers.min_gap + speed * time_gap) / np.maximum(view.gap_behind, 0.1)) ** 2
        push = on["follower"] * drivers.max_accel * np.minimum(pressure, PRESSURE_CAP)
        accel = accel + np.nan_to_num(push)
    if "lateral" in on:
        friction = np.maximum(speed - view.beside_speed, 0.0) * np.exp(-np.abs(view.beside_distance) / REACH_M)
        accel = accel - on["lateral"] * np.nan_to_num(friction)
    if "drag" in on:
        accel = accel - on["drag"] * view.speed**2
    if "grade" in on:
        accel = accel - GRAVITY * np.sin(np.arctan(slope(view.position, on["grade"])))
    return accel


def with_feed_forward(accel: np.ndarray, lead_accel: np.ndarray, on: dict[str, float]) -> np.ndarray:
    """Return the acceleration with the reaction to the leader's own acceleration."""
    if "leader_acceleration" in on:
        accel = accel + on["leader_acceleration"] * lead_accel
    if "brake_light" in on:
        accel = accel + on["brake_light"] * np.minimum(lead_accel, 0.0)
    return accel


def limited(accel: np.ndarray, speed: np.ndarray, held: np.ndarray, on: dict[str, float]) -> np.ndarray:
    """Return the accelerations within the vehicles' limits (m/s²): asymmetry, action points, power, brakes."""
    if "asymmetry" in on:
        accel = accel - on["asymmetry"] * np.abs(accel)
    if "action_point" in on:
        accel = np.where(np.abs(accel - held) >= on["action_point"], accel, held)
    if "power_limit" in on:
        accel = np.minimum(accel, on["power_limit"] / np.maximum(speed, 0.1))
    return np.maximum(accel, -HARDEST_BRAKING)


def _adapted(view: View, drivers: Drivers, on: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    time_gap, top = drivers.time_gap, drivers.desired_speed
    if "memory" in on:
        time_gap = time_gap * (1 + on["memory"] * (1 - view.memory))
    if "regime_shift" in on:
        time_gap = time_gap * (1 + on["regime_shift"] * (view.time > SHIFT_TIME_S))
    if "speed_time_gap" in on:
        time_gap = time_gap * np.maximum(1 + on["speed_time_gap"] * (view.speed / REFERENCE_SPEED - 1), 0.1)
    if "set_point_asymmetry" in on:
        branch = view.lead_accel / np.hypot(view.lead_accel, SIGN_WIDTH)
        time_gap = time_gap * (1 + on["set_point_asymmetry"] * branch)
    if "relaxation" in on:
        time_gap = time_gap * (1 + on["relaxation"] * (view.habit - 1))
    if "leader_trend" in on:
        time_gap = time_gap * on["leader_trend"] ** np.clip((view.lead_speed - view.lead_level) / TREND_MPS, -2.0, 2.0)
    if "speed_zone" in on:
        inside = (view.position > ZONE_M[0]) & (view.position < ZONE_M[1])
        top = np.where(inside, on["speed_zone"] * top, top)
    if "speed_profile" in on:
        top = top * dips(view.position, on["speed_profile"])
    if "curve_speed" in on:
        top = np.minimum(top, np.sqrt(on["curve_speed"] / np.maximum(np.abs(curvature(view.position)), 1e-6)))
    return time_gap, top


def habit_of(gap: np.ndarray, speed: np.ndarray, drivers: Drivers) -> np.ndarray:
    """Return the gap relative to that of equilibrium, which drivers get used to."""
    room = np.maximum(1 - (speed / drivers.desired_speed) ** 4, 0.1)
    equilibrium = (drivers.min_gap + speed * drivers.time_gap) / np.sqrt(room)
    return np.clip(gap / equilibrium, 0.2, 2.0)


def _desired_gap(speed: np.ndarray, closing: np.ndarray, time_gap: np.ndarray, drivers: Drivers) -> np.ndarray:
    braking = 2.0 * np.sqrt(drivers.max_accel * drivers.comfort_decel)
    return drivers.min_gap + np.maximum(speed * time_gap + speed * closing / braking, 0.0)
