"""Tiles of lanes and rings: which vehicles one holds, and how the rows of its workspace are filled.

Batch rows of ``size`` vehicles lie one behind the other in memory. Short rows share a tile, whole. A row longer than a
tile is cut, and each piece carries a halo: over some steps a vehicle feels nobody further ahead (and an adjoint nobody
further behind) than a step reaches, times the steps, so a piece computes that many neighbours once more and needs no
exchange while it stays in cache.

A workspace ``w`` is one flat array of rows that lie ``ROW`` apart. Printed phases run over rows at distances that the
compiler knows, so it need not test dozens of arrays for overlap, which it refuses to do and then emits scalar code.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from idm_env.extras import needed

with needed("a compiled loop"):
    from idm_env.compiled.kernels.compiler import apart, compiler

from idm_env.compiled.kernels.memory import LINE, add, copy, copy_truth, fill, number

Array = NDArray[Any]

exact = compiler()
"""Compiler for whatever yields values: IEEE arithmetic as written, so values do not depend on the loop around them."""

TILE = 1024
"""Most vehicles per tile: some forty rows of 4 kB and the states of a time block stay in the second-level cache."""

NARROW = 256
"""Vehicles per tile where a past is kept, which has hundreds of rows: they should stay in the second-level cache."""

ROW = TILE + 16
"""Distance of two rows: not a power of two, or all rows would compete for the same cache sets."""


def width(size: int, slots: int) -> int:
    """Return how many vehicles a tile should hold, where batch rows have ``size`` and the past ``slots`` steps."""
    return NARROW if slots and size <= NARROW else TILE


def halo(steps: int, reach: int) -> int:
    """Return how many neighbours on either side a piece of a long row computes once more."""
    return reach * steps + 1 + (reach > 1)


def tiles(rows: int, size: int, wide: int, around: int) -> int:
    """Return how many tiles hold ``rows`` batch rows of ``size`` vehicles, with a halo of ``around`` where cut."""
    if size <= wide:
        return -(-rows // (wide // size))
    return rows * -(-size // (wide - 2 * around))


@exact
def place(tile, rows, size, wide, around, is_ring):
    """Return first batch row, first vehicle (negative: round the ring), vehicles, and of these: skipped, own."""
    if size <= wide:
        several = wide // size
        row = tile * several
        n = min(several, rows - row) * size
        return row, 0, n, 0, n
    span = wide - 2 * around
    pieces = -(-size // span)
    row, begin = tile // pieces, tile % pieces * span
    own = min(span, size - begin)
    head, tail = around, around
    if not is_ring:
        head, tail = min(head, begin), min(tail, size - begin - own)
    return row, begin - head, head + own + tail, head, own


# -- neighbours --------------------------------------------------------------------------------------------------


@exact
def look_ahead(w, to, source, n, size, is_ring):
    """Copy each leader's value to row ``to``; entries without a leader are undefined (masked by ``led``)."""
    w[to] = w[source]
    copy(w, to + 1, w, source, n - 1)
    if is_ring and n >= size:
        for j in range(0, n, size):
            w[to + j] = w[source + j + size - 1]


@exact
def look_back(w, to, source, n, size, is_ring):
    """Fill row ``to`` with each follower's value; whoever has no follower gets what he will not read."""
    copy(w, to, w, source + 1, n - 1)
    w[to + n - 1] = w[source + n - 1]
    if is_ring and n >= size:
        for j in range(0, n, size):
            w[to + j + size - 1] = w[source + j]


@exact
def send_ahead(w, to, source, n, size, is_ring):
    """Add to row ``to`` what each follower sends to his leader: adjoint of looking ahead."""
    if not (is_ring and n >= size):
        add(w, to, w, source + 1, n - 1)
        return
    for j in range(0, n, size):
        add(w, to + j, w, source + j + 1, size - 1)
        w[to + j + size - 1] += w[source + j]


@exact
def send_back(w, to, source, n, size, is_ring):
    """Add to row ``to`` what each leader sends to his follower: adjoint of looking back."""
    if not (is_ring and n >= size):
        add(w, to + 1, w, source, n - 1)
        return
    for j in range(0, n, size):
        add(w, to + j + 1, w, source + j, size - 1)
        w[to + j] += w[source + j + size - 1]


# -- memory ------------------------------------------------------------------------------------------------------


@exact
def padded(n):
    """Return ``n`` rounded up to whole vectors: loops over a workspace then leave no scalar remainder.

    What they compute beyond ``n`` is never read.
    """
    return (n + 15) // 16 * 16


@exact
def workspace(size, like):
    """Return zeros that begin on a cache line: a vector of 64 bytes that straddles two costs two accesses."""
    buffer = np.zeros(size + LINE, like.dtype)
    skip = -(buffer.ctypes.data // like.itemsize) % (LINE // like.itemsize)
    return buffer[skip : skip + size]


@exact
def _fetch(w, to, source, begin, n, truth):
    if truth:
        copy_truth(w, to, source, begin, n)
    else:
        copy(w, to, source, begin, n)


@apart
def load(w, to, source, strides, which, t, row, first, n, size, truth):
    """Fill a workspace row from an address, whose strides by step, row and vehicle are ``strides[which]``.

    ``t`` is the step; ``truth`` says that truth values are there, a byte each.
    """
    by_row, by_vehicle = strides[which, 1], strides[which, 2]
    base = t * strides[which, 0] + row * by_row
    if by_vehicle == 0 and (by_row == 0 or n <= size):
        _fetch(w, to, source, base, 1, truth)
        fill(w, to, w[to], n)
    elif n > size or (first == 0 and n == size):
        if by_row == size and by_vehicle == 1:
            _fetch(w, to, source, base, n, truth)
            return
        for left in range(0, n, size):
            if by_vehicle == 0:
                _fetch(w, to + left, source, base, 1, truth)
                fill(w, to + left, w[to + left], size)
            else:
                _fetch(w, to + left, source, base, size, truth)
            base += by_row
    else:
        # A piece of one row, which may reach round a ring at either end.
        low, high = max(0, -first), min(n, size - first)
        if low > 0:
            _fetch(w, to, source, base + size + first, low, truth)
        _fetch(w, to + low, source, base + first + low, high - low, truth)
        if high < n:
            _fetch(w, to + high, source, base + first + high - size, n - high, truth)


@exact
def repeats(strides, which, n, size):
    """Whether every tile holds the same values: whole rows, and all rows alike."""
    return strides[which, 1] == 0 and (n >= size or strides[which, 2] == 0)


@exact
def uniform(w, row, n):
    """Whether all values of a workspace row are the same."""
    others, first = 0, w[row]
    for j in range(n):
        others += number(w, row + j, w) != first
    return others == 0
