"""Roads: leaders by topology, and gaps from displacements. Roads know no drivers.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from idm_env.types import FAR, LaneState, Neighbour, State


class Outline(NamedTuple):
    """Outline to draw of a road of several lanes: its ``length`` or ``ring`` (m), else neither.

    ``lanes``: of each, right lane first, where it begins, where one must stop, and where one leaves it (m).
    """

    lanes: tuple[tuple[float, float, float], ...]
    length: float | None
    ring: float | None


def if_present(other: Neighbour, speed: Tensor) -> Neighbour:
    """Return a neighbour, elementwise; where it is absent gap FAR, one's own ``speed`` (m/s), acceleration 0."""
    exists = other.present > 0
    return Neighbour(
        torch.where(exists, other.gap, FAR),
        torch.where(exists, other.speed, speed),
        torch.where(exists, other.accel, 0.0),
        other.present,
    )


@dataclass(frozen=True)
class Road(abc.ABC):
    """A topology over the last tensor dimension, vehicles sorted front first.

    Tensors have the shape ``(…, vehicles)``; circumferences have ``(…)``, one number per row.
    Written with shifted views instead of index gathers, because compilers fuse those. A road on which the order changes
    (``Lanes``) answers through ``view(state)``, which is bound to the lanes of that state.
    """

    beside: ClassVar[bool] = False
    """Whether there may be a lane beside another; of ``Lanes`` the property says it."""
    around: ClassVar[bool] = False
    """Whether the first vehicle follows the last."""

    def view(self, state: State) -> Road:
        """Return this road as it is in a state: itself, where the order never changes."""
        return self

    def lane_state(
        self, position: Tensor, length: Tensor, lane: Tensor | int | None, present: Tensor | None
    ) -> LaneState | None:
        """Return the links at these positions, lengths (m) and lanes: None where the order never changes.

        ValueError for lanes on a road that has one only.
        """
        if lane is not None:
            raise ValueError(f"a {type(self).__name__} has one lane, and lane = … was given. Use Lanes(count).")
        return None

    def placed(self, state: State, lane: Tensor, after: State) -> State:
        """Return the state ``after`` a step in which records give vehicles' lanes, −1 where they do not.

        ValueError on a road that has one lane only.
        """
        raise ValueError(f"a {type(self).__name__} has one lane, and a record says lanes. Use Lanes(count).")

    def lap(self, state: State) -> Tensor | None:
        """Return the circumference (m) of a ring in every row of a state, None on any other road."""
        return None

    @property
    def outline(self) -> Outline | None:
        """The outline of several lanes to draw, None on a road of one."""
        return None

    @property
    def leaving(self) -> bool:
        """Whether vehicles leave this road by themselves."""
        return False

    def remaining(self, present: Tensor | None, position: Tensor) -> Tensor | None:
        """Return presence (1 or 0) of the vehicles still on the road at these positions (m)."""
        return present

    @abc.abstractmethod
    def ahead(self, x: Tensor) -> Tensor:
        """Return each vehicle's leader's ``x``; a vehicle without a leader gets its own."""

    @abc.abstractmethod
    def back(self, x: Tensor) -> Tensor:
        """Return each vehicle's follower's ``x``; a vehicle without a follower gets its own."""

    @abc.abstractmethod
    def led(self, x: Tensor) -> Tensor:
        """Return 1 for every vehicle that the topology gives a leader, 0 otherwise, shape ``(vehicles,)``."""

    @abc.abstractmethod
    def gaps(self, position: Tensor, length: Tensor, circumference: Tensor | float | None = None) -> Tensor:
        """Return the bumper-to-bumper gap to the leader (m), ``FAR`` where there is none."""

    def leads(self, x: Tensor) -> Tensor:
        """Return 1 for every vehicle that has a follower, 0 otherwise, shape ``(vehicles,)``."""
        return self.led(x).flip(-1)

    def leader_present(self, present: Tensor | None, like: Tensor) -> Tensor:
        """Return 1 where there is a leader: by the topology, and by ``present`` where vehicles come and go."""
        led = self.led(like)
        return led if present is None else led * self.ahead(present) * present

    def advance(self, gap: Tensor, displacement: Tensor) -> Tensor:
        """Return the gaps after a step: ``gap + displacement[leader] − displacement`` (m)."""
        return gap + torch.where(self.led(gap) > 0, self.ahead(displacement) - displacement, 0.0)

    def leader(self, gap: Tensor, speed: Tensor, accel: Tensor, present: Tensor) -> Neighbour:
        """Return the leader as seen by every vehicle; ``present`` is ``leader_present``'s."""
        exists = present > 0
        return Neighbour(
            gap, torch.where(exists, self.ahead(speed), speed), torch.where(exists, self.ahead(accel), 0.0), present
        )

    def second_leader(self, leader: Neighbour, length: Tensor, speed: Tensor) -> Neighbour:
        """Return the leader's leader, with the gap between bumpers: ``s1 + length[leader] + s[leader]`` (m)."""
        present = leader.present * self.ahead(leader.present.expand_as(speed))
        gap = leader.gap + self.ahead(length) + self.ahead(leader.gap)
        return if_present(Neighbour(gap, self.ahead(leader.speed), self.ahead(leader.accel), present), speed)

    def behind(self, leader: Neighbour, speed: Tensor, accel: Tensor) -> Neighbour:
        """Return the vehicle whose leader is this one, with *its* gap (m)."""
        present = self.leads(speed) * self.back(leader.present.expand_as(speed))
        return if_present(Neighbour(self.back(leader.gap), self.back(speed), self.back(accel), present), speed)
