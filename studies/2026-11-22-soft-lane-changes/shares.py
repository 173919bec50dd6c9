"""Vehicles on several lanes at once, to a share each: ``decisions="soft"``, and the slopes of ``"surrogate"``.

Nobody chooses. Every vehicle has a share on every lane; the leader on a lane is the first vehicle ahead with the
chance of its share there, the next one where that is not there, and so on; drivers do the mean over lanes and leaders
of what they would do. At a decision shares go over from lane to lane by the chances of ``choices.py``, less the chance
that somebody with a better claim enters the same gap. Every pair of vehicles is looked at in every step: this is for
small scenes. As the temperature goes to 0 all this becomes the hard choice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, cast

import torch
from torch import Tensor

from idm_env.changes import NOW, wished
from idm_env.choices import chances
from idm_env.roads.ends import nearer
from idm_env.roads.linked import Linked
from idm_env.types import FAR, Beside, Choices, Neighbour, Params, Scene, State, Wish

if TYPE_CHECKING:
    from idm_env.step import Stepping


_NOTHING = 1e-9
"""A share that claims nothing: it keeps quotients finite, and their derivatives."""


class _Pairs(NamedTuple):
    """All pairs ``(n, …, n)``, how j stands to i: the gap between them (m), if j is ahead, and whether it can be.

    ``ahead`` and ``behind`` are vehicles from the nearest one on; on a ring everybody is both.
    """

    gap: Tensor
    is_ahead: Tensor
    is_behind: Tensor
    ahead: Tensor
    behind: Tensor


def _paired(view: Linked, state: State) -> _Pairs:
    position, length, ring = state.position, state.length.expand_as(state.position), view.road.ring
    n, dims = position.shape[-1], position.dim()

    def other(x: Tensor) -> Tensor:
        return x.movedim(-1, 0).unsqueeze(-1)

    slot = torch.arange(n, device=position.device)
    first = slot.view(n, *(1,) * dims)
    plain = other(position) - position
    way = plain.detach().double()
    back = -way
    is_ahead = (way > 0) | ((way == 0) & (first < slot))
    is_behind = ~is_ahead & (first != slot)
    if ring is not None:
        way = way.remainder(ring)
        back = ring - way
        plain = plain + (way - plain.detach().double()).to(plain.dtype)
        is_ahead = is_behind = (first != slot).expand_as(way)
    nearest, last = (
        torch.where(there, far, torch.inf).argsort(dim=0, stable=True)
        for there, far in ((is_ahead, way), (is_behind, back))
    )
    return _Pairs(plain - other(length), is_ahead, is_behind, nearest, last)


class _Met(NamedTuple):
    """Chances of each vehicle to be the first that is met on a lane, ``(lanes, n, …, n)``; of nobody at all.

    ``clear`` is that of nobody before each of them.
    """

    first: Tensor
    nobody: Tensor
    clear: Tensor


def _met(shares: Tensor, order: Tensor, possible: Tensor) -> _Met:
    """Return who is met in an order; ``shares`` ``(lanes, n, …, 1)`` are how much of each vehicle is on a lane."""
    there = torch.where(possible, shares, 0.0)
    index = order.expand_as(there)
    in_order = there.gather(1, index)
    past = torch.cat((torch.ones_like(in_order[:, :1]), (1.0 - in_order).cumprod(1)), 1)
    clear = torch.zeros_like(there).scatter(1, index, past[:, :-1])
    return _Met(there * clear, past[:, -1], torch.where(possible, clear, 0.0))


class _Lanes(NamedTuple):
    """Every lane as every vehicle sees it: whom it would meet ahead and behind, and scenes behind each leader.

    The scene's leaders have a lane (one for all where none ends) and a vehicle before all other dimensions, the last of
    whom is nobody: on a ring oneself. ``ends`` (m) is how far each lane goes on.
    """

    ahead: _Met
    behind: _Met
    scene: Scene
    ends: Tensor

    def mean(self, each: Tensor) -> Tensor:
        """Return the mean over leaders, ``(lanes, …, n)``."""
        return (self.ahead.first * each[:, :-1]).sum(1) + self.ahead.nobody * each[:, -1]

    def one_gap(self) -> Tensor:
        """Return the chance that two vehicles would enter the same gap of a lane, ``(lanes, n, …, n)``."""
        return 1.0 - (1.0 - self.ahead.clear) * (1.0 - self.behind.clear)


def _seen(view: Linked, choices: Choices, state: State, scene: Scene) -> _Lanes:
    road, position, present = view.road, state.position, state.present
    n, dims = position.shape[-1], position.dim()
    pairs = _paired(view, state)
    shares = choices.shares if present is None else choices.shares * present.unsqueeze(-1)
    shares = shares.movedim((-1, -2), (0, 1)).unsqueeze(-1)
    ahead = _met(shares, pairs.ahead, pairs.is_ahead)
    behind = _met(shares, pairs.behind, pairs.is_behind)
    slots = torch.arange(n, device=position.device).view(n, *(1,) * dims).expand(pairs.gap.shape)
    leader, second = view.follow(state, scene.leader, slots, pairs.gap, pairs.is_ahead.expand_as(pairs.gap))
    far, zero = torch.full_like(position, FAR), torch.zeros_like(position)
    none = oneself = Neighbour(far, scene.speed, zero, zero)
    if road.ring is not None:
        oneself = Neighbour(road.ring - state.length.expand_as(position), scene.speed, scene.accel, zero + 1.0)

    def with_last(every: Neighbour, last: Neighbour) -> Neighbour:
        pairs = zip(every, last, strict=True)
        return Neighbour(*(torch.cat((x, y.expand_as(position).unsqueeze(0))).unsqueeze(0) for x, y in pairs))

    leader, second = with_last(leader, oneself), with_last(second, none)
    lanes = torch.arange(road.count, device=position.device).view(-1, *(1,) * dims).expand(-1, *position.shape)
    ends = road.closed_at(lanes, position) - position
    if road.closed:
        shape = (road.count, *leader.gap.shape[1:])
        wide = Neighbour(*(x.expand(shape) for x in leader))
        leader = nearer(wide, ends.unsqueeze(1))
        second = second._replace(present=second.present * (leader.gap == wide.gap))
    there = scene._replace(leader=leader, second_leader=scene.second_leader and second, history=NOW)
    return _Lanes(ahead, behind, there, ends)


def mixed(stepping: Stepping, state: State, scene: Scene, params: Params, accel: Tensor) -> Tensor:
    """Return accelerations (m/s²): means over lanes and leaders, or with ``surrogate`` with that slope."""
    assert state.choices is not None
    if stepping.decisions == "surrogate" and not torch.is_grad_enabled():
        return accel
    view = cast(Linked, stepping.road.view(state))
    lanes = _seen(view, state.choices, state, scene)
    each = stepping.answered(lanes.scene, params)[0]
    shares = state.choices.shares.movedim(-1, 0)
    if stepping.decisions == "soft":
        return (lanes.mean(each) * shares).sum(0)
    # What each of them leads to has its gradient in the acceleration already.
    mean = (lanes.mean(each.detach()) * shares).sum(0)
    return accel + (mean - mean.detach())


def _place(lanes: _Lanes, each: Tensor, count: int) -> Beside:
    """Return every lane as a place to be, from what drivers would want behind each leader."""
    shape = (count, *each.shape[1:])
    some = lanes.behind.first.sum(1)
    flat = each.expand(shape).reshape(*shape[:2], -1, shape[-1])
    behind, alone = flat[:, :-1], flat[:, -1]
    leads, follows = (x.first.reshape(behind.shape) for x in (lanes.ahead, lanes.behind))
    nobody = lanes.ahead.nobody.reshape(alone.shape)
    # k lanes, b rows, i the driver, j his follower, l his leader; `behind` has whom, then who.
    with_me = torch.einsum("kjbi,kibj->kbi", follows, behind)
    without_me = torch.einsum("kjbi,klbi,klbj->kbi", follows, leads, behind)
    without_me = without_me + torch.einsum("kjbi,kbi,kbj->kbi", follows, nobody, alone)
    leader = Neighbour(*(lanes.mean(x.expand(shape)) for x in lanes.scene.leader))
    follower = Neighbour(torch.full_like(some, FAR), lanes.scene.speed.expand_as(some), torch.zeros_like(some), some)
    return Beside(
        torch.ones_like(some), leader, follower, lanes.mean(each), with_me.view_as(some), without_me.view_as(some),
        lanes.ends,
    )  # fmt: skip


def _beside(place: Beside, step: int, exists: Tensor) -> Beside:
    """Return, for every lane, the one ``step`` to the left of it."""

    def moved(one: Neighbour) -> Neighbour:
        return Neighbour(*(x.roll(-step, 0) for x in one))

    return Beside(
        exists.to(place.exists.dtype), moved(place.leader), moved(place.follower),
        *(x.roll(-step, 0) for x in place[3:]),
    )  # fmt: skip


def gone_over(stepping: Stepping, choices: Choices, state: State, scene: Scene, params: Params) -> Tensor:
    """Return the shares ``(…, n, lanes)`` after a decision: from every lane they go over by the chances there."""
    view = cast(Linked, stepping.road.view(state))
    lanes = _seen(view, choices, state, scene)
    each = stepping.wanted(lanes.scene, params)[0]
    place = _place(lanes, each, view.road.count)
    index = torch.arange(view.road.count, device=each.device).view(-1, *(1,) * state.position.dim())
    index = index.expand_as(place.exists)
    left, right = (view.road.open_between(index, index + step, state.position, state.length) for step in (1, -1))
    there = scene._replace(here=place, left=_beside(place, 1, left), right=_beside(place, -1, right), history=NOW)
    wish = wished(stepping, there, params)
    now = choices.shares.movedim(-1, 0)
    to_left, _, to_right = chances(wish, left, right, stepping.temperature)
    # By the lane that is entered: from its right, and from its left.
    entering = _from(now * to_left, 1), _from(now * to_right, -1)
    claim = _worth(wish, entering)
    better = torch.sigmoid((claim.movedim(-1, 1).unsqueeze(-1) - claim.unsqueeze(1)) / stepping.temperature)
    others = (entering[0] + entering[1]).movedim(-1, 1).unsqueeze(-1)
    granted = (1.0 - others * better * lanes.one_gap()).prod(1)
    come = tuple(x * granted for x in entering)
    return (now + come[0] + come[1] - _from(come[0], -1) - _from(come[1], 1)).movedim(0, -1)


def _from(x: Tensor, step: int) -> Tensor:
    """Return, for every lane, what stands for the one ``step`` to the right of it: 0 where there is none."""
    edge = torch.zeros_like(x[:1])
    return torch.cat((edge, x[:-1])) if step > 0 else torch.cat((x[1:], edge))


def _worth(wish: Wish, entering: tuple[Tensor, Tensor]) -> Tensor:
    """Return each vehicle's utility of entering each lane (m/s²), the mean over the lanes that it would come from."""
    from_right, from_left = entering
    worth = _from(wish.left, 1) * from_right + _from(wish.right, -1) * from_left
    return worth / (from_right + from_left + _NOTHING)
