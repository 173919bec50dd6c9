"""The paper's optimisation of one trajectory, compiled: rollout, exact gradient and Adam in one loop.

Equation by equation the smooth IDM of ``effects.idm`` and ``effects.limits`` with sharpness 1 and explicit Euler,
behind an imagined leader or a real one; tests hold it to the torch simulator and to the published layer.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.trajectories.compiled import compiled

FIVE = 5
NEAREST_M = 0.1
"""A real leader is never nearer than this (m)."""


@compiled
def _softplus(x):
    """Return log(1 + eˣ) and its derivative; above 20 the argument itself, as torch does."""
    if x > 20.0:
        return x, 1.0
    e = np.exp(x)
    return np.log1p(e), e / (1.0 + e)


@compiled
def forward(speed0, values, gap, closing, rear, pace, dt, max_decel, position, speed, accel):
    """Fill position (from 0), speed and acceleration [K]; the acceleration of a step starts at its own speed.

    ``rear`` (m) and ``pace`` (m/s) [K] are a real leader's, from which ``gap`` and ``closing`` are then filled; empty
    arrays leave these as imagined.
    """
    a, b, time_gap, min_gap, v0 = values[0], values[1], values[2], values[3], values[4]
    brake = 2.0 * np.sqrt(a * b)
    x, v = 0.0, speed0
    for k in range(len(position)):
        position[k], speed[k] = x, v
        if len(rear) > 0:
            gap[k], closing[k] = max(rear[k] - x, NEAREST_M), v - pace[k]
        wanted, _ = _softplus(min_gap + v * time_gap + v * closing[k] / brake)
        term, ratio = wanted / gap[k], v / v0
        square = ratio * ratio
        raw = a * (1.0 - square * square - term * term)
        floor = max(-v / dt, -max_decel)
        over, _ = _softplus(raw - floor)
        accel[k] = floor + over
        x, v = x + v * dt, v + accel[k] * dt


@compiled
def backward(values, gap, closing, real, dt, max_decel, speed, on_position, on_values, on_gap, on_closing):
    """Fill the gradients by the five values, gaps and closing speeds [K], from those by positions [K].

    Behind a real leader gaps and closing speeds follow the own motion.
    """
    a, b, time_gap, min_gap, v0 = values[0], values[1], values[2], values[3], values[4]
    root = np.sqrt(a * b)
    brake = 2.0 * root
    on_values[:] = 0.0
    on_x, on_v = 0.0, 0.0
    for k in range(len(speed) - 1, -1, -1):
        v = speed[k]
        interaction = v * closing[k] / brake
        wanted, wanted_slope = _softplus(min_gap + v * time_gap + interaction)
        inverse = 1.0 / gap[k]
        term, ratio = wanted * inverse, v / v0
        cube = ratio * ratio * ratio
        raw = a * (1.0 - cube * ratio - term * term)
        stop = -v / dt
        floor = max(stop, -max_decel)
        _, slope = _softplus(raw - floor)
        # x' = x + v dt, v' = v + accel dt: on_x and on_v are gradients by the state after this step
        on_accel = on_v * dt
        on_raw = on_accel * slope
        on_floor = on_accel * (1.0 - slope)
        on_wanted = -2.0 * a * term * inverse * on_raw * wanted_slope
        on_gap[k] = 2.0 * a * term * term * inverse * on_raw
        on_closing[k] = on_wanted * v / brake
        by_root = -on_wanted * interaction / (2.0 * root * root)
        on_values[0] += on_raw * (1.0 - cube * ratio - term * term) + by_root * b
        on_values[1] += by_root * a
        on_values[2] += on_wanted * v
        on_values[3] += on_wanted
        on_values[4] += 4.0 * a * cube * ratio / v0 * on_raw
        by_speed = -4.0 * a * cube / v0 * on_raw + on_wanted * (time_gap + closing[k] / brake)
        if stop > -max_decel:
            by_speed -= on_floor / dt
        by_position = on_position[k]
        if real:
            by_speed += on_closing[k]
            if gap[k] > NEAREST_M:
                by_position -= on_gap[k]
        on_v = on_v + on_x * dt + by_speed
        on_x = on_x + by_position


@compiled
def _adam(value, gradient, mean, square, rate, first, second, low, high):
    """One step of Adam (β 0.9 and 0.999), then back into the bounds; the corrections are given."""
    for i in range(len(value)):
        mean[i] += 0.1 * (gradient[i] - mean[i])
        square[i] += 0.001 * (gradient[i] * gradient[i] - square[i])
        moved = value[i] - rate * (mean[i] / first) / (np.sqrt(square[i] / second) + 1e-8)
        value[i] = min(max(moved, low[i]), high[i])


@compiled
def optimise(
    at, target, speed0, values, gap, closing, rear, pace, low, high, gap_bounds, closing_bounds, dt, max_decel,
    iterations, rate_first, rate_last, fixed, position, speed, accel,
):  # fmt: skip
    """Minimise the mean absolute error at the steps ``at``, in place; return the loss after the last step.

    ``values`` [5], ``gap`` and ``closing`` [K] are the start and become the result; ``fixed`` keeps the five. With a
    real leader (``rear`` and ``pace``, [K] instead of empty) only the five are free.
    """
    real = len(rear) > 0
    steps = len(gap)
    on_values, on_gap, on_closing, on_position = np.empty(FIVE), np.empty(steps), np.empty(steps), np.empty(steps)
    mean_v, square_v = np.zeros(FIVE), np.zeros(FIVE)
    mean_g, square_g, mean_c, square_c = np.zeros(steps), np.zeros(steps), np.zeros(steps), np.zeros(steps)
    low_g, high_g = np.full(steps, gap_bounds[0]), np.full(steps, gap_bounds[1])
    low_c, high_c = np.full(steps, closing_bounds[0]), np.full(steps, closing_bounds[1])
    for turn in range(iterations):
        forward(speed0, values, gap, closing, rear, pace, dt, max_decel, position, speed, accel)
        on_position[:] = 0.0
        for o in range(len(at)):
            on_position[at[o]] += np.sign(position[at[o]] - target[o]) / len(at)
        backward(values, gap, closing, real, dt, max_decel, speed, on_position, on_values, on_gap, on_closing)
        rate = rate_first + (rate_last - rate_first) * turn / iterations
        first, second = 1.0 - 0.9 ** (turn + 1), 1.0 - 0.999 ** (turn + 1)
        if not fixed:
            _adam(values, on_values, mean_v, square_v, rate, first, second, low, high)
        if not real:
            _adam(gap, on_gap, mean_g, square_g, rate, first, second, low_g, high_g)
            _adam(closing, on_closing, mean_c, square_c, rate, first, second, low_c, high_c)
    forward(speed0, values, gap, closing, rear, pace, dt, max_decel, position, speed, accel)
    loss = 0.0
    for o in range(len(at)):
        loss += abs(position[at[o]] - target[o])
    return loss / len(at)
