"""Memory as compiled loops move it: by place, without the bookkeeping of arrays.

A place is an array or, for memory that the caller holds, an address as a number; beside it stands an index. Numba
counts references to whatever array is taken from a tuple or sliced, which took a fifth of a step; here nothing is
counted, no index is wrapped round, and loops over indices become vector code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from idm_env.extras import needed

with needed("a compiled loop"):
    from llvmlite import ir
    from numba import extending, types
    from numba.core import cgutils

intrinsic: Any = extending.intrinsic

LINE = 64
"""Bytes of a cache line."""

_WHOLE, _BYTE = ir.IntType(64), ir.IntType(8)
_READ, _SECOND_LEVEL, _DATA = 0, 2, 1


def addresses(arrays: Sequence[np.ndarray[Any, Any] | None]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return where arrays begin [arrays], 0 for None; the caller keeps them as long as the addresses are used."""
    return np.array([0 if x is None else x.__array_interface__["data"][0] for x in arrays], np.int64)


def _number(*kinds: Any) -> Any:
    """Return the type of the numbers: that of the arrays, of which there is at least one."""
    return next(kind.dtype for kind in kinds if isinstance(kind, types.Array))


def _pointer(context: Any, builder: Any, kind: Any, place: Any, index: Any, number: Any) -> Any:
    """Return the pointer to one number of an array, or of what begins at an address."""
    to = context.get_value_type(number).as_pointer()
    if isinstance(kind, types.Array):
        base = builder.bitcast(context.make_array(kind)(context, builder, place).data, to)
    else:
        base = builder.inttoptr(place, to)
    return builder.gep(base, [index])


def _bytes(context: Any, number: Any) -> Any:
    return ir.Constant(_WHOLE, context.get_abi_sizeof(context.get_value_type(number)))


@intrinsic
def located(typing_context: Any, address: Any, like: Any) -> Any:
    """Return a pointer to what begins at an address, to numbers of the type ``like``."""
    kind = types.CPointer(like.dtype)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(kind))

    return kind(address, like), generate


@intrinsic
def number(typing_context: Any, place: Any, index: Any, like: Any) -> Any:
    """Return one number, of the type of those in the array ``like``."""
    kind = _number(place, like)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_pointer(context, builder, place, arguments[0], arguments[1], kind))

    return kind(place, types.int64, like), generate


def _ends(context: Any, builder: Any, target: Any, source: Any, arguments: Sequence[Any], kind: Any) -> tuple[Any, Any]:
    """Return the pointers to the first numbers that are written and read."""
    first = _pointer(context, builder, target, arguments[0], arguments[1], kind)
    return first, _pointer(context, builder, source, arguments[2], arguments[3], kind)


@intrinsic
def copy(typing_context: Any, target: Any, to: Any, source: Any, at: Any, n: Any) -> Any:
    """Copy ``n`` numbers from index ``at`` of one place to index ``to`` of another, which do not overlap."""
    kind = _number(target, source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first, second = _ends(context, builder, target, source, arguments, kind)
        cgutils.raw_memcpy(builder, first, second, arguments[4], _bytes(context, kind).constant)
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64, types.int64), generate


@intrinsic
def stream(typing_context: Any, target: Any, to: Any, source: Any, at: Any) -> Any:
    """Copy a cache line past the caches to an address where one begins, from an array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first, second = _ends(context, builder, target, source, arguments, source.dtype)
        line = ir.VectorType(ir.IntType(32), LINE // 4).as_pointer()
        content = builder.load(builder.bitcast(second, line), align=4)
        done = builder.store(content, builder.bitcast(first, line), align=LINE)
        done.set_metadata("nontemporal", builder.module.add_metadata([ir.IntType(32)(1)]))
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64), generate


@intrinsic
def add(typing_context: Any, target: Any, to: Any, source: Any, at: Any, n: Any) -> Any:
    """Add ``n`` numbers from index ``at`` of one place to those from index ``to`` of another."""
    kind = _number(target, source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first, second = _ends(context, builder, target, source, arguments, kind)
        with cgutils.for_range(builder, arguments[4]) as loop:
            cell = builder.gep(first, [loop.index])
            builder.store(builder.fadd(builder.load(cell), builder.load(builder.gep(second, [loop.index]))), cell)
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64, types.int64), generate


@intrinsic
def gather(typing_context: Any, target: Any, to: Any, source: Any, at: Any, index: Any, first: Any, n: Any) -> Any:
    """Copy ``n`` numbers from a place to another: those at ``at`` and the places from ``index[first]`` on."""
    kind = _number(target, source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        into, base = _ends(context, builder, target, source, arguments, kind)
        which = _pointer(context, builder, index, arguments[4], arguments[5], index.dtype)
        with cgutils.for_range(builder, arguments[6]) as loop:
            cell = builder.gep(base, [builder.load(builder.gep(which, [loop.index]))])
            builder.store(builder.load(cell), builder.gep(into, [loop.index]))
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64, index, types.int64, types.int64), generate


@intrinsic
def fill(typing_context: Any, target: Any, to: Any, value: Any, n: Any) -> Any:
    """Fill ``n`` numbers of an array from index ``to`` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first = _pointer(context, builder, target, arguments[0], arguments[1], target.dtype)
        with cgutils.for_range(builder, arguments[3]) as loop:
            builder.store(arguments[2], builder.gep(first, [loop.index]))
        return context.get_dummy_value()

    return types.void(target, types.int64, target.dtype, types.int64), generate


@intrinsic
def copy_truth(typing_context: Any, target: Any, to: Any, source: Any, at: Any, n: Any) -> Any:
    """Fill ``n`` numbers of an array with truth values, a byte each, from an address."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first = _pointer(context, builder, target, arguments[0], arguments[1], target.dtype)
        second = _pointer(context, builder, source, arguments[2], arguments[3], types.uint8)
        with cgutils.for_range(builder, arguments[4]) as loop:
            value = builder.uitofp(builder.load(builder.gep(second, [loop.index])), first.type.pointee)
            builder.store(value, builder.gep(first, [loop.index]))
        return context.get_dummy_value()

    return types.void(target, types.int64, types.int64, types.int64, types.int64), generate


@intrinsic
def prefetch(typing_context: Any, source: Any, at: Any, n: Any, like: Any) -> Any:
    """Start fetching ``n`` numbers, of the type of those in ``like``, from an address; outside it is harmless.

    A tile touches a dozen arrays, a few kilobytes each: too short for the hardware to notice the pattern. Without this
    the loads of a tile cost as much as five steps of it.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        size = _bytes(context, like.dtype)
        begin = builder.add(arguments[0], builder.mul(arguments[1], size))
        line = ir.Constant(_WHOLE, LINE)
        count = builder.sdiv(builder.add(builder.mul(arguments[2], size), line), line)
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [_BYTE.as_pointer(), word, word, word])
        touch = builder.module.declare_intrinsic("llvm.prefetch", [_BYTE.as_pointer()], kind)
        with cgutils.for_range(builder, count) as loop:
            address = builder.inttoptr(builder.add(begin, builder.mul(loop.index, line)), _BYTE.as_pointer())
            builder.call(touch, [address, word(_READ), word(_SECOND_LEVEL), word(_DATA)])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64, like), generate
