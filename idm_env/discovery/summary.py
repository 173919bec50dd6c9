"""Makes the result of a discovery: what was found, what it does for errors on held-out runs, and all that was tried."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from idm_env.data import Trajectories, noise_sigma
from idm_env.discovery import bases, crossed, fleet, judge, result, words
from idm_env.discovery.compare import RUNS, Comparison, changes, compare
from idm_env.discovery.judgement import Evaluation, Judgement
from idm_env.discovery.ladder import TOGETHER, Ladder
from idm_env.discovery.march import CURVE
from idm_env.discovery.model import STATES, Term
from idm_env.discovery.power import Strength, powerful, strength_of
from idm_env.discovery.score import contrast_of, interval_of, rivals
from idm_env.discovery.selection import Decided, Round
from idm_env.discovery.solve import Problem, Solution
from idm_env.discovery.units import MANY_RUNS, smallest_p, units
from idm_env.discovery.verdict import Reason, Refusal, Verdict, conclude
from idm_env.effects import ALL
from idm_env.reports.page import versions

INTERVAL = (
    f"95 % by bootstrap of whole runs, or of followers where fewer than {RUNS} runs are held out; Student's t. "
    "Better or worse: one of both intervals lies on one side of no change; worse goes before better."
)
"""How the intervals of ``helps`` are made."""
LARGE = 3.0
"""Times the sensors' noise above which errors 5 s ahead are not explained by it."""


def summarise(
    trajectories: Trajectories, evaluation: Evaluation, decided: Decided, judged: Judgement,
    laws: Sequence[bases.Law], drivers: tuple[Solution, Solution, Solution | None], floor: result.Errors,
    refused: dict[str, str], by: str, ceilings: result.Ceilings,
) -> result.Result:  # fmt: skip
    """Return everything that is said.

    Args:
        trajectories: The data.
        evaluation: How models were calibrated and judged.
        decided: What the search says.
        judged: Models compared on held-out runs.
        laws: All laws alone, that of the null first.
        drivers: Their parameters by the null, by the model beside it, and by a law that is better.
        floor: Errors that sensors alone would leave.
        refused: Why candidates could not be tested, by name.
        by: Who shares parameters.
        ceilings: How much could be explained at all.
    """
    problem, rounds = evaluation.searching.problem, decided.rounds
    compared, before, first, errors = judged.compared, judged.before, rounds[0], judged.errors
    law, base = judged.null.model.catalogue.base.title, len(judged.null.model.terms)
    final = compared if compared is not None and judged.added else judged.null
    terms = [] if compared is None else _findings(judged, compared, rounds, problem)
    added, nearest = (terms, []) if judged.added else ([], terms)
    test_runs = [] if evaluation.test is None else list(evaluation.test.runs)
    strengths = _strengths(first, problem)
    others = [name for f in added if f.effect for name in f.equivalent if name in ALL]
    left = (float("nan") if before is None else before.summary()["horizon_rmse_m"]), floor["horizon_rmse_m"]
    least = judge.least_m(evaluation.records)
    is_large = left[0] > LARGE * left[1] and not judged.is_exact(least)
    verdict, refusal = _verdict(judged, rounds, added, others, strengths, problem, least, is_large)
    data = _data(trajectories, evaluation, judged.null, by)
    sentence = words.headline(
        verdict, [f.clause for f in added], refusal, judged.tried, errors, judged.shared, others, law
    )
    if verdict is Verdict.UNDECIDED or (verdict is Verdict.NONE and is_large) or refusal == Refusal(Reason.TAILS):
        sentence = words.beside_noise(verdict, law, *left, judged.ladder)
    after = judged.after if judged.added else before
    of_laws, of_law = _of_laws(judged, drivers[0] if judged.on is not None else drivers[2])
    sentence = " ".join(filter(None, (*of_laws, sentence)))
    weight, beyond, base_law = decided.null_in_closed_loop, _against_first(judged), (judged.beneath or judged).titles[0]
    return result.Result(
        schema=result.SCHEMA,
        verdict=verdict.value,
        reason=None if refusal is None else refusal.reason.value,
        sentence=sentence,
        details=[
            *of_law,
            *words.details(added, nearest),
            *([f"Against {base_law}, {judged.titles[-1]}: {words.change_of(beyond)}."] if beyond else []),
            *words.agreement(judged.ladder, first.leading),
            *words.cautions(data.at_bounds if judged.law is None else judged.law.at_bounds, data.drivers),
        ],
        found=added,
        known=_known(final, interval_of(final, problem), base),
        helps=changes(errors),
        ladder=judged.ladder,
        interval=INTERVAL if errors else None,
        models=judged.names(),
        error=result.HeldOutErrors(
            test_runs, _drivers(before, after), None if before is None else before.summary(),
            None if before is None or after is None else after.summary(), floor,
        ),
        partial=None if judged.added or compared is None else _nearest(judged, nearest, first),
        candidates=candidates_of(rounds, refused),
        shared=judged.shared,
        excluded=[
            result.Excluded(name, s.parameter.name, s.parameter.unit, s.estimate, s.low, s.high, s.typical)
            for name, s in strengths.items()
        ],
        parameters=_parameters(drivers[0], drivers[1], np.unique(evaluation.records.group)),
        data=data,
        seed=judged.seed,
        versions=versions(),
        prior=result.Weight(
            weight.problem.prior.error_correlation_s, list(weight.rmse_m), list(weight.rmse_m.values())
        ),
        ceilings=ceilings,
        bases=bases.rows(laws),
        completed=None if (on := judged.on) is None
        else result.Completed(on.law.kind, on.title, list(on.own), changes(beyond)),
        fleet=None if judged.fleet is None else fleet.told(judged.fleet),
        rolled={},
    )  # fmt: skip


