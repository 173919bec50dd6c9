"""The command ``drift``: a file of measured traffic in, how its drivers drift and drivers who do so out."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from idm_env.data import Trajectories
from idm_env.data.fingerprint import fitted_on
from idm_env.drift import held_out
from idm_env.drift.estimate import Estimate
from idm_env.drift.kinds import Told, tell
from idm_env.effects import DRIFTS, Replay
from idm_env.fitting.options import Source
from idm_env.jobs import storage
from idm_env.jobs.executor import Executor
from idm_env.jobs.progress import OnProgress, silent
from idm_env.model_file import Model, Numbers, nested, save_model
from idm_env.reports import page

WRITTEN = ("model.yaml", "report.json", "report.html")
UNKNOWN = 100.0
"""An interval that reaches so many times as far as its estimate is none."""
UNSAID = ("forecasts", "crps_by_driver_m")
"""What a report's scores have and its table leaves out."""
DRIVERS = 60
"""Drivers at most on whom drift is estimated."""
STEP_S = 0.5
"""Time between two samples that are used: drift lasts seconds, and a file of 10 Hz takes five times as long."""


def step_of(trajectories: Trajectories) -> float | None:
    """Return the multiple of a file's step that is nearest to ``STEP_S``, None where runs have several steps."""
    steps = {round(step, 9) for step in trajectories.steps.values()}
    step = max(steps)
    return step * max(1, round(STEP_S / step)) if len(steps) == 1 else None


