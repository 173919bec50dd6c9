"""Tables in which a row holds a follower and its leader: both tracks, or own speed with range and range rate.

``time_s=t,follower.speed_mps=v[km/h],gap_m=range,range_rate_mps=rate``. Any of the leader's position and the gap is
enough, and any of the follower's position and speed: the way is then the trapezoidal integral of the speed.
"""

import polars as pl

from idm_env.data.clean import parsed
from idm_env.data.errors import DataError, Repair, listed, nearest, repaired
from idm_env.data.names import Columns, entries, place
from idm_env.data.schema import DEFAULT_LENGTH_M

OF_BOTH = ("vehicle_id", "position_m", "speed_mps", "length_m")
NAMES = ["time_s", "run_id", "lane", "gap_m", "range_rate_mps"]
NAMES += [f"{who}.{name}" for who in ("follower", "leader") for name in OF_BOTH]
"""What a column can be named for."""


def matches(columns: Columns) -> bool:
    """Say whether names of columns are those of a follower and its leader in one row."""
    return columns is not None and any(name.startswith(("follower.", "leader.")) for name, _ in entries(columns))


def read(frame: pl.DataFrame, columns: Columns, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the tidy table of both vehicles, in SI units; gaps that are not above 0 are taken as nobody ahead.

    Raises:
        DataError: If a column is not there, a unit is unknown, a cell is no number, or neither position nor speed of
            the follower, or neither position nor gap of the leader, is named.
    """
    series: list[pl.Series] = []
    for name, text in entries(columns):
        if name not in NAMES:
            guess = nearest(name, NAMES)
            raise DataError(f"--pair: {name!r} is not read; did you mean {guess or listed(NAMES, 20)}?")
        base = name.rpartition(".")[2]
        column, factor = place("speed_mps" if name == "range_rate_mps" else base, text, frame.columns, source)
        values = frame.select(pl.col(column).alias(base))
        if base not in ("run_id", "vehicle_id", "lane"):
            values = parsed(values, base, source).select(pl.col(base).cast(pl.Float64) * (factor or 1.0))
        series.append(values[base].alias(name))
    table = pl.DataFrame(series)
    for some in (("time_s",), ("follower.position_m", "follower.speed_mps"), ("leader.position_m", "gap_m")):
        if not {*some} & {*table.columns}:
            raise DataError(f"{source}: --pair names none of {' and '.join(some)}; name one of them.")
    numbers = {name: pl.Float64 for name in NAMES if not name.endswith(("_id", "lane"))}
    missing = [pl.lit(None, numbers.get(name, pl.String)).alias(name) for name in NAMES if name not in table.columns]
    table = table.with_columns(missing).with_columns(pl.col("run_id").cast(pl.String).fill_null("0"))
    table = table.sort("run_id", "time_s", maintain_order=True)
    speed, gap = pl.col("follower.speed_mps"), pl.when(pl.col("gap_m") > 0).then("gap_m")
    even = speed.interpolate().over("run_id")
    steps = (even + even.shift().over("run_id")) / 2 * pl.col("time_s").diff().over("run_id")
    way = pl.coalesce("follower.position_m", steps.fill_null(0.0).cum_sum().over("run_id"))
    lost = table.filter(pl.col("gap_m") <= 0).height
    table = table.with_columns(gap_m=gap, way=way)
    ahead = pl.col("way") + pl.col("gap_m") + pl.col("leader.length_m").fill_null(DEFAULT_LENGTH_M)
    own = pl.col("follower.vehicle_id").cast(pl.String)
    ids = pl.coalesce("leader.vehicle_id", pl.format("{} leader", own), pl.lit("leader")).cast(pl.String)
    table = table.with_columns(lead=pl.coalesce("leader.position_m", ahead), own=own.fill_null("follower"), id=ids)
    shared = ["run_id", "time_s", "lane"]
    leads = pl.when(pl.col("lead").is_not_null()).then("id")
    motion = {"position_m": "way", "speed_mps": speed, "length_m": "follower.length_m", "gap_m": "gap_m"}
    follower = table.select(*shared, vehicle_id="own", leader_id=leads, **motion)  # type: ignore[arg-type]
    rate = pl.coalesce("leader.speed_mps", speed + pl.col("range_rate_mps"))
    leader = table.filter(pl.col("lead").is_not_null()).select(
        *shared, vehicle_id="id", position_m="lead", speed_mps=rate, length_m="leader.length_m"
    )
    words = "gaps are not above 0 and are taken as nobody ahead."
    both = pl.concat([leader, follower], how="diagonal_relaxed")
    empty = [name for name in ("speed_mps", "length_m", "gap_m", "lane") if both[name].null_count() == both.height]
    return both.drop(empty), repaired("nobody ahead", lost, words)
