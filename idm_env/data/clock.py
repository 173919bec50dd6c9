"""Put every vehicle of a run on one regular clock; short holes are filled, long ones split the track later."""

from collections.abc import Iterable

import numpy as np
import polars as pl

from idm_env.data.clean import natural
from idm_env.data.errors import DataError, Repair, repaired
from idm_env.data.schema import TRACK, of_run, track_numbers

LONGEST_BRIDGE = 2.5
"""Two samples at most this many steps apart are joined: jitter and one missing row, never more."""
HOLE = 1.5
"""A difference of time above this many usual ones is a hole."""
CLOCK_ROUNDING_S = 1e-3
"""Times this close to the clock are on it: files round to milliseconds."""
SHORTEST_STEP_S = 1e-3
"""No traffic is measured more often than 1000 times a second (s)."""
UNSEEN_S = 10.0
"""A vehicle that is not measured for so long is still on the road, and in front of those behind it (s)."""
LINEAR = ("position_m", "speed_mps", "gap_m", "length_m")


def paces(frame: pl.DataFrame) -> pl.DataFrame:
    """Return, per vehicle of a sorted frame, the median difference of time, and sum and number of those not holes."""
    change = frame.select(*TRACK, pl.col("time_s").diff().over(TRACK).alias("change")).drop_nulls()
    change = change.with_columns(pl.col("change").median().over(TRACK).alias("middle"))
    near = change.filter(pl.col("change") < HOLE * pl.col("middle"))
    return near.group_by(TRACK).agg(pl.col("middle").first(), pl.col("change").sum().alias("total"), pl.len())


def steps_of(paces: pl.DataFrame, runs: Iterable[str], source: str) -> dict[str, float]:
    """Return each run's time step in s: the mean of the differences of time that are not holes.

    Raises:
        DataError: If no vehicle has two times, or a step is too short to be one.
    """
    usual = pl.col("middle") < HOLE * pl.col("middle").median().over("run_id")
    near = paces.filter(usual).group_by("run_id").agg(step=pl.col("total").sum() / pl.col("len").sum())
    if near.height == 0:
        raise DataError(f"{source}: no vehicle has two different times; a track needs at least 5 s of rows.")
    overall = float(near["step"].median())  # type: ignore[arg-type]
    steps = dict.fromkeys(runs, overall)
    for run, step in near.sort(natural("run_id"), "run_id").select("run_id", "step").rows():
        if step < SHORTEST_STEP_S:
            raise DataError(f"{source}: time_s rises by {step:g} s from row to row in run {run}; is it in seconds?")
        # 0.1000004 is a clock of 0.1 s; 0.0333 is not one of 0.033 s.
        steps[run] = round(step, 3) if abs(step - round(step, 3)) < 0.002 * step else step
    return steps


