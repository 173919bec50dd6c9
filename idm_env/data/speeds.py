"""Complete what a file leaves open: positions unwrapped on a ring, lengths assumed, speeds estimated; each counted."""

import numpy as np
import polars as pl

from idm_env.data import schema
from idm_env.data.errors import Repair, repaired
from idm_env.data.smooth import noise_sigma, smooth


def unwrapped(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with positions that go on rising where a vehicle passes the start of its ring."""
    if "ring_length_m" not in frame.columns:
        return frame, []
    change = pl.col("position_m").diff().over(schema.TRACK)
    # half a ring between two samples can only be the jump at its start
    jump = (
        pl.when(change < -pl.col("ring_length_m") / 2)
        .then(1)
        .when(change > pl.col("ring_length_m") / 2)
        .then(-1)
        .otherwise(0)
    )
    laps = jump.cum_sum().over(schema.TRACK)
    count = int(frame.select(jump.abs().sum()).item())
    driven = pl.coalesce(laps * pl.col("ring_length_m"), pl.lit(0.0))
    frame = frame.with_columns((pl.col("position_m") + driven).alias("position_m"))
    return frame, repaired("unwrapped", count, "jumps of position at the start of the ring were unwrapped.")


def lengths(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with a length for every vehicle: its median, or the default where the file gives none."""
    empty = frame["length_m"].null_count() if "length_m" in frame.columns else frame.height
    median = pl.col("length_m").median().over(schema.TRACK) if "length_m" in frame.columns else pl.lit(None, pl.Float64)
    frame = frame.with_columns(median.alias("length_m"))
    without = frame.filter(pl.col("length_m").is_null()).select(schema.TRACK).n_unique()
    filled = empty - frame["length_m"].null_count()
    words = "missing values of length_m were taken from other rows of the same vehicle."
    repairs = repaired("length filled", filled, words) + length_assumed(without)
    return frame.with_columns(pl.col("length_m").fill_null(schema.DEFAULT_LENGTH_M)), repairs


def length_assumed(without: int) -> list[Repair]:
    """Return the repair that counts vehicles without a length."""
    return repaired("length assumed", without, f"vehicles have no length_m; {schema.DEFAULT_LENGTH_M} m is assumed.")


def complete(frame: pl.DataFrame, steps: dict[str, float]) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with speed_mps in every row, estimated from the smoothed positions where it is missing."""
    absent = "speed_mps" not in frame.columns
    if absent:
        frame = frame.with_columns(pl.lit(None, pl.Float64).alias("speed_mps"))
    count = frame["speed_mps"].null_count()
    if not count:
        return frame, []
    position, speed = frame["position_m"].to_numpy(), frame["speed_mps"].to_numpy().copy()
    step = frame.select(schema.of_run(steps))["run_id"].to_numpy()
    for begin, end in stretches(frame):
        hole = np.isnan(speed[begin:end])
        if hole.any():
            speed[begin:end][hole] = _estimated(position[begin:end], float(step[begin]))[hole]
    text = (
        f"speed_mps is absent: {count} speeds were estimated from smoothed positions."
        if absent
        else f"{count} missing values of speed_mps were estimated from smoothed positions."
    )
    speed = np.clip(speed, schema.LOWEST_SPEED_MPS, schema.HIGHEST_SPEED_MPS)
    return frame.with_columns(pl.Series("speed_mps", speed)), [Repair("speed estimated", count, text)]


def stretches(frame: pl.DataFrame) -> list[tuple[int, int]]:
    """Return [begin, end) of every unbroken stretch of one vehicle; the frame is sorted and has ``step``."""
    joined = (np.diff(schema.track_numbers(frame)) == 0) & (np.diff(frame["step"].to_numpy()) == 1)
    return schema.spans(joined, np.ones(frame.height, bool))


def _estimated(position: np.ndarray, step: float) -> np.ndarray:
    if len(position) < 2:
        return np.zeros(len(position))
    return smooth(position, None, step, noise_sigma(position)).speed
