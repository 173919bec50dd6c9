"""Compiled events of a network: order on links, entries, leaders, and gates.

One event of one row of ``n`` slots, in place. What is decided is discrete; what that makes of positions, speeds and
gaps are a few lines here, the same as in ``multilane.junctions``, where they are differentiable.

What belongs to vehicles stands in ``car`` (numbers) and ``tag`` (whole numbers), to links in ``road`` and ``site``, to
moves in ``move``: a row each, a column for each name below. ``against`` are foes and yields ``(2, M, F)``,
``rules`` b_m (m/s²), t_c (s), sight and reach (m), the time to the next event (s), 1 / 2b_m, how far one may come
until then beyond v²/2b_m and at a constant speed, and room for the longest vehicle (m); ``driver`` are T, s0 and b of
all, or of each.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.tiles import exact

CAR: tuple[str, ...] = ("position", "speed", "accel", "gap", "length", "present", "asks", "stop", "limit")
CAR += ("base", "moved", "entering", "line", "later")
"""Of vehicles, numbers: state, and behind it the way to the leader's link, how far the own link is ahead of the one
before, the speed to enter at, where the next line is, closed or not, and the limit of the next link."""
TAG: tuple[str, ...] = ("link", "leader", "follower", "route", "hop", "told", "reserved", "due", "entered", "left")
TAG += ("new", "gate", "here", "order", "waits")
"""Of vehicles, whole numbers: state, and behind it what is new, the next move, the slots that are here, in any
order and in that of links, and for whom a vehicle waits at its gate or lane end (−1: for no vehicle)."""
POSITION, SPEED, ACCEL, GAP, LENGTH, PRESENT, ASKS, STOP, LIMIT, BASE, MOVED, ENTERING, LINE, LATER = range(len(CAR))
LINK, LEADER, FOLLOWER, ROUTE, HOP, TOLD, RESERVED, DUE, ENTERED, LEFT, NEW, GATE, HERE, ORDER, WAITS = range(len(TAG))
LONG, FAST, TRAIL_BASE, HEADING, UNGUARDED = range(5)
"""Of links, numbers: length and limit, the way to the link of the vehicle whose rear is there, how much is on its
way there through a junction (m), and whether one comes there without a gate (1)."""
OPENS, MOVE_OF, BESIDE, COUNT, BEGIN, TAIL, TRAIL, QUEUE = range(8)
"""Of links, whole numbers: the move that begins with it (``GATED``: a gate is at its end), or that it is a part of; the
lane to the left; how many are there, where they begin in the order, who is the last, whose rear is there, and
whether somebody waits, or (2) has come from beside."""
START, END, SIGNAL, INDEX, SHOWN, INSIDE, COMING, HOLDER = range(8)
"""Of moves, whole numbers: their links, signal and index, what it shows, how many are inside or have reserved, one who
arrives within t_c (his slot and 1, 0 for nobody), and one of those inside."""
SLOTS, LINKS, MOVES, WIDE, AGAINST, EACH, OTHERS = range(7)
MOST_DECEL, CRITICAL_GAP, SIGHT, REACH, EVERY, BRAKING, MORE, SETBACK = range(8)
TIME_GAP, LEAST, BRAKE, ACCEL_OF = range(4)

W, K = 16, 8
"""Columns of vehicles, and of links and moves: what one needs is on two lines of a cache. Tables are handed on as
pointers: numba counts references to arrays at every call, which costs more than most of what is done here."""
NONE, GATED, ASIDE, CIRCLE = -1, -2, -2, -2
"""No move; a gate at the end; what comes next is no gate, but a change of lanes; no signal, and yields in a circle."""
RED, GREEN, AMBER, YIELD = range(4)
FREE, STOPS, CLEARS = range(3)
"""What a driver is told: nothing; to stop; and that he counts as inside, so that in red he goes before his foes."""
FAR, OPEN = 1e4, 1e6
GAIN = 0.2
"""By how much a leader must brake less on the lane beside (m/s²), as in MOBIL (Kesting, Treiber and Helbing 2007)."""
STANDS = 1.0
"""Speed below which whoever is behind a junction may not make room in time (m/s)."""
SAME, LED, CAME, CAME_BEHIND = range(4)
"""What is new of a vehicle: nothing, its leader, itself, itself at its leader's speed."""


