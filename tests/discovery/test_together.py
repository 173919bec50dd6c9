"""Terms that show in free simulation: scored on what nothing has seen, fitted at once, and taken back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from idm_env.data import episodes, synthetic
from idm_env.discovery import closed_loop, model as terms, selection, together
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.noise import first_noise
from idm_env.discovery.records import gather, windows
from idm_env.discovery.score import interval_of
from idm_env.discovery.search import Search
from idm_env.discovery.solve import Problem, solve


@pytest.fixture(scope="module")
def searching() -> Search:
    made, _ = synthetic.generate(31, runs=6, followers=3, seconds=120.0, effect="speed_time_gap")
    records = gather(list(episodes(made, smooth=True, min_seconds=12.0)))
    rows = windows(records)
    problem = Problem(rows, first_noise(rows), first_prior(), np.ones(len(rows)))
    return Search(problem, ("speed_time_gap", "drag"), False, lambda *_: None)


@pytest.fixture(scope="module")
def start(searching: Search) -> closed_loop.ClosedLoopFit:
    problem = searching.problem
    null = solve(problem, Hypothesis(), np.tile(problem.prior.centre, (problem.groups, 1)), np.zeros(0))
    return closed_loop.evaluate(problem.rows.records, null.model, null.values, null.prior, null.theta)


def test_what_is_there_is_added_in_free_simulation_and_nothing_else(
    searching: Search, start: closed_loop.ClosedLoopFit
) -> None:
    joined, steps = together.grow(searching, start, 0, seed=0)
    assert joined is not None
    assert [t.label for t in joined.solution.model.terms] == ["speed_time_gap"]
    estimate, low, high = joined.intervals[0]
    assert estimate == pytest.approx(-0.4, rel=0.3) and low < estimate < high
    assert joined.gains.mean() > 0.1 and steps[0].tested.p_value[steps[0].winner] < 0.05
    assert len(start.units) == 18 and set(start.rmse_m) >= set(closed_loop.GRID_S)


def test_a_term_that_is_not_there_is_taken_back(start: closed_loop.ClosedLoopFit) -> None:
    model = Hypothesis((terms.simple("speed_time_gap"), terms.simple("drag")))
    both = closed_loop.joint(start, model, np.array([-0.3, 1e-4]))
    kept = together._backward(start, both, 0)
    assert [t.label for t in kept.model.terms] == ["speed_time_gap"]


def test_a_term_of_windows_whose_interval_contains_its_null_is_taken_back_whatever_it_gains(
    searching: Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Hypothesis((terms.simple("speed_time_gap"), terms.simple("drag")))
    problem = searching.problem
    both = solve(problem, model, np.tile(problem.prior.centre, (problem.groups, 1)), np.array([-0.3, 1e-4]))
    intervals = interval_of(both, problem)
    assert intervals[0, 2] < 0.0 and intervals[1, 1] < 0.0 < intervals[1, 2]
    monkeypatch.setattr(selection, "log_gain", lambda *_: np.ones(1))  # the loss of no term is small
    assert [t.label for t in selection._delete(searching, both, 0).model.terms] == ["speed_time_gap"]


def test_what_windows_found_is_fitted_in_free_simulation_once_more(
    searching: Search, start: closed_loop.ClosedLoopFit
) -> None:
    """A strength that is a quarter of the true one comes back."""
    model = Hypothesis((terms.simple("speed_time_gap"),))
    off = closed_loop.in_windows(
        searching.problem, replace(closed_loop.joint(start, model, np.array([-0.3])), values=np.array([-0.1]))
    )
    again, intervals = closed_loop.refitted(start.problem.rows.records, off)
    assert again.values[0] == pytest.approx(-0.4, rel=0.3)
    assert intervals[0, 1] < again.values[0] < intervals[0, 2]


def test_theta_follows_on_time_that_is_not_scored(start: closed_loop.ClosedLoopFit) -> None:
    """A response that θ can make up for leaves next to nothing."""
    by_theta = start.linear.by_theta[..., [2]]
    left = start.across(by_theta)
    assert (left**2).sum() < 0.1 * ((by_theta * start.scored[..., None]) ** 2).sum()
    assert not left[~start.scored].any()
