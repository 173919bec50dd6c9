"""From what a search decided to a discovery: judged on held-out runs, beside other laws, told, and saved as models."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from idm_env.data import Trajectories
from idm_env.data.fingerprint import fitted_on
from idm_env.discovery import bases, ceilings, fleet, found, judge, places, replica, shared, summary, tails
from idm_env.discovery.compare import compare
from idm_env.discovery.judgement import Evaluation, Judgement, judgement_of
from idm_env.discovery.ladder import UNEVEN
from idm_env.discovery.model import Hypothesis, effects_of
from idm_env.discovery.records import Records
from idm_env.discovery.result import Result
from idm_env.discovery.rolled import roll
from idm_env.discovery.selection import Decided, Round
from idm_env.discovery.solve import Problem, Solution
from idm_env.discovery.verdict import Reason, Refusal, Verdict, improves
from idm_env.effects import Brakes
from idm_env.jobs import storage
from idm_env.model_file import Model as SavedModel


@dataclass(eq=False)
class Discovery:
    """What is said, models by the name of their file, and what the pictures are drawn from.

    ``final`` has what was added or, where nothing was, what came nearest; ``judgement`` compares it with ``null``.
    """

    result: Result
    models: dict[str, SavedModel]
    records: Records
    null: Solution
    final: Solution
    problem: Problem
    rounds: list[Round]
    judgement: Judgement

    @property
    def verdict(self) -> Verdict:
        """What is concluded."""
        return Verdict(self.result.verdict)

    @cached_property
    def report(self) -> dict[str, Any]:
        """The content of ``report.json``."""
        return storage.plain(self.result)

    @property
    def found_effect(self) -> str:
        """What was found in a state of the driver and has no name, as the text of a file with effects; "" for none."""
        estimates = {f.label: f.parameters for f in self.result.found}
        added = [(term, estimates[term.label]) for term in self.judgement.terms if term.label in estimates]
        return found.source(added, self.result.sentence)

    @property
    def model(self) -> SavedModel:
        """The model that the verdict is about."""
        return self.models["model.yaml"]


Searched = Callable[[Hypothesis, judge.Judged | None], tuple[Evaluation, Decided]]


def finished(
    trajectories: Trajectories, evaluation: Evaluation, decided: Decided, refused: dict[str, str], by: str,
    on_law: bases.OnLaw, searched: Searched,
) -> Discovery:  # fmt: skip
    """Return what is said of what was decided.

    Args:
        trajectories: The data.
        evaluation: How models are calibrated and judged.
        decided: What the search says.
        refused: Why candidates could not be tested, by name.
        by: Who shares parameters.
        on_law: Called before each law that is compared, with its number, how many there are, and its title.
        searched: Searches effects beyond another model, whose errors are given.
    """
    judgement, last = judgement_of(evaluation, decided)
    before, of_laws, seed = evaluation.of_null[1], evaluation, evaluation.seed
    laws = [] if before is None else bases.compared(decided.null.model, before, evaluation.of_law, seed, on_law)
    least = judge.least_m(evaluation.records)
    scored = evaluation.records if evaluation.test is None else evaluation.test
    floor = ceilings.floor(scored, ceilings.drift(trajectories))
    if judgement.is_exact(least):
        judgement = replace(judgement, added=False, refusal=judgement.refusal or Refusal(Reason.SMALL_SIZE, least))
    elif laws:
        best = best_beyond_noise(laws, of_laws, floor["horizon_rmse_m"])
        evaluation, decided, judgement, last = _on_the_best((evaluation, decided, judgement, last), best, searched)
        if evaluation.adapt and judgement.of_all is not None:
            kinds = fleet.found(laws, judgement.of_all, of_laws.among, seed)
            if kinds is None or kinds.column or _stand_out(laws, of_laws, floor["horizon_rmse_m"], two=True):
                judgement = judgement.split(kinds)
    null, prepared, problem = decided.null, evaluation.records, evaluation.searching.problem
    first, before = evaluation.of_null
    final = judgement.compared if judgement.added and judgement.compared is not None else null
    everywhere = judge.windowed(prepared, problem, final)
    if not judgement.is_exact(least):
        judgement = replace(judgement, shared=shared.find(places.respond(*everywhere), seed))
    if evaluation.adapt and before is not None:
        pooled = evaluation.judged(null, pooled=True)[1]
        ladder = judgement.climbed(prepared, pooled, floor["horizon_rmse_m"])
        if not (judgement.added or judgement.law or judgement.fleet or judgement.is_exact(least)):
            leading = decided.rounds[0].leading
            noisy, agree = replica.agreement(*everywhere, floor["horizon_rmse_m"], seed, leading)
            errors = replica.ahead(everywhere[0], everywhere[1].theta, noisy.model)
            uneven = float(np.sqrt(np.mean(errors**2)) / (1.48 * np.median(np.abs(errors)) + 1e-9))
            ladder = replace(
                ladder, worst=tails.worst(everywhere[0].rows, errors), uneven=uneven, past=agree["past"],
                unsteady=(float(np.median(noisy.sigma)), noisy.memory_s), agreement=agree["scene"],
                sizes=agree["sizes"], tails=agree["tails"], leading=agree.get("leading"),
                few=tails.held_by(everywhere[0].rows, errors) if uneven >= UNEVEN else (),
            )  # fmt: skip
        judgement = replace(judgement, ladder=ladder)
    of_law = None if judgement.law is None else evaluation.calibrated(judgement.law.model, null.values)[0]
    limits = ceilings.ceilings_of(decided.null_in_closed_loop, scored, null, decided.rounds[0].smooth_gain)
    judged = trajectories, evaluation, decided, judgement, laws, (first, last, of_law), floor
    result = summary.summarise(*judged, refused | evaluation.searching.unplaced, by, limits)
    saved = _saved(trajectories, evaluation, judgement, of_laws, (first, last, of_law), by)
    models = dict(zip(judgement.names(), saved, strict=True))
    speed = float(np.median(prepared.speed[prepared.speed > 1.0])) if (prepared.speed > 1.0).any() else 1.0
    # The model of the verdict first, beside the law that was to be completed.
    rolls = {f: roll(models[f], speed) for f in ("model.yaml", "model_idm.yaml") if f in models}
    result = replace(result, rolled={file: one for file, one in rolls.items() if one is not None})
    return Discovery(result, models, prepared, null, judgement.compared or null, problem, decided.rounds, judgement)


def best_beyond_noise(laws: list[bases.Law], of_laws: Evaluation, noise_m: float) -> bases.Law:
    """Return the best law, or the null where drivers who follow that would prefer the other by their noise alone."""
    null, best = laws[0], bases.best_of(laws)
    held = best is null or not of_laws.adapt or _stand_out([null, best], of_laws, noise_m, two=False)
    return best if held else null


def _stand_out(laws: list[bases.Law], of_laws: Evaluation, noise_m: float, two: bool) -> bool:
    """Tell whether the last law, or ``two`` for drivers, gain more than where all have the null's and own residuals."""
    problem, null = judge.windowed(of_laws.records, of_laws.searching.problem, of_laws.null)
    return replica.stands_out(problem, null, noise_m, of_laws.seed, fleet.gain_of(laws, null.values, two))


