"""Two driving directions in one file: who drives towards falling positions is mirrored, into a run of its own.

Everything behind this (leaders, gaps, the simulator) has positions that rise along the road. A file in which all fall
is refused.
"""

import polars as pl

from idm_env.data.clean import NAMES
from idm_env.data.errors import DataError, Repair, repaired
from idm_env.data.schema import TRACK

DECIDED_M = 20.0
"""A vehicle whose position changes by less in all (m) may be standing; it takes the direction of its lane."""
SUFFIX = "-reverse"
"""What the run of a mirrored vehicle ends with."""


END = (
    pl.col("time_s").min().alias("begin"),
    pl.col("time_s").max().alias("end"),
    pl.col("position_m").sort_by("time_s").first().alias("from"),
    pl.col("position_m").sort_by("time_s").last().alias("to"),
    pl.col("position_m").sort_by("time_s").diff().sign().sum().alias("rises"),
)
"""Per group of rows: times (s) and positions (m) of the ends of a track, and by how many its rises outnumber its falls.

Where the two disagree the position begins anew, as on a lap: there it says nothing of the direction.
"""


def lane_of(frame: pl.DataFrame) -> pl.Expr:
    """Return, per group of rows, the first lane; null where there is none."""
    return pl.col("lane").drop_nulls().first() if "lane" in frame.columns else pl.lit(None, pl.Int64).alias("lane")


def ends(frame: pl.DataFrame) -> pl.DataFrame:
    """Return ``END`` and the lane of every vehicle; on a ring, where a fall is a new lap, there is no direction."""
    if "ring_length_m" in frame.columns:
        frame = frame.filter(pl.col("ring_length_m").is_null())
    rows = frame.filter(pl.col("position_m").is_not_null())
    return rows.group_by(TRACK, maintain_order=True).agg(*END, lane_of(frame))


def against(vehicles: pl.DataFrame, source: str) -> pl.DataFrame:
    """Return run_id and vehicle_id of those (of ``ends``) that drive towards falling positions.

    Raises:
        DataError: If they all do: then the sign of all positions is wrong, which is not ours to guess.
    """
    net = (pl.col("to") - pl.col("from")).alias("net")
    clear = (pl.col("net").abs() >= DECIDED_M) & (pl.col("net").sign() * pl.col("rises") >= 0)
    decided = vehicles.with_columns(net).with_columns(pl.when(clear).then(pl.col("net").sign()).alias("sign"))
    of_lane = pl.when(pl.col("lane").is_not_null()).then(pl.col("sign").sum().over("run_id", "lane"))
    falling = decided.with_columns(pl.coalesce("sign", of_lane).alias("sign")).filter(pl.col("sign") < 0)
    if falling.height and not (decided["sign"] > 0).any():
        run, vehicle, low, high = falling.sort(*NAMES).select(*TRACK, "to", "from").row(0)
        raise DataError(
            f"{source}: position_m falls while vehicles drive (vehicle {vehicle} of run {run}: from {high:g} to "
            f"{low:g}); it must rise along the road: change its sign."
        )
    return falling.select(TRACK)


def mirrored(frame: pl.DataFrame, vehicles: pl.DataFrame) -> pl.DataFrame:
    """Return the frame with the positions of some vehicles mirrored and their runs renamed.

    A speed that was negative with the position's fall becomes positive, and the acceleration with it.
    """
    if vehicles.height == 0:
        return frame
    other = frame.join(vehicles.with_columns(turn=True), on=TRACK, how="left", maintain_order="left")
    turn = pl.col("turn").fill_null(False)
    changes = [pl.when(turn).then(-pl.col("position_m")).otherwise(pl.col("position_m")).alias("position_m")]
    if "speed_mps" in frame.columns:
        signed = turn & (pl.col("speed_mps").median().over(TRACK) < 0)
        motion = [name for name in ("speed_mps", "accel_mps2") if name in frame.columns]
        changes += [pl.when(signed).then(-pl.col(name)).otherwise(pl.col(name)).alias(name) for name in motion]
    return renamed(other.with_columns(changes).drop("turn"), vehicles)


def renamed(frame: pl.DataFrame, vehicles: pl.DataFrame) -> pl.DataFrame:
    """Return the frame with the runs of mirrored vehicles renamed."""
    if vehicles.height == 0:
        return frame
    other = frame.join(vehicles.with_columns(turn=True), on=TRACK, how="left", maintain_order="left")
    run = pl.when(pl.col("turn").fill_null(False)).then(pl.col("run_id") + SUFFIX).otherwise(pl.col("run_id"))
    return other.with_columns(run.alias("run_id")).drop("turn")


def repairs(vehicles: pl.DataFrame) -> list[Repair]:
    """Return the repair that counts mirrored vehicles."""
    words = (
        f"vehicles drive against the others (their position_m falls): they were mirrored, with "
        f"−position_m for position_m, and are in runs of their own, whose names end with '{SUFFIX}'."
    )
    return repaired("direction mirrored", vehicles.height, words)


def one_way(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with every vehicle driving towards rising positions; DataError as in ``against``."""
    vehicles = against(ends(frame), source)
    return mirrored(frame, vehicles), repairs(vehicles)
