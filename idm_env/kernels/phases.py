"""Printed phases of a step, compiled each by itself and called through its address.

So the loops around them are compiled once for all simulators, and a new set of effects costs its own equations only.
A phase gets raw pointers of one precision: workspace and constants.
"""

from __future__ import annotations

from typing import Any

from idm_env.extras import needed

with needed("a compiled loop"):
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic


_POINTER = ir.IntType(8).as_pointer()


@intrinsic
def call(typing_context: Any, address: Any, w: Any, m: Any, k: Any) -> Any:
    """Call the phase at ``address`` for the first ``m`` vehicles of workspace ``w``, with constants ``k``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def data(array: Any, kind: Any) -> Any:
            return builder.bitcast(context.make_array(kind)(context, builder, array).data, _POINTER)

        kind = ir.FunctionType(ir.VoidType(), [_POINTER, ir.IntType(64), _POINTER])
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        builder.call(function, [data(arguments[1], w), arguments[2], data(arguments[3], k)])
        return context.get_dummy_value()

    return types.void(types.int64, w, types.int64, k), generate


@intrinsic
def call_beside(typing_context: Any, address: Any, w: Any, block: Any, m: Any, k: Any) -> Any:
    """As ``call``, with a second array: rows of which there are many alike, one set of them at a time."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def data(array: Any, kind: Any) -> Any:
            return builder.bitcast(context.make_array(kind)(context, builder, array).data, _POINTER)

        kind = ir.FunctionType(ir.VoidType(), [_POINTER, _POINTER, ir.IntType(64), _POINTER])
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        builder.call(function, [data(arguments[1], w), data(arguments[2], block), arguments[3], data(arguments[4], k)])
        return context.get_dummy_value()

    return types.void(types.int64, w, block, types.int64, k), generate


@intrinsic
def call_rows(typing_context: Any, address: Any, begin: Any, end: Any, table: Any) -> Any:
    """Call the loops at ``address`` (``rows.py``) over some rows, with a table of the addresses of their arrays."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64), ir.IntType(64), ir.IntType(64).as_pointer()])
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        data = context.make_array(table)(context, builder, arguments[3]).data
        builder.call(function, [arguments[1], arguments[2], data])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64, table), generate
