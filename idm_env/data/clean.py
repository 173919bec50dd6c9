"""First pass over a table: types, identifiers, values that are not finite, order and repeats of time."""

from __future__ import annotations

import polars as pl

from idm_env.data.errors import DataError, Repair, listed, missing_column, nearest
from idm_env.data.schema import LARGEST, NUMBERS, REQUIRED, TIDY, TRACK

LARGEST_ID = 2.0**53
"""Floats tell whole numbers apart below this only."""
NO_LEADER = ("", "0", "-1", "nan", "none", "null", "na")
MISSING_WORDS = ("", "na", "n/a", "nan", "null", "none", "-", "inf", "-inf", "+inf", "infinity", "-infinity")


def check_columns(frame: pl.DataFrame, source: str) -> None:
    """Raise DataError if the table is empty, lacks a required column, or seems to misspell an optional one."""
    for name in REQUIRED:
        if name not in frame.columns:
            raise missing_column(name, frame.columns, source, known=TIDY)
    if frame.height == 0:
        raise DataError(f"{source}: the table has a header and no rows; give at least one leader and one follower.")
    others = [name for name in frame.columns if name not in TIDY]
    for name in TIDY:
        guess = None if name in frame.columns or name == "accel_mps2" else nearest(name, others, cutoff=0.85)
        if guess:
            # Taking a misspelt column as an extra one would silently estimate what was measured.
            raise DataError(f"{source}: column {name!r} is missing and {guess!r} looks like it; rename or remove it.")


def exact(column: pl.Series, source: str) -> None:
    """Raise DataError if identifiers are floats so large that neighbouring integers are one float."""
    largest = column.fill_nan(None).abs().max()
    if isinstance(largest, float) and largest >= LARGEST_ID:
        raise DataError(
            f"{source}: {column.name} = {largest:.17g} is a float beyond 2^53, where several identifiers become one; "
            "write identifiers as integers or text."
        )


def identifiers(frame: pl.DataFrame, source: str = "table") -> pl.DataFrame:
    """Return the frame with run_id, vehicle_id and leader_id as strings; run_id "0" where the column is absent.

    Raises:
        DataError: If identifiers are floats so large that neighbouring integers are one float.
    """
    if "run_id" not in frame.columns:
        frame = frame.with_columns(pl.lit("0").alias("run_id"))
    changes = []
    for name in ("run_id", "vehicle_id", "leader_id"):
        if name not in frame.columns:
            continue
        column = pl.col(name)
        if frame[name].dtype.is_float():
            exact(frame[name], source)
            # A csv column of integers with empty cells arrives as floats: 12.0 is vehicle 12.
            column = pl.when(column.round() == column).then(column.cast(pl.Int64, strict=False).cast(pl.String))
            column = column.otherwise(pl.col(name).fill_nan(None).cast(pl.String))
        changes.append(column.cast(pl.String).str.strip_chars().alias(name))
    return frame.with_columns(changes)


