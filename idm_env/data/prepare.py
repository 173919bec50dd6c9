"""From any table with the tidy columns to the checked one on a regular clock, every change on the way counted."""

import polars as pl

from idm_env.data import clean, clock, directions, leaders, plausible, schema, speeds, units
from idm_env.data.errors import DataError, Repair
from idm_env.data.names import check_columns, without_patterns


def rows(
    frame: pl.DataFrame, source: str, ring_length: float | None, filled: clean.Filled
) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the rows of a table, or of a piece of one, that can be used, by the rules that look at single rows.

    ``filled`` counts them. DataError for what cannot be used.
    """
    check_columns(frame.columns, source)
    frame, literal = without_patterns(frame)
    frame, repairs = clean.numbers(clean.identifiers(frame, source), source, filled.lanes)
    filled.add(frame)
    frame, lost = clean.without_empty(_with_ring(frame, ring_length, source), source)
    return frame, [*literal, *repairs, *lost]


def measured(frame: pl.DataFrame, jumps: plausible.Jumps) -> tuple[pl.DataFrame, list[Repair]]:
    """Return whole vehicles, sorted, with the rules for lengths, laps, jumps and single speeds applied.

    ``jumps`` counts those of the file.
    """
    done: list[Repair] = []
    for rule in (units.implausible, speeds.unwrapped, jumps.rule, speeds.lengths):
        frame, repairs = rule(frame)
        done += repairs
    return frame, done


def prepare(
    frame: pl.DataFrame, source: str, ring_length: float | None
) -> tuple[pl.DataFrame, dict[str, float], list[Repair]]:
    """Return the tidy table, each run's time step in s, and the repairs.

    Raises:
        DataError: For a table that cannot be used.
    """
    done: list[Repair] = []

    def keep_repairs(result: tuple[pl.DataFrame, list[Repair]]) -> pl.DataFrame:
        done.extend(result[1])
        return result[0]

    filled = clean.Filled()
    frame = keep_repairs(rows(frame, source, ring_length, filled))
    filled.check(source)
    frame = keep_repairs(directions.one_way(frame, source))
    count = frame.height
    frame, sorted_, twice = clean.ordered(frame)
    done += sorted_
    clean.check_recordings(twice, count, source)
    units.check(frame, source)
    jumps = plausible.Jumps()
    frame = keep_repairs(measured(frame, jumps))
    jumps.check(source)
    frame = jumps.with_leaders(frame)
    frame = keep_repairs(clean.single_holes(frame))
    hidden = clean.hidden(frame)
    frame = keep_repairs(clean.without_position(frame))
    steps = clock.steps_of(clock.paces(frame), frame["run_id"].unique(), source)
    frame = keep_repairs(clock.regularise(frame, steps))
    frame = keep_repairs(speeds.complete(frame, steps))
    hidden = clean.on_clock(hidden, frame, steps)
    frame = frame if "lane" in frame.columns else frame.with_columns(pl.lit(None, pl.Int64).alias("lane"))
    frame = keep_repairs(leaders.steady(keep_repairs(_with_leaders(frame, source, hidden, steps))))
    frame = keep_repairs(leaders.gaps(frame, source))
    overlaps = plausible.Overlaps()
    overlaps.add(frame)
    done += overlaps.check(source, frame.select(schema.TRACK).n_unique())
    if frame["leader_id"].null_count() == frame.height:
        raise DataError(f"{source}: nobody follows anybody; two vehicles must share a run and a lane at one time.")
    return schema.check(_arranged(frame), source), steps, done


def _with_leaders(
    frame: pl.DataFrame, source: str, hidden: pl.DataFrame, steps: dict[str, float]
) -> tuple[pl.DataFrame, list[Repair]]:
    if "leader_id" in frame.columns:
        frame, counts = leaders.named_leaders(frame, frame)
        if (counts["state"] == "none").all():
            raise DataError(
                f"{source}: leader_id is empty in every row, so that nobody follows anybody; fill it, or remove the "
                "column to have leaders derived from lane and position."
            )
        return frame, leaders.named(counts, source)
    unseen, holes = clock.unseen(frame, steps)
    everybody = pl.concat([frame, hidden, unseen], how="diagonal").with_columns(
        leaders.in_lane(pl.col("lane").is_not_null().any().over("run_id"))
    )
    frame = leaders.derive(everybody).head(frame.height)  # who is there without a position is still ahead of somebody
    followers = frame.filter(pl.col("leader_id").is_not_null()).select(schema.TRACK).n_unique()
    return frame.drop("in_lane"), [*holes, leaders.derived(followers, frame["lane"].null_count() < frame.height)]


def _with_ring(frame: pl.DataFrame, ring_length: float | None, source: str) -> pl.DataFrame:
    if ring_length is not None:
        if not 0 < ring_length < float("inf"):
            raise DataError(f"ring_length = {ring_length:g} m must be positive and finite.")
        frame = frame.with_columns(pl.lit(float(ring_length)).alias("ring_length_m"))
    if "ring_length_m" in frame.columns and (frame["ring_length_m"] <= 0).any():
        raise DataError(f"{source}: ring_length_m holds values that are not positive; leave it empty for an open road.")
    return frame


def _arranged(frame: pl.DataFrame) -> pl.DataFrame:
    first = [name for name in (*schema.TIDY, "gap_measured") if name in frame.columns]
    return frame.select(first + [name for name in frame.columns if name not in {*first, "step"}])
