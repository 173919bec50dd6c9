"""Vehicles that come and go: trips wait in a counted queue where they enter, and enter only where there is room.

One slot per trip, or, where a trip is made ``again``, one slot for many of them in turn. Nobody vanishes and nobody is
moved: at any time ``due = inside + left + queued``, and a queue that grows is an inflow beyond capacity.

Shapes: what belongs to slots is ``[..., n]``; times in s, positions in m.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from idm_env.roads import Road
from idm_env.roads.linked import standing, still_changing, without_absent
from idm_env.step import CarFollowingStep
from idm_env.types import ENTRY_SPEED, FAR, Moving, Params, State, Trips, constant, worthwhile


class Counts(NamedTuple):
    """Trips of every batch row: due by now; of these inside, left, and queued at the entry for want of room or slot."""

    due: Tensor
    inside: Tensor
    left: Tensor
    queued: Tensor


def trips(
    per_hour: Mapping[int, float],
    seconds: float,
    *,
    speed: float = ENTRY_SPEED,
    slots: int | None = None,
    dtype: torch.dtype = torch.float32,
) -> Trips:
    """Return trips that begin evenly in time, so many an hour on each lane, as long as ``seconds``.

    Every lane's first trip is due after one interval. Without ``slots`` every trip has a slot of its own; with it,
    lanes share that many by their inflow, and every slot makes trips again and again, without an end. ``speed`` (m/s)
    is asked for at the entry.

    ValueError for an inflow that is no number above 0, or for no slot for some lane.
    """
    if not per_hour or not all(0.0 < flow < math.inf for flow in per_hour.values()):
        raise ValueError(f"per_hour = {dict(per_hour)} must give every lane that is entered vehicles an hour above 0.")
    if not (0.0 < seconds < math.inf and 0.0 <= speed < math.inf):
        raise ValueError(f"seconds = {seconds:g} and speed = {speed:g} m/s must be numbers above 0.")
    total, flows = sum(per_hour.values()), dict(sorted(per_hour.items()))
    counts = {
        k: int(seconds * flow / 3600.0 + 1e-9 if slots is None else slots * flow / total) for k, flow in flows.items()
    }
    for k, count in counts.items():
        if count < 1:
            raise ValueError(f"no slot for lane {k}: {flows[k]:g} vehicles an hour. Give more seconds, or more slots.")
    departs, again, lane = list[float](), list[float](), list[int]()
    for k, flow in flows.items():
        interval, count = 3600.0 / flow, counts[k]
        departs += [interval * (i + 1) for i in range(count)]
        again += [math.inf if slots is None else interval * count] * count
        lane += [k] * count
    none = torch.zeros(len(lane), dtype=torch.int64)
    begin, later = (torch.tensor(x, dtype=dtype) for x in (departs, again))
    return Trips(begin, later, torch.tensor(lane), torch.full((len(lane),), speed, dtype=dtype), none, none.clone())


def spread(schedule: Trips, shape: tuple[int, ...]) -> Trips:
    """Return the trips with this shape ``(…, vehicles)``."""
    return Trips(*(x.expand(shape).contiguous() for x in schedule))


def waiting(stepping: CarFollowingStep, schedule: Trips, params: Params, *, length: Tensor | float = 5.0) -> State:
    """Return a road on which nobody is yet: everybody waits for his trip.

    ValueError for a road without a beginning, or a lane that does not exist.
    """
    begins = _begins(stepping.road, schedule.speed)
    begin = begins[schedule.lane.clamp(0, len(begins) - 1)]
    state = stepping.state(
        begin, schedule.speed, params, length=length, lane=schedule.lane, present=torch.zeros_like(begin)
    )
    assert state.lanes is not None
    return state._replace(lanes=state.lanes._replace(trips=schedule))


def _begins(road: Road, like: Tensor) -> Tensor:
    """Return where each lane begins (m); ValueError for a road that begins nowhere."""
    outline = road.outline
    if outline is None or outline.ring is not None:
        raise ValueError("trips need a road that begins somewhere: Lanes(count), or Lanes(count, length=…).")
    return constant(tuple(begin for begin, *_ in outline.lanes), like.dtype, like.device)


def due(schedule: Trips, time: Tensor) -> Tensor:
    """Return how many trips of every slot should have begun by a time (s)."""
    more = (time - schedule.departs) / schedule.again.clamp_min(1e-3)
    more = torch.where(schedule.again.isinf(), 0.0, more).floor().clamp_min(0.0).long()
    return torch.where(time >= schedule.departs, 1 + torch.where(schedule.again > 0.0, more, schedule.left), 0)


def counts(stepping: CarFollowingStep, state: State) -> Counts:
    """Return the counts of all trips, by their state; ValueError for a state without any."""
    if state.lanes is None or state.lanes.trips is None or state.present is None:
        raise ValueError("this state has no trips. Make it with multilane.demand.waiting(…).")
    trips = state.lanes.trips
    now = due(trips, stepping.time(state)).expand(state.speed.shape)
    begun, left = (x.expand(state.speed.shape) for x in (trips.entered, trips.left))
    inside = state.present.expand(state.speed.shape) > 0
    return Counts(*(x.sum(-1) for x in (now, inside.long(), left, now - begun)))


def turnover(stepping: CarFollowingStep, state: State, params: Params) -> State:
    """Return the state after those have left who are at the end of their road, and those entered for whom it is time.

    This, too, is done when lanes are decided about: until then whoever is beyond the end drives on, and is followed.
    """
    now = state.clock.remainder(stepping.decides_after) == 0
    return turned(stepping, state, params, now) if worthwhile(now) else state


def turned(stepping: CarFollowingStep, state: State, params: Params, now: Tensor) -> State:
    """Return the state after that, in all rows where it is ``now``."""
    if stepping.road.leaving:
        state = _departed(stepping, state, now)
    return _enter(stepping, state, params, now)


def _departed(stepping: CarFollowingStep, state: State, now: Tensor) -> State:
    """Return the state after those have left who have come to the end of the road: nobody follows them any more."""
    view = stepping.road.view(state)
    stay = view.remaining(state.present, state.position)
    assert stay is not None and state.present is not None and state.lanes is not None
    stay = torch.where(now, stay, state.present)
    lanes, followed = without_absent(state.lanes, stay), view.leader_present(stay, state.speed) > 0
    if lanes.trips is not None:
        left = lanes.trips.left + ((state.present > 0) & (stay <= 0))
        lanes = lanes._replace(trips=lanes.trips._replace(left=left))
    return state._replace(present=stay, gap=torch.where(followed, state.gap, FAR), lanes=lanes)


def _enter(stepping: CarFollowingStep, state: State, params: Params, now: Tensor) -> State:
    """Return the state after due trips with room have entered, one on each lane.

    Of a lane's queue the first enters at the beginning of the lane, where the gap s to the last vehicle there allows::

        s ≥ s0 + v T    and    (v² − v_l²) / 2b ≤ s − s0

    with v the speed that he asks for, or if it must be that of the vehicle ahead (v_l) if that is less. Gradients flow
    through speed and gap, not through who enters when.
    """
    assert state.lanes is not None and state.present is not None
    schedule = state.lanes.trips
    if schedule is None:
        return state
    waits = (state.present <= 0) & (due(schedule, stepping.time(state)) > schedule.entered) & now
    if not worthwhile(waits):
        return state
    begins = _begins(stepping.road, state.speed)
    lanes = torch.arange(len(begins), device=begins.device)
    first, some = _first(waits, schedule, lanes)
    last, followed = _last(state, lanes)
    begins = begins.expand(some.shape)
    gap = torch.where(followed, state.position.gather(-1, last) - state.length.gather(-1, last) - begins, FAR)
    ahead, desired = state.speed.gather(-1, last), schedule.speed.expand_as(state.speed).gather(-1, first)
    driver = stepping.base.driver(dict(params[stepping.base.name]))
    least, time_gap, brake = (
        x.expand_as(state.speed).gather(-1, first) for x in (driver.min_gap, driver.time_gap, driver.comfort_decel)
    )

    def fits(v: Tensor) -> Tensor:
        return (gap >= least + v * time_gap) & ((v.square() - ahead.square()) <= 2.0 * brake * (gap - least))

    fast = fits(desired) | ~followed
    slow = torch.minimum(desired, ahead)
    speed = torch.where(fast, desired, slow)
    goes = some & (fast | fits(slow))
    if state.lanes.moving is not None:  # whoever is still leaving a lane is in the way there
        goes = goes & (_rear_of_leaving(state, lanes) - begins >= least + speed * time_gap)
    return _put_on_road(stepping, state, params, _Entry(goes, first, last, followed, begins, gap, speed))


def _rear_of_leaving(state: State, lanes: Tensor) -> Tensor:
    """Return where the last of those ends who are still leaving each lane (m)."""
    assert state.lanes is not None and state.lanes.moving is not None and state.present is not None
    leaving = still_changing(state) & (state.present > 0)
    mine = leaving.unsqueeze(-2) & (state.lanes.moving.origin.unsqueeze(-2) == lanes.unsqueeze(-1))
    return torch.where(mine, (state.position - state.length).unsqueeze(-2), FAR).amin(-1)


class _Entry(NamedTuple):
    """Candidate entry of each lane, ``(…, lanes)``: whether there is one, slots, position (m), gap (m), speed (m/s)."""

    goes: Tensor
    first: Tensor
    last: Tensor
    followed: Tensor
    begins: Tensor
    gap: Tensor
    speed: Tensor


def _first(waits: Tensor, schedule: Trips, lanes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the slot of each lane's first in the queue, and whether there is one; of equals the lowest slot."""
    more = torch.where(schedule.entered > 0, schedule.entered * schedule.again, 0.0)
    when = torch.where(waits, schedule.departs + more, torch.inf)
    mine = waits.unsqueeze(-2) & (schedule.lane.expand_as(waits).unsqueeze(-2) == lanes.unsqueeze(-1))
    each = torch.where(mine, when.unsqueeze(-2), torch.inf)
    own = torch.arange(waits.shape[-1], device=lanes.device)
    best = torch.where(mine & (each == each.amin(-1, keepdim=True)), own, waits.shape[-1]).amin(-1)
    return best.clamp_max(waits.shape[-1] - 1), mine.any(-1)


