"""Printed texts are compiled statement by statement; numbers are those that numba makes of the whole."""

import ctypes

import numpy as np
import pytest

pytest.importorskip("numba")

from idm_env.compiled.scalar import library

TEXT = '''
import numpy as np
from numba import carray, types

from idm_env.compiled.kernels.compiler import phase
from idm_env.compiled.kernels.emitted import emitted
from idm_env.compiled.kernels.functions import exp_{kind} as exp
from idm_env.compiled.kernels.memory import located

F, U = np.{kind}, np.uint64
SIZE = (1 << 40,)
WIDE = 3 * 2
{helpers}

@{compiled}(types.void(types.int64, types.int64, types.CPointer(types.int64)))
def run(begin, end, at):
    """Every kind of statement that is printed."""
    x = carray(located(at[0], F), SIZE)
    y = carray(located(at[1], F), SIZE)
    f, b = np.empty(WIDE, F), np.empty(WIDE, np.bool_)
    i = np.empty(WIDE, np.int64)
    for r in range(begin, end):
        s = F(0.0)
        for j in range(WIDE):
            b[U(j)] = x[U(r * WIDE + j)] > F(0.0) and not (x[U(r * WIDE + j)] >= F(2.0)) or np.isinf(x[U(r * WIDE)])
            f[U(j)] = (x[U(r * WIDE + j)] if b[U(j)] else -x[U(r * WIDE + j)]) ** F(1.5)
            f[U(j)] += exp(x[U(r * WIDE + j)]) + np.tanh(f[U(j)]) / abs(x[U(r * WIDE + j)])
            s = s + f[U(j)]
        v = larger(s, F(-1.0))
        s = 0
        for j in range(0, WIDE, 2):
            s = s + j
            i[U(j)] = min(s, 3)
            i[U(j + 1)] = s
        m = 0
        while m < 2:
            if f[U(m)] < F(1.0) or m > 100:
                f[U(m)] = smaller(f[U(m)], F(s) + F(np.sign(v)))
            m = m + 1
        for j in range(WIDE):
            y[U(r * WIDE + j)] = f[U(j)] - np.floor(v) * F(i[U(j)]) + F(np.nan if j > 10 else 0.25)
'''
HELPERS = """
from numba import njit

@njit
def larger(x, y):
    return y if x < y else x


@njit
def smaller(x, y):
    return y if x > y else x

"""


def compiled(kind, compiler, text=TEXT):
    text = text.format(kind=kind, compiled=compiler, helpers=HELPERS if compiler == "phase" else "")
    return library.load("both", text).run.address


def results(address, x):
    y = np.zeros_like(x)
    table = np.array([x.ctypes.data, y.ctypes.data], np.int64)
    run = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)(address)
    run(0, len(x), table.ctypes.data)
    return y


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_numbers_are_those_of_numba(kind):
    x = np.random.default_rng(1).normal(0.0, 2.0, (40, 6)).astype(kind)
    x[3, 0], x[4, 2], x[5, 0] = np.inf, np.nan, 0.0
    one, other = (results(compiled(kind, name), x) for name in ("emitted", "phase"))
    np.testing.assert_array_equal(one, other)
    assert np.isfinite(one[:3]).all() and len(np.unique(one)) > 100


def test_a_name_that_changes_its_type_within_a_loop_is_refused():
    text = TEXT.replace("            s = s + f[U(j)]\n", "            s = j if s > F(0.0) else j\n")
    with pytest.raises(TypeError, match="s changes its type within a loop"):
        compiled("float32", "emitted", text)
