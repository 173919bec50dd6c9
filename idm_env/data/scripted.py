"""Inputs of synthetic platoons: leaders that stop, go and run away, a queue beside them, and drivers' noise."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from idm_env.data.platoon import PlatoonMotion

VEHICLES_BESIDE = 30


def leaders(random: np.random.Generator, runs: int, steps: int, step: float, cruise: float) -> PlatoonMotion:
    """Return leaders that stop and go, cruise, brake sharply and run away for a while, as a smooth speed profile."""
    speed, draw = np.empty((steps, runs)), random.uniform
    for run in range(runs):
        knots, values, now = [0.0], [random.uniform(8.0, 16.0)], 0.0
        while now < steps * step:
            hold = random.uniform(3.0, 15.0)
            kind = random.choice(4, p=[0.25, 0.35, 0.25, 0.15])
            target = [draw(0.0, 2.0), draw(4.0, 14.0), draw(14.0, cruise), 1.35 * cruise][kind]
            hold = random.uniform(2.0, 5.0) if kind in (0, 3) else hold
            rate = random.uniform(0.5, 1.6) if target > values[-1] else random.uniform(0.6, 3.0)
            change = abs(target - values[-1]) / rate
            knots += [now + hold, now + hold + change]
            values += [values[-1], target]
            now += hold + change
            if kind == 3:  # back before the followers, at their desired speed, have lost it
                knots.append(now + (target - 0.8 * cruise) / 2.5)
                values.append(0.8 * cruise)
                now = knots[-1]
        speed[:, run] = np.interp(np.arange(steps) * step, knots, values)
    speed = np.maximum(gaussian_filter1d(speed, 0.6 / step, axis=0, mode="nearest"), 0.0)
    moved = np.cumsum((speed[1:] + speed[:-1]) * (step / 2), axis=0)
    position = random.uniform(0.0, 200.0, runs) + np.concatenate([np.zeros((1, runs)), moved])
    return PlatoonMotion(position, speed, np.gradient(speed, step, axis=0))


LAP_M = 900.0
BENDS_M = (150.0, 380.0, 640.0)


def lapping(random: np.random.Generator, runs: int, steps: int, step: float, cruise: float) -> PlatoonMotion:
    """Return leaders that drive laps of `LAP_M` and brake for the same bends every time, each a little differently."""
    position, speed = np.empty((2, steps, runs))
    x, v = random.uniform(0.0, LAP_M, runs), np.full(runs, 0.6 * cruise)
    pace = random.uniform(0.85, 1.0, runs)
    moods = ornstein_uhlenbeck(random, (steps, runs), 0.06, 8.0, step)
    for k in range(steps):
        position[k], speed[k] = x, v
        place = np.mod(x, LAP_M)[:, None]
        slow = np.exp(-(((place - BENDS_M) / 45.0) ** 2)).max(1)
        target = cruise * pace * (1.0 + moods[k]) * (1.0 - 0.65 * slow)
        accel = np.clip((target - v) / 1.5, -3.0, 1.5)
        x = x + step * v + 0.5 * step**2 * accel
        v = np.maximum(v + step * accel, 0.0)
    speed = gaussian_filter1d(speed, 0.4 / step, axis=0, mode="nearest")
    moved = np.cumsum((speed[1:] + speed[:-1]) * (step / 2), axis=0)
    position = position[0] + np.concatenate([np.zeros((1, runs)), moved])
    return PlatoonMotion(position, speed, np.gradient(speed, step, axis=0))


def adjacent_queue(leader: PlatoonMotion) -> PlatoonMotion:
    """Return a slower queue in the adjacent lane, long enough to have somebody beside each follower all the time."""
    start = leader.position[0][None, :, None]
    ahead = 40.0 * (np.arange(VEHICLES_BESIDE) - 6)
    position = start + ahead + 0.7 * (leader.position[:, :, None] - start)
    ones = np.ones(VEHICLES_BESIDE)
    return PlatoonMotion(position, 0.7 * leader.speed[:, :, None] * ones, 0.7 * leader.accel[:, :, None] * ones)


def ornstein_uhlenbeck(
    random: np.random.Generator, shape: tuple[int, ...], sigma: float, memory: float, step: float
) -> np.ndarray:
    """Return noise [steps, …] with standard deviation `sigma` and an autocorrelation exp(−t / memory)."""
    if sigma == 0.0:
        return np.zeros(shape)
    keep = np.exp(-step / memory)
    normal = random.standard_normal(shape)
    normal[1:] *= np.sqrt(1 - keep**2)
    return sigma * lfilter([1.0], [1.0, -keep], normal, axis=0)
