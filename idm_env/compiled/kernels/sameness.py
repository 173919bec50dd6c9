"""A function of tensors as a digest of its operations: two recordings with the same digest print the same loops.

A function may read whatever it likes: numbers, flags, hooks, globals. Only what it *does* with its inputs says whether
loops that were printed earlier are still it. Recorded on few rows, that costs as much as calling it some times.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from idm_env.compiled.kernels.rows import recorded, storage
from idm_env.compiled.scalar.record import Untraceable


def digest(
    function: Callable[..., Mapping[str, Tensor]],
    inputs: Mapping[str, Tensor],
    simpler: Mapping[str, Callable[..., Any]],
    *,
    gradients: bool = False,
) -> bytes:
    """Return the digest (16 bytes) of the operations of ``function(**inputs)``, and of every constant that it reads.

    ``inputs`` are tensors of any shape by name; ``simpler`` replaces operations, as in ``RowFunction``.

    Raises:
        Untraceable: With ``gradients``, for a tensor that requires one and is no input: loops would lose it.
    """
    calls, results = recorded(function, inputs, simpler)
    number = {storage(x): f"in {name}" for name, x in inputs.items()}
    parts: list[str | bytes] = []

    def tell(x: Any) -> None:
        if isinstance(x, (list, tuple)):
            parts.append("(")
            for each in x:
                tell(each)
            parts.append(")")
        elif isinstance(x, Tensor):
            parts.append(f"{x.dtype}{tuple(x.shape)}{x.stride()}{x.storage_offset()}")
            label = number.get(storage(x))
            if label is None:
                if gradients and x.requires_grad:
                    raise Untraceable("a tensor that requires a gradient and is no parameter")
                label = number[storage(x)] = f"constant {len(number)}"
                parts.append(x.detach().cpu().contiguous().numpy().tobytes())
            parts.append(label)
        else:
            parts.append(repr(x))

    for name, args, kwargs, out in calls:
        parts.append(name)
        tell(args)
        tell(tuple(kwargs.items()))
        for x in out if isinstance(out, (list, tuple)) else (out,):
            if isinstance(x, Tensor):
                number.setdefault(storage(x), f"result {len(number)}")
                tell(x)
    tell(tuple(results.items()))
    whole = hashlib.blake2b(digest_size=16)
    for part in parts:
        whole.update(part if isinstance(part, bytes) else part.encode() + b"\0")
    return whole.digest()
