"""Cuts one long recording into runs of equal duration, each driver in one of them only."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl

from idm_env.data import schema
from idm_env.data.errors import DataError, Repair
from idm_env.data.load import load
from idm_env.data.names import Columns
from idm_env.data.trajectories import Trajectories

LEAST_PIECES = 7
"""Runs with drivers of their own from which cutting is worth it: ``explain`` decides from seven runs on."""
SHORTEST_S, LONGEST_S = 20.0, 86400.0


def recordings(
    path: Path, *, ring_length: float | None = None, place: str | None = None, layout: str = "auto",
    columns: Columns = None, where: Sequence[str] | None = None, seconds: float | None = None,
) -> Trajectories:  # fmt: skip
    """Return the trajectories of a file, those that ``where`` selects, cut into runs of so many ``seconds``."""
    trajectories = load(path, ring_length=ring_length, place=place, layout=layout, columns=columns)
    trajectories = trajectories if where is None else trajectories.where(where)
    return trajectories if seconds is None else split_runs(trajectories, seconds)


def seconds_of(text: str | None) -> float | None:
    """Return the seconds of ``60s`` or ``60``. ValueError for any text but a duration of 20 s to a day."""
    if text is None:
        return None
    try:
        seconds = float(text.strip().lower().removesuffix("s"))
    except ValueError:
        raise ValueError(f"--split-runs = {text!r} is no duration. Write seconds: 60s.") from None
    if not SHORTEST_S <= seconds <= LONGEST_S:
        raise ValueError(f"--split-runs = {seconds:g} s is outside [{SHORTEST_S:g}, {LONGEST_S:g}] s.")
    return seconds


def split_runs(trajectories: Trajectories, seconds: float) -> Trajectories:
    """Return trajectories whose runs last ``seconds``: run ``a`` becomes ``a@0s``, ``a@60s``, ….

    A driver counts in the run in which most of his samples are, and is a neighbour in all others. So no driver is both
    fitted and held out.

    Raises:
        DataError: If fewer than seven runs have a driver of their own, as where a platoon stays together.
    """
    passed = (pl.col("time_s") - pl.col("time_s").min().over("run_id") + 1e-6) / seconds
    pieces = trajectories.table.with_columns(pl.col("run_id").alias("_run"), passed.floor().alias("_piece"))
    begin = (pl.col("_piece") * seconds).round(3).cast(pl.String).str.strip_suffix(".0")
    pieces = pieces.with_columns(pl.format("{}@{}s", "run_id", begin).alias("run_id"))
    drivers, track = _fitted_drivers(trajectories), ["_run", "vehicle_id"]
    home = pieces.join(drivers, left_on=track, right_on=schema.TRACK, how="semi")
    home = home.group_by(*track, "_piece", "run_id").len()
    home = home.sort(*track, "len", "_piece", descending=[False, False, True, False])
    home = home.unique(track, keep="first", maintain_order=True)
    count = home["run_id"].n_unique()
    if count < LEAST_PIECES:
        raise DataError(
            f"{trajectories.source}: of pieces of {seconds:g} s only {count} would have drivers of their own, not "
            f"{LEAST_PIECES}: vehicles stay in view too long. Record more runs, or take shorter pieces."
        )
    runs = dict(pieces.select("run_id", "_run").unique(maintain_order=True).rows())
    text = (
        f"{len(trajectories.runs())} recordings were cut into {len(runs)} runs of {seconds:g} s (--split-runs); "
        f"a driver counts in one of them."
    )
    return replace(
        trajectories,
        table=pieces.drop("_piece", "_run").sort(*schema.TRACK, "time_s"),
        repairs=(*trajectories.repairs, Repair("recordings cut into runs", len(runs), text)),
        steps={run: trajectories.steps[old] for run, old in runs.items()},
        recordings=runs,
        drivers=frozenset(home.select("run_id", "vehicle_id").rows()),
    )


def cure(trajectories: Trajectories) -> str | None:
    """Return advice on cutting one recording into runs, the longest that serve; None of several recordings.

    A vehicle that follows nobody makes no run.
    """
    if len({run for run, _ in trajectories.followers()}) != 1:
        return None
    for seconds in (120.0, 60.0, 30.0):
        try:
            split_runs(trajectories, seconds)
        except DataError:
            continue
        return f"Its vehicles come and go, so it can be cut: add --split-runs {seconds:g}s."
    return f"The same vehicles stay in view, so cutting it would not help: record {LEAST_PIECES} runs or more."


def _fitted_drivers(trajectories: Trajectories) -> pl.DataFrame:
    """Return run and vehicle of everybody who follows somebody and may be fitted."""
    return pl.DataFrame(trajectories.followers(), schema=dict.fromkeys(schema.TRACK, pl.String), orient="row")