Found = tuple[Evaluation, Decided, Judgement, Solution]


def _on_the_best(before: Found, best: bases.Law, searched: Searched) -> Found:
    """Return what is found on the best law where that is another one, if it is better than all that was found before.

    It has to hold by the rules of every addition, against its law, and against the law or IDM with what was added. On a
    law that errs more than IDM with what was added, nothing is sought.
    """
    evaluation, decided, judgement, last = before
    now = judgement.beside(best)
    few = judgement.refusal is not None and judgement.refusal.reason is Reason.FEW_RUNS
    # A law with all candidates as its drivers' own strengths leaves nothing to try.
    search, own = evaluation.searching, best.model.catalogue
    has_candidates = search.located or not set(search.names) <= set(own.personal)
    if not best.against or few or not has_candidates or not evaluation.adapt or now.of_all is None:
        return evaluation, decided, now, last
    if now.added and improves(compare(best.errors, now.of_all, evaluation.seed)):
        return evaluation, decided, now, last
    # In a law's loop there is room for all candidates.
    room = search.base.catalogue
    effects = tuple((best.model.catalogue.by_name | room.by_name).values())
    catalogue = replace(room, effects=effects, base=best.law, personal=own.personal, without=own.without)
    beyond, more = searched(Hypothesis(best.model.terms, catalogue), best.errors)
    other, its_last = judgement_of(beyond, more)
    if other.added and other.after is not None and improves(compare(now.of_all, other.after, evaluation.seed)):
        return beyond, more, replace(other, on=best, beneath=judgement), its_last
    return evaluation, decided, replace(now, sought=other), last


