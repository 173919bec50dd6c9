"""One processor instruction: start fetching a cache line that the next tile will need.

A tile touches a dozen arrays, a few kilobytes each: too short for the hardware to notice the pattern. Without this the
loads of a tile cost as much as five steps of it.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from idm_env.kernels.tiles import exact

LINE = 64
"""Bytes of a cache line."""

_READ, _SECOND_LEVEL, _DATA = 0, 2, 1


@intrinsic
def _touch(typing_context: Any, array: Any, index: Any) -> Any:
    """Prefetch the line of ``array[index]``; an address beyond the array is harmless."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = context.make_array(array)(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(pointer, [arguments[1]]), ir.PointerType(ir.IntType(8)))
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        builder.call(function, [address, number(_READ), number(_SECOND_LEVEL), number(_DATA)])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@exact
def prefetch(array, begin, n):
    """Start fetching ``array[begin : begin + n]``, of which a part may lie outside."""
    stride = LINE // array.itemsize
    for j in range(max(begin, 0), min(begin + n, array.size), stride):
        _touch(array, j)  # type: ignore[call-arg]
