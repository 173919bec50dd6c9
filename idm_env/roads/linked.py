"""Lanes as they are in one state: neighbours by its links, and the changes that a decision makes.

Shapes: what belongs to vehicles is ``[..., n]``; slots are indices into the last dimension, laps are counts.
"""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from idm_env.roads.adjacent import Preference, Side, Sideways
from idm_env.roads.ends import either
from idm_env.roads.layout import LaneLayout
from idm_env.roads.merging import on_lanes
from idm_env.roads.order import Order, laps
from idm_env.types import FAR, LaneState, Moving, Neighbour, State, worthwhile


class Claim(NamedTuple):
    """Outcome of every vehicle's wish: the lane it is granted (or its own), and bool tensors of why not.

    ``follower`` is the slot of whom the change was judged by, ``judged`` whether there is one. ``signals`` is where
    those look who were not granted it (1 left, −1 right, 0 nowhere).
    """

    lane: Tensor
    granted: Tensor
    refused: Tensor
    blocked: Tensor
    follower: Tensor
    judged: Tensor
    signals: Tensor


def still_changing(state: State) -> Tensor:
    """Return a mask of the vehicles still leaving a lane (bool)."""
    assert state.lanes is not None and state.lanes.moving is not None
    return state.lanes.moving.until > state.clock


def standing(state: State) -> Moving:
    """Return the changes of vehicles of which none is changing lanes."""
    assert state.lanes is not None
    own = torch.arange(state.speed.shape[-1], device=state.speed.device).expand_as(state.lanes.lane)
    return Moving(state.lanes.lane, torch.full_like(own, torch.iinfo(own.dtype).min), own)


def without_absent(links: LaneState, present: Tensor | None) -> LaneState:
    """Return links that no longer lead to absent vehicles, whose slots may be reused."""
    if present is None:
        return links
    own = torch.arange(present.shape[-1], device=present.device).expand_as(present)
    on_road = present > 0
    leader, follower = (
        torch.where(on_road & on_road.gather(-1, slot), slot, own) for slot in (links.leader, links.follower)
    )
    return links._replace(leader=leader, follower=follower)


