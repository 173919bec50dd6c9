"""Compiled loops of the smoother: Kalman filter, Rauch–Tung–Striebel pass and reweighting of one trajectory.

The state of a step is (position, speed, acceleration, noise): the motion of a ballistic step under a constant
acceleration, which the next step changes by a jerk, and the correlated part of the measurement noise.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.extras import needed

with needed("filtering or reconstruction"):  # these have no other path
    from idm_env.compiled.kernels.compiler import compiler

compiled = compiler(fastmath={"contract"})

N = 4
LOG_TWO_PI = float(np.log(2.0 * np.pi))


@compiled
def _predict(state, cov, dt, keep, fade, push, drift, out_state, out_cov, rows):
    """Advance mean and covariance by one step; ``push`` and ``drift`` are variances of jerk and noise.

    ``rows`` here, like ``along`` and ``low`` below, is scratch space: to allocate it would cost more than to fill it.
    """
    half = 0.5 * dt * dt
    out_state[0] = state[0] + dt * state[1] + half * state[2]
    out_state[1] = state[1] + dt * state[2]
    out_state[2] = keep * state[2]
    out_state[3] = fade * state[3]
    for j in range(N):
        rows[0, j] = cov[0, j] + dt * cov[1, j] + half * cov[2, j]
        rows[1, j] = cov[1, j] + dt * cov[2, j]
        rows[2, j] = keep * cov[2, j]
        rows[3, j] = fade * cov[3, j]
    for i in range(N):
        out_cov[i, 0] = rows[i, 0] + dt * rows[i, 1] + half * rows[i, 2]
        out_cov[i, 1] = rows[i, 1] + dt * rows[i, 2]
        out_cov[i, 2] = keep * rows[i, 2]
        out_cov[i, 3] = fade * rows[i, 3]
    out_cov[2, 2] += push
    out_cov[3, 3] += drift
    for i in range(N):
        for j in range(i):
            out_cov[i, j] = out_cov[j, i]


@compiled
def _update(state, cov, look, value, variance, along):
    """Take in one observation ``value = look · state + noise``, in place; return its log-likelihood."""
    total, error = variance, value
    for i in range(N):
        along[i] = 0.0
        for j in range(N):
            along[i] += cov[i, j] * look[j]
    for i in range(N):
        total += look[i] * along[i]
        error -= look[i] * state[i]
    for i in range(N):
        state[i] += along[i] * error / total
        for j in range(N):
            cov[i, j] -= along[i] * along[j] / total
    return -0.5 * (np.log(total) + error * error / total + LOG_TWO_PI)


@compiled
def likelihood(steps, ticks, look, value, variance, start, spread, dt, keep, fade, push, drift):
    """Return the log-likelihood of observations (sorted by ``ticks``) under the linear Gaussian model."""
    state, cov = start.copy(), spread.copy()
    next_state, next_cov = np.empty(N), np.empty((N, N))
    rows, along = np.empty((N, N)), np.empty(N)
    total, o = 0.0, 0
    for k in range(steps):
        if k > 0:
            _predict(state, cov, dt, keep, fade, push, drift, next_state, next_cov, rows)
            state, next_state = next_state, state
            cov, next_cov = next_cov, cov
        while o < len(ticks) and ticks[o] == k:
            total += _update(state, cov, look[o], value[o], variance[o], along)
            o += 1
    return total


@compiled
def _gain(cov, cross, out, low):
    """Solve ``cov X = cross`` by Cholesky; both are N × N."""
    for i in range(N):
        for j in range(i + 1):
            v = cov[i, j]
            for k in range(j):
                v -= low[i, k] * low[j, k]
            low[i, j] = np.sqrt(max(v, 1e-18)) if i == j else v / low[j, j]
    for c in range(N):
        for i in range(N):
            v = cross[i, c]
            for k in range(i):
                v -= low[i, k] * out[k, c]
            out[i, c] = v / low[i, i]
        for i in range(N - 1, -1, -1):
            v = out[i, c]
            for k in range(i + 1, N):
                v -= low[k, i] * out[k, c]
            out[i, c] = v / low[i, i]


@compiled
def smooth(ticks, look, value, variance, start, spread, dt, keep, fade, push, drift, mean, cov, jerk_square):
    """Fill the smoothed ``mean`` [K, 4], ``cov`` [K, 4, 4] and E[w²] of the jerk's push after every step [K].

    ``push`` [K] is the prior variance of every step's change of acceleration. Returns the log-likelihood.
    """
    steps = len(mean)
    ahead_mean, ahead_cov = np.empty((steps, N)), np.empty((steps, N, N))
    cross, gain, change, part = np.empty((N, N)), np.empty((N, N)), np.empty((N, N)), np.empty((N, N))
    along = np.empty(N)
    total, o = 0.0, 0
    for k in range(steps):
        if k == 0:
            ahead_mean[0], ahead_cov[0] = start, spread
        else:
            _predict(mean[k - 1], cov[k - 1], dt, keep, fade, push[k - 1], drift, ahead_mean[k], ahead_cov[k], part)
        mean[k], cov[k] = ahead_mean[k], ahead_cov[k]
        while o < len(ticks) and ticks[o] == k:
            total += _update(mean[k], cov[k], look[o], value[o], variance[o], along)
            o += 1
    half = 0.5 * dt * dt
    jerk_square[steps - 1] = push[steps - 1]
    for k in range(steps - 2, -1, -1):
        for j in range(N):
            cross[0, j] = cov[k, 0, j] + dt * cov[k, 1, j] + half * cov[k, 2, j]
            cross[1, j] = cov[k, 1, j] + dt * cov[k, 2, j]
            cross[2, j] = keep * cov[k, 2, j]
            cross[3, j] = fade * cov[k, 3, j]
        _gain(ahead_cov[k + 1], cross, gain, part)
        both = 0.0  # posterior covariance of acceleration k + 1 with acceleration k
        for m in range(N):
            both += cov[k + 1, 2, m] * gain[m, 2]
        for i in range(N):
            for j in range(N):
                change[i, j] = cov[k + 1, i, j] - ahead_cov[k + 1, i, j]
        for i in range(N):
            v = 0.0
            for m in range(N):
                v += gain[m, i] * (mean[k + 1, m] - ahead_mean[k + 1, m])
            mean[k, i] += v
            for j in range(N):
                v = 0.0
                for m in range(N):
                    v += change[i, m] * gain[m, j]
                part[i, j] = v
        for i in range(N):
            for j in range(i + 1):
                v = 0.0
                for m in range(N):
                    v += gain[m, i] * part[m, j]
                cov[k, i, j] += v
                cov[k, j, i] = cov[k, i, j]
        w = mean[k + 1, 2] - keep * mean[k, 2]
        jerk_square[k] = w * w + cov[k + 1, 2, 2] - 2.0 * keep * both + keep * keep * cov[k, 2, 2]
    return total


@compiled
def adapt(jerk_square, push, half_window, degrees, scale):
    """Fill ``push`` with the variances of a Student-t jerk: ``(ν s + Σ E[w²]) / (ν + n)`` over a window around each.

    ``degrees`` ν is the weight of the prior variance ``scale``, in samples; a variance never falls below 1 % of it.
    """
    steps = len(push)
    total, begin, end = 0.0, 0, 0
    for k in range(steps):
        last, first = min(k + half_window + 1, steps - 1), max(k - half_window, 0)
        while end < last:
            total += jerk_square[end]
            end += 1
        while begin < first:
            total -= jerk_square[begin]
            begin += 1
        push[k] = max((degrees * scale + total) / (degrees + end - begin), 0.01 * scale)


@compiled
def reweigh(ticks, look, value, mean, cov, white, degrees, robust, variance):
    """Fill ``variance`` of the observations marked ``robust`` with those of Student-t noise of ``degrees``."""
    for o in range(len(ticks)):
        if not robust[o]:
            continue
        k = ticks[o]
        error, spread = value[o], 0.0
        for i in range(N):
            error -= look[o, i] * mean[k, i]
            for j in range(N):
                spread += look[o, i] * look[o, j] * cov[k, i, j]
        variance[o] = (degrees * white + error * error + spread) / (degrees + 1.0)
