"""Transcendental functions that vectorise: a call of the C library in a loop keeps the whole loop scalar."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from idm_env.extras import needed

with needed("a compiled loop"):
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic

from idm_env.compiled.kernels.compiler import compiler

_MAGIC = 6755399441055744.0
"""1.5 · 2^52: added to a double, it leaves the nearest whole number in the lowest bits."""

_LOG2_E = 1.4426950408889634
_ROOT_HALF = 0.7071067811865476
_LN2_HIGH, _LN2_LOW = 0.693147180369123816490, 1.90821492927058770002e-10
"""ln 2 in two parts, the first with trailing zeros, so that n ln 2 is exact (Cody and Waite 1980)."""


def _like(x: Any, kind: ir.Type, value: float | None = None) -> Any:
    """Return a type, or a constant of it, for as many lanes as x has where it is a row of numbers."""
    many = x.type.count if isinstance(x.type, ir.VectorType) else 0
    wide = ir.VectorType(kind, many) if many else kind
    return wide if value is None else ir.Constant(wide, [value] * many if many else value)


def _emitted(kind: types.Float, emit: Callable[[Any, Any], Any]) -> Any:
    """Return an intrinsic of a number of this type; ``emit`` gets a builder and the number."""

    @intrinsic
    def made(typing_context: Any, x: Any) -> Any:
        return kind(kind), lambda context, builder, signature, arguments: emit(builder, *arguments)

    return made


def _parts(kind: types.Float) -> Iterator[Any]:
    """Return n and m of x = m 2^n, normal and positive, m from √½ to √2; and 2^k of k in the lowest bits of x."""
    single = kind == types.float32
    number, bits = (ir.FloatType(), ir.IntType(32)) if single else (ir.DoubleType(), ir.IntType(64))
    mantissa, bias = (23, 127) if single else (52, 1023)
    half = int.from_bytes(np.array(_ROOT_HALF, str(kind)).tobytes(), "little")

    def whole(builder: Any, x: Any) -> Any:
        return builder.bitcast(x, _like(x, bits))

    def power(builder: Any, x: Any) -> Any:
        return builder.ashr(builder.sub(whole(builder, x), _like(x, bits, half)), _like(x, bits, mantissa))

    def rest(builder: Any, x: Any) -> Any:
        shifted = builder.shl(power(builder, x), _like(x, bits, mantissa))
        return builder.bitcast(builder.sub(whole(builder, x), shifted), x.type)

    def two_to(builder: Any, x: Any) -> Any:
        shifted = builder.shl(builder.add(whole(builder, x), _like(x, bits, bias)), _like(x, bits, mantissa))
        return builder.bitcast(shifted, x.type)

    return (_emitted(kind, emit) for emit in (lambda b, x: b.sitofp(power(b, x), _like(x, number)), rest, two_to))


_exponent_of, _mantissa_of, _two_to = _parts(types.float64)
_exponent_of_single, _mantissa_of_single, _two_to_single = _parts(types.float32)


def _polynomial(kind: types.Float, coefficients: Sequence[float]) -> Any:
    """Return a polynomial of such a number, of coefficients from the highest power down, by Horner's rule."""
    number = ir.FloatType() if kind == types.float32 else ir.DoubleType()
    highest, *others = (float(np.array(x, str(kind))) for x in coefficients)

    def horner(builder: Any, x: Any) -> Any:
        value = _like(x, number, highest)
        for each in others:
            value = builder.fadd(builder.fmul(value, x), _like(x, number, each))
        return value

    return _emitted(kind, horner)


def _taylor(degree: int) -> list[float]:
    """Return the coefficients of e^x, from the highest power down."""
    return [1.0 / math.factorial(k) for k in range(degree, -1, -1)]


# Taylor's series for |r| ≤ ln 2 / 2: the first term left out is below 5e-18, and below 6e-9 in single precision.
_exp_of, _exp_of_single = _polynomial(types.float64, _taylor(13)), _polynomial(types.float32, _taylor(7))


@compiler(forceinline=True)
def exp_float64(x):
    """Return e^x of a double, within one unit in the last place; beyond ±708 as at ±708."""
    y = -708.0 if x < -708.0 else x
    y = 708.0 if y > 708.0 else y
    shifted = y * _LOG2_E + _MAGIC
    n = shifted - _MAGIC
    r = (y - n * _LN2_HIGH) - n * _LN2_LOW
    return _exp_of(r) * _two_to(shifted)  # type: ignore[call-arg]


