"""Decisions about lanes, the first part of a step: what drivers wish is granted, refused or counted.

How gradients go through choices is said by ``decisions`` of the simulator:

=============  =========================================================================================================
``pathwise``   hard choices, which are frozen: gradients flow through gaps alone, and are exact where no choice flips
``surrogate``  the same values, to the last bit; and gradients by chances of doing otherwise until the next decision
``score``      choices drawn by their chances (``choices.py``), from normals drawn beforehand; gradients as in
               ``pathwise``; ``state.choices.log_probability`` sums the logarithms of the chances of what was drawn
``soft``       nobody chooses: shares of vehicles on all lanes (``shares.py``)
=============  =========================================================================================================
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from idm_env import choices, shares
from idm_env.changes import NOW, beside, seen_merging, wished
from idm_env.roads.beside import preferred, signalled
from idm_env.roads.linked import Claim, Linked, still_changing, without_absent
from idm_env.types import Inputs, Params, State

if TYPE_CHECKING:
    from idm_env.step import Stepping


def decided(stepping: Stepping, state: State, inputs: Inputs, params: Params) -> State:
    """Return the state after the decisions that are due at this step, with gaps of those concerned measured anew."""
    due = stepping.due(state)
    if not bool(due.any()):
        return state
    assert state.links is not None
    links = without_absent(state.links, state.present)
    state = state._replace(links=links)
    view = stepping.road.view(state)
    assert isinstance(view, Linked)
    due = due if state.present is None else due & (state.present > 0)
    if state.moving is not None:
        due = due & ~still_changing(state)
    how = stepping.decisions
    if how == "pathwise" or (how == "surrogate" and not torch.is_grad_enabled()):
        return _done(stepping, view, state, inputs, params, due)[0]
    before = state.choices or choices.settled(links.lane, view.road.count, state.speed)
    if how == "score":
        state, logs = _done(stepping, view, state, inputs, params, due)
        total = before.log_probability + torch.where(due, logs, 0.0)
        return state._replace(choices=before._replace(log_probability=total))
    scene = stepping.scene(state, inputs)._replace(history=NOW)
    if how == "surrogate":
        # What is not done is weighed until the next decision: carried on through alternatives it grows without bound.
        before = choices.settled(links.lane, view.road.count, state.speed)
    after = shares.gone_over(stepping, before, state, scene, params)
    after = torch.where(due.unsqueeze(-1), after, before.shares)
    if how == "soft":
        state = view.changed(state, _mostly(state, after))
        return state._replace(choices=before._replace(shares=after))
    state, _ = _done(stepping, view, state, inputs, params, due)
    assert state.links is not None
    hard = choices.settled(state.links.lane, view.road.count, state.speed)
    return state._replace(choices=hard._replace(shares=hard.shares + (after - after.detach())))


def _done(
    stepping: Stepping, view: Linked, state: State, inputs: Inputs, params: Params, due: Tensor
) -> tuple[State, Tensor]:
    """Return the state after what was granted, and the logarithms of the chances of what was drawn, if it was."""
    score = stepping.decisions == "score"
    with contextlib.nullcontext() if score else torch.no_grad():
        order, left_hand = view.order(state.present), view.road.handed == "left"
        sides = view.side(order, 1, state), view.side(order, -1, state)
        seen = sides if state.moving is None else view.with_leaving(state, sides)
        wish = wished(stepping, beside(stepping, view, seen, state, inputs, params), params)
        if not score:
            prefers = preferred(*seen, wish, left_hand)
            logs = prefers.utility
        else:
            left, right = (side.exists & (side.gap > 0) & (side.back_gap > 0) for side in seen)
            normal: Tensor = stepping.scene(state, inputs).input(choices.NOISE)
            signals = signalled(sides[0].exists, sides[1].exists, wish, left_hand)
            prefers, logs = choices.drawn(wish, left, right, stepping.temperature, normal, signals)
        claim = view.chosen(sides, prefers, due)
    after = view.changed(state, claim)
    if view.road.duration:
        after = view.on_the_way(state, after, claim, round(view.road.duration / stepping.dt))
    if stepping.sees_mergers:
        after = seen_merging(view, after, view.mergers(state, sides, claim), due)
    return after, logs


def _mostly(state: State, after: Tensor) -> Claim:
    """Return the lane that has most of each vehicle: who leads whom where nobody has chosen."""
    assert state.links is not None
    lane = after.argmax(-1)
    none = torch.zeros_like(lane, dtype=torch.bool)
    signals = torch.zeros_like(after[..., 0])
    return Claim(lane, lane != state.links.lane, none, none, state.links.follower, none, signals)


__all__ = ["decided"]
