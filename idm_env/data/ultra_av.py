"""Reader of the unified pairs of Ultra-AV: a row holds an automated follower (FAV) and the vehicle ahead (LV).

Positions are of centres, along the road; Space_Gap is from bumper to bumper, Space_Headway from centre to centre.
Source: Zhou, Ma, Liang, Li, Qu 2024, A unified longitudinal trajectory dataset for automated vehicle, Scientific Data.
"""

import polars as pl

from idm_env.data.errors import Repair, refuse_missing

NEEDED = ("trajectory_id", "time_index", "pos_lv", "speed_lv", "pos_fav", "speed_fav")


def matches(columns: list[str]) -> bool:
    """Say whether the header is Ultra-AV's."""
    return {"trajectory_id", "time_index", "pos_fav"} <= {name.strip().lower() for name in columns}


def read(frame: pl.DataFrame, source: str = "table") -> tuple[pl.DataFrame, list[Repair]]:
    """Return the tidy table: runs of vehicle 1, the leader, and vehicle 2; ``vehicle_name`` has the file's identifiers.

    Both have the mean of their lengths, headway less gap. DataError if a column is missing.
    """
    frame = frame.rename({name: name.strip().lower().replace("spatial_", "space_") for name in frame.columns})
    refuse_missing(NEEDED, frame.columns, source)
    gap = pl.col("space_gap") if "space_gap" in frame.columns else pl.lit(None, pl.Float64)
    length = pl.lit(None, pl.Float64)
    if {"space_gap", "space_headway"} <= set(frame.columns):
        length = (pl.col("space_headway") - pl.col("space_gap")).median().over("trajectory_id")
        length = pl.when(length.is_between(2.0, 25.0)).then(length)

    def track(which: str, vehicle: str, leader: str | None, gap: pl.Expr) -> pl.DataFrame:
        name = f"id_{which}"
        named = pl.col(name).cast(pl.String) if name in frame.columns else pl.lit(vehicle)
        names = {"run_id": pl.col("trajectory_id").cast(pl.String), "vehicle_id": pl.lit(vehicle)}
        names |= {"leader_id": pl.lit(leader, pl.String), "vehicle_name": named, "lane": pl.lit(1)}
        motion = {"time_s": pl.col("time_index"), "position_m": pl.col(f"pos_{which}") + length.fill_null(0.0) / 2}
        motion |= {"speed_mps": pl.col(f"speed_{which}"), "length_m": length, "gap_m": gap.cast(pl.Float64)}
        return frame.select(**names, **motion)

    both = [track("lv", "1", None, pl.lit(None, pl.Float64)), track("fav", "2", "1", gap)]
    return pl.concat(both), []
