"""The content of ``report.json``: schema 1, and the sentences that say in plain words what was found."""

from __future__ import annotations

from typing import Any

import numpy as np

from idm_env.data import Trajectories, noise_sigma
from idm_env.discovery import judge
from idm_env.discovery.decide import ALPHA, LEAST_GAIN
from idm_env.discovery.model import Term
from idm_env.discovery.records import Records
from idm_env.discovery.score import interval_of
from idm_env.discovery.solve import BOUNDS, NAMES, Solution, Task
from idm_env.report import versions

LEFT = 0.04
"""Gain in log RMSE of a smooth function of the state above which something is left to explain.

Drivers' own noise of 0.2 m/s² alone comes to 0.01 to 0.03: it has changed the state that the function sees.
"""
LOOK_ALIKES = {
    "delay": ["lag", "leader_acceleration (negative)"], "lag": ["delay", "leader_acceleration (negative)"],
    "leader_acceleration": ["delay", "lag", "brake_light", "second_leader"],
    "brake_light": ["leader_acceleration", "asymmetry", "second_leader"],
    "second_leader": ["brake_light", "leader_acceleration", "delay"], "asymmetry": ["brake_light"],
    "drag": ["speed_dependent_gap", "power_limit", "v0"], "speed_dependent_gap": ["drag", "time_gap"],
    "memory": ["regime_shift", "time_gap"], "regime_shift": ["memory"], "grade": ["speed_zone", "T over position"],
    "speed_zone": ["grade", "T over position"], "power_limit": ["drag"], "gap_bias": ["min_gap"],
}  # fmt: skip
WOULD_TELL = {
    "delay": "sharp braking of leaders (jerk above 3 m/s³) at 10 Hz or more tells delay from lag",
    "lag": "sharp braking of leaders (jerk above 3 m/s³) at 10 Hz or more tells lag from delay",
    "drag": "free starts from standstill to above 25 m/s tell drag from v0 and power",
    "power_limit": "free starts from standstill to above 25 m/s tell power from drag and v0",
    "speed_dependent_gap": "following at 5 to 30 m/s by one driver tells the gap from drag",
    "memory": "runs that begin at different times of the day tell memory from a shift of regime",
    "regime_shift": "runs with different clock offsets tell a shift of regime from memory",
    "grade": "the same place at low and high speed, with and without leader, tells a grade from a speed zone",
    "speed_zone": "the same place at low and high speed, with and without leader, tells a zone from a grade",
}


def report(
    trajectories: Trajectories, prepared: Records, fit_runs: list[str], kept_runs: list[str], task: Task,
    null: Solution, final: Solution, rounds: list[Any], refused: dict[str, str], before: judge.Judged | None,
    after: judge.Judged | None,
    partial: judge.Judged | None, thetas: list[Solution], by: str, seed: int, names: list[str],
) -> dict[str, Any]:  # fmt: skip
    """Return the report as plain numbers and texts."""
    base = len(null.model.terms)
    found = _found(null, final, rounds, interval_of(final, task), base)
    verdict = _verdict(found, rounds)
    lockbox = prepared.of_runs(kept_runs) if kept_runs else prepared
    content = {
        "schema": 1,
        "verdict": verdict,
        "sentence": " ".join([sentence(verdict, found, rounds), *_soberly(found, before, after)]),
        "found": found,
        "known": _known(final, interval_of(final, task), base),
        "error": {
            "held_out_runs": kept_runs,
            "held_out_drivers": [
                {"driver": e.key, "before_m": float(b), "after_m": float(a)} for e, b, a in _drivers(before, after)
            ],
            "before": None if before is None else before.summary(),
            "after": None if after is None else after.summary(),
            "floor": judge.floor(lockbox),
        },
        "partial": _partial(rounds[0], partial, before),
        "candidates": _candidates(rounds, refused),
        "parameters": _parameters(thetas, prepared),
        "data": _data(trajectories, prepared, fit_runs, task, null, by, rounds),
        "seed": seed,
        "versions": versions(),
    }
    return _plain(content)


