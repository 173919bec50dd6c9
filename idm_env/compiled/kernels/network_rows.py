"""Compiled rollout of a network without a graph: rows run one after another, each from event to event, in place.

A row is laid out as paths, everybody behind the one whom he follows; where several follow one, all but the first drive
behind copies of the chain of their leaders, long enough that what goes wrong at its front does not reach them. What a
step does is ``lane_loops.step``: here is no equation.

``paths`` are the layout in tiles: slots, where their numbers begin, who has a leader and a follower there, who is
himself and no copy, everybody's own place, and the sizes of tiles.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from idm_env.compiled.kernels.lane_loops import (
    BEFORE,
    FLAGS,
    HOIST,
    INPUT_ROWS,
    N_ROWS,
    NUMBERS,
    PARAMETERS,
    STATE_ROWS,
    STATIC_ROWS,
    STATICS,
    look,
    step as step_lane,
)
from idm_env.compiled.kernels.memory import copy, fill, gather, located, number
from idm_env.compiled.kernels.network_loops import (
    COUNT,
    EACH,
    FOLLOWER,
    HERE,
    LEADER,
    LINK,
    LINKS,
    ORDER,
    PRESENT,
    SLOTS,
    K,
    W,
    event,
    sort,
)
from idm_env.compiled.kernels.phases import call
from idm_env.compiled.kernels.tiles import ROW, Array, exact, padded, workspace

LED, LEADS = -1, -2
"""Operands that are not in memory: who has a leader, and who a follower."""


class Operands(NamedTuple):
    """Places that a step reads and writes: addresses of states and operands, and strides by step, row and slot.

    ``read`` and ``written`` are states; an address of 0 is that of the clock. Rows of states lie ``by_row`` apart.
    """

    states: Array
    by_row: int
    read: Array
    written: Array
    operands: Array
    strides: Array
    measures: Array
    phases: Array
    looks: Array
    recalls: Array
    constants: Array


@exact
def pack(to, columns, by_row, by_slot, rows, n):
    """Copy columns ``(rows, n)``, at addresses and with strides by row and slot, beside one another into ``to``."""
    for r in range(rows):
        for c in range(len(columns)):
            column = located(columns[c], to)
            for i in range(n):
                to[(r * n + i) * W + c] = column[r * by_row[c] + i * by_slot[c]]


@exact
def unpack(source, which, columns, rows, n):
    """Copy some columns apart again, to where ``columns`` begin."""
    for r in range(rows):
        for c in range(len(columns)):
            column = located(columns[c], source)
            for i in range(r * n, (r + 1) * n):
                column[i] = source[i * W + which[c]]


@exact
def tables_of(r, sizes, cars, tags, road, site, move, against, routes, others, rules, drivers):
    """Return pointers to the tables that the event of a row takes."""
    n, real, whole = sizes[SLOTS], cars.itemsize, tags.itemsize
    driver = drivers.ctypes.data + min(r, len(drivers) - 1) * 4 * sizes[EACH] * real
    return (
        located(cars.ctypes.data + r * n * W * real, cars), located(tags.ctypes.data + r * n * W * whole, tags),
        located(road.ctypes.data, cars), located(site.ctypes.data, tags), located(move.ctypes.data, tags),
        located(against.ctypes.data, tags), located(routes.ctypes.data, tags), located(others.ctypes.data, tags),
        located(rules.ctypes.data + r * rules.shape[1] * real, cars), located(driver, cars),
    )  # fmt: skip


@exact
def events(which, clocks, dt, tables, plans, phases):
    """Do an event in some rows; ``clocks`` are their steps."""
    for r in which:
        event(clocks[r], dt, True, tables[0], tables_of(r, *tables), plans, phases[r])


@exact
def arrange(sizes, car, tag, site):
    """Find everybody's place in the order of links, nobody having moved to another; return how many are there."""
    n = 0
    for k in range(sizes[LINKS]):
        site[K * k + COUNT] = 0
    for i in range(sizes[SLOTS]):
        if car[W * i + PRESENT] > 0:
            tag[W * n + HERE] = i
            site[K * tag[W * i + LINK] + COUNT] += 1
            n += 1
    sort(n, sizes[LINKS], car, tag, site)
    return n


@exact
def lay(n, halo, wide, tag, paths):
    """Lay a row out in tiles of ``wide`` places, first those who lead a path, then circles; return how many tiles."""
    slots, cells, led, leads, own, place, sizes = paths
    for q in range(n):
        place[tag[W * q + ORDER]] = -1
    tile, p = 0, 0
    for turn in range(2):
        for q in range(n):
            i = tag[W * q + ORDER]
            j = tag[W * i + LEADER]
            if turn == 0 and j != i and tag[W * j + FOLLOWER] == i:
                continue
            while place[i] < 0:
                m = copies(i, halo, tag)
                if p + m >= wide:
                    sizes[tile] = p
                    tile, p = tile + 1, 0
                begin, j = tile * wide, i
                for cell in range(begin + p + m - 1, begin + p - 1, -1):
                    j = tag[W * j + LEADER]
                    slots[cell], cells[cell], led[cell], leads[cell], own[cell] = j, W * j, cell > begin + p, 1, 0
                p += m
                while place[i] < 0 and p < wide:
                    cell = begin + p
                    slots[cell], cells[cell], led[cell] = i, W * i, tag[W * i + LEADER] != i
                    leads[cell], own[cell], place[i] = 1, 1, cell
                    i, p = tag[W * i + FOLLOWER], p + 1
                leads[begin + p - 1] = 0
    sizes[tile] = p
    return tile + 1