def drift_file(
    source: Source, out: Path, *, drivers: int = DRIVERS, resume: bool = False,
    executor: Executor | None = None, on_progress: OnProgress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Say how the drivers of a file drift, and return the report; write it, a page and ``model.yaml``.

    ``drivers`` are taken at most, evenly spread over the file; every fourth driver is kept back, and forecasts of those
    are scored. Headline and model are the likeliest sort, unless another forecasts better beyond chance
    (``held_out.foremost``). σ is as estimated: bands are widened by the drivers kept back, and no factor of σ does so
    at all horizons. ``executor`` estimates the sorts. ``resume`` goes on with the estimates of an interrupted run.
    DataError and ValueError for what cannot be read.
    """
    with storage.results(out, WRITTEN, (source.path,)):
        progress = on_progress or silent
        progress("reading", 0, 0, source.path.name)
        trajectories = source.trajectories()
        thinned = replace(source, dt=source.dt or step_of(trajectories))
        both = [replace(thinned, smooth=x).episodes(trajectories) for x in (True, False)]
        taken, rest = held_out.split(len(both[0]), drivers)
        fitted, back = ([[episodes[i] for i in places] for episodes in both] for places in (taken, rest))
        mark = storage.fingerprint(source.path, replace(thinned, path=Path()), drivers)
        store = storage.Store(out / storage.UNFINISHED / "drift", mark, resume)
        answer = tell(*fitted, store=store, executor=executor, on_progress=progress)
        progress("kept back", 0, 0, f"{len(rest)} drivers")
        sorts = {"no drift": answer.steady} | {name: e for name, e in answer.found.items() if not e.why_not}
        scores = held_out.scores(sorts, back[0], back[1]) if len(rest) and answer.verdict != "cannot_tell" else []
        likeliest = next(iter(answer.one_of), "no drift")
        foremost = held_out.foremost(scores, likeliest)
        one_of = tuple(n for n in dict.fromkeys((foremost, *answer.one_of)) if n != "no drift")
        answer = replace(answer, one_of=one_of, foresees=foremost != "no drift" or foremost == likeliest)
        best = sorts[foremost]
        marked = fitted_on(trajectories, [(e.run_id, e.vehicle_id) for e in fitted[0]])
        save_model(out / "model.yaml", replace(model_of(best), fitted_on=marked))
        data: dict[str, Any] = {"episodes": len(both[0]), "taken": len(taken), "dt": best.drivers.batch.dt}
        named = {"none": answer.steady, **answer.found}
        result = {
            "verdict": answer.verdict,
            "one_of": list(answer.one_of),
            "sentence": f"{held_out.sentence(scores, likeliest)} {sentence(answer)}".lstrip(),
            "sorts": _sorts(answer),
            "kept_back": {"drivers": len(rest), "scores": scores},
            "estimates": {name: [] if e.why_not else e.table() for name, e in named.items()},
            "data": {**trajectories.summary(), **data, "account": page.account(trajectories.repairs, both[0].left_out)},
        }
        title, template = f"How the drivers of {trajectories.source} drift", Path(__file__).with_name("drift.html")
        report = page.write_report(out, title, template, result, tables=tables)
        store.remove()
        return report


def model_of(estimate: Estimate) -> Model:
    """Return drivers who drift as estimated: the median driver and everyone's own parameters."""
    drivers, names = estimate.drivers, estimate.drivers.free

    def numbers(row: np.ndarray) -> Numbers:
        return nested(dict(zip(names, np.exp(row).tolist(), strict=True)))

    s = estimate.settings
    numbers_of = zip(drivers.drifts, s.sigma.tolist(), s.memory_time.tolist(), strict=True)
    drifts = {name: {"sigma": sigma, "memory_time": tau} for name, sigma, tau in numbers_of}
    records: dict[str, list[np.ndarray]] = {}
    for e, theta in zip(drivers.batch.episodes, estimate.theta, strict=True):
        records.setdefault(f"{e.run_id}/{e.vehicle_id}", []).append(theta)
    simulator, median = drivers.simulator, {**numbers(np.median(estimate.theta, 0)), **drifts}
    effects = tuple(e for e in simulator.effects if not isinstance(e, Replay))
    own = {key: numbers(np.mean(x, 0)) for key, x in records.items()}
    return Model(effects, median, simulator.dt, simulator.integration, own)


def sentence(answer: Told) -> str:
    """Return in one sentence how drivers drift."""
    if answer.verdict == "cannot_tell" and answer.foresees:
        why = answer.steady.why_not or "; ".join(f"{name}: {e.why_not}" for name, e in answer.found.items())
        return f"These data cannot tell how drivers drift. Not estimated: {why}."
    if not answer.one_of:
        return "No drift: steady drivers and white noise explain these records as well."
    best, kinds = answer.found[answer.one_of[0]], {kind.name: kind for kind in DRIFTS}
    rows = {str(row["name"]): row for row in best.table()}
    parts = []
    for name in best.drivers.drifts:
        size = next(p.unit for p in kinds[name].parameters if p.name == "sigma")
        words = [f"{kinds[name].title} ({name})"]
        for key, symbol, unit in (("sigma", "sigma", "" if size == "1" else f" {size}"), ("memory_time", "tau", " s")):
            row = rows[f"{name}.{key}"]
            estimate, low, high = (float(row[end]) for end in ("estimate", "low", "high"))
            interval = f"{low:.3g} to {high:.3g}" if high < UNKNOWN * estimate else "these data do not tell it"
            words.append(f"{symbol} {estimate:.3g}{unit} ({interval})")
        parts.append(", ".join(words))
    apart = "".join(f" Not told apart from {kinds[n].title} ({n})." for n in answer.one_of[1:])
    unclear = "These data cannot tell how drivers drift. Likelier on those estimated, and worse in forecasts"
    return f"{'Drivers drift' if answer.foresees else unclear}: {'. And '.join(parts)}.{apart}"


def _sorts(answer: Told) -> list[dict[str, Any]]:
    """Return a row for every sort: its gain, and σ and τ (s), a list where it has several processes."""
    rows: list[dict[str, Any]] = []
    for name in sorted(answer.found, key=lambda n: (bool(answer.found[n].why_not), -answer.gain[n])):
        why, s = answer.found[name].why_not or answer.steady.why_not, answer.found[name].settings
        sigma, tau = (x.tolist() if len(x) > 1 else float(x[0]) for x in (s.sigma, s.memory_time))
        row = {"log_likelihood": answer.gain[name], "sigma": sigma, "tau_s": tau}
        row = dict.fromkeys(row) if why else row
        rows.append({"sort": name, **row, "note": f"not estimated: {why}" if why else ""})
    return rows


def tables(report: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of a report under their names in words and units, by the title of their table."""
    names = {"ahead_s": "ahead (s)", "gap_rmse_m": "RMSE (m)", "gap_crps_m": "CRPS (m)", "tau_s": "tau (s)"}
    names |= {"in_90_percent": "in the 90 % band (%)", "widening": "widening to hold 90 %"}
    names |= {"widened_90_percent": "in it as others widen it (%)"}
    names |= {"sort": "variant", "log_likelihood": "gain in log-likelihood"}
    both = {
        f"Forecasts of the gap of {report['kept_back']['drivers']} drivers kept back": report["kept_back"]["scores"],
        "Stochastic variants against the deterministic model": report["sorts"],
    }

    def row_in_words(row: dict[str, Any]) -> dict[str, Any]:
        texts = {k: ", ".join(map(page.number, x)) if isinstance(x, list) else x for k, x in row.items()}
        return {names.get(k, k): x for k, x in texts.items() if k not in UNSAID}

    return {title: [row_in_words(row) for row in rows] for title, rows in both.items() if rows}
