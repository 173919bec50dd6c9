"""Compiled loops behind ``recorded.py``: drivers side by side in a tile, time inside, one driver per row.

Arrays are ``(time, drivers)``; a tile of drivers stays in cache for the whole rollout. The leader is a record, so a
driver's step depends on nobody else's and the loops over drivers vectorise. All of them run over one flat workspace
``w`` of rows of ``ROW``, whose names below are the rows' first indices.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.kernels.equations import brake, exact, follow, integrate, inverses, linearise, swift, unpack

TILE = 512
"""Drivers per tile: parameters, state and tangents stay in cache, and time-major rows are read in long runs."""

ROW = TILE + 16
"""Distance of two rows in the workspace: not a power of two, or all rows would compete for the same cache sets."""

FIVE = 5
"""Parameters that have a tangent: a, b, T, s0, v0; the sixth, b_max, has a gradient only."""

GAP, SPEED, ACCEL, LEAD, LEAD_AFTER, LEAD_SPEED = (ROW * row for row in range(6))
P_A, P_B, P_TIME, P_MIN, P_V0, P_MAX = (ROW * row for row in range(6, 12))
BY_GAP, BY_SPEED, STAYS, PUSHES, DRIFTS, SHIFTS = (ROW * row for row in range(12, 18))
SOURCE = ROW * 18
GAP_BY, SPEED_BY = ROW * 23, ROW * 28
GAP_TARGET, GAP_WEIGHT, SPEED_TARGET, SPEED_WEIGHT, COST = (ROW * row for row in range(33, 38))
GRADIENT = ROW * 38
NORMAL = ROW * 43
ON_GAP, ON_SPEED, SEED_GAP, SEED_SPEED, SEED_ACCEL = (ROW * row for row in range(68, 73))
ON_P = ROW * 73
P_BRAKE, P_FREE = ROW * 79, ROW * 80
ROWS = 81


@exact
def _get(w, row, source, n):
    for i in range(n):
        w[row + i] = source[i]


@exact
def _put(target, w, row, n):
    for i in range(n):
        target[i] = w[row + i]


@exact
def _clear(w, row, count):
    for i in range(count * ROW):
        w[row + i] = 0


@exact
def _begin(w, params, gap0, speed0, left, n, c):
    for j in range(6):
        _get(w, P_A + j * ROW, params[j, left:], n)
    k = unpack(c)
    for i in range(n):
        w[P_BRAKE + i], w[P_FREE + i] = inverses(w[P_A + i], w[P_B + i], w[P_V0 + i], k)
    _get(w, GAP, gap0[left:], n)
    _get(w, SPEED, speed0[left:], n)


@exact
def _look(w, lead_position, lead_speed, t, left, n):
    _get(w, LEAD, lead_position[t, left:], n)
    _get(w, LEAD_AFTER, lead_position[t + 1, left:], n)
    _get(w, LEAD_SPEED, lead_speed[t, left:], n)


@exact
def _advance(w, n, is_euler, c):
    k = unpack(c)
    for i in range(n):
        gap, speed = w[GAP + i], w[SPEED + i]
        wanted = follow(
            gap, speed, w[LEAD_SPEED + i], k.one,
            w[P_A + i], w[P_BRAKE + i], w[P_TIME + i], w[P_MIN + i], w[P_FREE + i], k,
        )  # fmt: skip
        accel = brake(wanted, speed, w[P_MAX + i], is_euler, k)
        moved, after, felt = integrate(speed, accel, is_euler, k)
        w[GAP + i] = gap + ((w[LEAD_AFTER + i] - w[LEAD + i]) - moved)
        w[SPEED + i] = after
        w[ACCEL + i] = felt


@exact
def forward(gap0, speed0, lead_position, lead_speed, params, gap, speed, accel, begin, end, is_euler, c):
    """Fill ``gap``, ``speed`` and ``accel`` (time, drivers) for drivers ``begin`` to ``end``."""
    w = np.empty(ROWS * ROW, gap.dtype)
    for left in range(begin, end, TILE):
        n = min(TILE, end - left)
        _begin(w, params, gap0, speed0, left, n, c)
        for t in range(gap.shape[0]):
            _look(w, lead_position, lead_speed, t, left, n)
            _advance(w, n, is_euler, c)
            _put(gap[t, left:], w, GAP, n)
            _put(speed[t, left:], w, SPEED, n)
            _put(accel[t, left:], w, ACCEL, n)


@swift
def _linear_step(w, n, is_euler, c):
    """Fill the two-by-two matrix of a step, how an acceleration carries on, and the five sources of tangents."""
    k = unpack(c)
    for i in range(n):
        gap, speed, lead_speed = w[GAP + i], w[SPEED + i], w[LEAD_SPEED + i]
        a, b, time_gap, min_gap = w[P_A + i], w[P_B + i], w[P_TIME + i], w[P_MIN + i]
        slow, free, max_decel = w[P_BRAKE + i], w[P_FREE + i], w[P_MAX + i]
        raw = follow(gap, speed, lead_speed, k.one, a, slow, time_gap, min_gap, free, k)
        d = linearise(gap, speed, lead_speed, k.one, raw, a, b, slow, time_gap, min_gap, free, max_decel, is_euler, k)
        w[BY_GAP + i], w[BY_SPEED + i] = d.accel_gap, d.accel_speed + d.accel_floor_speed
        w[STAYS + i], w[PUSHES + i] = d.speed_speed, d.speed_accel
        w[DRIFTS + i], w[SHIFTS + i] = d.moved_speed, d.moved_accel
        w[SOURCE + i] = d.accel_max_accel
        w[SOURCE + ROW + i] = d.accel_comfort_decel
        w[SOURCE + 2 * ROW + i] = d.accel_time_gap
        w[SOURCE + 3 * ROW + i] = d.accel_min_gap
        w[SOURCE + 4 * ROW + i] = d.accel_desired_speed


@swift
def _tangents(w, n, is_euler, c):
    """Carry the five tangents of (gap, speed) over one step, in place."""
    _linear_step(w, n, is_euler, c)
    for i in range(n):
        by_gap, by_speed, stays, pushes = w[BY_GAP + i], w[BY_SPEED + i], w[STAYS + i], w[PUSHES + i]
        drifts, shifts = w[DRIFTS + i], w[SHIFTS + i]
        for j in range(FIVE):
            at = j * ROW + i
            gap, speed = w[GAP_BY + at], w[SPEED_BY + at]
            accel = by_gap * gap + by_speed * speed + w[SOURCE + at]
            w[GAP_BY + at] = gap - (drifts * speed + shifts * accel)
            w[SPEED_BY + at] = stays * speed + pushes * accel


@exact
def sensitivities(
    gap0, speed0, lead_position, lead_speed, params, gap, speed, accel, gap_by, speed_by, begin, end, is_euler, c
):
    """As ``forward``, and fill ``gap_by`` and ``speed_by`` (time, 5, drivers): derivatives by (a, b, T, s0, v0)."""
    w = np.empty(ROWS * ROW, gap.dtype)
    for left in range(begin, end, TILE):
        n = min(TILE, end - left)
        _begin(w, params, gap0, speed0, left, n, c)
        _clear(w, GAP_BY, 2 * FIVE)
        for t in range(gap.shape[0]):
            _look(w, lead_position, lead_speed, t, left, n)
            _tangents(w, n, is_euler, c)
            _advance(w, n, is_euler, c)
            _put(gap[t, left:], w, GAP, n)
            _put(speed[t, left:], w, SPEED, n)
            _put(accel[t, left:], w, ACCEL, n)
            for j in range(FIVE):
                _put(gap_by[t, j, left:], w, GAP_BY + j * ROW, n)
                _put(speed_by[t, j, left:], w, SPEED_BY + j * ROW, n)


@swift
def _project(w, n):
    """Add one step's part of the cost, of Jᵀr, and of JᵀJ (upper triangle)."""
    for i in range(n):
        u, v = w[GAP_WEIGHT + i], w[SPEED_WEIGHT + i]
        r, q = u * (w[GAP + i] - w[GAP_TARGET + i]), v * (w[SPEED + i] - w[SPEED_TARGET + i])
        w[COST + i] += r * r + q * q
        for j in range(FIVE):
            gap, speed = u * w[GAP_BY + j * ROW + i], v * w[SPEED_BY + j * ROW + i]
            w[GRADIENT + j * ROW + i] += gap * r + speed * q
            gap, speed = u * gap, v * speed
            for m in range(j, FIVE):
                at = (FIVE * j + m) * ROW + i
                w[NORMAL + at] += gap * w[GAP_BY + m * ROW + i] + speed * w[SPEED_BY + m * ROW + i]


