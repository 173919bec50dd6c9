"""A state that a user gives an episode to begin with: nothing is simulated, or looked up, before it is known to fit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from idm_env.roads import Road
from idm_env.types import FAR, State, mapped

_MOST = 1e9
"""No number of a state is further from 0, but the times of trips that never begin."""
_ENDLESS = ("lanes.trips.departs", "lanes.trips.again")
_FROM_0 = ("speed", "length", "step", "present", "lanes.")
_LANES = ("lanes.lane", "lanes.trips.lane", "lanes.moving.origin")
_VEHICLES = ("lanes.leader", "lanes.follower", "lanes.moving.shadow")
_LATER = "lanes.moving."
"""Part that a state has only once a decision about lanes was made, where changes take time."""
_STEP_ASIDE = 1e-3
"""By how much a number may lie below its bound, as differences for a derivative at rest need."""
_SLACK, _SHARE = 1.0, 1e-4
"""By how much gaps may differ from what positions say: in metres, and as a share of these, for float32's sake."""


def checked(given: Any, like: State, road: Road) -> State:
    """Return a state as one of its own, with its graph, in the shapes of ``like``, with which the task would begin.

    ValueError, in one line, for what is no state; for parts that are missing or not the task's; for shapes and types;
    for numbers that are not finite, below 0 where they cannot be, or that name no lane or vehicle; and for links and
    gaps that are not those of the positions.
    """
    if not isinstance(given, State):
        raise ValueError(f"options['state'] is of type {type(given).__name__}: give a State like env.unwrapped.state.")
    expected, leaves = dict(_leaves(like)), dict(_leaves(given))
    for name in expected:
        if name not in leaves:
            raise ValueError(f"options['state'].{name} is missing, and this task has it. Start from its own state.")
    tensors = {}
    for name, x in leaves.items():
        if name not in expected and not name.startswith(_LATER):
            raise ValueError(f"options['state'].{name} is no part of this task's state. Leave it out.")
        tensors[name] = _fitting(name, x, expected.get(name), like, road)
    in_order = iter(tensors.values())
    state = mapped(lambda _: next(in_order), given._replace(memory=given.memory or {}))
    with torch.no_grad():
        _linked(state, road)
        _spaced(state, road)
    return state


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Give everything in a state, or a part of it, with its name, in the order of ``mapped``."""
    for name, value in (tree if isinstance(tree, Mapping) else tree._asdict()).items():
        if isinstance(value, Mapping) or hasattr(value, "_asdict"):
            yield from _leaves(value, f"{path}{name}.")
        elif value is not None:
            yield f"{path}{name}", value


def _fitting(name: str, x: Any, like: Tensor | None, state: State, road: Road) -> Tensor:
    """Return a copy of a tensor in its full shape, all of whose numbers lie where they can."""
    here, (rows, vehicles), outline = f"options['state'].{name}", state.position.shape, road.outline
    if like is None:
        like = state.step.new_empty(()).expand(rows, vehicles)
    if not isinstance(x, Tensor) or x.dtype != like.dtype or x.device != like.device:
        kind = f"torch.Tensor of {x.dtype} on {x.device}" if isinstance(x, Tensor) else type(x).__name__
        raise ValueError(f"{here} is a {kind}, and a torch.Tensor of {like.dtype} on {like.device} is needed.")
    broad = name != "position" and x.dim() <= like.dim()
    if x.shape != like.shape and not (
        broad and all(a in (1, b) for a, b in zip(x.shape[::-1], like.shape[::-1], strict=False))
    ):
        raise ValueError(f"{here} has shape {tuple(x.shape)}; {tuple(like.shape)} is needed: environments, vehicles.")
    low = 0.0 if name.startswith(_FROM_0) and name != _ENDLESS[0] else -_MOST
    high = math.inf if name in _ENDLESS else _MOST
    if name in _LANES:
        high = 0.0 if outline is None else len(outline.lanes) - 1.0
    elif name in _VEHICLES:
        high = vehicles - 1
    elif name == "present":
        high = 1.0
    values = x.detach()
    good = (values >= low - _STEP_ASIDE) & (values <= high)
    if not bool(good.all()):
        worst = values[~good].reshape(-1)[0].item()
        raise ValueError(f"{here} = {worst:g} is outside [{low:g}, {high:g}].")
    return x.expand(like.shape).clone()


def _linked(state: State, road: Road) -> None:
    """Refuse links to another lane, to nobody, or not back, or, where nobody touches, past others."""
    links = state.lanes
    if links is None:
        return
    own = torch.arange(state.speed.shape[-1], device=state.speed.device).expand_as(links.lane)
    present = torch.ones_like(own, dtype=torch.bool) if state.present is None else state.present > 0
    apart = (state.gap > 0).all(-1, keepdim=True)
    order = road.lane_state(state.position, state.length, links.lane, state.present)
    assert order is not None
    for to, back, nearest in (
        (links.leader, links.follower, order.leader),
        (links.follower, links.leader, order.follower),
    ):
        right = present.gather(-1, to) & (links.lane.gather(-1, to) == links.lane) & (back.gather(-1, to) == own)
        wrong = present & (((to != own) & ~right) | (apart & (to != nearest)))
        if bool(wrong.any()):
            row, vehicle = wrong.nonzero()[0].tolist()
            raise ValueError(
                f"options['state'].lanes: vehicles {vehicle} and {int(to[row, vehicle])} of environment {row} do not "
                "follow one another on one lane. Make it with task.simulator.state(…, lane=…)."
            )


def _spaced(state: State, road: Road) -> None:
    """Refuse gaps that are not those of the positions; vehicles that touch are left to the task."""
    around = road.lap(state) if state.lanes is None else None  # links know their own
    view = road.view(state)
    led = view.leader_present(state.present, state.speed) > 0
    gap = torch.where(led, view.gaps(state.position, state.length, around), FAR)
    wrong = ((state.gap - gap).abs() > _SLACK + _SHARE * state.position.abs()) & (state.gap > 0)
    if bool(wrong.any()):
        row, vehicle = wrong.nonzero()[0].tolist()
        raise ValueError(
            f"options['state'].gap = {float(state.gap[row, vehicle]):g} m of vehicle {vehicle} of environment {row}, "
            f"and positions say {float(gap[row, vehicle]):g} m. Make it with task.simulator.state(…)."
        )
