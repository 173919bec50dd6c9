"""Compiled rollout of lanes and rings: a tile of vehicles runs a block of steps before it leaves the cache."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.kernels.equations import brake, exact, follow, integrate, inverses, unpack
from idm_env.kernels.prefetch import prefetch
from idm_env.kernels.tiles import (
    ACCEL,
    ACTIVE,
    COMMAND,
    GAP,
    LEAD_MOVED,
    LEAD_SPEED,
    LED,
    MOVED,
    NORMALS,
    P_A,
    P_B,
    P_BRAKE,
    P_FREE,
    P_MAX,
    P_MIN,
    P_SIGMA,
    P_TIME,
    P_V0,
    PACE,
    PLACE,
    PLACED,
    POSITION,
    PULL,
    RAW,
    ROW,
    ROWS,
    SPEED,
    load,
    padded,
    place,
    repeats,
    store,
)  # fmt: skip

# Operands, in the order in which they are passed: numbers, then flags (uint8).
O_LED, O_PARAMETERS, O_SIGMA, O_NORMALS, O_COMMAND, O_PLACE = 0, 1, 7, 8, 9, 10
OPERANDS = 13
F_ACTIVE, F_PLACED = 0, 1
STATE = OPERANDS + 2
"""Row of ``strides`` that describes a dense ``(rows, size)`` array."""

# What a simulator has, as bits.
EULER, RING, NOISE, CONTROL, REPLAY, COMES_AND_GOES = 1, 2, 4, 8, 16, 32


@exact
def load_static(w, operands, strides, row, first, n, size, again, c):
    """Load who is led and the parameters; ``again`` says that a tile of at least this size filled this workspace."""
    for j in range(8):
        if not (again and repeats(strides[j], n, size)):
            load(w, (LED if j == 0 else P_A + (j - 1) * ROW), operands[j], 0, strides[j], row, first, n, size)
    k = unpack(c)
    for j in range(padded(n)):
        w[P_BRAKE + j], w[P_FREE + j] = inverses(w[P_A + j], w[P_B + j], w[P_V0 + j], k)


@exact
def load_inputs(w, operands, flags, strides, t, row, first, n, size, has):
    """Load the inputs of step ``t``."""
    if has & NOISE:
        load(w, NORMALS, operands[O_NORMALS], t, strides[O_NORMALS], row, first, n, size)
    if has & CONTROL:
        load(w, COMMAND, operands[O_COMMAND], t, strides[O_COMMAND], row, first, n, size)
        load(w, ACTIVE, flags[F_ACTIVE], t, strides[OPERANDS + F_ACTIVE], row, first, n, size)
    if has & REPLAY:
        for j in range(3):
            o = O_PLACE + j
            load(w, PLACE + j * ROW, operands[o], t, strides[o], row, first, n, size)
        load(w, PLACED, flags[F_PLACED], t, strides[OPERANDS + F_PLACED], row, first, n, size)


@exact
def look_ahead(w, n, size, has):
    """Fill each vehicle's leader's speed; whoever has no leader will not read it."""
    m = padded(n)
    w[LEAD_SPEED] = w[SPEED]
    for j in range(1, m):
        w[LEAD_SPEED + j] = w[SPEED + j - 1]
    if has & RING and n >= size:
        for j in range(0, n, size):
            w[LEAD_SPEED + j] = w[SPEED + j + size - 1]


@exact
def want(w, n, has, c):
    """Fill the acceleration before the brakes, and each leader's speed as the driver meets it."""
    m = padded(n)
    k = unpack(c)
    for j in range(m):
        led, speed, ahead = w[LED + j], w[SPEED + j], w[LEAD_SPEED + j]
        lead_speed = ahead if led > k.zero else speed
        w[LEAD_SPEED + j] = lead_speed
        w[RAW + j] = follow(
            w[GAP + j], speed, lead_speed, led,
            w[P_A + j], w[P_BRAKE + j], w[P_TIME + j], w[P_MIN + j], w[P_FREE + j], k,
        )  # fmt: skip
    if has & NOISE:
        for j in range(m):
            w[RAW + j] = w[RAW + j] + w[P_SIGMA + j] * w[NORMALS + j]
    if has & CONTROL:
        for j in range(m):
            command, raw = w[COMMAND + j], w[RAW + j]
            w[RAW + j] = command if w[ACTIVE + j] > k.zero else raw


