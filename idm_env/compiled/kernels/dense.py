"""Products of small matrices with rows side by side: what a layer of a network does for 32 rows at a time.

Numbers of a column lie one behind another in a workspace, ``PITCH`` apart from the next column's. A tile of columns
times rows stays in registers, which no compiler arranges from loops: so the innermost loops are written as vectors.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from collections.abc import Callable
from typing import Any

from idm_env.extras import needed

with needed("a compiled loop"):
    from llvmlite import binding, ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

from idm_env.compiled.kernels.compiler import compiler

PITCH = 64
"""Rows in a block: their columns lie so far apart."""

ROWS = 32
"""Rows of a tile; blocks hold whole tiles."""

_WIDE = bool(binding.get_host_cpu_features().get("avx512f"))
_BYTES, _TALL = (64, 4) if _WIDE else (32, 2)
"""Bytes of a vector, and columns of a tile: accumulators, two vectors of rows and a weight fill the registers."""

swift = compiler(fastmath={"contract", "reassoc"})


class _Vectors:
    """Vectors of numbers of an array, in the middle of a compiled function."""

    def __init__(self, context: Any, builder: Any, array: types.Array) -> None:
        self.builder, self._context = builder, context
        self.number = context.get_value_type(array.dtype)
        size = array.dtype.bitwidth // 8  # type: ignore[attr-defined]
        self.lanes, self.align = _BYTES // size, size
        self.vector = ir.VectorType(self.number, self.lanes)

    def data(self, kind: types.Array, array: Any) -> Any:
        return self._context.make_array(kind)(self._context, self.builder, array).data

    def at(self, data: Any, place: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(data, [place]), self.vector.as_pointer())

    def get(self, data: Any, place: Any) -> Any:
        return self.builder.load(self.at(data, place), align=self.align)

    def put(self, value: Any, data: Any, place: Any) -> None:
        self.builder.store(value, self.at(data, place), align=self.align)

    def spread(self, number: Any) -> Any:
        one = ir.IntType(32)
        first = self.builder.insert_element(ir.Constant(self.vector, ir.Undefined), number, one(0))
        zeros = ir.Constant(ir.VectorType(one, self.lanes), [one(0)] * self.lanes)
        return self.builder.shuffle_vector(first, ir.Constant(self.vector, ir.Undefined), zeros)

    def fma(self, x: Any, y: Any, z: Any) -> Any:
        return self.builder.fadd(self.builder.fmul(x, y, flags=["contract"]), z, flags=["contract"])

    def total(self, x: Any) -> Any:
        name = f"llvm.vector.reduce.fadd.v{self.lanes}f{8 * self.align}"
        kind = ir.FunctionType(self.number, [self.number, self.vector])
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, [self.number(0.0), x], fastmath=["reassoc"])

    def step(self, place: Any, many: int, pitch: Any) -> Any:
        return self.builder.add(place, self.builder.mul(pitch, pitch.type(many)))


def _tile(tall: int) -> Any:
    @intrinsic
    def tile(typing_context: Any, w: Any, to: Any, apart: Any, a: Any, next_a: Any, b: Any, at: Any, by_column: Any,
             by_k: Any, deep: Any) -> Any:  # fmt: skip
        """Add to some columns at ``to`` the sum over k of what lies at ``a`` times numbers of ``b``, for 32 rows."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            v = _Vectors(context, builder, w)
            data, weights = v.data(w, arguments[0]), v.data(b, arguments[5])
            _, first, pitch, source, source_pitch, _, weight, column, inner, count = arguments
            lanes = range(0, ROWS, v.lanes)
            spots = [(i, builder.add(v.step(first, i, pitch), first.type(r))) for i in range(tall) for r in lanes]
            sums = [cgutils.alloca_once_value(builder, v.get(data, spot)) for _, spot in spots]
            with cgutils.for_range(builder, count) as loop:
                begin = builder.add(source, builder.mul(loop.index, source_pitch))
                rows = [v.get(data, builder.add(begin, begin.type(r))) for r in lanes]
                base = builder.add(weight, builder.mul(loop.index, inner))
                for i in range(tall):
                    times = v.spread(builder.load(builder.gep(weights, [v.step(base, i, column)])))
                    for x, total in zip(rows, sums[i * len(rows) : (i + 1) * len(rows)], strict=True):
                        builder.store(v.fma(times, x, builder.load(total)), total)
            for (_, spot), total in zip(spots, sums, strict=True):
                v.put(builder.load(total), data, spot)
            return context.get_dummy_value()

        whole = types.int64
        return types.void(w, whole, whole, whole, whole, b, whole, whole, whole, whole), generate

    return tile


