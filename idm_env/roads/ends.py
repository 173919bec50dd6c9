"""Ends of lanes: a standing leader without a length, wherever it is nearer than the real one.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units.
"""

from __future__ import annotations

import abc

import torch
from torch import Tensor

from idm_env.roads.base import Road
from idm_env.types import FAR, Neighbour


def nearer(leader: Neighbour, room: Tensor | None) -> Neighbour:
    """Return the leader, or whoever stands where the lane ends (``room`` metres ahead) if that is nearer."""
    if room is None:
        return leader
    first = room < leader.gap
    return Neighbour(
        torch.where(first, room, leader.gap),
        torch.where(first, 0.0, leader.speed),
        torch.where(first, 0.0, leader.accel),
        torch.where(first, 1.0, leader.present),
    )


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
        at_end = room <= leader.gap
        return Neighbour(
            torch.where(at_end, FAR, second.gap),
            torch.where(at_end, speed, second.speed),
            torch.where(at_end, 0.0, second.accel),
            torch.where(at_end, 0.0, second.present),
        )
