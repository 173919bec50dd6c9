"""Rollouts of lanes and rings by compiled kernels, differentiable by a vector-Jacobian product.

The tape is the part of the state that the adjoint reads, at every ``block`` steps; a tile recomputes what lies between
while it is in cache. Blocks are cut alike with and without a graph, so values are too.

Shapes: what belongs to vehicles is ``[rows, n]``, in SI units; kept trajectories have time first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from idm_env.backends import off
from idm_env.compiled.kernels import lane_adjoint, lane_loops, threads as pool, tiles
from idm_env.compiled.kernels.memory import addresses
from idm_env.compiled.kernels.operands import dense, gradients, operand, reduced, table
from idm_env.compiled.kernels.printed import TileKernel
from idm_env.compiled.kernels.tiles import Array
from idm_env.compiled.kernels.workspace import take
from idm_env.compiled.scalar.program import Program
from idm_env.compiled.scalar.record import slot_name
from idm_env.delay_buffer import PAST
from idm_env.types import Inputs, Params, State

if TYPE_CHECKING:
    from idm_env.step import CarFollowingStep

BLOCK = 16
"""Steps that a tile runs before it leaves the cache, and between two states of the tape."""


@dataclass(frozen=True, eq=False)
class RolloutPlan:
    """Everything about a rollout that is not differentiated."""

    kernel: TileKernel
    simulator: CarFollowingStep
    state: State
    inputs: Inputs
    params: Params
    steps: int
    block: int
    keep: bool
    tape: bool
    operands: tuple[Array, ...]
    strides: Array

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """``(*batch, vehicles)``."""
        return tuple(self.state.speed.shape)

    @cached_property
    def rows(self) -> int:
        """Batch rows."""
        return math.prod(self.shape[:-1])

    @cached_property
    def count(self) -> int:
        """Vehicles of all rows."""
        return math.prod(self.shape)

    @cached_property
    def kind(self) -> np.dtype[Any]:
        """Precision."""
        return np.dtype(np.float32 if self.state.speed.dtype == torch.float32 else np.float64)

    @cached_property
    def places(self) -> Array:
        """Addresses of the operands."""
        return addresses(self.operands)

    @cached_property
    def slots(self) -> int:
        """Steps that the past holds."""
        return self.state.memory[PAST].shape[-2] if self.kernel.signals else 0

    def blocks(self) -> list[tuple[int, int]]:
        """First step and number of steps of every block."""
        return [(t, min(self.block, self.steps - t)) for t in range(0, self.steps, self.block)]

    def run(self, loop: Any, first: int, steps: int, *arguments: Any) -> None:
        """Call a compiled loop over all tiles, on one thread or several."""
        size = self.shape[-1]
        wide = tiles.width(size, self.slots)
        around = tiles.halo(steps, self.kernel.program.reach)
        common = (
            *arguments, self.places, self.strides, self.kernel.constants[self.kind.name],
            first, steps, self.rows, size, wide, around,
        )  # fmt: skip
        pool.split(
            lambda begin, end: loop(*common, begin, end),
            tiles.tiles(self.rows, size, wide, around),
            1,
            pool.count(self.rows * size * steps),
        )

    def forward(self, first: int, steps: int, *arguments: Any) -> None:
        """Run a block of steps."""
        kernel = self.kernel
        self.run(
            lane_loops.forward, first, steps, *arguments, kernel.measures, kernel.forward(self.kind.name),
            kernel.looks, kernel.recalls, kernel.read,
        )  # fmt: skip

    def backward(self, first: int, steps: int, *arguments: Any) -> None:
        """Carry adjoints over a block of steps."""
        kernel = self.kernel
        self.run(
            lane_adjoint.backward, first, steps, *arguments, kernel.measures, kernel.forward(self.kind.name),
            kernel.looks, kernel.recalls, kernel.backward(self.kind.name), kernel.sends, kernel.taped, kernel.again,
        )  # fmt: skip

    def past(self, filled: bool = False) -> Array:
        """Return an array for the past: (slots · signals, vehicles)."""
        shape = (self.slots * self.kernel.signals, self.count)
        return np.zeros(shape, self.kind) if filled else take(shape, self.kind)


def static_of(simulator: CarFollowingStep, state: State, params: Params, name: str) -> Tensor:
    """Return what a static slot stands for, as a tensor."""
    if name == "led":
        return simulator.road.view(state).led(state.speed)
    if name == "leads":
        return simulator.road.view(state).leads(state.speed)
    if name == "ends":
        return state.lanes.ends  # type: ignore[union-attr]
    if name in ("length", "present"):
        value = getattr(state, name)
        assert value is not None
        return value
    effect, parameter = name.split(".", 1)
    return params[effect][parameter]


def part_of(inputs: Inputs, name: str) -> Tensor:
    """Return the input, or the part of one, that a slot stands for. KeyError for a slot of no input."""
    for effect, value in inputs.items():
        for part, x in ({"": value} if isinstance(value, Tensor) else value._asdict()).items():
            if slot_name(effect, part) == name:
                return x
    raise KeyError(name)


def starts(plan_state: State, names: tuple[str, ...]) -> list[Tensor]:
    """Return the tensors of the states, in the order of the program."""
    parts = []
    for name in names:
        if name.startswith("memory of "):
            parts.append(plan_state.memory[name.removeprefix("memory of ")])
        elif name == "step":
            parts.append(plan_state.clock.to(plan_state.speed.dtype))
        else:
            parts.append(getattr(plan_state, name))
    return parts


def past_rows(past: Tensor, shape: tuple[int, ...], *, every: bool = False) -> Array:
    """Return the past as (slots · signals, vehicles), newest first.

    Where all slots are one and not ``every`` is asked for, it is (signals, vehicles).
    """
    full = past.detach().expand(*shape, *past.shape[-2:]).movedim((-2, -1), (0, 1))
    if full.stride(0) == 0 and not every:
        full = full[:1]
    return full.reshape(full.shape[0] * full.shape[1], -1).contiguous().numpy()


def past_tensor(rows: Array, slots: int, shape: tuple[int, ...]) -> Tensor:
    """Return rows of the past as ``(..., vehicles, slots, signals)``."""
    return torch.from_numpy(rows).view(slots, -1, *shape).movedim((0, 1), (-2, -1))


def planned(
    kernel: TileKernel, simulator: CarFollowingStep, state: State, inputs: Inputs, params: Params, steps: int,
    block: int, keep: bool,
) -> tuple[RolloutPlan, list[Tensor]]:  # fmt: skip
    """Return what ``run`` takes."""
    *batch, size = state.speed.shape
    program = kernel.program
    values = [static_of(simulator, state, params, n) for n in (*program.statics, *program.parameters)]
    numbers = [part_of(inputs, n) for n in kernel.numbers]
    operands = [operand(x.to(state.speed.dtype), batch, size) for x in values]
    operands += [operand(x, batch, size, steps) for x in (*numbers, *(part_of(inputs, n) for n in kernel.flags))]
    strides = table([*(s for _, s in operands), (0, size, 1)])
    differentiated = list[Tensor]()
    if torch.is_grad_enabled():
        past, parameters = [state.memory[PAST]] if kernel.signals else [], values[len(program.statics) :]
        differentiated = [*starts(state, program.moving), *past, *parameters, *numbers]
    tape = any(x.requires_grad for x in differentiated)
    # Without a tape nobody asks for states between, and whole rows stay in the cache.
    block *= 1 if tape or kernel.signals or size > tiles.TILE else 4
    plan = RolloutPlan(
        kernel, simulator, state, inputs, params, steps, min(block, steps), keep, tape,
        tuple(a for a, _ in operands), strides,
    )  # fmt: skip
    return plan, differentiated


def _forward(
    plan: RolloutPlan, start: list[Array], past: Array
) -> tuple[list[Array | None], Array, Array, list[tuple[list[Array | None], Array]]]:
    """Return the last states, the last past, what is kept of every step, and the tape: states at every block."""
    states = range(len(plan.kernel.program.states))
    motion = take((4, plan.steps if plan.keep else 0, plan.count), plan.kind)
    blocks = plan.blocks()
    tape: list[tuple[list[Array | None], Array]] = []
    again, read = set(plan.kernel.again), set(plan.kernel.read)
    now: list[Array | None] = [*start]
    before = past
    spare: list[list[Array | None]] = []
    for number, (first, steps) in enumerate(blocks):
        last = number == len(blocks) - 1
        if plan.tape:
            tape.append(([x if i in again else None for i, x in enumerate(now)], before))
        if len(spare) > 1 and not plan.tape and not last:
            ends = spare[number % 2]
        else:
            ends = [take((plan.count,), plan.kind) if last or i in read else None for i in states]
            spare.append(ends)
        after = plan.past()
        alike = len(before) == plan.kernel.signals
        plan.forward(
            first, steps, addresses(now), addresses(ends), before.ctypes.data, alike, after.ctypes.data, plan.slots,
            motion.ctypes.data, plan.steps if plan.keep else 0,
        )  # fmt: skip
        now, before = ends, after
    return now, before, motion, tape


def _ran(plan: RolloutPlan) -> tuple[list[Tensor], list[tuple[list[Array | None], Array]]]:
    """Return the last states, the last past and what is kept, without a graph; and the tape."""
    start = [dense(x.to(plan.state.speed.dtype), plan.shape) for x in starts(plan.state, plan.kernel.program.states)]
    past = past_rows(plan.state.memory[PAST], plan.shape) if plan.slots else plan.past()
    ends, after, motion, tape = _forward(plan, start, past)
    out = [torch.from_numpy(x).view(plan.shape) for x in ends if x is not None]
    if plan.slots:
        out.append(past_tensor(after, plan.slots, plan.shape))
    if plan.keep:
        out += [torch.from_numpy(x).view(plan.steps, *plan.shape) for x in motion]
    return out, tape


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: RolloutPlan, *sources: Tensor) -> tuple[Tensor, ...]:
        program = plan.kernel.program
        out, tape = _ran(plan)
        ctx.plan, ctx.tape = plan, tape
        ctx.save_for_backward(*sources)
        ctx.set_materialize_grads(False)
        fixed = [x for x, n in zip(out, program.states, strict=False) if n not in program.moving]
        ctx.mark_non_differentiable(*fixed)
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        plan: RolloutPlan = ctx.plan
        saved = ctx.saved_tensors
        if torch.is_grad_enabled():
            return (None, *_differentiable(plan, saved, seeds))
        return (None, *_backward(plan, ctx.tape, saved, seeds, ctx.needs_input_grad[1:]))


def _backward(
    plan: RolloutPlan,
    tape: list[Any],
    saved: tuple[Tensor, ...],
    seeds: tuple[Tensor | None, ...],
    needed: tuple[bool, ...],
) -> list[Tensor | None]:
    kernel = plan.kernel
    program = kernel.program
    states, moving = len(program.states), len(program.moving)
    begin_of = moving + bool(plan.slots)
    parameters = len(program.parameters)
    *batch, size = plan.shape
    seeded_operands = [(None, (0, 0, 0)) if s is None else operand(s, batch, size) for s in seeds[:moving]]
    on: list[Array | None] = [array for array, _ in seeded_operands]
    strides = table([s for _, s in seeded_operands])
    on_past = plan.past(filled=True)
    if plan.slots and seeds[states] is not None:
        on_past = past_rows(seeds[states], plan.shape, every=True)  # type: ignore[arg-type]
    every = seeds[states + bool(plan.slots) :]
    seeded = plan.steps if any(s is not None for s in every) else 0
    along = take((4, seeded, plan.count), plan.kind)
    for j, seed in enumerate(every if seeded else ()):
        along[j] = 0 if seed is None else dense(seed, (plan.steps, *plan.shape)).reshape(plan.steps, plan.count)
    over = plan.steps if any(needed[begin_of + parameters :]) else 0
    on_inputs = take((len(kernel.numbers), over, plan.count), plan.kind)
    on_parameters = take((parameters, plan.count), plan.kind)
    blocks = plan.blocks()
    for number in range(len(blocks) - 1, -1, -1):
        first, steps = blocks[number]
        start, past = tape[number]
        # What nobody asks for is not written: half the time of a short rollout goes to memory.
        begin = [take((plan.count,), plan.kind) if number or is_needed else None for is_needed in needed[:moving]]
        before = plan.past()
        plan.backward(
            first, steps, addresses(start), past.ctypes.data, len(past) == kernel.signals, plan.slots,
            along.ctypes.data, seeded, addresses(on), strides, addresses(begin), on_past.ctypes.data,
            before.ctypes.data, on_parameters.ctypes.data, number == len(blocks) - 1, on_inputs.ctypes.data, over,
        )  # fmt: skip
        on, on_past, strides = begin, before, table([(0, size, 1)] * moving)
    full = [*on, *([on_past] if plan.slots else []), *on_parameters, *on_inputs]
    return [
        _gradient(plan, i, gradient, like, begin_of, parameters) if is_needed and gradient is not None else None
        for i, (gradient, like, is_needed) in enumerate(zip(full, saved, needed, strict=True))
    ]


def _gradient(plan: RolloutPlan, i: int, gradient: Array, like: Tensor, begin_of: int, parameters: int) -> Tensor:
    """Return a gradient in the shape of the tensor that it belongs to."""
    if plan.slots and i == begin_of - 1:
        return past_tensor(gradient, plan.slots, plan.shape).sum_to_size(like.shape)
    if i < begin_of + parameters:
        return reduced(gradient, plan.shape, like)
    return _timed(gradient, plan, like)


def _timed(gradient: Array, plan: RolloutPlan, like: Tensor) -> Tensor:
    """Return an input's gradient in its own shape; steps beyond the rollout have none."""
    shape = (plan.steps, *[1] * (len(plan.shape) + 1 - like.dim()), *like.shape[1:])
    part = torch.from_numpy(gradient).view(plan.steps, *plan.shape).sum_to_size(shape).view(plan.steps, *like.shape[1:])
    if len(like) == plan.steps:
        return part
    return torch.cat((part, like.new_zeros(len(like) - plan.steps, *like.shape[1:])))


