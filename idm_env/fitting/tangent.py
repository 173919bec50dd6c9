"""Forward-mode differentiation of a rollout: exact tangents of every step, for many directions at once.

``torch.func.jvp`` of a step spends most of its time on tangents of constants, which are zero. So the differentiated
step is traced once for given shapes, dead code is dropped, and the remaining plain graph is run for every step: about
ten times faster, the same numbers. The mathematics stays ``Simulator.step``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils import _pytree as pytree

from idm_env.parameters import replaced
from idm_env.simulator import Simulator
from idm_env.types import Params, State

Directions = Mapping[str, Tensor]
"""Full parameter name → its component along every direction, [K, ...rows, 1]."""


def _is_float(x: Any) -> bool:
    return isinstance(x, Tensor) and x.dtype.is_floating_point


class TangentStep:
    """The differentiated step of a simulator, traced once per set of shapes."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self._traced: dict[Any, Callable[..., Any]] = {}

    def __call__(
        self, state: State, tangents: list[Tensor], inputs: Any, params: Params, names: tuple[str, ...],
        directions: list[Tensor],
    ) -> tuple[State, list[Tensor]]:  # fmt: skip
        """Return the state Δt later and the tangents of its floating tensors, [K, ...] each, in tree order."""
        leaves, spec = pytree.tree_flatten((state, inputs, params))
        leaves = [x.contiguous() if _is_float(x) else x for x in leaves]  # duals refuse expanded memory
        shapes = tuple((x.shape, x.dtype) for x in (*leaves, *tangents, *directions) if x is not None)
        key = (spec, names, shapes)
        if key not in self._traced:
            self._traced[key] = self._trace(leaves, spec, names, tangents, directions)
        new_leaves, new_tangents = self._traced[key](leaves, tangents, directions)
        _, state_spec = pytree.tree_flatten(state)
        return pytree.tree_unflatten(new_leaves, state_spec), new_tangents

    def _trace(
        self, leaves: list[Tensor], spec: Any, names: tuple[str, ...], tangents: list[Tensor], directions: list[Tensor]
    ) -> Callable[..., Any]:
        step = self.simulator.step

        def advance(leaves: list[Tensor], tangents: list[Tensor], directions: list[Tensor]) -> Any:
            state, inputs, params = pytree.tree_unflatten(leaves, spec)
            state_leaves, state_spec = pytree.tree_flatten(state)
            moving = [i for i, x in enumerate(state_leaves) if _is_float(x)]
            fixed = [i for i, x in enumerate(state_leaves) if x is not None and i not in moving]

            def function(floats: list[Tensor], values: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
                filled = list(state_leaves)
                for i, x in zip(moving, floats, strict=True):
                    filled[i] = x
                changed = replaced(params, dict(zip(names, values, strict=True)))
                after = pytree.tree_flatten(step(pytree.tree_unflatten(filled, state_spec), inputs, changed))[0]
                return [after[i] for i in moving], [after[i] for i in fixed]

            floats = [state_leaves[i] for i in moving]
            values = [params[name.split(".")[0]][name.split(".")[1]] for name in names]

            def along(t: list[Tensor], d: list[Tensor]) -> Any:
                out, tangent, rest = torch.func.jvp(function, (floats, values), (t, d), has_aux=True)  # type: ignore[misc]
                return out, tangent, rest

            out, tangent, rest = torch.func.vmap(along, out_dims=(None, 0, None))(tangents, directions)  # type: ignore[arg-type]
            after: list[Tensor] = list(state_leaves)
            for i, x in (*zip(moving, out, strict=True), *zip(fixed, rest, strict=True)):
                after[i] = x
            return after, tangent

        traced = make_fx(advance)(leaves, tangents, directions)
        for node in list(traced.graph.nodes):
            if node.target is torch.ops.aten.alias.default:
                node.replace_all_uses_with(node.args[0])
        traced.graph.eliminate_dead_code()
        traced.recompile()
        return traced


def linearised_rollout(
    step: TangentStep, start: Callable[[Params], State], inputs: Mapping[str, Any], params: Params,
    directions: Directions, steps: int, read: Callable[[State], tuple[Tensor, ...]],
) -> tuple[list[Tensor], list[Tensor]]:  # fmt: skip
    """Roll out and return what ``read`` takes of every state [T, ...], and its derivative [T, K, ...] along directions.

    ``read`` must pick tensors of the state, not compute with them: it is applied to the tangents too.
    """
    names = tuple(directions)
    along = list(directions.values())

    def begin(values: list[Tensor]) -> list[Tensor]:
        changed = replaced(params, dict(zip(names, values, strict=True)))
        return [x for x in pytree.tree_flatten(start(changed))[0] if _is_float(x)]

    values = [params[name.split(".")[0]][name.split(".")[1]].contiguous() for name in names]
    with torch.no_grad():
        tangents = torch.func.vmap(lambda d: torch.func.jvp(begin, (values,), (d,))[1])(along)
        state = start(params)
        slices = step.simulator.slices(inputs, steps)
        samples: list[tuple[Tensor, ...]] = []
        derivatives: list[tuple[Tensor, ...]] = []
        for t in range(steps):
            state, tangents = step(state, tangents, slices[t], params, names, along)
            samples.append(read(state))
            derivatives.append(read(_with_floats(state, tangents)))
    return (
        [torch.stack(column) for column in zip(*samples, strict=True)],
        [torch.stack(column) for column in zip(*derivatives, strict=True)],
    )


def _with_floats(state: State, floats: list[Tensor]) -> State:
    leaves, spec = pytree.tree_flatten(state)
    rest = iter(floats)
    return pytree.tree_unflatten([next(rest) if _is_float(x) else x for x in leaves], spec)
