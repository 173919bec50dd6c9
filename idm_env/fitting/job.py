"""The commands ``fit`` and ``simulate``: a file of measured traffic in, a folder of results out."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import torch

from idm_env.data import DataError, Episode, Episodes, Repair, Trajectories, noise_sigma
from idm_env.data.fingerprint import Track, marks, names_by_mark
from idm_env.data.folder import FolderSlice, shares, stamp
from idm_env.data.schema import TRACK
from idm_env.effects import Brakes, base_named
from idm_env.fitting import drivers, pictures, pieces
from idm_env.fitting.batch import Batch
from idm_env.fitting.drivers import Estimates
from idm_env.fitting.evaluate import Errors, errors
from idm_env.fitting.options import Options, Source, behind_records
from idm_env.fitting.pieces import JoinedFit, Piece
from idm_env.fitting.problem import Problem, Simulated, group_of
from idm_env.jobs import storage
from idm_env.jobs.executor import Executor, Serial
from idm_env.jobs.progress import OnProgress, silent
from idm_env.jobs.shards import Parts
from idm_env.model_file import Model, load_model, nested, save_model
from idm_env.reports import page
from idm_env.roads import Lane
from idm_env.simulator import Simulator

FITTED = ("parameters.parquet", "drivers.csv", "model.yaml", "report.json", "report.html")
SIMULATED = ("simulated.parquet", "report.json", "report.html")
"""What ``fit_file`` and ``simulate_file`` write."""
NOISY_M, MOST_ROWS = 0.12, 50_000
"""Noise of a position above which a file is raw (m), and the rows that it is taken from. Of nine files of smoothed
positions none is above 0.01, and NGSIM's raw ones are at 0.16."""
TEMPLATES = Path(__file__).parent
"""Where the words of pages stand."""
MOST_DRIVERS = 10_000
"""Drivers that a model.yaml has of its own, at most; drivers.csv has all."""


