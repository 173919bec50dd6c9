"""Compiled rollout of lanes and rings, forwards and backwards: a tile runs a block of steps before it leaves the cache.

A template without an equation: the import of ``printed`` below is replaced by what ``scalar.tiles`` printed for one
simulator, and the file that results is compiled. A step is sense (into the past), respond, close (gaps); backwards the
states within a block live only in the workspace of a tile, so that the tape is one state per block.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.kernels.prefetch import prefetch
from idm_env.kernels.tiles import (
    ROW, add, clear, exact, gather, load, look_ahead, look_back, padded, place, repeats, replace, send_ahead, send_back,
    store, swift,
)  # fmt: skip

# <printed>
from idm_env.kernels.printed import (
    ACCEL, AGAIN, FLAGS, GAP, GRADIENT_ROWS, INPUT_ROWS, MOVING, NUMBERS, ON_ACCEL, ON_GAP,
    ON_INPUT_ROWS, ON_POSITION, ON_ROWS, ON_SPEED, PARAMETERS, POSITION, READ, RING, ROWS, SIGNALS, SPEED, STATE_ROWS,
    SEEDED, STATES, STATIC_ROWS, STATICS, TAPED, HOISTS, close, close_back, close_send, hoist, hoist_back, look_close,
    look_respond, look_sense, look_static, respond, respond_back, respond_send, sense, sense_back, sense_send,
)  # fmt: skip
# </printed>

__all__ = ["gather", "look_ahead", "look_back", "replace", "send_ahead", "send_back", "swift"]


@exact
def load_static(w, operands, strides, row, first, n, size, again, k):
    """Load what holds for the rollout; ``again`` says that a tile of at least this size filled this workspace."""
    for i in range(STATICS + PARAMETERS):
        if not (again and repeats(strides[i], n, size)):
            load(w, STATIC_ROWS + i * ROW, operands[i], 0, strides[i], row, first, n, size)
    hoist(w, padded(n), k)
    look_static(w, n, size)


@exact
def load_inputs(w, operands, flags, strides, t, row, first, n, size):
    """Load the inputs of step ``t``: numbers, then truth values."""
    for i in range(NUMBERS):
        o = STATICS + PARAMETERS + i
        load(w, INPUT_ROWS + i * ROW, operands[o], t, strides[o], row, first, n, size)
    for i in range(FLAGS):
        o = STATICS + PARAMETERS + NUMBERS + i
        load(w, INPUT_ROWS + (NUMBERS + i) * ROW, flags[i], t, strides[o], row, first, n, size)


@exact
def look(w, n, size):
    """Copy neighbours' numbers for the phases before anybody has moved."""
    look_sense(w, n, size)
    look_respond(w, n, size)


@exact
def step(w, h, n, size, k, now):
    """Advance a tile by one step, in place; ``now`` is the place of this step in the past."""
    m = padded(n)
    look(w, n, size)
    if SIGNALS:
        sense(w, h, m, k, now)
    respond(w, h, m, k, now)
    look_close(w, n, size)
    close(w, h, m, k, now)


@exact
def load_past(h, past, slots, dense, row, first, n, size):
    """Fill the past of a tile: slot 0 is the step before this block."""
    for s in range(slots):
        for i in range(SIGNALS):
            load(h, ((slots - 1 - s) * SIGNALS + i) * ROW, past[s * SIGNALS + i], 0, dense, row, first, n, size)


@exact
def store_past(h, past, first_slot, slots, at, skip, own):
    """Store the last steps of a tile's past; ``first_slot`` is the place of the newest."""
    for s in range(slots):
        for i in range(SIGNALS):
            store(past[s * SIGNALS + i], at, h, ((first_slot - s) * SIGNALS + i) * ROW + skip, own)


@exact
def fetch_next(arrays, operands, strides, placed, size):
    """Start fetching the state and the dense parameters of the next tile."""
    row, first, n, _, _ = placed
    begin = row * size + first
    for i in range(len(arrays)):
        prefetch(arrays[i], begin, n)
    for i in range(min(STATICS + PARAMETERS, strides.shape[0])):
        if strides[i][2] == 1 and strides[i][1] == size:
            prefetch(operands[i], begin, n)


@exact
def forward(
    start, ends, past, past_end, slots, kept, operands, flags, strides, k, begin_step, steps, rows, size, wide, around,
    begin, end,
):  # fmt: skip
    """Run tiles ``begin`` to ``end`` through a block of steps.

    ``start`` and ``ends`` are the states, one array each (of one element where it is not wanted); ``past`` (slots ·
    signals, vehicles); ``kept`` (4, time, vehicles) may have no time at all.
    """
    w = np.zeros(ROWS * ROW + 64, k.dtype)
    h = np.zeros(((slots + steps) * SIGNALS + 1) * ROW, k.dtype)
    dense, count = strides[len(strides) - 1], rows * size
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, RING)
        if tile + 1 < end:
            fetch_next(start, operands, strides, place(tile + 1, rows, size, wide, around, RING), size)
        for i in READ:
            load(w, STATE_ROWS + i * ROW, start[i], 0, dense, row, first, n, size)
        if SIGNALS:
            load_past(h, past, slots, dense, row, first, n, size)
        load_static(w, operands, strides, row, first, n, size, n <= filled, k)
        filled = max(filled, n)
        at = row * size + first + skip
        for t in range(steps):
            if NUMBERS + FLAGS:
                load_inputs(w, operands, flags, strides, begin_step + t, row, first, n, size)
            step(w, h, n, size, k, slots + t)
            if kept.shape[1]:
                store(kept[0, begin_step + t], at, w, POSITION + skip, own)
                store(kept[1, begin_step + t], at, w, SPEED + skip, own)
                store(kept[2, begin_step + t], at, w, ACCEL + skip, own)
                store(kept[3, begin_step + t], at, w, GAP + skip, own)
        for i in range(STATES):
            if ends[i].size == count:
                store(ends[i], at, w, STATE_ROWS + i * ROW + skip, own)
        if SIGNALS:
            store_past(h, past_end, slots + steps - 1, slots, at, skip, own)


