"""The weight of the prior is chosen by what drivers' parameters have not seen, before any effect is judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from idm_env.data import episodes, synthetic
from idm_env.discovery import closed_loop, judge, words
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.noise import first_noise
from idm_env.discovery.records import Records, gather, whole, windows
from idm_env.discovery.result import Weight
from idm_env.discovery.solve import Problem, Solution, solve


def fitted(seconds: float, ou: float, spread: float, seed: int = 5) -> tuple[Records, Solution]:
    made, _ = synthetic.generate(seed, runs=10, followers=2, seconds=seconds, ou=ou, spread=spread)
    records = gather(list(episodes(made, smooth=True, min_seconds=12.0)))
    rows = windows(records)
    problem = Problem(rows, first_noise(rows), first_prior())
    null = solve(problem, Hypothesis(), np.tile(first_prior().centre, (problem.groups, 1)), np.zeros(0))
    seen = null.theta[np.unique(records.group)]
    return records, replace(null, prior=replace(first_prior(), centre=np.median(seen, axis=0), width=np.full(5, 0.3)))


def weight(records: Records, null: Solution) -> tuple[float, dict[float, float]]:
    """Return the weight that was chosen and the errors of all; the best is no end of what was tried."""
    at = closed_loop.evaluate(records, null.model, null.values, null.prior, null.theta)
    tried, best = sorted(at.rmse_m), at.problem.prior.error_correlation_s
    for end, beside in ((0, 1), (-1, -2)):
        if best == tried[end] and best not in closed_loop.ENDS_S:
            assert at.rmse_m[best] > 0.9994 * at.rmse_m[tried[beside]]
    return best, at.rmse_m


def test_short_noisy_records_of_like_drivers_lean_on_the_population() -> None:
    records, null = fitted(60.0, ou=0.3, spread=0.05)
    error_correlation_s, errors_m = weight(records, null)
    assert error_correlation_s >= 50.0
    assert min(errors_m.values()) < 0.9 * errors_m[5.0]
    # Drivers that were never seen are predicted better, too.
    others, _ = fitted(60.0, ou=0.3, spread=0.05, seed=6)
    rows, empty = whole(others), np.zeros(0)
    second = judge.halves(rows)
    errors = []
    for seconds in (5.0, error_correlation_s):
        prior = replace(null.prior, error_correlation_s=seconds)
        theta = judge.calibrate(others, Hypothesis(), empty, prior, replace(rows, valid=rows.valid & ~second)).theta
        scored = Problem(replace(rows, valid=second), None, prior)
        errors.append(np.linalg.norm(scored.errors(theta[None], Hypothesis(), empty[None])))
    assert errors[1] < 0.95 * errors[0]


def test_long_clean_records_of_unlike_drivers_speak_for_themselves() -> None:
    records, null = fitted(120.0, ou=0.0, spread=0.5)
    assert weight(records, null)[0] <= 5.0


def test_the_weight_is_told() -> None:
    told = words.weight(Weight(50.0, (5.0, 50.0), (5.04, 3.82)))
    assert "strength chosen by validation, before any effect was tested: 50 s (3.82 m)" in told
