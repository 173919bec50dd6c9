"""What is inlined computes what its text says, for every lane of a row, with the same bits as Python."""

# ruff: noqa: F821
import math

import numpy as np
import pytest

pytest.importorskip("numba")
import numba

from idm_env.compiled.kernels.emitted import inlined
from idm_env.compiled.kernels.functions import exp_float64, power_float64, sigmoid_float64
from idm_env.compiled.kernels.record_lanes import column, recall

LANES = 8


@inlined
def numbers(x, y, out):
    out[0] = (2.0 - x[0]) * y[0] / (x[0] + 1.0) - (3.0 / y[0] - -x[0])
    out[1] = abs(x[0] - y[0]) + np.floor(3.0 * x[0]) ** 2.0 + 2.0 ** y[0]
    out[2] = np.sqrt(abs(x[0])) + np.expm1(y[0]) + np.log(abs(y[0])) + np.log1p(abs(x[0]))
    out[3] = np.tanh(x[0]) + np.sin(y[0]) * np.cos(x[0])


@inlined
def choices(x, y, out):
    either = (x[0] < y[0]) or (x[0] == 1.0)
    out[0] = x[0] if (x[0] > 0.0) and (y[0] >= 0.0) else y[0]
    out[1], out[2] = x[0] if either else y[0], x[0] if (not either) and (x[0] != y[0]) else 0.0


@inlined
def blocks(row, flags, past, now, ago, at, out):
    found = row[0]
    if flags[0]:
        found = found * 2.0 + recall(past, now, ago[0], 1, at[0])
    sample = smaller(larger(at[0] - 3, at[1]), 4 + at[1])
    row[1] = found
    out[0] = row[1] + (1.0 if 1.0 > 0.0 else row[0]) + column(row, 1, sample)


@inlined
def curved(x, y, out):
    out[0], out[1], out[2] = exp_float64(x[0]), sigmoid_float64(x[0]), power_float64(abs(x[0]), y[0])


@numba.njit(error_model="numpy")
def run(x, y, row, flags, past, now, ago, at, out):
    numbers(x, y, out[0])
    choices(x, y, out[1])
    blocks(row, flags, past, now, ago, at, out[2])
    curved(x, y, out[3])


@pytest.mark.parametrize("flag", [0, 1])
def test_inlined_functions_do_what_their_text_says(flag):
    x = np.array([[0.3, 1.0, -3.1, 5.5, math.nan, 0.0, 2.0, -0.0]])
    y = np.array([[0.7, -2.5, 0.2, 1.25, 1.0, 3.0, 2.0, -1.0]])
    past, row = np.arange(6.0 * 2 * LANES).reshape(6, 2, LANES), np.concatenate([x, x])
    at, ago = np.array([np.arange(LANES), [1] * LANES]), np.array([[1.0, 2.9, 3.0, 9.0, 0.0, 1.0, 2.0, 4.0]])
    out = np.zeros((4, 4, LANES))
    run(x, y, row, np.array([flag], np.int8), past, 4, ago, at, out)
    (x,), (y,) = x, y
    with np.errstate(all="ignore"):
        exact = (2.0 - x) * y / (x + 1.0) - (3.0 / y - -x)
        others = (abs(x - y) + np.floor(3.0 * x) ** 2.0 + 2.0**y,)
        others += np.sqrt(abs(x)) + np.expm1(y) + np.log(abs(y)) + np.log1p(abs(x)), np.tanh(x) + np.sin(y) * np.cos(x)
        curves = np.exp(x), 1.0 / (1.0 + np.exp(-x)), abs(x) ** y
    assert np.array_equal(out[0, 0], exact, equal_nan=True)
    np.testing.assert_allclose(out[0, 1:], others, rtol=4e-16)
    either = (x < y) | (x == 1.0)
    assert np.array_equal(out[1, 0], np.where((x > 0) & (y >= 0), x, y), equal_nan=True)
    assert np.array_equal(out[1, 1], np.where(either, x, y), equal_nan=True)
    assert np.array_equal(out[1, 2], np.where(~either & (x != y), x, 0.0), equal_nan=True)
    oldest = [past[max(4 - int(steps), 0), 1, lane] for lane, steps in enumerate(ago[0])]
    want = 2.0 * x + oldest if flag else x
    assert np.array_equal(row[1], want, equal_nan=True)
    sample = np.clip(np.arange(LANES) - 3, 1, 5)
    assert np.array_equal(out[2, 0], want + 1.0 + want[sample], equal_nan=True)
    known = ~np.isnan(x)
    np.testing.assert_allclose(out[3, :3, known], np.array(curves).T[known], rtol=4e-15)
