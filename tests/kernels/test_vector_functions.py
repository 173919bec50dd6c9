"""Functions of our own that vectorise, beside the C library's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

functions = pytest.importorskip("idm_env.compiled.kernels.functions", reason="numba is not installed")
numba = pytest.importorskip("numba")


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_log1p_is_within_two_units_in_the_last_place_of_the_true_one(kind: str) -> None:
    function = getattr(functions, f"log1p_{kind}")

    @numba.njit(error_model="numpy")
    def filled(x, y):  # type: ignore[no-untyped-def]
        for i in range(len(x)):
            y[i] = function(x[i])

    rng = np.random.default_rng(0)
    above = np.exp(rng.uniform(-60.0, 60.0, 40_000))
    x = np.concatenate([above, -1.0 + np.exp(rng.uniform(-12.0, 0.0, 10_000)), [0.0, 1e-30, -1e-30, 1.0]]).astype(kind)
    y = np.empty_like(x)
    filled(x, y)
    truth = np.log1p(x.astype(np.longdouble))
    assert y.dtype == kind
    edges = np.array([-1.0, -1.5, -2.0, -np.inf, np.inf, np.nan], kind)
    at_edges = np.empty_like(edges)
    filled(edges, at_edges)
    assert np.array_equal(at_edges, torch.log1p(torch.as_tensor(edges)).numpy(), equal_nan=True)
    assert (np.abs(y - truth) <= 2.0 * np.spacing(np.abs(truth).astype(kind))).all()
