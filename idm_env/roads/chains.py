"""Lanes laid out for a few steps in a row: whoever leads is the slot before, save at the front of each lane.

Between two decisions about lanes nobody's leader changes, so that compiled lanes can run: slots are copied into the
order of their lanes. On a ring each lane has a *halo* of copies at either end, long enough that what goes wrong at
its ends does not reach the vehicles themselves within those steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from idm_env.roads.base import Road
from idm_env.roads.ends import Ending
from idm_env.roads.lanes import Lanes
from idm_env.roads.order import Order
from idm_env.types import FAR, State


class Places(NamedTuple):
    """Which slot every place of a layout is a copy of, and at which place a slot itself is; who leads and is led.

    ``slots``, ``led``, ``leads`` and ``ends`` (m; where a standing leader is) have shape ``(..., places)``, ``own``
    ``(..., vehicles)``.
    """

    slots: Tensor
    own: Tensor
    led: Tensor
    leads: Tensor
    ends: Tensor | None


@dataclass(frozen=True)
class Chains(Road):
    """Lanes behind one another in one row, with standing leaders at their ends where ``closed``."""

    closed: bool = False

    def view(self, state: State) -> Road:
        """Return the chains of a state, whose links are ``Places``."""
        assert isinstance(state.links, Places)
        return _Chained(self, state.links, state.position)

    def ahead(self, x: Tensor) -> Tensor:
        """Return the x of the place before."""
        return torch.cat((x[..., :1], x[..., :-1]), dim=-1)

    def back(self, x: Tensor) -> Tensor:
        """Return the x of the place behind."""
        return torch.cat((x[..., 1:], x[..., -1:]), dim=-1)

    def led(self, x: Tensor) -> Tensor:
        """Raise TypeError: who is led is known in a state only."""
        raise TypeError("chains are seen through a state: road.view(state).")

    def gaps(self, position: Tensor, length: Tensor, circumference: Tensor | float | None = None) -> Tensor:
        """Return ``position[leader] − length[leader] − position`` (m), FAR at the front of a lane."""
        gap = self.ahead(position) - self.ahead(length) - position
        return torch.where(self.led(position) > 0, gap, FAR)


@dataclass(frozen=True, eq=False)
class _Chained(Ending, Chains):
    road: Chains = Chains()
    places: Places | None = None
    position: Tensor | None = None

    def __init__(self, road: Chains, places: Places, position: Tensor) -> None:
        for name, value in (("closed", road.closed), ("road", road), ("places", places), ("position", position)):
            object.__setattr__(self, name, value)

    def led(self, x: Tensor) -> Tensor:
        """Return 1 for every place whose leader is the one before."""
        assert self.places is not None
        return self.places.led.to(x.dtype)

    def leads(self, x: Tensor) -> Tensor:
        """Return 1 for every place whose follower is the one behind."""
        assert self.places is not None
        return self.places.leads.to(x.dtype)

    def room(self) -> Tensor | None:
        """Return how far each lane goes on (m)."""
        assert self.places is not None and self.position is not None
        return self.places.ends - self.position if self.closed and self.places.ends is not None else None


def laid_out(road: Lanes, state: State, halo: int) -> Places | None:
    """Return where the vehicles of a state lie in a row, or None where its links are not the order of positions."""
    links = state.links
    assert links is not None
    order = Order.of(state.position, links.lane, state.present, road.count, road.ring)
    if not torch.equal(order.links()[0], links.leader):
        return None
    front_first = order.slots.flip(-1)
    lane = links.lane.gather(-1, front_first)
    if road.ring is None:
        joined = lane[..., 1:] == lane[..., :-1]
        none = torch.zeros_like(lane[..., :1], dtype=torch.bool)
        kind = state.speed.dtype
        led, leads = torch.cat((none, joined), -1).to(kind), torch.cat((joined, none), -1).to(kind)
        ends = road.closed_at(lane, state.position) if road.closed else None
        return Places(front_first, front_first.argsort(-1), led, leads, ends)
    return _around(road, front_first, lane, halo, state.speed.dtype)


def _around(road: Lanes, front_first: Tensor, lane: Tensor, halo: int, kind: torch.dtype) -> Places:
    """Lay lanes of a ring out one after another, the left one first, each with copies of its other end at both ends."""
    device, n = lane.device, lane.shape[-1]
    each = torch.stack([(lane == k).sum(-1) for k in range(road.count - 1, -1, -1)], -1)
    first = each.cumsum(-1) - each
    wide = torch.where(each > 0, each + 2 * halo, 0)
    begin = wide.cumsum(-1) - wide
    place = torch.arange(n + 2 * halo * road.count, device=device).expand(*lane.shape[:-1], -1).contiguous()
    which = (torch.searchsorted(begin.contiguous(), place, right=True) - 1).clamp(0, road.count - 1)
    # An empty lane begins where the next one does.
    at = place - begin.gather(-1, which) - halo
    size = each.gather(-1, which)
    inside = at < size + halo
    index = (first.gather(-1, which) + at.remainder(size.clamp_min(1))).clamp_max(n - 1)
    slots = front_first.gather(-1, index)
    led = (inside & (at > -halo)).to(kind)
    leads = (inside & (at < size + halo - 1)).to(kind)
    mine = inside & (at >= 0) & (at < size)
    own = torch.empty_like(lane).scatter_(-1, slots[mine].view(lane.shape), place[mine].view(lane.shape))
    return Places(slots, own, led, leads, None)