@exact
def step_back(w, h, ah, n, size, k, now):
    """Carry the adjoint of a tile back by one step, in place; the states are those before that step."""
    m = padded(n)
    look(w, n, size)
    close_back(w, h, ah, m, k, now)
    close_send(w, n, size)
    respond_back(w, h, ah, m, k, now)
    respond_send(w, n, size)
    if SIGNALS:
        sense_back(w, h, ah, m, k, now)
        sense_send(w, n, size)


@exact
def recompute(w, h, tape, operands, flags, strides, k, begin_step, steps, slots, row, first, n, size):
    """Run a block once more and put what the adjoint reads on the tape of the tile."""
    for t in range(steps):
        for i in range(len(TAPED)):
            for j in range(n):
                tape[(t * len(TAPED) + i) * ROW + j] = w[STATE_ROWS + TAPED[i] * ROW + j]
        # The last step's result is not needed, but what it senses is.
        if t + 1 < steps or SIGNALS:
            if NUMBERS + FLAGS:
                load_inputs(w, operands, flags, strides, begin_step + t, row, first, n, size)
            step(w, h, n, size, k, slots + t)


@exact
def seed(w, to, source, dense, row, first, n, size):
    """Load an adjoint; an array of one element stands for zeros."""
    if source.size == 1:
        clear(w, to, n)
        w[to] = source[0]
    else:
        load(w, to, source, 0, dense, row, first, n, size)


@exact
def add_seeds(w, seeds, t, dense, row, first, n, size):
    """Add the adjoints of what was kept of one step."""
    targets = (ON_POSITION, ON_SPEED, ON_ACCEL, ON_GAP)
    for i in range(4):
        load(w, SEEDED, seeds[i, t], 0, dense, row, first, n, size)
        for j in range(n):
            w[targets[i] + j] += w[SEEDED + j]


@exact
def backward(
    start, past, slots, seeds, on_end, on_begin, on_past_end, on_past, on_parameters, fresh, on_inputs,
    operands, flags, strides, k, begin_step, steps, rows, size, wide, around, begin, end,
):  # fmt: skip
    """Carry adjoints at the end of a block to its begin; store (``fresh``) or add what falls on the parameters.

    ``seeds`` (4, time, vehicles; or no time) are the adjoints of position, speed, acceleration and gap of every step;
    ``on_end`` and ``on_begin`` one array per moving state; ``on_inputs`` (inputs, time, vehicles; or no time).
    """
    w = np.zeros(ROWS * ROW + 64, k.dtype)
    h = np.zeros(((slots + steps) * SIGNALS + 1) * ROW, k.dtype)
    ah = np.zeros(((slots + steps) * SIGNALS + 1) * ROW, k.dtype)
    tape = np.empty(len(TAPED) * steps * ROW, k.dtype)
    dense, count = strides[len(strides) - 1], rows * size
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, RING)
        at = row * size + first + skip
        if tile + 1 < end:
            following = place(tile + 1, rows, size, wide, around, RING)
            fetch_next(start, operands, strides, following, size)
            fetch_next(on_end, operands, strides[:0], following, size)
        for i in AGAIN:
            load(w, STATE_ROWS + i * ROW, start[i], 0, dense, row, first, n, size)
        load_static(w, operands, strides, row, first, n, size, n <= filled, k)
        filled = max(filled, n)
        if SIGNALS:
            load_past(h, past, slots, dense, row, first, n, size)
            clear(ah, 0, len(ah))
            load_past(ah[steps * SIGNALS * ROW :], on_past_end, slots, dense, row, first, n, size)
        recompute(w, h, tape, operands, flags, strides, k, begin_step, steps, slots, row, first, n, size)
        for i in range(MOVING):
            seed(w, ON_ROWS + i * ROW, on_end[i], dense, row, first, n, size)
        clear(w, GRADIENT_ROWS, (PARAMETERS + HOISTS) * ROW)
        for t in range(steps - 1, -1, -1):
            now = begin_step + t
            if seeds.shape[1]:
                add_seeds(w, seeds, now, dense, row, first, n, size)
            for i in range(len(TAPED)):
                for j in range(n):
                    w[STATE_ROWS + TAPED[i] * ROW + j] = tape[(t * len(TAPED) + i) * ROW + j]
            if NUMBERS + FLAGS:
                load_inputs(w, operands, flags, strides, now, row, first, n, size)
            step_back(w, h, ah, n, size, k, slots + t)
            if on_inputs.shape[1]:
                for i in range(NUMBERS):
                    store(on_inputs[i, now], at, w, ON_INPUT_ROWS + i * ROW + skip, own)
        hoist_back(w, padded(n), k)
        for i in range(MOVING):
            if on_begin[i].size == count:
                store(on_begin[i], at, w, ON_ROWS + i * ROW + skip, own)
        if SIGNALS:
            store_past(ah, on_past, slots - 1, slots, at, skip, own)
        for i in range(PARAMETERS):
            if fresh:
                store(on_parameters[i], at, w, GRADIENT_ROWS + i * ROW + skip, own)
            else:
                add(on_parameters[i], at, w, GRADIENT_ROWS + i * ROW + skip, own)
