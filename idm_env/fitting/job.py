"""The commands ``fit`` and ``simulate``: a file of measured traffic in, a folder of results out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import torch

from idm_env import keep
from idm_env import report as page
from idm_env.config import Model, Numbers, load_model, save_model
from idm_env.data import LEADER_LOST_GAP_M, DataError, Episodes, Repair, Trajectories, episodes, load
from idm_env.data.episode import windows
from idm_env.data.fingerprint import fingerprints, fitted_on
from idm_env.effects import Brakes, Effect, Replay, base_named
from idm_env.fitting import drivers, pictures
from idm_env.fitting.batch import Batch
from idm_env.fitting.evaluate import Errors, errors, own_for
from idm_env.fitting.fit import Fit, Method, base_simulator, fit
from idm_env.fitting.problem import Loss, Objective, Problem, Simulated, group_of
from idm_env.progress import OnProgress, silent
from idm_env.roads import Lane
from idm_env.simulator import Integration, Simulator

FITTED = ("parameters.parquet", "drivers.csv", "model.yaml", "report.json", "report.html")
SIMULATED = ("simulated.parquet", "report.json", "report.html")
"""What ``fit_file`` and ``simulate_file`` write."""


@dataclass(frozen=True)
class Source:
    """How a file is read: see ``idm_env.data.load`` and ``episodes``.

    ``where`` (``column=value``, or several that must all hold) selects runs or drivers; ``window`` (s) cuts long
    episodes.
    """

    path: Path
    ring_length: float | None = None
    place: str | None = None
    layout: str = "auto"
    max_gap: float | None = LEADER_LOST_GAP_M
    min_seconds: float = 5.0
    dt: float | None = None
    smooth: bool = False
    window: float | None = None
    where: str | Sequence[str] | None = None

    def trajectories(self) -> Trajectories:
        """Read and check the file."""
        read = load(self.path, ring_length=self.ring_length, place=self.place, layout=self.layout)
        return read if self.where is None else read.where(self.where)

    def episodes(self, trajectories: Trajectories) -> Episodes:
        """Return the drivers behind leaders, cut to windows where asked."""
        found = episodes(
            trajectories, min_seconds=self.min_seconds, max_gap=self.max_gap, smooth=self.smooth, dt=self.dt
        )
        if self.window is None:
            return found
        return Episodes(tuple(windows(found, self.window)), found.left_out)


@dataclass(frozen=True)
class Options:
    """How a model is fitted, as in ``idm_env.fitting.fit.fit``; ``held_out``: ``column=value`` or a share of runs."""

    by: str = "driver"
    held_out: str | float | None = None
    objective: Objective = "spacing"
    relative: bool = False
    loss: Loss = "rmse"
    method: Method = "lm"
    integration: Integration = "ballistic"
    starts: int = 4
    seed: int = 0
    substeps: int | None = None
    model: str | None = None
    base: str | None = None

    def simulator(self) -> tuple[Simulator, dict[str, float]]:
        """Return what is calibrated and the parameters that stay.

        That is the car-following law ``base`` (None: IDM), or a saved model, whose effects are kept.
        """
        if self.model is None:
            return base_simulator(base=base_named(self.base or "idm"), integration=self.integration), {}
        if self.base is not None:
            raise ValueError(f"base = '{self.base}', and the model {self.model} has one. Leave one of them out.")
        saved = load_model(Path(self.model))
        simulator = Simulator(Lane(), _behind_records(saved), dt=saved.dt, integration=saved.integration)
        kept = {
            f"{effect}.{name}": float(value)
            for effect, parameters in saved.parameters.items() if effect != simulator.base.name
            for name, value in parameters.items()
        }  # fmt: skip
        return simulator, kept


def _behind_records(model: Model) -> tuple[Effect, ...]:
    """Return a model's effects with replayed leaders, without an agent's control."""
    effects = tuple(e for e in model.effects if e.name != "control")
    return effects if "replay" in {e.name for e in effects} else (*effects, Replay())


def fit_file(
    source: Source, options: Options, out: Path, *, resume: bool = False, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Fit IDM, or another car-following law, to a file and return the report; write it, the parameters and the model.

    Writes ``parameters.parquet`` (one row per group and parameter), ``drivers.csv`` (one row per group),
    ``model.yaml``, ``report.json`` and ``report.html``.

    Held-out runs take no part in the fit. Where their group was fitted they are simulated with its parameters,
    otherwise with those of a pooled fit of the fitting runs. DataError and ValueError for what cannot be read or
    fitted.
    """
    with keep.results(out, FITTED, (source.path, options.model)):
        return _fit_file(source, options, out, resume, on_progress or silent)