@exact
def event(step, dt, anew, sizes, tables, plans, phases):
    """Do one event; return how many vehicles there are. ``anew``: gates ahead are not known from the event before."""
    car, tag, road, site, move, against, routes, others, rules, driver = tables
    show(step * dt, sizes[MOVES], move, plans, phases)
    n = travel(step, anew, sizes, car, tag, road, site, move, routes, rules)
    n = enter(step, n, sizes, car, tag, road, site, move, routes, rules, driver)
    sort(n, sizes[LINKS], car, tag, site)
    if change(n, sizes, car, tag, road, site, routes, others, rules, driver):
        sort(n, sizes[LINKS], car, tag, site)
        for k in range(sizes[LINKS]):
            p = site[K * k + K + BEGIN] - 1
            site[K * k + TAIL] = tag[W * p + ORDER] if p >= site[K * k + BEGIN] else NONE
    follow(n, sizes, car, tag, road, site, routes, rules)
    guard(n, sizes, car, tag, road, site, move, against, routes, rules, driver)
    return n


@exact
def show(time, moves, move, plans, phases):
    """Find the aspect of every move, by plans or by the phases that are set."""
    shows, first, until, offset, now = plans
    for s in range(len(offset)):
        begin, end = first[s], first[s + 1]
        p = begin + phases[s]
        if phases[s] < 0:
            t, p = (time - offset[s] + 1e-6) % until[end - 1], begin
            while p < end - 1 and t >= until[p]:
                p += 1
        now[s] = p
    for m in range(moves):
        s = move[K * m + SIGNAL]
        move[K * m + SHOWN] = YIELD if s < 0 else shows[now[s], move[K * m + INDEX]]


@exact
def next_link(i, h, wide, tag, routes):
    """Return link ``h`` of a vehicle's route, −1 behind its end."""
    return routes[tag[W * i + ROUTE] * wide + h] if h < wide else NONE


@exact
def is_beside(k, then, site):
    """Whether a link, if it is any, is the lane beside another."""
    return then >= 0 and (site[K * k + BESIDE] == then or site[K * then + BESIDE] == k)


@exact
def put_on_link(i, wide, car, tag, road, site, move, routes):
    """Note whose last vehicle is on a link, whose rear is still on links behind, and which moves have somebody."""
    k, x = tag[W * i + LINK], car[W * i + POSITION]
    site[K * k + COUNT] += 1
    if site[K * k + TAIL] < 0 or x < car[W * site[K * k + TAIL] + POSITION]:
        site[K * k + TAIL] = i
    m = site[K * k + MOVE_OF]
    if m >= 0:
        move[K * m + INSIDE] += 1
        move[K * m + HOLDER] = i
        road[K * move[K * m + END] + HEADING] += car[W * i + LENGTH]
    rear, back, h = x - car[W * i + LENGTH], x - x, tag[W * i + HOP] - 1
    while h >= 0 and rear + back < 0:
        k = routes[tag[W * i + ROUTE] * wide + h]
        back += road[K * k + LONG]
        j = site[K * k + TRAIL]
        if j < 0 or back + rear < road[K * k + TRAIL_BASE] + car[W * j + POSITION] - car[W * j + LENGTH]:
            site[K * k + TRAIL], road[K * k + TRAIL_BASE] = i, back
        if site[K * k + MOVE_OF] >= 0:
            move[K * site[K * k + MOVE_OF] + INSIDE] += 1
            move[K * site[K * k + MOVE_OF] + HOLDER] = i
        h -= 1


