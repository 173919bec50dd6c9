"""One step of worlds whose arrays are known by their addresses: what environments call again and again.

A rollout packs its arrays anew at every call and takes fresh memory for its tiles. Here both stay: a call hands over a
dozen arguments, so a single ring costs what its equations cost. The step is that of ``lane_loops``.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray  # type: ignore[attr-defined]
from numba.core import types
from numba.extending import intrinsic

from idm_env.kernels.lane_loops import (
    BEFORE,
    FLAGS,
    HOIST,
    INPUT_ROWS,
    IS_RING,
    N_ROWS,
    NUMBERS,
    PARAMETERS,
    SIGNALS,
    STATE_ROWS,
    STATES,
    STATIC_ROWS,
    STATICS,
    load_past,
    look,
    step,
    store_past,
)
from idm_env.kernels.phases import call
from idm_env.kernels.prefetch import prefetch
from idm_env.kernels.printed import TileKernel
from idm_env.kernels.tiles import ROW, Array, exact, load, padded, place, repeats, store

LONG = 1 << 40
"""Elements that an array is said to have of which only the address is known."""


@intrinsic
def _pointer(typing_context: Any, address: Any) -> Any:
    """Return an address as a pointer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


@exact
def numbers(address, like):
    """Return what lies at an address as an array of the same type as ``like``."""
    return carray(_pointer(address), (LONG,), like.dtype)  # type: ignore[call-arg]


@exact
def bits(address):
    """Return what lies at an address as an array of truth values."""
    return carray(_pointer(address), (LONG,), np.uint8)  # type: ignore[call-arg]


@exact
def load_static(w, places, strides, row, first, n, size, again, measures, phases, looks, k):
    """As ``lane_loops.load_static``."""
    for i in range(measures[STATICS] + measures[PARAMETERS]):
        if not (again and repeats(strides[i], n, size)):
            source = numbers(places[2 * measures[STATES] + i], w)
            load(w, measures[STATIC_ROWS] + i * ROW, source, 0, strides[i], row, first, n, size)
    if phases[HOIST]:
        call(phases[HOIST], w, padded(n), k)  # type: ignore[call-arg]
    look(w, n, size, measures, looks, BEFORE)


@exact
def load_inputs(w, places, strides, t, row, first, n, size, measures):
    """As ``lane_loops.load_inputs``."""
    o = measures[STATICS] + measures[PARAMETERS]
    for i in range(measures[NUMBERS] + measures[FLAGS]):
        at, to = places[2 * measures[STATES] + o + i], measures[INPUT_ROWS] + i * ROW
        if i < measures[NUMBERS]:
            load(w, to, numbers(at, w), t, strides[o + i], row, first, n, size)
        else:
            load(w, to, bits(at), t, strides[o + i], row, first, n, size)


@exact
def fetch_next(w, places, states, many, strides, placed, size):
    """Start fetching the states and the dense parameters of the next tile."""
    row, first, n, _, _ = placed
    begin = row * size + first
    for i in range(states):
        prefetch(numbers(places[i], w), begin, n)
    for i in range(many):
        if strides[i][2] == 1 and strides[i][1] == size:
            prefetch(numbers(places[2 * states + i], w), begin, n)


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
    dense, many = strides[len(strides) - 1], measures[STATICS] + measures[PARAMETERS]
    filled = 0
    for tile in range(begin, end):
        row, first, n, skip, own = place(tile, rows, size, wide, around, is_ring)
        if tile + 1 < end:
            fetch_next(w, places, states, many, strides, place(tile + 1, rows, size, wide, around, is_ring), size)
        for i in read:
            load(w, measures[STATE_ROWS] + i * ROW, numbers(places[i], w), 0, dense, row, first, n, size)
        load_past(h, past, 0, slots, signals, dense, row, first, n, size)
        if not kept:
            load_static(w, places, strides, row, first, n, size, n <= filled, measures, phases, looks, k)
            filled = max(filled, n)
        load_inputs(w, places, strides, t, row, first, n, size, measures)
        step(w, h, n, size, measures, phases, looks, recalls, k, slots)
        at = row * size + first + skip
        for i in range(states):
            store(numbers(places[states + i], w), at, w, measures[STATE_ROWS] + i * ROW + skip, own)
        store_past(h, past_end, slots, slots, signals, at, skip, own)


def workspaces(kernel: TileKernel, slots: int, real: np.dtype[Any]) -> tuple[Array, Array]:
    """Return a workspace and a past for a tile of a kernel's."""
    rows, signals = kernel.measures[N_ROWS], kernel.measures[SIGNALS]
    return np.zeros(rows * ROW + 64, real), np.zeros(((slots + 1) * signals + 1) * ROW, real)
