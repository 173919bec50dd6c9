"""A round of the search: what is tried, from where, and how much of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import t as student

from idm_env.data import episodes, synthetic
from idm_env.discovery import crossed, model as terms, places, search, selection
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.march import COLUMNS, PULSED
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.noise import Noise, first_noise
from idm_env.discovery.records import Records, gather, whole, windows
from idm_env.discovery.score import SYSTEMATIC, half_width, held_out, log_gain
from idm_env.discovery.search import Scored, Search
from idm_env.discovery.selection import _same_class
from idm_env.discovery.solve import Problem, Solution, _Nested, linearise, solve
from idm_env.discovery.verdict import Reason
from idm_env.effects import IDM, Brakes
from idm_env.model_file import Model, load_model, save_model
from idm_env.roads import Lane
from idm_env.simulator import Simulator


def begun(records: Records, *names: str) -> tuple[Search, Solution]:
    """Return a search with its null."""
    rows = windows(records)
    problem = Problem(rows, first_noise(rows), first_prior())
    searching = Search(problem, names, False, lambda *_: None)
    return searching, searching.null(Hypothesis(), np.tile(problem.prior.centre, (problem.groups, 1)), np.zeros(0))


def made(seed: int, **choices: object) -> Records:
    trajectories, _ = synthetic.generate(seed, **choices)  # type: ignore[arg-type]
    return gather(list(episodes(trajectories, smooth=True, min_seconds=12.0)))


def test_a_pair_that_cancels_is_fitted_from_strong_starts() -> None:
    """Strong starts make errors larger at first, and a fit of one step ended where it gained nothing."""
    records = made(941001, effect={"delay": 0.5, "leader_acceleration": 0.4}, runs=5, followers=2, seconds=90.0)
    searching, null = begun(records, "delay", "leader_acceleration")
    pair = searching.pair(null, ("delay", "leader_acceleration"), held_out(searching.problem, null), 1)
    assert pair.solution is not None and pair.gains.mean() > 0.1
    assert pair.solution.values.tolist() == pytest.approx([0.5, 0.4], rel=0.15)


def test_a_time_is_found_although_its_scan_ends_a_bin_off() -> None:
    """Drivers' own parameters make up for a wrong time, so that between two bins the cost has a local minimum."""
    searching, null = begun(made(90150, effect="regime_shift"), "regime_shift")
    scored = searching.round(null, 1)
    solution = scored[0].solution
    assert solution is not None
    strength, time = solution.values
    assert strength == pytest.approx(0.35, abs=0.03) and time == pytest.approx(100.0, abs=0.5)


def test_what_promises_nothing_costs_little_and_what_is_there_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("leader_acceleration", "memory", "drag", "dead_zone", "speed_time_gap")
    copies: list[int] = []
    predict = Problem.predict

    def counted(self: Problem, theta: np.ndarray, *rest: object) -> tuple[np.ndarray, np.ndarray]:
        copies.append(len(theta))
        return predict(self, theta, *rest)  # type: ignore[arg-type]

    for hidden in (None, "speed_time_gap"):
        searching, null = begun(made(31, runs=6, followers=2, seconds=120.0, effect=hidden), *names)
        monkeypatch.setattr(Problem, "predict", counted)
        for term in map(terms.simple, names):
            copies.clear()
            share, scaled = searching._promise(null, term)
            assert len(share) == len(scaled) == len(term.starts) and copies == [len(term.starts)]
            found = searching._nested(null, term, np.ones(len(searching.units))).solution
            assert found is not None
            lowered = 1.0 - (found.linear.residual**2).sum() / (null.linear.residual**2).sum()
            if term.label == hidden:
                assert lowered > share.max() > 0.1 and found.values[0] == pytest.approx(-0.4, abs=0.05)
            elif hidden is None:
                assert share.max() < search.FAINT and lowered < 2 * search.FAINT and sum(copies) < 60
        monkeypatch.undo()


