"""Compiled decisions about lanes: who is beside whom, what everybody wishes, who is granted it, and the new links.

No equation stands here: what drivers wish is one printed phase (``scalar.wishes``), called through its address for some
hundred vehicles at a time. Lanes are walked front first: who is beside is found by going down two lanes at once.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.compiler import apart
from idm_env.compiled.kernels.memory import copy, fill, gather, number
from idm_env.compiled.kernels.phases import call, call_rows
from idm_env.compiled.kernels.tiles import ROW, exact, padded, workspace

CHUNK = 256
"""Vehicles for which the printed phase is called at once: its rows stay in the second-level cache."""

RESULTS = 5
"""Rows that the phase fills: what ``roads.adjacent.Preference`` holds."""

ARRAY, LANE, AHEAD, BEHIND, LAPS_AHEAD, LAPS_BEHIND, OPENS, CLOSES, STOPS = range(9)
"""What a row of the phase is filled with: an array's numbers, or what ``search`` finds."""

KIND, SIDE, PLACE, ADDRESS, BY_ROW, BY_VEHICLE = range(6)
"""Columns of the plan of rows. Sides are 0 for the own lane, 1 left and 2 right; places are (side, vehicles up)."""


@apart
def walk(leader, follower, lane, position, present, coming, n, count, ring, base, order, begin, place):
    """Put one row in order by its links, and places (m, within one lap) by rank; False if places do not fall.

    ``coming`` says that ``present`` tells who is there.
    """
    heads, furthest, on_road = np.empty(count, np.int64), np.empty(count), 0
    for k in range(count):
        heads[k], furthest[k] = -1, -1.0
    for i in range(n):
        if coming and present[base + i] <= 0:
            continue
        on_road += 1
        k = lane[base + i]
        if ring > 0:
            x = np.float64(position[base + i])
            x -= np.floor(x / ring) * ring
            if heads[k] < 0 or x > furthest[k]:
                heads[k], furthest[k] = i, x
        elif leader[base + i] == i or (coming and present[base + leader[base + i]] <= 0):
            if heads[k] >= 0:
                return False
            heads[k] = i
    rank = 0
    for k in range(count):
        begin[k] = rank
        i = heads[k]
        if i < 0:
            continue
        while rank < on_road:
            x = np.float64(position[base + i])
            if ring > 0:
                x -= np.floor(x / ring) * ring
            if rank > begin[k] and x > place[rank - 1]:
                return False
            order[rank], place[rank] = i, x
            rank += 1
            following = follower[base + i]
            if following == i or following == heads[k]:
                break
            i = following
    begin[count] = rank
    if rank < on_road:
        return False
    if coming:
        for i in range(n):
            if present[base + i] <= 0:
                order[rank] = i
                rank += 1
    return rank == n


@exact
def beside(place, begin, count, step, behind):
    """Find, for every rank, the rank of whoever would be behind on the lane ``step`` to the left; its end for nobody.

    Who is exactly beside counts as behind.
    """
    for k in range(count):
        to = k + step
        if not 0 <= to < count:
            continue
        q, end = begin[to], begin[to + 1]
        for r in range(begin[k], begin[k + 1]):
            while q < end and place[q] > place[r]:
                q += 1
            behind[r] = q


@exact
def round_ring(q, first, last):
    """Return a rank of the lane from ``first`` to ``last``, on which somebody is, round a ring."""
    while q < first:
        q += last - first
    while q >= last:
        q -= last - first
    return q


@exact
def whose(which, places, c, at, m, step, to, behind, begin, order, ring, base):
    """Fill ``which`` with the slots of the ``c``-th place, as seen from ranks ``at`` to ``at + m``: own for nobody."""
    first, last, up = begin[to], begin[to + 1], places[c, 1]
    size, around = last - first, ring > 0 and last > first
    if around and size > abs(up):  # not more than once round: without a loop in it this is vector code
        for j in range(m):
            q = (at + j if step == 0 else number(behind, at + j, order)) - up
            q += (size if q < first else 0) - (size if q >= last else 0)
            which[c * CHUNK + j] = base + number(order, q, order)
        return
    for j in range(m):
        q = (at + j if step == 0 else behind[at + j]) - up
        if not first <= q < last:
            q = round_ring(q, first, last) if around else at + j
        which[c * CHUNK + j] = base + order[q]


