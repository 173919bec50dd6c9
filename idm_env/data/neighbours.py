"""For every row of a table, the rows of the vehicles around it at the same time: vectorised over the whole table."""

from dataclasses import dataclass

import numpy as np
import polars as pl

NONE = -1


@dataclass(frozen=True)
class Neighbours:
    """Row numbers [rows] of the neighbours at the same run and time; -1 where there is none."""

    leader: np.ndarray
    second_leader: np.ndarray
    behind: np.ndarray
    adjacent: np.ndarray


def find(table: pl.DataFrame) -> Neighbours:
    """Return the neighbours of every row of a tidy table that also has the integer column ``step``."""
    rows = table.with_row_index("row")
    targets = rows.select("run_id", "step", leader_id="vehicle_id", found="row")
    keys = ["run_id", "step", "leader_id"]
    joined = rows.select(keys).join(targets, on=keys, how="left", maintain_order="left")
    leader = joined["found"].cast(pl.Int64).fill_null(NONE).to_numpy()
    second = np.where(leader >= 0, leader[leader], NONE)
    return Neighbours(leader, second, _followers_of(leader, table["gap_m"].to_numpy()), _adjacent(rows, leader))


def _followers_of(leader: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Invert the leaders; of several followers of one vehicle the one with the smallest gap counts."""
    behind = np.full(len(leader), NONE)
    followers = np.flatnonzero(leader >= 0)
    order = followers[np.argsort(-np.nan_to_num(gap[followers], nan=np.inf), kind="stable")]
    behind[leader[order]] = order
    return behind


def _adjacent(rows: pl.DataFrame, leader: np.ndarray) -> np.ndarray:
    """Return the nearest vehicle, along the road, of the lanes beside one's own; the leader itself does not count."""
    rows_beside = np.full(rows.height, NONE)
    lanes = rows.select((pl.col("lane").max() - pl.col("lane").min()).over("run_id").alias("lanes"))["lanes"]
    if not (lanes.fill_null(0) > 0).any():
        return rows_beside
    nearest = np.full(rows.height, np.inf)
    position = rows["position_m"].to_numpy()
    laned = rows.filter(pl.col("lane").is_not_null())
    others = laned.select("run_id", "step", "lane", "position_m", other="row")
    others = others.sort("position_m")
    for side in (-1, 1):
        mine = laned.select("run_id", "step", pl.col("lane") + side, "position_m", "row")
        pairs = mine.sort("position_m").join_asof(
            others, on="position_m", by=["run_id", "step", "lane"], strategy="nearest", check_sortedness=False
        )
        pairs = pairs.filter(pl.col("other").is_not_null())
        row, other = pairs["row"].to_numpy().astype(int), pairs["other"].to_numpy().astype(int)
        distance = np.abs(position[row] - position[other])
        closer = (distance < nearest[row]) & (leader[row] != other)
        rows_beside[row[closer]], nearest[row[closer]] = other[closer], distance[closer]
    return rows_beside
