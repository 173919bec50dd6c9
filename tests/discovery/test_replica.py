"""Records made once more by fitted drivers and their noise: it is that of the data, and tells what noise alone does."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import undeclared
from idm_env.data import Trajectories, episodes, hidden, synthetic
from idm_env.discovery import finish, fleet, judge, replica
from idm_env.discovery.bases import Law
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.compare import Comparison
from idm_env.discovery.ladder import FORESEEN, LEVEL
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis, curve, simple
from idm_env.discovery.noise import first_noise
from idm_env.discovery.records import gather, windows
from idm_env.discovery.search import Search
from idm_env.discovery.selection import LEAST_GAIN
from idm_env.discovery.solve import Problem, Solution
from idm_env.effects import base_named
from tests.discovery.conftest import Mixing


def fitted(seed: int, ou: float, runs: int = 8, seconds: float = 120.0) -> tuple[Problem, Solution]:
    """Return the windows of three drivers in every run, with noise, and drivers of IDM fitted to them."""
    return fitted_to(synthetic.generate(seed, runs=runs, followers=3, seconds=seconds, ou=ou)[0])


def fitted_to(made: Trajectories) -> tuple[Problem, Solution]:
    """Return the windows of trajectories, and drivers of IDM fitted to them."""
    records = gather(list(episodes(made, smooth=True, min_seconds=12.0)))
    rows = windows(records)
    problem = Problem(rows, first_noise(rows), first_prior())
    searching = Search(problem, ("drag",), False, lambda *_: None)
    null = searching.null(Hypothesis(), np.tile(problem.prior.centre, (problem.groups, 1)), np.zeros(0))
    return judge.windowed(records, searching.problem, null)


def floor_of(problem: Problem) -> float:
    return judge.floor(problem.rows.records)["horizon_rmse_m"]


@pytest.mark.parametrize("ou", [0.0, 0.1])
def test_noise_of_drivers_is_that_of_the_data_and_what_it_leaves_agrees(ou: float) -> None:
    """An Ornstein–Uhlenbeck acceleration of 0.1 m/s² whose memory is 5 s."""
    problem, found = fitted(4, ou)
    drivers, told = replica.agreement(problem, found, floor_of(problem), 0)
    assert np.median(drivers.sigma) == pytest.approx(ou, abs=0.02)
    assert not ou or 2.0 <= drivers.memory_s <= 8.0
    assert told.pop("past").share < FORESEEN
    for one in told.values():
        assert not one.is_refused and one.p_value >= 0.05 and one.replicas >= replica.ENOUGH


def test_own_residuals_come_in_blocks_and_leave_drivers_as_unlike_as_they_are() -> None:
    """Drivers are spread until those fitted to a replica are, whom their population pulls together once more."""
    problem, found = fitted(5, 0.2)
    records, theta = problem.rows.records, found.theta
    bare = replica.NoisyDrivers(found.model.fixed(found.values), theta, np.ones(len(theta)), 1.0)
    steps = tuple(np.arange(0.0, 1e4, 1.0) for _ in theta)
    drawn = np.diff(replace(bare, own=steps)._noise(records, 0, np.random.default_rng(0)))
    assert np.flatnonzero(drawn != 1.0).tolist() == [299, 599, 899, 1199], "blocks of 30 s of one driver's residuals"
    own, errors = replica._own_noise(problem, found, bare, floor_of(problem)), []
    for seed in range(4):
        replicas, fitted_again = replica._fitted(problem, own, np.random.default_rng(seed), floor_of(problem))
        errors.append(np.median(np.abs(replica.ahead(replicas, fitted_again, own.model))))
        spread = [replica._spread(x)[1] for x in (theta, fitted_again)]
        assert np.median(spread[1] / spread[0]) == pytest.approx(1.0, abs=0.35)
    assert np.mean(errors) == pytest.approx(np.median(np.abs(replica.ahead(problem, theta, own.model))), rel=0.2)


@pytest.mark.parametrize("mixed", [False, True])
def test_kinds_of_drivers_gain_more_than_their_noise_alone(
    mixed: bool, kinds: Mixing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drivers of much noise are predicted better by a law that answers less, although all are IDM."""
    kinds(np.add.outer(np.arange(8), np.arange(2)) % 2 == (1 if mixed else 2))
    monkeypatch.setattr(replica, "FEW", 5)
    problem, found = fitted_to(synthetic.generate(31, runs=8, followers=2, seconds=90.0, ou=0.1)[0])
    models = [Hypothesis((), Catalogue((), base_named(name), located=False)) for name in ("idm", "constant_time_gap")]
    laws = [Law(model.catalogue.base, model, None, {}) for model in models]  # type: ignore[arg-type]
    gain = fleet.gain_of(laws, found.values, two=True)
    assert replica.stands_out(problem, found, floor_of(problem), 0, gain) is mixed