def _fit_file(source: Source, options: Options, out: Path, resume: bool, progress: OnProgress) -> dict[str, Any]:
    progress("reading", 0, 0, source.path.name)
    trajectories = source.trajectories()
    fitting, held = trajectories, None
    if options.held_out is not None:
        fitting, held = trajectories.split(options.held_out, seed=options.seed)
    chosen = source.episodes(fitting)
    simulator, kept = options.simulator()

    def run(by: str, checkpoint: str, before: str = "") -> Fit:
        return fit(
            chosen, by=by, simulator=simulator, objective=options.objective, relative=options.relative,
            loss=options.loss, method=options.method, starts=options.starts, seed=options.seed,
            substeps=options.substeps, fixed=kept, checkpoint=out / keep.UNFINISHED / checkpoint, resume=resume,
            on_progress=lambda phase, *state: progress(before + phase, *state),
        )  # fmt: skip

    found = run(options.by, "fit")
    progress("errors", 0, 0, "in free simulation")
    error, simulated = errors(found.problem, found.own, found.shared)
    left_out = list(chosen.left_out)
    bounds = drivers.bounds(found)
    result: dict[str, Any] = {
        "schema": 1,
        "command": page.command_line(),
        "data": {**trajectories.summary(), "left_out": [str(r) for r in chosen.left_out], "episodes": len(chosen)},
        "options": {**vars(options), "free": found.names},
        "fit": {
            **error.summary(),
            "groups": len(found.problem.groups),
            "converged": int(found.converged.sum()),
            "iterations": found.iterations,
        },
        "held_out": None,
        "at_bounds": drivers.sentence(bounds),
        "bounds": bounds,
        "parameters": found.table(),
        "versions": page.versions(),
    }
    if held is not None:
        pooled = found if options.by == "all" else run("all", "pooled", "held out: ")
        result["held_out"], lost = _held_out(source, options, held, found, pooled)
        left_out += lost
    result["data"]["account"] = _account(trajectories, left_out)
    progress("writing", 0, 0, "the report")
    table = drivers.table(found, error)
    keep.write(out / "drivers.csv", pl.DataFrame(table).write_csv)
    keep.write(out / "parameters.parquet", pl.DataFrame(result["parameters"]).write_parquet)
    marked = fitted_on(trajectories, _drivers(chosen))
    model = dataclasses.replace(model_of(found, options.by), substeps=options.substeps, fitted_on=marked)
    save_model(out / "model.yaml", model)
    page.write_json(out / "report.json", result)
    title = f"{simulator.base.title} fitted to {source.path.name}"
    page.write_page(out / "report.html", title, _fit_page(result, found, error, simulated, table))
    return result


def _drivers(items: Episodes) -> list[tuple[str, str]]:
    return [(episode.run_id, episode.vehicle_id) for episode in items]


def _account(trajectories: Trajectories, left_out: Iterable[Repair]) -> str:
    return page.account(((r.kind, r.count) for r in trajectories.repairs), ((r.kind, r.count) for r in left_out))


def _held_out(
    source: Source, options: Options, held: Trajectories, found: Fit, pooled: Fit
) -> tuple[dict[str, Any], tuple[Repair, ...]]:
    """Return the errors on runs that the fit has not seen, and what of them was left out."""
    items = source.episodes(held)
    batch = Batch.of(items, substeps=options.substeps)
    group, names = group_of(batch.episodes, options.by)
    fitted = found.problem
    problem = Problem(
        fitted.simulator, batch, fitted.own, (), group, names,
        objective=fitted.objective, relative=fitted.relative, loss=fitted.loss, fixed=fitted.fixed,
    )  # fmt: skip
    own, unseen = own_for(found, problem, pooled.own[0])
    error, _ = errors(problem, own, found.shared)
    return {
        **error.summary(),
        "runs": held.runs(),
        "groups_not_fitted": len(unseen),
        "left_out": [str(r) for r in items.left_out],
    }, items.left_out


