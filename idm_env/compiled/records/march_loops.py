"""Loop over rows and time of discovery's rollout, without an equation: lines between marks are printed.

This file is a template (``march``). What is printed is walked once (``kernels.emitted``), when numba compiles the loop.
"""

# ruff: noqa: F401, F821
# mypy: ignore-errors
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.compiler import compiler
from idm_env.compiled.kernels.curves import curve
from idm_env.compiled.kernels.emitted import choose, inlined
from idm_env.compiled.kernels.functions import exp_float64 as exp, sigmoid_float64 as sigmoid

log1p, tanh = np.log1p, np.tanh
ROOM = 68
compiled = compiler()


@inlined()
def constants(p, th, k, c, flags):
    """Fill ``c`` with what depends on parameters alone."""
    # <constants>
    # </constants>


@inlined()
def sense(
    signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap, speed, accel, lead_speed,
    lead_accel, time, per_dt, place, pulse_now,
):  # fmt: skip
    """Fill the past with what drivers could see now."""
    # <sense>
    # </sense>


@inlined()
def beginning(
    signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap, speed, accel, lead_speed,
    lead_accel, time, per_dt, place, pulse_now,
):  # fmt: skip
    """Fill memories at the beginning."""
    # <beginning>
    # </beginning>


@inlined()
def wind(
    signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap, speed, accel, lead_speed,
    lead_accel, time, per_dt, place, pulse_now,
):  # fmt: skip
    """Fill ``moved`` with memories Δt later, on the record."""
    # <wind>
    # </wind>


@inlined(3)
def respond(
    signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap, speed, accel, lead_speed,
    lead_accel, time, per_dt, place, pulse_now,
):  # fmt: skip
    """Fill ``moved`` with memories Δt later; return displacement, speed and acceleration of the step."""
    # <respond>
    # </respond>
    return displacement, speed_after, accel_after


@compiled
def march(
    signals, bounds, record, start, steps, group, length, theta, phi, on, tables, back, whole, lead, every, dt, k,
    pulse, gap_out, speed_out,
):  # fmt: skip
    """Roll every row out in every copy and fill ``gap_out`` and ``speed_out`` [copies, rows, samples].

    ``signals`` [samples, columns] holds all records, record r in rows ``bounds[r] : bounds[r + 1]``. Row i starts on
    its measured state at sample ``start[i]`` of ``record[i]`` and runs ``steps`` steps. In ``lead`` steps before that
    it is placed on the record and responds; ``whole`` winds memories up from the record's beginning. ``theta``
    [copies, groups, P]; ``phi`` [copies, groups, …] and ``on`` [copies, flags] as a catalogue lays them out;
    ``tables`` [tables, 3] is (form, number of knots, place in φ); ``back`` is how many steps of the past are kept;
    ``pulse`` [copies, 3] is (first step, end step, amount), times the last column of ``signals``;
    ``k`` are constants that depend on dt. Every ``every`` steps a sample is kept; rows in which a record ends keep
    their last state.
    """
    rows, per_dt = len(record), 1.0 / dt
    longest = 0
    for r in range(len(bounds) - 1):
        longest = max(longest, bounds[r + 1] - bounds[r])
    h = np.empty((longest + 1 if back > 0 else 1, SIGNALS))
    c = np.empty(CONSTANTS)
    memory, kept_memory, moved = np.zeros(MEMORIES), np.zeros(MEMORIES), np.zeros(MEMORIES)
    for copy in range(theta.shape[0]):
        flags = on[copy]
        last, kept_at = -1, 0
        for row in range(rows):
            r = record[row]
            th, p = theta[copy, group[row]], phi[copy, group[row]]
            begin, end, origin, own_length = bounds[r], bounds[r + 1], start[row], length[r]
            offset = signals[origin, 18] - signals[origin, 14]
            constants(p, th, k, c, flags)
            # Up to ``settle`` only memories are wound up, and from there to the origin the whole step, on the record.
            settle = max(begin, origin - lead)
            going_on = whole and r == last and kept_at <= settle
            first = kept_at if going_on else begin if whole else settle
            for j in range(MEMORIES):
                memory[j] = kept_memory[j]
            last = r
            speed, position, accel = signals[first, 15], signals[first, 14], signals[first, 16]
            # Before ``first`` only the past is filled.
            i = first if going_on or back == 0 else max(begin, first - back)
            while i < origin + steps:
                if i + 1 >= end:
                    for j in range((i - origin) // every, steps // every):
                        gap_out[copy, row, j], speed_out[copy, row, j] = signals[end - 1, 0] - position, speed
                    break
                if i <= origin:
                    position, speed = signals[i, 14], signals[i, 15]
                    if i <= settle:
                        accel = signals[i, 16]
                now = i - begin
                lead_speed, lead_accel = signals[i, 1], signals[i, 2]
                gap = signals[i, 0] - position
                time = signals[i, 17]
                place = position + offset
                pulse_now = 0.0
                if i - origin >= pulse[copy, 0] and i - origin < pulse[copy, 1]:
                    pulse_now = pulse[copy, 2] * signals[i, 19]
                if back > 0:
                    carried = accel
                    if i < origin:
                        accel = signals[i, 16]
                    sense(
                        signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap,
                        speed, accel, lead_speed, lead_accel, time, per_dt, place, pulse_now,
                    )  # fmt: skip
                    accel = carried
                if i < first:
                    i += 1
                    continue
                if i == first and not going_on:
                    beginning(
                        signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap,
                        speed, accel, lead_speed, lead_accel, time, per_dt, place, pulse_now,
                    )  # fmt: skip
                if i < settle:
                    wind(
                        signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap,
                        speed, accel, lead_speed, lead_accel, time, per_dt, place, pulse_now,
                    )  # fmt: skip
                    for j in range(MEMORIES):
                        memory[j] = moved[j]
                    i += 1
                    continue
                if i == settle:
                    kept_at = i
                    for j in range(MEMORIES):
                        kept_memory[j] = memory[j]
                displacement, speed_after, accel_after = respond(
                    signals, h, p, th, k, c, flags, tables, memory, moved, i, now, position, own_length, gap, speed,
                    accel, lead_speed, lead_accel, time, per_dt, place, pulse_now,
                )  # fmt: skip
                for j in range(MEMORIES):
                    memory[j] = moved[j]
                accel = accel_after
                i += 1
                if i <= origin:
                    continue
                speed = speed_after
                position += displacement
                k_step = i - origin
                if k_step % every == 0:
                    gap_out[copy, row, k_step // every - 1] = signals[i, 0] - position
                    speed_out[copy, row, k_step // every - 1] = speed
