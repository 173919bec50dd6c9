"""What the test set says: how every model is calibrated and judged alike, and what of the additions holds there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from idm_env.discovery import bases, calibrate, closed_loop, crossed, judge, ladder as ladders, words
from idm_env.discovery.compare import Comparison, compare
from idm_env.discovery.fleet import Kinds
from idm_env.discovery.ladder import Ladder
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.records import Records
from idm_env.discovery.search import Search
from idm_env.discovery.selection import Decided
from idm_env.discovery.shared import Shared
from idm_env.discovery.solve import Problem, Solution
from idm_env.discovery.verdict import Reason, Refusal, improves
from idm_env.reports.undecided import GROUPS

Calibration = tuple[Solution, judge.Judged | None]
"""Parameters of all drivers, and errors on held-out runs where there are any."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """Two models on held-out runs: IDM, and IDM with what was added, or with what came nearest to that.

    ``refusal`` says why nothing (more) was added; ``compared`` is None where nothing came near.
    """

    null: Solution
    compared: Solution | None
    added: bool
    refusal: Refusal | None
    before: judge.Judged | None
    after: judge.Judged | None
    seed: int
    intervals: np.ndarray | None = None
    """Estimates of φ with their intervals [Q, 3], where they are not those of predictions in windows."""
    shared: Shared | None = None
    """What vehicles of one run do alike, beyond the model."""
    law: bases.Law | None = None
    """A law that predicts better than the null, and than what was added to it."""
    fleet: Kinds | None = None
    """Laws of several kinds of drivers, which predict better than one model for all."""
    sought: Judgement | None = None
    """What was found on ``law``, where that did not hold."""
    on: bases.Law | None = None
    """The law that the null is, where that was found to be better than the one that was to be completed."""
    beneath: Judgement | None = None
    """The judgement of the law that was to be completed, where the null is another one."""
    ladder: Ladder | None = None
    """What is left of predictions 5 s ahead, rung by rung, where every run is held out once."""

    @cached_property
    def errors(self) -> dict[str, Comparison]:
        """How the errors on held-out runs changed; empty where nothing can be compared."""
        if self.compared is None or self.before is None or self.after is None:
            return {}
        return compare(self.before, self.after, self.seed)

    @property
    def improves(self) -> bool:
        """Whether the compared model may be called better than the null."""
        return improves(self.errors)

    def is_exact(self, least_m: float) -> bool:
        """Tell whether the null's errors 5 s ahead are of no practical size, so that nothing can be missing."""
        return self.before is not None and self.before.summary()["horizon_rmse_m"] < least_m

    def beside(self, best: bases.Law) -> Judgement:
        """Return the judgement beside the best law: where that is better than an addition, nothing is added.

        What takes an addition's place must hold against it as it had to hold against the null.
        """
        if not best.against:
            return self
        if self.added and self.after is not None and not improves(compare(self.after, best.errors, self.seed)):
            return self
        return self._giving_way(law=best)

    @property
    def of_all(self) -> judge.Judged | None:
        """Errors of the model for all drivers that is chosen: the other law, what was added to the null, or that."""
        if self.law is not None:
            return self.law.errors
        return self.after if self.added else self.before

    def split(self, fleet: Kinds | None) -> Judgement:
        """Return the judgement beside laws for several kinds of drivers, which were better than ``of_all``."""
        return self if fleet is None else self._giving_way(fleet=fleet)

    def _giving_way(self, **better: Any) -> Judgement:
        """Return the judgement beside a better model; where runs are too few, that stays the reason."""
        if self.refusal is not None and self.refusal.reason is Reason.FEW_RUNS:
            return replace(self, **better)
        return replace(self, **better, added=False, refusal=Refusal(Reason.LAW))

    def climbed(self, records: Records, pooled: judge.Judged | None, floor_m: float) -> Ladder:
        """Return the ladder, from the ``pooled`` null to what sensors alone leave 5 s ahead (m)."""
        assert self.before is not None and pooled is not None
        models = {"one set of parameters for all": pooled, (own := "parameters of every driver"): self.before}
        last = own
        if (other := self.fleet or self.law) is not None:
            models[last := other.title] = other.errors
        elif self.added and self.after is not None:
            models[last := f"with {self.tried}"] = self.after
        return ladders.climb(records, models, own, last, floor_m, self.seed)

    @property
    def terms(self) -> tuple[Term, ...]:
        """What the compared model has more than the null."""
        return () if self.compared is None else self.compared.model.terms[len(self.null.model.terms) :]

    @property
    def tried(self) -> str:
        """Plain names of ``terms``."""
        return " and ".join(words.plain(t.name) for t in self.terms)

    @property
    def titles(self) -> tuple[str, ...]:
        """Plain names of the models: the null and, where there is one, the model beside it."""
        null_terms = [words.plain(t.name) for t in self.null.model.terms]
        lists = [null_terms] if self.compared is None else [null_terms, [*null_terms, self.tried]]
        law = self.null.model.catalogue.base.title
        return tuple(" with ".join([law, *([" and ".join(names)] if names else [])]) for names in lists)

    @property
    def results(self) -> dict[str, judge.Judged]:
        """Errors by plain name: of the null, and of a better law or the model beside it; empty with too few runs."""
        if self.before is None:
            return {}
        if self.law is not None:
            return {self.titles[0]: self.before, self.law.title: self.law.errors}
        several = (self.before, self.after) if self.after is not None else (self.before,)
        return dict(zip(self.titles, several, strict=False))

    def names(self) -> dict[str, str]:
        """Return which model every file holds: the law alone, the model beside it, another law, those of kinds.

        ``model.yaml`` is the one for all drivers that the verdict is about.
        """
        corrected = ["model_corrected.yaml"] if self.compared is not None else []
        files = (
            ["model.yaml", *corrected] if self.beneath is None else ["model_law.yaml", "model.yaml", "model_idm.yaml"]
        )
        if self.law is not None:
            files = ["model_idm.yaml", *corrected, "model.yaml"]
        elif self.beneath is None and self.added:
            files = ["model_idm.yaml", "model.yaml"]
        titles = [*self.titles, *([self.law.title] if self.law is not None else [])]
        titles += [] if self.beneath is None else [self.beneath.titles[0]]
        if self.fleet is not None:
            files += GROUPS[: len(self.fleet.laws)]
            each = zip(self.fleet.laws, self.fleet.counts, strict=True)
            titles += [f"{law.title}, of {count} drivers" for law, count in each]
        return dict(zip(files, titles, strict=True))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One way to calibrate and to judge the ``null``, what is added and other laws: better calibrated looks better.

    ``test`` are the runs of the test set, None where there are too few. Drivers who ``adapt`` have parameters of their
    own; their errors are those of cross-fitting, in which every run of ``records`` is held out once.
    """

    searching: Search
    null: Solution
    records: Records
    test: Records | None
    adapt: bool
    seed: int
    known: judge.Judged | None = None
    """Errors of the model that is completed, where it was judged before; the null may have a latency more."""

    @cached_property
    def _fold(self) -> np.ndarray:
        return crossed.folds_of(self.records.runs, () if self.test is None else self.test.runs, self.seed)

    @cached_property
    def _null_values(self) -> np.ndarray:
        """φ of the null [folds, Q] without the runs of each fold, which every law takes as it is."""
        return crossed.values_of(self.searching.problem, self.null, self.records.runs, self._fold)

    @cached_property
    def of_null(self) -> Calibration:
        """Calibration of the null, with errors that are ``known`` already."""
        if self.known is None or self.null.model.terms != self.searching.base.terms:
            return self.judged(self.null)
        return self.calibrated(self.null.model, self.null.values, self.null.theta)[0], self.known

    def calibrated(self, model: Hypothesis, values: np.ndarray, start: np.ndarray | None = None) -> Calibration:
        """Return a model with values [Q], calibrated from log θ [G, P]; errors only where drivers do not adapt."""
        fit = self.searching.calibrated(model, values, start)
        # Drivers who adapt have parameters of their own, for which their own runs are needed.
        own = calibrate.drivers_of(fit, self.records if self.adapt else self.searching.problem.rows.records)
        judged = None if self.adapt or self.test is None else judge.judge(self.test, model, values, own.theta)
        return own, judged

    def judged(self, s: Solution, problem: Problem | None = None, pooled: bool = False) -> Calibration:
        """Return the calibration of a model; ``problem`` is what φ was fitted to, if not predictions in windows.

        With ``pooled`` all drivers have one set of parameters.
        """
        theta, errors = self.calibrated(s.model, s.values, s.theta)
        if self.adapt and self.test is not None:
            values = crossed.values_of(problem or self.searching.problem, s, self.records.runs, self._fold)
            errors = crossed.crossed(self.records, s.model, values, self._fold, theta.theta, pooled)
        return theta, errors

    def of_law(self, model: Hypothesis) -> judge.Judged:
        """Return the errors of another law, calibrated and judged as the null."""
        if self.adapt:
            return crossed.crossed(self.records, model, self._null_values, self._fold)
        errors = self.calibrated(model, self.null.values)[1]
        assert errors is not None
        return errors

    def among(self, model: Hypothesis, wanted: np.ndarray) -> judge.Judged:
        """Return the errors of a law for the drivers of the records ``wanted`` [records], its population."""
        records = self.records.some(wanted)
        fold = self._fold[[self.records.runs.index(run) for run in records.runs]]
        return crossed.crossed(records, model, self._null_values, fold)

    def calibrated_among(self, model: Hypothesis, wanted: np.ndarray) -> Solution:
        """Return the parameters by a law of the drivers of records ``wanted`` [records], its population."""
        records = self.records.some(wanted)
        return calibrate.drivers_of(calibrate.calibrate(records, model, self.null.values), records)


def judgement_of(evaluation: Evaluation, decided: Decided) -> tuple[Judgement, Solution]:
    """Evaluate the selected model on held-out runs; return the judgement and the drivers' parameters fitted with it."""
    null, rounds = decided.null, decided.rounds
    confirmed, refusal = _confirmed(evaluation, decided)
    # Where nothing was added, what came nearest is compared with the null and says what it would have done.
    nearest = rounds[0].partial if evaluation.test is not None else None
    compared = confirmed[-1] if confirmed else None if nearest is None else rounds[0].scored[nearest].solution
    if evaluation.known is not None and not confirmed and decided.joined is None:
        # Beyond a law that was judged before, only what is added is judged: what came nearest is told by name.
        return Judgement(null, compared, False, refusal, evaluation.known, None, evaluation.seed), null
    last, before = evaluation.of_null
    last, after = (last, before) if compared is None else evaluation.judged(compared)
    judgement = Judgement(null, compared, bool(confirmed), refusal, before, after, evaluation.seed)
    if judgement.added and judgement.errors and not judgement.improves:
        judgement = replace(judgement, added=False, refusal=Refusal(Reason.HELD_OUT))
        # What the last additions spoil does not speak against the first.
        for s in reversed(confirmed[:-1]):
            theta, errors = evaluation.judged(s)
            fewer = replace(judgement, compared=s, added=True, refusal=None, after=errors)
            if fewer.improves:
                judgement, compared, last = fewer, s, theta
                break
        if not judgement.added and compared is not None:
            # The right effect with a strength fitted in windows may be off over minutes: these fit it once more.
            again, intervals = closed_loop.refitted(evaluation.searching.problem.rows.records, compared)
            theta, after = evaluation.judged(again, decided.null_in_closed_loop.problem)
            other = _in_closed_loop(judgement, evaluation, again, intervals, after)
            if other.improves:
                judgement, last = other, theta
    if decided.joined is not None and before is not None:
        # What was found in closed loop takes the place of what windows found where it does better there.
        joined = decided.joined
        theta, after = evaluation.judged(joined.solution, decided.null_in_closed_loop.problem)
        now = judgement.after if judgement.added and judgement.after is not None else before
        assert after is not None
        if after.summary()["gap_rmse_m"] < now.summary()["gap_rmse_m"]:
            other = _in_closed_loop(judgement, evaluation, joined.solution, joined.intervals, after)
            if other.improves:
                judgement, last = other, theta
    return judgement, last


def _confirmed(evaluation: Evaluation, decided: Decided) -> tuple[list[Solution], Refusal | None]:
    """Return the additions that the test set confirms, and why no more.

    It is looked into once for every addition, and only to end there.
    """
    confirmed: list[Solution] = []
    test = evaluation.test
    if test is None:
        return confirmed, decided.rounds[0].refusal
    for s in decided.steps:
        final = confirmed[-1] if confirmed else decided.null
        if judge.confirmed(test, evaluation.searching.problem, final, s) <= 0:
            return confirmed, Refusal(Reason.TEST_SET)
        confirmed.append(s)
    return confirmed, decided.rounds[0].refusal


def _in_closed_loop(
    judgement: Judgement, evaluation: Evaluation, s: Solution, intervals: np.ndarray, after: judge.Judged | None
) -> Judgement:
    """Return the judgement of what was fitted in closed loop, with its intervals [Q, 3] and errors."""
    compared = closed_loop.in_windows(evaluation.searching.problem, s)
    return replace(judgement, compared=compared, added=True, refusal=None, after=after, intervals=intervals)
