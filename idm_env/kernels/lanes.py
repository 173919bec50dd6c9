"""Rollouts of lanes and rings by compiled kernels, differentiable by an analytic vector-Jacobian product.

The tape is the state at every ``block`` steps (gap, speed, position: 12 / block bytes per vehicle-step in float32); a
tile recomputes what lies between while it is in cache. Blocks are cut alike with and without a graph, so values are
too.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.kernels import lane_adjoint, lane_loops, tiles
from idm_env.kernels import threads as pool
from idm_env.kernels.dispatch import off
from idm_env.kernels.equations import Array, constants
from idm_env.kernels.operands import Strides, dense, operand, reduced, table
from idm_env.kernels.workspace import take
from idm_env.roads import Ring
from idm_env.types import Inputs, Params, State

if TYPE_CHECKING:
    from idm_env.simulator import Simulator

BLOCK = 16
"""Steps that a tile runs before it leaves the cache, and between two states of the tape."""

PARAMETERS = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")


class _Plan(NamedTuple):
    """Everything about a rollout that is not differentiated."""

    simulator: Simulator
    state: State
    inputs: Inputs
    params: Params
    steps: int
    block: int
    keep: bool
    tape: bool
    has: int
    operands: tuple[Array, ...]
    flags: tuple[Array, ...]
    strides: Array
    constants: Array
    threads: int | None

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.state.speed.shape)

    @property
    def rows(self) -> int:
        return math.prod(self.shape[:-1])

    def blocks(self) -> list[tuple[int, int]]:
        """First step and number of steps of every block."""
        return [(t, min(self.block, self.steps - t)) for t in range(0, self.steps, self.block)]

    def run(self, loop: Any, steps: int, *arguments: Any) -> None:
        """Call a compiled loop over all tiles, on one thread or several."""
        size = self.shape[-1]
        wide = tiles.width(size, steps)
        count = tiles.tiles(self.rows, size, steps, wide)
        threads = pool.count(self.rows * size * steps, self.threads)
        pool.split(
            lambda begin, end: loop(*arguments, steps, self.rows, size, wide, self.has, self.constants, begin, end),
            count, 1, threads,
        )  # fmt: skip


def _sources(simulator: Simulator, inputs: Inputs, params: Params) -> list[Tensor | None]:
    """Return the tensors that a rollout is differentiated by, beside the state: six parameters, σ, five inputs."""
    idm, brakes = params["idm"], params["brakes"]
    tensors: list[Tensor | None] = [idm[name] for name in PARAMETERS]
    tensors.append(brakes["max_decel"])
    noisy = "noise" in simulator.by_name
    tensors.append(params["noise"]["sigma"] if noisy else None)
    tensors.append(inputs["noise"] if noisy else None)
    tensors.append(inputs["control"].accel if "control" in simulator.by_name else None)
    replay = inputs.get("replay") if "replay" in simulator.by_name else None
    tensors += [None] * 3 if replay is None else [replay.position, replay.speed, replay.accel]
    return tensors


def _plan(
    simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int, block: int, keep: bool,
    threads: int | None,
) -> tuple[_Plan, list[Tensor | None]]:  # fmt: skip
    *batch, size = state.speed.shape
    sources = _sources(simulator, inputs, params)
    kind = np.dtype(np.float32 if state.speed.dtype == torch.float32 else np.float64)
    nothing: tuple[Array, Strides] = (np.zeros(1, kind), (0, 0, 0))
    made = [operand(simulator.road.leader_present(state.present, state.speed), batch, size)]
    for i, tensor in enumerate(sources):
        timed = steps if i >= 7 else None
        made.append(nothing if tensor is None else operand(tensor, batch, size, timed))
    control, record = inputs.get("control"), inputs.get("replay")
    flags = [
        (np.zeros(1, np.uint8), (0, 0, 0)) if x is None else operand(x.active.bool(), batch, size, steps)
        for x in (control, record)
    ]
    names = simulator.by_name
    has = sum(
        bit
        for bit, there in (
            (lane_loops.EULER, simulator.integration == "euler"),
            (lane_loops.RING, isinstance(simulator.road, Ring)),
            (lane_loops.NOISE, "noise" in names),
            (lane_loops.CONTROL, "control" in names),
            (lane_loops.REPLAY, "replay" in names),
            (lane_loops.COMES_AND_GOES, state.present is not None),
        )
        if there
    )
    width: float = names["brakes"].width  # type: ignore[attr-defined]
    differentiated = [state.gap, state.speed, state.position, *(x for x in sources if x is not None)]
    tape = torch.is_grad_enabled() and any(x.requires_grad for x in differentiated)
    strides = table([*(s for _, s in made), *(s for _, s in flags), (0, size, 1)])
    plan = _Plan(
        simulator, state, inputs, params, steps, min(block, steps), keep, tape, has, tuple(a for a, _ in made),
        tuple(a for a, _ in flags), strides, constants(simulator.dt, width, kind), threads,
    )  # fmt: skip
    return plan, sources


def _forward(plan: _Plan, start: tuple[Array, ...]) -> tuple[list[Array], Array, list[tuple[Array, ...]]]:
    """Return the last state (gap, speed, position, accel), what is kept of every step, and the states of the tape."""
    count, kind = start[0].size, start[0].dtype
    ends = [take((count,), kind) for _ in range(4)]
    kept = take((4, plan.steps if plan.keep else 0, count), kind)
    slots: list[tuple[Array, ...]] = []
    blocks = plan.blocks()
    for number, (first, steps) in enumerate(blocks):
        if number == len(blocks) - 1:
            to = tuple(ends[:3])
        elif plan.tape or number < 2:
            to = tuple(take((count,), kind) for _ in range(3))
        else:
            to = slots[number - 2]
        source = slots[number - 1] if number else start
        plan.run(lane_loops.forward, steps, *source, *to, ends[3], kept, plan.operands, plan.flags, plan.strides, first)
        slots.append(to)
    return ends, kept, slots[:-1] if plan.tape else []


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, plan: _Plan, gap: Tensor, speed: Tensor, position: Tensor, *sources: Tensor | None
    ) -> tuple[Tensor, ...]:
        start = tuple(dense(x, plan.shape) for x in (gap, speed, position))
        ends, kept, slots = _forward(plan, start)
        ctx.plan, ctx.slots, ctx.start = plan, slots, start
        ctx.save_for_backward(gap, speed, position, *sources)
        ctx.set_materialize_grads(False)
        out = [torch.from_numpy(x).view(plan.shape) for x in ends]
        if plan.keep:
            out += [torch.from_numpy(x).view(plan.steps, *plan.shape) for x in kept]
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        saved = ctx.saved_tensors
        if torch.is_grad_enabled():
            return (None, *_differentiable(ctx.plan, saved, seeds))
        return (None, *_backward(ctx.plan, ctx.start, ctx.slots, saved, seeds, ctx.needs_input_grad[1:]))


def _backward(
    plan: _Plan,
    start: tuple[Array, ...],
    slots: list[tuple[Array, ...]],
    saved: tuple[Tensor | None, ...],
    seeds: tuple[Tensor | None, ...],
    needed: tuple[bool, ...],
) -> list[Tensor | None]:
    count, kind = start[0].size, start[0].dtype
    nothing = np.zeros(1, kind)
    on = [nothing if s is None else dense(s, plan.shape) for s in seeds[:4]]
    every = [s for s in seeds[4:] if s is not None]
    along = take((4, plan.steps if every else 0, count), kind)
    for j, seed in enumerate(seeds[4:] if every else ()):
        along[j] = 0 if seed is None else dense(seed, (plan.steps, *plan.shape)).reshape(plan.steps, count)
    on_inputs = take((5, plan.steps if any(needed[10:]) else 0, count), kind)
    on_parameters = take((7 if plan.has & lane_loops.NOISE else 6, count), kind)
    blocks = plan.blocks()
    for number in range(len(blocks) - 1, -1, -1):
        first, steps = blocks[number]
        source = slots[number - 1] if number else start
        fresh = number == len(blocks) - 1
        # What nobody asks for is not written: half the time of a short rollout goes to memory.
        begin = [take((count,), kind) if number or wanted else np.zeros(1, kind) for wanted in needed[:3]]
        plan.run(
            lane_adjoint.backward, steps, *source, along, *on[:3], on[3], *begin,
            on_parameters, fresh, on_inputs, plan.operands, plan.flags, plan.strides, first,
        )  # fmt: skip
        on = [*begin, nothing]
    full = [*on[:3], *on_parameters, *([None] if len(on_parameters) == 6 else [])]
    command, normals, place, pace, pull = on_inputs
    gradients: list[Tensor | None] = []
    for i, gradient in enumerate([*full, normals, command, place, pace, pull]):
        like = saved[i]
        if like is None or gradient is None or not needed[i]:
            gradients.append(None)
        elif i < 10:
            gradients.append(reduced(gradient, plan.shape, like))
        else:
            gradients.append(_timed(gradient, plan, like))
    return gradients


def _timed(gradient: Array, plan: _Plan, like: Tensor) -> Tensor:
    """Return an input's gradient in its own shape; steps beyond the rollout have none."""
    shape = (plan.steps, *[1] * (len(plan.shape) + 1 - like.dim()), *like.shape[1:])
    part = torch.from_numpy(gradient).view(plan.steps, *plan.shape).sum_to_size(shape).view(plan.steps, *like.shape[1:])
    if len(like) == plan.steps:
        return part
    return torch.cat((part, like.new_zeros(len(like) - plan.steps, *like.shape[1:])))