def test_an_interval_is_as_wide_as_fits_without_a_run_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    searching, null = begun(made(31, runs=8, followers=2, seconds=150.0, effect="memory", ou=0.05), "memory")
    model, problem = Hypothesis((terms.simple("memory"),)), searching.problem
    found = solve(problem, model, null.theta, np.array(model.terms[0].starts[-1]), iterations=30, tolerance=1e-8)
    runs = np.unique(problem.rows.run)
    without = [problem.of_rows(problem.rows.run != run) for run in runs]
    left = [solve(t, model, found.theta, found.values, iterations=20, tolerance=1e-7).values[0] for t in without]
    jackknife = np.std(left) * np.sqrt(len(runs) - 1)
    wide = half_width(found, problem)[0]
    with monkeypatch.context() as without_noise:
        without_noise.setattr(Noise, "wander", 0.0)
        quiet = half_width(found, problem)[0]
    share = quiet**2 - (1.96 * SYSTEMATIC * found.values[0]) ** 2
    assert np.sqrt(share) / student.ppf(0.975, len(runs) - 1) == pytest.approx(jackknife, rel=0.12)
    # Drivers' noise, alike in all runs, does not show in how these differ.
    assert problem.noise is not None and 0.03 < problem.noise.wander < 0.08
    assert wide > quiet


def test_the_run_that_decides_is_held_out_by_a_solution_on_the_others() -> None:
    """A Newton step without the only run that has the effect ended at a gain of −0.70."""
    alike, _ = synthetic.generate(31, runs=4, followers=2, seconds=60.0)
    other, _ = synthetic.generate(32, runs=1, followers=2, seconds=120.0, effect="speed_time_gap")
    parts = [list(episodes(part, smooth=True, min_seconds=12.0)) for part in (alike, other)]
    searching, null = begun(gather([*parts[0], *(replace(e, run_id="other") for e in parts[1])]), "speed_time_gap")
    before = held_out(searching.problem, null)
    one = solve(searching.problem, Hypothesis((terms.simple("speed_time_gap"),)), null.theta, np.zeros(1), iterations=1)
    mine, gains = searching.problem.rows.run == 4, log_gain(before, held_out(searching.problem, one))
    rest = solve(searching.problem.of_rows(~mine), one.model, null.theta, one.values)
    fixed = solve(searching.problem.of_rows(mine), one.model.fixed(rest.values), null.theta, np.zeros(0))
    exact = 0.5 * np.log(before[4] / (fixed.linear.residual**2).sum())
    assert gains[4] == pytest.approx(exact, abs=0.02) and gains[4] > -0.05
    assert log_gain(before, held_out(searching.problem, one, exact=False))[4] < -0.5
    folds, runs = np.array([0, 0, 1, 1, 2]), searching.problem.rows.records.runs
    assert crossed.values_of(searching.problem, one, runs, folds)[2] == pytest.approx(rest.values, rel=0.02, abs=1e-3)


def test_a_curve_is_fitted_although_its_line_misses_one_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where a name gains as much as its mean with that loss; one that loses everywhere is not."""
    searching, null = begun(made(31, runs=4, followers=1, seconds=60.0), "drag")
    gains = {"speed": np.array([0.1, 0.1, 0.1, -0.8]), "gap": np.array([0.0, 0.02, 0.0, 0.0])}
    gains |= {"closing_speed": np.full(4, -0.1)}
    curves = [terms.curve("time_gap", c, 0.0, 5.0, 4) for c in gains]
    monkeypatch.setattr(search, "_line", lambda responses, term: (np.zeros(4), gains[term.coordinate]))
    monkeypatch.setattr(Search, "_nested", lambda self, solution, term, *rest: Scored(term, null, np.ones(4)))
    scored = searching._curves(null, places.respond(searching.problem, null), np.ones(4), curves, 0.06)
    fitted = {s.term.coordinate: s.solution is not None for s in scored}
    assert fitted == {"speed": True, "gap": False, "closing_speed": False}


def test_a_law_alone_has_a_loop_of_its_own(platoon: Records) -> None:
    """It rolls out as the whole catalogue's does with an effect at its null."""
    rows = whole(platoon)
    problem, theta = Problem(rows, None, first_prior()), np.tile(first_prior().centre, (1, len(platoon.groups), 1))
    absent = Hypothesis((terms.simple("drag"),))
    assert not Hypothesis().bare.catalogue.effects and absent.catalogue.effects
    alone = problem.predict(theta, Hypothesis(), np.zeros((1, 0)))
    beside = problem.predict(theta, absent, np.zeros((1, 1)))
    np.testing.assert_allclose(alone, beside, rtol=0, atol=1e-9)


