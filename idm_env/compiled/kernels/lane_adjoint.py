"""Compiled vector-Jacobian product of ``lane_loops.forward``: a tile recomputes a block of steps, then walks it back.

The states within a block live only in the workspace of a tile, so that the tape is one state per block of steps.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from idm_env.compiled.kernels import lane_loops, lane_loops as lane
from idm_env.compiled.kernels.compiler import apart
from idm_env.compiled.kernels.memory import add, copy, fill, number
from idm_env.compiled.kernels.phases import call
from idm_env.compiled.kernels.tiles import ROW, exact, load, padded, place, send_ahead, send_back, uniform, workspace


@apart
def send(w, n, size, measures, sends, phase):
    """Add what fell on neighbours' numbers to their adjoints; further than one vehicle it is handed on."""
    ring = measures[lane.IS_RING]
    for i in range(sends.shape[0]):
        if sends[i, 0] != phase:
            continue
        shift, source = sends[i, 1], sends[i, 2]
        for hop in range(abs(shift)):
            last = hop == abs(shift) - 1
            target = sends[i, 3] if last else measures[lane.SCRATCH] + (hop % 2) * ROW
            if not last:
                fill(w, target, 0, padded(n))
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
                back = int(number(w, ago + j, w))
                ah[((now - back) * signals + signal) * ROW + j] += number(w, on + j, w)


@apart
def step_back(w, h, pitch, ah, n, size, measures, phases, back, looks, recalls, sends, k, now, then):
    """Carry the adjoint of a tile back by one step, in place; the states are those before that step.

    ``now`` is the place of the step in the past at address ``h`` (see ``step``), ``then`` in its adjoint ``ah``.
    """
    m, signals = padded(n), measures[lane.SIGNALS]
    lane_loops.perceive(w, h, pitch, n, size, measures, phases, looks, recalls, k, now)
    if measures[lane.NUMBERS] + measures[lane.FLAGS]:
        lane_loops.look(w, n, size, measures, looks, lane.CLOSE)  # who comes or goes is an input of this step
    for phase in (lane.CLOSE, lane.RESPOND):
        call(back[phase], w, m, k)  # type: ignore[call-arg]
        send(w, n, size, measures, sends, phase)
    if phases[lane.SENSE]:
        give_back(w, ah, n, signals, recalls, then)
        for i in range(signals):
            copy(w, measures[lane.ON_SIGNAL_ROWS] + i * ROW, ah, (then * signals + i) * ROW, n)
        call(back[lane.SENSE], w, m, k)  # type: ignore[call-arg]
        send(w, n, size, measures, sends, lane.SENSE)


@exact
def recompute(
    w, h, tape, taped, operands, strides, k, begin_step, steps, slots, row, first, n, size, measures, phases, looks,
    recalls,
):  # fmt: skip
    """Run a block once more and put what the adjoint reads on the tape of the tile."""
    for t in range(steps):
        for i in range(len(taped)):
            copy(tape, (t * len(taped) + i) * ROW, w, measures[lane.STATE_ROWS] + taped[i] * ROW, n)
        # The last step's result is not needed, but what it senses is.
        if t + 1 < steps or phases[lane.SENSE]:
            if measures[lane.NUMBERS] + measures[lane.FLAGS]:
                lane_loops.load_inputs(w, operands, strides, begin_step + t, row, first, n, size, measures)
            lane_loops.step(w, h.ctypes.data, ROW, n, size, measures, phases, looks, recalls, k, slots + t)


@exact
def add_seeds(w, seeds, every, t, strides, row, first, n, size, measures, count):
    """Add the adjoints of what was kept of one step."""
    for i, target in enumerate((lane.ON_POSITION, lane.ON_SPEED, lane.ON_ACCEL, lane.ON_GAP)):
        source = seeds + (i * every + t) * count * w.itemsize
        load(w, measures[lane.SEEDED], source, strides, len(strides) - 1, 0, row, first, n, size, False)
        add(w, measures[target], w, measures[lane.SEEDED], n)


