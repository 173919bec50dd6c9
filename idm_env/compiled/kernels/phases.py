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


def _passing(*kinds: Any) -> Any:
    """Return how a call at an address is typed and emitted: of arrays the place where their numbers begin is passed."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def passed(x: Any, kind: Any) -> Any:
            is_array = isinstance(kind, types.Array)
            return builder.bitcast(context.make_array(kind)(context, builder, x).data, _POINTER) if is_array else x

        values = [passed(x, kind) for x, kind in zip(arguments[1:], kinds, strict=True)]
        kind = ir.FunctionType(ir.VoidType(), [x.type for x in values])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), values)
        return context.get_dummy_value()

    return types.void(types.int64, *kinds), generate


@intrinsic
def call(typing_context: Any, address: Any, w: Any, m: Any, k: Any) -> Any:
    """Call the phase at ``address`` for the first ``m`` vehicles of workspace ``w``, with constants ``k``."""
    return _passing(w, types.int64, k)


@intrinsic
def call_beside(typing_context: Any, address: Any, w: Any, block: Any, m: Any, k: Any) -> Any:
    """As ``call``, with a second array: rows of which there are many alike, one set of them at a time."""
    return _passing(w, block, types.int64, k)


@intrinsic
def call_rows(typing_context: Any, address: Any, begin: Any, end: Any, table: Any) -> Any:
    """Call the loops at ``address`` (``rows.py``) over some rows, with a table of the addresses of their arrays."""
    return _passing(types.int64, types.int64, table)
