"""The call of a policy: inputs stay as they are, and outputs are checked.

Shapes: rows are environments: ``[n, …]``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

_NAMED = {"seen": "observations", "hidden": "hidden"}
NO_NUMBERS = "policy returned NaN or infinite {}. Give finite numbers; actions outside [-1, 1] are clipped."


def policy_outputs(policy: Callable[..., Any], inputs: Mapping[str, Tensor], actions: int) -> tuple[Tensor, ...]:
    """Return the actions ``(n, actions)`` of a policy for observations ``seen`` ``(n, features)``.

    Where the inputs have ``hidden`` ``(n, …)`` its hidden numbers come behind, of the same shape.

    Raises:
        ValueError: In one line, for a policy that does not take such inputs, writes to them, or returns something else.
    """
    takes = " and ".join(f"{_NAMED[n]} of shape {_shape(x)} ({x.dtype})" for n, x in inputs.items())
    before = [x._version for x in inputs.values() if not x.is_inference()]
    try:
        outputs = policy(*inputs.values())
    except (RuntimeError, TypeError) as error:
        why = str(error).splitlines()[0].rstrip(".")
        raise ValueError(f"policy does not take {takes}: {why}.") from error
    if before != [x._version for x in inputs.values() if not x.is_inference()]:
        raise ValueError(f"policy writes to the {' or '.join(_NAMED[n] for n in inputs)} that it is given. Copy first.")
    seen, hidden = inputs["seen"], inputs.get("hidden")
    if hidden is not None and not (isinstance(outputs, tuple) and len(outputs) == 2 and _alike(outputs[1], hidden)):
        raise ValueError(
            f"policy gives {_shapes(outputs)}, and (actions, hidden of shape {_shape(hidden)}) are needed, in "
            f"{hidden.dtype}."
        )
    action, *later = (outputs,) if hidden is None else outputs
    if not (_dense(action, seen) and action.shape == (len(seen), actions)):
        raise ValueError(f"policy gives {_shapes(action)} for each observation, and {actions} actions are needed.")
    return (action, *later)


def _dense(x: Any, like: Tensor) -> bool:
    """Return whether something is real numbers that lie where others lie."""
    whole = isinstance(x, Tensor) and not x.is_complex() and x.dtype != torch.bool
    return whole and (x.device, x.layout) == (like.device, like.layout)


def _alike(x: Any, like: Tensor) -> bool:
    return _dense(x, like) and (x.shape, x.dtype) == (like.shape, like.dtype)


def _shape(x: Any) -> str:
    """Return the shape of rows as errors tell it."""
    return f"(n, {', '.join(str(n) for n in x.shape[1:])})" if isinstance(x, Tensor) else type(x).__name__


def _shapes(x: Any) -> str:
    if isinstance(x, tuple):
        return f"({', '.join(_shape(part) for part in x)})"
    return f"{tuple(x.shape[1:])} ({x.dtype}, {len(x)} rows)" if isinstance(x, Tensor) and x.dim() else type(x).__name__
