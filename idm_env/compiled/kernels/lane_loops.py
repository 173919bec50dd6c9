"""Compiled rollout of lanes and rings, forwards and backwards: a tile runs a block of steps before it leaves the cache.

No equation stands here. A step is sense (into the past), respond and close (gaps), each a printed phase that is called
through its address; ``measures`` tell how many rows of what there are and where (``printed.MEASURES``). Backwards, the
states within a block live only in the workspace of a tile, so that the tape is one state per block.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels import tiles
from idm_env.compiled.kernels.compiler import apart
from idm_env.compiled.kernels.memory import LINE, copy, number, prefetch, stream
from idm_env.compiled.kernels.phases import call
from idm_env.compiled.kernels.tiles import ROW, exact, load, look_ahead, look_back, padded, place, uniform, workspace

(
    N_ROWS, IS_RING, STATES, MOVING, STATICS, PARAMETERS, HOISTS, NUMBERS, FLAGS, SIGNALS, STATE_ROWS, ON_ROWS,
    STATIC_ROWS, GRADIENT_ROWS, INPUT_ROWS, ON_INPUT_ROWS, SCRATCH, SEEDED, ON_GAP, ON_SPEED, ON_POSITION, ON_ACCEL,
    GAP, SPEED, POSITION, ACCEL, SIGNAL_ROWS, ON_SIGNAL_ROWS,
) = range(28)  # fmt: skip
"""Places in ``measures``."""

HOIST, SENSE, RECALL, RESPOND, CLOSE = range(5)
"""Places of the phases' addresses."""

PIECE = 128
"""Vehicles between two fetches: their lines of a dozen arrays are what a core can wait for at a time."""

LARGE = 1 << 22
"""Bytes from which an array is written past the caches: a step's arrays together are then larger than any cache."""

BEFORE = 0
"""First column of ``looks``: 0 for the whole rollout, or the phase before which they are needed."""


@apart
def load_static(w, operands, strides, row, first, n, size, again, measures, phases, looks, k):
    """Load what holds for the rollout; ``again`` says that a tile of at least this size filled this workspace."""
    for i in range(measures[STATICS] + measures[PARAMETERS]):
        if not (again and tiles.repeats(strides, i, n, size)):
            load(w, measures[STATIC_ROWS] + i * ROW, operands[i], strides, i, 0, row, first, n, size, False)
    if phases[HOIST]:
        call(phases[HOIST], w, padded(n), k)  # type: ignore[call-arg]
    look(w, n, size, measures, looks, BEFORE)


@apart
def load_inputs(w, operands, strides, t, row, first, n, size, measures):
    """Load the inputs of step ``t``: numbers, then truth values."""
    o, numbers = measures[STATICS] + measures[PARAMETERS], measures[NUMBERS]
    for i in range(numbers + measures[FLAGS]):
        to = measures[INPUT_ROWS] + i * ROW
        load(w, to, operands[o + i], strides, o + i, t, row, first, n, size, i >= numbers)


@apart
def look(w, n, size, measures, looks, when):
    """Copy neighbours' numbers beside one's own, as far as a phase needs them."""
    for i in range(looks.shape[0]):
        if looks[i, 0] == when:
            if looks[i, 1] > 0:
                look_ahead(w, looks[i, 2], looks[i, 3], n, size, measures[IS_RING])
            else:
                look_back(w, looks[i, 2], looks[i, 3], n, size, measures[IS_RING])


@apart
def fetch(w, h, pitch, n, signals, recalls, now):
    """Fill the rows of what drivers recall; ``now`` is the place of this step in the past."""
    for i in range(recalls.shape[0]):
        ago, signal, to = recalls[i, 0], recalls[i, 1], recalls[i, 2]
        if uniform(w, ago, n):
            copy(w, to, h, ((now - int(w[ago])) * signals + signal) * pitch, n)
        else:
            for j in range(n):
                back = int(number(w, ago + j, w))
                w[to + j] = number(h, ((now - back) * signals + signal) * pitch + j, w)


