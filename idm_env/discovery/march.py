"""The compiled twin of the simulator for one driver behind a record: every effect of the catalogue in one loop.

Discovery rolls out the same records some thousand times with small changes of parameters, so the step is compiled
(numba) and runs row after row. It is a second source of the mathematics of ``Simulator.step`` with
``integration="midpoint"``; a parity test holds every effect to the first. A parameter at its null costs one
comparison.

Parameters of a row are a flat vector φ, laid out by ``INDEX``; behind them come ``SLOTS`` curves of ``ROOM`` numbers,
each ``[first knot or begin, distance of knots or end, edge, period, values …]``.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numba
import numpy as np

NAMES = (
    "delay.delay", "lag.lag", "second_leader.weight", "leader_acceleration.gain", "brake_light.gain",
    "asymmetry.strength", "power_limit.power", "drag.coefficient", "speed_dependent_gap.extra_gap", "memory.strength",
    "memory.memory_time", "follower.gain", "dead_zone.threshold", "action_point.threshold", "speed_zone.factor",
    "speed_zone.begin", "speed_zone.end", "regime_shift.strength", "regime_shift.time", "lateral.gain",
    "gap_bias.bias",
)  # fmt: skip
INDEX = {name: i for i, name in enumerate(NAMES)}
NULL = np.array(
    [0, 0, 0, 0, 0, 0, 1e5, 0, 0, 0, 60, 0, 0, 0, 1, 0, 1, 0, 0, 0, 0] + [0.0] * 3
)  # fmt: skip
SLOTS, ROOM, FIRST = 4, 68, 24
SIZE = FIRST + SLOTS * ROOM

COLUMNS = (
    "lead_rear", "lead_speed", "lead_accel", "second_rear", "second_speed", "second_accel", "second_present",
    "behind_front", "behind_speed", "behind_accel", "behind_present", "beside_distance", "beside_speed",
    "beside_present", "position", "speed", "accel", "time", "place",
)  # fmt: skip
WHATS = ("acceleration", "time_gap", "desired_speed", "max_accel", "comfort_decel", "accel_and_decel", "slope", "share")
"""What a curve changes: adds to the acceleration, multiplies a parameter by 1 + curve, or is the slope of the road.

``share`` is the slope times the value in the last room: a known profile of which some share acts.
"""
COORDINATES = ("position", "time", "speed", "gap", "closing_speed", "lead_accel")
NONE, CURVE, INTERVAL = 0, 1, 2

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def empty(copies: int, groups: int) -> np.ndarray:
    """Return φ at its null for every copy and group, [copies, groups, SIZE]."""
    phi = np.zeros((copies, groups, SIZE))
    phi[:, :, :FIRST] = NULL
    return phi


@compiled
def _curve(phi, at, form, count, x):
    """Piecewise linear through evenly spaced knots (periodic where a period is given), or a trapezoid."""
    period = phi[at + 3]
    if period > 0.0:
        x = x - period * np.floor(x / period)
    if form == 2:
        begin, end, edge, amount = phi[at], phi[at + 1], phi[at + 2], phi[at + 4]
        up = min(max((x - begin + edge) / (2.0 * edge), 0.0), 1.0)
        down = min(max((end + edge - x) / (2.0 * edge), 0.0), 1.0)
        return amount * min(up, down)
    position = (x - phi[at]) / phi[at + 1]
    if period > 0.0:
        position = position - count * np.floor(position / count)
        low = int(position)
        share = position - low
        return (1.0 - share) * phi[at + 4 + low % count] + share * phi[at + 4 + (low + 1) % count]
    position = min(max(position, 0.0), count - 1.0)
    low = min(int(position), count - 2)
    share = position - low
    return (1.0 - share) * phi[at + 4 + low] + share * phi[at + 5 + low]


@compiled
def _interaction(s0, time_gap, brake, extra, speed, gap, lead_speed):
    dynamic = speed * (time_gap + (speed - lead_speed) / brake)
    wanted = s0 + max(dynamic, 0.0) + extra
    safe = max(gap, 0.1)
    return wanted * wanted * (1.0 / (safe * safe) + max(0.1 - gap, 0.0) * 2000.0)


@compiled
def _logistic(x):
    return 1.0 / (1.0 + np.exp(-x))


@compiled
def _averages(signals, begin, end, tau, dt, out):
    """Fill ``out`` with the exponential average of the measured speed from the record's beginning."""
    keep = np.exp(-dt / tau)
    level = signals[begin, 15]
    for i in range(begin, end):
        out[i - begin] = level
        level = keep * level + (1.0 - keep) * signals[i, 15]


