"""The content of ``report.json``: what was found, what it does for errors on runs kept back, and all that was tried."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from idm_env.data import Trajectories, noise_sigma
from idm_env.discovery import bases, judge, words
from idm_env.discovery import ladder as ladders
from idm_env.discovery.compare import DRAWS, Comparison, compare, unit_of
from idm_env.discovery.ladder import Ladder
from idm_env.discovery.march import CURVE
from idm_env.discovery.model import STATES, Term
from idm_env.discovery.power import Bar, Strength, powerful, strength_of
from idm_env.discovery.records import Records
from idm_env.discovery.score import FREE_SHARE, contrast_of, interval_of, level, rivals
from idm_env.discovery.selection import LEAST_GAIN, Round
from idm_env.discovery.shared import Shared
from idm_env.discovery.solve import Solution, Task
from idm_env.discovery.units import MANY_RUNS, smallest_p, units
from idm_env.discovery.verdict import Reason, Refusal, Verdict, conclude, improves, mean_ratio
from idm_env.effects import ALL
from idm_env.reports.page import versions

SCHEMA = 3


@dataclass(frozen=True, eq=False)
class Judgement:
    """Two models on the runs kept back: IDM, and IDM with what was added, or with what came nearest to that.

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
    ladder: Ladder | None = None
    """What is left of predictions 5 s ahead, rung by rung, where every run is held out once."""

    @cached_property
    def errors(self) -> dict[str, Comparison]:
        """How the errors on runs kept back changed; empty where nothing can be compared."""
        if self.compared is None or self.before is None or self.after is None:
            return {}
        return compare(self.before, self.after, self.seed)

    @property
    def mean_ratio(self) -> float:
        """Geometric mean of the ratios of errors on runs kept back, compared model / null; 1 where there is none."""
        return mean_ratio(self.errors)

    @property
    def corrected_is_best(self) -> bool:
        """Whether the compared model predicts better than the null."""
        return self.mean_ratio < 1.0

    @property
    def improves(self) -> bool:
        """Whether the compared model may be called better than the null."""
        if self.before is None or self.after is None:
            return False
        return improves(self.errors)

    def beside(self, best: bases.Law) -> Judgement:
        """Return the judgement beside the best law: where that is better than an addition, nothing is added.

        What takes an addition's place must hold against it as it had to hold against the null.
        """
        if not best.against:
            return self
        if self.added and self.after is not None and not improves(compare(self.after, best.errors, self.seed)):
            return self
        if self.refusal is not None and self.refusal.reason is Reason.FEW_RUNS:
            return replace(self, law=best)
        return replace(self, law=best, added=False, refusal=Refusal(Reason.LAW))

    def climbed(self, records: Records, pooled: judge.Judged | None, floor_m: float) -> Ladder:
        """Return the ladder, from the ``pooled`` null to what sensors alone leave 5 s ahead (m)."""
        assert self.before is not None and pooled is not None
        models = {"one set of parameters for all": pooled, (own := "parameters of every driver"): self.before}
        last = own
        if self.law is not None:
            models[last := self.law.title] = self.law.errors
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
        return " and ".join(words.plain(t.effect or t.label) for t in self.terms)

    @property
    def titles(self) -> tuple[str, ...]:
        """Plain names of the models: the null and, where there is one, the model beside it."""
        known = [words.plain(t.effect or t.label) for t in self.null.model.terms]
        lists = [known] if self.compared is None else [known, [*known, self.tried]]
        law = self.null.model.catalogue.base.title
        return tuple(" with ".join([law, *([" and ".join(names)] if names else [])]) for names in lists)

    def names(self) -> dict[str, str]:
        """Return which model every file holds: the law alone, then the model beside it, then another law.

        ``model.yaml`` is the one that predicts best on the runs kept back.
        """
        if self.law is not None:
            files = ("model_idm.yaml", *(["model_corrected.yaml"] if self.compared is not None else []), "model.yaml")
            return dict(zip(files, (*self.titles, self.law.title), strict=True))
        if self.compared is None:
            return {"model.yaml": self.titles[0]}
        files = ("model_idm.yaml", "model.yaml") if self.corrected_is_best else ("model.yaml", "model_corrected.yaml")
        return dict(zip(files, self.titles, strict=True))


