"""Steps without a graph, for environments and searches: a simulator's kernel with its operands laid out once.

``Stepper`` is a function of state, inputs and parameters like ``Simulator.step``; what it spares is the bookkeeping
that a rollout does anew at every call.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.history import PAST
from idm_env.kernels import lane_loops, tiles
from idm_env.kernels import threads as pool
from idm_env.kernels.lanes import part_of, past_rows, past_tensor, starts, state_after, static_of
from idm_env.kernels.operands import FLAGS, OPERANDS, STATES, Strides, dense, filled, operand, table
from idm_env.kernels.printed import TileKernel, tile_kernel
from idm_env.kernels.tiles import Array
from idm_env.scalar.record import Form
from idm_env.step import Stepping
from idm_env.types import Inputs, Params, State


class Stepper:
    """``step(state, inputs, params)`` and ``run`` of a simulator by its kernel; values only, on the CPU.

    Parameters are packed anew whenever a tensor of theirs is another or has been written to. ValueError for a
    simulator without a kernel, at the first call.
    """

    def __init__(self, simulator: Stepping) -> None:
        self.simulator = simulator
        self._kernels: dict[Form, TileKernel | str] = {}
        self._packed_of: list[tuple[Tensor, int]] = []
        self._packed: list[tuple[Array, Strides]] = []
        self._packed_for: tuple[Any, ...] = ()

    def __call__(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later; inputs as for ``Simulator.step``."""
        return self.run(state, {name: _timed(value) for name, value in inputs.items()}, params, 1)

    def run(self, state: State, inputs: Inputs, params: Params, steps: int, *, threads: int | None = None) -> State:
        """Return the state some steps later; inputs have a leading time dimension, as for ``Simulator.rollout``."""
        kernel = self.kernel(state, inputs)
        if isinstance(kernel, str):
            raise ValueError(f"this simulator has no kernel: {kernel}. Use simulator.step.")
        program, shape, kind = kernel.program, tuple(state.speed.shape), state.speed.dtype
        *batch, size = shape
        made = self._static(kernel, state, params)
        made = made + [operand(part_of(inputs, n), batch, size, steps) for n in kernel.numbers]
        flags = [operand(part_of(inputs, n), batch, size, steps) for n in kernel.flags]
        strides = table([*(s for _, s in made), *(s for _, s in flags), (0, size, 1)])
        precision = np.dtype(np.float32 if kind == torch.float32 else np.float64)
        start = filled([dense(x.to(kind), shape) for x in starts(state, program.states)], STATES)
        count, rows = math.prod(shape), math.prod(batch)
        ends = [np.empty(count, precision) for _ in program.states]
        slots = state.memory[PAST].shape[-2] if kernel.signals else 0
        before = past_rows(state.memory[PAST], shape) if slots else np.zeros((1, 1), precision)
        after = np.empty((max(slots * kernel.signals, 1), count if slots else 1), precision)
        wide = tiles.NARROW if slots and size <= tiles.NARROW else tiles.width(size, steps)
        around = tiles.halo(steps, program.reach)
        given = (
            start, filled(ends, STATES), before, after, slots, np.empty((4, 0, 1), precision), kernel.measures,
            kernel.forward(precision.name), kernel.looks, kernel.recalls, kernel.read,
            filled([a for a, _ in made], OPERANDS), filled([a for a, _ in flags], FLAGS), strides,
            kernel.constants[precision.name], 0, steps, rows, size, wide, around,
        )  # fmt: skip
        pool.split(
            lambda begin, end: lane_loops.forward(*given, begin, end),
            tiles.tiles(rows, size, wide, around), 1, pool.count(count * steps, threads),
        )  # fmt: skip
        out = [torch.from_numpy(x).view(shape) for x in ends]
        if slots:
            out.append(past_tensor(after, slots, shape))
        return state_after(program, state, out, steps)

    def kernel(self, state: State, inputs: Inputs) -> TileKernel | str:
        """Return the kernel for these inputs, or why there is none."""
        form = Form.of(state, inputs)
        found = self._kernels.get(form)
        if found is None:
            found = self._kernels[form] = tile_kernel(self.simulator, form)
        return found

    def _static(self, kernel: TileKernel, state: State, params: Params) -> list[tuple[Array, Strides]]:
        """Return operands of what holds for many steps, packed once for the same tensors."""
        program = kernel.program
        shape, kind = state.speed.shape, state.speed.dtype
        values = [static_of(self.simulator, state, params, n) for n in program.parameters]
        same = self._packed_for == (id(kernel), shape) and all(
            a is b and version == a._version for a, (b, version) in zip(values, self._packed_of, strict=True)
        )
        if not same:
            self._packed = [operand(x.to(kind), shape[:-1], shape[-1]) for x in values]
            self._packed_of = [(x, x._version) for x in values]
            self._packed_for = (id(kernel), shape)
        fixed = [static_of(self.simulator, state, params, n).to(kind) for n in program.statics]
        return [*(operand(x, shape[:-1], shape[-1]) for x in fixed), *self._packed]


def _timed(value: Any) -> Any:
    """Give an input of one step a leading time dimension."""
    if isinstance(value, Tensor):
        return value[None]
    return type(value)(*(None if x is None else x[None] for x in value))