@exact
def remember(w, h, pitch, n, signals, signal_rows, now):
    """Put the signals of this step into the past."""
    for i in range(signals):
        copy(h, (now * signals + i) * pitch, w, signal_rows + i * ROW, n)


@apart
def perceive(w, h, pitch, n, size, measures, phases, looks, recalls, k, now):
    """Do all of a step that comes before the response."""
    m = padded(n)
    look(w, n, size, measures, looks, SENSE)
    look(w, n, size, measures, looks, RESPOND)
    if phases[SENSE]:
        call(phases[SENSE], w, m, k)  # type: ignore[call-arg]
        remember(w, h, pitch, n, measures[SIGNALS], measures[SIGNAL_ROWS], now)
        look(w, n, size, measures, looks, RECALL)
        call(phases[RECALL], w, m, k)  # type: ignore[call-arg]
        fetch(w, h, pitch, n, measures[SIGNALS], recalls, now)


@apart
def step(w, h, pitch, n, size, measures, phases, looks, recalls, k, now):
    """Advance a tile by one step, in place; ``now`` is the place of this step in the past.

    The past of the tile begins at address ``h``, oldest step first, and has a row of ``pitch`` numbers for each signal.
    """
    perceive(w, h, pitch, n, size, measures, phases, looks, recalls, k, now)
    call(phases[RESPOND], w, padded(n), k)  # type: ignore[call-arg]
    close(w, n, size, measures, phases, looks, k)


@apart
def close(w, n, size, measures, phases, looks, k):
    """Move gaps on, once everybody has responded."""
    look(w, n, size, measures, looks, CLOSE)
    call(phases[CLOSE], w, padded(n), k)  # type: ignore[call-arg]


@apart
def load_past(h, past, alike, begin, slots, signals, strides, row, first, n, size, count):
    """Fill the past of a tile from an address; slot 0 is the newest, at place ``begin + slots − 1``.

    ``alike`` says that one slot stands for all.
    """
    dense = len(strides) - 1
    for s in range(slots):
        for i in range(signals):
            source = past + (i if alike else s * signals + i) * count * h.itemsize
            load(
                h, ((begin + slots - 1 - s) * signals + i) * ROW, source, strides, dense, 0, row, first, n, size, False
            )


@exact
def store_past(h, past, newest, slots, signals, at, skip, own, count):
    """Store the last steps of a tile's past; ``newest`` is the place of slot 0."""
    for s in range(slots):
        for i in range(signals):
            copy(past, (s * signals + i) * count + at, h, ((newest - s) * signals + i) * ROW + skip, own)


@apart
def respond_and_fetch(w, m, phases, k, sources, following, size):
    """Respond, a piece of the tile at a time, and start fetching as much of the next tile each time.

    Fetched all at once, the next tile would hold up this one: a core waits for a few dozen cache lines at a time.
    """
    row, first, n, _, _ = following
    for j in range(0, m, PIECE):
        for i in range(len(sources)):
            prefetch(sources[i], row * size + first + j, min(PIECE, n - j), w)
        call(phases[RESPOND], w[j:], min(PIECE, m - j), k)  # type: ignore[call-arg]


@apart
def dense_arrays(start, read, operands, strides, many, size):
    """Return the addresses of what a tile is filled from and that has a number for every vehicle."""
    sources, count = np.empty(len(read) + many, np.int64), 0
    for i in read:
        sources[count] = start[i]
        count += 1
    for i in range(many):
        if strides[i, 2] == 1 and strides[i, 1] == size:
            sources[count] = operands[i]
            count += 1
    return sources[:count]


