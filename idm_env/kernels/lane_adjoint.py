"""Compiled vector-Jacobian product of ``lane_loops.forward``: a tile recomputes a block of steps, then walks it back.

The states within a block live only in the workspace of a tile, so that the tape is one state per block of steps.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.kernels.equations import exact, linearise, swift, unpack
from idm_env.kernels.lane_loops import (
    COMES_AND_GOES,
    CONTROL,
    EULER,
    NOISE,
    REPLAY,
    RING,
    STATE,
    fetch_next,
    load_inputs,
    load_static,
    look_ahead,
    step,
    want,
)  # fmt: skip
from idm_env.kernels.tiles import (
    ACTIVE,
    BEHIND,
    G_A,
    G_COMMAND,
    G_NORMALS,
    G_PACE,
    G_PLACE,
    G_PULL,
    GAP,
    LEAD_SPEED,
    LED,
    NORMALS,
    ON_ACCEL,
    ON_GAP,
    ON_MOVED,
    ON_POSITION,
    ON_SPEED,
    P_A,
    P_B,
    P_BRAKE,
    P_FREE,
    P_MAX,
    P_MIN,
    P_SIGMA,
    P_TIME,
    PLACED,
    POSITION,
    RAW,
    ROW,
    ROWS,
    SENT,
    SPEED,
    add,
    clear,
    load,
    padded,
    place,
    store,
)  # fmt: skip

SEEDS = 4


@exact
def _from_behind(w, source, n, size, has):
    """Fill ``BEHIND`` with each follower's value, 0 for whoever has none."""
    m = padded(n)
    for j in range(m):
        w[BEHIND + j] = w[source + j + 1]
    w[BEHIND + n - 1] = 0
    if has & RING and n >= size:
        for j in range(0, n, size):
            w[BEHIND + j + size - 1] = w[source + j]


@swift
def _displacement(w, n, size, has, c):
    """Split the adjoints of gaps and positions into those of displacements, and of records where they place."""
    m = padded(n)
    k = unpack(c)
    for j in range(m):
        led, gap = w[LED + j] > k.zero, w[ON_GAP + j]
        w[SENT + j] = gap if led else k.zero
    if has & COMES_AND_GOES:
        for j in range(m):
            w[ON_GAP + j] = w[SENT + j]
    _from_behind(w, SENT, n, size, has)
    for j in range(m):
        w[ON_MOVED + j] = w[BEHIND + j] - w[SENT + j]
    if has & REPLAY:
        for j in range(m):
            placed = w[PLACED + j] > k.zero
            moved, position, speed, accel = w[ON_MOVED + j], w[ON_POSITION + j], w[ON_SPEED + j], w[ON_ACCEL + j]
            w[G_PLACE + j] = moved + position if placed else k.zero
            w[G_PACE + j] = speed if placed else k.zero
            w[G_PULL + j] = accel if placed else k.zero
            w[ON_POSITION + j] = -moved if placed else position
            w[ON_MOVED + j] = k.zero if placed else moved + position
            w[ON_SPEED + j] = k.zero if placed else speed
            w[ON_ACCEL + j] = k.zero if placed else accel
    else:
        for j in range(m):
            w[ON_MOVED + j] = w[ON_MOVED + j] + w[ON_POSITION + j]


@swift
def _response(w, n, has, c):
    """Carry adjoints through integration, brakes and IDM; what falls on the leader's speed goes to ``SENT``."""
    m = padded(n)
    k = unpack(c)
    is_euler = has & EULER != 0
    for j in range(m):
        a, b, time_gap, min_gap = w[P_A + j], w[P_B + j], w[P_TIME + j], w[P_MIN + j]
        d = linearise(
            w[GAP + j], w[SPEED + j], w[LEAD_SPEED + j], w[LED + j], w[RAW + j],
            a, b, w[P_BRAKE + j], time_gap, min_gap, w[P_FREE + j], w[P_MAX + j], is_euler, k,
        )  # fmt: skip
        speed, accel, moved = w[ON_SPEED + j], w[ON_ACCEL + j], w[ON_MOVED + j]
        braked = d.felt_accel * accel + d.speed_accel * speed + d.moved_accel * moved
        own = braked * (k.one - w[ACTIVE + j])
        w[G_COMMAND + j] = d.accel_raw * (braked - own)
        w[G_NORMALS + j] = d.accel_raw * own
        w[SENT + j] = d.accel_lead_speed * own
        w[ON_GAP + j] += d.accel_gap * own
        w[ON_SPEED + j] = (
            d.felt_speed * accel + d.speed_speed * speed + d.moved_speed * moved
            + d.accel_floor_speed * braked + d.accel_speed * own
        )  # fmt: skip
        w[G_A + j] += d.accel_max_accel * own
        w[G_A + ROW + j] += d.accel_comfort_decel * own
        w[G_A + 2 * ROW + j] += d.accel_time_gap * own
        w[G_A + 3 * ROW + j] += d.accel_min_gap * own
        w[G_A + 4 * ROW + j] += d.accel_desired_speed * own
        w[G_A + 5 * ROW + j] += d.accel_max_decel * braked