def _against_first(judged: Judgement) -> dict[str, Comparison]:
    """Return how a better law with what was added to it compares with the law that was to be completed, if there is."""
    if judged.beneath is None or judged.beneath.before is None or judged.after is None:
        return {}
    return compare(judged.beneath.before, judged.after, judged.seed)


def _of_laws(judged: Judgement, drivers: Solution | None) -> tuple[list[str], list[str]]:
    """Return what is said of laws before effects, and in detail; ``drivers`` are the parameters of a better one."""
    law, kinds = judged.on or judged.law, judged.fleet
    first, more = ([], []) if kinds is None else ([words.fleet_first(kinds)], words.fleet_details(kinds))
    if law is not None:
        first.append(words.law_first(law, (judged.beneath or judged).titles[0], drivers))
        more += words.law_details(law, judged.on is not None)
    if judged.law is not None and judged.sought is not None:
        why = words.reason(judged.sought.refusal, judged.sought.tried) or "no error falls beyond chance"
        more.append(f"No effect added to it holds: {why}.")
    return first, more


def _verdict(
    judged: Judgement, rounds: Sequence[Round], added: Sequence[result.TermFinding], others: Sequence[str],
    strengths: dict[str, Strength], problem: Problem, least: float, is_large: bool,
) -> tuple[Verdict, Refusal | None]:  # fmt: skip
    """Return what is concluded, and why nothing (more) was added."""
    first, refusal, ladder = rounds[0], judged.refusal, judged.ladder
    counted = units(problem.rows.records)
    power = len(problem.rows.records.runs) >= MANY_RUNS or powerful(
        [s for s in strengths.values() if s.knots == 1], first.tested, smallest_p(counted.run)
    )
    leads = first.leading is not None and (ladder is None or ladder.leading is None or ladder.leading.is_refused)
    structured = leads or any(r.leading is not None for r in rounds if r.in_closed_loop)
    unnamed = 0.0 if ladder is None else ladder.unnamed
    verdict = conclude(
        bool(added), any(f.effect for f in added), refusal, structured or unnamed > 0.0, first.left, power,
        judged.shared is not None, apart=not others,
        in_a_state=all(f.where.coordinate in (*STATES, "state", "period") for f in added),
        exact=judged.is_exact(least), alike=ladder is not None and ladder.stands,
    )  # fmt: skip
    if verdict is Verdict.NONE and refusal is not None:
        small = judged.is_exact(least) or refusal.reason is Reason.SMALL_SIZE
        refusal = Refusal(Reason.SMALL_SIZE, least) if small else Refusal(Reason.NO_GAIN)
        return (verdict, refusal) if not is_large else unsure(ladder, refusal)
    if refusal is not None and refusal.reason not in (Reason.NO_GAIN, Reason.SMALL_SIZE):
        return verdict, refusal
    if verdict is Verdict.UNEXPLAINED and unnamed and refusal is not None:
        refusal = Refusal(Reason.STRUCTURE, unnamed)
    if verdict is Verdict.CANNOT_TELL and not power:
        refusal = Refusal(Reason.NO_POWER, len(problem.rows.records.runs))
    return verdict, refusal