def _differentiable(
    plan: RolloutPlan, saved: tuple[Tensor, ...], seeds: tuple[Tensor | None, ...]
) -> tuple[Tensor | None, ...]:
    """Return the gradients with a graph of their own, for second derivatives, from the torch path."""
    program = plan.kernel.program
    values = dict(zip(program.moving, saved, strict=False))
    memory = dict(plan.state.memory)
    memory.update({n.removeprefix("memory of "): x for n, x in values.items() if n in program.memories})
    if plan.slots:
        memory[PAST] = saved[len(program.moving)]
    plain: Any = {n: x for n, x in values.items() if n not in program.memories}
    with off("second derivatives"):
        last, motion = plan.simulator.rollout(  # type: ignore[attr-defined]
            plan.state._replace(**plain, memory=memory), plan.inputs, plan.params, plan.steps
        )
    outputs = [
        *starts(last, program.states),
        *([last.memory[PAST]] if plan.slots else []),
        *(motion if plan.keep else ()),
    ]
    return gradients(outputs, seeds, saved)


def rollout(
    kernel: TileKernel, simulator: CarFollowingStep, state: State, inputs: Inputs, params: Params, steps: int, *,
    block: int = BLOCK, keep: bool = True,
) -> tuple[State, tuple[Tensor, ...] | None]:  # fmt: skip
    """Do what ``simulator.rollout`` does, by the kernel that ``dispatch`` found for it.

    Returns the last state and, where ``keep`` is set, position, speed, acceleration and gap of every step.
    """
    return run(*planned(kernel, simulator, state, inputs, params, steps, block, keep))


def run(plan: RolloutPlan, sources: Sequence[Tensor]) -> tuple[State, tuple[Tensor, ...] | None]:
    """Return what ``rollout`` does of a plan, differentiated by ``sources`` where it has a tape."""
    program = plan.kernel.program
    out = _Rollout.apply(plan, *sources) if plan.tape else tuple(_ran(plan)[0])
    motion = out[len(program.states) + bool(plan.slots) :]
    return state_after(program, plan.state, out, plan.steps), tuple(motion) if plan.keep else None


def state_after(program: Program, state: State, out: Sequence[Tensor], steps: int) -> State:
    """Return the state after some steps from its parts, in the order of the program, with the past behind them."""
    values = dict(zip(program.states, out, strict=False))
    memory = dict(state.memory)
    memory.update({n.removeprefix("memory of "): values[n] for n in program.memories})
    if PAST in memory and len(out) > len(program.states):
        memory[PAST] = out[len(program.states)]
    return state._replace(
        gap=values["gap"], speed=values["speed"], position=values["position"], accel=values["accel"],
        step=state.step + steps, present=values.get("present", state.present), memory=memory,
    )  # fmt: skip
