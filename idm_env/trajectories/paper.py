"""The recipe as published: five IDM parameters and an imagined leader per step, by Adam on the mean absolute error.

Son et al. 2024. Per trajectory: p(0) is the first point, v(0) comes from the first two; initial parameters a, b, T, s0,
v0 = 10, 2, 1, 5, 50 within [5, 10], [0.1, 5], [0.1, 5], [1, 10], [20, 60]; imagined gap 10 m and closing speed 0 at
first; braking at most 10 m/s²; 500 steps of Adam, learning rate linearly from 0.1 to 0.01; the smooth equations
(sharpness 1), explicit Euler, steps of 0.1 s for filtering and 1 s for reconstruction. The paper states no bounds for
the imagined inputs: here the gap stays in [1, 10 000] m and the closing speed in [−100, 100] m/s, and all values are
put back into their bounds after every step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from idm_env.trajectories.recipe import clock_of
from idm_env.trajectories.scores import Motion
from idm_env.trajectories.tracks import Track

NAMES = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")
START = np.array([10.0, 2.0, 1.0, 5.0, 50.0])
LOW = np.array([5.0, 0.1, 0.1, 1.0, 20.0])
HIGH = np.array([10.0, 5.0, 5.0, 10.0, 60.0])
GAP_BOUNDS = np.array([1.0, 1e4])
CLOSING_BOUNDS = np.array([-100.0, 100.0])
MAX_DECEL = 10.0
ITERATIONS = 500
RATES = (0.1, 0.01)
FILTER_STEP_S, RECONSTRUCT_STEP_S = 0.1, 1.0
NOBODY = np.empty(0)
"""No real leader: an imagined one."""


@dataclass(frozen=True, eq=False)
class Imitated:
    """Result for one track: motion [K], the five values, imagined gap (m) and closing speed (m/s) [K], final loss."""

    motion: Motion
    values: np.ndarray
    gap: np.ndarray
    closing_speed: np.ndarray
    loss: float


def imitate(
    track: Track, dt: float = FILTER_STEP_S, *, iterations: int = ITERATIONS, fixed_parameters: bool = False
) -> Imitated:
    """Fit one track by the published recipe; a data point is compared at the simulation step nearest in time.

    ``fixed_parameters`` keeps the five at their initial values (the paper's ablation). ImportError without numba.
    """
    from idm_env.trajectories import paper_loops as loops

    clock = clock_of(track, dt)
    at = np.clip(np.round((track.time_s - clock[0]) / dt).astype(np.int64), 0, len(clock) - 1)
    target = track.position_m - track.position_m[0]
    speed0 = max(0.0, float(target[1] / (track.time_s[1] - track.time_s[0])))
    values, gap, closing = START.copy(), np.full(len(clock), 10.0), np.zeros(len(clock))
    position, speed, accel = (np.empty(len(clock)) for _ in range(3))
    loss = loops.optimise(
        at, target, speed0, values, gap, closing, NOBODY, NOBODY, LOW, HIGH, GAP_BOUNDS, CLOSING_BOUNDS, dt, MAX_DECEL,
        iterations, RATES[0], RATES[1], fixed_parameters, position, speed, accel,
    )  # fmt: skip
    return Imitated(Motion(clock, position + track.position_m[0], speed, accel), values, gap, closing, float(loss))


def follow(position_m: np.ndarray, speed0: float, rear_m: np.ndarray, pace: np.ndarray, dt: float) -> np.ndarray:
    """Return the five values fitted behind a real leader to positions [K] every ``dt`` (s), by the same optimisation.

    This is the recipe of prediction: nothing is imagined. ``rear_m`` and ``pace`` [K] are the leader's rear bumper (m)
    and speed (m/s), ``speed0`` the first speed (m/s).
    """
    from idm_env.trajectories import paper_loops as loops

    count = len(position_m)
    values, origin = START.copy(), position_m[0]
    gap, closing, position, speed, accel = (np.empty(count) for _ in range(5))
    loops.optimise(
        np.arange(count), position_m - origin, speed0, values, gap, closing, rear_m - origin, pace, LOW, HIGH,
        GAP_BOUNDS, CLOSING_BOUNDS, dt, MAX_DECEL, ITERATIONS, RATES[0], RATES[1], False, position, speed, accel,
    )  # fmt: skip
    return values


def drive(values: np.ndarray, speed0: float, rear_m: np.ndarray, pace: np.ndarray, dt: float) -> np.ndarray:
    """Return the distances [K] that the five values drive from 0 at ``speed0``, behind a leader as in ``follow``."""
    from idm_env.trajectories import paper_loops as loops

    gap, closing, position, speed, accel = (np.empty(len(rear_m)) for _ in range(5))
    loops.forward(speed0, values, gap, closing, rear_m, pace, dt, MAX_DECEL, position, speed, accel)
    return position