def unsure(ladder: Ladder | None, refusal: Refusal) -> tuple[Verdict, Refusal]:
    """Return the verdict on errors far above the sensors' in which no candidate gains.

    Noise of drivers explains them where it looks like them in every test; an effect of an unknown form does, too.
    """
    tails = None if ladder is None else ladder.tails
    if tails is not None and tails.is_refused and tails.share - tails.usual > TOGETHER:
        return Verdict.UNEXPLAINED, Refusal(Reason.TAILS)
    return Verdict.NONE if ladder is not None and ladder.agrees else Verdict.UNDECIDED, refusal


def _strengths(first: Round, problem: Problem) -> dict[str, Strength]:
    """Return by name what the first round says of the strengths of effects that have one."""
    fitted = [(s.term, s.solution) for s in first.scored if s.solution is not None]
    each = {t.effect: strength_of(one, problem, t.label) for t, one in fitted if t.effect in ALL}
    return {name: strength for name, strength in each.items() if name is not None and strength is not None}


def _nearest(judged: Judgement, terms: list[result.TermFinding], first: Round) -> result.Nearest | None:
    """Return what came nearest where nothing was added, or None without a test set."""
    before, after = judged.before, judged.after
    if before is None or after is None:
        return None
    seen = np.isfinite(before.gap_rmse)
    improved = float((after.gap_rmse[seen] < before.gap_rmse[seen]).mean())
    return result.Nearest(judged.tried, terms, first.share, after.summary(), improved)


def _drivers(before: judge.Judged | None, after: judge.Judged | None) -> list[result.DriverError]:
    """Return every held-out driver once, however many pieces the record has."""
    if before is None or after is None:
        return []
    each = zip(before.followers, before.gap_rmse, after.gap_rmse, strict=True)
    return [result.DriverError("/".join(name), float(b), float(a)) for name, b, a in each if np.isfinite(b)]


def _where(term: Term, values: dict[str, float]) -> result.Location:
    if "begin" in values:
        end = None if term.coordinate == "time" and values["end"] > 9e5 else values["end"]
        return result.Location(term.coordinate, (values["begin"], end))
    if term.effect is not None and ALL[term.effect].sought == "step":
        return result.Location("time", (values["time"], None))
    first, distance, count = term.knots
    if count > 2:
        profile = None
        if term.effect is not None and ALL[term.effect].sought == "profile" and term.profile is None:
            profile = {"position_m": [first + distance * i for i in range(term.size)]}
        coordinate = "period" if term.cycles else term.coordinate
        return result.Location(coordinate, (first, first + distance * (count - 1)), profile)
    return result.Location("state" if term.coordinate in ("", "state") else term.coordinate, (None, None))