@exact
def travel(step, anew, sizes, car, tag, road, site, move, routes, rules):
    """Move everybody to the next link who is beyond the end of his; return how many have not left."""
    for k in range(sizes[LINKS]):
        site[K * k + TAIL], site[K * k + TRAIL], site[K * k + COUNT], site[K * k + QUEUE] = NONE, NONE, 0, 0
        road[K * k + HEADING] = 0
    for m in range(sizes[MOVES]):
        move[K * m + INSIDE], move[K * m + COMING] = 0, 0
    n = 0
    for i in range(sizes[SLOTS]):
        if tag[W * i + DUE] > step:
            break
        if car[W * i + PRESENT] <= 0:
            continue
        k, h, far, x = tag[W * i + LINK], tag[W * i + HOP], road[LONG] - road[LONG], car[W * i + POSITION]
        while x - far >= road[K * k + LONG]:
            then = next_link(i, h + 1, sizes[WIDE], tag, routes)
            if is_beside(k, then, site):
                break
            h += 1
            far += road[K * k + LONG]
            k = then
            if k < 0:
                break
            if site[K * k + OPENS] >= 0:
                tag[W * i + TOLD], tag[W * i + RESERVED] = FREE, 0
        car[W * i + MOVED], tag[W * i + NEW] = 0, SAME
        if k < 0:
            tag[W * i + LEFT], tag[W * i + LEADER], tag[W * i + FOLLOWER] = step, i, i
            car[W * i + PRESENT], car[W * i + SPEED], car[W * i + ACCEL], car[W * i + GAP] = 0, 0, 0, FAR
            continue
        if far > 0:
            car[W * i + MOVED], car[W * i + POSITION], tag[W * i + HOP], tag[W * i + LINK] = far, x - far, h, k
        tag[W * n + HERE] = i
        n += 1
        put_on_link(i, sizes[WIDE], car, tag, road, site, move, routes)
        if far > 0 or anew or tag[W * i + GATE] == ASIDE:
            find_gate(i, sizes[WIDE], car, tag, road, site, routes, rules)
        if tag[W * i + RESERVED]:
            reserve(i, tag[W * i + GATE], 1, car, tag, road, move)
    return n


@exact
def leader_ahead(i, reach, wide, car, tag, road, site, routes):
    """Return whom the first vehicle of a link follows, and the way from the beginning of his link to his leader's.

    That is the next one along his route, or one whose rear is not yet on a way of his own. −1 for nobody: on the lane
    beside, to which he must change, nobody is ahead of him.
    """
    way, h, k = road[LONG] - road[LONG], tag[W * i + HOP], tag[W * i + LINK]
    while k >= 0 and way - car[W * i + POSITION] < reach:
        j = site[K * k + TAIL] if h > tag[W * i + HOP] else NONE
        base = way
        if j < 0:
            j, base = site[K * k + TRAIL], way + road[K * k + TRAIL_BASE]
        if j == i:
            break
        if j >= 0:
            return j, base
        way += road[K * k + LONG]
        h += 1
        own, k = k, next_link(i, h, wide, tag, routes)
        if is_beside(own, k, site):
            break
    return NONE, way


@exact
def find_gate(i, wide, car, tag, road, site, routes, rules):
    """Find a vehicle's next move, −1 for none, and the way to its line from the beginning of his link; and a limit.

    Whoever must go to the right stops before the end of his lane: who comes from there finds room ahead.
    """
    own, way, h = tag[W * i + LINK], road[K * tag[W * i + LINK] + LONG], tag[W * i + HOP] + 1
    k = next_link(i, h, wide, tag, routes)
    car[W * i + LATER], tag[W * i + GATE] = road[K * (max(k, 0)) + FAST] if k >= 0 else FAR, NONE
    while k >= 0:
        if site[K * k + OPENS] >= 0:
            tag[W * i + GATE] = site[K * k + OPENS]
            break
        if is_beside(own, k, site):
            tag[W * i + GATE] = ASIDE
            break
        way += road[K * k + LONG]
        h += 1
        own, k = k, next_link(i, h, wide, tag, routes)
    car[W * i + LINE] = way
    if tag[W * i + GATE] == ASIDE and site[K * k + BESIDE] == own:
        car[W * i + LINE] = max(0, car[W * i + LINE] - rules[SETBACK])


