"""One step of worlds whose arrays are known by their addresses, and its adjoint: what environments call.

A rollout packs its arrays anew at every call and takes fresh memory for its tiles. Here both stay: a call hands over a
dozen arguments, so a single ring costs what its equations cost. The step is that of ``lane_loops``; what a task says
before and after it are loops over rows (``rows.py``).
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import numpy as np

from idm_env.kernels import lane_loops as lane
from idm_env.kernels.compiler import apart
from idm_env.kernels.lane_adjoint import step_back
from idm_env.kernels.lane_loops import fetch_next, fetch_states, load_inputs, load_past, load_static, step, store_past
from idm_env.kernels.memory import add, copy, fill
from idm_env.kernels.phases import call, call_rows
from idm_env.kernels.printed import TileKernel
from idm_env.kernels.tiles import ROW, Array, exact, load, padded, place, workspace


@apart
def piece_of_past(h, past, newest, slots, signals, strides, row, first, n, size, count):
    """Fill the past of a piece of a long row, oldest step first."""
    for s in range(slots):
        for i in range(signals):
            source = past + ((newest + 1 - slots + s) * signals + i) * count * h.itemsize
            load(h, (s * signals + i) * ROW, source, strides, len(strides) - 1, 0, row, first, n, size, False)


@apart
def advance(
    places, strides, w, h, past, newest, measures, phases, looks, recalls, read, k, extent, t, kept, begin, end,
):  # fmt: skip
    """Do one step of tiles ``begin`` to ``end``.

    ``places`` are addresses: of the states now, of the states Δt later, and of the operands, numbers before truth
    values. ``past`` is (steps · signals, vehicles), oldest step first; the step before this one is at ``newest``, and
    this one comes behind it. ``w`` and ``h`` are the workspace and the past of a piece of a long row, ``extent`` is
    (slots of the past, rows, size, width of a tile, halo), ``t`` the step in operands that have time. ``kept`` says
    that the last call with this ``w`` was the same single tile with the same parameters.
    """
    slots, rows, size, wide, around = extent[0], extent[1], extent[2], extent[3], extent[4]
    states, signals, is_ring = measures[lane.STATES], measures[lane.SIGNALS], measures[lane.IS_RING] != 0
    dense, many = len(strides) - 1, measures[lane.STATICS] + measures[lane.PARAMETERS]
    operands, count, filled = places[2 * states :], rows * size, 0
    has_inputs, all_past = measures[lane.NUMBERS] + measures[lane.FLAGS] > 0, past.ctypes.data
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        if tile + 1 < end:
            following = place(tile + 1, rows, size, wide, around, is_ring)
            fetch_states(places, read, following, size, k)
            fetch_next(operands, strides[:many], following, size, k)
        for i in read:
            load(w, measures[lane.STATE_ROWS] + i * ROW, places[i], strides, dense, 0, row, first, n, size, False)
        if not kept:
            load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
            filled = max(filled, n)
        if has_inputs:
            load_inputs(w, operands, strides, t, row, first, n, size, measures)
        cell = row * size + first + skip
        if size <= wide:
            # Whole rows find their past where it lies: it is a hundred times as long as a state.
            source = np.int64(all_past + cell * k.itemsize)
            step(w, source, count, n, size, measures, phases, looks, recalls, k, newest + 1)
        else:
            piece_of_past(h, all_past, newest, slots, signals, strides, row, first, n, size, count)
            step(w, np.int64(h.ctypes.data), ROW, n, size, measures, phases, looks, recalls, k, slots)
            for i in range(signals):
                copy(all_past, ((newest + 1) * signals + i) * count + cell, h, (slots * signals + i) * ROW + skip, own)
        for i in range(states):
            copy(places[states + i], cell, w, measures[lane.STATE_ROWS] + i * ROW + skip, own)


@exact
def cut(extent, begin, end):
    """Return rows and tiles of a range of groups: the rows of a tile, or one row that several tiles share."""
    rows, size, wide, around = extent[1], extent[2], extent[3], extent[4]
    if size <= wide:
        several = wide // size
        return begin * several, min(end * several, rows), begin, end
    pieces = -(-size // (wide - 2 * around))
    return begin, end, begin * pieces, end * pieces


@exact
def step_worlds(
    before, asked, after, told, clock, later, places, strides, w, h, past, newest, measures, phases, looks, recalls,
    read, k, extent, t, kept, begin, end,
):  # fmt: skip
    """Do one whole step of groups of worlds: loops over rows with their tables, ``advance`` between them, clocks."""
    low, high, first, last = cut(extent, begin, end)
    call_rows(before, low, high, asked)  # type: ignore[call-arg]
    advance(
        places, strides, w, h, past, newest, measures, phases, looks, recalls, read, k, extent, t, kept, first, last
    )  # fmt: skip
    for i in range(low, high):
        later[i] = clock[i] + 1
    call_rows(after, low, high, told)  # type: ignore[call-arg]


@apart
def retreat(
    places, strides, w, h, ah, past, newest, on_end, on_begin, on_past_end, on_past, on_parameters, on_inputs,
    measures, phases, looks, recalls, back, sends, again, k, extent, t, kept, more, begin, end,
):  # fmt: skip
    """Carry adjoints at the end of a step to its begin, tile by tile; what falls on parameters is added.

    Arguments as of ``advance`` and of ``lane_adjoint.backward``: ``on_end`` and ``on_begin`` are addresses of dense
    adjoints of the moving states, ``on_past_end`` and ``on_past`` (slots · signals, vehicles), newest step first,
    ``on_parameters`` (parameters, vehicles), ``on_inputs`` (inputs, vehicles). ``ah`` is room for an adjoint past.
    ``kept`` says that the last call was that of the following step of the same single tile, and ``more`` that the next
    one will be that of the step before: what falls on parameters is added when all have been.
    """
    slots, rows, size, wide, around = extent
    states, signals, is_ring = measures[lane.STATES], measures[lane.SIGNALS], measures[lane.IS_RING] != 0
    dense, count = len(strides) - 1, rows * size
    operands, filled = places[2 * states :], 0
    has_inputs, all_past = measures[lane.NUMBERS] + measures[lane.FLAGS] > 0, past.ctypes.data
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        cell = row * size + first + skip
        for i in again:
            load(w, measures[lane.STATE_ROWS] + i * ROW, places[i], strides, dense, 0, row, first, n, size, False)
        if not kept:
            load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
            filled = max(filled, n)
            fill(w, measures[lane.GRADIENT_ROWS], 0, (measures[lane.PARAMETERS] + measures[lane.HOISTS]) * ROW)
        if has_inputs:
            load_inputs(w, operands, strides, t, row, first, n, size, measures)
        for i in range(measures[lane.MOVING]):
            load(w, measures[lane.ON_ROWS] + i * ROW, on_end[i], strides, dense, 0, row, first, n, size, False)
        if signals:
            fill(ah, 0, 0, len(ah))
            load_past(ah, on_past_end, False, 1, slots, signals, strides, row, first, n, size, count)
        if size <= wide:
            source, pitch, now = np.int64(all_past + cell * k.itemsize), count, newest + 1
        else:
            piece_of_past(h, all_past, newest, slots, signals, strides, row, first, n, size, count)
            source, pitch, now = np.int64(h.ctypes.data), ROW, slots
        step_back(w, source, pitch, ah, n, size, measures, phases, back, looks, recalls, sends, k, now, slots)
        for i in range(measures[lane.NUMBERS]):
            copy(on_inputs, i * count + cell, w, measures[lane.ON_INPUT_ROWS] + i * ROW + skip, own)
        if back[lane.HOIST] and not more:
            call(back[lane.HOIST], w, padded(n), k)  # type: ignore[call-arg]
        for i in range(measures[lane.MOVING]):
            copy(on_begin[i], cell, w, measures[lane.ON_ROWS] + i * ROW + skip, own)
        store_past(ah, on_past, slots - 1, slots, signals, cell, skip, own, count)
        for i in range(0 if more else measures[lane.PARAMETERS]):
            add(on_parameters, i * count + cell, w, measures[lane.GRADIENT_ROWS] + i * ROW + skip, own)


@exact
def retreat_worlds(
    after, told, before, asked, places, strides, w, h, ah, past, newest, on_end, on_begin, on_past_end, on_past,
    on_parameters, on_inputs, measures, phases, looks, recalls, back, sends, again, k, extent, t, kept, more, begin,
    end,
):  # fmt: skip
    """Do the adjoint of ``step_worlds``: ``after`` and ``before`` are now the adjoints of these loops."""
    low, high, first, last = cut(extent, begin, end)
    call_rows(after, low, high, told)  # type: ignore[call-arg]
    retreat(
        places, strides, w, h, ah, past, newest, on_end, on_begin, on_past_end, on_past, on_parameters, on_inputs,
        measures, phases, looks, recalls, back, sends, again, k, extent, t, kept, more, first, last,
    )  # fmt: skip
    call_rows(before, low, high, asked)  # type: ignore[call-arg]


def workspaces(kernel: TileKernel, slots: int, real: np.dtype[Any]) -> tuple[Array, Array]:
    """Return a workspace and a past for a tile of a kernel's."""
    rows, signals = kernel.measures[lane.N_ROWS], kernel.measures[lane.SIGNALS]
    like = np.empty(0, real)
    return workspace(rows * ROW, like), workspace(((slots + 1) * signals + 1) * ROW, like)
