"""Verdicts, outcomes and sentences follow held-out errors; figures are made up, or of small generated sets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from idm_env.data import Trajectories, episodes, synthetic
from idm_env.discovery import (
    Discovery,
    compare,
    crossed,
    discover,
    judge,
    model as terms,
    page,
    page as pages,
    selection,
    together,
    verdict,
    words,
    write_report,
)
from idm_env.discovery.bases import Law, best_of, personal
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.compare import ERRORS, Comparison, ErrorChange
from idm_env.discovery.judgement import Judgement
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import gather
from idm_env.discovery.selection import Round, shows_in_few
from idm_env.discovery.shared import Shared
from idm_env.discovery.verdict import Reason, Refusal, Verdict, conclude, improves
from idm_env.effects import ALL, CANDIDATES, base_named

pytestmark = pytest.mark.usefixtures("two_laws")

BETTER, SAME, WORSE = (Comparison(1.0, ratio, ratio, ratio - 0.05, ratio + 0.05) for ratio in (0.9, 0.99, 1.1))
UP, FAR_UP = (Comparison(1.0, ratio, ratio, 0.9, 1.2) for ratio in (1.01, 1.08))


def errors(*three: Comparison) -> dict[str, Comparison]:
    return dict(zip(ERRORS, three, strict=True))


@pytest.mark.parametrize(
    ("three", "may"),
    [
        ((BETTER, BETTER, BETTER), True),
        ((replace(BETTER, improved=0.2, followers=30), BETTER, BETTER), False),  # the median driver gets worse
        ((replace(BETTER, improved=0.45, followers=30), BETTER, BETTER), True),  # which chance does, too
        ((WORSE, BETTER, SAME), False),
        ((BETTER, WORSE, SAME), False),
        ((BETTER, replace(SAME, driver=(1.1, 1.02, 1.2)), SAME), False),  # one follower makes the pooled error the same
        ((UP, BETTER, SAME), True),
        ((FAR_UP, BETTER, SAME), False),
        ((replace(FAR_UP, improved=0.75), BETTER, SAME), False),
        ((UP, UP, UP), False),
        ((SAME, SAME, SAME), False),  # nothing falls beyond chance
        ((SAME, replace(SAME, driver=(0.9, 0.85, 0.96)), SAME), True),  # it does for the followers' own ratios
        ((replace(UP, driver=(0.9, 0.8, 0.95)), UP, UP), False),  # errors rise on the whole
        ((WORSE, SAME, SAME), False),
        ((WORSE, WORSE, UP), False),
    ],
)
def test_a_better_model_lowers_errors_on_the_whole_and_makes_none_worse(
    three: tuple[Comparison, ...], may: bool
) -> None:
    assert improves(errors(*three)) == may


def test_a_law_is_better_where_an_error_is_lower_beyond_chance() -> None:
    """None of them higher; its interval alone counts, as no run chose it."""

    def law(*three: Comparison) -> Law:
        base = base_named("gipps")
        model = Hypothesis((), Catalogue((), base, located=False))
        return Law(base, model, None, errors(*three) if three else {})  # type: ignore[arg-type]

    null, gipps = law(), law(UP, BETTER, SAME)
    assert gipps.is_better
    nearly = replace(BETTER, ratio=0.98)
    for three in ((SAME, SAME, SAME), (WORSE, BETTER, BETTER), (FAR_UP, BETTER, SAME), (nearly, nearly, nearly)):
        assert not law(*three).is_better
    assert best_of([null, gipps, law(BETTER, BETTER, SAME)]).mean_ratio == pytest.approx((0.9 * 0.9 * 0.99) ** (1 / 3))
    assert best_of([null, law(SAME, SAME, SAME)]) is null
    judgement = Judgement(None, None, False, Refusal(Reason.NO_GAIN), None, None, 0)  # type: ignore[arg-type]
    first = judgement.beside(gipps)
    assert first.law is gipps and first.refusal == Refusal(Reason.LAW) and judgement.beside(null) is judgement
    told = words.law_first(gipps, "IDM")
    assert told.startswith("Gipps' model predicts better than IDM calibrated alike. Against IDM, gap 5 s ahead −10.0")
    more = " ".join(words.law_details(gipps, on=False))
    assert f"with {len(gipps.law.declared)} parameters a driver" in more and "explain --base gipps" in more


@pytest.mark.parametrize(("stiffness", "finding"), [(0.4, "less"), (2.5, "more")])
def test_a_law_with_strengths_of_each_drivers_own_says_which_way_they_lie(stiffness: float, finding: str) -> None:
    bare = Hypothesis((), Catalogue((), base_named("idm"), located=False))
    model = personal(bare, base_named("idm"))
    own = Law(base_named("idm"), model, None, errors(UP, BETTER, SAME))  # type: ignore[arg-type]
    values = [stiffness if name == "gap_stiffness" else p.default for name, p in model.catalogue.of_driver]
    theta = np.log(np.array(values)) + np.zeros((5, 1))
    by_mean_driver = replace(BETTER, high=1.01, driver=(0.95, 0.91, 0.999))
    assert own.is_better and not own._replace(against=errors(BETTER, by_mean_driver, SAME)).is_better
    first = words.law_first(own, "IDM", SimpleNamespace(model=model, theta=theta, row_group=np.arange(5)))  # type: ignore[arg-type]
    told = ALL["gap_stiffness"].wording[finding == "more"]
    assert first.startswith(f"{told[:1].upper()}{told[1:]}"[:20]) and "With strengths of each driver's own" in first


def test_a_choice_is_made_anew_without_every_fold() -> None:
    """Two candidates, six runs in three folds: the first gains in one fold only."""
    gains = np.array([[0.9, 0.9, 0.0, 0.0, 0.0, 0.0], [0.1] * 6])
    scored = [
        SimpleNamespace(gains=g, term=terms.simple(n), solution=1) for g, n in zip(gains, ("lag", "drag"), strict=True)
    ]
    this = Round(scored, None, 0, run=np.arange(6))  # type: ignore[arg-type]
    fold = np.array([1, 1, 2, 2, 3, 3])
    assert this.chosen_in(0, fold) == pytest.approx(2 / 3) and this.chosen_in(1, fold) == pytest.approx(1 / 3)
    this.equivalent = [1]
    assert this.chosen_in(0, fold) == 1.0
    # Where followers are counted, each belongs to the fold of its run.
    thrice = [SimpleNamespace(gains=np.repeat(s.gains, 3), term=s.term, solution=1) for s in scored]
    followers = Round(thrice, None, 0, run=np.repeat(np.arange(6), 3))  # type: ignore[arg-type]
    assert followers.chosen_in(0, fold) == pytest.approx(2 / 3)


def test_the_verdict_is_made_from_what_was_added_and_why_not_more() -> None:
    flat, steep = np.full(8, 0.001), np.full(8, 0.2)
    assert conclude(True, True, None, True, flat) is Verdict.NAMED
    assert conclude(True, True, None, True, flat, apart=False) is Verdict.ONE_OF
    assert conclude(True, False, None, True, flat, apart=False) is Verdict.LOCATED
    assert conclude(True, False, None, True, flat) is Verdict.LOCATED
    assert conclude(False, False, Refusal(Reason.FEW_RUNS, 3), True, steep) is Verdict.CANNOT_TELL
    assert conclude(False, False, Refusal(Reason.NO_GAIN), False, flat) is Verdict.NONE
    assert conclude(False, False, Refusal(Reason.NO_GAIN), False, steep) is Verdict.UNEXPLAINED
    # Much noise of drivers leaves much to a smooth function of the state; it leaves nothing to a candidate.
    assert conclude(False, False, Refusal(Reason.NO_GAIN), False, steep, alike=True) is Verdict.UNDECIDED
    assert conclude(False, False, Refusal(Reason.NO_GAIN), True, steep, alike=True) is Verdict.UNEXPLAINED
    assert conclude(False, False, Refusal(Reason.HELD_OUT), True, flat) is Verdict.UNEXPLAINED
    assert conclude(False, False, Refusal(Reason.LAW), False, flat, shared=True) is Verdict.UNEXPLAINED


def test_an_outcome_needs_the_whole_interval_on_one_side() -> None:
    assert [c.outcome for c in (BETTER, SAME, WORSE)] == [ErrorChange.BETTER, ErrorChange.SAME, ErrorChange.WORSE]
    assert Comparison(1.0, 1.0, 1.0, float("nan"), float("nan")).outcome is ErrorChange.SAME
    # Most followers' errors fall, and the pooled one does not.
    assert replace(SAME, ratio=1.007, driver=(0.8, 0.7, 0.9)).outcome is ErrorChange.SAME


def test_intervals_cover_the_true_change() -> None:
    """Followers whose errors change by known factors around 0.9, in few runs and in many: 95 % is about 95 %."""
    random = np.random.default_rng(0)
    for runs, each in ((2, 4), (4, 3), (12, 1), (10, 3)):
        covered = []
        for trial in range(150):
            # What a run has in common exists only where runs are drawn.
            common = 0.2 * random.standard_normal(runs) if runs >= compare.RUNS else np.zeros(runs)
            run = np.repeat(np.arange(runs), each)
            change = np.log(0.9) + common[run] + 0.2 * random.standard_normal(len(run))
            was = np.ones(len(run))
            found = compare.compared(was, was * np.exp(2 * change), np.full(len(run), 10.0), run, trial)
            true = 0.9 * np.exp(0.2**2 * (2 if runs >= compare.RUNS else 1))  # of the root of the mean square
            covered.append(found.low < true < found.high)
        assert np.mean(covered) > 0.88, (runs, each)


def test_one_follower_tells_nothing() -> None:
    found = compare.compared(np.ones(1), np.full(1, 0.1), np.full(1, 10.0), np.array(["a"]), 0)
    assert found.outcome is ErrorChange.SAME and found.low == 0.0 and found.high == float("inf")


def test_a_hopeless_follower_is_told_apart() -> None:
    """He takes the pooled error up, and the trimmed one of the others falls."""
    was, now = np.append(np.ones(19), 100.0), np.append(np.full(19, 0.25), 400.0)
    found = compare.compared(was, now, np.ones(20), np.arange(20).astype(str), 0)
    assert found.after > 1.8 * found.before and found.trimmed == (1.0, 0.5)


def test_a_driver_in_pieces_is_one_driver() -> None:
    """A hole in a record makes two episodes of one driver: one row in the table, with the error of both."""
    made, _ = synthetic.generate(11, runs=2, followers=2, seconds=60.0)
    since = pl.col("time_s") - pl.col("time_s").min().over("run_id")
    cut = made.table.filter(~since.is_between(28.0, 30.0))
    records = gather(list(episodes(replace(made, table=cut), smooth=True, min_seconds=12.0)))
    assert len(records) > len(records.groups) == 4
    judged = judge.judge(records, Hypothesis(), np.zeros(0), np.tile(first_prior().centre, (4, 1)))
    assert len(judged.followers) == len(judged.gap_rmse) == 4
    total = judged.squares["gap_rmse_m"][1]
    pooled = np.sqrt((judged.gap_rmse**2 * total).sum() / total.sum())
    assert pooled == pytest.approx(judged.summary()["gap_rmse_m"])


@pytest.mark.parametrize("name", CANDIDATES)
def test_every_effect_is_told_with_equation_and_sign(name: str) -> None:
    cls = ALL[name]
    if cls.sought == "anywhere":
        term = terms.simple(name)
    elif cls.sought == "profile":
        term = terms.unknown_profile(name, 0.0, 100.0, 7, 0.0)
    elif cls.sought == "given":
        term = terms.given_profile(cls())
    else:
        term = terms.placed(name, *((0.5, 100.0, 200.0) if cls.sought == "interval" else (0.5, 100.0)))
    strength = term.parameters[0]
    for side, text in zip((strength.low, strength.high), cls.wording, strict=True):
        values = [(side, side, side)] + [(p.default,) * 3 for p in term.parameters[1:]]
        if text and cls.sought != "profile":
            told = words.clause(term, values)
            begins, equation = told.split(". ", 1)
            assert begins == text.replace("{law}", "IDM") and cls.equation in equation
            assert f"{strength.symbol} = " in equation
            assert "IDM" not in words.clause(term, values, law="Gipps' model"), "the law that is completed"


def test_what_is_located_is_told_with_place_and_sign() -> None:
    less = terms.interval("time_gap", "position", 700.0, 1000.0, -0.3)
    told = words.clause(less, [(-0.3, -0.4, -0.2), (700.0, 690.0, 710.0), (1000.0, 990.0, 1010.0)])
    assert told.startswith("drivers keep shorter time gaps between 700 and 1000 m than elsewhere. Time gap: T → T (1")
    step = terms.interval("acceleration", "time", 40.0, 1e6, 0.2)
    assert "vehicles accelerate more from 40 s on" in words.clause(step, [(0.2, 0.1, 0.3), (40.0,) * 3, (1e6,) * 3])


def few(runs: int = 8, **changes: object) -> Trajectories:
    options: dict[str, object] = {"runs": runs, "followers": 2, "seconds": 90.0} | changes
    return synthetic.generate(21, **options)[0]  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def lag() -> Discovery:
    return discover(few(effect="lag"), effects=["lag", "drag"])


def test_a_finding_tells_what_it_does_for_every_error(lag: Discovery, tmp_path: Path) -> None:
    report = lag.report
    assert report["sentence"].startswith("Vehicles take longer than IDM") and "τ dA/dt = a − A" in report["sentence"]
    assert set(report["helps"]) == set(ERRORS)
    for key, told in report["helps"].items():
        assert told["verdict"] == "better" and told["low"] < told["ratio"] < told["high"] < 1.0
        assert told["before"] == pytest.approx(report["error"]["before"][key])
        assert told["after"] == pytest.approx(report["error"]["after"][key])
    assert "bootstrap of whole runs" in report["interval"]
    paths = write_report(lag, tmp_path)
    assert set(paths) == {"report.json", "report.html", "model.yaml", "model_idm.yaml"}
    assert report["models"]["model.yaml"] == "IDM with response lag"
    assert [e.name for e in lag.models["model_idm.yaml"].effects] == ["idm", "brakes"]
    page = paths["report.html"].read_text()
    first = page[: page.index("How sure is that")]
    assert report["sentence"].split(". ")[0] in first and first.count('class="light better"') == 3
    assert first.count("<img") == 1 and "<table" not in first
    gap = report["helps"]["gap_rmse_m"]
    trimmed = " → ".join(pages.number(gap[f"trimmed_{which}"]) for which in ("before", "after"))
    assert f'data-label="nine in ten followers">{trimmed}</td>' in page
    assert len(report["ladder"]["dependences"]) == 9 and "Above zero the model falls behind" in page


def test_what_data_do_not_tell_apart_is_one_of() -> None:
    """Leaders here brake too gently to tell a delay from a lag."""
    report = discover(few(effect="lag", strength=0.25), effects=["lag", "delay"], located=False).report
    first, other = report["found"][0]["effect"], report["found"][0]["equivalent"]
    assert report["verdict"] == "one_of" and {first, *other} == {"lag", "delay"}
    assert f"These data do not tell it from {words.plain(other[0])}." in report["sentence"]


def test_the_other_model_of_an_earlier_run_does_not_stay(lag: Discovery, tmp_path: Path) -> None:
    """It would be taken for one of this run; a file of that name that is not ours stays, and is told."""
    turned = {"model.yaml": lag.models["model_idm.yaml"], "model_corrected.yaml": lag.model}
    write_report(replace(lag, models=turned), tmp_path)
    write_report(lag, tmp_path)
    assert {path.name for path in tmp_path.glob("*.yaml")} == {"model.yaml", "model_idm.yaml"}
    (tmp_path / "model_corrected.yaml").write_text("mine")
    with pytest.raises(ValueError, match=r"model_corrected\.yaml was not written by idm-env"):
        write_report(lag, tmp_path)


def test_what_makes_every_error_worse_is_not_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The decision on the runs that choose stands, the judgement by cross-fitting goes against it."""
    right = crossed.crossed

    def contrary(records, model, *rest, **named):  # type: ignore[no-untyped-def]
        judged = right(records, model, *rest, **named)
        if not model.terms:
            return judged
        return replace(judged, gap=judged.gap + 3.0, speed=judged.speed + 1.0, ahead=np.abs(judged.ahead) + 2.0)

    monkeypatch.setattr(crossed, "crossed", contrary)
    found = discover(few(effect="lag"), effects=["lag", "drag"], located=False)
    report = found.report
    assert report["verdict"] == "unexplained" and report["reason"] == "held_out" and report["found"] == []
    assert "Response lag was selected, and no error falls on held-out runs." in report["sentence"]
    assert "τ dA/dt = a − A" in " ".join(report["details"])
    assert all(told["ratio"] > 1.0 for told in report["helps"].values())
    assert report["error"]["after"] == report["error"]["before"]
    assert report["partial"]["effect"] == "response lag" and report["partial"]["share_of_drivers_improved"] == 0.0
    paths = write_report(found, tmp_path)
    assert [e.name for e in found.model.effects] == ["idm", "brakes"]
    assert set(paths) >= {"model.yaml", "model_corrected.yaml"}
    assert json.loads(paths["report.json"].read_text())["models"]["model_corrected.yaml"] == "IDM with response lag"
    assert 'class="light worse"' in paths["report.html"].read_text()


