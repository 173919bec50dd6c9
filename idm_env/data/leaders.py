"""Leaders and gaps: leaders derived or checked, gaps measured or taken from positions."""

import polars as pl

from idm_env.data import units
from idm_env.data.clean import NAMES, NO_LEADER, natural
from idm_env.data.errors import DataError, Repair, listed, repaired
from idm_env.data.schema import TRACK

SHARE_BEHIND = 0.5
"""If more than this share of followers' rows have their leader behind, positions or leaders are wrong."""


def derive(frame: pl.DataFrame) -> pl.DataFrame:
    """Return the frame with leader_id: the next vehicle ahead in the same run, lane and step.

    Who has no lane, in a run that has lanes, has no leader. With ``ring_length_m`` the foremost vehicle of a lane
    follows the hindmost one. Vehicles at the same position are ordered by their identifier, so that the result does not
    depend on the order of rows.
    """
    place = ["run_id", "in_lane", "step"]
    on_ring = "ring_length_m" in frame.columns
    along = pl.col("position_m") % pl.col("ring_length_m") if on_ring else pl.col("position_m")
    along = pl.coalesce(along, "position_m").alias("along")
    order = frame.with_row_index("row").with_columns(along).sort(*place, "along", "vehicle_id")
    ahead = pl.col("vehicle_id").shift(-1).over(place)
    if on_ring:
        around = pl.when(pl.len().over(place) > 1).then(pl.col("vehicle_id").first().over(place))
        ahead = pl.coalesce(ahead, pl.when(pl.col("ring_length_m").is_not_null()).then(around))
    ahead = pl.when(pl.col("in_lane").is_not_null()).then(ahead).alias("leader_id")
    return order.with_columns(ahead).sort("row").drop("row", "along")


def derived(followers: int, lanes: bool) -> Repair:
    """Return the repair that counts vehicles whose leaders were derived."""
    source = "lane and position" if lanes else "position, all vehicles being in one lane"
    text = f"leader_id is absent: the leaders of {followers} vehicles were derived from {source}."
    return Repair("leaders derived", followers, text)


def in_lane(laned: pl.Expr) -> pl.Expr:
    """Return where leaders are looked for: the lane, or one and the same in runs that are not ``laned``."""
    return pl.when(laned).then(pl.col("lane")).otherwise(0).alias("in_lane")


