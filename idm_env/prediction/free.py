"""Without lanes: road users who keep their velocity, and those who keep their motion with a spread."""

from functools import lru_cache

import numpy as np
from scipy.stats import norm, qmc

from idm_env.data.scenario import Agent

DRAWS = 128
KEEPING, KEEPING_SPEED, KEEPING_ANGLE = 32, 0.1, 0.1
"""Futures near constant velocity, and their deviations of speed (relative) and of direction (rad)."""
WANDER = {"pedestrian": 0.35, "cyclist": 0.2, "vehicle": 0.25}
"""Deviation of the direction (rad) that each kind takes within some seconds."""
STOPPING = 0.15
FADE_S = 2.0
"""Time in which the present acceleration and yaw rate fade (s)."""
WALKING = 0.45
"""Share of pedestrians who go over to the speed at which people like to walk."""
WALK_MPS, WALK_DEVIATION = 1.34, 0.26
"""That speed: mean and deviation (m/s), Weidmann 1993."""
WALK_S = (0.5, 4.0)
"""Time in which they do (s), from starters to runners who fall back."""


@lru_cache(maxsize=16)
def quantiles(count: int, dimensions: int, seed: int) -> np.ndarray:
    """Return evenly spread points [count, dimensions] of the unit cube, the same at every call."""
    power = max(1, int(np.ceil(np.log2(count))))
    return np.clip(qmc.Sobol(dimensions, seed=seed).random_base2(power)[:count], 1e-3, 1 - 1e-3)


def motion_now(agent: Agent, present: int, dt: float = 0.1) -> tuple[float, float, float, float]:
    """Return speed (m/s), direction (rad), acceleration (m/s²) and yaw rate (rad/s) from the last second.

    Straight lines of least squares over the second, at its end: a single velocity is noisy. A direction is that of the
    velocity where it moves, else that of the body.
    """
    steps = np.arange(max(0, present - 10), present + 1)
    steps = steps[agent.valid[steps]]
    speeds = np.hypot(*agent.velocity[steps].T)
    speed = float(speeds[-1])
    vx, vy = agent.velocity[present]
    direction = float(np.arctan2(vy, vx)) if speed > 0.5 else float(agent.heading[present])
    if len(steps) < 4:
        return speed, direction, 0.0, 0.0
    time = (steps - steps[-1]) * dt
    slope, level = np.polyfit(time, speeds, 1)
    speed, accel = max(float(level), 0.0), float(np.clip(slope, -4.0, 3.0))
    turning = float(np.clip(np.polyfit(time, np.unwrap(agent.heading[steps]), 1)[0], -0.6, 0.6))
    return speed, direction, accel, turning if speed > 0.5 else 0.0


def free_futures(agent: Agent, present: int, steps: int, dt: float = 0.1) -> np.ndarray:
    """Return futures [DRAWS, S, 2]: speed and direction go on, fading trends and a random change in each.

    ``v(t) = max(0, v + (a/2 + ξ) τ (1 − e^(−t/τ)))`` with ξ normal of 0.2 + 0.04 v m/s²; the direction likewise, with
    the yaw rate and a wandering of 0.2 to 0.35 rad; 15 % brake to a stop with 1 m/s². Of the pedestrians, 45 % go over
    to walking, ``v(t) = w + (v − w) e^(−t/τ)``.
    """
    u = quantiles(DRAWS, 4, 1)
    speed, direction, accel, turning = motion_now(agent, present, dt)
    time = dt * np.arange(1, steps + 1)
    faded = FADE_S * (1 - np.exp(-time / FADE_S))
    push = 0.5 * accel + (0.2 + 0.04 * speed) * norm.ppf(u[:, 0])
    speeds = np.maximum(speed + push[:, None] * faded, 0.0)
    stopping = u[:, 2] < STOPPING
    speeds[stopping] = np.maximum(speed - (0.5 + u[stopping, 0])[:, None] * time, 0.0)
    if agent.kind == "pedestrian":
        walking = u[:, 2] > 1.0 - WALKING
        target = (WALK_MPS + WALK_DEVIATION * norm.ppf(u[walking, 0]))[:, None]
        slowness = (WALK_S[0] + (WALK_S[1] - WALK_S[0]) * u[walking, 3])[:, None]
        speeds[walking] = np.maximum(target + (speed - target) * np.exp(-time / slowness), 0.0)
    wander = WANDER.get(agent.kind, 0.3) * norm.ppf(u[:, 1])
    angle = direction + turning * faded + wander[:, None] * (1 - np.exp(-time / 3.0))
    step = dt * speeds[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(agent.position[present] + np.cumsum(step, axis=1))


def constant_velocity(agent: Agent, present: int, steps: int, dt: float = 0.1) -> np.ndarray:
    """Return the future [1, S, 2] at the present velocity."""
    time = dt * np.arange(1, steps + 1)
    return np.asarray(agent.position[present] + time[:, None] * agent.velocity[present])[None]


def kept_velocity(agent: Agent, present: int, steps: int, dt: float = 0.1) -> np.ndarray:
    """Return futures [KEEPING, S, 2] near constant velocity; the first is constant velocity itself.

    Walking people are predicted by it as well as by trained networks (Schöller et al. 2020), and who stands mostly
    stays. The spread is proportional to the speed, so that standing is exact.
    """
    z = norm.ppf(quantiles(KEEPING, 2, 2))
    z[0] = 0.0
    cos, sin = np.cos(KEEPING_ANGLE * z[:, 1]), np.sin(KEEPING_ANGLE * z[:, 1])
    x, y = agent.velocity[present]
    velocity = (1.0 + KEEPING_SPEED * z[:, :1]) * np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    time = dt * np.arange(1, steps + 1)
    return np.asarray(agent.position[present] + time[None, :, None] * velocity[:, None])
