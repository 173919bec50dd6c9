"""What a test counts where runs are few, how seldom it errs there, and what could be explained at all."""

from __future__ import annotations

import dataclasses

import numpy as np
import polars as pl
import pytest

from idm_env.data import Trajectories, synthetic
from idm_env.discovery import ceilings, score
from idm_env.discovery.power import Strength, powerful
from idm_env.discovery.records import Records
from idm_env.discovery.score import westfall_young
from idm_env.discovery.units import LEAST_RHO, rho, signs, smallest_p, units
from idm_env.parameters import Parameter


def test_units_are_followers_where_runs_are_few(platoon: Records) -> None:
    counted = units(platoon)
    assert len(counted) == len({(e.run_id, e.vehicle_id) for e in platoon.episodes}) > len(platoon.runs)
    assert set(counted.run.tolist()) == {0, 1, 2}
    values = np.arange(float(len(counted)))
    others = counted.others(values)
    assert others[0] == values[counted.run != counted.run[0]].sum()


@pytest.mark.parametrize("correlation", [0.25, 0.6])
def test_signs_depend_on_each_other_as_stated(correlation: float) -> None:
    run = np.repeat(np.arange(5), 4)
    drawn = signs(run, correlation, 0)
    assert (drawn[0] == 1.0).all()
    together = np.corrcoef(drawn[1:].T)
    same = (run[:, None] == run) & ~np.eye(len(run), dtype=bool)
    assert together[same].mean() == pytest.approx(correlation, abs=0.03)
    assert abs(together[run[:, None] != run].mean()) < 0.01


@pytest.mark.parametrize(("runs", "each", "shared"), [(3, 3, 0.0), (4, 3, 0.3), (6, 3, 0.3), (5, 5, 0.5)])
def test_it_seldom_finds_what_is_not_there_in_few_runs(runs: int, each: int, shared: float) -> None:
    """Gains of followers of one run have ``shared`` of their variance in common, and heavy tails."""
    random = np.random.default_rng(runs)
    run = np.repeat(np.arange(runs), each)
    found = 0
    for number in range(150):
        common = np.sqrt(shared) * random.standard_t(4, (30, runs))[:, run]
        own = np.sqrt(1.0 - shared) * random.standard_t(4, (30, runs * each))
        gains = (common + own) * 10.0 ** random.uniform(-4, -1, (30, 1))
        found += bool((westfall_young(gains, number, run).p_value < 0.05).any())
    assert found / 150 <= 0.10


def test_what_all_units_gain_is_no_dependence() -> None:
    random = np.random.default_rng(3)
    run = np.repeat(np.arange(6), 3)
    assert rho(1.0 + 0.1 * random.standard_normal((20, 18)), run) == pytest.approx(LEAST_RHO, abs=0.05)
    alike = np.repeat(random.standard_normal((20, 6)), 3, axis=1)
    assert rho(alike + 0.01 * random.standard_normal((20, 18)), run) > 0.95


def test_the_smallest_p_is_that_of_all_signs_alike() -> None:
    run = np.repeat(np.arange(3), 3)
    drawn = signs(run, LEAST_RHO, 1)[1:]
    assert smallest_p(run) == pytest.approx((drawn > 0).all(1).mean(), abs=0.005)
    assert smallest_p(np.arange(6)) == 2.0**-6


def test_power_needs_typical_strengths_to_be_seen() -> None:
    parameter = Parameter("lag", "τ", "s", 0.5, 0.0, 3.0, null=0.0)
    sharp, blunt = (Strength(parameter, 0.0, -w, w, 2 * w, 0.5) for w in (0.1, 1.0))
    flat, large = (score.Tested(np.ones(1), np.array([g]), np.zeros((1, 2))) for g in (0.001, 0.1))
    assert powerful([sharp, sharp, blunt], flat, 0.001)
    assert not powerful([sharp, blunt, blunt], flat, 0.001)
    assert not powerful([sharp], large, 0.001)  # a large gain that is not beyond chance
    assert not powerful([sharp], flat, 0.03)


def with_drift(per_root_s: float) -> Trajectories:
    made, _ = synthetic.generate(4, runs=3, followers=2, seconds=120.0, gap_column=True)
    random = np.random.default_rng(0)
    step = per_root_s * np.sqrt(0.1) * random.standard_normal(made.table.height)
    moved = pl.col("gap_m") + pl.Series(np.cumsum(step)) - pl.Series(np.cumsum(step)).first()
    return dataclasses.replace(made, table=made.table.with_columns(pl.when(pl.col("gap_measured")).then(moved)))


def test_slow_drift_of_a_sensor_is_known_from_gaps_and_speeds() -> None:
    assert ceilings.drift(with_drift(0.1)) == pytest.approx(0.1, rel=0.3)
    assert ceilings.drift(with_drift(0.0)) < 0.02
