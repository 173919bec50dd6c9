"""Which path runs, and why: a compiled kernel where simulator, tensors and surroundings fit, torch everywhere else.

The choice looks at types, shapes, devices and at what is installed, never at ``requires_grad``: values are the same
bits with and without a graph. It imports numba only once a kernel is to run.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from idm_env import compat
from idm_env.backends import off, switched_off
from idm_env.compiled.kernels import available
from idm_env.compiled.scalar.record import Form
from idm_env.delay_buffer import PAST
from idm_env.simulator import Simulator
from idm_env.step import CarFollowingStep
from idm_env.types import Inputs, Params, State

if TYPE_CHECKING:
    from idm_env.compiled.kernels.printed import TileKernel


def found(simulator: CarFollowingStep, state: State, inputs: Inputs, params: Params) -> TileKernel | str:
    """Return the kernel for this call, or why it takes the torch path."""
    why = surroundings() or _unfit_tensors(state, inputs, params)
    if why is not None:
        return why
    if state.lanes is not None:
        if state.lanes.journeys is not None:
            from idm_env.compiled.kernels.networks import kernel_of
        else:
            from idm_env.compiled.kernels.several import kernel_of

        return kernel_of(simulator, state, inputs)  # type: ignore[arg-type]
    from idm_env.compiled.kernels.printed import tile_kernel

    return tile_kernel(simulator, Form.of(state, inputs))


def surroundings() -> str | None:
    """Return why no kernel can run here at all, or None."""
    if switched_off() is not None or os.environ.get("IDM_ENV_KERNELS", "1") == "0":
        return switched_off() or "IDM_ENV_KERNELS=0"
    if not available():
        return "numba is not installed; pip install 'idm-env[kernels]'"
    if compat.transforming() or compat.forward_mode():
        return "a torch.func transform or forward-mode differentiation is active"
    if torch.compiler.is_compiling():
        return "torch is compiling"
    return None


def rollout(
    simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int, every: int, keep: bool
) -> tuple[State, tuple[Tensor, ...] | None] | None:
    """Return what ``Simulator.rollout`` returns, by a kernel; None where there is none for this call."""
    if not simulator.kernels:
        return None
    kernel = found(simulator, state, inputs, params)
    if isinstance(kernel, str):
        return None
    if state.lanes is not None:
        from idm_env.compiled.kernels import networks, several

        way = several if state.lanes.journeys is None else networks
        return way.rollout(kernel, simulator, state, inputs, params, steps, keep)
    from idm_env.compiled.kernels import lanes

    block = min(every or lanes.BLOCK, 4 * lanes.BLOCK)
    return lanes.run(*lanes.planned(kernel, simulator, state, inputs, params, steps, block, keep))


def refusal(simulator: Simulator, state: State, inputs: Inputs, params: Params) -> str | None:
    """Return why this call takes the torch path, or None if a kernel takes it."""
    if not simulator.kernels:
        return "the step is compiled by torch"
    kernel = found(simulator, state, inputs, params)
    return kernel if isinstance(kernel, str) else None


def _unfit_tensors(state: State, inputs: Inputs, params: Params) -> str | None:
    kind = state.speed.dtype
    if kind not in (torch.float32, torch.float64):
        return f"tensors are {kind}; kernels take float32 and float64"
    if state.speed.numel() == 0:
        return "there are no vehicles"
    shape = state.speed.shape
    for x in (x for name, x in state.memory.items() if name != PAST):
        if not _within(x.shape, shape):
            return f"a memory has shape {tuple(x.shape)}; kernels know one number per vehicle"
    tensors = [state.position, state.speed, state.gap, *state.memory.values(), *_tensors(inputs)]
    for effect, values in params.items():
        for name, value in values.items():
            if not isinstance(value, Tensor):
                return f"{effect}.{name} is no tensor"
            if value.dim() and not _within(value.shape, shape):
                return f"{effect}.{name} enlarges the batch"
            tensors.append(value)
    for x in tensors:
        if not x.is_cpu:
            return f"tensors are on {x.device}; kernels run on the CPU"
        if x.dtype is not kind and x.dtype is not torch.bool:
            return f"tensors are {kind} and {x.dtype}"
    for x in _tensors(inputs):
        if x.dim() == 0 or not _within(x.shape[1:], shape):
            return "an input enlarges the batch"
    return None


def _within(shape: torch.Size, full: torch.Size) -> bool:
    """Whether a shape broadcasts to the full one; plain Python, because torch.broadcast_shapes takes 20 µs."""
    if len(shape) > len(full):
        return False
    return all(a in (1, b) for a, b in zip(reversed(shape), reversed(full), strict=False))


def _tensors(inputs: Inputs) -> list[Tensor]:
    parts = ((value,) if isinstance(value, Tensor) else value for value in inputs.values())
    return [x for part in parts for x in part if x is not None]


__all__ = ["found", "off", "refusal", "rollout", "surroundings"]