def report(
    trajectories: Trajectories, prepared: Records, fit_runs: list[str], kept_runs: list[str], task: Task,
    judged: Judgement, rounds: list[Any], refused: dict[str, str], thetas: list[Solution], by: str,
) -> dict[str, Any]:  # fmt: skip
    """Return the report as plain numbers and texts."""
    null, compared, before, after = judged.null, judged.compared, judged.before, judged.after
    base = len(null.model.terms)
    final = compared if compared is not None and judged.added else null
    entries: list[dict[str, Any]] = []
    if compared is not None:
        known = judged.intervals if judged.intervals is not None else interval_of(compared, task)
        entries = _found(compared, rounds, known, base, task)
    found = entries if judged.added else []
    first = rounds[0]
    structured = any(r.significant for r in (first, *(r for r in rounds if r.free)))
    run = units(task.rows.records).run
    strengths = _strengths(first, task, bar(first, run, judged.seed, len(kept_runs)))
    smallest = smallest_p(run)
    power = len(fit_runs) >= MANY_RUNS or powerful(
        [s for s in strengths.values() if s.knots == 1], first.tested, smallest
    )
    refusal, ladder = judged.refusal, judged.ladder
    unnamed = ladder is not None and ladder.is_structured
    structured = structured or unnamed
    common = judged.shared
    others = [name for f in found if f["effect"] for name in f["equivalent"] if name in ALL]
    verdict = conclude(
        bool(found), any(f["effect"] for f in found), refusal, structured, first.left, power, common is not None,
        apart=not others, in_a_state=all(f["where"]["coordinate"] in (*STATES, "state") for f in found),
    )  # fmt: skip
    if (
        verdict is Verdict.UNEXPLAINED
        and ladder is not None
        and unnamed
        and refusal is not None
        and refusal.reason is Reason.NO_GAIN
    ):
        refusal = Refusal(Reason.STRUCTURE, ladder.structure[0])
    if verdict is Verdict.CANNOT_TELL and not power and (refusal is None or refusal.reason is Reason.NO_GAIN):
        refusal = Refusal(Reason.NO_POWER, len(fit_runs))
    errors = judged.errors
    left = 1.0 - np.exp(-first.smooth_gain)
    content = {
        "schema": SCHEMA,
        "verdict": verdict.value,
        "reason": None if refusal is None else refusal.reason.value,
        "sentence": words.headline(
            verdict, [f["clause"] for f in found], refusal, judged.tried, errors, common, others, strengths,
        ),
        "details": [*words.details(verdict, found, [] if judged.added else entries, left),
                    *words.excluded(verdict, strengths)],
        "found": found,
        "known": _known(final, interval_of(final, task), base),
        "helps": {
            key: {"verdict": c.light.value, "ratio": c.ratio, "low": c.low, "high": c.high, "before": c.before,
                  "after": c.after, "unit": words.ERRORS[key][1], "drivers_ratio": c.driver[0],
                  "drivers_low": c.driver[1], "drivers_high": c.driver[2], "share_of_drivers_improved": c.improved}
            for key, c in errors.items()
        },
        "ladder": None if ladder is None else {
            "rungs_m": ladder.rungs, **ladder.others, "parts": ladder.parts, "structure": dict(
                zip(("share", "low", "high"), ladder.structure, strict=True)
            ),
        },
        "interval": _how(before) if errors and before is not None else None,
        "models": judged.names(),
        "error": {
            "held_out_runs": kept_runs,
            "held_out_drivers": _drivers(before, after if judged.added else before),
            "before": None if before is None else before.summary(),
            "after": None if after is None or before is None else (after if judged.added else before).summary(),
        },
        "partial": None if judged.added or compared is None else _partial(judged, entries, first),
        "candidates": _candidates(rounds, refused),
        "shared": None if common is None else vars(common),
        "excluded": [
            {"effect": name, "parameter": s.parameter.name, "unit": s.parameter.unit, "estimate": s.estimate,
             "low": s.low, "high": s.high, "would_be_found": s.seen, "typical": s.typical}
            for name, s in strengths.items()
        ],
        "parameters": _parameters(thetas, prepared),
        "data": _data(trajectories, prepared, fit_runs, task, null, by, rounds),
        "seed": judged.seed,
        "versions": versions(),
    }  # fmt: skip
    return _plain(content)


