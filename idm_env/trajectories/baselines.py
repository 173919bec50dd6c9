"""The smoothers that ours is compared with: four of the paper and one that it left out.

Each is a function ``(time_s, position_m, clock) -> Motion`` of measured times and positions [N] (times rising, not
necessarily regular) and the clock [K] on which the result is wanted; free numbers have the paper's defaults where it
states them.
"""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import nnls
from scipy.signal import lfilter, savgol_filter

from idm_env.trajectories.scores import RegularMotion, from_positions

LONGEST_BLOCK_S = 120.0
"""Longer tracks are fitted by bounded splines block by block (s): the cost grows with the cube of the knots."""
OVERLAP_S = 10.0
"""Blocks of a spline overlap by this and are blended (s)."""
TINY = 1e-9


def linear(time_s: np.ndarray, position_m: np.ndarray, clock: np.ndarray) -> RegularMotion:
    """Return straight lines between samples."""
    return from_positions(clock, np.interp(clock, time_s, position_m))


def moving_average(time_s: np.ndarray, position_m: np.ndarray, clock: np.ndarray, window: int = 9) -> RegularMotion:
    """Return means over ``window`` samples (odd)."""
    x, pad = _extended(np.interp(clock, time_s, position_m), window // 2, window // 2)
    total = np.concatenate([[0.0], np.cumsum(x - x[0])])
    width = 2 * pad + 1
    return from_positions(clock, x[0] + (total[width:] - total[:-width]) / width)


def exponential(time_s: np.ndarray, position_m: np.ndarray, clock: np.ndarray, width: float = 5.0) -> RegularMotion:
    """Return exponential moving averages of factor exp(−1/width), forward and backward so that nothing lags.

    The symmetric exponential smoothing of Thiemann, Treiber and Kesting (2008), by two recursions.
    """
    x, pad = _extended(np.interp(clock, time_s, position_m), round(10 * width), round(2 * width))
    decay = np.exp(-1.0 / width)

    def one_way(values: np.ndarray) -> np.ndarray:
        smoothed, _ = lfilter([1.0 - decay], [1.0, -decay], values, zi=[decay * values[0]])
        return np.asarray(smoothed)

    smooth = one_way(one_way(x - x[0])[::-1])[::-1] + x[0]
    return from_positions(clock, smooth[pad : len(x) - pad])


def _extended(x: np.ndarray, pad: int, near: int) -> tuple[np.ndarray, int]:
    """Return ``x`` continued by ``pad`` samples at both ends, and how many: reflected in the point of a fitted line.

    Without it an average would be pulled back, or be as noisy as the data, where its window leaves the track. The
    point is the end of a line through the ``near + 1`` samples beside it, since the last sample alone is noisy.
    """
    near = min(near, len(x) - 1)
    if near > 1:
        ticks = np.arange(near + 1)
        first = np.polyval(np.polyfit(ticks, x[: near + 1], 1), 0)
        last = np.polyval(np.polyfit(ticks, x[-near - 1 :], 1), near)
        x = np.concatenate([[first], x[1:-1], [last]])
    return np.pad(x, pad, "reflect", reflect_type="odd"), pad


def savitzky_golay(
    time_s: np.ndarray, position_m: np.ndarray, clock: np.ndarray, window: int = 61, order: int = 3
) -> RegularMotion:
    """Return local polynomials of ``order`` over ``window`` samples, and their own derivatives (scipy)."""
    x = np.interp(clock, time_s, position_m)
    dt = (clock[-1] - clock[0]) / (len(clock) - 1)
    width = min(window, len(x) - 1 + len(x) % 2)
    if width <= order:
        return from_positions(clock, x)
    return RegularMotion(clock, *(savgol_filter(x, width, order, deriv=d, delta=dt) for d in range(3)))


def bounded_spline(
    time_s: np.ndarray, position_m: np.ndarray, clock: np.ndarray, spacing: float = 1.5, bound: float = 10.0
) -> RegularMotion:
    """Return the cubic B-spline of least squares with speed ≥ 0 and |acceleration| ≤ ``bound`` (m/s²) everywhere.

    Knots are ``spacing`` seconds apart. A B-spline lies within the hull of its control points, so bounds on those of
    its first two derivatives, which are linear in the coefficients, suffice; the constrained least squares is solved
    exactly as a least-distance problem by non-negative least squares (Lawson and Hanson 1974, chapter 23).
    """
    if clock[-1] - clock[0] <= LONGEST_BLOCK_S + OVERLAP_S:
        return _bounded_block(time_s, position_m, clock, spacing, bound)
    sums = [np.zeros(len(clock)) for _ in range(4)]
    for begin in np.arange(clock[0], clock[-1] - OVERLAP_S, LONGEST_BLOCK_S):
        end = begin + LONGEST_BLOCK_S + OVERLAP_S
        data = (time_s >= begin - TINY) & (time_s <= end + TINY)
        ticks = (clock >= begin - TINY) & (clock <= end + TINY)
        if data.sum() < 2 or ticks.sum() < 2:
            continue
        part = _bounded_block(time_s[data], position_m[data], clock[ticks], spacing, bound)
        weight = np.clip(np.minimum(clock[ticks] - begin, end - clock[ticks]) / OVERLAP_S, 1e-3, 1.0)
        for total, values in zip(sums, (1.0, part.position_m, part.speed_mps, part.accel_mps2), strict=True):
            total[ticks] += weight * values
    return RegularMotion(clock, *(total / sums[0] for total in sums[1:]))


def _bounded_block(
    time_s: np.ndarray, position_m: np.ndarray, clock: np.ndarray, spacing: float, bound: float
) -> RegularMotion:
    begin, end = min(time_s[0], clock[0]), max(time_s[-1], clock[-1])
    pieces = max(1, round((end - begin) / spacing))
    knots = np.concatenate([[begin] * 3, np.linspace(begin, end, pieces + 1), [end] * 3])
    count = len(knots) - 4
    identity = BSpline(knots, np.eye(count), 3)
    # With fewer samples than coefficients a little of the bending decides between equally good splines.
    middle = np.linspace(begin, end, 2 * pieces, endpoint=False) + 0.25 * (end - begin) / pieces
    bending = 1e-4 * spacing**3 * identity(middle, 3), 1e-5 * spacing**2 * identity(middle, 2)
    matrix = np.vstack([identity(np.clip(time_s, begin, end)), *bending])
    target = np.concatenate([position_m - position_m[0], np.zeros(4 * pieces)])
    # coefficients of the derivative splines: the last of a cubic's (and the last two of its derivative's) are padding
    speed, accel = identity.derivative(1).c[: count - 1], identity.derivative(2).c[: count - 2]
    inequality = np.vstack([speed, accel, -accel])
    # a hair inside, so that rounding never breaks the bound
    limit = np.concatenate([np.zeros(len(speed)), np.full(2 * len(accel), -bound * (1 - 1e-6))])
    spline = BSpline(knots, _least_squares(matrix, target, inequality, limit), 3)
    return RegularMotion(clock, spline(clock) + position_m[0], spline(clock, 1), spline(clock, 2))


def _least_squares(matrix: np.ndarray, target: np.ndarray, inequality: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Minimise |A x − b|² subject to G x ≥ h, by the least-distance dual (Lawson and Hanson 1974)."""
    q, r = np.linalg.qr(matrix)
    free = np.linalg.solve(r, q.T @ target)
    if (inequality @ free >= limit - TINY).all():
        return free
    along = np.linalg.solve(r.T, inequality.T).T
    dual = np.vstack([along.T, limit - inequality @ free])
    unit = np.zeros(len(dual))
    unit[-1] = 1.0
    weights, _ = nnls(dual, unit, maxiter=30 * dual.shape[1])
    residual = dual @ weights - unit
    if abs(residual[-1]) < TINY:
        raise ValueError("no spline keeps these bounds. Give more knots or wider bounds.")
    return free + np.linalg.solve(r, -residual[:-1] / residual[-1])


BASELINES: dict[str, Callable[..., RegularMotion]] = {
    "linear": linear,
    "moving average": moving_average,
    "exponential": exponential,
    "bounded spline": bounded_spline,
    "Savitzky–Golay": savitzky_golay,
}
"""By name."""