def _findings(
    judged: Judgement, compared: Solution, rounds: Sequence[Round], problem: Problem
) -> list[result.TermFinding]:
    """Return the terms of the model that is ``compared`` after those of the null."""
    intervals = interval_of(compared, problem) if judged.intervals is None else judged.intervals
    fold = crossed.folds_of(problem.rows.records.runs, (), judged.seed)
    law = judged.null.model.catalogue.base.title
    each = [(term, compared, rounds, intervals[compared.model.where(term.label)]) for term in judged.terms]
    return [_finding(*one, problem, law, fold) for one in each]


def _finding(
    term: Term, compared: Solution, rounds: Sequence[Round], intervals: np.ndarray, problem: Problem, law: str,
    fold: np.ndarray,
) -> result.TermFinding:  # fmt: skip
    this, winner = next(
        (r, i)
        for r in rounds for i in (r.winner, r.partner, r.partial)
        if i is not None and r.scored[i].term.label == term.label
    )  # fmt: skip
    estimates = {
        p.name: result.ParameterEstimate(p.symbol, float(x[0]), float(x[1]), float(x[2]), p.unit)
        for p, x in zip(term.parameters, intervals, strict=True)
    }
    contrast = contrast_of(compared, problem, term.label) if term.located and term.form == CURVE else None
    gains, run = np.array([s.gains for s in this.scored]), units(problem.rows.records).run
    close = [] if this.in_closed_loop else rivals(gains, winner, run)
    equivalent, near = ([this.scored[i].term.name for i in which] for which in (this.equivalent, close))
    effect = None if term.effect is None else ALL[term.effect]
    return result.TermFinding(
        effect=term.effect,
        label=term.label,
        title=words.plain(term.name),
        equation=words.CHANGES[term.what][3] if effect is None else effect.equation,
        clause=words.clause(term, intervals.tolist(), contrast, law),
        equivalent=equivalent,
        rivals=near,
        looks_like=[] if effect is None else list(effect.looks_like),
        told_by="" if effect is None else effect.told_by,
        parameters=estimates,
        what=term.what,
        where=_where(term, {name: e.estimate for name, e in estimates.items()}),
        p_value=float(this.tested.p_value[winner]),
        held_out_gain=float(1.0 - np.exp(-this.tested.gain[winner])),
        explained_share=this.share,
        chosen_in_folds=this.chosen_in(winner, fold),
    )


def _known(final: Solution, intervals: np.ndarray, base: int) -> list[result.GivenParameter]:
    named = [(term.effect, p.name) for term in final.model.terms[:base] for p in term.parameters]
    estimates = zip(named, intervals.tolist(), strict=False)
    return [result.GivenParameter(*name, estimate, low, high) for name, (estimate, low, high) in estimates]


def candidates_of(rounds: Sequence[Round], refused: dict[str, str]) -> list[result.Candidate]:
    """Return every candidate of every round, best first, then those ``refused`` by name and why."""
    rows = [_candidate(n, this, int(i)) for n, this in enumerate(rounds, 1) for i in np.argsort(-this.tested.gain)]
    more = [result.Candidate(0, None, n, True, None, None, (None, None), None, {}, {}, r) for n, r in refused.items()]
    return rows + more


def _candidate(number: int, this: Round, i: int) -> result.Candidate:
    s, low_high = this.scored[i], 1.0 - np.exp(-this.tested.interval[i])
    values = np.zeros(0) if s.solution is None else s.solution.values[s.solution.model.where(s.term.label)]
    shown = len(values) <= words.MANY
    return result.Candidate(
        round=number,
        errors="free simulation" if this.in_closed_loop else "windows",
        effect=s.term.name,
        named=s.term.effect is not None,
        p_value=float(this.tested.p_value[i]),
        held_out_gain=float(1.0 - np.exp(-this.tested.gain[i])),
        interval=(float(low_high[0]), float(low_high[1])),
        absorbed_share=absorbed(s.solution, s.term),
        parameters=dict(zip((p.name for p in s.term.parameters), values.tolist(), strict=False)) if shown else {},
        units={p.name: p.unit for p in s.term.parameters} if shown else {},
        note="" if s.solution is not None else "scored by its linear response only",
    )


