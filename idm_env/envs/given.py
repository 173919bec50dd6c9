"""A state that a user gives an episode to begin with: nothing is simulated, or looked up, before it is known to fit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from idm_env.roads import Road
from idm_env.types import FAR, Links, State

_MOST = 1e9
"""No number of a state is further from 0, but the times of trips that never begin."""
_FROM_0 = ("speed", "length", "step", "present", "links.", "moving.", "trips.again", "trips.lane", "trips.speed",
           "trips.entered", "trips.left")  # fmt: skip
_LANES = ("links.lane", "trips.lane", "moving.origin")
_VEHICLES = (*(f"links.{name}" for name in Links._fields[1:3]), "moving.shadow")
_ENDLESS = ("trips.departs", "trips.again")
_LATER = "moving."
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
        raise ValueError(
            f"options['state'] is of type {type(given).__name__}: give a State, such as env.unwrapped.state."
        )
    expected, leaves = dict(_leaves(like)), dict(_leaves(given))
    for name in expected:
        if name not in leaves:
            raise ValueError(f"options['state'].{name} is missing, and this task has it. Start from its own state.")
    tensors = {}
    for name, x in leaves.items():
        if name not in expected and not name.startswith(_LATER):
            raise ValueError(f"options['state'].{name} is no part of this task's state. Leave it out.")
        tensors[name] = _fitting(name, x, expected.get(name), like, road)
    parts: dict[str, Any] = {}
    for field, value in given._asdict().items():
        if isinstance(value, tuple):
            parts[field] = type(value)(**{n: tensors[f"{field}.{n}"] for n in value._asdict()})  # type: ignore[attr-defined]
        elif isinstance(value, Mapping):
            parts[field] = {n: tensors[f"{field}.{n}"] for n in value}
        else:
            parts[field] = tensors.get(field, {} if isinstance(getattr(like, field), Mapping) else None)
    state = State(**parts)
    with torch.no_grad():
        _linked(state, road)
        _spaced(state, road)
    return state


def _leaves(state: State) -> Iterator[tuple[str, Any]]:
    for field, value in state._asdict().items():
        if isinstance(value, Mapping):
            yield from ((f"{field}.{name}", x) for name, x in value.items())
        elif isinstance(value, tuple) and hasattr(value, "_asdict"):
            yield from ((f"{field}.{name}", x) for name, x in value._asdict().items())
        elif value is not None:
            yield field, value


def _fitting(name: str, x: Any, like: Tensor | None, state: State, road: Road) -> Tensor:
    """Return a copy of a tensor in its full shape, all of whose numbers lie where they can."""
    here, (rows, vehicles), lanes = f"options['state'].{name}", state.position.shape, getattr(road, "count", 1)
    if like is None:
        like = state.step.new_empty(()).expand(rows, vehicles)
    if not isinstance(x, Tensor) or x.dtype != like.dtype or x.device != like.device:
        kind = f"torch.Tensor of {x.dtype} on {x.device}" if isinstance(x, Tensor) else type(x).__name__
        raise ValueError(f"{here} is a {kind}, and a torch.Tensor of {like.dtype} on {like.device} is needed.")
    broad = name != "position" and x.dim() <= like.dim()
    if x.shape != like.shape and not (
        broad and all(a in (1, b) for a, b in zip(x.shape[::-1], like.shape[::-1], strict=False))
    ):
        raise ValueError(
            f"{here} has shape {tuple(x.shape)}, and {tuple(like.shape)} is needed: environments, vehicles."
        )
    low = 0.0 if name.startswith(_FROM_0) else -_MOST
    high = math.inf if name in _ENDLESS else _MOST
    if name in _LANES:
        high = lanes - 1
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
    links = state.links
    if links is None:
        return
    own = torch.arange(state.speed.shape[-1], device=state.speed.device).expand_as(links.lane)
    present = torch.ones_like(own, dtype=torch.bool) if state.present is None else state.present > 0
    apart = (state.gap > 0).all(-1, keepdim=True)
    order = road.links(state.position, state.length, links.lane, state.present)
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
                f"options['state'].links: vehicles {vehicle} and {int(to[row, vehicle])} of environment {row} do not "
                "follow one another on one lane. Make it with task.simulator.state(…, lane=…)."
            )


def _spaced(state: State, road: Road) -> None:
    """Refuse gaps that are not those of the positions; vehicles that touch are left to the task."""
    around = road.lap(state) if state.links is None else None  # links know their own
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
