"""Loops over drivers and time of discovery's rollout, without an equation: lines between marks are printed.

This file is a template (``march``). What is printed is walked once (``kernels.emitted``), when numba compiles the loop.
``LANES`` drivers stand side by side: copies of a row of records and of the next ones. What belongs to each is a row of
that many numbers, which printed lines work on as one.
"""

# ruff: noqa: F401, F403, F405
# mypy: ignore-errors
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.compiler import compiler
from idm_env.compiled.kernels.emitted import inlined
from idm_env.compiled.kernels.functions import exp_float64 as exp, power_float64 as power, sigmoid_float64 as sigmoid
from idm_env.compiled.kernels.record_lanes import *

log1p, tanh = np.log1p, np.tanh
ROOM = 68
compiled = compiler()


@inlined
def constants(phi, p, th, k, c, flags):
    """Fill ``c`` with what depends on parameters alone."""
    # <constants>
    # </constants>


@inlined
def sense(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved):
    """Fill the past with what drivers could see now."""
    # <sense>
    # </sense>


@inlined
def beginning(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved):
    """Fill ``moved`` with memories at the beginning."""
    # <beginning>
    # </beginning>


@inlined
def wind(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved):
    """Fill ``memory`` with memories Δt later, on the record."""
    # <wind>
    # </wind>


@inlined
def respond(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved):
    """Fill ``memory`` with memories Δt later, ``moved`` with speed and acceleration after the step and displacement."""
    # <respond>
    # </respond>


@inlined
def look(signals, index, state, seen, many, t, per_dt):
    """Set the sample of now, and load the measurements there; up to the origin of a row also the driver's own motion.

    ``seen`` are the columns of others that somebody reads, so many.
    """
    sample = smaller(larger(index[ORIGIN] + t, index[FIRST]), index[LAST])
    index[SAMPLE] = sample
    if t <= 0:
        state[POSITION] = column(signals, sample, MEASURED_POSITION)
        state[SPEED] = column(signals, sample, MEASURED_SPEED)
        state[OFFSET] = column(signals, sample, MEASURED_PLACE) - state[POSITION]
    state[GAP] = column(signals, sample, MEASURED_REAR) - state[POSITION]
    state[LEAD_SPEED] = column(signals, sample, MEASURED_LEAD_SPEED)
    state[LEAD_ACCEL] = column(signals, sample, MEASURED_LEAD_ACCEL)
    state[STEP] = column(signals, sample, MEASURED_TIME) * per_dt
    state[PLACE] = state[POSITION] + state[OFFSET]
    for j in range(many):
        state[COLUMN + seen[j]] = column(signals, sample, seen[j])


@inlined
def hold(signals, index, state, moved, t, until):
    """Load accelerations: measured ones up to step ``until`` and where a record begins, after that the drivers' own."""
    measured = column(signals, index[SAMPLE], MEASURED_ACCEL)
    state[ACCEL] = measured if index[ORIGIN] + t <= index[FIRST] else moved[ACCEL]
    if t <= until:
        state[ACCEL] = measured


@inlined
def advance(index, state, moved, t):
    """Move drivers on; where a record ends a driver keeps its last state."""
    goes_on = index[ORIGIN] + t < index[LAST]
    state[SPEED] = moved[SPEED] if goes_on else state[SPEED]
    state[POSITION] = state[POSITION] + (moved[DISPLACEMENT] if goes_on else 0.0)
    state[ACCEL] = moved[ACCEL]


@compiled
def march(
    signals, bounds, record, start, group, length, theta, phi, flags, used, seen, tables, back, dt, k, lead, steps,
    every, pulse, ends, order, settle, wound, gap_out, speed_out, begin, end,
):  # fmt: skip
    """Roll the tiles from ``begin`` to ``end`` out and fill ``gap_out`` and ``speed_out`` [copies, rows, samples].

    ``signals`` [samples, columns] holds all records, record r in rows ``bounds[r] : bounds[r + 1]``. Row i starts on
    its measured state at sample ``start[i]`` of ``record[i]`` and runs ``steps`` steps. In ``lead`` steps before that
    it is placed on the record and responds; memories begin there, or are ``wound`` already. ``theta``
    [copies, groups, P]; ``phi`` [copies · groups, …] and ``flags`` as a catalogue lays them out: what a step reads of φ
    is ``used``, of others in the record ``seen``; ``tables`` [tables, 3] is (form, number of knots, place in φ);
    ``back`` is how many steps of the past are kept; ``pulse`` [copies, 4] is (first step, end step, change, push), of
    which the last two are times the last column of ``signals``; ``k`` are constants that depend on dt. Every ``every``
    steps a sample is kept; rows in which a record ends keep their last state.

    Where there are ``ends``, ``wound`` [copies, rows, memories] is filled instead: a lane goes through a record from
    its beginning to ``start``, for rows ``order[ends[i] : ends[i + 1]]``, which begin at the samples ``settle`` [rows].
    """
    index, state = np.zeros((10, LANES), np.int64), np.zeros((COLUMN + signals.shape[1], LANES))
    th, p, c = np.empty((theta.shape[2], LANES)), np.zeros((phi.shape[1], LANES)), np.empty((CONSTANTS, LANES))
    memory, moved, winds = np.zeros((MEMORIES, LANES)), np.zeros((3 + MEMORIES, LANES)), len(ends) > 0
    ready = wound[:0] if winds else wound
    for tile in range(begin, end):
        seat(tile, index, state, p, th, record, start, group, length, bounds, theta, phi, used, ends)
        constants(phi, p, th, k, c, flags)
        begins = -index[SPAN, 1] if winds else -lead
        h = np.empty((steps + back - begins if back > 0 else 1, SIGNALS, LANES))
        for t in range(begins - back, steps):
            now = t - begins + back
            look(signals, index, state, seen, len(seen), t, 1.0 / dt)
            if len(pulse):
                push(signals, index, state, t, pulse)
            if back > 0:
                if t <= 0:
                    hold(signals, index, state, moved, t, max(-1, begins))
                sense(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved)
            if t < begins:
                continue
            if t <= 0:
                hold(signals, index, state, moved, t, 0 if winds else begins)
            if t <= max(begins, -index[SPAN, 0]):
                beginning(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved)
                remember(index, memory, moved, ready, t, begins)
            if winds:
                wind_up(index, memory, wound, t, ends, order, settle)
                wind(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved)
                continue
            respond(signals, index, now, state, h, phi, p, th, k, c, flags, tables, memory, moved)
            if t >= 0:
                advance(index, state, moved, t)
                if (t + 1) % every == 0:
                    keep(signals, index, state, t + 1, (t + 1) // every - 1, gap_out, speed_out)