@exact
def enter(step, n, sizes, car, tag, road, site, move, routes, rules, driver):
    """Let the first of each queue in where there is room, and nobody on his way there; return how many are there.

    ::

        s ≥ s0 + v T    and    (v² − v_l²) / 2b ≤ s − s0    and    v² ≤ 2 b_m s_line

    with the speed that he asks for, or that of the vehicle ahead if it must be and is less.
    """
    for i in range(sizes[SLOTS]):
        if tag[W * i + DUE] > step:
            break
        k = tag[W * i + LINK]
        if tag[W * i + ENTERED] >= 0 or site[K * k + QUEUE]:
            continue
        site[K * k + QUEUE] = 1
        if road[K * k + HEADING] > 0:
            continue
        car[W * i + POSITION] = 0
        j, base = leader_ahead(i, rules[REACH], sizes[WIDE], car, tag, road, site, routes)
        if site[K * k + TAIL] >= 0:
            j, base = site[K * k + TAIL], base - base
        find_gate(i, sizes[WIDE], car, tag, road, site, routes, rules)
        v = min(car[W * i + ASKS], road[K * k + FAST])
        fast = np.sqrt(2 * rules[MOST_DECEL] * car[W * i + LINE]) if tag[W * i + GATE] >= 0 else v
        car[W * i + ENTERING] = min(v, fast)
        kind = entry(i, j, base, sizes[EACH], car, driver)
        if kind == SAME:
            continue
        car[W * i + SPEED] = min(car[W * i + ENTERING], car[W * j + SPEED] if kind == CAME_BEHIND else FAR)
        car[W * i + ACCEL], car[W * i + PRESENT], tag[W * i + ENTERED], tag[W * i + LEADER] = 0, 1, step, i
        tag[W * i + TOLD], tag[W * i + RESERVED], car[W * i + MOVED], tag[W * i + NEW] = FREE, 0, 0, kind
        tag[W * n + HERE] = i
        n += 1
        put_on_link(i, sizes[WIDE], car, tag, road, site, move, routes)
    return n


@exact
def entry(i, j, base, each, car, driver):
    """Return how a vehicle enters behind vehicle ``j`` (−1: nobody), ``SAME`` for not at all."""
    if j < 0:
        return CAME
    v, v_l, room = car[W * i + ENTERING], car[W * j + SPEED], base + car[W * j + POSITION] - car[W * j + LENGTH]
    if fits(i, room, v, v_l, 1, each, driver):
        return CAME
    return CAME_BEHIND if fits(i, room, min(v, v_l), v_l, 1, each, driver) else SAME


@exact
def change(n, sizes, car, tag, road, site, routes, others, rules, driver):
    """Move vehicles that must, and those that gain, to the lane beside; return whether any has moved, one to each lane.

    Those whose way goes on from there, too, gain where ``a (s*/s)² − a (s*/s′)² > 0.2 m/s²``, s′ being the gap there.
    They stay if they have reserved the junction.
    """
    some = False
    for q in range(n):
        i = tag[W * q + ORDER]
        if tag[W * i + NEW] >= CAME or car[W * i + MOVED] > 0 or tag[W * i + RESERVED]:
            continue
        place, v = tag[W * i + ROUTE] * sizes[WIDE] + tag[W * i + HOP], car[W * i + SPEED]
        if tag[W * i + GATE] == ASIDE:
            if is_beside(tag[W * i + LINK], next_link(i, tag[W * i + HOP] + 1, sizes[WIDE], tag, routes), site):
                some |= change_to(i, place + 1, np.inf, sizes, car, tag, road, site, routes, rules, driver)
        elif sizes[OTHERS] > 0 and tag[W * i + LEADER] != i:
            brakes = interaction(i, car[W * i + GAP], v, car[W * tag[W * i + LEADER] + SPEED], sizes[EACH], driver)
            for side in range(2):
                to = others[2 * place + side]
                if brakes > GAIN and to >= 0 and tag[W * i + NEW] == SAME:
                    some |= change_to(i, to, brakes, sizes, car, tag, road, site, routes, rules, driver)
    return some


@exact
def interaction(i, gap, v, v_l, each, driver):
    """Return the deceleration of IDM's interaction (m/s²), ``a (s*/s)²``."""
    d = i if each > 1 else 0
    a, time_gap = driver[ACCEL_OF * each + d], driver[TIME_GAP * each + d]
    dynamic = v * time_gap + v * (v - v_l) / (2 * np.sqrt(a * driver[BRAKE * each + d]))
    return a * ((driver[LEAST * each + d] + max(0, dynamic)) / max(gap, 0.1)) ** 2


