"""Straight-line code that Python runs once, while numba compiles, on numbers that emit their own instructions.

numba's analysis of a function takes a time that grows with the square of its length: ten seconds for a whole catalogue
of effects. A ``staged`` function is not analysed: its text is run with ``Number`` in place of floats, so each operation
is one instruction, with the rounding that the text says.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from idm_env.extras import needed

with needed("a compiled loop"):
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.core.typing.templates import signature

from idm_env.compiled.kernels.compiler import counted
from idm_env.compiled.kernels.functions import exp_float64, sigmoid_float64

REAL, WHOLE = ir.DoubleType(), ir.IntType(64)


class Emitter(NamedTuple):
    """Where instructions go."""

    context: Any
    builder: Any


_now: ContextVar[Emitter] = ContextVar("emitter")


class Number:
    """A double that the compiled code will have."""

    def __init__(self, value: Any) -> None:
        self._value = value

    @property
    def value(self) -> Any:
        """The value in LLVM."""
        return self._value

    def __neg__(self) -> Number:
        return Number(_now.get().builder.fneg(self.value))

    def __abs__(self) -> Number:
        return _called(lambda x: abs(x), self)

    def __ne__(self, other: Any) -> StagedBool:  # type: ignore[override]
        return StagedBool(_now.get().builder.fcmp_unordered("!=", self.value, _real(other)))

    __hash__ = None  # type: ignore[assignment]


class Merged(Number):
    """A number that a block under ``when`` may replace."""

    def __init__(self, value: Any) -> None:
        builder = _now.get().builder
        super().__init__(cgutils.alloca_once(builder, REAL))
        builder.store(_real(value), self._value)

    @property
    def value(self) -> Any:
        """The value in LLVM, as it is now."""
        return _now.get().builder.load(self._value)

    def become(self, value: Any) -> None:
        """Replace the number."""
        _now.get().builder.store(_real(value), self._value)


class StagedBool:
    """A truth value that the compiled code will have."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __and__(self, other: Any) -> StagedBool:
        return StagedBool(_now.get().builder.and_(self.value, _bit(other)))

    def __or__(self, other: Any) -> StagedBool:
        return StagedBool(_now.get().builder.or_(self.value, _bit(other)))

    __rand__, __ror__ = __and__, __or__

    def __invert__(self) -> StagedBool:
        return StagedBool(_now.get().builder.not_(self.value))


class Row:
    """An array of numbers, or of flags (of which an element is a truth value)."""

    def __init__(self, kind: Any, value: Any) -> None:
        emitter = _now.get()
        self.kind, self.value = kind, value
        self._array = emitter.context.make_array(kind)(emitter.context, emitter.builder, value)

    def _place(self, index: Any) -> Any:
        builder = _now.get().builder
        if not isinstance(index, tuple):
            return builder.gep(self._array.data, [_whole(index)])
        _, width = cgutils.unpack_tuple(builder, self._array.shape, 2)
        row = builder.mul(_whole(index[0]), width)
        return builder.gep(self._array.data, [builder.add(row, _whole(index[1]))])

    def __getitem__(self, index: Any) -> Any:
        content = _now.get().builder.load(self._place(index))
        if self.kind.dtype == types.float64:
            return Number(content)
        return StagedBool(_now.get().builder.icmp_signed("!=", content, ir.Constant(content.type, 0)))

    def __setitem__(self, index: Any, value: Any) -> None:
        _now.get().builder.store(_real(value), self._place(index))