def test_candidates_far_behind_the_best_are_not_fitted_to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("memory", "leader_acceleration", "drag", "power_limit", "speed_time_gap")
    searching, null = begun(made(31, runs=6, followers=2, seconds=120.0, effect="speed_time_gap"), *names)
    before = held_out(searching.problem, null)
    to_the_end: list[str] = []

    def noted(problem: Problem, model: Hypothesis, *rest: np.ndarray, iterations: int = 12) -> Solution:
        if model.terms and iterations > 5:
            to_the_end.append(model.terms[-1].label)
        return solve(problem, model, *rest, iterations=iterations)

    monkeypatch.setattr(search, "solve", noted)
    alone = {n: searching._nested(null, terms.simple(n), before) for n in names}
    best = max(alone, key=lambda n: alone[n].gains.mean())
    assert best == "speed_time_gap" and len(to_the_end) > 1
    to_the_end.clear()
    scored = {s.term.label: s for s in searching.round(null, 1) if s.term.label in alone}
    assert to_the_end == [best]
    np.testing.assert_array_equal(scored[best].gains, alone[best].gains)
    behind = [s.gains.mean() for n, s in scored.items() if n != best]
    assert max(behind) < search.NEAR * alone[best].gains.mean()


def test_only_groups_that_moved_are_rolled_out_again(platoon: Records) -> None:
    """Free simulation, and windows, whose errors depend on those before: the same bits as everything anew."""
    searching, null = begun(platoon, "drag")
    for problem in (searching.problem, Problem(whole(platoon), None, searching.problem.prior)):
        model, values = Hypothesis((terms.simple("drag"),)), np.array([1e-4])
        nested = _Nested(problem, model)
        shared, first = torch.tensor(values[None]), torch.tensor(null.theta[None])
        nested.linear(first, shared)
        other = first.clone()
        other[:, [1, 4]] += 0.05
        got, anew = nested.linear(other, shared), linearise(problem, model, other[0].numpy(), values)
        assert (got.residual == anew.residual).all() and (got.jacobian == anew.jacobian).all()
        assert (got.residual != nested.problem.residual(problem.errors(first.numpy(), model, values[None]))[0]).any()


def test_a_curve_has_intervals_over_its_coordinate_in_it() -> None:
    zone, shift = terms.placed("speed_zone", 0.7, 500.0, 900.0), terms.placed("regime_shift", 0.3, 100.0)
    profile = terms.unknown_profile("speed_profile", 0.0, 80.0, 40, 0.0)
    ramp = terms.curve("time_gap", "time", 0.0, 200.0, 2, label="time_gap ramp")
    assert _same_class(zone, Hypothesis((profile,))) and not _same_class(profile, Hypothesis((zone,)))
    assert not _same_class(shift, Hypothesis((profile,))) and not _same_class(shift, Hypothesis((ramp,)))