def numbers(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with its numeric columns as Float64 and everything not finite as null, counted.

    A number beyond `LARGEST` is as little a measurement as an infinite one.
    """
    repairs: list[Repair] = []
    for name in [*NUMBERS, "lane"]:
        if name in frame.columns and not frame[name].dtype.is_numeric():
            frame = _parse(frame, name, source)
    if "lane" in frame.columns:
        value = frame["lane"].cast(pl.Float64)
        between = (value.is_finite() & ((value - value.round()).abs() > 1e-6)).fill_null(False)
        if between.any():
            row = int(between.arg_true()[0])
            raise DataError(
                f"{source}: lane = {value[row]:g} in row {row + 1} is between two lanes. Give a whole number, or an "
                "empty cell."
            )
    lane = [pl.col("lane").cast(pl.Float64).round().cast(pl.Int64, strict=False)] if "lane" in frame.columns else []
    present = [name for name in NUMBERS if name in frame.columns]
    frame = frame.with_columns(lane).with_columns(pl.col(present).cast(pl.Float64))
    for name in frame.columns:
        if not frame[name].dtype.is_float():
            continue
        finite = (frame[name].is_finite() & (frame[name].abs() <= LARGEST.get(name, float("inf")))).fill_null(True)
        bad = frame.height - int(finite.sum())
        if bad:
            frame = frame.with_columns(pl.when(finite).then(pl.col(name)).alias(name))
            text = f"{bad} values of {name} were NaN, infinite or beyond all measure and are taken as missing."
            repairs.append(Repair("not finite", bad, text))
    return frame, repairs


def _parse(frame: pl.DataFrame, name: str, source: str) -> pl.DataFrame:
    if frame[name].dtype in (pl.Null, pl.Boolean):
        return frame.with_columns(pl.col(name).cast(pl.Float64))
    text = frame[name].cast(pl.String).str.strip_chars()
    value = text.cast(pl.Float64, strict=False)
    wrong = value.is_null() & text.is_not_null() & ~text.str.to_lowercase().is_in(MISSING_WORDS)
    if wrong.any():
        row = int(wrong.arg_true()[0])
        raise DataError(
            f"{source}: {name} = {text[row]!r} in row {row + 1} is not a number; write it with a decimal point."
        )
    return frame.with_columns(value.alias(name))


def without_empty(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Leave out rows that have no vehicle, run or time."""
    kept = frame.filter(pl.all_horizontal(pl.col("vehicle_id", "run_id", "time_s").is_not_null()))
    count = frame.height - kept.height
    if kept.height == 0:
        raise DataError(f"{source}: no row has both a vehicle_id and a finite time_s; fill those columns.")
    text = f"{count} rows without a vehicle or a time were left out."
    return kept, [Repair("no time", count, text)] if count else []


def ordered(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Sort by run, vehicle and time, and keep the first of rows that repeat a time.

    Raises:
        DataError: If so many times are repeated with other positions that two recordings must share a run_id.
    """
    repairs = []
    backward = pl.col("time_s").diff().over(TRACK) < 0
    unsorted = int(frame.select(backward.sum()).item() or 0)
    if unsorted:
        text = f"Time runs backward at {unsorted} rows; the rows were sorted by time."
        repairs.append(Repair("time not increasing", unsorted, text))
    frame = frame.sort(*(natural(name) for name in TRACK), "run_id", "vehicle_id", "time_s", maintain_order=True)
    repeated = (pl.col("time_s").diff() == 0) & _same_track()
    moved = repeated & ((pl.col("position_m") - pl.col("position_m").shift(1)).abs() > 1e-6)
    counts = frame.select(repeated.sum().alias("repeated"), moved.sum().alias("moved")).row(0, named=True)
    if counts["moved"] > max(0.02 * frame.height, 5):
        run, vehicle, time = frame.filter(moved).select("run_id", "vehicle_id", "time_s").row(0)
        raise DataError(
            f"{source}: vehicle {vehicle} of run {run} is at two positions at t = {time:g} s, as are {counts['moved']} "
            "rows; two recordings share a run_id: give each its own."
        )
    if counts["repeated"]:
        text = (
            f"{counts['repeated']} rows repeat a time of their vehicle and were left out; the first of each was kept."
        )
        repairs.append(Repair("duplicated time", counts["repeated"], text))
        frame = frame.filter(~repeated.fill_null(False))
    return frame, repairs


def natural(name: str) -> pl.Expr:
    """Return a sort key under which vehicle 2 comes before vehicle 10; text identifiers come last."""
    return pl.col(name).cast(pl.Int64, strict=False).fill_null(2**62).alias(f"{name}_number")


def _same_track() -> pl.Expr:
    return (pl.col("run_id") == pl.col("run_id").shift(1)) & (pl.col("vehicle_id") == pl.col("vehicle_id").shift(1))


def single_holes(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Fill a missing value between two present ones with their mean; longer holes stay empty."""
    repairs = []
    for name in ("position_m", "speed_mps", "gap_m"):
        if name not in frame.columns:
            continue
        column = pl.col(name)
        between = (column.shift(1) + column.shift(-1)).over(TRACK) / 2
        if name == "gap_m" and "leader_id" in frame.columns:
            leader = pl.col("leader_id")
            between = pl.when(leader.shift(1).eq_missing(leader.shift(-1)).over(TRACK)).then(between)
        filled = frame.select(pl.coalesce(column, between).alias(name))[name]
        count = frame[name].null_count() - filled.null_count()
        if count:
            text = f"{count} single missing values of {name} were interpolated between their neighbours in time."
            repairs.append(Repair("interpolated", count, text))
            frame = frame.with_columns(filled)
    return frame, repairs


def without_position(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Leave out rows whose position is still missing; tracks are split there."""
    kept = frame.filter(pl.col("position_m").is_not_null())
    count = frame.height - kept.height
    if kept.height == 0:
        raise DataError(
            f"{source}: position_m is empty in every row; it must hold the front bumper's position in metres."
        )
    if not count:
        return kept, []
    tracks = frame.filter(pl.col("position_m").is_null()).select(TRACK).unique().rows()
    names = listed(vehicle for _, vehicle in tracks)
    text = f"{count} rows without a position were left out; tracks are split there (vehicles {names})."
    return kept, [Repair("no position", count, text)]