# Constants of single precision: a Python literal would make doubles of what they meet.
_LOW, _HIGH, _ONE = np.float32(-87.0), np.float32(88.0), np.float32(1.0)
_MAGIC_32, _LOG2_E_32 = np.float32(12582912.0), np.float32(_LOG2_E)
_LN2_HIGH_32, _LN2_LOW_32 = np.float32(0.693359375), np.float32(-2.12194440e-4)


@compiler(forceinline=True)
def exp_float32(x):
    """Return e^x of a float, within two units in the last place; beyond −87 and 88 as there."""
    y = _LOW if x < _LOW else x
    y = _HIGH if y > _HIGH else y
    shifted = y * _LOG2_E_32 + _MAGIC_32
    n = shifted - _MAGIC_32
    r = (y - n * _LN2_HIGH_32) - n * _LN2_LOW_32
    return _exp_of_single(r) * _two_to_single(shifted)  # type: ignore[call-arg]


@compiler(forceinline=True)
def sigmoid_float64(x):
    """Return 1 / (1 + e^−x), not below 5e-131: numbers too small for full precision cost a hundred products each."""
    return 1.0 / (1.0 + exp_float64(-x if x > -300.0 else 300.0))


_FAR_32 = np.float32(-40.0)


@compiler(forceinline=True)
def sigmoid_float32(x):
    """Return 1 / (1 + e^−x), not below 4e-18, for the same reason."""
    return _ONE / (_ONE + exp_float32(-x if x > _FAR_32 else -_FAR_32))


# log m = 2 artanh s as a series in s² ≤ 0.0295: the first term left out is below 1e-18 in double precision.
_artanh_of = _polynomial(types.float64, [1.0 / k for k in range(21, 1, -2)])
_artanh_of_single = _polynomial(types.float32, [1.0 / k for k in range(9, 1, -2)])


@compiler(forceinline=True)
def _log_of(n, m, lost):
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    return n * _LN2_HIGH + (2.0 * s + (2.0 * s * z * _artanh_of(z) + (n * _LN2_LOW + lost)))


@compiler(forceinline=True)
def log1p_float64(x):
    """Return log(1 + x) of a double, within two units in the last place; −∞ at −1 and nan below."""
    u = 1.0 + x
    # What rounding took from 1 + x, relative to it.
    lost = ((1.0 - (u - x)) if x > 1.0 else (x - (u - 1.0))) / u
    n, m = _exponent_of(u), _mantissa_of(u)  # type: ignore[call-arg]
    y = _log_of(n, m, lost)
    y = y if u > 0.0 else (-np.inf if u == 0.0 else np.nan)
    return x if x == np.inf else y


@compiler(forceinline=True)
def power_float64(x, y):
    """Return x^y of doubles, x normal and positive or 0, within |y log x| + 2 units in the last place."""
    n, m = _exponent_of(x), _mantissa_of(x)  # type: ignore[call-arg]
    power = exp_float64(y * _log_of(n, m, 0.0))
    nothing = 0.0 if y > 0.0 else (np.inf if y < 0.0 else 1.0)
    return power if x > 0.0 else (nothing if x == 0.0 else np.nan)


_ZERO, _INFINITE, _NAN = np.float32(0.0), np.float32(np.inf), np.float32(np.nan)
_TWO = np.float32(2.0)


@compiler(forceinline=True)
def log1p_float32(x):
    """Return log(1 + x) of a float, within two units in the last place; −∞ at −1 and nan below."""
    u = _ONE + x
    lost = ((_ONE - (u - x)) if x > _ONE else (x - (u - _ONE))) / u
    n, m = _exponent_of_single(u), _mantissa_of_single(u)  # type: ignore[call-arg]
    s = (m - _ONE) / (m + _ONE)
    z = s * s
    y = n * _LN2_HIGH_32 + (_TWO * s + (_TWO * s * z * _artanh_of_single(z) + (n * _LN2_LOW_32 + lost)))
    y = y if u > _ZERO else (-_INFINITE if u == _ZERO else _NAN)
    return x if x == _INFINITE else y


_UP: tuple[float, ...] = (-2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08)
_UP += (1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03)
_DOWN = (1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)
_odd_of, _even_of = _polynomial(types.float32, _UP), _polynomial(types.float32, _DOWN)
_MOST_32 = np.float32(7.90531110763549805)


@compiler(forceinline=True, fastmath={"contract", "reassoc"})
def tanh_float32(x):
    """Return tanh of a float, within some units in the last place: the quotient of polynomials that Eigen takes."""
    y = -_MOST_32 if x < -_MOST_32 else x
    y = _MOST_32 if y > _MOST_32 else y
    z = y * y
    return _odd_of(z) * y / _even_of(z)


@compiler(forceinline=True)
def tanh_float64(x):
    """Return tanh of a double."""
    return np.tanh(x)
