"""Rollouts of several lanes by the kernels of one: compiled decisions, and compiled steps between them.

Slots are copied into the order of their lanes (``roads.chains``), run as one lane whose vehicles are led or not, and
copied back; so values and gradients are those of the kernels, and no loop is written for lanes.
"""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import lanes, tiles
from idm_env.compiled.kernels.lane_changes import decision
from idm_env.compiled.kernels.printed import TileKernel, tile_kernel
from idm_env.compiled.kernels.traffic import Traffic
from idm_env.compiled.scalar.record import Form
from idm_env.delay_buffer import PAST
from idm_env.effects.base import Remembering
from idm_env.roads import Lanes
from idm_env.roads.chains import Chains, Places
from idm_env.types import Inputs, Params, State, Tree, mapped

if TYPE_CHECKING:
    from idm_env.simulator import Simulator


def between(simulator: Simulator) -> Simulator:
    """Return the simulator of the steps between two decisions, made once."""
    inner: Simulator | None = simulator.__dict__.get("_between")
    if inner is None:
        effects = (Remembering(e) if e.hook == "change" else e for e in simulator.effects)
        still = tuple(e for e in effects if not isinstance(e, Remembering) or e.of.remembers)
        closed = isinstance(simulator.road, Lanes) and simulator.road.closed
        inner = dataclasses.replace(simulator, road=Chains(closed), effects=still)
        simulator.__dict__["_between"] = inner
    return inner


class _LaidOut:
    """Where the vehicles of the last few states lie, so that single steps need not walk lanes that nobody has left.

    Nothing here is kept alive by that; states are known by their tensors of links and presence, which nobody changes.
    """

    def __init__(self) -> None:
        self._kept: dict[int, tuple[list[weakref.ref[Tensor] | None], list[int], int, Places]] = {}

    @staticmethod
    def _parts(state: State) -> tuple[list[Tensor | None], list[int]]:
        """Return links and presence, and their versions."""
        assert state.lanes is not None
        parts = [*state.lanes[:3], state.present]
        return parts, [-1 if x is None or x.is_inference() else x._version for x in parts]

    def of(self, state: State, halo: int) -> Places | None:
        """Return the places of a state, or None where they are not known."""
        parts, versions = self._parts(state)
        refs, then, around, places = self._kept.get(id(parts[1]), ([], [], 0, None))
        same = (around, then) == (halo, versions) and all((r and r()) is x for r, x in zip(refs, parts, strict=True))
        return places if same else None

    def put(self, state: State, halo: int, places: Places) -> None:
        """Keep the places of a state; not in ``torch.inference_mode``, whose tensors do not tell when they change."""
        parts, versions = self._parts(state)
        if any(x is not None and x.is_inference() for x in parts):
            return
        while len(self._kept) >= 8:
            self._kept.pop(next(iter(self._kept)))
        self._kept[id(parts[1])] = [None if x is None else weakref.ref(x) for x in parts], versions, halo, places


_LAID_OUT = _LaidOut()


def kernel_of(simulator: Simulator, state: State, inputs: Inputs) -> TileKernel | str:
    """Return the kernel of the steps between two decisions, or why there is none."""
    if state.step.numel() > 1 and state.step.shape != state.speed.shape[:-1]:
        return "steps are not counted by row"
    assert isinstance(simulator.road, Lanes)
    if simulator.lane_change_models and simulator.road.duration:
        return "compiled changes take no time, and Lanes has a duration"
    inner = between(simulator)
    own_inputs = {name: x for name, x in inputs.items() if name in inner.by_name}
    return tile_kernel(inner, Form.of(state._replace(lanes=None), own_inputs))