def _saved(
    trajectories: Trajectories,
    evaluation: Evaluation,
    judgement: Judgement,
    of_laws: Evaluation,
    drivers: tuple[Solution, Solution, Solution | None],
    by: str,
) -> list[SavedModel]:
    """Return the models in the order of ``Judgement.names``."""
    (first, last, of_law), prepared = drivers, evaluation.records
    # Drivers who adapt are calibrated on parts of the held-out runs too.
    fit = prepared if evaluation.adapt else evaluation.searching.problem.rows.records
    seen = fitted_on(trajectories, [(e.run_id, e.vehicle_id) for e in fit.episodes])
    parts = [(prepared, evaluation.null, first)]
    if judgement.compared is not None:
        parts.append((prepared, judgement.compared, last))
    if of_law is not None:
        parts.append((prepared, of_law, of_law))
    if judgement.beneath is not None:
        parts.append((prepared, of_laws.null, of_laws.of_null[0]))
    if judgement.fleet is not None:
        for law, mine in zip(judgement.fleet.laws, judgement.fleet.records, strict=True):
            its = of_laws.calibrated_among(law.model, mine)
            parts.append((prepared.some(mine), its, its))
    names = {f"{run}/{vehicle}": trajectories.name_of(run, vehicle) for run, vehicle in trajectories.followers()}
    models = [corrected(part, s, theta.theta, by) for part, s, theta in parts]
    return [
        replace(m, fitted_on=seen, drivers={names.get(key, key): own for key, own in m.drivers.items()}) for m in models
    ]


def corrected(prepared: Records, final: Solution, theta: np.ndarray, by: str) -> SavedModel:
    """Return the corrected model as it is saved: effects, shared parameters, the median driver and every driver.

    ``theta`` [G, P] is log θ of all groups, of which those of ``prepared`` are saved.
    """
    added, numbers = effects_of(final.model, final.values)
    # Effects that adapt a driver are chained as in discovery's loop.
    added.sort(key=lambda e: e.rank if e.hook == "adapt" else 0)
    seen = np.unique(prepared.group)
    middle = np.exp(np.median(theta[seen], axis=0))

    def bounded(values: np.ndarray) -> dict[str, dict[str, float]]:
        by_effect: dict[str, dict[str, float]] = {}
        for v, (name, p) in zip(values, final.model.catalogue.of_driver, strict=True):
            by_effect.setdefault(name, {})[p.name] = float(np.clip(v, p.low, p.high))
        return by_effect

    drivers = {prepared.groups[group]: bounded(np.exp(theta[group])) for group in seen}
    return SavedModel(
        effects=(final.model.catalogue.base, *added, Brakes()),
        parameters={**numbers, **bounded(middle)},
        dt=prepared.dt,
        integration="midpoint",
        drivers=drivers if by != "all" else {},
        by=by,
    )