def model_of(found: Fit, by: str = "driver") -> Model:
    """Return a fit ``by`` groups as a model: their median as its parameters, every group as a driver of its own."""
    values = found.values()

    def numbers(row: torch.Tensor) -> Numbers:
        nested: Numbers = {}
        for name, value in zip(found.names, row.tolist(), strict=True):
            effect, parameter = name.split(".")
            nested.setdefault(effect, {})[parameter] = value
        return nested

    simulator = found.problem.simulator
    several = len(found.problem.groups) > 1
    middle = numbers(values.median(0).values)
    for name, value in found.problem.fixed.items():
        effect, parameter = name.split(".")
        middle.setdefault(effect, {})[parameter] = value
    return Model(
        effects=simulator.without("replay").effects if "replay" in simulator.by_name else simulator.effects,
        parameters=middle,
        dt=found.problem.batch.dt,
        integration=simulator.integration,
        drivers={g: numbers(values[i]) for i, g in enumerate(found.problem.groups)} if several else {},
        by=by,
    )


def _fit_page(
    result: dict[str, Any], found: Fit, error: Errors, simulated: Simulated, table: list[dict[str, Any]]
) -> list[page.Block]:
    held = result["held_out"]
    lead = (
        f"{result['fit']['episodes']} episodes of {result['fit']['groups']} groups: mean gap RMSE "
        f"{result['fit']['gap_rmse_m']:.2f} m, speed RMSE {result['fit']['speed_rmse_mps']:.2f} m/s, in free "
        "simulation behind the measured leader."
    )
    if held is not None:
        lead += f" On {held['episodes']} episodes held out: {held['gap_rmse_m']:.2f} m."
    rows = [{"": "fitted", **result["fit"]}] + ([] if held is None else [{"": "held out", **held}])
    return [
        page.lead(lead),
        page.lead(result["at_bounds"]),
        _errors_table(rows),
        page.note(
            f"{result['fit']['converged']} of {result['fit']['groups']} groups converged. A value on its bound is not "
            "an estimate: the data would have it beyond."
        ),
        page.heading("Measured and simulated"),
        pictures.examples(found.problem, error, simulated),
        page.heading("Residuals"),
        pictures.residuals(found.problem, simulated),
        page.heading("In space and time"),
        *pictures.space_time(found.problem, simulated),
        page.heading("Parameters"),
        *([pictures.parameters(found)] if len(found.problem.groups) > 1 else []),
        *drivers.blocks(found, table, result["bounds"]),
        *_data_section(result),
    ]


def _data_section(result: dict[str, Any]) -> list[page.Block]:
    """Return what the data are, and what was repaired or left out."""
    data = result["data"]
    size = (
        f"{data['source']}: {data['rows']} rows, {data['vehicles']} vehicles in {data['runs']} runs, "
        f"{data['followers']} followers, {data['episodes']} episodes."
    )
    return [
        page.heading("Data"),
        page.text(size),
        page.text(data["account"]),
        page.bullets([*(r["text"] for r in data["repairs"]), *data["left_out"]]),
    ]


