"""Several lanes side by side: vehicles keep their slot for life, and links say who leads whom.

Between two lane changes the order within a lane does not change, so gaps stay state; ``Lanes.links`` sorts anew only
where somebody changes, comes or goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from idm_env.roads.base import Road
from idm_env.roads.ends import Ending, nearer
from idm_env.roads.order import Order, laps
from idm_env.types import FAR, Links, Neighbour, State, Wish


class Side(NamedTuple):
    """The lane on one side of every vehicle: which, whether it may be entered, and who is there.

    ``gap`` (m) would be the vehicle's own, ``back_gap`` the follower's; both are ``FAR`` where nobody is.
    """

    lane: Tensor
    exists: Tensor
    leader: Tensor
    follower: Tensor
    led: Tensor
    followed: Tensor
    gap: Tensor
    back_gap: Tensor


class Claim(NamedTuple):
    """What becomes of every vehicle's wish: the lane it is granted (or its own), and bool tensors of why not.

    ``follower`` is the slot of whom the change was judged by, ``judged`` whether there is one.
    """

    lane: Tensor
    granted: Tensor
    refused: Tensor
    blocked: Tensor
    follower: Tensor
    judged: Tensor


ENDLESS = 1e9
"""Where a lane ends that does not (m): finite, as all that vehicles see."""


@dataclass(frozen=True)
class End:
    """Where one lane begins and ends (m), and where it may be entered and left sideways; made by the three below.

    At a ``closed`` end stands a virtual leader; from an open one vehicles leave the road. Sideways a lane is open for
    front bumpers from ``opens`` to ``closes``.
    """

    lane: int
    begin: float = -ENDLESS
    end: float = ENDLESS
    closed: bool = True
    opens: float = -ENDLESS
    closes: float = ENDLESS


def lane_drop(lane: int, at: float) -> End:
    """Return the end of a lane that stops at ``at`` (m): whoever is on it must change, or stands there."""
    return End(lane, end=at, closes=at)


def on_ramp(lane: int, begin: float, end: float, entry: float = -ENDLESS) -> End:
    """Return a ramp from ``entry`` on, from which one may merge between ``begin`` and ``end`` (m), where it stops."""
    return End(lane, begin=entry, end=end, opens=begin, closes=end)


def off_ramp(lane: int, begin: float, end: float, leaves: float) -> End:
    """Return a ramp that one may enter between ``begin`` and ``end``, and on which vehicles leave at ``leaves`` (m)."""
    return End(lane, begin=begin, end=leaves, closed=False, opens=begin, closes=end)


@dataclass(frozen=True)
class Lanes(Road):
    """``count`` lanes in one direction, lane 0 on the right: endless, of a ``length`` (m), or a ``ring`` (m).

    At the end of a length vehicles leave the road: ``present`` becomes 0, and they do not come back. ``ends`` are lanes
    that begin or end elsewhere. ``handed`` settles claims of equal utility: to the left is preferred, or to the right.

    Positions on a ring are unwrapped, as on ``Ring``. A vehicle alone in its lane of a ring follows itself.

    ValueError for a lane that does not exist, or a ramp that does not lie on its road.
    """

    count: int = 2
    length: float | None = None
    ring: float | None = None
    ends: tuple[End, ...] = ()
    handed: Literal["left", "right"] = "left"

    def __post_init__(self) -> None:
        object.__setattr__(self, "ends", tuple(self.ends))
        if isinstance(self.count, bool) or not isinstance(self.count, int) or self.count < 1:
            raise ValueError(f"Lanes: count = {self.count!r} must be a whole number of at least 1.")
        if self.length is not None and self.ring is not None:
            raise ValueError(f"Lanes: length = {self.length:g} m and ring = {self.ring:g} m: a road is one of them.")
        for name, size in (("length", self.length), ("ring", self.ring)):
            if size is not None and not 0.0 < size < ENDLESS:
                raise ValueError(f"Lanes: {name} = {size:g} m must lie between 0 and {ENDLESS:g} m.")
        if self.handed not in ("left", "right"):
            raise ValueError(f"Lanes: handed = {self.handed!r} must be 'left' or 'right'.")
        if self.ring is not None and self.ends:
            raise ValueError("Lanes: a ring has no ends. Give a length, or leave the ends out.")
        self._check_ends()

    def _check_ends(self) -> None:
        seen = set()
        for end in self.ends:
            if not 0 <= end.lane < self.count:
                raise ValueError(f"lane {end.lane} does not exist: this road has lanes 0 to {self.count - 1}.")
            if end.lane in seen:
                raise ValueError(f"lane {end.lane} has two ends. Give one for each lane.")
            seen.add(end.lane)
            last = ENDLESS if self.length is None else self.length
            if not end.begin <= max(end.opens, end.begin) < end.closes <= end.end <= last:
                raise ValueError(
                    f"lane {end.lane} opens at {end.opens:g} m, closes at {end.closes:g} m and ends at {end.end:g} m: "
                    f"these must rise, and lie on the road of {last:g} m."
                )

    # -- tables over lanes ---------------------------------------------------------------------------------------

    def _table(self, lane: Tensor, like: Tensor, name: str, none: float) -> Tensor:
        """Return, for each vehicle, a number of its lane: ``none`` for lanes without an end of their own."""
        values = [none] * self.count
        for end in self.ends:
            values[end.lane] = getattr(end, name)
        return torch.tensor(values, dtype=like.dtype, device=like.device)[lane]

    def closed_at(self, lane: Tensor, like: Tensor) -> Tensor:
        """Return where a virtual leader stands on each vehicle's lane (m), ``ENDLESS`` where none does."""
        values = [ENDLESS] * self.count
        for end in self.ends:
            if end.closed:
                values[end.lane] = end.end
        return torch.tensor(values, dtype=like.dtype, device=like.device)[lane]

    def left_at(self, lane: Tensor, like: Tensor) -> Tensor:
        """Return where vehicles leave the road (m)."""
        values = [ENDLESS if self.length is None else self.length] * self.count
        for end in self.ends:
            if not end.closed:
                values[end.lane] = end.end
        return torch.tensor(values, dtype=like.dtype, device=like.device)[lane]

    @property
    def closed(self) -> bool:
        """Whether a lane of this road ends."""
        return any(end.closed for end in self.ends)

    @property
    def leaving(self) -> bool:
        """Whether vehicles leave this road."""
        return self.length is not None or any(not end.closed for end in self.ends)

    def open_between(self, lane: Tensor, to: Tensor, position: Tensor, length: Tensor) -> Tensor:
        """Return whether a vehicle may change from a lane to one beside it here (bool); ``to`` may not exist."""
        there = (to >= 0) & (to < self.count)
        if not self.ends:
            return there
        for each in (lane, to.clamp(0, self.count - 1)):
            there = there & (position - length >= self._table(each, position, "opens", -ENDLESS))
            there = there & (position <= self._table(each, position, "closes", ENDLESS))
        return there

    # -- links ---------------------------------------------------------------------------------------------------

    def links(self, position: Tensor, length: Tensor, lane: Tensor | int | None, present: Tensor | None) -> Links:
        """Return the links of vehicles of these positions, lengths (m) and lanes.

        ValueError for a lane that does not exist, or vehicles that do not fit theirs on a ring.
        """
        if lane is None:
            raise ValueError("a road of several lanes needs each vehicle's lane: state(…, lane=…), 0 on the right.")
        lane = torch.as_tensor(lane, device=position.device)
        if lane.is_floating_point() or lane.dtype == torch.bool:
            raise ValueError(f"lane is a tensor of {lane.dtype}: lanes are whole numbers, 0 on the right.")
        outside = (lane < 0) | (lane >= self.count)
        if bool(outside.any()):
            worst = int(lane[outside].reshape(-1)[0])
            raise ValueError(f"lane {worst} does not exist: this road has lanes 0 to {self.count - 1}.")
        lane = lane.to(torch.int64).expand_as(position)
        if self.ring is not None:
            there = length.detach() if present is None else length.detach() * present
            taken = torch.zeros((*lane.shape[:-1], self.count), dtype=length.dtype, device=length.device)
            taken = taken.scatter_add(-1, lane, there.expand(lane.shape))
            if bool((taken >= self.ring).any()):
                raise ValueError(
                    f"vehicles of {float(taken.max()):g} m in all do not fit a lane of {self.ring:g} m. Take fewer "
                    "vehicles or a longer ring."
                )
        order = Order.of(position, lane, present, self.count, self.ring)
        none = torch.zeros_like(lane)
        return Links(lane, *order.links(), none, none, none, none)

    def view(self, state: State) -> Road:
        """Return the road as it is in this state; ValueError for a state without links."""
        if state.links is None:
            raise ValueError("this state has no links. Make it with simulator.state(…, lane=…).")
        return Linked(self, state.links, state.position)

    def ahead(self, x: Tensor) -> Tensor:
        """Raise TypeError: who leads whom is known in a state only."""
        raise TypeError("lanes are seen through a state: road.view(state).")

    def back(self, x: Tensor) -> Tensor:
        """Raise TypeError."""
        return self.ahead(x)

    def led(self, x: Tensor) -> Tensor:
        """Raise TypeError."""
        return self.ahead(x)

    def gaps(self, position: Tensor, length: Tensor, circumference: Tensor | float | None = None) -> Tensor:
        """Raise TypeError."""
        return self.ahead(position)


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
class Linked(Ending):
    """Lanes as they are in one state: neighbours by its links, ends of lanes merged into the leader."""

    road: Lanes
    links_now: Links
    position: Tensor

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

    def _there(self, slot: Tensor, x: Tensor) -> Tensor:
        if self.road.ring is not None:
            return torch.ones_like(slot, dtype=x.dtype)
        return (slot != torch.arange(slot.shape[-1], device=slot.device)).to(x.dtype)

    def led(self, x: Tensor) -> Tensor:
        """Return 1 for every vehicle with a leader: on a ring for all, be it oneself."""
        return self._there(self.links_now.leader, x)

    def leads(self, x: Tensor) -> Tensor:
        """Return 1 for every vehicle with a follower: on a ring for all, be it oneself."""
        return self._there(self.links_now.follower, x)

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

    def room(self) -> Tensor | None:
        """Return how far each vehicle's lane goes on (m), None where no lane ends."""
        return self.goes_on(self.links_now.lane) if self.road.closed else None

    def before_end(self, leader: Neighbour, lane: Tensor) -> Neighbour:
        """Return whichever is nearer to each vehicle: its leader on a lane, or a standing one at the end of it."""
        return nearer(leader, self.goes_on(lane) if self.road.closed else None)

    def remaining(self, present: Tensor | None, position: Tensor) -> Tensor | None:
        """Return who is still on the road at these positions (m)."""
        if present is None or not self.road.leaving:
            return present
        return present * (position < self.road.left_at(self.links_now.lane, position)).to(present.dtype)

    # -- changes -------------------------------------------------------------------------------------------------

    def goes_on(self, lane: Tensor) -> Tensor:
        """Return how far each vehicle could go on on a lane (m)."""
        return self.road.closed_at(lane, self.position) - self.position

    def order(self, present: Tensor | None) -> Order:
        """Return the vehicles in order."""
        return Order.of(self.position, self.links_now.lane, present, self.road.count, self.road.ring)

    def side(self, order: Order, step: int, state: State) -> Side:
        """Return the lane ``step`` to the left of every vehicle."""
        position, length, lane = self.position, state.length, self.links_now.lane
        to = (lane + step).clamp(0, self.road.count - 1)
        exists = self.road.open_between(lane, lane + step, position, length)
        if state.present is not None:
            exists = exists & (state.present > 0)
        around = order.around(to, position)
        ahead = position.gather(-1, around.leader) - length.gather(-1, around.leader) - position + around.to_leader
        back = position - length - position.gather(-1, around.follower) + around.to_follower
        return Side(
            to, exists, around.leader, around.follower, around.led, around.followed,
            torch.where(around.led, ahead, FAR), torch.where(around.followed, back, FAR),
        )  # fmt: skip

    def follow(
        self, state: State, leaders: Neighbour, slot: Tensor, gap: Tensor, there: Tensor
    ) -> tuple[Neighbour, Neighbour]:
        """Return the vehicle in a slot as a leader at a gap (m), and its own leader as the second one.

        ``leaders`` is everybody's leader; ``there`` is 0 where the slot is nobody's.
        """
        speed = state.speed
        present = there.to(speed.dtype)
        some = present > 0
        leader = Neighbour(
            torch.where(some, gap, FAR),
            torch.where(some, speed.gather(-1, slot), speed),
            torch.where(some, state.accel.gather(-1, slot), 0.0),
            present,
        )
        its = Neighbour(*(x.expand_as(speed).gather(-1, slot) for x in leaders))
        both = (its.present * present) > 0
        second = Neighbour(
            torch.where(both, gap + state.length.gather(-1, slot) + its.gap, FAR),
            torch.where(both, its.speed, speed),
            torch.where(both, its.accel, 0.0),
            its.present * present,
        )
        return leader, second

    def chosen(self, sides: tuple[Side, Side], wish: Wish, due: Tensor) -> Claim:
        """Return what becomes of every wish: the better side that is there, safe and free; per gap the best claim.

        A gap of a lane is known by the vehicle at its front. Of claims of equal utility the one towards the road's
        hand is granted, then the one of the first slot. What overlaps would be no room, whatever a margin says.
        """
        left, right = sides
        hand = self.road.handed == "left"
        may = [
            side.exists & (margin >= 0) & (side.gap > 0) & (side.back_gap > 0)
            for side, margin in ((left, wish.left_margin), (right, wish.right_margin))
        ]
        never = torch.full_like(wish.left, -torch.inf)
        utility = [torch.where(ok, u, never) for ok, u in zip(may, (wish.left, wish.right), strict=True)]
        to_left = utility[0] >= utility[1] if hand else utility[0] > utility[1]
        best = torch.where(to_left, utility[0], utility[1])
        wants = (best > 0) & due
        blocked = due & ~wants & (torch.maximum(wish.left, wish.right) > 0)
        to = torch.where(to_left, left.lane, right.lane)
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
        return Claim(
            torch.where(granted, to, self.links_now.lane), granted, wants & ~granted, blocked, follower, judged
        )

    def changed(self, state: State, claim: Claim) -> State:
        """Return the state after the granted changes: new links, and gaps measured where somebody has a new leader."""
        links = self.links_now
        links = links._replace(
            changed=links.changed + claim.granted,
            refused=links.refused + claim.refused,
            blocked=links.blocked + claim.blocked,
        )
        if not bool(claim.granted.any()):
            return state._replace(links=links)
        order = Order.of(self.position, claim.lane, state.present, self.road.count, self.road.ring)
        leader, follower = order.links()
        other = claim.granted & claim.judged & (follower != claim.follower)
        links = links._replace(lane=claim.lane, leader=leader, follower=follower, unjudged=links.unjudged + other)
        fresh = Linked(self.road, links, self.position).gaps(self.position, state.length)
        return state._replace(links=links, gap=torch.where(leader != self.links_now.leader, fresh, state.gap))


def _most(room: tuple[int, ...], key: Tensor, value: Tensor, how: Literal["amax", "amin"]) -> Tensor:
    """Return, for every vehicle, the largest or smallest value among those of its key."""
    worst = torch.zeros((), dtype=value.dtype, device=value.device)
    if how == "amin":
        worst = worst + value.max()
    elif value.is_floating_point():
        worst = worst + value.min()
    found = worst.expand(room).clone().scatter_reduce(-1, key, value, how)
    return found.gather(-1, key)
