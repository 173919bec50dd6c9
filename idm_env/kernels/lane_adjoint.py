"""Compiled vector-Jacobian product of ``lane_loops.forward``: a tile recomputes a block of steps, then walks it back.

The states within a block live only in the workspace of a tile, so that the tape is one state per block of steps.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.kernels.lane_loops import (
    CLOSE,
    FLAGS,
    GRADIENT_ROWS,
    HOIST,
    HOISTS,
    IS_RING,
    MOVING,
    N_ROWS,
    NUMBERS,
    ON_ACCEL,
    ON_GAP,
    ON_INPUT_ROWS,
    ON_POSITION,
    ON_ROWS,
    ON_SIGNAL_ROWS,
    ON_SPEED,
    PARAMETERS,
    RESPOND,
    SCRATCH,
    SEEDED,
    SENSE,
    SIGNALS,
    STATE_ROWS,
    STATICS,
    fetch_next,
    load_inputs,
    load_past,
    load_static,
    look,
    perceive,
    step,
    store_past,
)  # fmt: skip
from idm_env.kernels.phases import call
from idm_env.kernels.tiles import (
    ROW,
    add,
    clear,
    exact,
    load,
    padded,
    place,
    send_ahead,
    send_back,
    store,
    uniform,
)  # fmt: skip


@exact
def send(w, n, size, measures, sends, phase):
    """Add what fell on neighbours' numbers to their adjoints; further than one vehicle it is handed on."""
    ring = measures[IS_RING]
    for i in range(sends.shape[0]):
        if sends[i, 0] != phase:
            continue
        shift, source = sends[i, 1], sends[i, 2]
        for hop in range(abs(shift)):
            last = hop == abs(shift) - 1
            target = sends[i, 3] if last else measures[SCRATCH] + (hop % 2) * ROW
            if not last:
                clear(w, target, padded(n))
            if shift > 0:
                send_ahead(w, target, source, n, size, ring)
            else:
                send_back(w, target, source, n, size, ring)
            source = target


@exact
def give_back(w, ah, n, signals, recalls, now):
    """Add the adjoints of what drivers recalled to those of the past."""
    for i in range(recalls.shape[0]):
        ago, signal, on = recalls[i, 0], recalls[i, 1], recalls[i, 3]
        if uniform(w, ago, n):
            add(ah, ((now - int(w[ago])) * signals + signal) * ROW, w, on, n)
        else:
            for j in range(n):
                ah[((now - int(w[ago + j])) * signals + signal) * ROW + j] += w[on + j]


@exact
def step_back(w, h, ah, n, size, measures, phases, back, looks, recalls, sends, k, now):
    """Carry the adjoint of a tile back by one step, in place; the states are those before that step."""
    m, signals = padded(n), measures[SIGNALS]
    perceive(w, h, n, size, measures, phases, looks, recalls, k, now)
    if measures[NUMBERS] + measures[FLAGS]:
        look(w, n, size, measures, looks, CLOSE)  # whose neighbour comes or goes is an input of this step
    for phase in (CLOSE, RESPOND):
        call(back[phase], w, m, k)  # type: ignore[call-arg]
        send(w, n, size, measures, sends, phase)
    if phases[SENSE]:
        give_back(w, ah, n, signals, recalls, now)
        for i in range(signals):
            store(w, measures[ON_SIGNAL_ROWS] + i * ROW, ah, (now * signals + i) * ROW, n)
        call(back[SENSE], w, m, k)  # type: ignore[call-arg]
        send(w, n, size, measures, sends, SENSE)


@exact
def recompute(
    w, h, tape, taped, operands, flags, strides, k, begin_step, steps, slots, row, first, n, size, measures, phases,
    looks, recalls,
):  # fmt: skip
    """Run a block once more and put what the adjoint reads on the tape of the tile."""
    for t in range(steps):
        for i in range(len(taped)):
            store(tape, (t * len(taped) + i) * ROW, w, measures[STATE_ROWS] + taped[i] * ROW, n)
        # The last step's result is not needed, but what it senses is.
        if t + 1 < steps or phases[SENSE]:
            if measures[NUMBERS] + measures[FLAGS]:
                load_inputs(w, operands, flags, strides, begin_step + t, row, first, n, size, measures)
            step(w, h, n, size, measures, phases, looks, recalls, k, slots + t)