@exact
def backward(
    start, past, alike, slots, seeds, every, on_end, on_strides, on_begin, on_past_end, on_past, on_parameters, fresh,
    on_inputs, over, measures, phases, looks, recalls, back, sends, taped, again, operands, strides, k,
    begin_step, steps, rows, size, wide, around, begin, end,
):  # fmt: skip
    """Carry adjoints at the end of a block to its begin; store (``fresh``) or add what falls on the parameters.

    Addresses as in ``forward``: ``seeds`` (4, ``every`` steps, vehicles) are the adjoints of position, speed,
    acceleration and gap of every step, nothing where ``every`` is 0; ``on_end`` with its strides and ``on_begin`` are
    those of moving states, 0 for zeros and for what is not wanted; ``on_parameters`` (parameters, vehicles);
    ``on_inputs`` (inputs, ``over`` steps, vehicles).
    """
    signals = measures[lane.SIGNALS]
    w = workspace(measures[lane.N_ROWS] * ROW, k)
    h = workspace(((slots + steps) * signals + 1) * ROW, k)
    ah = workspace(((slots + steps) * signals + 1) * ROW, k)
    tape = workspace(len(taped) * steps * ROW, k)
    dense, count, is_ring = len(strides) - 1, rows * size, measures[lane.IS_RING] != 0
    many, has_inputs = (
        measures[lane.STATICS] + measures[lane.PARAMETERS],
        measures[lane.NUMBERS] + measures[lane.FLAGS] > 0,
    )
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        cell = row * size + first + skip
        if tile + 1 < end:
            following = place(tile + 1, rows, size, wide, around, is_ring)
            lane_loops.fetch_states(start, again, following, size, k)
            lane_loops.fetch_next(operands, strides[:many], following, size, k)
            lane_loops.fetch_next(on_end, on_strides, following, size, k)
        for i in again:
            load(w, measures[lane.STATE_ROWS] + i * ROW, start[i], strides, dense, 0, row, first, n, size, False)
        lane_loops.load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
        filled = max(filled, n)
        lane_loops.load_past(h, past, alike, 0, slots, signals, strides, row, first, n, size, count)
        if signals:
            fill(ah, 0, 0, len(ah))
            lane_loops.load_past(ah, on_past_end, False, steps, slots, signals, strides, row, first, n, size, count)
        recompute(
            w, h, tape, taped, operands, strides, k, begin_step, steps, slots, row, first, n, size, measures, phases,
            looks, recalls,
        )  # fmt: skip
        for i in range(measures[lane.MOVING]):
            if on_end[i]:
                load(w, measures[lane.ON_ROWS] + i * ROW, on_end[i], on_strides, i, 0, row, first, n, size, False)
            else:
                fill(w, measures[lane.ON_ROWS] + i * ROW, 0, n)
        fill(w, measures[lane.GRADIENT_ROWS], 0, (measures[lane.PARAMETERS] + measures[lane.HOISTS]) * ROW)
        for t in range(steps - 1, -1, -1):
            now = begin_step + t
            if every:
                add_seeds(w, seeds, every, now, strides, row, first, n, size, measures, count)
            for i in range(len(taped)):
                copy(w, measures[lane.STATE_ROWS] + taped[i] * ROW, tape, (t * len(taped) + i) * ROW, n)
            if has_inputs:
                lane_loops.load_inputs(w, operands, strides, now, row, first, n, size, measures)
            then = slots + t
            step_back(w, h.ctypes.data, ROW, ah, n, size, measures, phases, back, looks, recalls, sends, k, then, then)
            if over:
                for i in range(measures[lane.NUMBERS]):
                    to = (i * over + now) * count + cell
                    copy(on_inputs, to, w, measures[lane.ON_INPUT_ROWS] + i * ROW + skip, own)
        if back[lane.HOIST]:
            call(back[lane.HOIST], w, padded(n), k)  # type: ignore[call-arg]
        for i in range(measures[lane.MOVING]):
            if on_begin[i]:
                copy(on_begin[i], cell, w, measures[lane.ON_ROWS] + i * ROW + skip, own)
        lane_loops.store_past(ah, on_past, slots - 1, slots, signals, cell, skip, own, count)
        for i in range(measures[lane.PARAMETERS]):
            if fresh:
                copy(on_parameters, i * count + cell, w, measures[lane.GRADIENT_ROWS] + i * ROW + skip, own)
            else:
                add(on_parameters, i * count + cell, w, measures[lane.GRADIENT_ROWS] + i * ROW + skip, own)
