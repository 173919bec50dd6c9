"""Tensors of any broadcastable shape as what compiled loops take: a flat array and three strides, without copies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels.tiles import Array

Strides = tuple[int, int, int]


def operand(x: Tensor, batch: Sequence[int], size: int, steps: int | None = None) -> tuple[Array, Strides]:
    """Return the memory of ``x`` and its strides by step, batch row and vehicle.

    ``x`` broadcasts against ``(*batch, size)``, after a leading dimension of at least ``steps`` where that is given.
    """
    x = x.detach()
    if steps is None and x.is_contiguous():
        # The two commonest shapes, without the arithmetic below.
        if x.numel() == 1:
            return x.reshape(1).numpy(), (0, 0, 0)
        if x.shape == (*batch, size):
            return x.view(-1).numpy(), (0, size, 1)
    if steps is not None:
        gap = len(batch) + 2 - x.dim()
        x = x[(slice(0, steps), *([None] * gap))].expand(steps, *batch, size)
    else:
        x = x.expand(1, *batch, size)
    by_row = _collapsed(x)
    if by_row is None or x.stride(-1) not in (0, 1):
        x = x.contiguous()
        by_row = size
    by_step = x.stride(0) if x.shape[0] > 1 else 0
    by_vehicle = x.stride(-1) if size > 1 else by_row
    rows = math.prod(batch)
    reach = (x.shape[0] - 1) * by_step + (rows - 1) * by_row + (size - 1) * by_vehicle + 1 if x.numel() else 0
    flat = x.as_strided((max(reach, 0),), (1,), x.storage_offset())
    if flat.dtype == torch.bool:
        flat = flat.view(torch.uint8)
    if size == 1:
        by_vehicle = 1 if by_row == 1 else 0
    return flat.numpy(), (by_step, by_row, by_vehicle)


def _collapsed(x: Tensor) -> int | None:
    """Return the one stride that walks all batch dimensions of (time, *batch, vehicles), or None if there is none."""
    dims = [(size, stride) for size, stride in zip(x.shape[1:-1], x.stride()[1:-1], strict=True) if size > 1]
    if not dims:
        return x.shape[-1]
    for (_, outer), (size, inner) in pairwise(dims):
        if outer != size * inner:
            return None
    return dims[-1][1]


def dense(x: Tensor, shape: Sequence[int]) -> Array:
    """Return a tensor as one flat array of that shape, in the batch's order."""
    x = x.detach()
    if x.shape != shape:
        x = x.expand(*shape)
    return x.contiguous().view(-1).numpy()


def reduced(gradient: Array, full: Sequence[int], like: Tensor) -> Tensor:
    """Sum a gradient of the full shape to the shape of the tensor that was broadcast."""
    return torch.from_numpy(gradient).view(*full).sum_to_size(like.shape)


def gradients(
    outputs: Sequence[Tensor | None], seeds: Sequence[Tensor | None], sources: Sequence[Tensor | None]
) -> tuple[Tensor | None, ...]:
    """Return what falls on sources of any shape from ``seeds`` on outputs, by torch, with a graph of their own.

    None where a source requires no gradient, or nothing falls on it.
    """
    pairs = [(o, s) for o, s in zip(outputs, seeds, strict=True) if o is not None and s is not None and o.requires_grad]
    leaves = [x for x in sources if x is not None and x.requires_grad]
    results, falls = zip(*pairs, strict=True)
    slopes = iter(torch.autograd.grad(results, leaves, falls, create_graph=True, allow_unused=True))
    return tuple(next(slopes) if x is not None and x.requires_grad else None for x in sources)


def table(strides: Sequence[Strides]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return strides as the array that compiled loops read."""
    return np.array(strides, np.int64).reshape(-1, 3)
