"""Several lanes: trips, incentives and lane changes, as functions of a state that run before a step."""

from idm_env.multilane.demand import turnover
from idm_env.multilane.junctions import crossed
from idm_env.multilane.lane_change import decided
from idm_env.step import CarFollowingStep
from idm_env.types import Inputs, Params, State


def before(stepping: CarFollowingStep, state: State, inputs: Inputs, params: Params) -> State:
    """Return the state after entries, exits and lane changes that are due at this step; on one lane, the same state."""
    if state.lanes is None:
        return state
    if state.lanes.journeys is not None:
        return crossed(stepping, state, params)
    if state.present is not None:
        state = turnover(stepping, state, params)
    return decided(stepping, state, inputs, params) if stepping.lane_change_models else state
