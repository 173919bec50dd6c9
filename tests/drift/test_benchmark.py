"""A generated set of which drift was once found wrongly."""

from __future__ import annotations

from benchmarks import drift_sets
from idm_env.data import episodes
from idm_env.drift.estimate import estimate, usual
from idm_env.drift.kinds import behind_a_record
from idm_env.drift.linear import stacked
from idm_env.fitting.problem import IDM_NAMES


def test_a_wandering_desired_speed_is_found_again() -> None:
    """A set in which settings sought about a first, bad path led to a worse one: σ came out four times too large."""
    kind, sigma, memory_time = drift_sets.HIDDEN[3][0], 0.24, 20.0
    made = drift_sets.made(1048, kind, sigma, memory_time)
    smooth, raw = (stacked(episodes(made, smooth=x)) for x in (True, False))
    found = estimate(behind_a_record(smooth.step, kind), smooth, IDM_NAMES, usual(IDM_NAMES), measured=raw)
    for row, true in zip(found.table()[:2], (sigma, memory_time), strict=True):
        assert row["low"] < true < row["high"] and 0.7 < row["estimate"] / true < 1.4
