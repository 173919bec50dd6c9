"""Reader of the official NGSIM vehicle trajectories: feet, frames of 0.1 s, milliseconds, ``Preceding``.

Both the original files' capitals (``v_Vel``) and the data.transportation.gov layout (with ``Location``, thousands
separators, and identifiers used again in another period) are read. Local_Y is the front centre of the vehicle.
Source: U.S. Federal Highway Administration, Next Generation Simulation, data dictionary of the trajectory files.
"""

import polars as pl

from idm_env.data.clean import exact
from idm_env.data.errors import DataError, Repair, refuse_missing, repaired

FOOT_M = 0.3048
FRAME_S = 0.1
NEW_VEHICLE_MS = 60_000
"""A vehicle that is away for longer than this is another one with the same identifier."""
_WHOLE = ("vehicle_id", "frame_id", "global_time", "total_frames", "lane_id", "preceding")
_NUMBERS = (*_WHOLE, "local_x", "local_y", "v_length", "v_vel")
_ALIASES = (
    "v_length=veh_len v_length=v_len v_length=veh_length v_vel=veh_velocity v_vel=veh_vel v_vel=v_velocity "
    "v_acc=vehicle_acc v_class=veh_class total_frames=tot_frames global_time=epoch_ms preceding=preceding_veh "
    "preceding=preceding_vehicle lane_id=lane lane_id=lane_identification section_id=section int_id=intersection"
)
ALIASES = {other: name for name, other in (pair.split("=") for pair in _ALIASES.split())}
"""Names of the motorways' files, by those of the arterials' (Lankershim, Peachtree) and of copies."""
_HEAD = "vehicle_id frame_id total_frames global_time local_x local_y x y v_length v_width v_class v_vel v_acc lane_id"
_ZONES, _TAIL = "o_zone d_zone int_id section_id direction movement", "preceding following space_headway time_headway"
WITHOUT_HEADER = {18: f"{_HEAD} {_TAIL}".split(), 24: f"{_HEAD} {_ZONES} {_TAIL}".split()}
"""Names of the columns of the original text files, which have no line of names, by their number."""
_OTHERS = {"v_class": "vehicle_class", "direction": "direction", "section_id": "section", "int_id": "intersection"}


def matches(columns: list[str]) -> bool:
    """Say whether the header is NGSIM's."""
    plain = {_plain(name) for name in columns}
    return "local_y" in plain and bool({"frame_id", "global_time"} & plain)


def read(frame: pl.DataFrame, source: str = "table") -> tuple[pl.DataFrame, list[Repair]]:
    """Return the tidy table of an NGSIM table, in SI units.

    Raises:
        DataError: If a column that is needed is missing, or identifiers are floats too large to be told apart.
    """
    plain = [_plain(name) for name in frame.columns]
    if twice := next((name for name in plain if plain.count(name) > 1), None):
        both = " and ".join(repr(name) for name in frame.columns if _plain(name) == twice)
        raise DataError(f"{source}: columns {both} are both NGSIM's {twice}; remove one of them.")
    frame = frame.rename(dict(zip(frame.columns, plain, strict=True)))
    refuse_missing(("vehicle_id", "local_y"), frame.columns, source)
    names = [name for name in _NUMBERS if name in frame.columns]
    frame = frame.with_columns(_number(frame, name, source) for name in names)
    place = pl.col("location").cast(pl.String).str.strip_chars().fill_null("ngsim")
    frame = frame.with_columns((place if "location" in frame.columns else pl.lit("ngsim")).alias("run_id"))
    frame = _with_time(frame, source)
    frame, repairs = _told_apart(frame)
    feet = {"local_y": "position_m", "v_vel": "speed_mps", "v_length": "length_m", "local_x": "lateral_m"}
    columns = [pl.col("run_id", "vehicle_id", "time_s")]
    columns += [(pl.col(old) * FOOT_M).alias(new) for old, new in feet.items() if old in frame.columns]
    if "leader_id" in frame.columns:
        columns.append(pl.col("leader_id"))
    if "lane_id" in frame.columns:
        columns.append(pl.col("lane_id").alias("lane"))
    columns += [pl.col(old).alias(new) for old, new in _OTHERS.items() if old in frame.columns]
    return frame.select(columns), repairs


def _plain(name: str) -> str:
    plain = name.strip().lower().replace(" ", "_")
    return ALIASES.get(plain, plain)


def _number(frame: pl.DataFrame, name: str, source: str) -> pl.Expr:
    column = pl.col(name)
    whole = name in _WHOLE
    if whole and frame[name].dtype.is_integer():
        return column.cast(pl.Int64, strict=False)
    if frame[name].dtype == pl.String:
        column = column.str.replace_all(",", "").str.strip_chars()
    column = column.cast(pl.Float64, strict=False)
    if name in ("vehicle_id", "preceding"):
        exact(frame.select(column)[name], source)
    return (column.round().cast(pl.Int64, strict=False) if whole else column).alias(name)


def _with_time(frame: pl.DataFrame, source: str) -> pl.DataFrame:
    """Return the frame with time_s: of frames where they are one clock, else of Global_Time since the run's start."""
    if "frame_id" not in frame.columns and "global_time" not in frame.columns:
        raise DataError(f"{source}: neither Frame_ID nor Global_Time is present; one of them must tell the time.")
    if "global_time" not in frame.columns:
        return frame.with_columns((pl.col("frame_id") * FRAME_S).alias("time_s"))
    since = (pl.col("global_time") - pl.col("global_time").min().over("run_id")) / 1000.0
    if "frame_id" in frame.columns:
        offset = pl.col("global_time") - 100 * pl.col("frame_id")
        one_clock = (offset.max() - offset.min()).over("run_id") < 50
        since = pl.when(one_clock).then(pl.col("frame_id") * FRAME_S).otherwise(since)
    return frame.with_columns(since.alias("time_s"))


def _told_apart(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Give vehicles that share an identifier in different periods their own, and resolve ``preceding`` likewise."""
    name = ["run_id", "vehicle_id"]
    keys = [*name, *(["total_frames"] if "total_frames" in frame.columns else []), "time_s"]
    frame = frame.sort(keys, maintain_order=True)
    new = (pl.col("time_s").diff().over(name) > NEW_VEHICLE_MS / 1000) | (pl.col("time_s").diff().over(name) < 0)
    frame = frame.with_columns(new.fill_null(False).cum_sum().over(name).alias("again"))
    text = pl.col("vehicle_id").cast(pl.String)
    named = pl.when(pl.col("again") > 0).then(text + "." + pl.col("again").cast(pl.String)).otherwise(text)
    frame = frame.with_columns(named.alias("name"))
    count = frame.filter(pl.col("again") > 0).select("run_id", "name").n_unique()
    if "preceding" in frame.columns:
        leaders = frame.select("run_id", "time_s", preceding="vehicle_id", leader_id="name").unique(
            ["run_id", "time_s", "preceding"], keep="first"
        )
        frame = frame.join(leaders, on=["run_id", "time_s", "preceding"], how="left", maintain_order="left")
        # a leader outside the file keeps its number, so that it is counted as one that does not exist
        frame = frame.with_columns(pl.coalesce("leader_id", pl.col("preceding").cast(pl.String)))
    frame = frame.drop("vehicle_id").rename({"name": "vehicle_id"})
    words = "vehicles had the identifier of an earlier one and were told apart by their times."
    return frame, repaired("identifier used again", count, words)
