"""The corpus of bad files: each by its name, and what every command that reads trajectories must say of it.

``READ``: every command reads it, and alike. A text: every command refuses it in one line that has this text.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from tests.data.tables import platoon, with_value

READ = ""
PLATOON = platoon()
NO_LEADERS = PLATOON.drop("leader_id")
BARE = NO_LEADERS.drop("speed_mps", "length_m")
FALLING = pl.col("position_m").mul(-1).add(1000)
RNG = np.random.default_rng(0)


def _list(name: str) -> pl.DataFrame:
    return PLATOON.with_columns(pl.concat_list(name).alias(name))


def _first(name: str, value: object) -> pl.DataFrame:
    return with_value(PLATOON, name, [0], value)


def _all(name: str, kind: Any = pl.Float64) -> pl.DataFrame:
    return PLATOON.with_columns(pl.lit(None, kind).alias(name))


def _twice(**change: pl.Expr) -> pl.DataFrame:
    return pl.concat([PLATOON, PLATOON.with_columns(**change)])


def _both_ways() -> pl.DataFrame:
    back = BARE.with_columns(pl.col("vehicle_id") + 10, position_m=FALLING, lane=pl.lit(2))
    return pl.concat([BARE, back], how="vertical_relaxed")


def _laps(column: bool) -> pl.DataFrame:
    table = platoon(vehicles=2, seconds=60.0).with_columns(pl.col("position_m") % 300, gap_m=16 + 0 * pl.col("time_s"))
    return table.with_columns(ring_length_m=pl.lit(300.0)) if column else table


def _wrong(**factors: float) -> pl.DataFrame:
    return PLATOON.with_columns(pl.col(name) * factor for name, factor in factors.items())


def _gap(factor: float) -> pl.Expr:
    return pl.when(pl.col("leader_id").is_not_null()).then(16.0 * factor + 0.1 * pl.col("time_s").sin())


def _date(zone: str) -> pl.Expr:
    return pl.format("2024-05-01T12:30:{}{}", (pl.col("time_s") + 10).round(1).cast(pl.String), pl.lit(zone)).alias(
        "time_s"
    )


JITTER = RNG.uniform(-0.02, 0.02, PLATOON.height)

TABLES: dict[str, tuple[pl.DataFrame, str]] = {
    # directions
    "positions fall": (BARE.with_columns(position_m=FALLING), "position_m falls while vehicles drive"),
    "positions fall, with speeds": (NO_LEADERS.with_columns(position_m=FALLING), "position_m falls"),
    "positions fall, with leaders": (PLATOON.with_columns(position_m=FALLING), "position_m falls"),
    "positions and speeds are negative": (_wrong(position_m=-1.0, speed_mps=-1.0), "position_m falls"),
    "one vehicle, and it falls": (BARE.filter(pl.col("vehicle_id") == 1).with_columns(position_m=FALLING), "falls"),
    "both directions": (_both_ways(), READ),
    "both directions in one lane": (_both_ways().with_columns(lane=pl.lit(1)), READ),
    "laps without a ring": (_laps(False), "position_m falls in 2 of 2 tracks"),
    "a ring": (_laps(True), READ),
    "a ring of no length": (_laps(True).with_columns(ring_length_m=pl.lit(-3.0)), "ring_length_m holds values"),
    # runs and identifiers
    "two recordings": (_twice(position_m=pl.col("position_m") + 300), "two recordings share a run_id"),
    "two recordings, interleaved": (_twice(position_m=pl.col("position_m") + 3).sort("time_s"), "two recordings"),
    "two recordings in two lanes": (_twice(position_m=pl.col("position_m") - 9, lane=pl.lit(2)), "two recordings"),
    "every row twice": (_twice(), READ),
    "no run": (_all("run_id", pl.String), "run_id is empty for vehicle 1;"),
    "blank runs": (PLATOON.with_columns(run_id=pl.lit(" ")), "run_id is empty for vehicle 1;"),
    "one row without a run": (_first("run_id", None), "run_id is empty for vehicle 1;"),
    "no vehicle": (_all("vehicle_id", pl.Int64), "vehicle_id is empty in every row"),
    "one row without a vehicle": (_first("vehicle_id", None), READ),
    "vehicles that are one float": (
        PLATOON.with_columns(pl.col("vehicle_id", "leader_id").cast(pl.Float64) + 2.0**53), "write identifiers as"
    ),
    "vehicle 0 leads": (PLATOON.with_columns(pl.col("vehicle_id", "leader_id") - 1), READ),
    # leaders
    "a leader that is not there": (with_value(PLATOON, "leader_id", list(range(200, 250)), 99), READ),
    "no leader is there": (
        PLATOON.with_columns(pl.when(pl.col("leader_id") > 0).then(77).alias("leader_id")), "leader_id = '77' is no"
    ),
    "own leader": (with_value(PLATOON, "leader_id", list(range(200, 250)), 3), READ),
    "leaders are behind": (
        PLATOON.with_columns(pl.when(pl.col("vehicle_id") < 3).then(pl.col("vehicle_id") + 1).alias("leader_id")),
        "leader 2 is behind vehicle 1",
    ),
    "a leader flickers": (with_value(PLATOON, "leader_id", [240, 260], 1), READ),
    "lanes are missing": (with_value(NO_LEADERS, "lane", [120, 121, 240], None), READ),
    "one vehicle has no lane": (with_value(NO_LEADERS, "lane", list(range(100, 200)), None), READ),
    "no lane": (NO_LEADERS.drop("lane"), READ),
    # units
    "km/h": (_wrong(speed_mps=3.6), "looks like km/h"),
    "feet per second": (_wrong(speed_mps=3.28084), "feet per second"),
    "miles per hour": (_wrong(speed_mps=2.23694), "miles per hour"),
    "negative speeds": (_wrong(speed_mps=-1.0), "speed_mps is negative"),
    "speeds are 0": (PLATOON.with_columns(speed_mps=pl.lit(0)), "speed_mps is 0 while position_m rises"),
    "speeds are 1": (PLATOON.with_columns(speed_mps=pl.lit(1)), "times the change of position_m per second"),
    "speeds are true": (PLATOON.with_columns(speed_mps=pl.lit(True)), "speed_mps = 'true' in row 1 is not a number"),
    "speeds are a 14th": (_wrong(speed_mps=1 / 14), "speed_mps is 0.0715 times the change"),
    "positions are true": (PLATOON.with_columns(position_m=pl.lit(True)), "position_m = 'true' in row 1"),
    "lanes are true": (PLATOON.with_columns(lane=pl.lit(True)), "lane = 'true' in row 1"),
    "positions in feet": (_wrong(position_m=3.28084), "position_m looks like feet"),
    "lengths in feet": (_wrong(length_m=3.28084), "the median length_m is 13.1"),
    "frames": (_wrong(time_s=10.0), "frames"),
    "milliseconds": (_wrong(time_s=1000.0), "milliseconds"),
    "milliseconds without speeds": (_wrong(time_s=1000.0).drop("speed_mps"), "milliseconds"),
    "microsteps": (_wrong(time_s=1e-3).drop("speed_mps"), "position_m changes by more than"),
    "gaps in feet": (PLATOON.with_columns(gap_m=_gap(3.281)), "gap_m looks like feet"),
    "positions in feet, gaps in metres": (
        PLATOON.with_columns(pl.col("position_m") * 3.281, gap_m=_gap(16.5 / 16), length_m=11.5).drop("speed_mps"),
        "position_m looks like feet",
    ),
    # cells
    "lists of positions": (_list("position_m"), "position_m holds a list in every row"),
    "lists of times": (_list("time_s"), "time_s holds a list"),
    "lists of vehicles": (_list("vehicle_id"), "vehicle_id holds a list"),
    "lists of lanes": (_list("lane"), "lane holds a list"),
    "a structure": (PLATOON.with_columns(position_m=pl.struct("position_m", "lane")), "position_m holds a struct"),
    "text": (with_value(PLATOON.with_columns(pl.col("position_m").cast(pl.String)), "position_m", [3], "abc"), "'abc'"),
    "between two lanes": (PLATOON.with_columns(pl.col("lane") + 0.5), "lane = 1.5 in row 1 is between two lanes"),
    "no position": (_all("position_m"), "position_m is empty in every row"),
    "no time": (_all("time_s"), "time_s is empty in every row"),
    "no row": (PLATOON.clear(), "no rows"),
    "single positions are missing": (with_value(PLATOON, "position_m", [130, 150], None), READ),
    "positions are not numbers": (with_value(PLATOON, "position_m", list(range(130, 140)), float("nan")), READ),
    "speeds are infinite": (with_value(PLATOON, "speed_mps", [130], float("inf")), READ),
    "a row without a time": (_first("time_s", None), READ),
    "one instant": (PLATOON.filter(pl.col("time_s") == 0), "no vehicle has two different times"),
    "lengths are missing": (with_value(PLATOON, "length_m", [3, 130], None), READ),
    "no length is possible": (PLATOON.with_columns(length_m=pl.lit(0.0)), READ),
    # times
    "shuffled": (PLATOON.sample(fraction=1.0, shuffle=True, seed=0), READ),
    "jitter": (PLATOON.with_columns(pl.col("time_s") + JITTER, pl.col("position_m") + 12.0 * JITTER), READ),
    "jitter without leaders": (NO_LEADERS.with_columns(pl.col("time_s") + JITTER), READ),
    "a row is missing": (PLATOON.filter(pl.int_range(pl.len()) != 150), READ),
    "a second is missing": (PLATOON.filter(~pl.int_range(pl.len()).is_between(150, 159)), READ),
    "1 % of rows are missing": (NO_LEADERS.filter(pl.Series(RNG.random(PLATOON.height) > 0.01)), READ),
    "dates with an offset": (PLATOON.with_columns(_date("+02:00")), READ),
    "dates in UTC": (PLATOON.with_columns(_date("Z")), READ),
    "dates with and without an offset": (
        PLATOON.with_columns(pl.when(pl.col("vehicle_id") > 1).then(_date("Z")).otherwise(_date("")).alias("time_s")),
        "in row 1 has no offset from UTC, and other rows have one",
    ),
    # columns
    "names that are patterns": (PLATOON.with_columns(pl.lit(1).alias("*"), pl.lit("x").alias("^.*$")), READ),
    "a column is missing": (PLATOON.drop("time_s"), "column 'time_s' is missing"),
    "a column is misspelt": (PLATOON.rename({"leader_id": "leaderid"}), "'leader_id' is missing and 'leaderid'"),
    "other columns": (pl.DataFrame({"a": [1], "b": [2]}), "no known layout has the columns a, b"),
}  # fmt: skip

FOLLOWED = {
    "no leader": (_all("leader_id", pl.Int64), "leader_id is empty in every row"),
    "nobody ahead": (platoon(vehicles=1).drop("leader_id"), "nobody follows anybody"),
    "sparse": (platoon(seconds=300.0, dt=5.0).drop("speed_mps"), "time_s rises by 5 s"),
}
"""What a command refuses that needs drivers behind leaders on a dense clock, and tracks do not."""


def _bytes(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


FILES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "nothing.csv": ("nothing.csv", lambda path: None, "does not exist"),
    "empty": ("a.csv", _bytes(b""), "is empty (0 bytes)"),
    "a header": ("a.csv", _bytes(b"vehicle_id,time_s,position_m\n"), "no rows"),
    "not gzip": ("a.csv.gz", _bytes(b"\x1f\x8b\x08\x00rubbish"), "cannot be read"),
    "not parquet": ("a.parquet", _bytes(b"PAR1" + b"rubbish" * 20 + b"PAR1"), "cannot be read"),
    "cut gzip": ("a.csv.gz", _bytes(gzip.compress(PLATOON.write_csv().encode())[:-300]), "cannot be read"),
    "an extension": ("a.xls", _bytes(b"x"), "unknown extension"),
    "rubbish": ("a.csv", _bytes(bytes(range(256)) * 4), "a.csv"),
    "a column twice": ("a.csv", _bytes(b"vehicle_id,time_s,position_m,lane,lane\n1,0.0,1,2,3\n"), "'lane' is there"),
}  # fmt: skip