def bar(first: Round, run: np.ndarray, seed: int, kept: int) -> Bar:
    """Return what a candidate had to reach in the first round, on units of runs ``run``, and on ``kept`` runs."""
    # It has to explain half of what any smooth function of the state explains.
    rest = 0.5 * np.log(2.0 - np.exp(-2.0 * max(float(first.left.mean()), 0.0)))
    gains = np.array([s.gains for s in first.scored])
    return Bar(level(gains, seed, run, 1.0 - FREE_SHARE), max(LEAST_GAIN, float(rest)), kept)


def _strengths(first: Round, task: Task, reached: Bar) -> dict[str, Strength]:
    """Return by name what the first round says of the strengths of effects that have one."""
    found = {}
    for s in first.scored:
        if s.solution is not None and s.term.effect is not None and s.term.effect in ALL:
            one = strength_of(s.solution, task, s.term.label, reached)
            if one is not None:
                found[s.term.effect] = one
    return found


def _how(before: judge.Judged) -> str:
    """Say how the intervals of ``helps`` were made."""
    count = before.squares["gap_rmse_m"][1]
    runs = np.array([run for (run, _), n in zip(before.followers, count, strict=True) if n])
    return (
        f"95 % by bootstrap of {unit_of(runs)}, {DRAWS} draws: standard error of the logarithm of after / before, "
        "times Student's t; of the followers' own ratios Student's t. Better or worse: one of both intervals lies on "
        "one side of no change; worse goes before better."
    )


def _partial(judged: Judgement, entries: list[dict[str, Any]], first: Round) -> dict[str, Any] | None:
    """Return what came nearest where nothing was added: its terms, share and errors on the runs kept back."""
    before, after = judged.before, judged.after
    if before is None or after is None:
        return None
    ok = np.isfinite(before.gap_rmse)
    return {
        "effect": judged.tried,
        "terms": entries,
        "explained_share": first.share,
        "after": after.summary(),
        "share_of_drivers_improved": float((after.gap_rmse[ok] < before.gap_rmse[ok]).mean()),
    }


def _drivers(before: judge.Judged | None, after: judge.Judged | None) -> list[dict[str, Any]]:
    """Return every held-out driver once, however many pieces the record has."""
    if before is None or after is None:
        return []
    return [
        {"driver": "/".join(name), "before_m": float(b), "after_m": float(a)}
        for name, b, a in zip(before.followers, before.gap_rmse, after.gap_rmse, strict=True)
        if np.isfinite(b)
    ]


def _where(term: Term, values: dict[str, float]) -> dict[str, Any]:
    if "begin" in values:
        return {"coordinate": term.coordinate, "interval": [values["begin"], values["end"]]}
    if term.effect is not None and ALL[term.effect].sought == "step":
        return {"coordinate": "time", "interval": [values["time"], None]}
    if term.knots[2] > 2:
        first, distance, count = term.knots
        coordinate = "period" if "phase" in term.label else term.coordinate
        return {"coordinate": coordinate, "interval": [first, first + distance * (count - 1)]}
    return {"coordinate": "state" if term.coordinate in ("", "state") else term.coordinate, "interval": [None, None]}