@apart
def store(ends, at, w, rows, count, n):
    """Store the first ``n`` numbers of rows that lie ``ROW`` apart, at ``at`` of as many addresses that are not 0.

    Lines of all are written in turn and past the caches: whatever is so large is not read again before it has left
    them, and a line that is written whole need not be read before.
    """
    line = LINE // w.itemsize
    skip = min(-at % line, n)
    whole = (n - skip) // line * line
    for j in range(skip, skip + whole, line):
        for i in range(count):
            if ends[i]:
                stream(ends[i], at + j, w, rows + i * ROW + j)
    for i in range(count):
        if ends[i]:
            copy(ends[i], at, w, rows + i * ROW, skip)
            copy(ends[i], at + skip + whole, w, rows + i * ROW + skip + whole, n - whole - skip)


@exact
def fetch_next(sources, strides, placed, size, like):
    """Start fetching the dense ones of some arrays, as many as there are strides, for the next tile."""
    row, first, n, _, _ = placed
    for i in range(len(strides)):
        if sources[i] and strides[i, 2] == 1 and strides[i, 1] == size:
            prefetch(sources[i], row * size + first, n, like)


@exact
def fetch_states(states, which, placed, size, like):
    """Start fetching some of the states for the next tile."""
    row, first, n, _, _ = placed
    for i in which:
        prefetch(states[i], row * size + first, n, like)


@exact
def forward(
    start, ends, past, alike, past_end, slots, kept, every, measures, phases, looks, recalls, read, operands, strides,
    k, begin_step, steps, rows, size, wide, around, begin, end,
):  # fmt: skip
    """Run tiles ``begin`` to ``end`` through a block of steps.

    What belongs to the caller are addresses (``memory``): ``start`` and ``ends`` of the states, 0 for one that is not
    wanted; ``past`` (slots · signals, vehicles; of one slot where all are ``alike``) and ``past_end``; ``kept``
    (4, ``every`` steps, vehicles), nothing where ``every`` is 0; ``operands`` with their ``strides``, of which the last
    are those of a dense array: statics, parameters, inputs, truth values among these.
    """
    w = workspace(measures[N_ROWS] * ROW, k)
    signals = measures[SIGNALS]
    h = workspace(((slots + steps) * signals + 1) * ROW, k)
    dense, count, is_ring = len(strides) - 1, rows * size, measures[IS_RING] != 0
    many, has_inputs = measures[STATICS] + measures[PARAMETERS], measures[NUMBERS] + measures[FLAGS] > 0
    sources, past_caches = dense_arrays(start, read, operands, strides, many, size), count * k.itemsize > LARGE
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        for i in read:
            load(w, measures[STATE_ROWS] + i * ROW, start[i], strides, dense, 0, row, first, n, size, False)
        load_past(h, past, alike, 0, slots, signals, strides, row, first, n, size, count)
        load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
        filled = max(filled, n)
        cell = row * size + first + skip
        for t in range(begin_step, begin_step + steps):
            if has_inputs:
                load_inputs(w, operands, strides, t, row, first, n, size, measures)
            now = slots + t - begin_step
            if t < begin_step + steps - 1 or tile + 1 == end:
                step(w, h.ctypes.data, ROW, n, size, measures, phases, looks, recalls, k, now)
            else:
                perceive(w, h.ctypes.data, ROW, n, size, measures, phases, looks, recalls, k, now)
                following = place(tile + 1, rows, size, wide, around, is_ring)
                respond_and_fetch(w, padded(n), phases, k, sources, following, size)
                close(w, n, size, measures, phases, looks, k)
            if every:
                copy(kept, t * count + cell, w, measures[POSITION] + skip, own)
                copy(kept, (every + t) * count + cell, w, measures[SPEED] + skip, own)
                copy(kept, (2 * every + t) * count + cell, w, measures[ACCEL] + skip, own)
                copy(kept, (3 * every + t) * count + cell, w, measures[GAP] + skip, own)
        if past_caches:
            store(ends, cell, w, measures[STATE_ROWS] + skip, measures[STATES], own)
        else:
            for i in range(measures[STATES]):
                if ends[i]:
                    copy(ends[i], cell, w, measures[STATE_ROWS] + i * ROW + skip, own)
        store_past(h, past_end, slots + steps - 1, slots, signals, cell, skip, own, count)