def _last(state: State, lanes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the slot of each lane's last vehicle, and whether there is one."""
    assert state.present is not None and state.lanes is not None
    present, follower = state.present > 0, state.lanes.follower
    own = torch.arange(present.shape[-1], device=lanes.device)
    last = present & ((follower == own) | ~present.gather(-1, follower))
    mine = last.unsqueeze(-2) & (state.lanes.lane.unsqueeze(-2) == lanes.unsqueeze(-1))
    return torch.where(mine, own, 0).amax(-1), mine.any(-1)


def _put_on_road(stepping: CarFollowingStep, state: State, params: Params, entry: _Entry) -> State:
    """Return the state with those on the road who enter."""
    assert state.present is not None and state.lanes is not None and state.lanes.trips is not None
    goes, first, last, followed, begins, gap, speed = entry
    links = without_absent(state.lanes, state.present)
    lanes = torch.arange(goes.shape[-1], device=goes.device).expand(goes.shape)
    n = state.speed.shape[-1]

    def put(x: Tensor, value: Tensor, where: Tensor, slots: Tensor) -> Tensor:
        """Return x with values in some slots; what goes nowhere goes into a place of its own, which is cut off."""
        wide = torch.cat((x.expand(state.speed.shape), x.new_zeros(*state.speed.shape[:-1], 1)), -1)
        return wide.scatter(-1, torch.where(where, slots, n), value.to(x.dtype).expand(slots.shape))[..., :n]

    one = torch.ones_like(gap)
    new = put(torch.zeros_like(state.speed), one, goes, first) > 0
    trips = state.lanes.trips
    after = links._replace(
        lane=put(links.lane, lanes, goes, first),
        leader=put(links.leader, torch.where(followed, last, first), goes, first),
        follower=put(put(links.follower, first, goes, first), first, goes & followed, last),
        trips=trips._replace(entered=trips.entered + new),
    )
    begun = state._replace(
        position=put(state.position, begins, goes, first),
        speed=put(state.speed, speed, goes, first),
        accel=torch.where(new, 0.0, state.accel),
        gap=put(state.gap, gap, goes, first),
        present=put(state.present, one, goes, first),
        lanes=after,
    )
    fresh = stepping.remembered(begun, params)
    memory = {
        name: torch.where(new if x.dim() <= new.dim() else new[..., None, None], fresh[name], x)
        for name, x in state.memory.items()
    }
    if after.moving is not None:
        moving = (torch.where(new, x, y) for x, y in zip(standing(begun), after.moving, strict=True))
        after = after._replace(moving=Moving(*moving))
    return begun._replace(memory=memory, lanes=after)