def regularise(
    frame: pl.DataFrame, steps: dict[str, float], starts: dict[str, float] | None = None, bridge: float = 0.0
) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame (sorted, times unique) on its runs' clocks, with the integer column ``step``.

    A clock begins at ``starts`` of its run (s), or at its first row. Holes up to ``bridge`` (s) are filled, too.

    Position, speed, gap and length are interpolated linearly in time; all other columns are taken from the sample
    nearest in time, as a place on a lap must not be averaged over its wrap.
    """
    first = pl.col("time_s").min().over("run_id") if starts is None else of_run(starts)
    columns = frame.select(of_run(steps).alias("step"), first.alias("start"))
    step, start = columns["step"].to_numpy(), columns["start"].to_numpy()
    exact = (frame["time_s"].to_numpy() - start) / step
    whole = np.round(exact)
    on_clock = np.abs(exact - whole) * step <= np.minimum(CLOCK_ROUNDING_S, 0.05 * step)
    exact = np.where(on_clock, whole, exact)
    track = track_numbers(frame)
    left, weight, ticks = _grid(exact, track, np.maximum(LONGEST_BRIDGE, bridge / step))
    times = start[left] + ticks * step[left]
    changed = weight > 0
    if changed.any() or len(left) != frame.height:
        same_leader = _same_leader(frame)[left]
        same = {"gap_m": same_leader}
        values = {name: _interpolated(frame[name], left, weight, same.get(name)) for name in frame.columns}
        result = pl.DataFrame(values)
    else:
        result = frame
    result = result.with_columns(pl.Series("time_s", times), pl.Series("step", ticks.astype(np.int64)))
    result = result.filter((pl.col("step").diff() != 0).fill_null(True) | (pl.struct(TRACK).rle_id().diff() != 0))
    return result, _repairs(track, on_clock, track[left[changed]])


def unseen(frame: pl.DataFrame, steps: dict[str, float]) -> tuple[pl.DataFrame, list[Repair]]:
    """Return rows for the holes up to ``UNSEEN_S`` of tracks: about where, and in which lane, these vehicles are.

    ``frame`` is what ``regularise`` returns. Who drives behind such a vehicle follows nobody else meanwhile.
    """
    position, step = pl.col("position_m"), pl.col("step")
    hole = (step.shift(-1) - step).over(TRACK).alias("hole")
    slope = ((position.shift(-1) - position).over(TRACK) / hole).alias("slope")
    holes = frame.with_columns(hole, slope).filter((pl.col("hole") > 1) & (pl.col("hole") * of_run(steps) <= UNSEEN_S))
    rows = holes.with_columns(pl.int_ranges(1, "hole").alias("beyond")).explode("beyond")
    rows = rows.with_columns(position + pl.col("beyond") * pl.col("slope"), step + pl.col("beyond"))
    keep = [name for name in (*TRACK, "step", "position_m", "lane", "ring_length_m") if name in frame.columns]
    words = f"holes of at most {UNSEEN_S:g} s in tracks: vehicles behind them have no gap there."
    return rows.select(keep), repaired("hole", holes.height, words)


def _grid(exact: np.ndarray, track: np.ndarray, bridge: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, per tick of the clock, the sample to its left, the weight of the one to its right, and the tick."""
    first = np.ceil(exact)
    joined = np.zeros(len(exact), bool)
    joined[:-1] = (track[1:] == track[:-1]) & (np.diff(exact) <= bridge[1:] + 1e-9)
    following = np.append(first[1:], 0.0)
    count = np.where(joined, following - first, first == exact).astype(int)
    left = np.repeat(np.arange(len(exact)), count)
    ticks = first[left] + (np.arange(len(left)) - np.repeat(np.cumsum(count) - count, count))
    span = np.where(joined, np.append(np.diff(exact), 1.0), 1.0)
    return left, (ticks - exact[left]) / span[left], ticks


def _same_leader(frame: pl.DataFrame) -> np.ndarray:
    """Say for every row whether the next one has the same leader: only then a gap can be interpolated."""
    if "leader_id" not in frame.columns:
        return np.ones(frame.height, bool)
    return frame["leader_id"].eq_missing(frame["leader_id"].shift(-1)).to_numpy()


def _interpolated(column: pl.Series, left: np.ndarray, weight: np.ndarray, same: np.ndarray | None) -> pl.Series:
    right = left + (weight > 0)
    if same is not None:
        weight = np.where(same, weight, np.round(weight))
    if column.name in LINEAR:
        values = column.to_numpy()
        before, after = values[left], values[right]
        mixed = np.where(weight > 0, before * (1 - weight) + after * weight, before)
        return pl.Series(column.name, mixed, nan_to_null=True)
    return column.gather(np.where(weight > 0.5, right, left))


def _repairs(track: np.ndarray, on_clock: np.ndarray, changed_tracks: np.ndarray) -> list[Repair]:
    jittered = np.unique(track[~on_clock])
    filled = int((~np.isin(changed_tracks, jittered)).sum())
    words = f"tracks had irregular times ({(~on_clock).sum()} rows) and were resampled onto a regular clock."
    return [
        *repaired("irregular time", len(jittered), words),
        *repaired(
            "missing row", filled, "single missing rows were filled by interpolation; longer holes split the track."
        ),
    ]
