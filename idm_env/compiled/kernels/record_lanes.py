"""Look-ups of loops over records and steps of single lanes, some compiled once for all printed loops (``apart``).

A tile is ``LANES`` drivers side by side: copies of a row of records, and the next rows. This is no printed file: numba
keeps with a compiled loop where each function that it calls was defined, and a printed file is not there to be imported
in a process that has printed another.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.extras import needed

with needed("a compiled loop"):
    from idm_env.compiled.kernels.compiler import apart, compiler

LANES = 8
COLUMNS: tuple[str, ...] = ("lead_rear", "lead_speed", "lead_accel", "second_rear", "second_speed", "second_accel")
COLUMNS += ("second_present", "behind_front", "behind_speed", "behind_accel", "behind_present", "beside_distance")
COLUMNS += ("beside_speed", "beside_present", "position", "speed", "accel", "time", "place", "pushed")
"""What a record has of every sample; of others, the distance to them or where they are."""
MEASURED_REAR, MEASURED_LEAD_SPEED, MEASURED_LEAD_ACCEL = range(3)
MEASURED_POSITION, MEASURED_SPEED, MEASURED_ACCEL, MEASURED_TIME, MEASURED_PLACE, MEASURED_PUSH = range(14, 20)
"""The columns that every loop reads."""
SPEED, ACCEL, DISPLACEMENT, POSITION, GAP, LENGTH, LEAD_SPEED, LEAD_ACCEL, STEP, PLACE, PULSE, OFFSET, PUSH = range(13)
"""Rows of ``state``; the first three those of ``moved``, memories at the beginning behind them."""
COLUMN = 13
"""The row of ``state`` with the first column of the record; of these those are filled that somebody reads."""
SAMPLE, LANE, DRIVER, ROW, COPY, ORIGIN, FIRST, LAST, NEXT, SPAN = range(10)
"""Rows of ``index``: the sample of now, the lane, place in φ, row, copy; first samples of the row and of its record,
the record's last; the next row to be wound up; least and most steps from a record's first sample to a row's."""


@apart
def seat(tile, index, state, p, th, record, start, group, length, bounds, theta, phi, used, ends):
    """Give every lane of a tile its copy and row, copies of a row one beside another, and load their parameters."""
    copies = theta.shape[0]
    for lane in range(LANES):
        both = min(tile * LANES + lane, copies * len(record) - 1)
        row, copy = both // copies, both % copies
        r, driver = record[row], copy * theta.shape[1] + group[row]
        index[LANE, lane], index[DRIVER, lane], index[ROW, lane], index[COPY, lane] = lane, driver, row, copy
        index[ORIGIN, lane], index[FIRST, lane], index[LAST, lane] = start[row], bounds[r], bounds[r + 1] - 1
        index[NEXT, lane], since = ends[row] if len(ends) else row, start[row] - bounds[r]
        index[SPAN, 0] = min(since, index[SPAN, 0]) if lane else since
        index[SPAN, 1] = max(since, index[SPAN, 1]) if lane else since
        state[LENGTH, lane] = length[r]
        for j in range(theta.shape[2]):
            th[j, lane] = theta[copy, group[row], j]
        for j in used:
            p[j, lane] = phi[driver, j]


@apart
def push(signals, index, state, t, pulse):
    """Load the pulses of now."""
    for lane in range(LANES):
        begin, end, change, added = pulse[index[COPY, lane]]
        now = signals[index[SAMPLE, lane], MEASURED_PUSH] if begin <= t < end else 0.0
        state[PULSE, lane], state[PUSH, lane] = change * now, added * now


@apart
def keep(signals, index, state, t, n, gap_out, speed_out):
    """Keep a sample."""
    for lane in range(LANES):
        copy, row, i = index[COPY, lane], index[ROW, lane], min(index[ORIGIN, lane] + t, index[LAST, lane])
        gap_out[copy, row, n] = signals[i, MEASURED_REAR] - state[POSITION, lane]
        speed_out[copy, row, n] = state[SPEED, lane]


@apart
def remember(index, memory, moved, wound, t, begins):
    """Fill the memories of drivers who are where they begin: as they are ``wound``, or as ``beginning`` has them."""
    for lane in range(LANES):
        if t <= begins or index[ORIGIN, lane] + t <= index[FIRST, lane]:
            for j in range(len(memory)):
                memory[j, lane] = wound[index[COPY, lane], index[ROW, lane], j] if wound.size else moved[3 + j, lane]


@apart
def wind_up(index, memory, wound, t, ends, order, settle):
    """Keep the memories of rows that settle at the sample of now."""
    for lane in range(LANES):
        stop = ends[index[ROW, lane] + 1]
        while index[NEXT, lane] < stop and settle[order[index[NEXT, lane]]] == index[ORIGIN, lane] + t:
            for j in range(len(memory)):
                wound[index[COPY, lane], order[index[NEXT, lane]], j] = memory[j, lane]
            index[NEXT, lane] += 1


@compiler(forceinline=True)
def recall(h, now, steps, signal, lane):
    """Return a signal so many steps ago, or the oldest that is kept."""
    return h[np.uint64(max(now - int(steps), 0)), np.uint64(signal), np.uint64(lane)]


@compiler(forceinline=True)
def column(signals, sample, number):
    """Return a number of a record; numba asks of no index without a sign whether it counts from the end."""
    return signals[np.uint64(sample), np.uint64(number)]


@compiler()
def curve(phi, driver, number, tables, x):
    """Piecewise linear through evenly spaced knots (periodic where a period is given), or a trapezoid."""
    form, count, place, row = tables[number, 0], tables[number, 1], np.uint64(tables[number, 2]), np.uint64(driver)
    first, by, period = phi[row, place], phi[row, place + np.uint64(1)], phi[row, place + np.uint64(3)]
    knots = place + np.uint64(4)
    if period > 0.0:
        x = x - period * np.floor(x / period)
    if form == 2:
        edge = phi[row, place + np.uint64(2)]
        up = min(max((x - first + edge) / (2.0 * edge), 0.0), 1.0)
        down = min(max((by + edge - x) / (2.0 * edge), 0.0), 1.0)
        return phi[row, knots] * min(up, down)
    position = (x - first) * by
    if period > 0.0:
        position = position - count * np.floor(position / count)
        low = int(position)
        one, other = low % count, (low + 1) % count
    else:
        position = min(max(position, 0.0), count - 1.0)
        low = min(int(position), count - 2)
        one, other = low, low + 1
    share = position - low
    return (1.0 - share) * phi[row, knots + np.uint64(one)] + share * phi[row, knots + np.uint64(other)]
