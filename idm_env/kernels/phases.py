"""Printed phases of a step, compiled each by itself and called through its address.

So the loops around them are compiled once for all simulators, and a new set of effects costs its own equations only.
A phase gets raw pointers of one precision: workspace, past, adjoint of the past, and constants.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_POINTER = ir.IntType(8).as_pointer()


@intrinsic
def call(typing_context: Any, address: Any, w: Any, h: Any, ah: Any, m: Any, k: Any, now: Any) -> Any:
    """Call the phase at ``address`` for ``m`` vehicles; ``now`` is the place of this step in the past."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def data(array: Any, kind: Any) -> Any:
            return builder.bitcast(context.make_array(kind)(context, builder, array).data, _POINTER)

        where, *rest = arguments
        number = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [_POINTER, _POINTER, _POINTER, number, _POINTER, number])
        function = builder.inttoptr(where, kind.as_pointer())
        builder.call(
            function, [data(rest[0], w), data(rest[1], h), data(rest[2], ah), rest[3], data(rest[4], k), rest[5]]
        )
        return context.get_dummy_value()

    return types.void(types.int64, w, h, ah, types.int64, k, types.int64), generate