def test_the_past_of_a_record_is_what_a_driver_on_it_remembers(platoon: Records) -> None:
    """Coordinates of curves are those that the loop winds up: here of one record, by definition."""
    mine = slice(platoon.bounds[1], platoon.bounds[2])
    slower = platoon.signals.copy()
    slower[:, COLUMNS.index("speed")] -= np.quantile(platoon.speed[mine], 0.2)  # so that there are stops
    speed, lead_accel = slower[mine, COLUMNS.index("speed")], platoon.column("lead_accel")[mine]
    past = {name: x[mine] for name, x in replace(platoon, signals=slower).past.items()}
    stops = [i for i in range(len(speed)) if speed[i] <= 0.5]
    mean, hardest = speed[0], max(-lead_accel[0], 0.0)
    for i in range(len(speed)):
        since = 0.1 * (i - 1 - max((j for j in stops if j < i), default=-np.inf))
        expected = min(since, 90.0) if i else 90.0 * (0 not in stops)
        assert past["time_since_stop"][i] == pytest.approx(expected, abs=1e-6)
        assert past["mean_speed_20s"][i] == pytest.approx(mean) and past["lead_braking_15s"][i] == pytest.approx(
            hardest
        )
        mean, hardest = mean + (speed[i] - mean) * 0.1 / 20.1, max(-lead_accel[i], hardest * 15.0 / 15.1)
    assert 0 < len(stops) < len(speed) and past["braking_15s"].max() > 0.5


def test_a_model_has_one_curve_over_the_past(platoon: Records) -> None:
    since, mean = (terms.curve("time_gap", c, 0.0, 5.0, 4) for c in ("time_since_stop", "mean_speed_90s"))
    searching, null = begun(platoon, "drag")
    solution = solve(searching.problem, Hypothesis((since,)), null.theta, np.zeros(4), iterations=1)
    responses = places.respond(searching.problem, null)
    before = held_out(searching.problem, null)
    assert [s.term for s in searching._curves(solution, responses, before, (mean,))] == []
    assert [s.term for s in searching._curves(null, responses, before, (mean,), np.inf)] == [mean]
    with pytest.raises(ValueError, match="one more over the past, and 0 and 2 were given"):
        Hypothesis((since, mean))


def test_a_model_with_the_period_that_explains_most_is_read_back(platoon: Records, tmp_path: Path) -> None:
    """A report was not written for it: YAML has no numbers of numpy's."""
    searching, null = begun(platoon, "drag")
    what, cycle, _ = places.best_period(places.respond(searching.problem, null))
    phase = terms.curve(what, "time", 0.0, cycle / 8, 8, cycle)
    added, numbers = terms.effects_of(Hypothesis((phase,)), np.full(8, 0.1))
    save_model(tmp_path / "model.yaml", Model((IDM(), *added, Brakes()), numbers))
    back = load_model(tmp_path / "model.yaml")
    assert back.effects == (IDM(), *added, Brakes()) and f"period: {cycle}" in (tmp_path / "model.yaml").read_text()


@pytest.mark.parametrize("dt", [0.04, 0.1, 0.2, 0.3])
def test_responses_of_all_seconds_are_that_of_the_whole_window(dt: float) -> None:
    """At every time step: a change that lasts is what its parts of a second add up to."""
    searching, null = begun(made(3, runs=2, followers=1, seconds=30.0, dt=dt), "drag")
    problem, always = searching.problem, terms.curve("time_gap", "time", 0.0, 200.0, 2)
    rows, change = problem.rows, places.respond(problem, null).change[PULSED.index("time_gap")]
    assert rows.seconds[0] == 0 and rows.seconds[-1] == rows.steps and change.shape[0] == rows.middle.shape[1]

    def left(model: Hypothesis, values: np.ndarray) -> np.ndarray:
        return problem.residual(problem.errors(null.theta[None], model, values[None]))[0]

    together = left(Hypothesis((always,)), np.full(2, 0.01)) - left(Hypothesis(), np.zeros(0))
    np.testing.assert_allclose(0.01 * change.sum(0), together, rtol=0.0, atol=0.05 * abs(together).max())