@exact
def seed(w, to, source, dense, row, first, n, size):
    """Load an adjoint; an array of one element stands for zeros."""
    if source.size == 1:
        clear(w, to, n)
        w[to] = source[0]
    else:
        load(w, to, source, 0, dense, row, first, n, size)


@exact
def add_seeds(w, seeds, t, dense, row, first, n, size, measures):
    """Add the adjoints of what was kept of one step."""
    for i, target in enumerate((ON_POSITION, ON_SPEED, ON_ACCEL, ON_GAP)):
        load(w, measures[SEEDED], seeds[i, t], 0, dense, row, first, n, size)
        add(w, measures[target], w, measures[SEEDED], n)


@exact
def backward(
    start, past, slots, seeds, on_end, on_begin, on_past_end, on_past, on_parameters, fresh, on_inputs,
    measures, phases, looks, recalls, back, sends, taped, again, operands, flags, strides, k,
    begin_step, steps, rows, size, wide, around, begin, end,
):  # fmt: skip
    """Carry adjoints at the end of a block to its begin; store (``fresh``) or add what falls on the parameters.

    ``seeds`` (4, time, vehicles; or no time) are the adjoints of position, speed, acceleration and gap of every step;
    ``on_end`` and ``on_begin`` one array per moving state; ``on_inputs`` (inputs, time, vehicles; or no time).
    """
    signals = measures[SIGNALS]
    w = np.zeros(measures[N_ROWS] * ROW + 64, k.dtype)
    h = np.zeros(((slots + steps) * signals + 1) * ROW, k.dtype)
    ah = np.zeros(((slots + steps) * signals + 1) * ROW, k.dtype)
    tape = np.empty(len(taped) * steps * ROW, k.dtype)
    dense, count, is_ring = strides[len(strides) - 1], rows * size, measures[IS_RING] != 0
    many, has_inputs = measures[STATICS] + measures[PARAMETERS], measures[NUMBERS] + measures[FLAGS] > 0
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        at = row * size + first + skip
        if tile + 1 < end:
            following = place(tile + 1, rows, size, wide, around, is_ring)
            fetch_next(start, operands, many, strides, following, size)
            fetch_next(on_end, operands, 0, strides, following, size)
        for i in again:
            load(w, measures[STATE_ROWS] + i * ROW, start[i], 0, dense, row, first, n, size)
        load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
        filled = max(filled, n)
        load_past(h, past, 0, slots, signals, dense, row, first, n, size)
        if signals:
            clear(ah, 0, len(ah))
            load_past(ah, on_past_end, steps, slots, signals, dense, row, first, n, size)
        recompute(
            w, h, tape, taped, operands, flags, strides, k, begin_step, steps, slots, row, first, n, size, measures,
            phases, looks, recalls,
        )  # fmt: skip
        for i in range(measures[MOVING]):
            seed(w, measures[ON_ROWS] + i * ROW, on_end[i], dense, row, first, n, size)
        clear(w, measures[GRADIENT_ROWS], (measures[PARAMETERS] + measures[HOISTS]) * ROW)
        for t in range(steps - 1, -1, -1):
            now = begin_step + t
            if seeds.shape[1]:
                add_seeds(w, seeds, now, dense, row, first, n, size, measures)
            for i in range(len(taped)):
                store(w, measures[STATE_ROWS] + taped[i] * ROW, tape, (t * len(taped) + i) * ROW, n)
            if has_inputs:
                load_inputs(w, operands, flags, strides, now, row, first, n, size, measures)
            step_back(w, h, ah, n, size, measures, phases, back, looks, recalls, sends, k, slots + t)
            if on_inputs.shape[1]:
                for i in range(measures[NUMBERS]):
                    store(on_inputs[i, now], at, w, measures[ON_INPUT_ROWS] + i * ROW + skip, own)
        if back[HOIST]:
            call(back[HOIST], w, padded(n), k)  # type: ignore[call-arg]
        for i in range(measures[MOVING]):
            if on_begin[i].size == count:
                store(on_begin[i], at, w, measures[ON_ROWS] + i * ROW + skip, own)
        store_past(ah, on_past, slots - 1, slots, signals, at, skip, own)
        for i in range(measures[PARAMETERS]):
            if fresh:
                store(on_parameters[i], at, w, measures[GRADIENT_ROWS] + i * ROW + skip, own)
            else:
                add(on_parameters[i], at, w, measures[GRADIENT_ROWS] + i * ROW + skip, own)
