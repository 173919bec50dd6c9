"""Compiled rollout of lanes and rings, forwards and backwards: a tile runs a block of steps before it leaves the cache.

No equation stands here. A step is sense (into the past), respond and close (gaps), each a printed phase that is called
through its address; ``measures`` tell how many rows of what there are and where (``printed.MEASURES``). Backwards, the
states within a block live only in the workspace of a tile, so that the tape is one state per block.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.kernels.phases import call
from idm_env.kernels.prefetch import prefetch
from idm_env.kernels.tiles import (
    ROW,
    exact,
    load,
    look_ahead,
    look_back,
    padded,
    place,
    repeats,
    store,
    uniform,
)

(
    N_ROWS, IS_RING, STATES, MOVING, STATICS, PARAMETERS, HOISTS, NUMBERS, FLAGS, SIGNALS, STATE_ROWS, ON_ROWS,
    STATIC_ROWS, GRADIENT_ROWS, INPUT_ROWS, ON_INPUT_ROWS, SCRATCH, SEEDED, ON_GAP, ON_SPEED, ON_POSITION, ON_ACCEL,
    GAP, SPEED, POSITION, ACCEL, SIGNAL_ROWS, ON_SIGNAL_ROWS,
) = range(28)  # fmt: skip
"""Places in ``measures``."""

HOIST, SENSE, RECALL, RESPOND, CLOSE = range(5)
"""Places of the phases' addresses."""

BEFORE = 0
"""First column of ``looks``: 0 for the whole rollout, or the phase before which they are needed."""


@exact
def load_static(w, operands, strides, row, first, n, size, again, measures, phases, looks, k):
    """Load what holds for the rollout; ``again`` says that a tile of at least this size filled this workspace."""
    for i in range(measures[STATICS] + measures[PARAMETERS]):
        if not (again and repeats(strides[i], n, size)):
            load(w, measures[STATIC_ROWS] + i * ROW, operands[i], 0, strides[i], row, first, n, size)
    if phases[HOIST]:
        call(phases[HOIST], w, padded(n), k)  # type: ignore[call-arg]
    look(w, n, size, measures, looks, BEFORE)


@exact
def load_inputs(w, operands, flags, strides, t, row, first, n, size, measures):
    """Load the inputs of step ``t``: numbers, then truth values."""
    o = measures[STATICS] + measures[PARAMETERS]
    numbers = measures[NUMBERS]
    for i in range(numbers):
        load(w, measures[INPUT_ROWS] + i * ROW, operands[o + i], t, strides[o + i], row, first, n, size)
    for i in range(measures[FLAGS]):
        at = numbers + i
        load(w, measures[INPUT_ROWS] + at * ROW, flags[i], t, strides[o + at], row, first, n, size)


@exact
def look(w, n, size, measures, looks, when):
    """Copy neighbours' numbers beside one's own, as far as a phase needs them."""
    for i in range(looks.shape[0]):
        if looks[i, 0] == when:
            if looks[i, 1] > 0:
                look_ahead(w, looks[i, 2], looks[i, 3], n, size, measures[IS_RING])
            else:
                look_back(w, looks[i, 2], looks[i, 3], n, size, measures[IS_RING])


@exact
def fetch(w, h, n, signals, recalls, now):
    """Fill the rows of what drivers recall; ``now`` is the place of this step in the past."""
    for i in range(recalls.shape[0]):
        ago, signal, to = recalls[i, 0], recalls[i, 1], recalls[i, 2]
        if uniform(w, ago, n):
            store(w, to, h, ((now - int(w[ago])) * signals + signal) * ROW, n)
        else:
            for j in range(n):
                w[to + j] = h[((now - int(w[ago + j])) * signals + signal) * ROW + j]


@exact
def remember(w, h, n, signals, signal_rows, now):
    """Put the signals of this step into the past."""
    for i in range(signals):
        store(h, (now * signals + i) * ROW, w, signal_rows + i * ROW, n)


