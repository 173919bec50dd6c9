"""Reader of tables that are tidy already: csv, csv.gz or parquet with the columns of `idm_env.data.schema`."""

from __future__ import annotations

import polars as pl

from idm_env.data.errors import Repair


def matches(columns: list[str]) -> bool:
    """Say whether the header is that of a tidy table; also true for one with a column missing, to name it."""
    return bool({"time_s", "position_m", "speed_mps", "run_id"} & set(columns))


def read(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame as it is."""
    return frame, []