def _found(compared: Solution, rounds: list[Any], intervals: np.ndarray, base: int, task: Task) -> list[dict[str, Any]]:
    result, run = [], units(task.rows.records).run
    at = sum(t.size for t in compared.model.terms[:base])
    for term in compared.model.terms[base:]:
        this, winner = next(
            (r, i)
            for r in rounds for i in (r.winner, r.partner, r.partial)
            if i is not None and r.scored[i].term.label == term.label
        )  # fmt: skip
        mine = intervals[at : at + term.size]
        values = {p.name: float(x[0]) for p, x in zip(term.parameters, mine, strict=True)}
        parameters = {
            p.name: {
                "symbol": p.symbol,
                "estimate": float(x[0]),
                "low": float(x[1]),
                "high": float(x[2]),
                "unit": p.unit,
            }
            for p, x in zip(term.parameters, mine, strict=True)
        }
        contrast = contrast_of(compared, task, term.label) if term.located and term.form == CURVE else None
        where = _where(term, values)
        beside = [] if this.free else rivals(np.array([s.gains for s in this.scored]), winner, run)
        if where["coordinate"] == "time" and (where["interval"][1] or 0) > 9e5:
            where["interval"][1] = None
        effect = None if term.effect is None else ALL[term.effect]
        if effect is not None and effect.sought == "profile" and term.profile is None:
            first, distance, _ = term.knots
            where["profile"] = {"position_m": [first + distance * i for i in range(term.size)]}
        result.append(
            {
                "effect": term.effect,
                "label": term.label,
                "title": words.plain(term.effect or term.label),
                "equation": words.CHANGES[term.what][3] if effect is None else effect.equation,
                "clause": words.clause(term, mine.tolist(), contrast),
                "equivalent": [this.scored[i].term.effect or this.scored[i].term.label for i in this.equivalent],
                "rivals": [this.scored[i].term.effect or this.scored[i].term.label for i in beside],
                "looks_like": [] if effect is None else list(effect.looks_like),
                "told_by": "" if effect is None else effect.told_by,
                "parameters": parameters,
                "what": term.what,
                "where": where,
                "p_value": float(this.tested.p_value[winner]),
                "held_out_gain": float(1.0 - np.exp(-this.tested.gain[winner])),
                "explained_share": this.share,
            }
        )
        at += term.size
    return result


def _known(final: Solution, intervals: np.ndarray, base: int) -> list[dict[str, Any]]:
    result, at = [], 0
    for term in final.model.terms[:base]:
        for p, x in zip(term.parameters, intervals[at : at + term.size], strict=True):
            result.append({"effect": term.effect, "parameter": p.name, "estimate": x[0], "low": x[1], "high": x[2]})
        at += term.size
    return result


def _candidates(rounds: list[Any], refused: dict[str, str]) -> list[dict[str, Any]]:
    rows = []
    for number, this in enumerate(rounds, 1):
        for i in np.argsort(-this.tested.gain):
            s = this.scored[i]
            solution = s.solution
            found = np.zeros(0) if solution is None else solution.values[solution.model.where(s.term.label)]
            values = dict(zip((p.name for p in s.term.parameters), found.tolist(), strict=False))
            units = {p.name: p.unit for p in s.term.parameters}
            rows.append(
                {
                    "round": number,
                    "errors": "free simulation" if this.free else "windows",
                    "effect": s.term.effect or s.term.label,
                    "named": s.term.effect is not None,
                    "p_value": this.tested.p_value[i],
                    "held_out_gain": 1.0 - np.exp(-this.tested.gain[i]),
                    "interval": (1.0 - np.exp(-this.tested.interval[i])).tolist(),
                    "absorbed_share": absorbed(solution, s.term),
                    "parameters": values if len(values) <= words.MANY else {},
                    "units": units if len(values) <= words.MANY else {},
                    "note": "" if solution is not None else "scored by its linear response only",
                }
            )
    for name, reason in refused.items():
        rows.append({"round": 0, "errors": None, "effect": name, "named": True, "p_value": None, "held_out_gain": None,
                     "interval": [None, None], "absorbed_share": None, "parameters": {}, "units": {},
                     "note": reason})  # fmt: skip
    return rows


def absorbed(solution: Solution | None, term: Term) -> float | None:
    """Return which share of the candidate's response re-calibrated drivers absorb, in its first parameter."""
    if solution is None or not solution.linear.by_phi.shape[-1]:
        return None
    first = solution.model.where(term.label).start
    j = solution.linear.by_phi[..., first]
    alone = float((j**2).sum())
    projected = float(np.einsum("gqq->gq", solution.reduced_hessian)[:, first].sum())
    return None if alone <= 0 else float(np.clip(1.0 - projected / alone, 0.0, 1.0))