@apart
def count_laps(position, base, order, place, count, ring, lap):
    """Write how many laps of the ring the vehicle of each rank has driven."""
    for r in range(count):
        lap[r] = np.int64(np.floor((np.float64(position[base + order[r]]) - place[r]) / ring + 0.5))


@exact
def find(w, target, kind, at, m, exists, to, behind, begin, lap, ring, tables):
    """Fill one row with what a search says of lane ``to``, as seen from ranks ``at`` to ``at + m``.

    Laps (m) are what differences of positions lack of the way ahead, or behind.
    """
    first, last = begin[to], begin[to + 1]
    around = ring > 0 and last > first
    if kind == LANE:
        fill(w, target, 1 if exists else 0, m)
    elif kind >= OPENS:
        fill(w, target, tables[kind - OPENS, to], m)
    elif not exists:
        fill(w, target, 0, m)
    elif kind == AHEAD:
        for j in range(m):
            w[target + j] = around or behind[at + j] > first
    elif kind == BEHIND:
        for j in range(m):
            w[target + j] = around or behind[at + j] < last
    elif not around:
        fill(w, target, 0, m)
    elif kind == LAPS_AHEAD:
        for j in range(m):
            q = number(behind, at + j, w)
            over = q == first
            other_lap = number(lap, last - 1 if over else q - 1, w)
            w[target + j] = ring * (number(lap, at + j, w) - other_lap + over)
    else:
        for j in range(m):
            q = number(behind, at + j, w)
            over = q == last
            other_lap = number(lap, first if over else q, w)
            w[target + j] = -(ring * (number(lap, at + j, w) - other_lap - over))


@exact
def fill_alike(w, slots, plan, row, first):
    """Fill the rows that are the same for all vehicles of a batch row, and at first those that are for all rows."""
    for i in range(slots):
        if plan[i, KIND] == ARRAY and plan[i, BY_VEHICLE] == 0 and (first or plan[i, BY_ROW] != 0):
            fill(w, i * ROW, number(plan[i, ADDRESS], row * plan[i, BY_ROW], w), CHUNK)


@apart
def fill_rows(
    w, slots, plan, places, which, at, m, own_lane, begin, count, order, left, right, lap, base, row, ring, tables,
):  # fmt: skip
    """Fill the rows of the phase for ranks ``at`` to ``at + m``, all of one lane."""
    for c in range(len(places)):
        step = 0 if places[c, 0] == 0 else 1 if places[c, 0] == 1 else -1
        to = own_lane + step
        if 0 <= to < count:
            whose(which, places, c, at, m, step, to, left if step > 0 else right, begin, order, ring, base)
        else:
            for j in range(m):
                which[c * CHUNK + j] = base + order[at + j]
    for i in range(slots):
        kind, side = plan[i, KIND], plan[i, SIDE]
        if kind != ARRAY:
            step = 0 if side == 0 else 1 if side == 1 else -1
            to = own_lane + step
            exists = 0 <= to < count
            find(
                w, i * ROW, kind, at, m, exists, to if exists else own_lane, left if side == 1 else right, begin,
                lap, ring, tables,
            )  # fmt: skip
        elif plan[i, BY_VEHICLE] != 0:
            gather(w, i * ROW, plan[i, ADDRESS], row * plan[i, BY_ROW] - base, which, plan[i, PLACE] * CHUNK, m)


@exact
def key_of(r, to, behind, begin, ring):
    """Return the number of the gap on lane ``to`` that rank r would enter: one more gap than vehicles on each lane."""
    first, last = begin[to], begin[to + 1]
    q = behind[r]
    return to + (first if ring > 0 and q == last else q)


@exact
def better(utility, by_hand, slot, other, other_by_hand, other_slot):
    """Whether a claim is to be granted rather than another one."""
    if utility != other:
        return utility > other
    if by_hand != other_by_hand:
        return by_hand
    return slot < other_slot