def test_bounds_are_told() -> None:
    assert words.cautions({"comfort_decel": 3, "time_gap": 0}, 38) == []
    told = " ".join(words.cautions({"comfort_decel": 15, "time_gap": 0}, 38))
    assert "comfort decel is at its bound for 15 of 38" in told


def test_an_interval_that_ends_at_the_bound_of_the_search_says_so() -> None:
    parameter = replace(terms.simple("gap_stiffness").parameters[0], low=0.05, high=3.0)
    assert words.told(parameter, 0.2, 0.05, 0.4).endswith("[0.05, 0.4; 0.05 the search's bound]")
    assert words.told(parameter, 0.2, 0.06, 0.4).endswith("[0.06, 0.4]")


@pytest.mark.parametrize(("own", "last", "told"), [(2.0, 2.68, ["+34.0\N{NO-BREAK SPACE}%"]), (2.0, 1.9, [])])
def test_predictions_ten_seconds_ahead_that_get_worse_are_on_the_first_screen(
    own: float, last: float, told: list[str]
) -> None:
    rungs = {"one set of parameters for all": 3.0, "parameters of every driver": own, "a law": last}
    report = SimpleNamespace(ladder=SimpleNamespace(ten_s_m=rungs))
    assert [text for _, _, text in page._later(report)] == told  # type: ignore[arg-type]


