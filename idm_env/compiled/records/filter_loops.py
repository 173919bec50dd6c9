"""A Kalman filter over affine steps, its likelihood and its smoothed mean, compiled: algebra only, no driver in it.

A driver's state is [gap, speed, levels (k)]. Gap and speed follow the affine step, levels are Ornstein–Uhlenbeck. Gap
and speed are measured, one after the other, with white noise.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.extras import needed

with needed("estimating drift"):
    from idm_env.compiled.kernels.compiler import compiler

compiled = compiler(fastmath={"contract"})
LOG_2PI = float(np.log(2.0 * np.pi))


@compiled
def predict(m, p, t, r, to, by_state, by_level, gap, speed, level, decay, kick, jitter, a, w):
    """Advance mean m [d] and covariance p [d, d] of row r from sample t on, in place; ``a`` keeps the transition."""
    k = decay.shape[0]
    d = 2 + k
    for i in range(2):
        x = to[t, r, i] + by_state[t, r, i, 0] * (m[0] - gap[t, r]) + by_state[t, r, i, 1] * (m[1] - speed[t, r])
        a[i, 0], a[i, 1] = by_state[t, r, i, 0], by_state[t, r, i, 1]
        for j in range(k):
            x += by_level[t, r, i, j] * (decay[j] * m[2 + j] - level[t + 1, r, j])
            a[i, 2 + j] = by_level[t, r, i, j] * decay[j]
        w[i, d] = x
    m[0], m[1] = w[0, d], w[1, d]
    for j in range(k):
        m[2 + j] *= decay[j]
    for j in range(d):
        x, y = 0.0, 0.0
        for i in range(d):
            x += a[0, i] * p[i, j]
            y += a[1, i] * p[i, j]
        w[0, j], w[1, j] = x, y
    corner = np.zeros((2, 2))
    for i in range(2):
        for h in range(2):
            x = 0.0
            for j in range(d):
                x += w[i, j] * a[h, j]
            corner[i, h] = x
    for i in range(d):
        p[0, i], p[1, i] = w[0, i], w[1, i]
    for j in range(k):
        for i in range(d):
            p[2 + j, i] *= decay[j]
            p[i, 2 + j] *= decay[j]
    for h in range(2):
        for i in range(2):
            p[h, i] = corner[h, i]
        for i in range(2, d):
            p[i, h] = p[h, i]
    for j in range(k):
        q = kick[j]
        g, v = by_level[t, r, 0, j], by_level[t, r, 1, j]
        p[0, 0] += g * g * q
        p[0, 1] += g * v * q
        p[1, 0] += g * v * q
        p[1, 1] += v * v * q
        p[0, 2 + j] += g * q
        p[2 + j, 0] += g * q
        p[1, 2 + j] += v * q
        p[2 + j, 1] += v * q
        p[2 + j, 2 + j] += q
    p[1, 1] += jitter


@compiled
def update(m, p, i, y, r2, gain):
    """Take in a measurement y of entry i with variance r2, in place; return its innovation and variance."""
    d = m.shape[0]
    s = p[i, i] + r2
    e = y - m[i]
    for j in range(d):
        gain[j] = p[j, i] / s
    for j in range(d):
        m[j] += gain[j] * e
    for j in range(d):
        for h in range(d):
            p[j, h] -= gain[j] * gain[h] * s
    return e, s


@compiled
def likelihood(
    length, measured_gap, measured_speed, to, by_state, by_level, gap, speed, level, decay, sigma, noise, jitter, skip
):
    """Return the log-likelihood of every row; innovations of the first ``skip`` samples do not count."""
    rows, k = gap.shape[1], decay.shape[0]
    d = 2 + k
    log_likelihood = np.zeros(rows)
    kick = sigma * sigma * (1.0 - decay * decay)
    a, w, gain = np.zeros((2, d)), np.zeros((2, d + 1)), np.zeros(d)
    r2 = noise * noise
    for r in range(rows):
        m, p = np.zeros(d), np.zeros((d, d))
        begin(m, p, measured_gap[0, r], measured_speed[0, r], sigma, noise)
        total = 0.0
        for t in range(length[r] - 1):
            predict(m, p, t, r, to, by_state, by_level, gap, speed, level, decay, kick, jitter, a, w)
            e, s = update(m, p, 0, measured_gap[t + 1, r], r2[0], gain)
            f, u = update(m, p, 1, measured_speed[t + 1, r], r2[1], gain)
            if t >= skip:
                total -= 0.5 * (2.0 * LOG_2PI + np.log(s * u) + e * e / s + f * f / u)
        log_likelihood[r] = total
    return log_likelihood


@compiled
def begin(m, p, gap, speed, sigma, noise):
    """Set mean and covariance before the first step: gap and speed as measured, levels as in the long run."""
    m[:] = 0.0
    p[:] = 0.0
    m[0], m[1] = gap, speed
    p[0, 0], p[1, 1] = noise[0] ** 2, noise[1] ** 2
    for j in range(sigma.shape[0]):
        p[2 + j, 2 + j] = sigma[j] ** 2


@compiled
def smooth(
    length, measured_gap, measured_speed, to, by_state, by_level, gap, speed, level, decay, sigma, noise, jitter
):
    """Return filtered means and covariances [T, rows, d(, d)] and smoothed means [T, rows, d].

    The modified Bryson–Frazier recursion: adjoints of the innovations, backwards, need no inverse.
    """
    samples, rows = gap.shape
    k = decay.shape[0]
    d = 2 + k
    mean = np.zeros((samples, rows, d))
    filtered, covariance = np.zeros((samples, rows, d)), np.zeros((samples, rows, d, d))
    kick = sigma * sigma * (1.0 - decay * decay)
    r2 = noise * noise
    w, scratch = np.zeros((2, d + 1)), np.zeros(d)
    for r in range(rows):
        steps = length[r]
        m, p = np.zeros(d), np.zeros((d, d))
        moves, gains, seen = np.zeros((steps, 2, d)), np.zeros((steps, 2, d)), np.zeros((steps, 2, 2))
        begin(m, p, measured_gap[0, r], measured_speed[0, r], sigma, noise)
        filtered[0, r], covariance[0, r] = m, p
        for t in range(steps - 1):
            predict(m, p, t, r, to, by_state, by_level, gap, speed, level, decay, kick, jitter, moves[t + 1], w)
            seen[t + 1, 0, 0], seen[t + 1, 0, 1] = update(m, p, 0, measured_gap[t + 1, r], r2[0], gains[t + 1, 0])
            seen[t + 1, 1, 0], seen[t + 1, 1, 1] = update(m, p, 1, measured_speed[t + 1, r], r2[1], gains[t + 1, 1])
            filtered[t + 1, r], covariance[t + 1, r] = m, p
        back = np.zeros(d)
        for t in range(steps - 1, -1, -1):
            for i in range(d):
                x = filtered[t, r, i]
                for j in range(d):
                    x -= covariance[t, r, i, j] * back[j]
                mean[t, r, i] = x
            if t == 0:
                break
            for i in (1, 0):
                x = 0.0
                for j in range(d):
                    x += gains[t, i, j] * back[j]
                back[i] -= x + seen[t, i, 0] / seen[t, i, 1]
            for j in range(d):
                scratch[j] = moves[t, 0, j] * back[0] + moves[t, 1, j] * back[1]
            for j in range(k):
                scratch[2 + j] += decay[j] * back[2 + j]
            back[:] = scratch
        for t in range(steps, samples):
            mean[t, r], filtered[t, r], covariance[t, r] = mean[steps - 1, r], m, p
    return filtered, covariance, mean