def _partial(first: Any, after: judge.Judged | None, before: judge.Judged | None) -> dict[str, Any] | None:
    """Return the best partial explanation where nothing was added: its name, share and error on the lockbox."""
    if after is None or before is None or first.partial is None:
        return None
    s = first.scored[first.partial]
    values = s.solution.values[s.solution.model.where(s.term.label)]
    ok = before.scored.any(1)
    return {
        "effect": s.term.effect or s.term.label,
        "parameters": dict(zip([p.name for p in s.term.parameters][:4], values[:4].tolist(), strict=False)),
        "explained_share": first.share,
        "after": after.summary(),
        "share_of_drivers_improved": float((after.gap_rmse[ok] < before.gap_rmse[ok]).mean()),
    }


def _drivers(before: judge.Judged | None, after: judge.Judged | None) -> list[tuple[Any, float, float]]:
    if before is None or after is None:
        return []
    episodes = before.rows.records.episodes
    return [
        (episodes[r], b, a)
        for r, b, a, n in zip(before.rows.record, before.gap_rmse, after.gap_rmse, before.scored.sum(1), strict=True)
        if n
    ]


def _verdict(found: list[dict[str, Any]], rounds: list[Any]) -> str:
    if found:
        return "named" if any(f["effect"] for f in found) else "located"
    first = rounds[0]
    if first.why_not.startswith("only"):
        return "cannot_tell"
    structured = bool(((first.verdict.p_value < ALPHA) & (first.verdict.gain >= LEAST_GAIN)).any())
    left = first.left
    error = left.std(ddof=1) / np.sqrt(len(left)) if len(left) > 1 else np.inf
    return "unexplained" if structured or left.mean() > max(LEFT, 3.0 * error) else "none"


def sentence(verdict: str, found: list[dict[str, Any]], rounds: list[Any]) -> str:
    """Say in plain words what was found, how sure it is, what it is confused with, and what data would tell."""
    if verdict == "none":
        return (
            "Nothing is missing that these data could show: no candidate lowers the error on runs that it was not "
            "fitted to. What remains looks like the drivers' own noise and the noise of measurement."
        )
    if verdict == "cannot_tell":
        return (
            f"These data cannot tell: {rounds[0].why_not}. Seven runs are needed (a quarter is kept for the final "
            "check), ten or more are better. The ranking below is a hint, not a finding."
        )
    if verdict == "unexplained":
        return (
            f"Something is missing that no candidate explains: {rounds[0].why_not}. The best partial explanation is at "
            "the top of the ranking; the maps of the residual say where to look."
        )
    parts = []
    for f in found:
        name = f["effect"] or f["label"]
        numbers = ", ".join(
            f"{k} = {v['estimate']:.3g} ({v['low']:.3g} to {v['high']:.3g})"
            + ("" if v["unit"] == "1" else f" {v['unit']}")
            for k, v in list(f["parameters"].items())[:3]
        )
        if len(f["parameters"]) > 6:
            estimates = [v["estimate"] for v in f["parameters"].values()]
            numbers = f"a curve of {len(estimates)} knots from {min(estimates):.3g} to {max(estimates):.3g}"
        what = f"{name} is missing" if f["effect"] else f"an effect without a name was located: {name}"
        parts.append(f"{what[0].upper()}{what[1:]} ({numbers}; p = {f['p_value']:.2g}).")
        if f["equivalent"]:
            parts.append(f"These data cannot tell it from {', '.join(f['equivalent'])}.")
        elif f["looks_like"]:
            parts.append(f"It is most easily confused with {', '.join(f['looks_like'][:3])}.")
        if f["effect"] in WOULD_TELL:
            parts.append(f"What would tell: {WOULD_TELL[f['effect']]}.")
    return " ".join(parts)


def _soberly(found: list[dict[str, Any]], before: judge.Judged | None, after: judge.Judged | None) -> list[str]:
    """Say what the finding does not do for long simulation, if so."""
    if not found or before is None or after is None:
        return []
    was, now = (x.summary()["gap_rmse_m"] for x in (before, after))
    if now < was:
        return []
    return [
        f"It shows in predictions over some seconds; free simulation of the runs kept back does not get better by it "
        f"(gap RMSE {was:.2f} to {now:.2f} m)."
    ]