def named_leaders(frame: pl.DataFrame, vehicles: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return the frame with leader_id null where it says "none" (empty, 0, -1) or names no other vehicle of the run.

    Also return how many rows name whom: columns ``leader_id``, ``state`` and ``len``, for ``named``. ``vehicles`` has
    the run_id and vehicle_id of everybody.
    """
    names = vehicles.select("run_id", pl.col("vehicle_id").alias("leader_id"), exists=True).unique()
    joined = frame.join(names, on=["run_id", "leader_id"], how="left", maintain_order="left")
    # 0 and -1 mean "none" only where no vehicle has that name
    none = pl.col("leader_id").is_null() | pl.col("leader_id").str.to_lowercase().is_in(NO_LEADER)
    own = pl.when(pl.col("leader_id") == pl.col("vehicle_id")).then(pl.lit("own"))
    state = own.when(pl.col("exists")).then(pl.lit("there")).when(none).then(pl.lit("none")).otherwise(pl.lit("lost"))
    joined = joined.with_columns(state.alias("state"))
    counts = joined.group_by("leader_id", "state").len()
    leader = pl.when(pl.col("state") == "there").then(pl.col("leader_id")).alias("leader_id")
    return joined.with_columns(leader).drop("exists", "state"), counts


def named(counts: pl.DataFrame, source: str) -> list[Repair]:
    """Return the repairs of the leaders that a file names.

    Raises:
        DataError: If leaders are named, and none is another vehicle of its run.
    """
    total = dict(counts.group_by("state").agg(pl.col("len").sum()).rows())
    wrong = counts.filter(pl.col("state").is_in(["lost", "own"])).sort(natural("leader_id"), "leader_id")
    if wrong.height and "there" not in total:
        name = wrong["leader_id"][0]
        raise DataError(
            f"{source}: leader_id = {name!r} is no other vehicle of its run, as is every leader; check them."
        )
    repairs = []
    if lost := total.get("lost", 0):
        names = wrong.filter(pl.col("state") == "lost")["leader_id"].unique(maintain_order=True)
        text = f"{lost} rows name a leader that the run does not hold ({listed(names, 5)}); they are without leader."
        repairs.append(Repair("leader does not exist", lost, text))
    words = "rows name the vehicle itself as leader and are taken as without leader."
    return repairs + repaired("own leader", total.get("own", 0), words)


def steady(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame, sorted by track and ``step``, without leaders of a single sample between those of another.

    Nobody counts as another. Of four samples around, three must have the other leader: a lane number is off once, or
    the order of two vehicles side by side flickers. The gap there is the mean of those around.
    """
    leader = pl.col("leader_id")

    def shifted(shift: int, name: str = "leader_id") -> pl.Expr:
        return pl.col(name).shift(shift).over(TRACK)

    same_around = shifted(1).eq_missing(shifted(-1))
    around = pl.sum_horizontal(shifted(shift).eq_missing(shifted(1)).cast(pl.Int8) for shift in (-2, -1, 1, 2))
    whole = shifted(-1, "step") - shifted(1, "step") == 2
    flicker = (same_around & whole & (around >= 3) & leader.ne_missing(shifted(1))).fill_null(False)
    count = int(frame.select(flicker.sum()).item())
    if not count:
        return frame, []
    changes = [pl.when(flicker).then(shifted(1)).otherwise(leader).alias("leader_id")]
    if "gap_m" in frame.columns:
        mean = (shifted(1, "gap_m") + shifted(-1, "gap_m")) / 2
        changes.append(pl.when(flicker).then(mean).otherwise("gap_m").alias("gap_m"))
    words = "single samples of another leader were taken as of the one before and after."
    return frame.with_columns(changes), repaired("leader flickers", count, words)


def gaps(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with gap_m in every row with a leader at that time, and the flag gap_measured.

    A run whose file measures gaps keeps them, holes included: positions of such files (antennas, laps) need not agree
    with them. Otherwise gap = leader's position − leader's length − position, around the ring where there is one.

    Raises:
        DataError: If most leaders are behind their followers, or gaps and positions are in different units.
    """
    joined = gap_of(headways(frame, source))
    count = joined.filter(~pl.col("gap_measured") & pl.col("gap_m").is_not_null()).height
    words = "gaps were taken from the positions and lengths of the two vehicles, as gap_m is absent."
    return joined, repaired("gap from positions", count, words)


def gap_of(joined: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of ``headways`` with the gap in force in gap_m, without the columns that it was taken from."""
    gap = pl.when(pl.col("gap_measured")).then(pl.col("gap_m")).otherwise(pl.col("headway") - pl.col("lead_length"))
    gap = pl.when(pl.col("leader_id").is_not_null()).then(gap)
    return joined.with_columns(gap.alias("gap_m")).drop("lead_position", "lead_length", "headway")


def headways(frame: pl.DataFrame, source: str) -> pl.DataFrame:
    """Return the frame with gap_measured, lead_position, lead_length, headway (front to front); errors of ``gaps``."""
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
    return joined


def _check_ahead(joined: pl.DataFrame, source: str) -> None:
    rows = joined.filter(~pl.col("gap_measured") & pl.col("headway").is_not_null())
    behind = rows.filter(pl.col("headway") < 0)
    if rows.height and behind.height > SHARE_BEHIND * rows.height:
        run, vehicle, leader, time = behind.sort(*NAMES, "step").select(*TRACK, "leader_id", "time_s").row(0)
        raise DataError(
            f"{source}: leader {leader} is behind vehicle {vehicle} of run {run} at t = {time:g} s, as in "
            f"{behind.height} of {rows.height} rows; positions must rise along the road, or give ring_length."
        )