def _differentiable(
    plan: _Plan, saved: tuple[Tensor | None, ...], seeds: tuple[Tensor | None, ...]
) -> list[Tensor | None]:
    """Return the gradients with a graph of their own, for second derivatives, from the torch path."""
    gap, speed, position = saved[:3]
    assert gap is not None and speed is not None and position is not None
    state = plan.state._replace(gap=gap, speed=speed, position=position)
    with off("second derivatives"):
        last, kept = plan.simulator.rollout(state, plan.inputs, plan.params, plan.steps)
    outputs = (last.gap, last.speed, last.position, last.accel, *(kept if plan.keep else ()))
    pairs = [(o, s) for o, s in zip(outputs, seeds, strict=True) if s is not None]
    wanted = [x for x in saved if x is not None and x.requires_grad]
    found = iter(
        torch.autograd.grad(
            [o for o, _ in pairs], wanted, [s for _, s in pairs], create_graph=True, allow_unused=True
        )
    )  # fmt: skip
    return [next(found) if x is not None and x.requires_grad else None for x in saved]


def rollout(
    simulator: Simulator,
    state: State,
    inputs: Inputs,
    params: Params,
    steps: int,
    *,
    block: int = BLOCK,
    keep: bool = True,
    threads: int | None = None,
) -> tuple[State, tuple[Tensor, ...] | None]:
    """Do what ``simulator.rollout`` does; ``dispatch.refusal`` must have nothing against it.

    Returns the last state and, where ``keep`` is set, position, speed, acceleration and gap of every step.
    """
    plan, sources = _plan(simulator, state, inputs, params, steps, block, keep, threads)
    gap, speed, position, accel, *kept = _Rollout.apply(plan, state.gap, state.speed, state.position, *sources)
    last = state._replace(gap=gap, speed=speed, position=position, accel=accel, step=state.step + steps)
    return last, tuple(kept) if keep else None
