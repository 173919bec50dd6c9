"""Ends of lanes: a standing leader without a length, wherever it is nearer than the real one.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units.
"""

import abc
from collections.abc import Sequence

import torch
from torch import Tensor

from idm_env.roads.base import Road
from idm_env.types import FAR, Neighbour


def nearer(leader: Neighbour, room: Tensor | None) -> Neighbour:
    """Return the leader, or a standing obstacle where the lane ends (``room`` metres ahead) if that is nearer."""
    if room is None:
        return leader
    return either(room < leader.gap, (room, 0.0, 0.0, 1.0), leader)


def either(condition: Tensor, one: Sequence[Tensor | float], other: Neighbour) -> Neighbour:
    """Return gap, speed, acceleration and presence of ``one`` where a condition holds, elsewhere those of ``other``."""
    return Neighbour(*(torch.where(condition, x, y) for x, y in zip(one, other, strict=True)))


class Ending(Road):
    """A road whose lanes may end: the end is merged into the leader, and behind it there is nobody."""

    @abc.abstractmethod
    def room(self) -> Tensor | None:
        """Return how far each vehicle's lane goes on (m), None where no lane ends."""

    def leader(self, gap: Tensor, speed: Tensor, accel: Tensor, present: Tensor) -> Neighbour:
        """Return the leader as seen by every vehicle, or the end of its lane where that is nearer."""
        return nearer(super().leader(gap, speed, accel, present), self.room())

    def second_leader(self, leader: Neighbour, length: Tensor, speed: Tensor) -> Neighbour:
        """Return the leader's leader, be it the end of the lane; behind an end there is nobody."""
        second, room = super().second_leader(leader, length, speed), self.room()
        if room is None:
            return second
        return either(room <= leader.gap, (FAR, speed, 0.0, 0.0), second)