@exact
def normal_equations(
    gap0, speed0, lead_position, lead_speed, params, gap_target, speed_target, gap_weight, speed_weight,
    cost, gradient, normal, begin, end, is_euler, c,
):  # fmt: skip
    """Fill ``cost`` (drivers), ``gradient`` (5, drivers) and ``normal`` (5, 5, drivers) without storing a Jacobian."""
    w = np.empty(ROWS * ROW, gap0.dtype)
    for left in range(begin, end, TILE):
        n = min(TILE, end - left)
        _begin(w, params, gap0, speed0, left, n, c)
        _clear(w, GAP_BY, 2 * FIVE)
        _clear(w, COST, 1 + FIVE + FIVE * FIVE)
        for t in range(gap_target.shape[0]):
            _look(w, lead_position, lead_speed, t, left, n)
            _tangents(w, n, is_euler, c)
            _advance(w, n, is_euler, c)
            _get(w, GAP_TARGET, gap_target[t, left:], n)
            _get(w, GAP_WEIGHT, gap_weight[t, left:], n)
            _get(w, SPEED_TARGET, speed_target[t, left:], n)
            _get(w, SPEED_WEIGHT, speed_weight[t, left:], n)
            _project(w, n)
        _put(cost[left:], w, COST, n)
        for j in range(FIVE):
            _put(gradient[j, left:], w, GRADIENT + j * ROW, n)
            for m in range(FIVE):
                _put(normal[j, m, left:], w, NORMAL + (FIVE * min(j, m) + max(j, m)) * ROW, n)