def absorbed(solution: Solution | None, term: Term) -> float | None:
    """Return which share of the candidate's response re-calibrated drivers absorb, in its first parameter."""
    if solution is None or not solution.linear.by_phi.shape[-1]:
        return None
    first = solution.model.where(term.label).start
    total = float((solution.linear.by_phi[..., first] ** 2).sum())
    projected = float(np.einsum("gqq->gq", solution.reduced_hessian)[:, first].sum())
    return None if total <= 0 else float(np.clip(1.0 - projected / total, 0.0, 1.0))


def _parameters(before: Solution, after: Solution, seen: np.ndarray) -> list[result.Moved]:
    """Return the parameters of groups ``seen`` in two models, with standard errors from the curvature."""
    spreads = []
    for s in (before, after):
        values, errors = np.exp(s.theta[seen]), standard_errors(s)[seen]
        columns = zip(values.T, errors.T, strict=True)
        each = [(np.median(v), *np.quantile(v, (0.1, 0.9)), np.median(e * v)) for v, e in columns]
        spreads.append([result.Spread(*map(float, one)) for one in each])
    names = [p.name for p in before.model.catalogue.own]
    return [result.Moved(*row) for row in zip(names, *spreads, strict=False)]


def standard_errors(solution: Solution) -> np.ndarray:
    """Return standard errors of log θ [G, P]; a residual that is correlated over 5 s counts every 5 s once."""
    linear = solution.linear
    # The groups of a calibration are those of its normal equations; rows are summed by group there already.
    groups = len(solution.theta)
    matrix = np.tile(np.diag(solution.prior.width**-2.0), (groups, 1, 1))
    group = solution.row_group
    np.add.at(matrix, group, np.einsum("rmi,rmj->rij", linear.by_theta, linear.by_theta) / 10.0)
    square = np.bincount(group, (linear.residual**2).sum(1), groups)
    count = np.bincount(group, (linear.by_theta != 0).any(-1).sum(1), groups)
    variance = np.maximum(square / np.maximum(count, 1), 1e-9)
    inverse = np.linalg.inv(matrix / variance[:, None, None] + 1e-9 * np.eye(matrix.shape[-1]))
    return np.sqrt(np.einsum("gii->gi", inverse))


def _data(trajectories: Trajectories, evaluation: Evaluation, null: Solution, by: str) -> result.DataCard:
    prepared, rows = evaluation.records, evaluation.searching.problem.rows
    inside = np.concatenate([np.arange(a, b) for a, b in zip(prepared.first, prepared.bounds[1:], strict=True)])
    speed, gap = prepared.speed[inside], prepared.gap[inside]
    closing, free = speed - prepared.column("lead_speed")[inside], gap > 3.0 * np.maximum(speed, 2.0)
    standing = speed < 0.3
    residual = null.linear.residual
    return result.DataCard(
        **trajectories.summary(),  # type: ignore[arg-type]
        by=by,
        drivers=len(np.unique(prepared.group)),
        records=len(prepared),
        runs_to_choose_on=len(rows.records.runs),
        smallest_p_value=smallest_p(units(rows.records).run),
        windows=len(rows),
        gap_noise_m=float(np.median([noise_sigma(e.gap_m) for e in prepared.episodes])),
        residual_autocorrelation=float(np.mean(residual[:, 1:] * residual[:, :-1]) / max(np.mean(residual**2), 1e-12)),
        share_standing=float(standing.mean()),
        share_free=float((free & ~standing).mean()),
        share_approaching=float((~free & (closing > 1.0) & ~standing).mean()),
        share_following=float((~free & (closing <= 1.0) & ~standing).mean()),
        at_bounds=null.model.catalogue.at_bounds(null.theta),
        horizon_s=rows.steps * prepared.dt,
        lap_m=prepared.period or None,
    )
