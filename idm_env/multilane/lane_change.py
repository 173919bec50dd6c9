"""Decisions about lanes, the first part of a step: what drivers wish is granted, refused or counted.

Choices are frozen: gradients flow through gaps alone, and are exact where no choice flips.
"""

import torch

from idm_env.multilane.incentives import lane_scene, seen_merging, wished
from idm_env.roads.adjacent import preferred
from idm_env.roads.linked import Linked, still_changing, without_absent
from idm_env.roads.merging import on_lanes
from idm_env.step import CarFollowingStep
from idm_env.types import Inputs, Params, State, worthwhile


def decided(stepping: CarFollowingStep, state: State, inputs: Inputs, params: Params) -> State:
    """Return the state after the decisions that are due at this step, with gaps of those concerned measured anew."""
    due = stepping.due(state)
    if not worthwhile(due):
        return state
    assert state.lanes is not None
    lanes = without_absent(state.lanes, state.present)
    state = state._replace(lanes=lanes)
    view = stepping.road.view(state)
    assert isinstance(view, Linked)
    turn = due.any(-1, keepdim=True)
    due = due if state.present is None else due & (state.present > 0)
    if lanes.moving is not None:
        due = due & ~still_changing(state)
    with torch.no_grad():
        order = view.order(state.present)
        sides = view.side(order, 1, state), view.side(order, -1, state)
        seen = sides if lanes.moving is None else view.with_leaving(state, sides)
        wish = wished(stepping, lane_scene(stepping, view, seen, state, inputs, params), params)
        claim = view.chosen(sides, preferred(*seen, wish, view.road.handed == "left"), due)
    after = view.changed(state, claim)
    if view.road.duration:
        after = view.on_the_way(state, after, claim, round(view.road.duration / stepping.dt), turn)
    if stepping.sees_mergers:
        after = seen_merging(view, after, view.mergers(state, sides, claim), due)
    return on_lanes(after)
