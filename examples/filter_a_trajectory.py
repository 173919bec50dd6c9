"""Filter a noisy trajectory: positions with 0.3 m of noise become motions that a vehicle can make."""

import tempfile
from pathlib import Path

import numpy as np
import polars as pl

from idm_env.data import synthetic
from idm_env.trajectories.files import filter_file

trajectories, truth = synthetic.generate(seed=2, runs=2, followers=3, seconds=60.0, noise=0.3)
keys = ["run_id", "vehicle_id", "time_s"]
with tempfile.TemporaryDirectory() as folder:
    noisy, out = Path(folder) / "noisy.csv", Path(folder) / "filtered"
    trajectories.table.select(*keys, "leader_id", "lane", "position_m", "length_m").write_csv(noisy)
    filter_file(noisy, out)
    filtered = pl.read_parquet(out / "trajectories.parquet")

exact, measured, ours = (
    table.with_columns(pl.col("time_s").round(3)).select(*keys, "position_m", "speed_mps")
    for table in (truth.motion, trajectories.table, filtered)
)
both = exact.join(measured, on=keys, suffix="_noisy").join(ours, on=keys, suffix="_filtered")


def rmse(column: str, kind: str) -> float:
    return float(np.sqrt((both[f"{column}_{kind}"] - both[column]).pow(2).mean()))


before, after, speed = rmse("position_m", "noisy"), rmse("position_m", "filtered"), rmse("speed_mps", "filtered")
differences = both.sort(keys).select((pl.col("position_m_noisy").diff() / 0.1 - pl.col("speed_mps")).over(keys[:2]))
print(f"position: off by {before:.3f} m as measured, by {after:.3f} m filtered ({len(both)} samples)")
print(f"speed: off by {differences.to_series().drop_nulls().std():.2f} m/s if differenced, by {speed:.2f} m/s filtered")
assert after < 0.7 * before and speed < 0.5
