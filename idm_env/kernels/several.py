"""Rollouts of several lanes by the kernels of one: compiled decisions, and compiled steps between them.

Slots are copied into the order of their lanes (``roads.chains``), run as one lane whose vehicles are led or not, and
copied back; so values and gradients are those of the kernels, and no loop is written for lanes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from idm_env.history import PAST
from idm_env.kernels import lanes, tiles
from idm_env.kernels.deciding import Traffic, decision
from idm_env.kernels.printed import TileKernel, tile_kernel
from idm_env.roads import Lanes
from idm_env.roads.chains import Chains, Places
from idm_env.scalar.record import Form
from idm_env.types import Inputs, Params, State

if TYPE_CHECKING:
    from idm_env.simulator import Simulator


def between(simulator: Simulator) -> Simulator:
    """Return the simulator of the steps between two decisions."""
    assert isinstance(simulator.road, Lanes)
    still = tuple(e for e in simulator.effects if e.hook != "change")
    return dataclasses.replace(simulator, road=Chains(simulator.road.closed), effects=still)


def kernel_of(simulator: Simulator, state: State, inputs: Inputs) -> TileKernel | str:
    """Return the kernel of the steps between two decisions, or why there is none."""
    if state.step.numel() > 1 and bool((state.step != state.step.reshape(-1)[0]).any()):
        return "rows decide at different steps"
    inner = between(simulator)
    kept = {name: x for name, x in inputs.items() if name in inner.by_name}
    return tile_kernel(inner, Form.of(state._replace(links=None), kept))


def rollout(
    kernel: TileKernel, simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int, keep: bool
) -> tuple[State, tuple[Tensor, ...] | None] | None:
    """Do what ``Simulator.rollout`` does; None where vehicles are not in the order of their links."""
    inner, road = between(simulator), simulator.road
    assert isinstance(road, Lanes)
    own = {name: params[name] for name in inner.by_name}
    stops = bool(simulator.changes) or state.present is not None
    every = simulator.decides_after if stops else max(steps, 1)
    turns = simulator.turns(state.speed.shape[-1])
    stages = sorted({0, *turns.tolist()}) if stops else [0]
    block = lanes.BLOCK if road.ring is not None else every
    wishes = decision(simulator, Form.of(state._replace(links=None), inputs)) if simulator.changes else ""
    traffic = Traffic(simulator, state)
    kept: list[tuple[Tensor, ...]] = []
    done, clock = 0, int(state.step.reshape(-1)[0])
    while done < steps:
        phase = (clock + done) % every
        if stops and phase == 0:
            state = traffic.begin(state, params)
        if simulator.changes and phase in stages:
            after = traffic.decide(wishes, state, _cut(inputs, done, None), params, turns == phase)
            if after is None:
                return None
            state = after
        until = min((stage - phase) % every or every for stage in stages) if stops else steps - done
        count = min(until, block, steps - done)
        places = traffic.places(state, tiles.halo(count, kernel.program.reach))
        if places is None:
            return None
        given = {n: _placed(_cut(x, done, count), places, state, 1) for n, x in inputs.items() if n in inner.by_name}
        end, some = lanes.rollout(
            kernel, inner, _row(state, places), given, _placed(own, places, state), count, keep=keep
        )
        state = _back(state, end, places)
        if some is not None:
            kept.append(tuple(x.gather(-1, places.own.expand(count, *places.own.shape)) for x in some))
        done += count
    state = state._replace(links=traffic.links)
    return state, tuple(torch.cat(column) for column in zip(*kept, strict=True)) if keep else None


def _cut(tree: Any, begin: int, count: int | None) -> Any:
    """Return some steps of inputs, or the one step where ``count`` is None."""
    if isinstance(tree, Tensor):
        return tree[begin] if count is None else tree[begin : begin + count]
    if isinstance(tree, Mapping):
        return {name: _cut(x, begin, count) for name, x in tree.items()}
    return tree if tree is None else type(tree)(*(_cut(x, begin, count) for x in tree))


def _placed(tree: Any, places: Places, state: State, leading: int = 0) -> Any:
    """Return what belongs to vehicles in the order of places; what is the same for all of them stays.

    ``leading`` dimensions are neither rows nor vehicles: an input's first one is time.
    """
    if isinstance(tree, Tensor):
        n = state.speed.shape[-1]
        if tree.dim() == 0 or tree.shape[-1] != n or n == 1:
            return tree
        more = (1,) * (leading + state.speed.dim() - tree.dim())
        shape = (*tree.shape[:leading], *state.speed.shape)
        tree = tree.reshape(*tree.shape[:leading], *more, *tree.shape[leading:])
        return tree.expand(shape).gather(-1, places.slots.expand(*shape[:-1], -1))
    if isinstance(tree, Mapping):
        return {name: _placed(x, places, state, leading) for name, x in tree.items()}
    return tree if tree is None else type(tree)(*(_placed(x, places, state, leading) for x in tree))


def _moved(memory: Mapping[str, Tensor], index: Tensor, n: int) -> dict[str, Tensor]:
    """Return memories in another order; the past has vehicles before its slots and signals."""
    found = {}
    for name, x in memory.items():
        if name == PAST:
            full = x.expand(*index.shape[:-1], *x.shape[-3:])
            found[name] = full.gather(-3, index[..., None, None].expand(*index.shape, *x.shape[-2:]))
        elif x.dim() and x.shape[-1] == n and n > 1:
            found[name] = x.expand(*index.shape[:-1], n).gather(-1, index)
        else:
            found[name] = x
    return found


def _row(state: State, places: Places) -> State:
    """Return a state with vehicles at their places."""
    index = places.slots
    return state._replace(
        **{n: getattr(state, n).gather(-1, index) for n in ("position", "speed", "accel", "gap", "length")},
        present=None if state.present is None else state.present.gather(-1, index),
        memory=_moved(state.memory, index, state.speed.shape[-1]),
        links=places,  # type: ignore[arg-type]
    )


def _back(state: State, end: State, places: Places) -> State:
    """Return the state after some steps, every vehicle in its slot."""
    return state._replace(
        **{n: getattr(end, n).gather(-1, places.own) for n in ("position", "speed", "accel", "gap")},
        step=end.step,
        memory=_moved(end.memory, places.own, places.slots.shape[-1]),
    )