@exact
def change_to(i, place, brakes, sizes, car, tag, road, site, routes, rules, driver):
    """Move a vehicle to the lane beside at a place of ``routes``, if it may; return whether it has moved.

    ::

        s − (1 + u) s0 / 2 ≥ u v T    and    v² − v_l² ≤ 2 b (s − (1 + u) s0 / 2)

    to the new leader and of the new follower. Who must (he ``brakes`` with ∞) has u = min(1, s_line / reach): the
    nearer the end, the less is enough. Who gains has u = 1.
    Where somebody is about to come from behind the lane, one is taken to be at its beginning, as fast as may be.
    The first who can stops s0 behind somebody who stands at the end of his lane: nearer, neither could go.
    """
    each, wide = sizes[EACH], sizes[WIDE]
    k, to, old = tag[W * i + LINK], routes[place], tag[W * i + ROUTE] * wide + tag[W * i + HOP]
    v, room = car[W * i + SPEED], car[W * i + LINE] - car[W * i + POSITION]
    shift = car[W * i + POSITION] - car[W * i + POSITION] * road[K * to + LONG] / road[K * k + LONG]
    x, p, end = car[W * i + POSITION] - shift, site[K * to + BEGIN], site[K * to + K + BEGIN]
    share = min(1, max(0, room / rules[REACH])) if brakes == np.inf else 1
    while p < end and car[W * tag[W * p + ORDER] + POSITION] >= x:
        p += 1
    base, rear, late = shift - shift, x - car[W * i + LENGTH], road[K * to + HEADING] + road[K * to + UNGUARDED] > 0
    j = tag[W * p + ORDER] if p < end else NONE
    if j >= 0:
        gap, late = rear - car[W * j + POSITION], tag[W * j + RESERVED] > 0
        late = late or not fits(j, gap, car[W * j + SPEED], v, share, each, driver)
    elif late:
        late = not fits(i, rear, road[K * to + FAST], v, share, each, driver)
    tag[W * i + ROUTE], tag[W * i + HOP], tag[W * i + LINK] = place // wide, place % wide, to
    if p > site[K * to + BEGIN]:
        ahead = tag[W * p - W + ORDER]
    else:
        ahead, base = leader_ahead(i, rules[REACH], wide, car, tag, road, site, routes)
    late = late or rear < 0 or site[K * to + QUEUE] == 2 or v * v * rules[BRAKING] > road[K * to + LONG] - x
    if ahead >= 0 and not late:
        j, gap = ahead, base + car[W * ahead + POSITION] - car[W * ahead + LENGTH] - x
        late = not fits(i, gap, v, car[W * ahead + SPEED], share, each, driver)
        late = late or brakes - interaction(i, gap, v, car[W * ahead + SPEED], each, driver) <= GAIN
    if late:
        tag[W * i + ROUTE], tag[W * i + HOP], tag[W * i + LINK], tag[W * i + WAITS] = old // wide, old % wide, k, j
        while brakes == np.inf and v < STANDS and room < rules[SETBACK] and p < end:
            j, p = tag[W * p + ORDER], p + 1
            least = driver[LEAST * each + (j if each > 1 else 0)]
            if car[W * j + POSITION] + car[W * j + SPEED] * car[W * j + SPEED] * rules[BRAKING] <= rear - least:
                if not tag[W * j + RESERVED]:
                    tag[W * j + GATE], car[W * j + LINE] = ASIDE, min(car[W * j + LINE], rear)
                break
        return False
    car[W * i + POSITION], car[W * i + MOVED], tag[W * i + NEW], tag[W * i + TOLD] = x, shift, LED, FREE
    find_gate(i, wide, car, tag, road, site, routes, rules)
    site[K * to + QUEUE] = 2
    if p == end:
        site[K * to + TAIL] = i
    site[K * to + COUNT], site[K * k + COUNT] = site[K * to + COUNT] + 1, site[K * k + COUNT] - 1
    return True