@exact
def copies(i, halo, tag):
    """Return how many leaders, one behind the other, a vehicle has ahead, at most ``halo``."""
    m = 0
    while m < halo and tag[W * i + LEADER] != i:
        i, m = tag[W * i + LEADER], m + 1
    return m


@exact
def laid(halo, wide, tables, paths):
    """Lay all rows out, each as one tile of a row of ``paths``; return whether all fit."""
    slots, cells, led, leads, own, place, sizes = paths
    fits = True
    for r in range(len(slots)):
        mine = tables_of(r, *tables)
        n = arrange(tables[0], mine[0], mine[1], mine[3])
        one = slots[r], cells[r], led[r], leads[r], own[r], place[r], sizes[r]
        fits &= lay(n, halo, wide, mine[1], one) == 1
        for p in range(sizes[r, 0], wide):
            slots[r, p], led[r, p], leads[r, p] = 0, 0, 0
    return fits


@exact
def fetch_states(w, to, cells, begin, n, r, clock, plan):
    """Copy the states of a tile into rows of a workspace."""
    for s in plan.read:
        if plan.states[s] == 0:
            fill(w, to + s * ROW, w.dtype.type(clock), n)
        else:
            gather(w, to + s * ROW, plan.states[s], r * plan.by_row, cells, begin, n)


@exact
def fetch_operand(w, to, paths, begin, n, r, t, plan, i):
    """Copy an operand of a tile at step ``t`` into a row of a workspace."""
    slots, _, led, leads, _, _, _ = paths
    cell = t * plan.strides[i, 0] + r * plan.strides[i, 1]
    if plan.operands[i] == LED:
        copy(w, to, led, begin, n)
    elif plan.operands[i] == LEADS:
        copy(w, to, leads, begin, n)
    elif plan.strides[i, 2] == 0:
        fill(w, to, number(plan.operands[i], cell, w), n)
    else:
        gather(w, to, plan.operands[i], cell, slots, begin, n)


@exact
def drive(w, paths, begin, n, r, done, steps, plan):
    """Do some steps of a tile, which is in a workspace, and copy what has become of everybody back to his slot."""
    _, cells, _, _, own, _, _ = paths
    m, k = plan.measures, plan.constants
    many, inputs = m[STATICS] + m[PARAMETERS], m[NUMBERS] + m[FLAGS]
    for i in range(many):
        fetch_operand(w, m[STATIC_ROWS] + i * ROW, paths, begin, n, r, 0, plan, i)
    if plan.phases[HOIST]:
        call(plan.phases[HOIST], w, padded(n), k)  # type: ignore[call-arg]
    look(w, n, n, m, plan.looks, BEFORE)
    for t in range(done, done + steps):
        for i in range(inputs):
            fetch_operand(w, m[INPUT_ROWS] + i * ROW, paths, begin, n, r, t, plan, many + i)
        step_lane(w, 0, ROW, n, n, m, plan.phases, plan.looks, plan.recalls, k, 0)
    for s in plan.written:
        to, source, cell = located(plan.states[s], w), m[STATE_ROWS] + s * ROW, r * plan.by_row
        for j in range(n):
            if own[begin + j]:
                to[cell + cells[begin + j]] = w[source + j]


@exact
def run(begin, end, clocks, steps, every, dt, halo, wide, tables, plans, phases, paths, plan):
    """Run rows ``begin`` to ``end`` for so many steps, an event before every step that ``every`` divides."""
    cells, sizes, count = paths[1], paths[6], len(plan.states)
    w = workspace(plan.measures[N_ROWS] * ROW, plan.constants)
    states = np.empty(count * ROW * len(sizes), w.dtype)
    for r in range(begin, end):
        own = tables_of(r, *tables)
        done, n = 0, -1
        while done < steps:
            clock = clocks[r] + done
            if clock % every == 0:
                n = event(clock, dt, n < 0 or done < every, tables[0], own, plans, phases[r])
            elif n < 0:
                n = arrange(tables[0], own[0], own[1], own[3])
            ahead = min(every - clock % every, steps - done)
            tiles = lay(n, halo, wide, own[1], paths)
            for tile in range(tiles):
                fetch_states(states, tile * count * ROW, cells, tile * wide, sizes[tile], r, clock, plan)
            for tile in range(tiles):
                for s in plan.read:
                    copy(w, plan.measures[STATE_ROWS] + s * ROW, states, (tile * count + s) * ROW, sizes[tile])
                drive(w, paths, tile * wide, sizes[tile], r, done, ahead, plan)
            done += ahead
