"""Several lanes as rows of lanes behind one another, for one step of ``world_loop`` and its adjoint.

What belongs to vehicles lies in their slots; a kernel wants it in the order of their lanes (``roads.chains``). Here it
is copied there and back. ``slots`` (rows · wide) are the slots of all places, ``own`` (rows · n) the places
of all slots.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.extras import needed
from idm_env.kernels.compiler import apart
from idm_env.kernels.memory import located
from idm_env.kernels.order_loops import lay, sort, walk
from idm_env.kernels.phases import call_rows
from idm_env.kernels.tiles import exact
from idm_env.kernels.world_loop import advance, cut, retreat

with needed("a compiled loop"):
    from numba import carray  # type: ignore[attr-defined]

SIZE = (1 << 40,)
BYTE = np.empty(0, np.uint8)


@exact
def each_row(loops, rows, table):
    """Call loops over single rows."""
    for row in rows:
        call_rows(loops, row, row + 1, table)  # type: ignore[call-arg]


@exact
def all_rows(loops, rows, table):
    """Call loops over the first rows."""
    call_rows(loops, 0, rows, table)  # type: ignore[call-arg]


@exact
def mark_led(rows, n, leader, follower, led, leads):
    """Write who has a leader and who a follower, as numbers."""
    for row in rows:
        for i in range(n):
            led[row * n + i] = leader[row * n + i] != i
            leads[row * n + i] = follower[row * n + i] != i


@exact
def lay_out(links, position, present, coming, rows, n, count, ring, halo, wide, stops, slots, own, led, leads, ends):
    """Lay some rows out by their links; False where links are not the order of positions.

    ``stops`` are the places where lanes end (m), and ``ends`` those of the lanes of all places.
    """
    lane, leader, follower = links[0], links[1], links[2]
    order, begin, place = np.empty(n, np.int64), np.empty(count + 1, np.int64), np.empty(n)
    for row in rows:
        if not walk(leader, follower, lane, position, present, coming, n, count, ring, row * n, order, begin, place):
            return False
        lay(order, begin, n, count, halo, wide, row * n, row * wide, slots, own, led, leads)
        for p in range(row * wide, (row + 1) * wide):
            ends[p] = stops[lane[row * n + slots[p]]]
    return True


@exact
def to_places(rows, sources, strides, truths, targets, slots, wide, like):
    """Copy what belongs to vehicles to their places; ``strides`` (by row, by vehicle) are those of the sources."""
    for i in range(len(sources)):
        by_row, by_vehicle = strides[i, 0], strides[i, 1]
        if truths[i]:
            source, target = carray(located(sources[i], BYTE), SIZE), carray(located(targets[i], BYTE), SIZE)
            for row in rows:
                for p in range(row * wide, (row + 1) * wide):
                    target[p] = source[row * by_row + slots[p] * by_vehicle]
        else:
            numbers, to = carray(located(sources[i], like), SIZE), carray(located(targets[i], like), SIZE)
            for row in rows:
                for p in range(row * wide, (row + 1) * wide):
                    to[p] = numbers[row * by_row + slots[p] * by_vehicle]


@apart
def to_slots(low, high, sources, targets, own, n, wide, like):
    """Copy what lies at places back to the slots of the vehicles themselves."""
    for i in range(len(sources)):
        source, target = carray(located(sources[i], like), SIZE), carray(located(targets[i], like), SIZE)
        for row in range(low, high):
            for s in range(row * n, (row + 1) * n):
                target[s] = source[row * wide + own[s]]


@apart
def seeds_to_places(low, high, sources, targets, own, n, wide, like):
    """Copy what falls on vehicles to their places; nothing falls on copies."""
    for i in range(len(sources)):
        source, target = carray(located(sources[i], like), SIZE), carray(located(targets[i], like), SIZE)
        for row in range(low, high):
            target[row * wide : (row + 1) * wide] = 0
            for s in range(row * n, (row + 1) * n):
                target[row * wide + own[s]] = source[s]


@apart
def sums_to_slots(low, high, sources, targets, slots, n, wide, like):
    """Add what falls on all places of a vehicle, its copies included, to what falls on its slot."""
    for i in range(len(sources)):
        source, target = carray(located(sources[i], like), SIZE), carray(located(targets[i], like), SIZE)
        for row in range(low, high):
            for p in range(row * wide, (row + 1) * wide):
                target[row * n + slots[p]] += source[p]


@apart
def put_in_lanes(low, high, said, before, links, position, was, present, coming, n, count, fresh):
    """Put vehicles where records say (``said``; −1 where they do not), as ``Order.of`` and ``Order.links`` do.

    ``links`` are written from those ``before``; ``fresh`` gets whose leader is another one; ``was`` is who was present.
    """
    lane, leader, follower, changed = links[0], links[1], links[2], links[3]
    key, order, spare = np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64)
    for row in range(low, high):
        base = row * n
        last, width = position[base], 0.0
        for i in range(n):
            last = min(last, position[base + i])
        for i in range(n):
            width = max(width, np.float64(position[base + i]) - np.float64(last))
        width += 1.0
        for i in range(n):
            slot = base + i
            lane[slot] = said[slot] if said[slot] >= 0 else before[0, slot]
            on_road = not coming or present[slot] > 0
            changed[slot] = before[3, slot] + (
                lane[slot] != before[0, slot] and on_road and (not coming or was[slot] > 0)
            )
            key[i] = (lane[slot] if on_road else count) * width + (np.float64(position[slot]) - np.float64(last))
            leader[slot] = follower[slot] = i
        sort(key, order, spare, n)
        for r in range(n - 1):
            i, j = base + order[r], base + order[r + 1]
            if lane[i] == lane[j] and (not coming or (present[i] > 0 and present[j] > 0)):
                leader[i], follower[j] = order[r + 1], order[r]
        for i in range(base, base + n):
            fresh[i] = leader[i] != before[1, i]


@exact
def step_chains(
    after, told, clock, later_clock, placed, settled, settle, said, links, links_later, position, was, present, coming,
    lanes, fresh, sources, source_strides, truths, targets, ends, later, slots, own, places, strides, w, h,
    past, newest, measures, phases, looks, recalls, read, k, extent, t, kept, n, begin, end,
):  # fmt: skip
    """Do the second half of a step of groups of worlds: the kernel's step, who is put where, and what is told.

    ``sources`` are what the kernel reads of every step, ``targets`` where it reads them; ``ends`` its states Δt later
    and ``later`` these in slots. With ``placed`` records say who is on which lane; ``settle`` (called with ``settled``)
    then measures gaps.
    """
    low, high, first, last = cut(extent, begin, end)
    wide = extent[2]
    rows = np.empty(high - low, np.int64)
    for i in range(low, high):
        rows[i - low] = i
    to_places(rows, sources, source_strides, truths, targets, slots, wide, k)
    advance(
        places, strides, w, h, past, newest, measures, phases, looks, recalls, read, k, extent, t, kept, first, last
    )  # fmt: skip
    to_slots(low, high, ends, later, own, n, wide, k)
    for i in range(low, high):
        later_clock[i] = clock[i] + 1
    if placed:
        put_in_lanes(low, high, said, links, links_later, position, was, present, coming, n, lanes, fresh)
        call_rows(settle, low, high, settled)  # type: ignore[call-arg]
    call_rows(after, low, high, told)  # type: ignore[call-arg]


@exact
def retreat_chains(
    seeds, seed_places, sums, sum_slots, slots, own, n, places, strides, w, h, ah, past, newest, on_end, on_begin,
    on_parameters, on_inputs, measures, phases, looks, recalls, back, sends, again, k, extent, t, begin, end,
):  # fmt: skip
    """Carry adjoints from the slots Δt later to those now: ``seeds`` to ``seed_places``, and back ``sums``."""
    low, high, first, last = cut(extent, begin, end)
    seeds_to_places(low, high, seeds, seed_places, own, n, extent[2], k)
    retreat(
        places, strides, w, h, ah, past, newest, on_end, on_begin, 0, 0, on_parameters, on_inputs, measures, phases,
        looks, recalls, back, sends, again, k, extent, t, False, False, first, last,
    )  # fmt: skip
    sums_to_slots(low, high, sums, sum_slots, slots, n, extent[2], k)
