"""What a model was fitted on is told by who was where when: not by the file, its format, its names or its rounding."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import Trajectories, load, synthetic
from idm_env.data.fingerprint import fitted_on, names_by_mark


def drivers(trajectories: Trajectories) -> list[tuple[str, str]]:
    return trajectories.table.select("run_id", "vehicle_id").unique(maintain_order=True).rows()


@pytest.fixture(scope="module")
def table() -> pl.DataFrame:
    trajectories, _ = synthetic.generate(1, runs=4, followers=2, seconds=60.0)
    return trajectories.table.select("run_id", "vehicle_id", "leader_id", "time_s", "position_m", "speed_mps")


def noisy(table: pl.DataFrame) -> pl.DataFrame:
    noise = 0.4 * np.random.default_rng(3).standard_normal(table.height)
    return table.with_columns(pl.col("position_m") + pl.Series(noise))


OTHERWISE: dict[str, Callable[[pl.DataFrame], pl.DataFrame]] = {
    "columns in another order": lambda t: t.select(reversed(t.columns)),
    "rows in another order": lambda t: t.sample(fraction=1.0, shuffle=True, seed=1),
    "two decimals": lambda t: t.with_columns(pl.col("position_m", "speed_mps").round(2)),
    "single precision": lambda t: t.with_columns(pl.col("position_m").cast(pl.Float32)),
    "feet": lambda t: t.with_columns(position_ft=pl.col("position_m") / 0.3048).drop("position_m"),
    "every tenth row": lambda t: t.filter((pl.col("time_s") * 10).round().cast(pl.Int64) % 10 == 3),
    "its second half": lambda t: t.filter(pl.col("time_s") > pl.col("time_s").max() / 2),
    "other names": lambda t: t.with_columns(pl.format("x{}", "run_id").alias("run_id")),
    "filtered, or measured again": noisy,
}


@pytest.mark.parametrize("change", OTHERWISE.values(), ids=OTHERWISE)
def test_the_same_drivers_at_the_same_times_are_known(
    table: pl.DataFrame, tmp_path: Path, change: Callable[[pl.DataFrame], pl.DataFrame]
) -> None:
    """Those of two of four runs were fitted: they are known again, and the others are not."""
    table.write_csv(tmp_path / "fitted.csv")
    first = load(tmp_path / "fitted.csv")
    marks = fitted_on(first, [driver for driver in drivers(first) if driver[0] in "12"])["tracks"]
    change(table).write_parquet(tmp_path / "other.parquet")
    again = load(tmp_path / "other.parquet")
    known = names_by_mark(again, drivers(again), marks)
    assert known and set(known) == {driver for driver in drivers(again) if driver[0][-1] in "12"} and len(known) == 6


def test_other_traffic_is_not_known(table: pl.DataFrame) -> None:
    """The next vehicle of the same platoon, and other platoons on the same road at the same times."""
    first, _ = synthetic.generate(1, runs=4, followers=2, seconds=60.0)
    other, _ = synthetic.generate(2, runs=4, followers=2, seconds=60.0)
    leaders = [driver for driver in drivers(first) if driver[1] == "1"]
    marks = fitted_on(first, leaders)["tracks"]
    found = names_by_mark(first, drivers(first), marks)
    assert found == {driver: "/".join(driver) for driver in leaders}
    assert not names_by_mark(other, drivers(other), marks)


def test_marks_stay_short_and_what_an_older_version_wrote_is_not_known() -> None:
    """64 places at most, however long a drive is."""
    drive, _ = synthetic.generate(1, runs=1, followers=1, seconds=400.0)
    (mark,) = fitted_on(drive, [("1", "2")])["tracks"]
    assert len(mark.split()) <= 66
    assert names_by_mark(drive, drivers(drive), ["0123456789ab"]) is None
