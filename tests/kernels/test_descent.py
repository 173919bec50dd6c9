"""Adam through compiled rollouts: whatever the blocks, the precision of the start and the switch for kernels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from idm_env.compiled.kernels import dispatch
from idm_env.effects import IDM, Brakes, Delay
from idm_env.roads import Lane
from idm_env.simulator import Simulator

descent = pytest.importorskip("idm_env.compiled.kernels.descent", reason="numba is not installed")
STEPS, COUNT = 40, 3


def fitted(kind=torch.float64, *more, iterations=30, free="idm.max_accel"):
    sim = Simulator(Lane(), (IDM(), *more, Brakes()), 0.1)
    params = sim.defaults(dtype=kind)
    speed = torch.tensor([[5.0], [8.0], [11.0]], dtype=kind)
    state = sim.state(torch.zeros_like(speed), speed, params)
    at = np.tile(np.arange(STEPS + 1), COUNT)
    which = np.repeat(np.arange(COUNT), STEPS + 1)
    target = np.concatenate([v * 0.1 * np.arange(STEPS + 1) for v in (5.5, 8.0, 10.0)])
    observed = descent.Observed(at, which, target, np.full(len(at), 1.0 / (STEPS + 1)))
    bounds = {"idm.desired_speed": (2.0, 60.0), free: (0.1, 5.0)}
    return descent.descend(sim, state, {}, params, STEPS, observed, bounds, iterations=iterations, rates=(0.5, 0.05))


def test_blocks_decide_nothing_and_the_fit_comes_nearer(monkeypatch):
    start, whole = fitted(iterations=0), fitted()
    monkeypatch.setattr(descent, "BLOCK", 7)
    for name, value in fitted().params.items():
        assert np.allclose(value, whole.params[name], rtol=1e-12), name
    for i, speed in enumerate((5.5, 8.0, 10.0)):
        target = speed * 0.1 * np.arange(STEPS + 1)
        first, last = (np.abs(found.position[:, i] - target).mean() for found in (start, whole))
        assert last < 0.4 * first
    assert (whole.params["idm.time_gap"] == start.params["idm.time_gap"]).all()  # it has no bounds


def test_runs_in_double_precision_whatever_is_switched_off():
    single = fitted(torch.float32)
    with dispatch.off():
        double = fitted()
    assert single.position.dtype == np.float64
    assert np.allclose(single.position, double.position, atol=1e-6)


def test_a_bound_of_what_nobody_reads_is_refused():
    with pytest.raises(
        ValueError, match=r"bounds of 'idm.max_acel': no such number is read. Did you mean 'idm.max_accel'"
    ):
        fitted(free="idm.max_acel")


def test_what_looks_back_is_refused():
    with pytest.raises(ValueError, match="looks back in time"):
        fitted(torch.float64, Delay())