class Index:
    """A whole number that the compiled code will have."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def before(self, steps: Any) -> Index:
        """Return this index less a number of steps, cut to whole ones; not below 0."""
        builder = _now.get().builder
        step = builder.sub(self.value, builder.fptosi(_real(steps), WHOLE))
        zero = ir.Constant(WHOLE, 0)
        return Index(builder.select(builder.icmp_signed("<", step, zero), zero, step))


def _real(x: Any) -> Any:
    return x.value if isinstance(x, Number) else ir.Constant(REAL, float(x))


def _whole(x: Any) -> Any:
    return x.value if isinstance(x, Index) else ir.Constant(WHOLE, int(x))


def _bit(x: Any) -> Any:
    return x.value if isinstance(x, StagedBool) else ir.Constant(ir.IntType(1), bool(x))


def _made(instruction: str, a: Any, b: Any) -> Number:
    return Number(getattr(_now.get().builder, instruction)(_real(a), _real(b)))


def _compared(how: str, a: Any, b: Any) -> StagedBool:
    return StagedBool(_now.get().builder.fcmp_ordered(how, _real(a), _real(b)))


def _called(function: Callable[..., Any], *numbers: Any) -> Number:
    """Call what numba compiles."""
    context, builder = _now.get()
    kinds = signature(types.float64, *[types.float64] * len(numbers))
    return Number(context.compile_internal(builder, function, kinds, [_real(x) for x in numbers]))


def _operator(name: str, rule: Callable[[Any, Any], Any], *, both: bool) -> None:
    """Give numbers an operator, and the one that Python asks for where a number stands on its right."""
    setattr(Number, f"__{name}__", lambda self, other: rule(self, other))
    if both:
        setattr(Number, f"__r{name}__", lambda self, other: rule(other, self))


for _name, _instruction in (("add", "fadd"), ("sub", "fsub"), ("mul", "fmul"), ("truediv", "fdiv")):
    _operator(_name, partial(_made, _instruction), both=True)
_operator("pow", partial(_called, lambda a, b: a**b), both=True)
for _name, _sign in (("lt", "<"), ("le", "<="), ("gt", ">"), ("ge", ">="), ("eq", "==")):
    _operator(_name, partial(_compared, _sign), both=False)


# -- what printed texts call -------------------------------------------------------------------------------------------


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Return a where the condition holds, else b; both are there already.

    A branch, not a selection: what follows need not wait for the one that does not count.
    """
    if not isinstance(condition, StagedBool):
        return a if condition else b
    builder, one, other = _now.get().builder, _real(a), _real(b)
    before = builder.block
    with builder.if_then(condition.value):
        inside = builder.block
    result = builder.phi(REAL)
    result.add_incoming(one, inside)
    result.add_incoming(other, before)
    return Number(result)


def negated(condition: Any) -> Any:
    """Return whether the condition does not hold."""
    return ~condition if isinstance(condition, StagedBool) else not condition


@contextmanager
def when(condition: StagedBool) -> Iterator[None]:
    """Run what stands in it only where the condition holds; it leaves results in ``Merged`` or in arrays."""
    with _now.get().builder.if_then(_bit(condition)):
        yield


def looked_up(function: Callable[..., Any], row: Row, number: int, tables: Row, x: Any) -> Number:
    """Return ``function(row, number, tables, x)``, compiled by numba."""
    context, builder = _now.get()
    kinds = signature(types.float64, row.kind, types.int64, tables.kind, types.float64)
    arguments = [row.value, _whole(number), tables.value, _real(x)]
    return Number(context.compile_internal(builder, function, kinds, arguments))


def _function(function: Callable[..., Any]) -> Callable[[Any], Number]:
    return lambda x: _called(function, x)


exp, sigmoid = _function(lambda x: exp_float64(x)), _function(lambda x: sigmoid_float64(x))
sqrt, log, log1p, expm1 = (
    _function(f) for f in (lambda x: np.sqrt(x), lambda x: np.log(x), lambda x: np.log1p(x), lambda x: np.expm1(x))
)
tanh, sin, cos, floor = (
    _function(f) for f in (lambda x: np.tanh(x), lambda x: np.sin(x), lambda x: np.cos(x), lambda x: np.floor(x))
)


def staged(results: int = 0) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that makes a function one that compiled loops call; it returns so many numbers, in a tuple.

    Arguments become ``Number`` (floats), ``Index`` (whole numbers) and ``Row`` (arrays).
    """

    def wrapped(function: Callable[..., Any]) -> Any:
        names = ", ".join(inspect.signature(function).parameters)
        kind = types.UniTuple(types.float64, results) if results else types.void

        def typed(*given: Any) -> Any:
            def generate(context: Any, builder: Any, made: Any, arguments: Any) -> Any:
                token = _now.set(Emitter(context, builder))
                try:
                    outputs = function(*(_argument(k, x) for k, x in zip(made.args, arguments, strict=True)))
                    if not results:
                        return context.get_dummy_value()
                    return context.make_tuple(builder, kind, [_real(x) for x in outputs])
                finally:
                    _now.reset(token)

            return kind(*given), generate

        return counted(function.__name__, names, typed)

    return wrapped


def _argument(kind: Any, value: Any) -> Any:
    if isinstance(kind, types.Array):
        return Row(kind, value)
    return Number(value) if kind == types.float64 else Index(value)