def _parameters(thetas: list[Solution], prepared: Records) -> list[dict[str, Any]]:
    """Return calibrated parameters before and after, with standard errors from the free simulation's curvature."""
    seen = np.unique(prepared.group)
    rows = []
    errors = [standard_errors(s) for s in thetas]
    for i, name in enumerate(p.name for p in thetas[0].model.catalogue.own):
        row: dict[str, Any] = {"parameter": name}
        for label, s, e in zip(("before", "after"), thetas, errors, strict=True):
            values = np.exp(s.theta[seen, i])
            row[label] = {
                "median": float(np.median(values)),
                "low": float(np.quantile(values, 0.1)),
                "high": float(np.quantile(values, 0.9)),
                "standard_error": float(np.median(e[seen, i] * values)),
            }
        rows.append(row)
    return rows


def standard_errors(solution: Solution) -> np.ndarray:
    """Return standard errors of log θ [G, P]; a residual that is correlated over 5 s counts every 5 s once."""
    linear = solution.linear
    # The groups of a calibration are those of its normal equations; rows are summed by group there already.
    groups = len(solution.theta)
    matrix = np.tile(np.diag(solution.prior.width**-2.0), (groups, 1, 1))
    variance = np.ones(groups)
    count = np.zeros(groups)
    square = np.zeros(groups)
    of = solution.row_group
    np.add.at(matrix, of, np.einsum("rmi,rmj->rij", linear.by_theta, linear.by_theta) / 10.0)
    np.add.at(square, of, (linear.residual**2).sum(1))
    np.add.at(count, of, (linear.by_theta != 0).any(-1).sum(1))
    variance = np.maximum(square / np.maximum(count, 1), 1e-9)
    inverse = np.linalg.inv(matrix / variance[:, None, None] + 1e-9 * np.eye(matrix.shape[-1]))
    return np.sqrt(np.einsum("gii->gi", inverse))


def _data(
    trajectories: Trajectories, prepared: Records, fit_runs: list[str], task: Task, null: Solution, by: str,
    rounds: list[Any],
) -> dict[str, Any]:  # fmt: skip
    signals = prepared.signals
    inside = np.concatenate([np.arange(a, b) for a, b in zip(prepared.first, prepared.bounds[1:], strict=True)])
    speed, gap = signals[inside, 15], signals[inside, 0] - signals[inside, 14]
    closing = speed - signals[inside, 1]
    free = gap > 3.0 * np.maximum(speed, 2.0)
    residual = null.linear.residual
    lag = float(np.mean(residual[:, 1:] * residual[:, :-1]) / max(np.mean(residual**2), 1e-12))
    summary = trajectories.summary()
    return summary | {
        "by": by,
        "drivers": len(np.unique(prepared.group)),
        "records": len(prepared),
        "runs_to_choose_on": len(fit_runs),
        "smallest_p_value": smallest_p(units(task.rows.records).run),
        "windows": len(task.rows),
        "gap_noise_m": float(np.median([noise_sigma(e.gap_m) for e in prepared.episodes])),
        "residual_autocorrelation": lag,
        "share_standing": float((speed < 0.3).mean()),
        "share_free": float((free & (speed >= 0.3)).mean()),
        "share_approaching": float((~free & (closing > 1.0) & (speed >= 0.3)).mean()),
        "share_following": float((~free & (closing <= 1.0) & (speed >= 0.3)).mean()),
        "at_bounds": at_bounds(null),
        "unexplained_gain": [float(r.left.mean()) for r in rounds],
        "horizon_s": task.rows.steps * prepared.dt,
        "lap_m": prepared.period or None,
    }


def at_bounds(solution: Solution) -> dict[str, int]:
    """Return how many groups have each of the drivers' parameters at a bound."""
    out, catalogue = {}, solution.model.catalogue
    for i, (p, (low, high)) in enumerate(zip(catalogue.own, catalogue.bounds, strict=True)):
        out[p.name] = int(((solution.theta[:, i] < low + 1e-3) | (solution.theta[:, i] > high - 1e-3)).sum())
    return out


def _plain(x: Any) -> Any:
    """Return x with numpy numbers as Python's and what is not finite as None, so that JSON stays JSON."""
    if isinstance(x, dict):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    if isinstance(x, np.ndarray):
        return _plain(x.tolist())
    if isinstance(x, (bool, np.bool_)):
        return bool(x)
    if isinstance(x, np.integer):
        return int(x)
    if isinstance(x, (float, np.floating)):
        return float(x) if np.isfinite(x) else None
    return x