def _outer(tall: int, wide: int) -> Any:
    @intrinsic
    def outer_tile(typing_context: Any, sums: Any, to: Any, by_x: Any, by_y: Any, w: Any, x: Any, apart_x: Any, y: Any,
                   apart_y: Any, m: Any) -> Any:  # fmt: skip
        """Add to some elements of a matrix at ``to`` sums over rows of columns at ``x`` times columns at ``y``."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            v = _Vectors(context, builder, w)
            target, data = v.data(sums, arguments[0]), v.data(w, arguments[4])
            _, first, down, across, _, left, pitch_left, right, pitch_right, count = arguments
            zero = ir.Constant(v.vector, [v.number(0.0)] * v.lanes)
            totals = [[cgutils.alloca_once_value(builder, zero) for _ in range(wide)] for _ in range(tall)]
            for row in totals:
                for total in row:
                    builder.store(zero, total)
            low, step = count.type(0), count.type(v.lanes)
            with cgutils.for_range_slice(builder, low, count, step, intp=count.type) as (r, _):
                one = [v.get(data, builder.add(v.step(left, i, pitch_left), r)) for i in range(tall)]
                other = [v.get(data, builder.add(v.step(right, k, pitch_right), r)) for k in range(wide)]
                for a, row in zip(one, totals, strict=True):
                    for b, total in zip(other, row, strict=True):
                        builder.store(v.fma(a, b, builder.load(total)), total)
            for i, row in enumerate(totals):
                for k, total in enumerate(row):
                    spot = builder.gep(target, [v.step(v.step(first, i, down), k, across)])
                    builder.store(builder.fadd(builder.load(spot), v.total(builder.load(total))), spot)
            return context.get_dummy_value()

        whole = types.int64
        return types.void(sums, whole, whole, whole, w, whole, whole, whole, whole, whole), generate

    return outer_tile


_tall_tile: Callable[..., Any] = _tile(_TALL)
_flat_tile: Callable[..., Any] = _tile(1)
_large, _small = _outer(_TALL, 4), _outer(1, 1)


@swift
def dense(w, to, apart, wide, a, next_a, deep, b, at, by_column, by_k, m):
    """Add ``Σ_k a_k b_kj`` to columns j at ``to``, for m rows; ``b`` begins at ``at``, with strides by j and by k."""
    tall = wide - wide % _TALL
    for r in range(0, m, ROWS):
        for j in range(0, tall, _TALL):
            _tall_tile(w, to + j * apart + r, apart, a + r, next_a, b, at + j * by_column, by_column, by_k, deep)
        for j in range(tall, wide):
            _flat_tile(w, to + j * apart + r, apart, a + r, next_a, b, at + j * by_column, by_column, by_k, deep)


@swift
def outer(sums, to, by_x, by_y, w, x, apart_x, tall, y, apart_y, wide, m):
    """Add ``Σ_r x_jr y_kr`` to a matrix at ``to`` with strides by j and by k, for m rows r."""
    for j in range(0, tall - tall % _TALL, _TALL):
        for k in range(0, wide - wide % 4, 4):
            _large(sums, to + j * by_x + k * by_y, by_x, by_y, w, x + j * apart_x, apart_x, y + k * apart_y, apart_y, m)
    for j in range(tall):
        for k in range(0 if j >= tall - tall % _TALL else wide - wide % 4, wide):
            _small(sums, to + j * by_x + k * by_y, by_x, by_y, w, x + j * apart_x, apart_x, y + k * apart_y, apart_y, m)