@swift
def _back(w, n, is_euler, c):
    """Carry the adjoint of one step back, in place, and add what falls on the six parameters."""
    k = unpack(c)
    for i in range(n):
        gap, speed, lead_speed = w[GAP + i], w[SPEED + i], w[LEAD_SPEED + i]
        a, b, time_gap, min_gap = w[P_A + i], w[P_B + i], w[P_TIME + i], w[P_MIN + i]
        slow, free, max_decel = w[P_BRAKE + i], w[P_FREE + i], w[P_MAX + i]
        raw = follow(gap, speed, lead_speed, k.one, a, slow, time_gap, min_gap, free, k)
        d = linearise(gap, speed, lead_speed, k.one, raw, a, b, slow, time_gap, min_gap, free, max_decel, is_euler, k)
        on_gap = w[ON_GAP + i] + w[SEED_GAP + i]
        on_speed = w[ON_SPEED + i] + w[SEED_SPEED + i]
        seed = w[SEED_ACCEL + i]
        on_accel = d.felt_accel * seed + d.speed_accel * on_speed - d.moved_accel * on_gap
        by_speed = d.accel_speed + d.accel_floor_speed
        w[ON_GAP + i] = on_gap + d.accel_gap * on_accel
        w[ON_SPEED + i] = d.felt_speed * seed + d.speed_speed * on_speed - d.moved_speed * on_gap + by_speed * on_accel
        w[ON_P + i] += d.accel_max_accel * on_accel
        w[ON_P + ROW + i] += d.accel_comfort_decel * on_accel
        w[ON_P + 2 * ROW + i] += d.accel_time_gap * on_accel
        w[ON_P + 3 * ROW + i] += d.accel_min_gap * on_accel
        w[ON_P + 4 * ROW + i] += d.accel_desired_speed * on_accel
        w[ON_P + 5 * ROW + i] += d.accel_max_decel * on_accel


@exact
def adjoint(
    gap0, speed0, lead_speed, params, gap, speed, seed_gap, seed_speed, seed_accel,
    on_gap, on_speed, on_params, begin, end, is_euler, c,
):  # fmt: skip
    """Fill the gradients of start and parameters from seeds on every step; ``gap`` and ``speed`` are ``forward``'s."""
    w = np.empty(ROWS * ROW, gap.dtype)
    for left in range(begin, end, TILE):
        n = min(TILE, end - left)
        _begin(w, params, gap0, speed0, left, n, c)
        _clear(w, ON_GAP, 2)
        _clear(w, ON_P, 6)
        for t in range(gap.shape[0] - 1, -1, -1):
            _get(w, GAP, gap[t - 1, left:] if t > 0 else gap0[left:], n)
            _get(w, SPEED, speed[t - 1, left:] if t > 0 else speed0[left:], n)
            _get(w, LEAD_SPEED, lead_speed[t, left:], n)
            _get(w, SEED_GAP, seed_gap[t, left:], n)
            _get(w, SEED_SPEED, seed_speed[t, left:], n)
            _get(w, SEED_ACCEL, seed_accel[t, left:], n)
            _back(w, n, is_euler, c)
        _put(on_gap[left:], w, ON_GAP, n)
        _put(on_speed[left:], w, ON_SPEED, n)
        for j in range(6):
            _put(on_params[j, left:], w, ON_P + j * ROW, n)
