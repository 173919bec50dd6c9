"""Who follows whom, and at what gap: leaders derived or checked, gaps measured or taken from positions."""

from __future__ import annotations

import polars as pl

from idm_env.data import units
from idm_env.data.clean import NO_LEADER
from idm_env.data.errors import DataError, Repair, listed
from idm_env.data.schema import TRACK

SHARE_BEHIND = 0.5
"""If more than this share of followers' rows have their leader behind, positions or leaders are wrong."""


def derive(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with leader_id: the next vehicle ahead in the same run, lane and step.

    With ``ring_length_m`` the foremost vehicle of a lane follows the hindmost one. Vehicles at the same position are
    ordered by their identifier, so that the result does not depend on the order of rows.
    """
    place = ["run_id", "lane", "step"]
    on_ring = "ring_length_m" in frame.columns
    along = pl.col("position_m") % pl.col("ring_length_m") if on_ring else pl.col("position_m")
    order = frame.with_row_index("row").with_columns(along.alias("along")).sort(*place, "along", "vehicle_id")
    ahead = pl.col("vehicle_id").shift(-1).over(place)
    if on_ring:
        around = pl.when(pl.len().over(place) > 1).then(pl.col("vehicle_id").first().over(place))
        ahead = pl.coalesce(ahead, pl.when(pl.col("ring_length_m").is_not_null()).then(around))
    derived = order.with_columns(ahead.alias("leader_id")).sort("row")
    followers = derived.filter(pl.col("leader_id").is_not_null()).select(TRACK).n_unique()
    lanes = (
        "lane and position" if frame["lane"].null_count() < frame.height else "position, all vehicles being in one lane"
    )
    text = f"leader_id is absent: the leaders of {followers} vehicles were derived from {lanes}."
    return derived.drop("row", "along"), [Repair("leaders derived", followers, text)]


def known(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with leader_id null where it says "none" (empty, 0, -1) or names no vehicle of the run.

    Raises:
        DataError: If every row is without leader, or no named leader exists.
    """
    vehicles = frame.select("run_id", pl.col("vehicle_id").alias("leader_id"), exists=True).unique()
    joined = frame.join(vehicles, on=["run_id", "leader_id"], how="left", maintain_order="left")
    exists = joined["exists"].fill_null(False)
    # 0 and -1 mean "none" only where no vehicle has that name
    none = (joined["leader_id"].str.to_lowercase().is_in(NO_LEADER) & ~exists) | joined["leader_id"].is_null()
    if none.all():
        raise DataError(
            f"{source}: leader_id is empty in every row, so that nobody follows anybody; fill it, or remove the column "
            "to have leaders derived from lane and position."
        )
    own = (joined["leader_id"] == joined["vehicle_id"]).fill_null(False)
    lost = ~none & ~exists
    if not (exists & ~own & ~none).any():
        name = joined.filter(~none)["leader_id"][0]
        raise DataError(
            f"{source}: leader_id = {name!r} is no other vehicle of its run, as is every leader; check the identifiers."
        )
    repairs = []
    if lost.any():
        names = joined.filter(lost)["leader_id"].unique(maintain_order=True)
        count, some = int(lost.sum()), listed(names, 5)
        text = f"{count} rows name a leader that the run does not hold ({some}) and are taken as without leader."
        repairs.append(Repair("leader does not exist", count, text))
    if own.any():
        text = f"{own.sum()} rows name the vehicle itself as leader and are taken as without leader."
        repairs.append(Repair("own leader", int(own.sum()), text))
    keep = exists & ~own & ~none
    return joined.with_columns(pl.when(keep).then(pl.col("leader_id")).alias("leader_id")).drop("exists"), repairs


def gaps(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with gap_m in every row with a leader at that time, and the flag gap_measured.

    A run whose file measures gaps keeps them, holes included: positions of such files (antennas, laps) need not agree
    with them. Otherwise gap = leader's position − leader's length − position, around the ring where there is one.

    Raises:
        DataError: If most leaders are behind their followers, or gaps and positions are in different units.
    """
    if "gap_m" not in frame.columns:
        frame = frame.with_columns(pl.lit(None, pl.Float64).alias("gap_m"))
    measured = pl.col("gap_m").is_not_null().any().over("run_id")
    lead = frame.select("run_id", "step", leader_id="vehicle_id", lead_position="position_m", lead_length="length_m")
    joined = frame.with_columns(measured.alias("gap_measured"))
    joined = joined.join(lead, on=["run_id", "leader_id", "step"], how="left", maintain_order="left")
    headway = pl.col("lead_position") - pl.col("position_m")
    if "ring_length_m" in frame.columns:
        ring = pl.col("ring_length_m")
        headway = pl.when(ring.is_not_null()).then(headway % ring).otherwise(headway)
    joined = joined.with_columns(headway.alias("headway"))
    _check_ahead(joined, source)
    units.check_gaps(joined, source)
    gap = pl.when(pl.col("gap_measured")).then(pl.col("gap_m")).otherwise(pl.col("headway") - pl.col("lead_length"))
    gap = pl.when(pl.col("leader_id").is_not_null()).then(gap)
    joined = joined.with_columns(gap.alias("gap_m")).drop("lead_position", "lead_length", "headway")
    count = joined.filter(~pl.col("gap_measured") & pl.col("gap_m").is_not_null()).height
    text = f"{count} gaps were taken from the positions and lengths of the two vehicles, as gap_m is absent."
    return joined, [Repair("gap from positions", count, text)] if count else []


def _check_ahead(joined: pl.DataFrame, source: str) -> None:
    rows = joined.filter(~pl.col("gap_measured") & pl.col("headway").is_not_null())
    behind = rows.filter(pl.col("headway") <= 0)
    if rows.height and behind.height > SHARE_BEHIND * rows.height:
        run, vehicle, leader, time = behind.select("run_id", "vehicle_id", "leader_id", "time_s").row(0)
        raise DataError(
            f"{source}: leader {leader} is behind vehicle {vehicle} of run {run} at t = {time:g} s, as in "
            f"{behind.height} of {rows.height} rows; positions must rise along the road, or give ring_length."
        )
