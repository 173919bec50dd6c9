"""The rows that forecasts of drift are compared with, on residuals whose future is known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import drift, drift_sets
from idm_env.data import episodes
from idm_env.drift.estimate import estimate, usual
from idm_env.drift.kinds import behind_a_record
from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import IDM_NAMES

STEPS = 6


def test_the_autoregression_goes_on_as_the_residual_does() -> None:
    """Residuals that start anew every ten samples and then lose a fifth at every step, begun at the fourth."""
    starts = np.random.default_rng(0).standard_normal((8, 5))
    residual = starts[np.arange(80) // 10] * 0.8 ** (np.arange(80) % 10)[:, None]
    begun = [(r, t) for r in range(5) for t in (13, 23, 33, 43)]
    true = np.stack([residual[t : t + STEPS, r] for r, t in begun], 1)
    same = drift.going_on(residual, begun, np.array([0.8, 0.0, 0.0]), drift.RESIDUAL_S, STEPS)
    assert same == pytest.approx(true)


def test_distributions_that_are_alike_have_no_distance() -> None:
    random = np.random.default_rng(1)
    gap, speed = (base + 0.3 * random.standard_normal((400, 1, 1)).cumsum(0) for base in (60.0, 40.0))
    same = drift._quantities(gap, speed[:1].repeat(401, 0) + 0.0, 0.5)
    assert [len(x) for x in same] == [400, 400, 399] and not same[1].any() and not same[2].any()
    moving = drift._quantities(gap, np.concatenate([speed[:1], speed]), 0.5)
    assert moving[0][:, 0, 0] == pytest.approx(gap[:, 0, 0] / speed[:, 0, 0])
    assert moving[1].sum() == pytest.approx((speed[-1, 0, 0] - speed[0, 0, 0]) / 0.5)


def test_a_wandering_desired_speed_is_found_again() -> None:
    """A set in which settings sought about a first, bad path led to a worse one: σ came out four times too large."""
    kind, sigma, memory_time = drift_sets.HIDDEN[3][0], 0.24, 20.0
    made = drift_sets.made(1048, kind, sigma, memory_time)
    smooth, raw = (Batch.of(list(episodes(made, smooth=x)), substeps=1) for x in (True, False))
    found = estimate(behind_a_record(smooth.dt, kind), smooth, IDM_NAMES, usual(IDM_NAMES), measured=raw)
    for row, true in zip(found.table()[:2], (sigma, memory_time), strict=True):
        assert row["low"] < true < row["high"] and 0.7 < row["estimate"] / true < 1.4
