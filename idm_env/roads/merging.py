"""Drivers' memory from one decision about lanes to the next: their lane, and the vehicle that signals beside.

Shapes: what belongs to drivers is ``[..., n]``; slots are indices into the last dimension.
"""

import torch
from torch import Tensor

from idm_env.types import FAR, Memory, Neighbour, State

MERGER_GAP, MERGER_SPEED = "merger_gap", "merger_speed"
"""Memories of whoever drivers see signalling beside them: the gap to him (m) and his speed (m/s), as they last decided.

Until they decide again he is taken to drive on at that speed.
"""

LANE = "on_lane"
"""Memory of the lane on which a vehicle drives, where some effect looks at that."""


def nobody(like: Tensor) -> dict[str, Tensor]:
    """Return the memories of drivers without a merging vehicle beside them."""
    return {MERGER_GAP: torch.full_like(like, FAR), MERGER_SPEED: torch.zeros_like(like)}


def merger(memory: Memory, speed: Tensor) -> Neighbour:
    """Return the vehicle that is remembered to signal, as a leader would be seen."""
    if MERGER_GAP not in memory:
        none = torch.zeros_like(speed)
        return Neighbour(none + FAR, speed, none, none)
    gap = memory[MERGER_GAP]
    some = gap < 0.5 * FAR
    none = torch.zeros_like(gap)
    return Neighbour(gap, torch.where(some, memory[MERGER_SPEED], speed), none, torch.where(some, none + 1.0, none))


def on_lanes(state: State) -> State:
    """Return the state with each driver's lane in memory, if an effect reads it."""
    if LANE not in state.memory:
        return state
    assert state.lanes is not None
    lane = state.lanes.lane.to(state.speed.dtype).expand(state.speed.shape)
    return state._replace(memory={**state.memory, LANE: lane})


def driven_on(memory: Memory, displacement: Tensor, dt: float) -> dict[str, Tensor]:
    """Return these memories a step later, if there are any."""
    held = {LANE: memory[LANE]} if LANE in memory else {}
    if MERGER_GAP not in memory:
        return held
    gap, speed = memory[MERGER_GAP], memory[MERGER_SPEED]
    gap = torch.where(gap < 0.5 * FAR, gap + speed * dt - displacement, gap)
    return {**held, MERGER_GAP: gap, MERGER_SPEED: speed}


__all__ = ["LANE", "MERGER_GAP", "MERGER_SPEED", "driven_on", "merger", "nobody", "on_lanes"]
