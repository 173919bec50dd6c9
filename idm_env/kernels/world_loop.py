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
    load_past,
    load_static,
    step,
    store_past,
)
from idm_env.kernels.memory import copy
from idm_env.kernels.printed import TileKernel
from idm_env.kernels.tiles import ROW, Array, exact, load, place, workspace


@exact
def advance(
    places, strides, w, h, past, past_end, measures, phases, looks, recalls, read, k, extent, t, kept, begin, end,
):  # fmt: skip
    """Do one step of tiles ``begin`` to ``end``.

    ``places`` are addresses: of the states now, of the states Δt later, and of the operands, numbers before truth
    values. ``w`` and ``h`` are the workspace and the past of a tile, ``extent`` is
    (slots of the past, rows, size, width of a tile, halo), ``t`` the step in operands that have time. ``kept`` says
    that the last call with this ``w`` was the same single tile with the same parameters.
    """
    slots, rows, size, wide, around = extent[0], extent[1], extent[2], extent[3], extent[4]
    states, signals, is_ring = measures[STATES], measures[SIGNALS], measures[IS_RING] != 0
    dense, many = len(strides) - 1, measures[STATICS] + measures[PARAMETERS]
    operands, count, filled = places[2 * states :], rows * size, 0
    has_inputs = measures[NUMBERS] + measures[FLAGS] > 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        if tile + 1 < end:
            following = place(tile + 1, rows, size, wide, around, is_ring)
            fetch_states(places, read, following, size, k)
            fetch_next(operands, strides[:many], following, size, k)
        for i in read:
            load(w, measures[STATE_ROWS] + i * ROW, places[i], strides, dense, 0, row, first, n, size, False)
        load_past(h, past.ctypes.data, False, 0, slots, signals, strides, row, first, n, size, count)
        if not kept:
            load_static(w, operands, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
            filled = max(filled, n)
        if has_inputs:
            load_inputs(w, operands, strides, t, row, first, n, size, measures)
        step(w, h, n, size, measures, phases, looks, recalls, k, slots)
        at = row * size + first + skip
        for i in range(states):
            copy(places[states + i], at, w, measures[STATE_ROWS] + i * ROW + skip, own)
        store_past(h, past_end.ctypes.data, slots, slots, signals, at, skip, own, count)


def workspaces(kernel: TileKernel, slots: int, real: np.dtype[Any]) -> tuple[Array, Array]:
    """Return a workspace and a past for a tile of a kernel's."""
    rows, signals = kernel.measures[N_ROWS], kernel.measures[SIGNALS]
    like = np.empty(0, real)
    return workspace(rows * ROW, like), workspace(((slots + 1) * signals + 1) * ROW, like)