def _where(term: Term, values: dict[str, float]) -> dict[str, Any]:
    if term.effect == "speed_zone" or (term.effect is None and "begin" in values):
        return {"coordinate": term.coordinate, "interval": [values["begin"], values["end"]]}
    if term.effect == "regime_shift":
        return {"coordinate": "time", "interval": [values["time"], None]}
    if term.knots[2] > 2 or term.effect == "grade":
        first, distance, count = term.knots
        coordinate = "period" if "phase" in term.label else term.coordinate
        return {"coordinate": coordinate, "interval": [first, first + distance * (count - 1)]}
    return {"coordinate": "state" if term.coordinate in ("", "state") else term.coordinate, "interval": [None, None]}


def _found(
    null: Solution, final: Solution, rounds: list[Any], intervals: np.ndarray, base: int
) -> list[dict[str, Any]]:
    result = []
    at = sum(t.size for t in final.model.terms[:base])
    for term in final.model.terms[base:]:
        this, winner = next(
            (r, i)
            for r in rounds for i in (r.winner, r.partner)
            if i is not None and r.scored[i].term.label == term.label
        )  # fmt: skip
        mine = intervals[at : at + term.size]
        values = {p.name: float(x[0]) for p, x in zip(term.parameters, mine, strict=True)}
        parameters = {
            p.name: {"estimate": float(x[0]), "low": float(x[1]), "high": float(x[2]), "unit": p.unit}
            for p, x in zip(term.parameters, mine, strict=True)
        }
        where = _where(term, values)
        if where["coordinate"] == "time" and (where["interval"][1] or 0) > 9e5:
            where["interval"][1] = None
        if term.effect == "grade" and term.profile is None:
            first, distance, _ = term.knots
            where["profile"] = {"position_m": [first + distance * i for i in range(term.size)]}
        result.append(
            {
                "effect": term.effect,
                "label": term.label,
                "equivalent": [this.scored[i].term.effect or this.scored[i].term.label for i in this.equivalent],
                "looks_like": LOOK_ALIKES.get(term.effect or "", []),
                "parameters": parameters,
                "what": term.what if term.what != "slope" else "acceleration",
                "where": where,
                "p_value": float(this.verdict.p_value[winner]),
                "held_out_gain": float(1.0 - np.exp(-this.verdict.gain[winner])),
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
        for i in np.argsort(-this.verdict.gain):
            s = this.scored[i]
            solution = s.solution
            found = np.zeros(0) if solution is None else solution.values[solution.model.where(s.term.label)]
            values = dict(zip((p.name for p in s.term.parameters), found.tolist(), strict=False))
            rows.append(
                {
                    "round": number,
                    "effect": s.term.effect or s.term.label,
                    "named": s.term.effect is not None,
                    "p_value": this.verdict.p_value[i],
                    "held_out_gain": 1.0 - np.exp(-this.verdict.gain[i]),
                    "interval": (1.0 - np.exp(-this.verdict.interval[i])).tolist(),
                    "absorbed_share": absorbed(solution, s.term),
                    "parameters": values if len(values) <= 4 else {},
                    "note": "" if solution is not None else "scored by its linear response only",
                }
            )
    for name, reason in refused.items():
        rows.append({"round": 0, "effect": name, "named": True, "p_value": None, "held_out_gain": None,
                     "interval": [None, None], "absorbed_share": None, "parameters": {}, "note": reason})  # fmt: skip
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
    for i, name in enumerate(NAMES):
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
    """Return standard errors of log θ [G, 5]; a residual that is correlated over 5 s counts every 5 s once."""
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
    inverse = np.linalg.inv(matrix / variance[:, None, None] + 1e-9 * np.eye(5))
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
        "smallest_p_value": 2.0 ** -len(fit_runs),
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
    """Return how many groups have each IDM parameter at a bound."""
    out = {}
    for i, name in enumerate(NAMES):
        low, high = BOUNDS[i]
        out[name] = int(((solution.theta[:, i] < low + 1e-3) | (solution.theta[:, i] > high - 1e-3)).sum())
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
