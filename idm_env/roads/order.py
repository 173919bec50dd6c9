"""Vehicles of several lanes in order: by lane, and from rear to front within a lane."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Around(NamedTuple):
    """The vehicles next to a place on a lane: their slots, one's own where there is nobody, and whether there are.

    ``to_leader`` and ``to_follower`` are what ``position[leader] − position`` and ``position − position[follower]``
    lack on a ring: laps (m).
    """

    leader: Tensor
    follower: Tensor
    led: Tensor
    followed: Tensor
    to_leader: Tensor
    to_follower: Tensor


class Order(NamedTuple):
    """Slots by lane and place, absent ones last; ``keys`` are their ``lane · width + place``.

    All of shape ``(..., vehicles)``; ``width`` (m, one per row) is larger than any distance. Sorting and searching know
    no derivatives, and are done in float64 whatever the positions are.
    """

    slots: Tensor
    keys: Tensor
    place: Tensor
    lane: Tensor
    width: Tensor
    ring: float | None

    @classmethod
    def built(cls, position: Tensor, lane: Tensor, present: Tensor | None, count: int, ring: float | None) -> Order:
        """Return the order of vehicles at these positions (m), unwrapped on a ring."""
        place = places(position, ring)
        if present is not None:
            lane = torch.where(present.expand_as(place) > 0, lane, count)
        if ring is None:
            place = place - place.amin(-1, keepdim=True)
        width = place.amax(-1, keepdim=True) + 1.0
        keys, slots = (lane * width + place).sort(dim=-1, stable=True)
        return cls(slots, keys, place, torch.where(lane < count, lane, -1), width, ring)

    def links(self) -> tuple[Tensor, Tensor]:
        """Return leader and follower of every slot."""
        own = torch.arange(self.slots.shape[-1], device=self.slots.device).expand_as(self.slots)
        lane = self.lane.gather(-1, self.slots)
        on_lane = lane >= 0
        joined = (lane[..., 1:] == lane[..., :-1]) & on_lane[..., 1:]
        none = torch.zeros_like(joined[..., :1]) if joined.shape[-1] else torch.zeros_like(on_lane[..., :1])
        led, followed = torch.cat((joined, none), -1), torch.cat((none, joined), -1)
        leader, follower = self.slots.roll(-1, -1), self.slots.roll(1, -1)
        if self.ring is None:
            leader, follower = torch.where(led, leader, self.slots), torch.where(followed, follower, self.slots)
        else:
            low, high = self._ends(lane)
            first, last = (self._slot(index) for index in (low, high - 1))
            leader = torch.where(led, leader, torch.where(on_lane, first, self.slots))
            follower = torch.where(followed, follower, torch.where(on_lane, last, self.slots))
        return own.scatter(-1, self.slots, leader), own.scatter(-1, self.slots, follower)

    def _ends(self, lane: Tensor) -> tuple[Tensor, Tensor]:
        """Return where each of these lanes begins and ends in the order."""
        keys = self.keys.contiguous()
        low = torch.searchsorted(keys, (lane * self.width).contiguous())
        return low, torch.searchsorted(keys, ((lane + 1) * self.width).contiguous())

    def _slot(self, index: Tensor) -> Tensor:
        return self.slots.gather(-1, index.clamp(0, self.slots.shape[-1] - 1))

    def around(self, lane: Tensor, position: Tensor) -> Around:
        """Return the neighbours ahead of and behind every vehicle on these lanes, which are not its own.

        Who is exactly beside counts as behind: with a gap of minus one's own length.
        """
        own = torch.arange(self.slots.shape[-1], device=self.slots.device).expand_as(self.slots)
        low, high = self._ends(lane)
        query = (lane * self.width + self.place).contiguous()
        index = torch.searchsorted(self.keys.contiguous(), query, right=True)
        some = high > low
        before, after = some & (index < high), some & (index > low)
        leader, follower = self._slot(index), self._slot(index - 1)
        zero = torch.zeros_like(position)
        if self.ring is None:
            leader, follower = torch.where(before, leader, own), torch.where(after, follower, own)
            return Around(leader, follower, before, after, zero, zero)
        leader = torch.where(some, torch.where(before, leader, self._slot(low)), own)
        follower = torch.where(some, torch.where(after, follower, self._slot(high - 1)), own)
        ahead = self.place.gather(-1, leader) - self.place + self.ring * (~before)
        behind = self.place - self.place.gather(-1, follower) + self.ring * (~after)
        laps = missing(ahead, leader, position, self.ring), -missing(-behind, follower, position, self.ring)
        return Around(leader, follower, some, some, *laps)


def laps(position: Tensor, leader: Tensor, ring: float) -> Tensor:
    """Return the whole laps (m) to add to ``position[leader] − position`` on a ring, elementwise.

    The leader is less than a lap ahead; who follows himself is a lap behind himself.
    """
    place = places(position, ring)
    way = place.gather(-1, leader) - place
    own = leader == torch.arange(leader.shape[-1], device=leader.device)
    return missing(torch.where((way < 0) | own, way + ring, way), leader, position, ring)


def missing(way: Tensor, other: Tensor, position: Tensor, ring: float) -> Tensor:
    """Return the laps (m), elementwise, by which ``position[other] − position`` falls short of a known ``way`` (m)."""
    plain = position.detach().double()
    return (ring * ((way - (plain.gather(-1, other) - plain)) / ring).round()).to(position.dtype)


def places(position: Tensor, ring: float | None) -> Tensor:
    """Return positions (m), shape as given, in float64, without a graph, and within one lap of a ring."""
    plain = position.detach().double()
    return plain if ring is None else plain.remainder(ring)