@exact
def fits(i, room, v, v_l, share, each, driver):
    """Whether a vehicle of speed ``v`` may be so far behind one of speed ``v_l``."""
    d = i if each > 1 else 0
    room -= 0.5 * (1 + share) * driver[LEAST * each + d]
    return room >= share * v * driver[TIME_GAP * each + d] and v * v - v_l * v_l <= 2 * driver[BRAKE * each + d] * room


@exact
def sort(n, links, car, tag, site):
    """Put those who are here in the order of their links, front first; those of link ``k`` begin at ``begin[k]``."""
    p = 0
    for k in range(links):
        site[K * k + BEGIN] = p
        p += site[K * k + COUNT]
        site[K * k + COUNT] = 0
    site[K * links + BEGIN] = p
    for q in range(n):
        i = tag[W * q + HERE]
        k = tag[W * i + LINK]
        p = site[K * k + BEGIN] + site[K * k + COUNT]
        site[K * k + COUNT] += 1
        while p > site[K * k + BEGIN] and car[W * tag[W * p - W + ORDER] + POSITION] < car[W * i + POSITION]:
            tag[W * p + ORDER] = tag[W * p - W + ORDER]
            p -= 1
        tag[W * p + ORDER] = i


@exact
def follow(n, sizes, car, tag, road, site, routes, rules):
    """Find whom everybody follows; where that is another one the gap is measured anew, else it is what it was."""
    for q in range(n):
        tag[W * tag[W * q + ORDER] + FOLLOWER] = tag[W * q + ORDER]
    for q in range(n):
        i = tag[W * q + ORDER]
        if q > site[K * tag[W * i + LINK] + BEGIN]:
            j, base = tag[W * q - W + ORDER], road[LONG] - road[LONG]
            tag[W * j + FOLLOWER] = i
        else:
            reach = max(rules[REACH], car[W * i + SPEED] * car[W * i + SPEED] * rules[BRAKING])
            j, base = leader_ahead(i, reach, sizes[WIDE], car, tag, road, site, routes)
        car[W * i + BASE] = base
        if j < 0:
            tag[W * i + LEADER], car[W * i + GAP] = i, FAR
        elif j != tag[W * i + LEADER] or tag[W * i + NEW] > SAME:
            tag[W * i + LEADER], tag[W * i + NEW] = j, max(tag[W * i + NEW], LED)
            car[W * i + GAP] = car[W * i + BASE] + car[W * j + POSITION] - car[W * j + LENGTH] - car[W * i + POSITION]
    for q in range(n):  # of several who merge behind one, the first is his follower, unless there is one on his link
        i = tag[W * q + ORDER]
        if q == site[K * tag[W * i + LINK] + BEGIN] and tag[W * tag[W * i + LEADER] + FOLLOWER] == tag[W * i + LEADER]:
            tag[W * tag[W * i + LEADER] + FOLLOWER] = i


@exact
def guard(n, sizes, car, tag, road, site, move, against, routes, rules, driver):
    """Open gates, front first and in the order of links; whoever finds his shut is told to stop at its line."""
    for q in range(n):
        look_ahead(tag[W * q + ORDER], sizes, car, tag, road, site, move, routes, rules, driver)
    for turn in range(2):  # those on links before gates, then those who are further behind
        for k in range(sizes[LINKS]):
            if (site[K * k + OPENS] == GATED) == turn:
                continue
            for q in range(site[K * k + BEGIN], site[K * (k + 1) + BEGIN]):
                i = tag[W * q + ORDER]
                m = tag[W * i + GATE]
                if m == ASIDE:
                    break
                if m < 0 or tag[W * i + RESERVED]:
                    continue
                if turn == 1 and q == site[K * k + BEGIN] and waits_behind(i, m, car, tag):
                    break
                if not passes(i, m, sizes, car, tag, road, site, move, against, routes, rules, driver):
                    break


@exact
def is_closed(m, move):
    """Whether a move is shown red or amber."""
    return move[K * m + SHOWN] == RED or move[K * m + SHOWN] == AMBER