@exact
def step(w, n, size, has, c):
    """Advance a tile by one step, in place."""
    m = padded(n)
    k = unpack(c)
    look_ahead(w, n, size, has)
    want(w, n, has, c)
    is_euler = has & EULER != 0
    for j in range(m):
        speed = w[SPEED + j]
        moved, after, felt = integrate(speed, brake(w[RAW + j], speed, w[P_MAX + j], is_euler, k), is_euler, k)
        w[MOVED + j], w[SPEED + j], w[ACCEL + j] = moved, after, felt
    if has & REPLAY:
        for j in range(m):
            placed = w[PLACED + j] > k.zero
            jumped, pace, pull = w[PLACE + j] - w[POSITION + j], w[PACE + j], w[PULL + j]
            moved, speed, accel = w[MOVED + j], w[SPEED + j], w[ACCEL + j]
            w[MOVED + j] = jumped if placed else moved
            w[SPEED + j] = pace if placed else speed
            w[ACCEL + j] = pull if placed else accel
    w[LEAD_MOVED] = w[MOVED]
    for j in range(1, m):
        w[LEAD_MOVED + j] = w[MOVED + j - 1]
    if has & RING and n >= size:
        for j in range(0, n, size):
            w[LEAD_MOVED + j] = w[MOVED + j + size - 1]
    for j in range(m):
        led = w[LED + j] > k.zero
        gap, moved = w[GAP + j], w[MOVED + j]
        opened = gap + (w[LEAD_MOVED + j] - moved)
        w[GAP + j] = opened if led else gap
        w[POSITION + j] = w[POSITION + j] + moved
    if has & COMES_AND_GOES:
        for j in range(m):
            gap = w[GAP + j]
            w[GAP + j] = gap if w[LED + j] > k.zero else k.far
    if has & REPLAY:
        for j in range(m):
            there, position = w[PLACE + j], w[POSITION + j]
            w[POSITION + j] = there if w[PLACED + j] > k.zero else position


@exact
def fetch_next(gap, speed, position, operands, strides, placed, size):
    """Start fetching the state and the dense parameters of the next tile."""
    row, first, n, _, _ = placed
    begin = row * size + first
    prefetch(gap, begin, n)
    prefetch(speed, begin, n)
    prefetch(position, begin, n)
    for j in range(min(8, strides.shape[0])):
        if strides[j][2] == 1 and strides[j][1] == size:
            prefetch(operands[j], begin, n)


@exact
def forward(
    gap, speed, position, gap_end, speed_end, position_end, accel_end, kept, operands, flags, strides,
    begin_step, steps, rows, size, wide, has, c, begin, end,
):  # fmt: skip
    """Run tiles ``begin`` to ``end`` through a block of steps; ``kept`` (4, time, vehicles) may have no time at all."""
    w = np.zeros(ROWS * ROW, gap.dtype)
    dense, is_ring = strides[STATE], has & RING != 0
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, steps, wide, is_ring)
        if tile + 1 < end:
            fetch_next(gap, speed, position, operands, strides, place(tile + 1, rows, size, steps, wide, is_ring), size)
        load(w, GAP, gap, 0, dense, row, first, n, size)
        load(w, SPEED, speed, 0, dense, row, first, n, size)
        load(w, POSITION, position, 0, dense, row, first, n, size)
        load_static(w, operands, strides, row, first, n, size, n <= filled, c)
        filled = max(filled, n)
        at = row * size + first + skip
        for t in range(begin_step, begin_step + steps):
            if has & (NOISE | CONTROL | REPLAY):
                load_inputs(w, operands, flags, strides, t, row, first, n, size, has)
            step(w, n, size, has, c)
            if kept.shape[1]:
                store(kept[0, t], at, w, POSITION + skip, own)
                store(kept[1, t], at, w, SPEED + skip, own)
                store(kept[2, t], at, w, ACCEL + skip, own)
                store(kept[3, t], at, w, GAP + skip, own)
        store(gap_end, at, w, GAP + skip, own)
        store(speed_end, at, w, SPEED + skip, own)
        store(position_end, at, w, POSITION + skip, own)
        store(accel_end, at, w, ACCEL + skip, own)
