"""Several lanes side by side: vehicles keep their slot for life, and links give their leaders.

Between two lane changes the order within a lane does not change, so gaps stay state; ``Lanes.lane_state`` sorts anew
only where somebody changes, comes or goes.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.roads.base import Outline, Road
from idm_env.roads.layout import LaneLayout
from idm_env.roads.linked import Linked
from idm_env.roads.order import Order
from idm_env.types import LaneState, State


@dataclass(frozen=True)
class Lanes(LaneLayout, Road):
    """``count`` lanes in one direction, lane 0 on the right: endless, of a ``length`` (m), or a ``ring`` (m).

    At the end of a length vehicles leave the road, when lanes are next decided about: ``present`` becomes 0. ``ends``
    are lanes that begin or end elsewhere. ``handed`` settles claims of equal utility: to the left is preferred, or to
    the right. A change takes ``duration`` (s): a vehicle follows whom it finds on its new lane at once, and stays a
    leader on the old one for so long, in which it decides nothing; 0 is a change at a point.

    Positions on a ring are unwrapped, as on ``Ring``. A vehicle alone in its lane of a ring follows itself.

    ValueError for a lane that does not exist, or a ramp that does not lie on its road.
    """

    @property
    def beside(self) -> bool:  # type: ignore[override]
        """Whether there is more than one lane."""
        return self.count > 1

    @property
    def outline(self) -> Outline:
        """Where each lane begins, stops and is left (m)."""
        places = (self.table("begins"), self.table("stops"), self.table("leaves"))
        return Outline(tuple(zip(*places, strict=True)), self.length, self.ring)

    def lap(self, state: State) -> Tensor | None:
        """Return the circumference (m) in every row of a state, None where lanes go straight on."""
        return None if self.ring is None else torch.full_like(state.speed[..., 0], self.ring)

    def lane_state(
        self, position: Tensor, length: Tensor, lane: Tensor | int | None, present: Tensor | None
    ) -> LaneState:
        """Return the links at these positions, lengths (m) and lanes.

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
            lengths = length.detach() if present is None else length.detach() * present
            taken = torch.zeros((*lane.shape[:-1], self.count), dtype=length.dtype, device=length.device)
            taken = taken.scatter_add(-1, lane, lengths.expand(lane.shape))
            if bool((taken >= self.ring).any()):
                raise ValueError(
                    f"vehicles of {float(taken.max()):g} m in all do not fit a lane of {self.ring:g} m. Take fewer "
                    "vehicles or a longer ring."
                )
        order = Order.built(position, lane, present, self.count, self.ring)
        none = torch.zeros_like(lane)
        return LaneState(lane, *order.links(), none, none, none, none)

    def view(self, state: State) -> Linked:
        """Return the road as it is in this state; ValueError for a state without lanes."""
        if state.lanes is None:
            raise ValueError("this state has no lanes. Make it with simulator.state(…, lane=…).")
        shadow = None if state.lanes.moving is None else state.lanes.moving.shadow
        return Linked(self, state.lanes, state.position, shadow, state.length)

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
