"""The lanes beside a vehicle: who would be ahead and behind there, and which side is better.

What stands here is arithmetic of one vehicle and its neighbours. ``roads.linked`` runs it on tensors and gathers;
``scalar.wishes`` records it, with places in lanes instead of slots, and prints it.

Shapes: everything is of one vehicle, ``[]`` in a recording and ``[..., n]`` in tensors, in SI units.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from idm_env.roads.base import if_present
from idm_env.roads.ends import Ending, nearer
from idm_env.types import FAR, Neighbour, State, Wish


class Side(NamedTuple):
    """The lane on one side of every vehicle: whether it may be entered, and the neighbours there.

    ``gap`` (m) would be the vehicle's own, ``back_gap`` the follower's; both are ``FAR`` where nobody is. ``ends`` is
    how far the vehicle could go on there (m); ``leader`` and ``follower`` are slots.
    """

    exists: Tensor
    leader: Any
    follower: Any
    led: Tensor
    followed: Tensor
    gap: Tensor
    back_gap: Tensor
    ends: Tensor


class Preference(NamedTuple):
    """The better side of every vehicle: its utility (m/s²), whether it is the left one, and bool tensors.

    ``wants`` is a wish for a side that is there, safe and free; ``blocked`` one that comes to nothing. ``signals`` is 1
    where some effect wishes for the left, be it safe or not, −1 for the right, 0 for neither.
    """

    utility: Tensor
    to_left: Tensor
    wants: Tensor
    blocked: Tensor
    signals: Tensor


def is_open_beside(position: Tensor, length: Tensor, opens: Tensor, closes: Tensor) -> Tensor:
    """Return whether a vehicle is, with all of its length, where a lane may be entered and left sideways (bool)."""
    return (position - length >= opens) & (position <= closes)


def preferred(left: Side, right: Side, wish: Wish, left_hand: bool) -> Preference:
    """Return the better side that is there, safe and free; of equal ones that of the road's hand.

    What overlaps would be no room, whatever a margin says.
    """
    may = [
        side.exists & (margin >= 0) & (side.gap > 0) & (side.back_gap > 0)
        for side, margin in ((left, wish.left_margin), (right, wish.right_margin))
    ]
    never = torch.full_like(wish.left, -torch.inf)
    utility = [torch.where(ok, u, never) for ok, u in zip(may, (wish.left, wish.right), strict=True)]
    to_left = utility[0] >= utility[1] if left_hand else utility[0] > utility[1]
    best = torch.where(to_left, utility[0], utility[1])
    wants = best > 0
    blocked = ~wants & (torch.maximum(wish.left, wish.right) > 0)
    return Preference(best, to_left, wants, blocked, signalled(left.exists, right.exists, wish, left_hand))


def signalled(left: Tensor, right: Tensor, wish: Wish, left_hand: bool) -> Tensor:
    """Return the side that some effect wishes for most: 1 for the left, −1 for the right, 0 for neither."""
    assert wish.left_most is not None and wish.right_most is not None
    never, none = torch.full_like(wish.left, -torch.inf), torch.zeros_like(wish.left)
    one, other = torch.where(left, wish.left_most, never), torch.where(right, wish.right_most, never)
    to_left = one >= other if left_hand else one > other
    return torch.where(torch.maximum(one, other) > 0, torch.where(to_left, none + 1.0, none - 1.0), none)


class Sideways(Ending):
    """A road on which one can look beside."""

    beside: ClassVar[bool] = True

    @abc.abstractmethod
    def at(self, x: Any, slot: Any) -> Any:
        """Return the x of the vehicles in some slots; what is the same for all vehicles stays."""

    @abc.abstractmethod
    def beyond(self) -> Any:
        """Return the slot of each leader's leader."""

    @abc.abstractmethod
    def goes_on(self) -> Tensor:
        """Return how far each vehicle could go on on its lane (m)."""

    def look(
        self, state: State, exists: Tensor, leader: Any, follower: Any, led: Tensor, followed: Tensor,
        to_leader: Tensor, to_follower: Tensor, ends: Tensor,
    ) -> Side:  # fmt: skip
        """Return a lane beside, from its neighbours; ``to_leader`` and ``to_follower`` are laps on a ring (m)."""
        position, length = state.position, state.length
        ahead = self.at(position, leader) - self.at(length, leader) - position + to_leader
        back = position - length - self.at(position, follower) + to_follower
        if state.present is not None:
            exists = exists & (state.present > 0)
        gap, back_gap = torch.where(led, ahead, FAR), torch.where(followed, back, FAR)
        return Side(exists, leader, follower, led, followed, gap, back_gap, ends)

    def before_end(self, leader: Neighbour, ends: Tensor) -> Neighbour:
        """Return whichever is nearer to each vehicle: its leader on a lane, or a standing one at the end of it."""
        return nearer(leader, ends if self.room() is not None else None)

    def follow(
        self, state: State, leaders: Neighbour, slot: Any, gap: Tensor, present: Tensor
    ) -> tuple[Neighbour, Neighbour]:
        """Return the vehicle in a slot as a leader at a gap (m), and its own leader as the second one.

        ``leaders`` is everybody's leader; ``present`` is 0 where the slot is nobody's.
        """
        speed = state.speed
        present = present.to(speed.dtype)
        leader = if_present(Neighbour(gap, self.at(speed, slot), self.at(state.accel, slot), present), speed)
        its = Neighbour(*(self.at(x, slot) for x in leaders))
        second = its._replace(gap=gap + self.at(state.length, slot) + its.gap, present=its.present * present)
        return leader, if_present(second, speed)
