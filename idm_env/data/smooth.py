"""A penalised-jerk smoother that fuses measured positions and speeds into one consistent motion.

Minimises  Σ (x − p)²/σ_p² + Σ (ẋ − v)²/σ_v² + Σ (x‴)² Δt / q  over the positions x, with speed, acceleration and jerk
as differences of x. The jerk's spectral density q is that of driving, so that the noise alone says how much to smooth.
A banded system is solved anew for every record: nothing is cached, and nothing is rounded.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

JERK_DENSITY = 0.3
"""Spectral density of a driver's jerk, m²/s⁵: a jerk of 0.4 m/s³ that lasts for about 1 s. On a known truth with
correlated position noise of 0.3 m this gave smaller errors of speed and acceleration than 1 or 3."""
SMALLEST_SIGMA = 1e-3
"""Noise is never taken as smaller than this (m or m/s): files are rounded."""
LONGEST_STRIDE_S = 0.3
"""Up to this lag a motion's own third difference, jerk times lag cubed, is below a centimetre (s)."""
_MEDIAN_OF_NORMAL = 0.6745


class SmoothMotion(NamedTuple):
    """A smooth motion: arrays [T] of position (m), speed (m/s) and acceleration (m/s²), differences of one another."""

    position: np.ndarray
    speed: np.ndarray
    accel: np.ndarray


def noise_sigma(values: ArrayLike, stride: int = 1) -> float:
    """Return the standard deviation of white noise in `values` [T], from the median of their third differences.

    A smooth motion has almost no third difference over 0.1 s; white noise of deviation σ has one of σ √20. Noise that
    is correlated over several samples is underestimated at stride 1: `fuse` also looks at longer strides.
    """
    third = np.asarray(values, float)
    for _ in range(3):
        third = third[stride:] - third[:-stride]
    if len(third) == 0:
        return SMALLEST_SIGMA
    return max(float(np.median(np.abs(third))) / _MEDIAN_OF_NORMAL / np.sqrt(20.0), SMALLEST_SIGMA)


def fuse(position: np.ndarray, speed: np.ndarray, dt: float) -> SmoothMotion:
    """Return the smooth motion of one unbroken record [T], with both noises estimated from the record itself.

    ``position`` is in m, ``speed`` in m/s, the time step ``dt`` in s. A position that drifts against the integral of
    the speed over 1 s (an antenna's, for instance) is as uncertain as that drift, however smooth it looks.
    """
    strides = range(1, max(1, round(LONGEST_STRIDE_S / dt)) + 1)
    sigma = max(noise_sigma(position, stride) for stride in strides)
    second = max(1, round(1.0 / dt))
    driven = np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) * (dt / 2)))
    drift = (position - driven)[second:] - (position - driven)[:-second]
    if len(drift):
        sigma = max(sigma, float(np.median(np.abs(drift))) / _MEDIAN_OF_NORMAL / np.sqrt(2.0))
    return smooth(position, speed, dt, sigma, noise_sigma(speed), robust=3)


def smooth(
    position: ArrayLike,
    speed: ArrayLike | None,
    dt: float,
    sigma_position: float,
    sigma_speed: float = 0.1,
    jerk_density: float = JERK_DENSITY,
    robust: int = 0,
) -> SmoothMotion:
    """Return the motion that fits positions and speeds within their noise with the least jerk.

    Args:
        position: Measured positions [T] in m, finite.
        speed: Measured speeds [T] in m/s, or None if only positions are known.
        dt: Time step in s.
        sigma_position: Standard deviation of the positions' noise in m; see `noise_sigma`.
        sigma_speed: Standard deviation of the speeds' noise in m/s.
        jerk_density: Spectral density q of the jerk, m²/s⁵; larger follows the data more closely.
        robust: Number of reweighted solutions (Huber, 2 σ) against single jumps; 0 is plain least squares.
    """
    measured = np.asarray(position, float)
    length = len(measured)
    if length < 4:
        # too short for a jerk: the straight differences
        rate = np.gradient(measured, dt) if length > 1 else np.zeros(length)
        return SmoothMotion(measured.copy(), rate, np.gradient(rate, dt) if length > 1 else np.zeros(length))
    origin = measured[0]  # keeps the numbers small; the penalty does not see it
    target = measured - origin
    rates = None if speed is None else np.asarray(speed, float)
    stiffness = 1.0 / (dt**5 * jerk_density)
    penalty = _bands(_jerk_rows(length), np.full(length - 3, stiffness), length)
    # The penalty alone does not see a parabola; below this weight the matrix would be singular to rounding.
    lowest = 1e-11 * stiffness
    position_weight = np.full(length, max(max(sigma_position, SMALLEST_SIGMA) ** -2.0, lowest))
    speed_weight = np.full(length, max(sigma_speed, SMALLEST_SIGMA) ** -2.0)
    estimate = _solve(target, rates, dt, position_weight, speed_weight, penalty)
    for _ in range(robust):
        scaled = np.abs(estimate - target) * np.sqrt(position_weight)
        weights = np.maximum(position_weight * np.minimum(1.0, 2.0 / np.maximum(scaled, 1e-9)), lowest)
        estimate = _solve(target, rates, dt, weights, speed_weight, penalty)
    return SmoothMotion(estimate + origin, _speed(estimate, dt), _accel(estimate, dt))


def _solve(
    target: np.ndarray,
    rates: np.ndarray | None,
    dt: float,
    position_weight: np.ndarray,
    speed_weight: np.ndarray,
    penalty: np.ndarray,
) -> np.ndarray:
    length = len(target)
    matrix = penalty.copy()
    matrix[0] += position_weight
    right = position_weight * target
    if rates is not None:
        columns, values = _speed_rows(length, dt)
        matrix += _bands((columns, values), speed_weight, length)
        np.add.at(right, columns.ravel(), (values * (speed_weight * rates)[:, None]).ravel())
    from scipy.linalg import solveh_banded  # a fifth of a second, which no refusal waits for

    return solveh_banded(matrix, right, lower=True, check_finite=False)


def _jerk_rows(length: int) -> tuple[np.ndarray, np.ndarray]:
    columns = np.arange(length - 3)[:, None] + np.arange(4)
    return columns, np.broadcast_to(np.array([-1.0, 3.0, -3.0, 1.0]), columns.shape)


def _speed_rows(length: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return columns [T, 3] and values [T, 3] of the matrix that takes positions to speeds (second order)."""
    first = np.clip(np.arange(length) - 1, 0, length - 3)
    values = np.tile(np.array([-0.5, 0.0, 0.5]) / dt, (length, 1))
    values[0] = np.array([-1.5, 2.0, -0.5]) / dt
    values[-1] = np.array([0.5, -2.0, 1.5]) / dt
    return first[:, None] + np.arange(3), values


def _bands(rows: tuple[np.ndarray, np.ndarray], weight: np.ndarray, length: int) -> np.ndarray:
    """Return Rᵀ diag(weight) R in lower banded form [4, T] for rows R given by their columns and values."""
    columns, values = rows
    bands = np.zeros((4, length))
    width = columns.shape[1]
    for low in range(width):
        for high in range(low, width):
            product = weight * values[:, low] * values[:, high]
            bands[high - low] += np.bincount(columns[:, low], product, minlength=length)
    return bands


def _speed(position: np.ndarray, dt: float) -> np.ndarray:
    columns, values = _speed_rows(len(position), dt)
    return np.einsum("tk,tk->t", values, position[columns])


def _accel(position: np.ndarray, dt: float) -> np.ndarray:
    inner = np.diff(position, 2) / dt**2
    return np.concatenate([inner[:1], inner, inner[-1:]])