@compiled
def march(
    signals, bounds, record, start, steps, group, length, theta, phi, slots, lead, every, dt,
    pulse, gap_out, speed_out,
):  # fmt: skip
    """Roll every row out in every copy and fill ``gap_out`` and ``speed_out`` [copies, rows, samples].

    ``signals`` [samples, columns] holds all records, record r in rows ``bounds[r] : bounds[r + 1]``. Row i starts on
    its measured state at sample ``start[i]`` of ``record[i]`` and runs ``steps`` steps; ``lead`` steps before that,
    in which it is placed on the record, wind up what has a memory. ``theta`` [copies, groups, 5] is (a, b, T, s0, v0);
    ``phi`` [copies, groups, SIZE]; ``slots`` [SLOTS, 4] is (form, what, coordinate, number of knots). ``pulse``
    [copies, 4] is (what + 1 or 0, first step, end step, amount). Every ``every`` steps a sample is kept; the rows that
    a record ends in keep their last state.
    """
    rows = len(record)
    history = np.empty((steps + 1, 8))
    longest = 0
    for r in range(len(bounds) - 1):
        longest = max(longest, bounds[r + 1] - bounds[r])
    average = np.empty(longest)
    for c in range(theta.shape[0]):
        last = -1
        for i in range(rows):
            r = record[i]
            g = group[i]
            p = phi[c, g]
            if p[9] != 0.0 and r != last:
                _averages(signals, bounds[r], bounds[r + 1], p[10], dt, average)
                last = r
            _row(
                signals, bounds[r], bounds[r + 1], start[i], steps, length[r], theta[c, g], p, slots, lead, every, dt,
                pulse[c], average, history, gap_out[c, i], speed_out[c, i],
            )  # fmt: skip


@compiled
def _ahead(signals, i, x, v, accel, length, half, out):
    """Fill ``out`` with the scene of sample i half a step ahead, as ``simulator.half_ahead`` does."""
    quarter = 0.5 * half
    out[0] = max(v + half * accel, 0.0)
    out[1] = signals[i, 0] - x + half * ((signals[i, 1] - v) + quarter * (signals[i, 2] - accel))
    out[2] = max(signals[i, 1] + half * signals[i, 2], 0.0)
    out[3] = signals[i, 2]
    out[4] = signals[i, 3] - x + half * ((signals[i, 4] - v) + quarter * (signals[i, 5] - accel))
    out[5] = max(signals[i, 4] + half * signals[i, 5], 0.0)
    out[6] = x - length - signals[i, 7] - half * ((signals[i, 8] - v) + quarter * (signals[i, 9] - accel))
    out[7] = max(signals[i, 8] + half * signals[i, 9], 0.0)