def rollout(
    kernel: TileKernel, simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int, keep: bool
) -> tuple[State, tuple[Tensor, ...] | None] | None:
    """Do what ``Simulator.rollout`` does, shapes as there; None where vehicles are not in the order of their links."""
    inner, road = between(simulator), simulator.road
    assert isinstance(road, Lanes)
    own = {name: params[name] for name in inner.by_name}
    stops = bool(simulator.lane_change_models) or state.present is not None
    every = simulator.decides_after if stops else max(steps, 1)
    blocks = stops and simulator.decides_in_blocks
    stages = sorted({0, *simulator.turns(state.speed.shape[-1]).tolist()}) if blocks else [0]
    block = lanes.BLOCK if road.ring is not None else every
    traffic = Traffic(simulator, state)
    motions: list[tuple[Tensor, ...]] = []
    first, halo, places = state, 0, None
    done, clocks = 0, state.step.expand(state.speed.shape[:-1]).reshape(-1).numpy()
    while done < steps:
        phase = (clocks + done) % every
        own_turn = np.isin(phase, stages) if blocks else (phase == 0) & stops
        if own_turn.any():
            # Rows of a vector whose episodes began at different times decide at different steps.
            rows, state = np.flatnonzero(own_turn), traffic.begin(state, params)
            if simulator.lane_change_models:
                wishes = decision(simulator, Form.of(state._replace(lanes=None), inputs))
                after = traffic.decide(wishes, state, _cut(inputs, done, None), params, (rows, phase[rows]))
                if after is None:
                    return None
                state = after
        until = min(int(((stage - phase - 1) % every + 1).min()) for stage in stages) if stops else steps - done
        count = min(until, block, steps - done)
        halo = tiles.halo(count, kernel.program.reach)
        # Within a rollout decisions change links in place, so only what comes in is looked up.
        places = _LAID_OUT.of(state, halo) if state.lanes is first.lanes else None
        places = traffic.places(state, halo) if places is None else places
        if places is None:
            return None
        own_inputs = {
            n: _placed(_cut(x, done, count), places, state, 1) for n, x in inputs.items() if n in inner.by_name
        }
        end, some = lanes.rollout(
            kernel, inner, _row(state, places), own_inputs, _placed(own, places, state), count, keep=keep
        )
        state = _back(state, end, places)
        if some is not None:
            motions.append(tuple(x.gather(-1, places.own.expand(count, *places.own.shape)) for x in some))
        done += count
    state = state._replace(lanes=traffic.lanes)
    if places is not None:
        _LAID_OUT.put(state, halo, places)
    return state, tuple(torch.cat(column) for column in zip(*motions, strict=True)) if keep else None


def _cut(tree: Tree, begin: int, count: int | None) -> Tree:
    """Return some steps of inputs, or the one step where ``count`` is None."""
    return mapped(lambda x: x[begin] if count is None else x[begin : begin + count], tree)


def _placed(tree: Tree, places: Places, state: State, leading: int = 0) -> Tree:
    """Return what belongs to vehicles in the order of places; what is the same for all of them stays.

    ``leading`` dimensions are neither rows nor vehicles: an input's first one is time.
    """
    n = state.speed.shape[-1]

    def placed(x: Tensor) -> Tensor:
        if x.dim() == 0 or x.shape[-1] != n or n == 1:
            return x
        more = (1,) * (leading + state.speed.dim() - x.dim())
        shape = (*x.shape[:leading], *state.speed.shape)
        x = x.reshape(*x.shape[:leading], *more, *x.shape[leading:])
        return x.expand(shape).gather(-1, places.slots.expand(*shape[:-1], -1))

    return mapped(placed, tree)


def _moved(memory: Mapping[str, Tensor], index: Tensor, n: int) -> dict[str, Tensor]:
    """Return memories in another order; the past has vehicles before its slots and signals."""

    def moved(name: str, x: Tensor) -> Tensor:
        if name == PAST:
            full = x.expand(*index.shape[:-1], *x.shape[-3:])
            return full.gather(-3, index[..., None, None].expand(*index.shape, *x.shape[-2:]))
        return x.expand(*index.shape[:-1], n).gather(-1, index) if x.dim() and x.shape[-1] == n and n > 1 else x

    return {name: moved(name, x) for name, x in memory.items()}


def _row(state: State, places: Places) -> State:
    """Return a state with vehicles at their places."""
    index = places.slots
    return state._replace(
        **{n: getattr(state, n).gather(-1, index) for n in ("position", "speed", "accel", "gap", "length")},
        present=None if state.present is None else state.present.gather(-1, index),
        memory=_moved(state.memory, index, state.speed.shape[-1]),
        lanes=places,  # type: ignore[arg-type]
    )


def _back(state: State, end: State, places: Places) -> State:
    """Return the state after some steps, every vehicle in its slot."""
    return state._replace(
        **{n: getattr(end, n).gather(-1, places.own) for n in ("position", "speed", "accel", "gap")},
        step=end.step,
        memory=_moved(end.memory, places.own, places.slots.shape[-1]),
    )
