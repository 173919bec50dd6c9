"""The tidy trajectory table: its columns, its constants and the pandera check of both.

One row per vehicle and time. Positions are front bumpers along the lane, gaps are bumper to bumper, units are SI.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import polars as pl

from idm_env.data.errors import DataError

REQUIRED = ("vehicle_id", "time_s", "position_m")
TIDY = (
    "run_id",
    "vehicle_id",
    "leader_id",
    "lane",
    "time_s",
    "position_m",
    "speed_mps",
    "accel_mps2",
    "length_m",
    "gap_m",
)
NUMBERS = ("time_s", "position_m", "speed_mps", "accel_mps2", "length_m", "gap_m", "ring_length_m")
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


@cache
def _schema() -> Any:
    import pandera.polars as pa  # a second, which a refusal does not wait for

    return pa.DataFrameSchema(
        {
            "run_id": pa.Column(pl.String),
            "vehicle_id": pa.Column(pl.String),
            "leader_id": pa.Column(pl.String, nullable=True),
            "lane": pa.Column(pl.Int64, nullable=True),
            "time_s": pa.Column(pl.Float64),
            "position_m": pa.Column(pl.Float64),
            "speed_mps": pa.Column(pl.Float64, pa.Check.in_range(LOWEST_SPEED_MPS, HIGHEST_SPEED_MPS)),
            "length_m": pa.Column(pl.Float64, pa.Check.in_range(0.0, LONGEST_LENGTH_M, include_min=False)),
            "gap_m": pa.Column(pl.Float64, nullable=True),
            "gap_measured": pa.Column(pl.Boolean),
        },
        strict=False,
    )


def check(table: pl.DataFrame, source: str) -> pl.DataFrame:
    """Return `table` unchanged if it obeys the schema of tidy trajectories.

    Raises:
        DataError: If a column is missing, has another type, or breaks a bound; names the column and the rule.
    """
    from pandera.errors import SchemaError, SchemaErrors

    for name in _schema().columns:
        if name not in table.columns:
            raise DataError(f"{source}: column {name!r} of the tidy table is missing.")
    try:
        _schema().validate(table)
    except (SchemaError, SchemaErrors) as error:
        column = getattr(getattr(error, "schema", None), "name", None)
        rule = getattr(error, "check", None)
        raise DataError(f"{source}: column {column!r} breaks the rule {rule} of the tidy table.") from None
    for name in ("time_s", "position_m", "speed_mps", "length_m", "gap_m"):
        if not table[name].is_finite().fill_null(True).all():
            raise DataError(f"{source}: column {name!r} holds values that are not finite.")
    return table