def _seen(model: Model, trajectories: Trajectories, items: Episodes, error: Errors) -> dict[str, Any]:
    """Return how many episodes are of tracks that the model was fitted on, the error on the others, and it in words."""
    tracks = fingerprints(trajectories, _drivers(items))
    known = set(model.fitted_on.get("tracks", ()))
    new = torch.tensor([tracks[driver] not in known for driver in _drivers(items)])
    count, others = int((~new).sum()), float(error.gap_rmse[new].mean()) if new.any() else None
    if not known:
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
    return {
        "source": model.fitted_on.get("source"), "episodes_fitted_on": count if known else None,
        "gap_rmse_of_others_m": others if known else None, "words": words,
    }  # fmt: skip


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
    Noise is drawn with ``seed``.
    """
    if (model_path is None) == (base is None):
        raise ValueError("simulate takes either a model (--model) or a car-following law (--base). Give one of them.")
    with keep.results(out, SIMULATED, (source.path, model_path)):
        model = load_model(model_path) if model_path else Model((base_named(base or ""), Brakes()))
        return _simulate_file(source, model, str(model_path or base), out, seed, on_progress or silent)


def _simulate_file(
    source: Source, model: Model, name: str, out: Path, seed: int, progress: OnProgress
) -> dict[str, Any]:
    progress("reading", 0, 0, source.path.name)
    trajectories = source.trajectories()
    items = source.episodes(trajectories)
    progress("simulating", 0, 0, f"{len(items)} episodes")
    problem, values, matched = problem_of(model, items, seed)
    with torch.no_grad():
        error, simulated = errors(problem, values, torch.zeros(0, dtype=values.dtype))
    progress("writing", 0, 0, "the report")
    tables = [_simulated_table(problem, simulated, row) for row in range(len(items))]
    keep.write(out / "simulated.parquet", pl.concat(tables).write_parquet)
    result: dict[str, Any] = {
        "schema": 1,
        "command": page.command_line(),
        "model": name,
        "data": {
            **trajectories.summary(),
            "left_out": [str(r) for r in items.left_out],
            "episodes": len(items),
            "account": _account(trajectories, items.left_out),
        },
        "drivers_with_own_parameters": matched,
        "error": error.summary(),
        "fitted_on": _seen(model, trajectories, items, error),
        "seed": seed,
        "versions": page.versions(),
    }
    page.write_json(out / "report.json", result)
    blocks = [
        page.lead(
            f"{len(items)} episodes simulated behind their measured leaders: mean gap RMSE "
            f"{error.summary()['gap_rmse_m']:.2f} m, {result['fitted_on']['words']} {matched} of them have driver "
            "parameters of their own."
        ),
        _errors_table([error.summary()]),
        pictures.examples(problem, error, simulated),
        page.heading("Residuals"),
        pictures.residuals(problem, simulated),
        page.heading("In space and time"),
        *pictures.space_time(problem, simulated),
        *_data_section(result),
    ]
    page.write_page(out / "report.html", f"{Path(name).name} behind the leaders of {source.path.name}", blocks)
    return result


def _errors_table(rows: list[dict[str, Any]]) -> page.Block:
    """Return a table of errors under their names in words and units."""
    names = {
        "": "", "gap_rmse_m": "gap RMSE (m)", "gap_rmse_median_m": "median gap RMSE (m)",
        "gap_mae_m": "mean |gap error| (m)", "speed_rmse_mps": "speed RMSE (m/s)", "collisions": "collisions",
        "episodes": "episodes",
    }  # fmt: skip
    return page.table([{title: row[name] for name, title in names.items() if name in row} for row in rows])


def problem_of(model: Model, items: Episodes, seed: int = 0) -> tuple[Problem, torch.Tensor, int]:
    """Return a problem with all parameters of a model, their values per episode, and how many drivers were matched."""
    batch = Batch.of(items, substeps=model.substeps)
    effects = _behind_records(model)
    simulator = Simulator(Lane(), effects, dt=batch.step, integration=model.integration)
    names = tuple(f"{e.name}.{p.name}" for e in effects for p in e.parameters)
    try:
        groups, labels = group_of(batch.episodes, model.by)
        keys = [labels[i] for i in groups.tolist()]
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
    return pl.DataFrame(
        {
            "run_id": episode.run_id,
            "vehicle_id": episode.vehicle_id,
            "leader_id": episode.leader_id,
            "time_s": episode.time_s,
            "position_m": episode.leader.position_m - episode.leader.length_m - gap,
            "speed_mps": speed,
            "length_m": episode.length_m,
            "gap_m": gap,
            "measured_gap_m": episode.gap_m,
            "measured_speed_mps": episode.speed_mps,
        }
    )
