"""The tidy trajectory table: its columns, its constants and the check of both.

One row per vehicle and time. Positions are front bumpers along the lane, gaps are bumper to bumper, units are SI.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from idm_env.data.errors import DataError, Repair, repaired

REQUIRED = ("vehicle_id", "time_s", "position_m")
NUMBERS = ("time_s", "position_m", "speed_mps", "accel_mps2", "length_m", "gap_m", "ring_length_m")
TIDY = ("run_id", "vehicle_id", "leader_id", "lane", *NUMBERS[:-1])
TRACK = ["run_id", "vehicle_id"]

LARGEST = {"time_s": 1e13, "position_m": 1e7, "speed_mps": 1e4, "gap_m": 1e6, "length_m": 1e4, "ring_length_m": 1e7}
"""No clock (in s, or in ms by mistake), road or vehicle goes beyond these; such numbers are taken as missing."""
LEADER_LOST_GAP_M = 80.0
"""A gap above this is taken as a leader that was lost; the rows are left out (m)."""
DEFAULT_LENGTH_M = 4.5
"""Length of a vehicle whose file gives none (m)."""
HIGHEST_SPEED_MPS = 70.0
"""Speeds above this are not those of road traffic (m/s)."""
LOWEST_SPEED_MPS = -1.0
"""Speeds below this are not measurement noise around standstill (m/s)."""
LONGEST_LENGTH_M = 30.0
"""No vehicle on a road is longer than this, a lorry with its trailers included (m)."""
SHORTEST_TRACK_S = 5.0
"""Stretches shorter than this say nothing about a driver; they are left out (s)."""


_ANY, _FINITE = (pl.lit(True), ""), (lambda name: (pl.col(name).is_finite(), "finite"))
_SPEED = pl.col("speed_mps").is_between(LOWEST_SPEED_MPS, HIGHEST_SPEED_MPS)
_LENGTH = pl.col("length_m").is_between(0.0, LONGEST_LENGTH_M, closed="right")
COLUMNS: dict[str, tuple[Any, bool, pl.Expr, str]] = {
    "run_id": (pl.String, True, *_ANY),
    "vehicle_id": (pl.String, True, *_ANY),
    "leader_id": (pl.String, False, *_ANY),
    "lane": (pl.Int64, False, *_ANY),
    "time_s": (pl.Float64, True, *_FINITE("time_s")),
    "position_m": (pl.Float64, True, *_FINITE("position_m")),
    "speed_mps": (pl.Float64, True, _SPEED, f"{LOWEST_SPEED_MPS:g} to {HIGHEST_SPEED_MPS:g} m/s"),
    "length_m": (pl.Float64, True, _LENGTH, f"above 0, up to {LONGEST_LENGTH_M:g} m"),
    "gap_m": (pl.Float64, False, *_FINITE("gap_m")),
    "gap_measured": (pl.Boolean, True, *_ANY),
}
"""Columns of the tidy table: type, whether every row has a value, what holds of every value, and how that is said."""


def of_run(values: Mapping[str, float]) -> pl.Expr:
    """Return the number that every row's run has."""
    return pl.col("run_id").replace_strict(values, return_dtype=pl.Float64)


def track_numbers(frame: pl.DataFrame, names: Sequence[str] = TRACK) -> np.ndarray:
    """Return the number of every row's track [rows], from 0; consecutive rows of the same ``names`` are one."""
    return frame.select(pl.struct(names).rle_id())[names[0]].to_numpy()


def spans(joined: np.ndarray, usable: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end of every stretch of usable rows [rows], each of them joined to the one before [rows − 1]."""
    joined = joined & usable[1:] & usable[:-1]
    begins = np.flatnonzero(usable & ~np.append(False, joined))
    ends = np.flatnonzero(usable & ~np.append(joined, False)) + 1
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


def taken_as_missing(
    frame: pl.DataFrame, name: str, good: pl.Series, kind: str, words: str
) -> tuple[pl.DataFrame, list[Repair]]:
    """Return a table without the values of a column that are not good [rows], and how many these were."""
    count = frame.height - int(good.sum())
    done = repaired(kind, count, f"values of {name} {words} taken as missing.")
    return frame.with_columns(pl.when(good).then(pl.col(name)).alias(name)) if count else frame, done


def check(table: pl.DataFrame, source: str) -> pl.DataFrame:
    """Return `table` unchanged if it obeys the schema of tidy trajectories.

    Raises:
        DataError: If a column is missing, has another type, lacks a value or breaks a bound.
    """
    for name, (kind, always, rule, rule_text) in COLUMNS.items():
        if name not in table.columns:
            raise DataError(f"{source}: column {name!r} of the tidy table is missing.")
        if table.schema[name] != kind:
            raise DataError(f"{source}: column {name!r} is {table.schema[name]} and must be {kind} in the tidy table.")
        if always and table[name].null_count():
            raise DataError(f"{source}: column {name!r} of the tidy table lacks a value.")
        if not table.select(rule.all()).item():
            raise DataError(f"{source}: column {name!r} of the tidy table holds values that are not {rule_text}.")
    return table