def test_words_of_none_claim_no_cause() -> None:
    text = words.headline(Verdict.NONE, [], Refusal(Reason.NO_GAIN), "", {})
    assert "drivers' own noise" not in text and f"gains {selection.NAMED_GAIN:.0%} on held-out runs" in text
    assert verdict.Verdict("none") is Verdict.NONE


def test_whoever_gave_seven_runs_is_not_told_that_seven_are_needed() -> None:
    few = words.headline(Verdict.CANNOT_TELL, [], Refusal(Reason.FEW_RUNS, 2), "", {})
    assert "only 2 runs are left" in few and "Four runs of three followers or seven runs, better ten, are needed" in few
    weak = words.headline(Verdict.CANNOT_TELL, [], Refusal(Reason.NO_POWER, 5), "", {})
    assert "the 5 runs left for model selection would not have shown most effects" in weak
    assert "More runs, ten or more, are needed" in weak


def test_ceilings_are_told_with_the_smooth_function_and_the_sensors(lag: Discovery) -> None:
    """A hidden lag of 0.5 s is much of the error of IDM's predictions, so a smooth function takes much of it, too."""
    gain, error = lag.result.ceilings.smooth_function_gain, lag.result.error
    assert gain is not None and 0.05 < gain < 1.0 and error.before is not None
    text = words.ceilings(lag.result.ceilings, error.before["gap_rmse_m"], error.floor["gap_rmse_m"])
    assert f"error 5 s ahead by {100 * gain:.1f} %" in text and "sensor noise alone leaves 0.0" in text


