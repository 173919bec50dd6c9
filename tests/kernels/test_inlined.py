"""What is inlined computes what its text says, with the same bits as Python."""

# ruff: noqa: F821
import math

import numpy as np
import pytest

pytest.importorskip("numba")
import numba

from idm_env.compiled.kernels.emitted import choose, inlined


@inlined(4)
def numbers(x, y):
    a = (2.0 - x) * y / (x + 1.0) - (3.0 / y - -x)
    b = abs(x - y) + np.floor(3.0 * x) ** 2.0 + 2.0**y
    c = np.sqrt(abs(x)) + np.expm1(y) + np.log(abs(y)) + np.log1p(abs(x))
    return a, b, c, np.tanh(x) + np.sin(y) * np.cos(x)


@inlined(3)
def choices(x, y):
    either = (x < y) or (x == 1.0)
    one, other = choose((x > 0.0) and (y >= 0.0), x, y), choose(either, x, y)
    return one, other, choose((not either) and (x == x), x, y)


@inlined(1)
def blocks(row, flags, past, now, ago):
    found = row[0]
    if flags[0]:
        found = found * 2.0
        if row[0] > 1.0:
            found = found + past[larger(now - np.int64(ago), 0), 1]
    row[1] = found
    return (row[1] + choose(1.0 > 0.0, 1.0, row[0]),)


@numba.njit(error_model="numpy")
def run(x, y, row, flags, past, now, ago):
    return numbers(x, y), choices(x, y), blocks(row, flags, past, now, ago)


def test_inlined_functions_do_what_their_text_says():
    past = np.arange(12.0).reshape(6, 2)
    for x, y in ((0.3, 0.7), (1.0, -2.5), (-3.1, 0.2), (5.5, 1.25), (math.nan, 1.0)):
        for flag, now, ago in ((0, 4, 1.0), (1, 4, 2.9), (1, 1, 3.0)):
            row = np.array([x, 0.0])
            made, chosen, merged = run(x, y, row, np.array([flag], np.int8), past, now, ago)
            a = (2.0 - x) * y / (x + 1.0) - (3.0 / y - -x)
            b = abs(x - y) + np.floor(3.0 * x) ** 2.0 + 2.0**y
            c = np.sqrt(abs(x)) + np.expm1(y) + np.log(abs(y)) + np.log1p(abs(x))
            assert np.array_equal(made[0], a, equal_nan=True)
            np.testing.assert_allclose(made[1:], (b, c, np.tanh(x) + np.sin(y) * np.cos(x)), rtol=4e-16)
            conditions = (x > 0 and y >= 0, x < y or x == 1, not (x < y or x == 1) and x == x)
            assert np.array_equal(chosen, [x if holds else y for holds in conditions], equal_nan=True)
            want = x if not flag else 2 * x + past[max(now - int(ago), 0), 1] if x > 1 else 2 * x
            assert np.array_equal(merged, (want + 1.0,), equal_nan=True)
            assert np.array_equal(row[1], want, equal_nan=True)