@apart
def reordered(order, begin, place, count, ring, winner, granted, fresh_order, fresh_begin):
    """Write the order after the granted changes."""
    rank = 0
    for k in range(count):
        fresh_begin[k] = rank
        first, last = begin[k], begin[k + 1]
        late = np.int64(-1)
        for q in range(first, last + 1):
            r = winner[k + q]
            if r >= 0:
                if ring > 0 and q == first and last > first and place[r] <= place[first]:
                    late = r  # the gap in front of the first is the one behind the last
                else:
                    fresh_order[rank] = order[r]
                    rank += 1
            if q < last and not granted[q]:
                fresh_order[rank] = order[q]
                rank += 1
        if late >= 0:
            fresh_order[rank] = order[late]
            rank += 1
    fresh_begin[count] = rank


@apart
def relink(order, begin, count, ring, base, lane, leader, follower, fresh):
    """Write links that follow an order; ``fresh`` marks who has another leader than before."""
    for k in range(count):
        first, last = begin[k], begin[k + 1]
        for r in range(first, last):
            i = order[r]
            ahead = order[r - 1] if r > first else (order[last - 1] if ring > 0 else i)
            after = order[r + 1] if r + 1 < last else (order[first] if ring > 0 else i)
            if leader[base + i] != ahead:
                leader[base + i] = ahead
                fresh[base + i] = 1
            follower[base + i], lane[base + i] = after, k


@apart
def settle(w, results, at, m, own_lane, left, right, begin, ring, left_hand, base, order, winner, utility, to_left,
           looks, signals, refused, blocked, turns, stage):  # fmt: skip
    """Grant the best claim on each gap so far, and count the others; return whether there was any, −1 for NaN."""
    some = 0
    for j in range(m):
        r = at + j
        if looks:
            signals[r] = w[results + 4 * ROW + j]
        if len(turns) and turns[order[r]] != stage:
            continue
        comes_to_nothing = w[results + 3 * ROW + j]
        if comes_to_nothing != 0:
            if comes_to_nothing != comes_to_nothing:
                return -1
            blocked[base + order[r]] += 1
        if not w[results + 2 * ROW + j] > 0:
            continue
        some = 1
        utility[r], to_left[r] = w[results + j], w[results + ROW + j] > 0
        to, behind = (own_lane + 1, left) if to_left[r] else (own_lane - 1, right)
        key = key_of(r, to, behind, begin, ring)
        q = winner[key]
        if q < 0 or better(
            utility[r], to_left[r] == left_hand, order[r], utility[q], to_left[q] == left_hand, order[q]
        ):
            if q >= 0:
                refused[base + order[q]] += 1
            winner[key] = r
        else:
            refused[base + order[r]] += 1
    return some


@apart
def count_changes(winner, order, left, right, to_left, begin, ring, base, lane, follower, changed, unjudged):
    """Count the changes that were granted, and those in front of another follower than the one who was judged."""
    for key in range(len(winner)):
        r = winner[key]
        if r < 0:
            continue
        i = base + order[r]
        changed[i] += 1
        first, last = begin[lane[i]], begin[lane[i] + 1]
        q = left[r] if to_left[r] else right[r]
        if q == last and ring > 0:
            q = first
        if q < last and follower[i] != order[q]:
            unjudged[i] += 1


@exact
def any_of(turns, stage, order, at, m):
    """Whether it is the turn of any of the ranks ``at`` to ``at + m``."""
    some = False
    for j in range(m):
        some |= turns[order[at + j]] == stage
    return some


@apart
def find_mergers(order, begin, count, place, ring, left, right, signals, granted, base, nearest, merger):
    """Write, for everybody who stays, the slot of the nearest of those who signal and would have him as follower."""
    nearest[:] = np.inf
    for k in range(count):
        for r in range(begin[k], begin[k + 1]):
            if signals[r] == 0 or granted[r]:
                continue
            to, q = (k + 1, left[r]) if signals[r] > 0 else (k - 1, right[r])
            first, last = begin[to], begin[to + 1]
            around = ring > 0 and q == last and last > first
            q = first if around else q
            if q >= last or granted[q]:
                continue
            way = place[r] - place[q] + (ring if around else 0.0)
            if way < nearest[q] or (way == nearest[q] and order[r] < merger[base + order[q]]):
                nearest[q], merger[base + order[q]] = way, order[r]


