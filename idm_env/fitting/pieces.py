"""A fit in parts: some drivers each, fitted by the executor's workers, joined afterwards.

Parts know nothing of each other: a part's drivers start from the pooled optimum of that part. So a part is the same
bytes wherever and how often it is done.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import torch

from idm_env.data import DataError, Episode, Repair
from idm_env.data.errors import Counted
from idm_env.data.fingerprint import marks
from idm_env.data.folder import FolderSlice
from idm_env.fitting import drivers, pictures
from idm_env.fitting.evaluate import Errors, errors
from idm_env.fitting.fit import fit
from idm_env.fitting.options import Options, Source
from idm_env.fitting.problem import group_of
from idm_env.jobs.executor import Executor
from idm_env.jobs.progress import OnProgress
from idm_env.jobs.shards import Parts
from idm_env.reports import page

PART = 2000
"""Drivers of a part, about."""
PARAMETERS, DRIVERS, ERRORS = "parameters", "drivers", "errors"


@dataclass(frozen=True)
class Piece:
    """A part of a fit: the episodes in hand, or runs of a folder that are read where they are fitted."""

    number: int
    of: int
    data: Sequence[Episode] | FolderSlice
    source: Source
    options: Options
    by: str
    parts: Parts
    checkpoint: Path | None = None
    resume: bool = False

    def __str__(self) -> str:
        if isinstance(self.data, FolderSlice):
            return str(self.data)
        first, last = (f"{e.run_id}/{e.vehicle_id}" for e in (self.data[0], self.data[-1]))
        return f"drivers {first} to {last}"


def cut(items: Sequence[Episode], by: str, size: int) -> list[list[Episode]]:
    """Return episodes in parts of ``size`` groups each, in the order of the groups."""
    group, names = group_of(items, by)
    cuts: list[list[Episode]] = [[] for _ in range(-(-len(names) // size))]
    for number, episode in zip(group.tolist(), items, strict=True):
        cuts[number // size].append(episode)
    return cuts


def run(executor: Executor, pieces: Sequence[Piece], on_progress: OnProgress) -> None:
    """Fit all pieces that are not done yet; PartsError names those that failed."""
    missing = [piece for piece in pieces if not piece.parts.done(piece.number)]
    done = len(pieces) - len(missing)
    for _ in executor.map(_fit_piece, missing, on_progress):
        done += 1
        if len(pieces) > 1:
            on_progress("parts", done, len(pieces), "")


def _fit_piece(piece: Piece, on_progress: OnProgress) -> None:
    """Fit one piece and write what is found; what a folder's data do not allow is left out and told."""
    parts, number, options = piece.parts, piece.number, piece.options
    summary: dict[str, Any] = {}
    if isinstance(piece.data, FolderSlice):
        try:
            trajectories = piece.source.trajectories(piece.data)
            chosen = piece.source.episodes(trajectories)
        except DataError as wrong:
            parts.finish(number, {"lost": str(wrong), "share": str(piece.data)})
            return
        data = {k: v for k, v in trajectories.summary().items() if k not in ("source", "repairs")}
        summary = {"data": data, "repairs": trajectories.repairs, "left_out": chosen.left_out}
        summary["tracks"] = marks(trajectories, [(e.run_id, e.vehicle_id) for e in chosen])
    items = piece.data if isinstance(piece.data, Sequence) else chosen
    simulator, fixed = options.simulator()
    names = ("objective", "relative", "loss", "method", "starts", "seed", "substeps")
    how: dict[str, Any] = {name: getattr(options, name) for name in names}
    how |= {"checkpoint": piece.checkpoint, "resume": piece.resume, "on_progress": on_progress}
    result = fit(items, by=piece.by, simulator=simulator, fixed=fixed, **how)
    on_progress("errors", 0, 0, "in free simulation")
    error, simulated = errors(result.problem, result.own, result.shared)
    parts.write(number, PARAMETERS, pl.DataFrame(result.table()))
    parts.write(number, DRIVERS, pl.DataFrame(drivers.table(result, error, piece.by)).fill_nan(None))
    parts.write(number, ERRORS, pl.DataFrame({name: getattr(error, name).numpy() for name in Errors._fields}))
    figures = []
    if number == 0:
        figures = [pictures.examples(result.problem, error, simulated), pictures.residuals(result.problem, simulated)]
        figures += pictures.space_time(result.problem, simulated)
    summary |= {"iterations": result.iterations, "converged": int(result.converged.sum())}
    parts.finish(number, {**summary, "dt": result.problem.batch.dt, "pictures": figures})


@dataclass(frozen=True, eq=False)
class JoinedFit:
    """Results of all pieces of a fit: estimates, errors of every episode, and the summary of each piece."""

    parts: Parts
    estimates: drivers.Estimates
    errors: Errors
    summaries: list[dict[str, Any]]
    lost: list[dict[str, Any]]

    @property
    def converged(self) -> int:
        """How many groups converged."""
        return sum(summary["converged"] for summary in self.summaries)

    @property
    def iterations(self) -> int:
        """Most iterations of any piece."""
        return max(summary["iterations"] for summary in self.summaries)

    @property
    def pictures(self) -> list[page.Block]:
        """Measured against simulated, residuals, and space and time, of the first piece that has them."""
        return [page.Block(**block) for summary in self.summaries for block in summary["pictures"]]


def join(parts: Parts, options: Options) -> JoinedFit:
    """Return the joined results of the pieces. DataError if none has any."""
    summaries = parts.summaries()
    good = [summary for summary in summaries if "lost" not in summary]
    if not good:
        raise DataError(f"no part can be fitted: {summaries[0]['lost']}" if summaries[1:] else summaries[0]["lost"])
    odd = next((s["dt"] for s in good if abs(s["dt"] - good[0]["dt"]) > 1e-9), None)
    if odd is not None:
        raise DataError(f"some runs have steps of {good[0]['dt']:g} s, others of {odd:g} s. Give one --dt.")
    simulator, fixed = options.simulator()
    table = pl.concat([pl.read_parquet(path, glob=False) for path in parts.tables(PARAMETERS)])
    errors = pl.concat([pl.read_parquet(path, glob=False) for path in parts.tables(ERRORS)])
    estimates = drivers.Estimates.joined(table, simulator, good[0]["dt"], fixed)
    measures = Errors(*(torch.from_numpy(errors[name].to_numpy().copy()) for name in Errors._fields))
    return JoinedFit(parts, estimates, measures, good, [summary for summary in summaries if "lost" in summary])


def account_of(joined: JoinedFit, source: str) -> dict[str, Any]:
    """Return the counts of all parts of a folder, as ``Trajectories.summary`` has them of a file."""
    data = [summary["data"] for summary in joined.summaries]
    repairs, left_out = Counted(), Counted()
    for summary in joined.summaries:
        repairs.add([Repair(**one) for one in summary["repairs"]])
        left_out.add([Repair(**one) for one in summary["left_out"]])
    left_out.add([Repair("part", 1, f"{summary['share']} left out: {summary['lost']}") for summary in joined.lost])
    sums = ("rows", "runs", "vehicles", "followers", "vehicle_seconds")
    return {
        "source": source,
        **{name: sum(one[name] for one in data) for name in sums},
        "time_steps_s": sorted({step for one in data for step in one["time_steps_s"]}),
        "place": data[0]["place"],
        "repairs": [{"kind": r.kind, "count": r.count, "text": r.text} for r in repairs.repairs()],
        "left_out": [r.text for r in left_out.repairs()],
        "episodes": len(joined.errors.gap_rmse),
        "account": page.account(repairs.repairs(), left_out.repairs()),
    }
