"""A network as it is in one state: everybody's leader is the next vehicle along his own route.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units.
"""

from __future__ import annotations

import torch
from torch import Tensor

from idm_env.roads.layout import LaneLayout
from idm_env.roads.linked import Linked
from idm_env.types import FAR, LaneState

_ENDLESS = LaneLayout(1)


class Travelled(Linked):
    """Neighbours by the links of a state. Several vehicles may follow one: those who merge behind him."""

    def __init__(self, links: LaneState, position: Tensor) -> None:
        super().__init__(_ENDLESS, links, position)

    def _look(self, x: Tensor, to: Tensor, fro: Tensor) -> Tensor:
        return x.expand(to.shape).gather(-1, to)

    def gaps(self, position: Tensor, length: Tensor, circumference: Tensor | float | None = None) -> Tensor:
        """Return FAR where nobody is followed; ValueError elsewhere: gaps across links are measured by events."""
        if bool((self.led(position) > 0).any()):
            raise ValueError("gaps on a network are state: records are not replayed there. Leave Replay() out.")
        return torch.full_like(position, FAR)

    def measured(self, position: Tensor, length: Tensor, base: Tensor) -> Tensor:
        """Return ``base + position[leader] − length[leader] − position`` (m), FAR without a leader.

        ``base`` is the way from the beginning of one's own link to that of the leader's (m).
        """
        gap = base + self.ahead(position) - self.ahead(length) - position
        return torch.where(self.led(position) > 0, gap, FAR)


def unlinked(links: int, position: Tensor, lane: Tensor | int | None) -> LaneState:
    """Return the state ``(..., n)`` of vehicles on some of so many links, of which nobody follows anybody yet.

    ValueError for a link that does not exist.
    """
    if lane is None:
        raise ValueError("a network needs each vehicle's link: see multilane.junctions.travelling(…).")
    lane = torch.as_tensor(lane, device=position.device).long().expand(position.shape)
    for worst in lane[(lane < 0) | (lane >= links)].tolist()[:1]:
        raise ValueError(f"link {worst} does not exist: this network has links 0 to {links - 1}.")
    own = torch.arange(position.shape[-1], device=position.device).expand(position.shape)
    none = torch.zeros((), dtype=torch.int64, device=position.device).expand(position.shape)
    return LaneState(lane, own, own, none, none, none, none)
