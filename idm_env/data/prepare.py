"""From any table with the tidy columns to the checked one on a regular clock, every change on the way counted."""

from __future__ import annotations

import polars as pl

from idm_env.data import clean, clock, directions, leaders, schema, speeds, units
from idm_env.data.errors import DataError, Repair


def prepare(
    frame: pl.DataFrame, source: str, ring_length: float | None
) -> tuple[pl.DataFrame, dict[str, float], list[Repair]]:
    """Return the tidy table, each run's time step in s, and the repairs.

    Raises:
        DataError: For a table that cannot be used.
    """
    done: list[Repair] = []

    def then(result: tuple[pl.DataFrame, list[Repair]]) -> pl.DataFrame:
        done.extend(result[1])
        return result[0]

    clean.check_columns(frame, source)
    frame = then(clean.numbers(clean.identifiers(frame, source), source))
    frame = then(clean.without_empty(_with_ring(frame, ring_length, source), source))
    frame = then(directions.one_way(frame))
    frame = then(clean.ordered(frame, source))
    units.check(frame, source)
    frame = then(units.implausible(frame))
    frame = then(speeds.unwrapped(frame))
    frame = then(clean.single_holes(frame))
    frame = then(clean.without_position(frame, source))
    frame = then(speeds.lengths(frame))
    steps = clock.steps_of(frame, source)
    frame = then(clock.regularise(frame, steps))
    frame = then(speeds.complete(frame, steps))
    if "leader_id" in frame.columns:
        frame = then(leaders.known(_with_lane(frame), source))
    else:
        frame = then(leaders.derive(_with_lane(frame)))
    frame = then(leaders.gaps(frame, source))
    if frame["leader_id"].null_count() == frame.height:
        raise DataError(f"{source}: nobody follows anybody; two vehicles must share a run and a lane at one time.")
    return schema.check(_arranged(frame), source), steps, done


def _with_ring(frame: pl.DataFrame, ring_length: float | None, source: str) -> pl.DataFrame:
    if ring_length is not None:
        if not 0 < ring_length < float("inf"):
            raise DataError(f"ring_length = {ring_length:g} m must be positive and finite.")
        frame = frame.with_columns(pl.lit(float(ring_length)).alias("ring_length_m"))
    if "ring_length_m" in frame.columns and (frame["ring_length_m"] <= 0).any():
        raise DataError(f"{source}: ring_length_m holds values that are not positive; leave it empty for an open road.")
    return frame


def _with_lane(frame: pl.DataFrame) -> pl.DataFrame:
    return frame if "lane" in frame.columns else frame.with_columns(pl.lit(None, pl.Int64).alias("lane"))


def _arranged(frame: pl.DataFrame) -> pl.DataFrame:
    first = [name for name in (*schema.TIDY, "gap_measured") if name in frame.columns]
    return frame.select(first + [name for name in frame.columns if name not in {*first, "step"}])
