"""Compiled loops of drivers behind records, without equations: drivers side by side in a tile, time inside.

Everybody else is a record, so a driver's step depends on nobody else's and a tile of drivers stays in cache for a whole
rollout. Phases are those of ``scalar/driver_text.py``, called through their addresses; ``plan`` is a ``Layout``.

Arrays: ``record`` (series, time, rows) is shared by all copies of the rows; ``start``, ``statics`` and whatever is
kept of a rollout have one entry per copy and row, copies outermost. ``past`` is (slots · signals, entries), newest
slot first. ``every`` steps one is a sample.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.memory import add, copy
from idm_env.compiled.kernels.phases import call, call_beside
from idm_env.compiled.kernels.tiles import exact, padded

TILE = 256
"""Most drivers per tile: the rows of a step stay in the first-level cache, those of all directions in the second."""

ROW = TILE + 16
"""Distance of two rows: not a power of two, or all rows would compete for the same cache sets."""

BLOCK = 64
"""Steps after which the window on the past is moved."""

HOIST, SENSE, RESPOND = range(3)
"""Places of the addresses of a step's phases, and of their adjoints."""

FIX, LINEARISE, CARRY_SENSE, CARRY = range(3, 7)
"""Places of the addresses of tangents."""


def tiles(rows: int, copies: int) -> int:
    """Return how many tiles hold ``copies`` of ``rows`` drivers."""
    if rows <= TILE:
        return -(-copies // (TILE // rows))
    return copies * -(-rows // TILE)


def width(rows: int, copies: int) -> int:
    """Return the distance of rows of the past: what the drivers of a tile need, in whole vectors, and one more."""
    most = TILE if rows > TILE else min(TILE // rows, copies) * rows
    return (most + 15) // 16 * 16 + 16


@exact
def place(tile, rows, copies):
    """Return first entry, first row, drivers, and how often the rows of the record repeat."""
    if rows <= TILE:
        several = TILE // rows
        first = tile * several
        many = min(several, copies - first)
        return first * rows, 0, many * rows, many
    pieces = -(-rows // TILE)
    copy, piece = tile // pieces, tile % pieces
    begin, end = rows * piece // pieces, rows * (piece + 1) // pieces
    return copy * rows + begin, begin, end - begin, 1


@exact
def clear_rows(w, at, rows, distance, n):
    """Zero rows of the workspace, or of the past."""
    for i in range(rows):
        target = w[at + i * distance :]
        for j in range(n):
            target[j] = 0


@exact
def begin_tile(w, plan, phases, start, statics, k, flat, n):
    """Load states and what holds for the rollout."""
    for i in range(plan.n_statics):
        copy(w, plan.statics + i * ROW, statics[i, flat:], 0, n)
    for i in range(plan.n_states):
        copy(w, plan.states + i * ROW, start[i, flat:], 0, n)
    if phases[HOIST]:
        call(phases[HOIST], w, padded(n), k)  # type: ignore[call-arg]


@exact
def load_record(w, plan, record, reads, t, row, n, repeats):
    """Load what records and inputs give at step ``t``."""
    many = n // repeats
    for i in range(plan.n_records):
        source = record[reads[i, 0], t + reads[i, 1], row:]
        for c in range(repeats):
            copy(w, plan.records + i * ROW + c * many, source, 0, many)


# -- the past ----------------------------------------------------------------------------------------------------


@exact
def load_past(h, past, slots, signals, flat, wide, n):
    """Fill the window before the first step."""
    for s in range(slots):
        for i in range(signals):
            copy(h, ((slots - 1 - s) * signals + i) * wide, past[s * signals + i, flat:], 0, n)


@exact
def turn(h, slots, signals, wide, n):
    """Move the window on the past a block ahead."""
    for i in range(slots * signals):
        copy(h, i * wide, h, (i + BLOCK * signals) * wide, n)


@exact
def turn_back(ah, slots, signals, wide, n):
    """Move what fell on the steps before a block to the end of the block before it."""
    for i in range(slots * signals - 1, -1, -1):
        copy(ah, (i + BLOCK * signals) * wide, ah, i * wide, n)
    clear_rows(ah, 0, BLOCK * signals, wide, n)


@exact
def uniform(w, plan, n):
    """Return, per time that somebody looks back, whether it is the same for all drivers of a tile."""
    same = np.ones(max(plan.n_agos, 1), np.bool_)
    for i in range(plan.n_agos):
        row = w[plan.agos + i * ROW :]
        for j in range(n):
            if row[j] != row[0]:
                same[i] = False
    return same


@exact
def look(target, to, h, w, plan, seen, same, signals, places, now, wide, n):
    """Fill rows with the past: ``places`` are (row, signal) of each, ``seen`` tells how long ago it was."""
    for i in range(places.shape[0]):
        begin, signal, ago = to + i * ROW, places[i, 1], seen[places[i, 0], 1]
        when = w[plan.agos + ago * ROW :]
        row = target[begin:]
        if same[ago]:
            source = h[((now - int(when[0])) * signals + signal) * wide :]
            for j in range(n):
                row[j] = source[j]
        else:
            for j in range(n):
                row[j] = h[((now - int(when[j])) * signals + signal) * wide + j]


@exact
def sense(w, h, plan, phases, k, now, wide, n):
    """Keep what drivers see now."""
    call(phases[SENSE], w, padded(n), k)  # type: ignore[call-arg]
    for i in range(plan.n_signals):
        copy(h, (now * plan.n_signals + i) * wide, w, plan.signals + i * ROW, n)


# -- values ------------------------------------------------------------------------------------------------------


@exact
def forward(
    start, past, statics, record, reads, seen, places, plan, phases, k, every, gap, speed, tape, taped,
    rows, copies, wide, steps, slots, begin, end,
):  # fmt: skip
    """Fill ``gap`` and ``speed`` (samples, entries), and the states before every step that ``taped`` names."""
    w = np.zeros(plan.size, k.dtype)
    h = np.zeros(((slots + BLOCK) * plan.n_signals + 1) * wide, k.dtype)
    for tile in range(begin, end):
        flat, row, n, repeats = place(tile, rows, copies)
        begin_tile(w, plan, phases, start, statics, k, flat, n)
        load_past(h, past, slots, plan.n_signals, flat, wide, n)
        same = uniform(w, plan, n)
        for t in range(steps):
            now = slots + t % BLOCK
            if t and t % BLOCK == 0:
                turn(h, slots, plan.n_signals, wide, n)
            load_record(w, plan, record, reads, t, row, n, repeats)
            for i in range(len(taped)):
                copy(tape[i, t, flat:], 0, w, plan.states + taped[i] * ROW, n)
            if phases[SENSE]:
                sense(w, h, plan, phases, k, now, wide, n)
                look(w, plan.past, h, w, plan, seen, same, plan.n_signals, places, now, wide, n)
            call(phases[RESPOND], w, padded(n), k)  # type: ignore[call-arg]
            if (t + 1) % every == 0:
                copy(gap[t // every, flat:], 0, w, plan.states, n)
                copy(speed[t // every, flat:], 0, w, plan.states + ROW, n)


# -- tangents ----------------------------------------------------------------------------------------------------


@exact
def carry(w, h, th, plan, phases, seen, same, places, moving, k, now, wide, n):
    """Carry the tangents of all directions over one step; the states are those before it."""
    m = padded(n)
    call(phases[LINEARISE], w, m, k)  # type: ignore[call-arg]
    many = plan.n_moving_signals
    size = len(th) // max(plan.n_blocks, 1)
    for p in range(plan.n_blocks):
        block = w[plan.blocks + p * plan.block :]
        if phases[CARRY_SENSE]:
            past = th[p * size :]
            call_beside(phases[CARRY_SENSE], w, block, m, k)  # type: ignore[call-arg]
            for i in range(many):
                copy(past, (now * many + i) * wide, block, plan.tangent_signals + i * ROW, n)
            look(block, plan.tangent_past, past, w, plan, seen, same, many, moving, now, wide, n)
        call_beside(phases[CARRY], w, block, m, k)  # type: ignore[call-arg]


@exact
def begin_tangents(w, th, plan, phases, start_by, k, slots, flat, wide, n):
    """Load tangents of the start, and clear those of the past."""
    clear_rows(w, plan.blocks, plan.n_blocks * plan.block // ROW, ROW, n)
    size = len(th) // max(plan.n_blocks, 1)
    for p in range(plan.n_blocks):
        clear_rows(th, p * size, slots * plan.n_moving_signals, wide, n)
    if start_by.shape[0]:
        for p in range(plan.n_blocks):
            for i in range(plan.n_moving):
                copy(w, plan.blocks + p * plan.block + i * ROW, start_by[p, i, flat:], 0, n)
    if phases[FIX]:
        call(phases[FIX], w, padded(n), k)  # type: ignore[call-arg]


@exact
def linear_step(w, h, th, plan, phases, seen, same, places, moving, record, reads, k, t, slots, row, wide, n, repeats):
    """Advance a tile and its tangents by one step."""
    now = slots + t % BLOCK
    if t and t % BLOCK == 0 and plan.n_signals:
        turn(h, slots, plan.n_signals, wide, n)
        size = len(th) // max(plan.n_blocks, 1)
        for p in range(plan.n_blocks):
            turn(th[p * size :], slots, plan.n_moving_signals, wide, n)
    load_record(w, plan, record, reads, t, row, n, repeats)
    if phases[SENSE]:
        sense(w, h, plan, phases, k, now, wide, n)
        look(w, plan.past, h, w, plan, seen, same, plan.n_signals, places, now, wide, n)
    carry(w, h, th, plan, phases, seen, same, places, moving, k, now, wide, n)
    call(phases[RESPOND], w, padded(n), k)  # type: ignore[call-arg]


@exact
def sensitivities(
    start, start_by, past, statics, record, reads, seen, places, moving, plan, phases, k, every,
    gap, speed, gap_by, speed_by, rows, copies, wide, steps, slots, begin, end,
):  # fmt: skip
    """As ``forward``, and fill ``gap_by`` and ``speed_by`` (samples, directions, entries)."""
    w = np.zeros(plan.size, k.dtype)
    h = np.zeros(((slots + BLOCK) * plan.n_signals + 1) * wide, k.dtype)
    th = np.zeros(plan.n_blocks * ((slots + BLOCK) * plan.n_moving_signals + 1) * wide, k.dtype)
    for tile in range(begin, end):
        flat, row, n, repeats = place(tile, rows, copies)
        begin_tile(w, plan, phases, start, statics, k, flat, n)
        begin_tangents(w, th, plan, phases, start_by, k, slots, flat, wide, n)
        load_past(h, past, slots, plan.n_signals, flat, wide, n)
        same = uniform(w, plan, n)
        for t in range(steps):
            linear_step(
                w, h, th, plan, phases, seen, same, places, moving, record, reads, k, t, slots, row, wide, n, repeats
            )
            if (t + 1) % every == 0:
                copy(gap[t // every, flat:], 0, w, plan.states, n)
                copy(speed[t // every, flat:], 0, w, plan.states + ROW, n)
                for p in range(plan.n_blocks):
                    copy(gap_by[t // every, p, flat:], 0, w, plan.blocks + p * plan.block, n)
                    copy(speed_by[t // every, p, flat:], 0, w, plan.blocks + p * plan.block + ROW, n)


@exact
def weigh(x, at, target, weight, scaled, square, cost, n):
    """Fill weighted residuals times weight, and squared weights; add the squared residuals to the cost."""
    value = x[at:]
    for j in range(n):
        residual = weight[j] * (value[j] - target[j])
        cost[j] += residual * residual
        scaled[j] = weight[j] * residual
        square[j] = weight[j] * weight[j]


@exact
def project(w, state, plan, scaled, square, part, gradient, normal, n):
    """Add one signal's part of Jᵀr and of JᵀJ (upper triangle)."""
    pair = 0
    for p in range(plan.n_blocks):
        tangent = w[plan.blocks + p * plan.block + state * ROW :]
        onto = gradient[p]
        for j in range(n):
            onto[j] += tangent[j] * scaled[j]
            part[j] = tangent[j] * square[j]
        for q in range(p, plan.n_blocks):
            other = w[plan.blocks + q * plan.block + state * ROW :]
            both = normal[pair]
            for j in range(n):
                both[j] += part[j] * other[j]
            pair += 1


@exact
def load_measured(row_of, source, row, n, repeats):
    """Load targets or weights of a sample, once per copy."""
    many = n // repeats
    for c in range(repeats):
        copy(row_of, c * many, source, row, many)


@exact
def normal_equations(
    start, start_by, past, statics, record, reads, seen, places, moving, plan, phases, k, every,
    targets, weights, counts, cost, gradient, normal, rows, copies, wide, steps, slots, begin, end,
):  # fmt: skip
    """Fill ``cost`` (entries), ``gradient`` (directions, entries) and ``normal`` (pairs, entries), storing no Jacobian.

    ``targets`` and ``weights`` are (gap and speed, samples, rows); ``counts`` says which of the two count.
    """
    w = np.zeros(plan.size, k.dtype)
    h = np.zeros(((slots + BLOCK) * plan.n_signals + 1) * wide, k.dtype)
    th = np.zeros(plan.n_blocks * ((slots + BLOCK) * plan.n_moving_signals + 1) * wide, k.dtype)
    x = np.zeros((6, ROW), k.dtype)
    target, weight, scaled, square, part, sums = x[0], x[1], x[2], x[3], x[4], x[5]
    pairs = plan.n_blocks * (plan.n_blocks + 1) // 2
    gradients, normals = np.zeros((plan.n_blocks, ROW), k.dtype), np.zeros((pairs, ROW), k.dtype)
    for tile in range(begin, end):
        flat, row, n, repeats = place(tile, rows, copies)
        begin_tile(w, plan, phases, start, statics, k, flat, n)
        begin_tangents(w, th, plan, phases, start_by, k, slots, flat, wide, n)
        load_past(h, past, slots, plan.n_signals, flat, wide, n)
        same = uniform(w, plan, n)
        sums[:] = 0
        gradients[:] = 0
        normals[:] = 0
        for t in range(steps):
            linear_step(
                w, h, th, plan, phases, seen, same, places, moving, record, reads, k, t, slots, row, wide, n, repeats
            )
            if (t + 1) % every == 0:
                for state in range(2):
                    if counts[state]:
                        load_measured(target, targets[state, t // every], row, n, repeats)
                        load_measured(weight, weights[state, t // every], row, n, repeats)
                        weigh(w, plan.states + state * ROW, target, weight, scaled, square, sums, n)
                        project(w, state, plan, scaled, square, part, gradients, normals, n)
        copy(cost, flat, sums, 0, n)
        for p in range(plan.n_blocks):
            copy(gradient[p, flat:], 0, gradients[p], 0, n)
        for q in range(pairs):
            copy(normal[q, flat:], 0, normals[q], 0, n)


# -- adjoint -----------------------------------------------------------------------------------------------------


@exact
def load_step(w, plan, tape, taped, record, reads, t, flat, row, n, repeats):
    """Load states before step ``t``, and the record."""
    for i in range(len(taped)):
        copy(w, plan.states + taped[i] * ROW, tape[i, t, flat:], 0, n)
    load_record(w, plan, record, reads, t, row, n, repeats)


@exact
def past_again(
    w, h, plan, phases, past, tape, taped, record, reads, k, first, last, slots, flat, row, wide, n, repeats
):
    """Fill the window on the past of the steps from ``first`` up to ``last``."""
    for t in range(first - slots, last):
        now = slots + t - first
        if t < 0:
            for i in range(plan.n_signals):
                copy(h, (now * plan.n_signals + i) * wide, past[(-t - 1) * plan.n_signals + i, flat:], 0, n)
        else:
            load_step(w, plan, tape, taped, record, reads, t, flat, row, n, repeats)
            sense(w, h, plan, phases, k, now, wide, n)


@exact
def fall(w, ah, plan, seen, same, places, now, wide, n):
    """Add what falls on the past."""
    for i in range(places.shape[0]):
        source = w[plan.on_past + i * ROW :]
        signal, ago = places[i, 1], seen[places[i, 0], 1]
        when = w[plan.agos + ago * ROW :]
        for j in range(n):
            ah[((now - int(when[j])) * plan.n_signals + signal) * wide + j] += source[j]


@exact
def begin_adjoint(w, ah, plan, wide, n):
    """Zero all adjoints."""
    clear_rows(w, plan.on_states, plan.n_moving, ROW, n)
    clear_rows(w, plan.on_parameters, plan.n_parameters, ROW, n)
    clear_rows(w, plan.on_hoisted, plan.n_hoisted, ROW, n)
    clear_rows(ah, 0, len(ah) // wide, wide, n)


@exact
def adjoint(
    start, past, statics, record, reads, seen, places, plan, phases, back, k, every, on_gap, on_speed, tape, taped,
    on_start, on_past, on_statics, rows, copies, wide, steps, slots, begin, end,
):  # fmt: skip
    """Carry adjoints of every sample's gap and speed back to start, past and parameters."""
    w = np.zeros(plan.size, k.dtype)
    signals = plan.n_signals
    h = np.zeros(((slots + BLOCK) * signals + 1) * wide, k.dtype)
    ah = np.zeros(((slots + BLOCK) * signals + 1) * wide, k.dtype)
    for tile in range(begin, end):
        flat, row, n, repeats = place(tile, rows, copies)
        m = padded(n)
        begin_tile(w, plan, phases, start, statics, k, flat, n)
        begin_adjoint(w, ah, plan, wide, n)
        same = uniform(w, plan, n)
        for first in range((steps - 1) // BLOCK * BLOCK, -1, -BLOCK):
            last = min(first + BLOCK, steps)
            if signals:
                past_again(
                    w, h, plan, phases, past, tape, taped, record, reads, k, first, last, slots, flat, row, wide, n,
                    repeats,
                )  # fmt: skip
            for t in range(last - 1, first - 1, -1):
                now = slots + t - first
                load_step(w, plan, tape, taped, record, reads, t, flat, row, n, repeats)
                if (t + 1) % every == 0:
                    if len(on_gap):
                        add(w, plan.on_states, on_gap[t // every, flat:], 0, n)
                    if len(on_speed):
                        add(w, plan.on_states + ROW, on_speed[t // every, flat:], 0, n)
                if signals:
                    look(w, plan.past, h, w, plan, seen, same, signals, places, now, wide, n)
                call(back[RESPOND], w, m, k)  # type: ignore[call-arg]
                if signals:
                    fall(w, ah, plan, seen, same, places, now, wide, n)
                    for i in range(signals):
                        copy(w, plan.on_signals + i * ROW, ah, (now * signals + i) * wide, n)
                    if back[SENSE]:  # what is seen of records alone has no adjoint
                        call(back[SENSE], w, m, k)  # type: ignore[call-arg]
            if signals and first:
                turn_back(ah, slots, signals, wide, n)
        if back[HOIST]:
            call(back[HOIST], w, m, k)  # type: ignore[call-arg]
        for i in range(plan.n_moving):
            copy(on_start[i, flat:], 0, w, plan.on_states + i * ROW, n)
        for s in range(slots):
            for i in range(signals):
                copy(on_past[s * signals + i, flat:], 0, ah, ((slots - 1 - s) * signals + i) * wide, n)
        for i in range(plan.n_parameters):
            copy(on_statics[i, flat:], 0, w, plan.on_parameters + i * ROW, n)
