"""One step of worlds whose arrays are known by their addresses: what environments call again and again.

A rollout packs its arrays anew at every call and takes fresh memory for its tiles. Here both stay: a call hands over a
dozen arguments, so a single ring costs what its equations cost. The step is that of ``lane_loops``.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import numpy as np

from idm_env.kernels.lane_loops import (
    FLAGS,
    IS_RING,
    N_ROWS,
    NUMBERS,
    PARAMETERS,
    SIGNALS,
    STATE_ROWS,
    STATES,
    STATICS,
    fetch_next,
    fetch_states,
    load_inputs,
    load_static,
    step,
)
from idm_env.kernels.memory import copy
from idm_env.kernels.printed import TileKernel
from idm_env.kernels.tiles import ROW, Array, exact, load, place, workspace


@exact
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
    states, signals, is_ring = measures[STATES], measures[SIGNALS], measures[IS_RING] != 0
    dense, many = len(strides) - 1, measures[STATICS] + measures[PARAMETERS]
    operands, count, filled = places[2 * states :], rows * size, 0
    has_inputs, all_past = measures[NUMBERS] + measures[FLAGS] > 0, past.ctypes.data
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        if tile + 1 < end:
            following = place(tile + 1, rows, size, wide, around, is_ring)
            fetch_states(places, read, following, size, k)
            fetch_next(operands, strides[:many], following, size, k)
        for i in read:
            load(w, measures[STATE_ROWS] + i * ROW, places[i], strides, dense, 0, row, first, n, size, False)
        if not kept:
            load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
            filled = max(filled, n)
        if has_inputs:
            load_inputs(w, operands, strides, t, row, first, n, size, measures)
        at = row * size + first + skip
        if size <= wide:
            # Whole rows find their past where it lies: it is a hundred times as long as a state.
            step(w, all_past + at * k.itemsize, count, n, size, measures, phases, looks, recalls, k, newest + 1)
        else:
            for s in range(slots):
                for i in range(signals):
                    source = all_past + ((newest + 1 - slots + s) * signals + i) * count * k.itemsize
                    load(h, (s * signals + i) * ROW, source, strides, dense, 0, row, first, n, size, False)
            step(w, h.ctypes.data, ROW, n, size, measures, phases, looks, recalls, k, slots)
            for i in range(signals):
                copy(all_past, ((newest + 1) * signals + i) * count + at, h, (slots * signals + i) * ROW + skip, own)
        for i in range(states):
            copy(places[states + i], at, w, measures[STATE_ROWS] + i * ROW + skip, own)


def workspaces(kernel: TileKernel, slots: int, real: np.dtype[Any]) -> tuple[Array, Array]:
    """Return a workspace and a past for a tile of a kernel's."""
    rows, signals = kernel.measures[N_ROWS], kernel.measures[SIGNALS]
    like = np.empty(0, real)
    return workspace(rows * ROW, like), workspace(((slots + 1) * signals + 1) * ROW, like)
