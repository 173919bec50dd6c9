"""Lanes laid out for a few steps in a row: whoever leads is the slot before, save at the front of each lane.

Between two decisions about lanes nobody's leader changes, so that compiled lanes can run: slots are copied into the
order of their lanes. On a ring each lane has a *halo* of copies at either end, long enough that what goes wrong at
its ends does not reach the vehicles themselves within those steps.
"""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from idm_env.roads.base import Road
from idm_env.roads.ends import Ending
from idm_env.roads.lane import Lane
from idm_env.types import State


class Places(NamedTuple):
    """Layout of chains: slot of every place, place of every slot, has a leader, has a follower (bool), end of lane (m).

    ``slots``, ``led``, ``leads`` and ``ends`` (m; where a standing leader is) have shape ``(..., places)``, ``own``
    ``(..., vehicles)``.
    """

    slots: Tensor
    own: Tensor
    led: Tensor
    leads: Tensor
    ends: Tensor | None


@dataclass(frozen=True)
class Chains(Lane):
    """Lanes behind one another in one row, with standing leaders at their ends where ``closed``."""

    closed: bool = False

    def view(self, state: State) -> Road:
        """Return the chains of a state, whose lanes are ``Places``."""
        assert isinstance(state.lanes, Places)
        return _Chained(self, state.lanes, state.position)

    def led(self, x: Tensor) -> Tensor:
        """Raise TypeError: who is led is known in a state only."""
        raise TypeError("chains are seen through a state: road.view(state).")


@dataclass(frozen=True, eq=False)
class _Chained(Ending, Chains):
    places: Places | None = None
    position: Tensor | None = None

    def __init__(self, road: Chains, places: Places, position: Tensor) -> None:
        for name, value in (("closed", road.closed), ("places", places), ("position", position)):
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
