"""A window of steps with a policy between them, of any face: compiled together where they can be, else step by step.

Shapes: rows are environments, and time comes first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import dispatch
from idm_env.compiled.scalar.record import Untraceable
from idm_env.envs.batch import Batch, in_memory
from idm_env.envs.policy_call import NO_NUMBERS, policy_outputs


class Unrolled(NamedTuple):
    """A window of n environments, time first, with its graph.

    ``observation`` ``(steps + 1, n, features)`` is what the policy saw, and sees next: where an episode ended, that of
    the next one, through which no gradient flows. ``action`` ``(steps, n, actions)`` is what it did. ``reward``,
    ``terminated`` and ``truncated`` ``(steps, n)`` are those of ``step``. ``final`` ``(steps, n, features)`` is what is
    observed after each step, before any reset. ``hidden`` ``(n, …)`` is what a policy with a memory remembers then, 0
    where an episode has just begun; None of other policies.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    final: Tensor
    hidden: Tensor | None = None


@in_memory
def unroll(
    batch: Batch, policy: Callable[..., Any], steps: int, push: Tensor | None, hidden: Tensor | None
) -> Unrolled:
    """Return a window of steps; see ``Face.unroll``. ValueError for a policy whose actions have another shape."""
    task, values, dtype = batch.task, batch.values, batch.settings.dtype
    shape = (batch.count, len(task.agents) * len(task.commands))
    extra = _per_environment("push", torch.zeros(shape) if push is None else push, shape).to(dtype).contiguous()
    if hidden is not None:
        hidden = _per_environment("hidden", hidden, (batch.count, *np.shape(hidden)[1:]))
    if hidden is not None and hidden.dtype != dtype:
        raise ValueError(f"hidden has {hidden.dtype}, and the environments have {dtype}. Give it in {dtype}.")
    # Detectors count every step: there a window is its steps, each of which is compiled.
    counts = batch.counters is not None and bool(batch.counters.loops)
    if not counts and not task.simulator.untried and values is not None and dispatch.surroundings() is None:
        from idm_env.envs import window

        try:
            batch.settle()
            fields = window.compiled(batch, values, policy, steps, extra, hidden)
            if fields is not None:
                return Unrolled(*fields)
        except Untraceable:
            pass
    columns: list[tuple[Tensor, ...]] = []
    seen = batch.seen().clone()  # a policy may write to it
    first = [seen]
    for _ in range(steps):
        inputs = {"seen": seen} if hidden is None else {"seen": seen, "hidden": hidden}
        action, *later = policy_outputs(policy, inputs, shape[1])
        hidden = next(iter(later), None)
        for name, x in (("actions", action), ("hidden numbers", hidden)):
            if x is not None and not bool(x.isfinite().all()):
                raise ValueError(NO_NUMBERS.format(name))
        action = action.clamp(torch.finfo(dtype).min, torch.finfo(dtype).max).to(dtype) + extra
        outcome = batch.step(action)
        seen = final = outcome.observation.reshape(batch.count, -1)
        over = np.flatnonzero((outcome.whole.terminated | outcome.whole.truncated).numpy())
        if len(over):
            seen = torch.as_tensor(batch.reset(over)).reshape(batch.count, -1)
            hidden = None if hidden is None else hidden.index_fill(0, torch.from_numpy(over), 0.0)
        first.append(seen)
        columns.append((action, *outcome.whole, final))
    action, reward, terminated, truncated, final = (torch.stack(x) for x in zip(*columns, strict=True))
    return Unrolled(torch.stack(first), action, reward, terminated, truncated, final, hidden)


def _per_environment(name: str, x: Any, shape: tuple[int, ...]) -> Tensor:
    """Return a tensor in a shape; ValueError, in one line, for another type or shape, and for NaN."""
    text = f"a tensor of shape {tuple(x.shape)}" if isinstance(x, Tensor) else f"of type {type(x).__name__}"
    try:
        if isinstance(x, Tensor) and bool(x.isfinite().all()):
            return x.expand(shape)
        text += " with NaN or infinite numbers" if isinstance(x, Tensor) else ""
    except RuntimeError:  # it does not fit
        pass
    raise ValueError(
        f"{name} is {text}. Give one row for each of {shape[0]} environments: a tensor of finite numbers, {shape}."
    )