@exact
def decide(
    links, position, present, coming, rows, stages, n, count, ring, left_hand, tables, plan, places, phase, k, slots,
    fresh, merger, turns, orders, begins,
):  # fmt: skip
    """Decide in some rows: ``links`` (7, slots; as ``types.Links``) change in place, ``fresh`` marks new leaders.

    ``rows`` are those that decide, in their ``stages``: of their slots those whose ``turns`` are the same (none:
    all of them). ``plan`` says what the ``slots`` rows of the printed ``phase`` are filled with, ``places`` whose.
    ``merger`` (rows · n own slots, or empty if nobody looks) gets who signals beside everybody. ``orders`` (rows · n)
    and ``begins`` (rows · (count + 1)) get the order of every row afterwards, as ``walk`` would put it. Returns False,
    with some rows decided, where links are not the order of positions, or a wish is NaN.
    """
    lane, leader, follower = links[0], links[1], links[2]
    changed, refused, blocked, unjudged = links[3], links[4], links[5], links[6]
    w, which = workspace((slots + RESULTS) * ROW, k), np.empty(len(places) * CHUNK, np.int64)
    order, begin, place = np.empty(n, np.int64), np.empty(count + 1, np.int64), np.empty(n)
    fresh_order, fresh_begin = np.empty(n, np.int64), np.empty(count + 1, np.int64)
    left, right, winner = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n + count, np.int64)
    utility, to_left, granted = np.empty(n, k.dtype), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    signals, nearest, lap = np.zeros(n, np.int8), np.empty(n), np.zeros(n, np.int64)
    for i in range(len(rows)):
        row, stage = rows[i], stages[i]
        base = row * n
        if not walk(leader, follower, lane, position, present, coming, n, count, ring, base, order, begin, place):
            return False
        if ring > 0:
            count_laps(position, base, order, place, begin[count], ring, lap)
        beside(place, begin, count, 1, left)
        beside(place, begin, count, -1, right)
        fill_alike(w, slots, plan, row, i == 0)
        winner[:] = -1
        some = 0
        for own in range(count):
            for rank in range(begin[own], begin[own + 1], CHUNK):
                m = min(CHUNK, begin[own + 1] - rank)
                if len(turns) and not any_of(turns, stage, order, rank, m):
                    continue
                fill_rows(
                    w, slots, plan, places, which, rank, m, own, begin, count, order, left, right, lap, base, row,
                    ring, tables,
                )  # fmt: skip
                call(phase, w, padded(m), k)  # type: ignore[call-arg]
                outcome = settle(
                    w, slots * ROW, rank, m, own, left, right, begin, ring, left_hand, base, order, winner, utility,
                    to_left, len(merger) > 0, signals, refused, blocked, turns, stage,
                )  # fmt: skip
                if outcome < 0:
                    return False
                some |= outcome
        granted[:] = False
        for r in winner:
            if r >= 0:
                granted[r] = True
        if len(merger):
            find_mergers(order, begin, count, place, ring, left, right, signals, granted, base, nearest, merger)
        if some:
            reordered(order, begin, place, count, ring, winner, granted, fresh_order, fresh_begin)
            relink(fresh_order, fresh_begin, count, ring, base, lane, leader, follower, fresh)
            count_changes(winner, order, left, right, to_left, begin, ring, base, lane, follower, changed, unjudged)
            copy(order, 0, fresh_order, 0, begin[count])
            copy(begin, 0, fresh_begin, 0, count + 1)
        copy(orders, base, order, 0, n)
        copy(begins, row * (count + 1), begin, 0, count + 1)
    return True


@exact
def each_row(loops, rows, table):
    """Call loops over some rows, and over neighbours at once."""
    first = 0
    for i in range(len(rows)):
        if i + 1 == len(rows) or rows[i + 1] != rows[i] + 1:
            call_rows(loops, rows[first], rows[i] + 1, table)  # type: ignore[call-arg]
            first = i + 1