@exact
def look_ahead(i, sizes, car, tag, road, site, move, routes, rules, driver):
    """Note whether a vehicle is about to arrive; what he has reserved ends where it is closed and he can stop.

    Nobody arrives behind somebody who stands before the line, or who stands because he cannot leave the junction, or to
    yield, where all might wait in a circle. In amber and red those alone arrive who count as inside.
    Before a link of a lower limit he brakes as before a closed line, until he is as slow.
    """
    v, k, m, room = car[W * i + SPEED], tag[W * i + LINK], tag[W * i + GATE], car[W * i + LINE] - car[W * i + POSITION]
    tag[W * i + WAITS] = tag[W * i + WAITS] if m == ASIDE else NONE
    car[W * i + LIMIT], slower = road[K * k + FAST], car[W * i + LATER] < min(v, road[K * k + FAST])
    car[W * i + STOP] = road[K * k + LONG] if slower else OPEN
    if m == ASIDE and room < 2 * v * v * rules[BRAKING] + rules[SETBACK]:
        car[W * i + STOP] = min(car[W * i + STOP], car[W * i + LINE] if room >= 0 else road[K * k + LONG])
    if m < 0:
        return
    j = tag[W * i + LEADER]
    stuck = j != i and car[W * j + SPEED] < STANDS and car[W * i + BASE] + car[W * j + POSITION] < car[W * i + LINE]
    stuck = stuck or (v < STANDS and tag[W * i + TOLD] > FREE and move[K * m + SIGNAL] == CIRCLE)
    near = room < rules[CRITICAL_GAP] * max(v, STANDS) and not stuck
    ends = tag[W * i + TOLD] < CLEARS and is_closed(m, move)
    if near and not ends and (v >= STANDS or has_room(i, m, sizes, car, tag, road, site, move, routes, driver)):
        move[K * m + COMING] = i + 1
    if ends and tag[W * i + RESERVED] and v * v * rules[BRAKING] <= room:
        tag[W * i + TOLD] = STOPS
        reserve(i, m, -1, car, tag, road, move)


@exact
def reserve(i, m, sign, car, tag, road, move):
    """Reserve a move for a vehicle (1), or end that (−1)."""
    tag[W * i + RESERVED] = sign > 0
    move[K * m + INSIDE] += sign
    move[K * m + HOLDER] = i
    road[K * move[K * m + END] + HEADING] += sign * car[W * i + LENGTH]


@exact
def waits_behind(i, m, car, tag):
    """Whether somebody is between a vehicle and his line who does not pass it."""
    j = tag[W * i + LEADER]
    before_line = j != i and car[W * i + BASE] + car[W * j + POSITION] < car[W * i + LINE]
    return before_line and not (tag[W * j + RESERVED] and tag[W * j + GATE] == m)


@exact
def passes(i, m, sizes, car, tag, road, site, move, against, routes, rules, driver):
    """Tell a vehicle to stop at his line, or let him drive on and reserve when he is near; return whether he has."""
    room, v, every = car[W * i + LINE] - car[W * i + POSITION], car[W * i + SPEED], rules[EVERY]
    if room >= max(rules[REACH], v * v * rules[BRAKING]):
        return False
    if is_shut(i, m, room, sizes, car, tag, road, site, move, against, routes, rules, driver):
        car[W * i + STOP], tag[W * i + TOLD] = car[W * i + LINE], max(tag[W * i + TOLD], STOPS)
        return False
    if tag[W * i + TOLD] == STOPS:
        tag[W * i + TOLD] = FREE
    if room > v * v * rules[BRAKING] + v * every + rules[MORE]:  # how far he may come until the next event
        return False
    reserve(i, m, 1, car, tag, road, move)
    return True


