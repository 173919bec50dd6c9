"""The rows that forecasts of drift are compared with, on residuals whose future is known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import drift, drift_gru, drift_sets
from idm_env.data import episodes
from idm_env.drift.estimate import estimate, usual
from idm_env.drift.kinds import behind_a_record
from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import IDM_NAMES

STEPS = 6


def decaying(rows: int, samples: int) -> np.ndarray:
    """Residuals [samples, rows] that start anew every ten samples and then lose a fifth at every step."""
    random = np.random.default_rng(0)
    starts = random.standard_normal((samples // 10 + 1, rows))
    return starts[np.arange(samples) // 10] * 0.8 ** (np.arange(samples) % 10)[:, None]


def test_targets_are_the_steps_that_follow_as_far_as_they_were_measured() -> None:
    residual = np.arange(9.0)[:, None].repeat(2, 1)
    values, known = drift_gru.targets(residual, np.array([10, 7]), 3)
    assert values[2, 0].tolist() == [3.0, 4.0, 5.0] and known[2, 0].all()
    # A record of 7 samples has 6 steps, 0 to 5.
    assert known[:, 1].sum(1).tolist() == [3, 3, 3, 2, 1, 0, 0, 0, 0]


def test_the_net_goes_on_as_the_residual_does_and_so_does_the_autoregression() -> None:
    residual = decaying(24, 80)
    gap, speed = (np.full((81, 24), x) for x in (20.0, 15.0))
    nets = drift_gru.trained(residual, gap, speed, np.full(24, 81), STEPS)
    fresh = decaying(5, 80)[:, ::-1] + 0.0
    starts = [(r, t) for r in range(5) for t in (13, 23, 33, 43)]
    true = np.stack([fresh[t : t + STEPS, r] for r, t in starts], 1)
    found = drift_gru.ahead(nets, fresh, gap[:, :5], speed[:, :5], starts)
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.35 * np.sqrt(np.mean(true**2))
    same = drift.going_on(fresh, starts, np.array([0.8, 0.0, 0.0]), drift.RESIDUAL_S, STEPS)
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