def fit_file(
    source: Source,
    options: Options,
    out: Path,
    *,
    resume: bool = False,
    part: int = pieces.PART,
    executor: Executor | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Fit IDM, or another car-following law, to a file and return the report; write it, the parameters and the model.

    Writes ``parameters.parquet`` (one row per group and parameter), ``drivers.csv`` (one row per group),
    ``model.yaml`` (without drivers of its own above ``MOST_DRIVERS``), ``report.json`` and ``report.html``. A fit that
    failed (``failed`` of the report says in what) has no model.

    The work is done in parts of ``part`` groups by ``executor`` (None: here), on which no byte of the first three
    depends. The path may be a folder of parquet files with columns run_id, vehicle_id, time_s and position_m at least:
    it is fitted by driver, some runs at a time, and never held as a whole.

    Held-out runs take no part in the fit. Where their group was fitted they are simulated with its parameters,
    otherwise with those of a pooled fit of the fitting runs. DataError and ValueError for what cannot be read or
    fitted; PartsError names parts that failed for another reason, and keeps the others for ``resume``.
    """
    work = _Work(source, options, out.absolute(), resume, part, executor or Serial(), on_progress or silent)
    with storage.results(out, FITTED, (source.path, options.model)):
        return _fit_folder(work) if source.path.is_dir() else _fit_file(work)


class _Work(NamedTuple):
    """Arguments of one call of ``fit_file``."""

    source: Source
    options: Options
    out: Path
    resume: bool
    part: int
    executor: Executor
    progress: OnProgress

    def pieces(self, data: Sequence[Sequence[Episode] | FolderSlice], by: str, name: str) -> tuple[Piece, ...]:
        """Return the parts of a fit and where they are kept; one that is alone is kept step by step."""
        inputs = stamp(self.source.path), self.options.model and Path(self.options.model)
        request = dataclasses.replace(self.source, path=Path()), self.options, by, self.part
        folder = self.out / storage.UNFINISHED
        parts = Parts(folder / f"{name}-parts", storage.fingerprint(request, *inputs), self.resume)
        checkpoint = folder / name if len(data) == 1 else None
        return tuple(
            Piece(n, len(data), one, self.source, self.options, by, parts, checkpoint, self.resume)
            for n, one in enumerate(data)
        )

    def fit(self, data: Sequence[Sequence[Episode] | FolderSlice], by: str, name: str, before: str = "") -> JoinedFit:
        """Fit all parts and return their results."""
        cut = self.pieces(data, by, name)
        parts = cut[0].parts
        try:
            pieces.run(self.executor, cut, lambda phase, *state: self.progress(before + phase, *state))
            return pieces.join(parts, self.options)
        except ValueError:
            if not parts.summaries() or not parts.tables(pieces.PARAMETERS):
                parts.remove()  # nothing of it could go on
            raise


def _fit_file(work: _Work) -> dict[str, Any]:
    source, options = work.source, work.options
    work.progress("reading", 0, 0, source.path.name)
    trajectories = source.trajectories()
    fitting, held = trajectories, None
    if options.held_out is not None:
        fitting, held = trajectories.split(options.held_out, seed=options.seed)
    chosen = source.episodes(fitting)
    joined = work.fit(pieces.cut(chosen, options.by, work.part), options.by, "fit")
    held_out, left_out, pooled = None, list(chosen.left_out), joined
    if held is not None:
        if options.by != "all":
            pooled = work.fit([chosen], "all", "pooled", "held out: ")
        held_out, lost = _held_out(source, options, held, joined.estimates, pooled.estimates)
        left_out += lost
    account = page.account(trajectories.repairs, left_out)
    data = {**_data(trajectories, chosen), "account": account, "noise": _noise(trajectories, source.path)}
    result = _write(work, joined, held_out, data, marks(trajectories, _drivers(chosen)))
    pooled.parts.remove()
    return result


def _data(trajectories: Trajectories, items: Episodes) -> dict[str, Any]:
    """Return the counts of a file, its repairs and the rows left out."""
    left_out, account = [str(r) for r in items.left_out], page.account(trajectories.repairs, items.left_out)
    return {**trajectories.summary(), "left_out": left_out, "episodes": len(items), "account": account}


def _noise(trajectories: Trajectories, path: Path) -> str:
    """Return the warning that positions are raw, with its cure; nothing where their noise is below ``NOISY_M``."""
    tracks = [p["position_m"].to_numpy() for _, p in trajectories.table.head(MOST_ROWS).group_by(TRACK) if len(p) > 20]
    sigma = float(np.median([noise_sigma(track) for track in tracks])) if tracks else 0.0
    if sigma <= NOISY_M:
        return ""
    page.ASKED.set(page.ASKED.get()._replace(command="raw"))
    return f"Positions have noise of {sigma:.2f} m (one sample to the next): first idm-env filter {path}."


def _fit_folder(work: _Work) -> dict[str, Any]:
    """Fit a folder by driver, some runs at a time."""
    source, options = work.source, work.options
    if options.by != "driver":
        raise ValueError(f"by = '{options.by}' needs all rows at once, and {source.path} is a folder. Give one file.")
    if options.held_out is not None:
        raise ValueError("held_out cannot be drawn from a folder. Keep a file back, and simulate the model on it.")
    work.progress("reading", 0, 0, source.path.name)
    joined = work.fit(shares(source.path, work.part, source.columns), "driver", "fit")
    tracks = [track for summary in joined.summaries for track in summary["tracks"]]
    return _write(work, joined, None, pieces.account_of(joined, source.path.name), tracks)


def _write(
    work: _Work, joined: JoinedFit, held_out: dict[str, Any] | None, data: dict[str, Any], tracks: list[str]
) -> dict[str, Any]:
    """Join the parts to the files that were promised, and return the report."""
    out, options, estimates = work.out, work.options, joined.estimates
    error = joined.errors.summary()
    bounds, many = drivers.bounds(estimates), len(estimates.groups) > drivers.MOST_ROWS
    failed, rest = drivers.failure(bounds, joined.errors), held_out or {}
    unseen = rest.get("gap_rmse_m"), options.by, rest.get("parts", "runs")
    fit = {**error, "groups": len(estimates.groups), "converged": joined.converged, "iterations": joined.iterations}
    result: dict[str, Any] = {
        "data": data,
        "options": {**vars(options), "free": estimates.names},
        "fit": fit,
        "held_out": held_out,
        "failed": failed,
        "at_bounds": drivers.sentence(bounds),
        "over_fitting": drivers.over_fitting(bounds, error["gap_rmse_m"], *unseen),
        "bounds": bounds,
        "parameters": [],
    }
    work.progress("writing", 0, 0, "the report")
    joined.parts.join(pieces.DRIVERS, out / "drivers.csv")
    joined.parts.join(pieces.PARAMETERS, out / "parameters.parquet")
    if not many:
        result["parameters"] = pl.read_parquet(out / "parameters.parquet", glob=False).to_dicts()
    rows = pl.scan_parquet(joined.parts.tables(pieces.DRIVERS), glob=False)
    table = rows.head(drivers.MOST_ROWS).collect().to_dicts()
    model = dataclasses.replace(model_of(estimates, options.by), substeps=options.substeps)
    if len(estimates.groups) <= MOST_DRIVERS:
        model = dataclasses.replace(model, fitted_on={"source": data["source"], "tracks": sorted(tracks)})
    if failed:
        (out / "model.yaml").unlink(missing_ok=True)  # of an earlier fit
    else:
        save_model(out / "model.yaml", model)
    title = f"{estimates.simulator.base.title} fitted to {data['source']}"
    errors_in_words = in_words([{"": "fitted", **fit}] + ([{"": f"held-out {rest['parts']}", **rest}] if rest else []))
    figures = list(zip(("Measured and simulated", "Residuals", "In space and time"), joined.pictures, strict=False))
    names: dict[str, Any] = {"rows": errors_in_words, "figures": figures, "joined": joined, "table": table}
    names |= {"drivers": drivers, "pictures": pictures}
    report = page.write_report(out, title, TEMPLATES / "fit.html", result, **names)
    joined.parts.remove()
    return report


def _drivers(items: Episodes) -> list[tuple[str, str]]:
    return [(episode.run_id, episode.vehicle_id) for episode in items]


def _held_out(
    source: Source, options: Options, held: Trajectories, estimates: Estimates, pooled: Estimates
) -> tuple[dict[str, Any], tuple[Repair, ...]]:
    """Return the errors on runs that the fit has not seen, and the rows of them left out."""
    items = source.episodes(held)
    batch = Batch.stack(items, substeps=options.substeps)
    group, names = group_of(batch.episodes, options.by)
    simulator = dataclasses.replace(estimates.simulator, dt=batch.step)
    cost: dict[str, Any] = {name: getattr(options, name) for name in ("objective", "relative", "loss")}
    problem = Problem(simulator, batch, estimates.names, (), group, names, fixed=estimates.fixed, **cost)
    own, unseen = estimates.own_for(names, pooled.values[0])
    error, _ = errors(problem, own, own[0, :0])
    return {
        **error.summary(),
        "parts": "runs" if held.drivers is None else "drivers",
        "runs": held.runs(),
        "groups_not_fitted": len(unseen),
        "left_out": [str(r) for r in items.left_out],
    }, items.left_out


def model_of(found: Estimates, by: str = "driver") -> Model:
    """Return estimates ``by`` groups as a model: their median as its parameters, every group as a driver of its own.

    Above ``MOST_DRIVERS`` groups it has the median only.
    """

    def named(row: torch.Tensor) -> dict[str, float]:
        return dict(zip(found.names, row.tolist(), strict=True))

    simulator = found.simulator
    several = 1 < len(found.groups) <= MOST_DRIVERS
    return Model(
        effects=simulator.without("replay").effects if "replay" in simulator.by_name else simulator.effects,
        parameters=nested({**named(found.values.median(0).values), **found.fixed}),
        dt=found.dt,
        integration=simulator.integration,
        drivers={g: nested(named(found.values[i])) for i, g in enumerate(found.groups)} if several else {},
        by=by,
    )


def _overlap(model: Model, overlap: dict[Track, str] | None, items: Episodes, error: Errors) -> dict[str, Any]:
    """Return how many episodes are of tracks that the model was fitted on, the error on the others, and it in words."""
    new = torch.tensor([driver not in (overlap or ()) for driver in _drivers(items)])
    count, others = int((~new).sum()), float(error.gap_rmse[new].mean()) if new.any() else None
    if overlap is None:
        words = "of which the model does not say whether it was fitted on them."
    elif others is None:
        words = "fitted on these data: not a held-out figure."
    elif count:
        words = (
            f"in part fitted on these data ({count} of {len(items)} episodes): not a held-out figure. On the others it "
            f"is {others:.2f} m."
        )
    else:
        words = "on data that the model was not fitted on."
    numbers = (None, None) if overlap is None else (count, others)
    names = ("source", "episodes_fitted_on", "gap_rmse_of_others_m", "words")
    return dict(zip(names, (model.fitted_on.get("source"), *numbers, words), strict=True))


def drivers_in_words(model: Model, matched: int, count: int) -> str:
    """Return in words how many of so many episodes are of drivers that a model has."""
    if not model.drivers:
        return "The model has no drivers of its own: all have its parameters."
    others = "" if matched == count else ", the others have its median parameters"
    return f"{matched} of {count} stretches are of its {len(model.drivers)} drivers{others}."


def simulate_file(
    source: Source,
    model_path: Path | None,
    out: Path,
    *,
    base: str | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Roll a saved model behind the measured leaders; write simulated.parquet, report.json and report.html.

    Instead of a model, ``base`` names a car-following law, which is taken with its defaults.

    A driver takes the parameters of ``drivers`` whose key is his, by the model's ``by``, otherwise the model's own.
    Noise is drawn with ``seed``. ValueError for a model and a law, or neither.
    """
    if (model_path is None) == (base is None):
        raise ValueError("simulate takes either a model (--model) or a car-following law (--base). Give one of them.")
    with storage.results(out, SIMULATED, (source.path, model_path)):
        model = load_model(model_path) if model_path else Model((base_named(base or ""), Brakes()))
        return _simulate_file(source, model, str(model_path or base), out, seed, on_progress or silent)


def _simulate_file(
    source: Source, model: Model, name: str, out: Path, seed: int, progress: OnProgress
) -> dict[str, Any]:
    progress("reading", 0, 0, source.path.name)
    trajectories = source.trajectories()
    items = source.episodes(trajectories)
    progress("simulating", 0, 0, f"{len(items)} episodes")
    same = names_by_mark(trajectories, _drivers(items), model.fitted_on.get("tracks", ()))
    problem, values, matched = problem_of(model, items, seed, same)
    with torch.no_grad():
        error, simulated = errors(problem, values, torch.zeros(0, dtype=values.dtype))
    progress("writing", 0, 0, "the report")
    tables = [_simulated_table(problem, simulated, row) for row in range(len(items))]
    storage.write(out / "simulated.parquet", pl.concat(tables).write_parquet)
    result = {
        "model": name,
        "data": _data(trajectories, items),
        "drivers_with_own_parameters": matched,
        "drivers": drivers_in_words(model, matched, len(items)),
        "error": error.summary(),
        "fitted_on": _overlap(model, same, items, error),
        "seed": seed,
    }
    names = {"rows": in_words([error.summary()]), "shown": (problem, error, simulated), "pictures": pictures}
    title = f"{Path(name).name} behind the leaders of {source.path.name}"
    return page.write_report(out, title, TEMPLATES / "simulate.html", result, **names)


def in_words(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return errors under their names in words and units."""
    names = {"": "", "gap_rmse_m": "gap RMSE (m)", "gap_rmse_median_m": "median gap RMSE (m)"}
    names |= {"gap_mae_m": "mean |gap error| (m)", "speed_rmse_mps": "speed RMSE (m/s)"}
    names |= {name: name for name in ("collisions", "episodes")}
    return [{title: row[name] for name, title in names.items() if name in row} for row in rows]


def problem_of(
    model: Model, items: Episodes, seed: int = 0, same: Mapping[Track, str] | None = None
) -> tuple[Problem, torch.Tensor, int]:
    """Return a problem with all P parameters of a model, their values [episodes, P] (SI), and how many drivers it has.

    ``same`` are the names in the model of drivers whose tracks it was fitted on; others are looked for by their own.
    """
    batch = Batch.stack(items, substeps=model.substeps)
    effects = behind_records(model)
    simulator = Simulator(Lane(), effects, dt=batch.step, integration=model.integration)
    names = tuple(f"{e.name}.{p.name}" for e in effects for p in e.parameters)
    try:
        groups, labels = group_of(batch.episodes, model.by)
        keys = [labels[i] for i in groups.tolist()]
        if model.by == "driver":
            keys = [(same or {}).get(track, key) for track, key in zip(_drivers(items), keys, strict=True)]
    except DataError:  # these data lack the column by which the drivers were told apart
        keys = [""] * len(batch)
    owns = [key if key in model.drivers else None for key in keys]
    every = [model.params(own, dtype=torch.float64) for own in owns]
    rows = [torch.stack([p[n.split(".")[0]][n.split(".")[1]] for n in names]) for p in every]
    matched = sum(own is not None for own in owns)
    group = torch.arange(len(batch))
    problem = Problem(simulator, batch, names, (), group, tuple(str(i) for i in range(len(batch))), seed=seed)
    return problem, torch.stack(rows), matched


def _simulated_table(problem: Problem, simulated: Simulated, row: int) -> pl.DataFrame:
    episode = problem.batch.episodes[row]
    size = len(episode)
    gap = torch.cat((problem.batch.gap[:1, row], simulated.gap[: size - 1, row])).numpy()
    speed = torch.cat((problem.batch.speed[:1, row], simulated.speed[: size - 1, row])).numpy()
    names = {name: getattr(episode, name) for name in ("run_id", "vehicle_id", "leader_id", "time_s")}
    place = episode.leader.position_m - episode.leader.length_m - gap
    motion = {"position_m": place, "speed_mps": speed, "length_m": episode.length_m, "gap_m": gap}
    measured = {"measured_gap_m": episode.gap_m, "measured_speed_mps": episode.speed_mps}
    return pl.DataFrame(names | motion | measured)