@compiled
def _row(
    signals, begin, end, origin, steps, length, theta, p, slots, lead, every, dt, pulse, average, history, gap_out,
    speed_out,
):  # fmt: skip
    a0, b0, time_gap0, s0, v00 = theta[0], theta[1], theta[2], theta[3], theta[4]
    tau, lag = p[0], p[1]
    whole = int(np.floor(tau / dt + 1e-12))
    share = tau / dt - whole
    half = 0.5 * dt
    first = max(begin - origin, -lead)
    x, v = signals[origin + first, 14], signals[origin + first, 15]
    accel = signals[origin + first, 16]
    offset = signals[origin, 18] - signals[origin, 14]
    level = average[origin + first - begin] / v00 if p[9] != 0.0 else 0.0
    keep = np.exp(-dt / p[10])
    seen, then = np.empty(8), np.empty(8)
    for k in range(first, steps):
        i = origin + k
        if i + 1 >= end:
            for j in range(k // every, steps // every):
                gap_out[j], speed_out[j] = signals[end - 1, 0] - x, v
            return
        if k <= 0:
            x, v = signals[i, 14], signals[i, 15]
        # The scene half a step ahead: own speed, gap, speed and acceleration of the leader, gap and speed of the second
        # leader, gap and speed of the vehicle behind; then what the driver sees of it.
        _ahead(signals, i, x, v, accel, length, half, seen)
        true_speed, pull = seen[0], seen[3]
        if tau > 0.0:
            if k >= 0:
                history[k] = seen
            for q in range(8):
                seen[q] = 0.0
            for side in range(2):
                weight = 1.0 - share if side == 0 else share
                past = k - whole - side
                if past >= 0:
                    for q in range(8):
                        seen[q] += weight * history[past, q]
                else:
                    j = max(origin + past, begin)
                    _ahead(signals, j, signals[j, 14], signals[j, 15], signals[j, 16], length, half, then)
                    for q in range(8):
                        seen[q] += weight * then[q]
        if p[12] > 0.0:
            closing = seen[0] - seen[2]
            near = max(seen[1], 0.1)
            ratio = p[12] / max(1.8 * abs(closing) / (near * near), 1e-7)
            square = ratio * ratio
            square *= square
            seen[2] += (1.0 - 1.0 / (1.0 + square * square)) * closing
        seen[1] += p[20]
        sv, sg, sl = seen[0], seen[1], seen[2]
        closing = sv - sl
        # The driver in force.
        place, time = x + offset, signals[i, 17]
        headway, a, b, v0, extra, added = time_gap0, a0, b0, v00, 0.0, 0.0
        if p[9] != 0.0:
            headway *= 1.0 + p[9] * (1.0 - level)
        if p[14] != 1.0:
            inside = _logistic((place - p[15]) / 5.0) * _logistic((p[16] - place) / 5.0)
            v0 *= 1.0 + (p[14] - 1.0) * inside
        if p[17] != 0.0:
            headway *= 1.0 + p[17] * _logistic((time - p[18]) / 0.5)
        for s in range(slots.shape[0]):
            form = slots[s, 0]
            if form == 0:
                continue
            coordinate = slots[s, 2]
            at = 24 + 68 * s
            if coordinate == 0:
                z = place
            elif coordinate == 1:
                z = time
            elif coordinate == 2:
                z = sv
            elif coordinate == 3:
                z = sg
            elif coordinate == 4:
                z = closing
            else:
                z = seen[3]
            value = _curve(p, at, form, slots[s, 3], z)
            what = slots[s, 1]
            if what == 0:
                added += value
            elif what == 1:
                headway *= 1.0 + value
            elif what == 2:
                v0 *= 1.0 + value
            elif what == 3:
                a *= 1.0 + value
            elif what == 4:
                b *= 1.0 + value
            elif what == 5:
                a *= 1.0 + value
                b *= 1.0 + value
            elif what == 6:
                added -= 9.81 * value / np.sqrt(1.0 + value * value)
            else:
                added -= 9.81 * p[at + 67] * value / np.sqrt(1.0 + value * value)
        if pulse[0] > 0.0 and k >= pulse[1] and k < pulse[2]:
            what = int(pulse[0]) - 1
            if what == 0:
                added += pulse[3]
            elif what == 1:
                headway *= 1.0 + pulse[3]
            elif what == 2:
                v0 *= 1.0 + pulse[3]
            else:
                a *= 1.0 + pulse[3]
                b *= 1.0 + pulse[3]
        if p[8] != 0.0:
            ratio = sv / v0
            extra = p[8] * (np.sqrt(max(ratio, 1e-3)) - max(1e-3 - ratio, 0.0) / np.sqrt(1e-3))
        # What he wants.
        brake = 2.0 * np.sqrt(a * b)
        free = sv / v0
        free *= free
        term = _interaction(s0, headway, brake, extra, sv, sg, sl)
        want = a * (1.0 - free * free - term) + added
        if p[2] != 0.0 and signals[i, 6] > 0.0:
            want += a * p[2] * (term - _interaction(s0, headway, brake, extra, sv, 0.5 * seen[4], seen[5]))
        want += p[3] * pull + p[4] * min(seen[3], 0.0)
        if p[11] != 0.0 and signals[i, 10] > 0.0:
            pressure = (s0 + sv * headway) / max(seen[6], 0.1)
            want += p[11] * a * min(pressure * pressure, 4.0)
        if p[19] != 0.0:
            want -= p[19] * max(sv - signals[i, 12], 0.0) * np.exp(-abs(signals[i, 11]) / 25.0) * signals[i, 13]
        want -= p[7] * true_speed * true_speed
        # What the vehicle does.
        want -= p[5] * abs(want)
        if p[13] > 0.0 and abs(want - accel) < p[13]:
            want = accel
        want = min(want, p[6] / max(true_speed, 0.1))
        want += (accel - want) * (lag / (lag + dt))
        above = max(want + 9.0, 0.0)
        part = min(above, 0.1)
        want = -9.0 + part * part * (0.2 - part) * 100.0 + (above - part)
        if p[9] != 0.0:
            level += (true_speed / v0 - level) * (1.0 - keep)
        after = v + want * dt
        if k < 0:
            accel = want
            continue
        if after < 0.0:
            x += 0.5 * v * v / -want
            accel = -v / dt
            v = 0.0
        else:
            x += half * (v + after)
            accel = want
            v = after
        if (k + 1) % every == 0:
            gap_out[(k + 1) // every - 1] = signals[i + 1, 0] - x
            speed_out[(k + 1) // every - 1] = v