@pytest.mark.parametrize(("name", "true"), [("idm_plus", False), ("constant_time_gap", True)])
def test_a_law_is_better_only_where_it_gains_more_than_drivers_noise_alone(
    name: str, true: bool, kinds: Mixing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drivers of IDM with much noise, 0.7 m/s², are predicted better by IDM+; linear controllers by their own law."""
    kinds(np.full((8, 2), true))
    monkeypatch.setattr(replica, "FEW", 10 if true else 19)
    problem, found = fitted_to(synthetic.generate(31, runs=8, followers=2, seconds=90.0, ou=0.1 if true else 0.7)[0])
    models = [Hypothesis((), Catalogue((), base_named(one), located=False)) for one in ("idm", name)]
    falls = {"horizon_rmse_m": Comparison(1.0, 0.9, 0.9, 0.85, 0.95)}
    null, law = (
        Law(m.catalogue.base, m, None, against)  # type: ignore[arg-type]
        for m, against in zip(models, ({}, falls), strict=True)
    )
    searching = SimpleNamespace(problem=problem)
    of_laws = SimpleNamespace(records=problem.rows.records, searching=searching, null=found, adapt=True, seed=0)
    assert law.is_better and fleet.gain_of([null, law], found.values, two=False)(problem) > 0.0
    told = finish.best_beyond_noise([null, law], of_laws, floor_of(problem))  # type: ignore[arg-type]
    assert told is (law if true else null)


def test_what_lies_far_above_the_first_replicas_needs_no_more() -> None:
    """Five are enough then; else one that gains as much ends it."""
    problem, found = fitted(4, 0.1, runs=4, seconds=60.0)
    first = [0.1, 0.2, 0.1, 0.2, 0.1]
    for gains, told in (([9.0, *first], True), ([0.3, *first, 0.1, 0.4], False), ([0.3, *first, *[0.2] * 14], True)):
        each = iter(gains)
        assert replica.stands_out(problem, found, 0.05, 0, lambda _, each=each: next(each)) is told  # type: ignore[misc]
        assert list(each) == [], "no replica fewer"


def test_noise_gains_a_candidate_as_much_in_replicas() -> None:
    """Noise of 0.2 m/s² passes for a weaker pull to the gap, which sign flips of runs take for an effect."""
    problem, found = fitted(599009, 0.2, runs=10, seconds=180.0)
    leading = replica.agreement(problem, found, floor_of(problem), 0, simple("gap_stiffness"))[1]["leading"]
    assert leading.share > 1.5 * LEAST_GAIN and not leading.is_refused


def test_what_drivers_do_in_a_state_is_no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closing speeds count double above 2 m/s, under noise of 0.1 m/s²."""
    usual = hidden._desired_gap

    def doubled(speed, closing, time_gap, drivers):  # type: ignore[no-untyped-def]
        return usual(speed, np.where(closing > 2.0, 2.0 * closing - 2.0, closing), time_gap, drivers)

    monkeypatch.setattr(hidden, "_desired_gap", doubled)
    _, told = replica.agreement(*fitted(4, 0.1), 0.05, 0, curve("time_gap", "closing_speed", -3.0, 1.0, 8))
    for one in (told["scene"], told["leading"]):
        assert one.is_refused and one.replicas == replica.CLEAR and one.share > 0.02
    assert 1.0 / (1.0 + replica.CLEAR) < LEVEL  # so many replicas can decide


@pytest.mark.parametrize(("kind", "ou", "seed"), [("OU 0.2", 0.2, 970_201), ("noise by speed", 0.0, 970_402)])
def test_sets_in_which_nothing_is_missing_say_so(kind: str, ou: float, seed: int) -> None:
    """Both were refused with p = 0.025, the least of 39 replicas whose noise was too short, or as large everywhere."""
    problem, found = fitted_to(undeclared.generated(undeclared.Job(kind, ou, seed)))
    drivers, told = replica.agreement(problem, found, floor_of(problem), seed)
    assert drivers.by_speed == (kind == "noise by speed") and 3.0 < drivers.memory_s < 8.0
    assert not any(one.is_refused for one in told.values())