@swift
def step_back(w, n, size, has, c):
    """Carry the adjoint of a tile back by one step, in place; ``ON_ACCEL`` is consumed."""
    m = padded(n)
    look_ahead(w, n, size, has)
    want(w, n, has, c)
    _displacement(w, n, size, has, c)
    _response(w, n, has, c)
    if has & NOISE:
        for j in range(m):
            w[G_A + 6 * ROW + j] += w[G_NORMALS + j] * w[NORMALS + j]
            w[G_NORMALS + j] = w[G_NORMALS + j] * w[P_SIGMA + j]
    _from_behind(w, SENT, n, size, has)
    for j in range(m):
        w[ON_SPEED + j] += w[BEHIND + j]
    clear(w, ON_ACCEL, n)


@exact
def _recompute(w, tape, operands, flags, strides, begin_step, steps, row, first, n, size, has, c):
    for t in range(steps):
        for j in range(n):
            tape[2 * t * ROW + j] = w[GAP + j]
            tape[(2 * t + 1) * ROW + j] = w[SPEED + j]
        if t + 1 < steps:
            if has & (NOISE | CONTROL | REPLAY):
                load_inputs(w, operands, flags, strides, begin_step + t, row, first, n, size, has)
            step(w, n, size, has, c)


@exact
def _seed(w, to, source, dense, row, first, n, size):
    """Load an adjoint; an array of one element stands for zeros."""
    if source.size == 1:
        clear(w, to, n)
        w[to] = source[0]
    else:
        load(w, to, source, 0, dense, row, first, n, size)


@exact
def _result(target, base, w, row, n, count):
    """Store an adjoint, unless the array is a stand-in for one that nobody asked for."""
    if target.size == count:
        store(target, base, w, row, n)


@exact
def backward(
    gap, speed, position, seeds, on_gap, on_speed, on_position, on_accel, gap_begin, speed_begin, position_begin,
    on_parameters, fresh, on_inputs, operands, flags, strides, begin_step, steps, rows, size, wide, has, c, begin, end,
):  # fmt: skip
    """Carry adjoints at the end of a block to its begin; store (``fresh``) or add what falls on the parameters.

    ``seeds`` (4, time, vehicles; or no time) are the adjoints of position, speed, acceleration and gap of every step;
    ``on_inputs`` (5, time, vehicles; or no time) receives those of command, normals and the three columns of a record.
    """
    w = np.zeros(ROWS * ROW, gap.dtype)
    tape = np.empty(2 * steps * ROW, gap.dtype)
    dense, is_ring, count = strides[STATE], has & RING != 0, rows * size
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, steps, wide, is_ring)
        at = row * size + first + skip
        if tile + 1 < end:
            following = place(tile + 1, rows, size, steps, wide, is_ring)
            fetch_next(gap, speed, position, operands, strides, following, size)
            fetch_next(on_gap, on_speed, on_position, operands, strides[:0], following, size)
        load(w, GAP, gap, 0, dense, row, first, n, size)
        load(w, SPEED, speed, 0, dense, row, first, n, size)
        if has & REPLAY:
            load(w, POSITION, position, 0, dense, row, first, n, size)
        load_static(w, operands, strides, row, first, n, size, n <= filled, c)
        filled = max(filled, n)
        _recompute(w, tape, operands, flags, strides, begin_step, steps, row, first, n, size, has, c)
        _seed(w, ON_GAP, on_gap, dense, row, first, n, size)
        _seed(w, ON_SPEED, on_speed, dense, row, first, n, size)
        _seed(w, ON_POSITION, on_position, dense, row, first, n, size)
        _seed(w, ON_ACCEL, on_accel, dense, row, first, n, size)
        for j in range(7):
            clear(w, G_A + j * ROW, n)
        for t in range(steps - 1, -1, -1):
            now = begin_step + t
            if seeds.shape[1]:
                for j in range(SEEDS):
                    load(w, SENT, seeds[j, now], 0, dense, row, first, n, size)
                    target = (ON_POSITION, ON_SPEED, ON_ACCEL, ON_GAP)[j]
                    for i in range(n):
                        w[target + i] += w[SENT + i]
            for j in range(n):
                w[GAP + j] = tape[2 * t * ROW + j]
                w[SPEED + j] = tape[(2 * t + 1) * ROW + j]
            if has & (NOISE | CONTROL | REPLAY):
                load_inputs(w, operands, flags, strides, now, row, first, n, size, has)
            step_back(w, n, size, has, c)
            if on_inputs.shape[1]:
                for j in range(5):
                    store(on_inputs[j, now], at, w, G_COMMAND + j * ROW + skip, own)
        _result(gap_begin, at, w, ON_GAP + skip, own, count)
        _result(speed_begin, at, w, ON_SPEED + skip, own, count)
        _result(position_begin, at, w, ON_POSITION + skip, own, count)
        for j in range(on_parameters.shape[0]):
            if fresh:
                store(on_parameters[j], at, w, G_A + j * ROW + skip, own)
            else:
                add(on_parameters[j], at, w, G_A + j * ROW + skip, own)
