"""Spaces of a task, and actions on their way in: checked, and converted to the tensors of the simulation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, MultiDiscrete, Space
from torch import Tensor

from idm_env.envs.settings import Settings
from idm_env.tasks import Task
from idm_env.validation import shown


def numpy_dtype(dtype: torch.dtype) -> type[np.floating]:
    """Return numpy's name of a float dtype."""
    return np.float64 if dtype == torch.float64 else np.float32


def observation_box(task: Task, dtype: torch.dtype, agents: int) -> Box:
    """Return the space of what ``agents`` agents observe, one after the other."""
    kind = numpy_dtype(dtype)
    low, high = np.asarray(task.bounds.low, kind), np.asarray(task.bounds.high, kind)
    return Box(np.tile(low, agents), np.tile(high, agents), dtype=kind)


def action_space(task: Task, agents: int) -> Space[np.ndarray]:
    """Return the space of actions ``(agents · commands,)``: float32, exactly [−1, 1], or whole numbers of levels."""
    if task.levels is not None:
        return MultiDiscrete(np.repeat(task.levels, agents))
    return Box(-1.0, 1.0, (agents * len(task.commands),), np.float32)


def continuous(action: Any, levels: Sequence[int], shape: tuple[int, ...]) -> np.ndarray:
    """Return actions of whole numbers as numbers in [−1, 1]; ``levels`` are those of the last dimension.

    ValueError for a wrong shape, or for what is no level.
    """
    array = action.detach().cpu().numpy() if isinstance(action, Tensor) else np.asarray(action)
    most = np.asarray(levels)
    if array.shape != shape or array.dtype.kind not in "iu" or (array < 0).any() or (array >= most).any():
        raise ValueError(f"action {shown(action)} must be whole numbers {shape}, from 0 to below {most.tolist()}.")
    return 2.0 * array / (most - 1) - 1.0


def action_of(action: Any, shape: tuple[int, ...], made: Settings) -> Tensor | np.ndarray:
    """Return an action as what ``Batch.step`` takes: an array with numpy output, else a tensor with its graph.

    Every type of number and every order in memory is accepted. ValueError for a wrong shape, or values that are not
    finite.
    """
    levels = made.task.levels
    if levels is not None:
        action = continuous(action, np.repeat(levels, shape[-1] // len(levels)).tolist(), shape)
    x: Any = action if isinstance(action, Tensor) else np.asarray(action)
    whole = x.dtype.kind in "fiu" if isinstance(x, np.ndarray) else not (x.dtype == torch.bool or x.is_complex())
    if not whole:
        raise ValueError(f"an action of type {x.dtype} is not a number. Give floats in [-1, 1].")
    if x.shape != shape:
        raise ValueError(f"action has shape {tuple(x.shape)}; {shape} is needed: one number per controlled vehicle.")
    held = x.detach() if isinstance(x, Tensor) else x
    finite = torch.isfinite if isinstance(x, Tensor) else np.isfinite
    if not (math.isfinite(held.item()) if shape == (1,) else finite(held).all()):
        raise ValueError("action holds NaN or infinite values. Give finite numbers; those outside [-1, 1] are clipped.")
    if x.dtype.itemsize > made.dtype.itemsize:  # what is finite stays so
        x = x.clip(-1.0, 1.0)
    if isinstance(x, np.ndarray):
        x = x.astype(numpy_dtype(made.dtype), order="C")
        return x if made.output == "numpy" else torch.from_numpy(x).to(made.device)
    x = x.to(device=made.device, dtype=made.dtype)
    return x.detach().cpu().numpy() if made.output == "numpy" else x  # type: ignore[no-any-return]
