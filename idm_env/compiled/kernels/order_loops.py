"""Compiled layout of several lanes as one row for a few steps: vehicles of each lane front first (``walk``).

Rows of ``n`` slots lie one behind the other. ``order`` holds slots, lane 0 first, absent vehicles last; lane k has the
ranks from ``begin[k]`` to ``begin[k + 1]``. On a ring a lane begins with whoever is furthest on his lap.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.compiler import apart
from idm_env.compiled.kernels.lane_change_loops import walk
from idm_env.compiled.kernels.tiles import exact


@apart
def lay(order, begin, n, count, halo, wide, base, to, slots, own, led, leads):
    """Lay one row of ``wide`` places out, from place ``to`` on: lanes behind one another, with copies at both ends.

    Who is absent is alone, and so are places to spare, which are copies of slot 0.
    """
    p = to
    for k in range(count):
        first, size = begin[k], begin[k + 1] - begin[k]
        if size == 0:
            continue
        for rank in range(-halo, size + halo):
            slots[p] = order[first + rank % size] if halo else order[first + rank]
            led[p] = rank > -halo
            leads[p] = rank < size + halo - 1
            if 0 <= rank < size:
                own[base + order[first + rank]] = p - to
            p += 1
    for r in range(begin[count], n):
        slots[p], led[p], leads[p], own[base + order[r]] = order[r], 0, 0, p - to
        p += 1
    while p < to + wide:
        slots[p], led[p], leads[p] = 0, 0, 0
        p += 1


@exact
def laid_by(order, begin, rows, n, count, halo, wide, slots, own, led, leads):
    """Lay all rows out by an order that is known: ``order`` (rows · n) and ``begin`` (rows · (count + 1))."""
    for row in range(rows):
        first, lanes = row * n, row * (count + 1)
        lay(
            order[first : first + n], begin[lanes : lanes + count + 1], n, count, halo, wide, first, row * wide, slots,
            own, led, leads,
        )  # fmt: skip


@exact
def laid(leader, follower, lane, position, present, coming, which, n, count, ring, halo, wide, slots, own, led, leads):
    """Lay some rows out by their links; False where links are not the order of positions."""
    order, begin, place = np.empty(n, np.int64), np.empty(count + 1, np.int64), np.empty(n)
    for row in which:
        if not walk(leader, follower, lane, position, present, coming, n, count, ring, row * n, order, begin, place):
            return False
        lay(order, begin, n, count, halo, wide, row * n, row * wide, slots, own, led, leads)
    return True