@exact
def perceive(w, h, n, size, measures, phases, looks, recalls, k, now):
    """Do all of a step that comes before the response."""
    m = padded(n)
    look(w, n, size, measures, looks, SENSE)
    look(w, n, size, measures, looks, RESPOND)
    if phases[SENSE]:
        call(phases[SENSE], w, m, k)  # type: ignore[call-arg]
        remember(w, h, n, measures[SIGNALS], measures[SIGNAL_ROWS], now)
        look(w, n, size, measures, looks, RECALL)
        call(phases[RECALL], w, m, k)  # type: ignore[call-arg]
        fetch(w, h, n, measures[SIGNALS], recalls, now)


@exact
def step(w, h, n, size, measures, phases, looks, recalls, k, now):
    """Advance a tile by one step, in place; ``now`` is the place of this step in the past."""
    m = padded(n)
    perceive(w, h, n, size, measures, phases, looks, recalls, k, now)
    call(phases[RESPOND], w, m, k)  # type: ignore[call-arg]
    look(w, n, size, measures, looks, CLOSE)
    call(phases[CLOSE], w, m, k)  # type: ignore[call-arg]


@exact
def load_past(h, past, begin, slots, signals, dense, row, first, n, size):
    """Fill the past of a tile; slot 0 is the newest, at place ``begin + slots − 1``. One slot may stand for all."""
    for s in range(slots):
        for i in range(signals):
            to = ((begin + slots - 1 - s) * signals + i) * ROW
            load(h, to, past[(s * signals + i) % past.shape[0]], 0, dense, row, first, n, size)


@exact
def store_past(h, past, newest, slots, signals, at, skip, own):
    """Store the last steps of a tile's past; ``newest`` is the place of slot 0."""
    for s in range(slots):
        for i in range(signals):
            store(past[s * signals + i], at, h, ((newest - s) * signals + i) * ROW + skip, own)


@exact
def fetch_next(arrays, operands, many, strides, placed, size):
    """Start fetching the state and the dense parameters of the next tile."""
    row, first, n, _, _ = placed
    begin = row * size + first
    for i in range(len(arrays)):
        prefetch(arrays[i], begin, n)
    for i in range(many):
        if strides[i][2] == 1 and strides[i][1] == size:
            prefetch(operands[i], begin, n)


@exact
def forward(
    start, ends, past, past_end, slots, kept, measures, phases, looks, recalls, read, operands, flags, strides, k,
    begin_step, steps, rows, size, wide, around, begin, end,
):  # fmt: skip
    """Run tiles ``begin`` to ``end`` through a block of steps.

    ``start`` and ``ends`` are the states, one array each (of one element where it is not wanted); ``past`` (slots ·
    signals, vehicles); ``kept`` (4, time, vehicles) may have no time at all.
    """
    w = np.zeros(measures[N_ROWS] * ROW + 64, k.dtype)
    signals = measures[SIGNALS]
    h = np.zeros(((slots + steps) * signals + 1) * ROW, k.dtype)
    dense, count, is_ring = strides[len(strides) - 1], rows * size, measures[IS_RING] != 0
    many, has_inputs = measures[STATICS] + measures[PARAMETERS], measures[NUMBERS] + measures[FLAGS] > 0
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        if tile + 1 < end:
            fetch_next(start, operands, many, strides, place(tile + 1, rows, size, wide, around, is_ring), size)
        for i in read:
            load(w, measures[STATE_ROWS] + i * ROW, start[i], 0, dense, row, first, n, size)
        load_past(h, past, 0, slots, signals, dense, row, first, n, size)
        load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
        filled = max(filled, n)
        at = row * size + first + skip
        for t in range(begin_step, begin_step + steps):
            if has_inputs:
                load_inputs(w, operands, flags, strides, t, row, first, n, size, measures)
            step(w, h, n, size, measures, phases, looks, recalls, k, slots + t - begin_step)
            if kept.shape[1]:
                store(kept[0, t], at, w, measures[POSITION] + skip, own)
                store(kept[1, t], at, w, measures[SPEED] + skip, own)
                store(kept[2, t], at, w, measures[ACCEL] + skip, own)
                store(kept[3, t], at, w, measures[GAP] + skip, own)
        for i in range(measures[STATES]):
            if ends[i].size == count:
                store(ends[i], at, w, measures[STATE_ROWS] + i * ROW + skip, own)
        store_past(h, past_end, slots + steps - 1, slots, signals, at, skip, own)