def test_what_is_not_compared_has_cards_all_the_same() -> None:
    """Where it lies and how much it is, or what to do: on the first screen, of every verdict without a second model."""
    data = SimpleNamespace(runs=4, runs_to_choose_on=3)
    error = SimpleNamespace(before={"gap_rmse_m": 2.0}, floor={"gap_rmse_m": 0.5})
    shared = Shared("a", 10.0, 20.0, -0.4, 3, 0.001)
    for said, common, names in (("cannot_tell", None, ["Runs", "What to do"]),
                                   ("located", shared, ["Runs", "Where", "How much"])):  # fmt: skip
        result = SimpleNamespace(verdict=said, data=data, shared=common, error=error, helps={}, fleet=None, reason=None)
        cards = pages.cards(result, "IDM")  # type: ignore[arg-type]
        assert [name for name, _, _ in cards] == [*names, "Gap in free simulation, IDM"]
        assert all(card for _, _, card in cards) and "2 m on held-out runs" in cards[-1][2]
    assert cards[1][2] == "run a, 10 to 20 s, 3 followers"


def test_what_has_no_practical_size_gets_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Data without noise from another integrator: errors of millimetres, in which candidates gain beyond chance."""
    monkeypatch.setattr(synthetic, "SUBSTEPS", 1)
    made, _ = synthetic.generate(5, runs=8, followers=4, seconds=60.0, noise=0.0, speed_noise=0.0)
    report = discover(made, effects=["second_leader", "leader_acceleration"]).report
    first = report["candidates"][0]
    assert first["effect"] == "second_leader" and first["p_value"] < 0.05 and first["held_out_gain"] > 0.02
    assert (report["verdict"], report["reason"], report["found"]) == ("none", "small_size", [])
    assert report["sentence"].startswith("Nothing of practical size is missing: second leader moves predictions 5 s")


def test_a_latency_below_half_a_step_gets_no_name() -> None:
    model = Hypothesis((terms.simple("drag"), terms.simple("delay")))
    for seconds, short in ((0.017, True), (0.06, False)):
        s = SimpleNamespace(model=model, values=np.array([1e-4, seconds]))
        assert together.is_too_short(s, model.terms[1:], 0.1) is short  # type: ignore[arg-type]
        assert not together.is_too_short(s, model.terms[:1], 0.1)  # type: ignore[arg-type]


def test_a_run_that_cannot_show_an_effect_has_no_say() -> None:
    """Of six runs four had stops and gained 20 % each by what follows one: p = 0.2, as signs of four can have."""
    assert shows_in_few(np.array([0.2, 0.25, 0.0, 0.15, -0.002, 0.2]))
    assert not shows_in_few(np.array([0.2, 0.25, 0.0, -0.15, 0.0, 0.2]))  # one that shows it loses
    assert not shows_in_few(np.array([0.2, 0.25, 0.0, 0.0, -0.002, 0.0]))  # two may be chance
    assert not shows_in_few(np.array([0.02, 0.025, 0.0, 0.015, -0.002, 0.02]))  # sets with nothing in them come near