CURVES = (
    terms.interval("time_gap", "position", 100.0, 200.0, 0.3),
    terms.interval("time_gap", "time", 20.0, 50.0, 0.3),
    terms.curve("time_gap", "position", 0.0, 150.0, 4),
    terms.curve("time_gap", "time", 0.0, 200.0, 2, label="time_gap ramp"),
    replace(terms.interval("accel_and_decel", "time", 80.0, 1e6, 0.3), label="accel_and_decel step in time"),
    terms.interval("accel_and_decel", "time", 20.0, 50.0, -0.3),
    replace(terms.interval("acceleration", "time", 80.0, 1e6, 0.3), label="acceleration step in time"),
    terms.interval("acceleration", "time", 20.0, 50.0, -0.3),
    terms.curve("acceleration", "time", 0.0, 8.0, 6),
    terms.curve("acceleration", "time", 0.0, 5.0, 8, 40.0, label="acceleration over phase"),
    terms.curve("time_gap", "speed", 0.0, 3.0, 4),
    terms.curve("time_gap", "speed", 0.0, 3.0, 4, by="gap"),
)
"""One of every kind that rounds add without a name, those over one coordinate with other knots among them."""


def test_whatever_rounds_join_is_one_model(tmp_path: Path) -> None:
    """Two rounds may add a curve of one quantity over one coordinate: both are in the model, and read back."""
    for pair in combinations(CURVES, 2):
        values = np.concatenate([np.full(t.size, 0.1) if len(t.starts[0]) > 3 else t.starts[0] for t in pair])
        added, numbers = terms.effects_of(Hypothesis(pair), values)
        model = Model(effects=(IDM(), *added, Brakes()), parameters=numbers)
        save_model(tmp_path / "model.yaml", model)
        again = load_model(tmp_path / "model.yaml")
        assert again.effects == model.effects and again.parameters == numbers
        names = [e.name for e in Simulator(Lane(), again.effects).effects]
        assert len(set(names)) == len(names) == 2 + sum(2 if t.what == "accel_and_decel" else 1 for t in pair)


def test_a_latency_below_a_step_that_was_all_that_was_asked_for_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """It becomes the null's, and nothing is left to try: that is an answer and no error."""
    searching, null = begun(made(7, runs=6, followers=2, seconds=60.0, ou=0.0, noise=0.0), "delay")
    scored = searching.round(null, 1)
    solution = scored[0].solution
    assert solution is not None
    model = solution.model
    short = solve(searching.problem, model, solution.theta, np.array([0.05]), iterations=0)
    rounds: list[list[Scored]] = [[replace(scored[0], solution=short, gains=np.full(6, 0.5))], []]
    monkeypatch.setattr(Search, "round", lambda *_: rounds.pop(0))
    monkeypatch.setattr(Search, "null", lambda *_: short)
    monkeypatch.setattr(Search, "again", lambda _, now, best, scored: (now, scored))
    monkeypatch.setattr(selection, "_closed_loop_holds", lambda *_: True)
    null, steps, seen = selection._rounds(searching, null, 0)
    assert null is not solution and steps == [] and len(seen) == 1
    assert seen[0].winner is None and seen[0].leading is None


@pytest.mark.parametrize(("gain", "reason"), [(0.018, Reason.NO_GAIN), (0.022, Reason.SMALL_SIZE)])
def test_what_gains_less_than_two_percent_is_not_added(
    gain: float, reason: Reason, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sure as it may be: a time gap that wanders makes stiffness gain 0.015, and that was named."""
    searching, null = begun(made(7, runs=8, followers=1, seconds=30.0), "drag")
    monkeypatch.setattr(selection, "_is_small", lambda *_: True)
    gains = gain + 1e-4 * np.arange(-4.0, 4.0)
    scored = [Scored(terms.simple("drag"), null, gains)]
    this = selection.Round(scored, selection._tested(searching, scored, 0))
    selection._choose(searching, null, this)
    assert this.tested.p_value[0] < 0.05 and this.refusal is not None and this.refusal.reason is reason
