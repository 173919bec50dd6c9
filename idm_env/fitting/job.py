"""The commands ``fit`` and ``simulate``: a file of measured traffic in, a folder of results out."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import torch

from idm_env import report as page
from idm_env.config import Model, Numbers, load_model, save_model
from idm_env.data import LEADER_LOST_GAP_M, DataError, Episodes, Trajectories, episodes, load
from idm_env.effects import Effect, Replay
from idm_env.fitting import pictures
from idm_env.fitting.batch import Batch, windows
from idm_env.fitting.evaluate import Errors, errors, own_for
from idm_env.fitting.fit import Fit, Method, OnProgress, base_simulator, fit
from idm_env.fitting.problem import Loss, Objective, Problem, Simulated, group_of
from idm_env.roads import Lane
from idm_env.simulator import Integration, Simulator


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

    def simulator(self) -> tuple[Simulator, dict[str, float]]:
        """Return what is calibrated and the parameters that stay: IDM, or a saved model whose effects are kept."""
        if self.model is None:
            return base_simulator(integration=self.integration), {}
        saved = load_model(Path(self.model))
        simulator = Simulator(Lane(), _behind_records(saved), dt=saved.dt, integration=saved.integration)
        kept = {
            f"{effect}.{name}": float(value)
            for effect, parameters in saved.parameters.items() if effect != "idm"
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
    """Fit IDM to a file; write parameters.parquet, model.yaml, report.json and report.html; return the report.

    Held-out runs take no part in the fit. Where their group was fitted they are simulated with its parameters,
    otherwise with those of a pooled fit of the fitting runs. DataError and ValueError for what cannot be read or
    fitted.
    """
    page.output_folder(out)
    trajectories = source.trajectories()
    fitting, held = trajectories, None
    if options.held_out is not None:
        fitting, held = trajectories.split(options.held_out, seed=options.seed)
    chosen = source.episodes(fitting)
    simulator, kept = options.simulator()

    def run(by: str, checkpoint: str) -> Fit:
        return fit(
            chosen, by=by, simulator=simulator, objective=options.objective, relative=options.relative,
            loss=options.loss, method=options.method, starts=options.starts, seed=options.seed,
            substeps=options.substeps, fixed=kept, checkpoint=out / checkpoint, resume=resume, on_progress=on_progress,
        )  # fmt: skip

    found = run(options.by, "fit.resume.pt")
    error, simulated = errors(found.problem, found.own, found.shared)
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
        "parameters": found.table(),
        "versions": page.versions(),
    }
    if held is not None:
        pooled = found if options.by == "all" else run("all", "pooled.resume.pt")
        result["held_out"] = _held_out(source, options, held, found, pooled)
    pl.DataFrame(result["parameters"]).write_parquet(out / "parameters.parquet")
    save_model(out / "model.yaml", dataclasses.replace(model_of(found, options.by), substeps=options.substeps))
    page.write_json(out / "report.json", result)
    page.write_page(
        out / "report.html", f"IDM fitted to {source.path.name}", _fit_page(result, found, error, simulated)
    )
    return result


def _held_out(source: Source, options: Options, held: Trajectories, found: Fit, pooled: Fit) -> dict[str, Any]:
    """Return the errors on runs that the fit has not seen."""
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
    }


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


def _fit_page(result: dict[str, Any], found: Fit, error: Errors, simulated: Simulated) -> list[page.Block]:
    doubtful = [
        f"{row['group']}: {row['parameter']} = {row['estimate']:.3g} {row['unit']}"
        + (" sits on its bound" if row["at_bound"] else " is not identified by these data")
        for row in result["parameters"]
        if row["at_bound"] or not row["identified"]
    ]
    repairs = [*(r["text"] for r in result["data"]["repairs"]), *result["data"]["left_out"]]
    held = result["held_out"]
    lead = (
        f"{result['fit']['episodes']} episodes of {result['fit']['groups']} groups: mean gap RMSE "
        f"{result['fit']['gap_rmse_m']:.2f} m, speed RMSE {result['fit']['speed_rmse_mps']:.2f} m/s, in free "
        "simulation behind the measured leader."
    )
    if held is not None:
        lead += f" On {held['episodes']} episodes held out: {held['gap_rmse_m']:.2f} m."
    rows = [{"": "fitted", **result["fit"]}] + ([] if held is None else [{"": "held out", **held}])
    names = ("", "gap_rmse_m", "gap_rmse_median_m", "gap_mae_m", "speed_rmse_mps", "collisions", "episodes")
    return [
        page.lead(lead),
        page.table(rows, names),
        page.note(
            f"{result['fit']['converged']} of {result['fit']['groups']} groups converged. Standard errors allow for "
            "correlated residuals, not for a wrong model."
        ),
        page.heading("Measured and simulated"),
        pictures.examples(found.problem, error, simulated),
        page.heading("Parameters"),
        *([pictures.parameters(found)] if len(found.problem.groups) > 1 else []),
        page.table(result["parameters"][:200]),
        *([page.note("The first 200 rows of parameters.parquet.")] if len(result["parameters"]) > 200 else []),
        page.heading(f"Doubtful parameters: {len(doubtful)} of {len(result['parameters'])}"),
        page.bullets(doubtful[:40] or ["none"]),
        page.heading("Data"),
        page.bullets(repairs or ["Nothing was repaired or left out."]),
    ]


def simulate_file(source: Source, model_path: Path, out: Path, *, seed: int = 0) -> dict[str, Any]:
    """Roll a saved model behind the measured leaders; write simulated.parquet, report.json and report.html.

    A driver takes the parameters of ``drivers`` whose key is his, by the model's ``by``, otherwise the model's own.
    Noise is drawn with ``seed``.
    """
    page.output_folder(out)
    model = load_model(model_path)
    trajectories = source.trajectories()
    items = source.episodes(trajectories)
    problem, values, matched = problem_of(model, items, seed)
    with torch.no_grad():
        error, simulated = errors(problem, values, torch.zeros(0, dtype=values.dtype))
    tables = [_simulated_table(problem, simulated, row) for row in range(len(items))]
    pl.concat(tables).write_parquet(out / "simulated.parquet")
    result = {
        "schema": 1,
        "command": page.command_line(),
        "model": str(model_path),
        "data": {**trajectories.summary(), "left_out": [str(r) for r in items.left_out], "episodes": len(items)},
        "drivers_with_own_parameters": matched,
        "error": error.summary(),
        "seed": seed,
        "versions": page.versions(),
    }
    page.write_json(out / "report.json", result)
    blocks = [
        page.lead(
            f"{len(items)} episodes simulated behind their measured leaders: mean gap RMSE "
            f"{error.summary()['gap_rmse_m']:.2f} m. {matched} of them have driver parameters of their own."
        ),
        page.table([error.summary()]),
        pictures.examples(problem, error, simulated),
    ]
    page.write_page(out / "report.html", f"{model_path.name} behind the leaders of {source.path.name}", blocks)
    return result


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