@exact
def is_shut(i, m, room, sizes, car, tag, road, site, move, against, routes, rules, driver):
    """Whether a gate is shut to a vehicle that is ``room`` (m) before its line.

    Who yields comes as near as he can stop within sight of the line. If he is refused there he counts as inside, as in
    SUMO: in amber and red he goes once no foe is inside, and foes wait for him.
    """
    square, yields = car[W * i + SPEED] * car[W * i + SPEED], against[(sizes[MOVES] + m) * sizes[AGAINST]] >= 0
    can_stop, clears = tag[W * i + TOLD] > FREE or square * rules[BRAKING] <= room, tag[W * i + TOLD] == CLEARS
    if can_stop and not clears and is_closed(m, move):
        return True
    if yields and move[K * m + SHOWN] == YIELD and tag[W * i + TOLD] == STOPS and room < rules[SIGHT]:
        tag[W * i + TOLD] = CLEARS
    for q in range(sizes[AGAINST]):
        f = against[m * sizes[AGAINST] + q]
        if f >= 0 and is_in_the_way(i, f, room, sizes, car, tag, road, move, routes, rules):
            tag[W * i + WAITS] = move[K * f + HOLDER]
            return True
        if f >= 0 and not clears and move[K * f + COMING] > 0 and is_closed(f, move):
            tag[W * i + WAITS] = move[K * f + COMING] - 1
            return True
    if move[K * m + SHOWN] == YIELD and yields:
        brake = driver[BRAKE * sizes[EACH] + (i if sizes[EACH] > 1 else 0)]
        if room > rules[SIGHT] and can_stop and square > 2 * brake * rules[SIGHT]:
            return True
        for q in range(sizes[AGAINST]):
            f = against[(sizes[MOVES] + m) * sizes[AGAINST] + q]
            if f >= 0 and move[K * f + COMING] > 0 and not is_closed(f, move):
                tag[W * i + WAITS] = move[K * f + COMING] - 1
                return True
    return (
        can_stop
        and against[m * sizes[AGAINST]] >= 0
        and not has_room(i, m, sizes, car, tag, road, site, move, routes, driver)
    )


@exact
def is_in_the_way(i, f, room, sizes, car, tag, road, move, routes, rules):
    """Whether somebody is inside on a foe's move, or has reserved it, and will not have left it in time at his speed.

    That is before a vehicle must decide to stop. Until then it reserves nothing: a wrong guess lets no foes meet.
    """
    inside, j, v = move[K * f + INSIDE], move[K * f + HOLDER], car[W * i + SPEED]
    spare = room - v * v * rules[BRAKING] - v * rules[EVERY] - rules[MORE]
    if inside != 1 or spare <= 0:
        return inside > 0
    way, h, k = car[W * j + LENGTH] - car[W * j + POSITION], tag[W * j + HOP], tag[W * j + LINK]
    while k >= 0 and k != move[K * f + END]:
        way += road[K * k + LONG]
        h += 1
        k = next_link(j, h, sizes[WIDE], tag, routes)
    return (way + car[W * j + SPEED] * rules[EVERY]) * max(v, STANDS) > spare * car[W * j + SPEED]


@exact
def has_room(i, m, sizes, car, tag, road, site, move, routes, driver):
    """Whether a vehicle can leave a junction, even if all ahead stop behind the last who stands, or at a link's end."""
    h, k = tag[W * i + HOP] + 1, move[K * m + END]
    while next_link(i, h, sizes[WIDE], tag, routes) != k:
        h += 1
    way, least = road[LONG] - road[LONG], driver[LEAST * sizes[EACH] + (i if sizes[EACH] > 1 else 0)]
    needs = car[W * i + LENGTH] + road[K * k + HEADING] + least
    while k >= 0:
        for q in range(site[K * (k + 1) + BEGIN] - 1, site[K * k + BEGIN] - 1, -1):
            j = tag[W * q + ORDER]
            if j == i or car[W * j + SPEED] < STANDS:
                tag[W * i + WAITS] = j
                return j == i or way + car[W * j + POSITION] - car[W * j + LENGTH] >= needs
            needs += car[W * j + LENGTH] + least
        j = site[K * k + TRAIL]
        if j >= 0 and car[W * j + SPEED] < STANDS:
            tag[W * i + WAITS] = j
            return way + road[K * k + TRAIL_BASE] + car[W * j + POSITION] - car[W * j + LENGTH] >= needs
        way += road[K * k + LONG]
        if way >= needs:
            return True
        h += 1
        own, k = k, next_link(i, h, sizes[WIDE], tag, routes)
        if is_beside(own, k, site):
            return False
    return True