class _Look(torch.autograd.Function):
    """``x[to]`` where ``to`` and ``fro`` are inverse: the adjoint is a gather, too, always in the same order."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, to: Tensor, fro: Tensor) -> Tensor:
        return x.gather(-1, to)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        _, to, fro = inputs
        ctx.save_for_backward(to, fro)
        ctx.save_for_forward(to, fro)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        to, fro = ctx.saved_tensors
        own = torch.arange(to.shape[-1], device=to.device)
        zero = torch.zeros_like(g)
        # What nobody but oneself has read comes back by `to`; whom nobody follows has himself as follower.
        return torch.where(to == own, g, zero) + torch.where(fro == own, zero, g.gather(-1, fro)), None, None

    @staticmethod
    def jvp(ctx: Any, g: Tensor, *_: Any) -> Tensor:
        to, _fro = ctx.saved_tensors
        return g.gather(-1, to)


@dataclass(frozen=True, eq=False)
class Linked(Sideways):
    """Lanes in one state: neighbours by its links; ends of lanes and leaving vehicles merged into leaders."""

    road: LaneLayout
    links_now: LaneState
    position: Tensor
    shadow: Tensor | None = None
    length: Tensor | None = None

    def _look(self, x: Tensor, to: Tensor, fro: Tensor) -> Tensor:
        if x.shape != to.shape:
            shape = torch.broadcast_shapes(x.shape, to.shape)
            x, to, fro = x.expand(shape), to.expand(shape), fro.expand(shape)
        return _Look.apply(x, to, fro) if x.requires_grad else x.gather(-1, to)

    def ahead(self, x: Tensor) -> Tensor:
        """Return the leader's x; one's own without a leader."""
        return self._look(x, self.links_now.leader, self.links_now.follower)

    def back(self, x: Tensor) -> Tensor:
        """Return the follower's x; one's own without a follower."""
        return self._look(x, self.links_now.follower, self.links_now.leader)

    def _linked(self, slot: Tensor, x: Tensor) -> Tensor:
        if self.road.ring is not None:
            return torch.ones_like(slot, dtype=x.dtype)
        return (slot != torch.arange(slot.shape[-1], device=slot.device)).to(x.dtype)

    def led(self, x: Tensor) -> Tensor:
        """Return 1 for every vehicle with a leader: on a ring for all, be it oneself."""
        return self._linked(self.links_now.leader, x)

    def leads(self, x: Tensor) -> Tensor:
        """Return 1 for every vehicle with a follower: on a ring for all, be it oneself."""
        return self._linked(self.links_now.follower, x)

    def gaps(self, position: Tensor, length: Tensor, circumference: Tensor | float | None = None) -> Tensor:
        """Return ``position[leader] − length[leader] − position`` (m), laps added on a ring; FAR without a leader.

        ValueError for a circumference that is given here.
        """
        if circumference is not None:
            raise ValueError(f"the circumference of lanes stands in Lanes(ring=…), and {circumference} was given.")
        gap = self.ahead(position) - self.ahead(length) - position
        if self.road.ring is None:
            return torch.where(self.led(position) > 0, gap, FAR)
        return gap + laps(position, self.links_now.leader, self.road.ring)

    def gaps_of(self, which: Tensor, position: Tensor, length: Tensor) -> Tensor:
        """Return the gaps of some vehicles, by their places in all rows together (m)."""
        n = position.shape[-1]
        mine = self.links_now.leader.reshape(-1)[which]
        ahead = which - which.remainder(n) + mine
        two = torch.stack([position.reshape(-1)[i] for i in (ahead, which)], -1)
        gap = two[:, 0] - length.reshape(-1)[ahead] - two[:, 1]
        leading_self = ahead == which
        if self.road.ring is None:
            return torch.where(leading_self, FAR, gap)
        return gap + laps(two, torch.stack((torch.zeros_like(which), leading_self.long()), -1), self.road.ring)[:, 1]

    def room(self) -> Tensor | None:
        """Return how far each vehicle's lane goes on (m), None where no lane ends."""
        return self.goes_on() if self.road.closed else None

    def remaining(self, present: Tensor | None, position: Tensor) -> Tensor | None:
        """Return presence (1 or 0) of the vehicles still on the road at these positions (m)."""
        if present is None or not self.road.leaving:
            return present
        return present * (position < self.road.left_at(self.links_now.lane, position)).to(present.dtype)

    def placed(self, state: State, lane: Tensor, after: State) -> State:
        """Return the state ``after`` a step in which records give vehicles' lanes, with gaps to new leaders.

        Whoever is placed may be anywhere, so all are laid out anew.
        """
        before, position = self.links_now, after.position
        lane = torch.where(lane >= 0, lane, before.lane)
        leader, follower = Order.built(position, lane, after.present, self.road.count, self.road.ring).links()
        changed = lane != before.lane
        for mask in (state.present, after.present):
            changed = changed if mask is None else changed & (mask > 0)
        lanes = before._replace(lane=lane, leader=leader, follower=follower, changed=before.changed + changed)
        fresh = Linked(self.road, lanes, position).gaps(position, state.length)
        return on_lanes(after._replace(lanes=lanes, gap=torch.where(leader == before.leader, after.gap, fresh)))

    # -- who is still leaving a lane ------------------------------------------------------------------------------

    def leader(self, gap: Tensor, speed: Tensor, accel: Tensor, present: Tensor) -> Neighbour:
        """Return the nearest of the leader, the end of the lane and a vehicle still leaving it."""
        nearest = super().leader(gap, speed, accel, present)
        if self.shadow is None:
            return nearest
        way = self._to_shadow()
        ahead = way, self.at(speed, self.shadow), self.at(accel, self.shadow), 1.0
        return either(way < nearest.gap, ahead, nearest)

    def second_leader(self, leader: Neighbour, length: Tensor, speed: Tensor) -> Neighbour:
        """Return the leader's leader; beyond somebody who is leaving nobody is seen."""
        second = super().second_leader(leader, length, speed)
        if self.shadow is None:
            return second
        return either(self._to_shadow() <= leader.gap, (FAR, speed, 0.0, 0.0), second)

    def _to_shadow(self) -> Tensor:
        assert self.shadow is not None and self.length is not None
        return self.to_slot(self.position, self.length, self.shadow)

    def to_slot(self, position: Tensor, length: Tensor, slot: Tensor) -> Tensor:
        """Return the gap to the vehicle of a slot, less than a lap ahead (m); FAR for one's own."""
        gap = self.at(position, slot) - self.at(length, slot) - position
        if self.road.ring is not None:
            gap = gap + laps(position, slot, self.road.ring)
        return torch.where(slot == torch.arange(slot.shape[-1], device=slot.device), FAR, gap)

    def _leaving(self, state: State) -> Order:
        """Return those who are still leaving a lane, in order."""
        assert state.lanes is not None and state.lanes.moving is not None
        leaving = still_changing(state)
        if state.present is not None:
            leaving = leaving & (state.present > 0)
        origin, position = state.lanes.moving.origin, state.position
        return Order.built(position, origin, leaving.to(position.dtype), self.road.count, self.road.ring)

    def with_leaving(self, state: State, sides: tuple[Side, Side]) -> tuple[Side, Side]:
        """Return the adjacent lanes; vehicles still changing out of them are neighbours where they are nearer."""
        order, lanes = self._leaving(state), []
        for side, step in zip(sides, (1, -1), strict=True):
            other = self.look(state, side.exists, *order.around(self.to(step), state.position), side.ends)
            ahead, behind = other.gap < side.gap, other.back_gap < side.back_gap
            leader, led = torch.where(ahead, other.leader, side.leader), side.led | ahead
            follower, followed = torch.where(behind, other.follower, side.follower), side.followed | behind
            gap, back_gap = torch.where(ahead, other.gap, side.gap), torch.where(behind, other.back_gap, side.back_gap)
            lanes.append(Side(side.exists, leader, follower, led, followed, gap, back_gap, side.ends))
        return lanes[0], lanes[1]

    def on_the_way(self, before: State, after: State, claim: Claim, steps: int, turn: Tensor) -> State:
        """Return the state after a decision whose granted lane changes last ``steps`` steps.

        ``turn`` (bool, ``(…, 1)``) are the rows that decide.
        """
        assert before.lanes is not None and after.lanes is not None
        moving = before.lanes.moving or standing(before)
        until = torch.where(claim.granted, before.clock + steps, moving.until)
        moving = Moving(torch.where(claim.granted, before.lanes.lane, moving.origin), until, moving.shadow)
        lanes = after.lanes
        around = self._leaving(after._replace(lanes=lanes._replace(moving=moving))).around(lanes.lane, after.position)
        shadow = torch.where(turn, around.leader, moving.shadow)
        return after._replace(lanes=lanes._replace(moving=moving._replace(shadow=shadow)))

    # -- changes -------------------------------------------------------------------------------------------------

    def at(self, x: Tensor, slot: Tensor) -> Tensor:
        """Return the x of the vehicles in some slots; what is the same for all vehicles stays."""
        shape = slot.shape
        if x.dim() == 0 or x.shape[-1] != shape[-1] or shape[-1] == 1 or x.dim() > len(shape):
            return x
        return x.expand(shape).gather(-1, slot)

    def beyond(self) -> Tensor:
        """Return the slot of each leader's leader."""
        return self.ahead(self.links_now.leader)

    def goes_on(self) -> Tensor:
        """Return how far each vehicle could go on on its lane (m)."""
        return self.road.closed_at(self.links_now.lane, self.position) - self.position

    def order(self, present: Tensor | None) -> Order:
        """Return the vehicles in order."""
        return Order.built(self.position, self.links_now.lane, present, self.road.count, self.road.ring)

    def to(self, step: int) -> Tensor:
        """Return the lane ``step`` to the left of every vehicle, its own where there is none."""
        return (self.links_now.lane + step).clamp(0, self.road.count - 1)

    def side(self, order: Order, step: int, state: State) -> Side:
        """Return the lane ``step`` to the left of every vehicle."""
        position, lane = self.position, self.links_now.lane
        to = self.to(step)
        around = order.around(to, position)
        is_open = self.road.open_between(lane, lane + step, position, state.length)
        return self.look(state, is_open, *around, self.road.closed_at(to, position) - position)

    def chosen(self, sides: tuple[Side, Side], prefers: Preference, due: Tensor) -> Claim:
        """Return the outcome of every wish: per gap the best claim is granted.

        A gap of a lane is known by the vehicle at its front. Of claims of equal utility the one towards the road's
        hand is granted, then the one of the first slot.
        """
        left, right = sides
        hand = self.road.handed == "left"
        best, to_left, wants, blocked, signals = prefers
        wants, blocked = wants & due, blocked & due
        never = torch.full_like(best, -torch.inf)
        to = torch.where(to_left, self.to(1), self.to(-1))
        led = torch.where(to_left, left.led, right.led)
        count = best.shape[-1]
        gap = torch.where(led, torch.where(to_left, left.leader, right.leader), count + to)
        room = (*best.shape[:-1], count + self.road.count)
        granted = wants & (best == _most(room, gap, torch.where(wants, best, never), "amax"))
        hands = granted & (to_left == hand)
        granted = granted & (hands | ~_most(room, gap, hands.to(best.dtype), "amax").bool())
        own = torch.arange(count, device=best.device).expand_as(gap)
        granted = granted & (own == _most(room, gap, torch.where(granted, own, count), "amin"))
        follower = torch.where(to_left, left.follower, right.follower)
        judged = torch.where(to_left, left.followed, right.followed)
        lane, refused = torch.where(granted, to, self.links_now.lane), wants & ~granted
        return Claim(lane, granted, refused, blocked, follower, judged, torch.where(due & ~granted, signals, 0.0))

    def mergers(self, state: State, sides: tuple[Side, Side], claim: Claim) -> Tensor:
        """Return for each vehicle the slot of the vehicle signalling to merge ahead of it; its own slot if none.

        Of two the one whose front is nearer, then the first slot.
        """
        left, right = sides
        own = torch.arange(claim.lane.shape[-1], device=claim.lane.device).expand_as(claim.lane)
        to_left = claim.signals > 0
        asks = (claim.signals != 0) & torch.where(to_left, left.followed, right.followed)
        target = torch.where(asks, torch.where(to_left, left.follower, right.follower), own)
        way = torch.where(to_left, left.back_gap, right.back_gap) + state.length
        shape = tuple(claim.lane.shape)
        nearest = asks & (way == _most(shape, target, torch.where(asks, way, FAR), "amin"))
        count = own.shape[-1]
        first = torch.full_like(own, count).scatter_reduce(-1, target, torch.where(nearest, own, count), "amin")
        return torch.where((first < count) & ~claim.granted, first, own)

    def changed(self, state: State, claim: Claim) -> State:
        """Return the state after the granted changes: new links, and gaps measured where somebody has a new leader."""
        links = self.links_now
        links = links._replace(
            changed=links.changed + claim.granted,
            refused=links.refused + claim.refused,
            blocked=links.blocked + claim.blocked,
        )
        if not worthwhile(claim.granted):
            return state._replace(lanes=links)
        order = Order.built(self.position, claim.lane, state.present, self.road.count, self.road.ring)
        # Where nobody changes lanes links stay what they are.
        some = claim.granted.any(-1, keepdim=True)
        before = self.links_now.leader, self.links_now.follower
        leader, follower = (torch.where(some, new, old) for new, old in zip(order.links(), before, strict=True))
        other = claim.granted & claim.judged & (follower != claim.follower)
        links = links._replace(lane=claim.lane, leader=leader, follower=follower, unjudged=links.unjudged + other)
        fresh = Linked(self.road, links, self.position).gaps(self.position, state.length)
        return state._replace(lanes=links, gap=torch.where(leader != self.links_now.leader, fresh, state.gap))


def _most(room: tuple[int, ...], key: Tensor, value: Tensor, how: Literal["amax", "amin"]) -> Tensor:
    """Return, for every vehicle, the largest or smallest value among those of its key."""
    ends = (torch.finfo if value.is_floating_point() else torch.iinfo)(value.dtype)
    worst = value.new_full(room, ends.max if how == "amin" else ends.min)
    return worst.scatter_reduce(-1, key, value, how).gather(-1, key)
