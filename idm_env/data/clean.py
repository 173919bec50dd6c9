"""First pass over a table: types, identifiers, values that are not finite, order and repeats of time."""

from dataclasses import dataclass, field

import polars as pl

from idm_env.data.errors import DataError, Repair, listed, repaired
from idm_env.data.schema import LARGEST, NUMBERS, REQUIRED, TRACK, of_run, taken_as_missing

LANES_OF_A_ROAD = 100
HIDDEN_S = 2.0
"""A vehicle without a position is still about where it was for so long (s)."""
LARGEST_ID = 2.0**53
"""Floats tell whole numbers apart below this only."""
NO_LEADER = ("", "0", "-1", "nan", "none", "null", "na")
_DATE = r"^(?<day>\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?) ?(?<zone>[Zz]|[+-]\d\d(?::?\d\d)?)?$"
MISSING_WORDS = ("", "na", "n/a", "nan", "null", "none", "-", "inf", "-inf", "+inf", "infinity", "-infinity")


def exact(column: pl.Series, source: str) -> None:
    """Raise DataError if identifiers are floats so large that neighbouring integers are one float."""
    large = column.filter(column.fill_nan(None).abs() >= LARGEST_ID)
    if len(large):
        raise DataError(
            f"{source}: {column.name} = {large[0]:.17g} is a float beyond 2^53, where several identifiers become one; "
            "write identifiers as integers or text."
        )


def identifiers(frame: pl.DataFrame, source: str = "table") -> pl.DataFrame:
    """Return the frame with run_id, vehicle_id and leader_id as strings; run_id "0" where the column is absent.

    Raises:
        DataError: If identifiers are lists, or floats so large that neighbouring integers are one float.
    """
    if "run_id" not in frame.columns:
        frame = frame.with_columns(pl.lit("0").alias("run_id"))
    changes = []
    for name in ("run_id", "vehicle_id", "leader_id"):
        if name not in frame.columns:
            continue
        _single(frame[name], source)
        column = pl.col(name)
        if frame[name].dtype.is_float():
            exact(frame[name], source)
            # A csv column of integers with empty cells arrives as floats: 12.0 is vehicle 12.
            column = pl.when(column.round() == column).then(column.cast(pl.Int64, strict=False).cast(pl.String))
            column = column.otherwise(pl.col(name).fill_nan(None).cast(pl.String))
        changes.append(column.cast(pl.String).str.strip_chars().replace("", None).alias(name))
    return frame.with_columns(changes)


def _single(column: pl.Series, source: str) -> None:
    """Raise DataError if the cells of a column hold several values."""
    if column.dtype.is_nested() or column.dtype == pl.Object:
        kind = type(column.dtype).__name__.lower()
        raise DataError(f"{source}: {column.name} holds a {kind} in every row; write one value per row.")


def numbers(frame: pl.DataFrame, source: str, labels: dict[str, int]) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with its numeric columns as Float64 and everything not finite as null, counted.

    A number beyond `LARGEST` is as little a measurement as an infinite one. Lanes that are texts are numbered, as
    ``labels`` says, which grows by those that it does not have. DataError for a lane between two lanes.
    """
    frame, repairs = numbered(frame, labels)
    for name in [*NUMBERS, "lane"]:
        if name in frame.columns and not frame[name].dtype.is_numeric():
            frame = parsed(frame, name, source)
    if "lane" in frame.columns:
        value = frame["lane"].cast(pl.Float64)
        between = (value.is_finite() & ((value - value.round()).abs() > 1e-6)).fill_null(False)
        if between.any():
            row = int(between.arg_true()[0])
            fault = f"lane = {value[row]:g} in row {row + 1} is between two lanes"
            raise DataError(f"{source}: {fault}. Give a whole number, or an empty cell.")
    lane = [pl.col("lane").cast(pl.Float64).round().cast(pl.Int64, strict=False)] if "lane" in frame.columns else []
    present = [name for name in NUMBERS if name in frame.columns]
    frame = frame.with_columns(lane).with_columns(pl.col(present).cast(pl.Float64))
    for name in frame.columns:
        if not frame[name].dtype.is_float():
            continue
        finite = (frame[name].is_finite() & (frame[name].abs() <= LARGEST.get(name, float("inf")))).fill_null(True)
        words = "were NaN, infinite or beyond all measure and are"
        frame, done = taken_as_missing(frame, name, finite, "not finite", words)
        repairs += done
    return frame, repairs


def numbered(frame: pl.DataFrame, labels: dict[str, int]) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with lanes that are texts, such as ``E0_1``, as numbers: 1 apart where only the last one is."""
    if "lane" not in frame.columns or frame["lane"].dtype not in (pl.String, pl.Categorical, pl.Enum):
        return frame, []
    text = frame["lane"].cast(pl.String).str.strip_chars()
    lanes = text.filter(~text.str.to_lowercase().is_in(MISSING_WORDS)).unique(maintain_order=True)
    if not labels and lanes.cast(pl.Float64, strict=False).null_count() == 0:
        return frame, []
    new = 0
    roads = {label.rpartition("_")[0]: number // LANES_OF_A_ROAD for label, number in labels.items()}
    for label in lanes.drop_nulls():
        if label not in labels:
            road, _, index = label.rpartition("_")
            is_of_road = bool(road) and index.isdecimal() and int(index) < LANES_OF_A_ROAD
            number = roads.setdefault(road if is_of_road else label, len(roads) + 1)
            labels[label] = number * LANES_OF_A_ROAD + (int(index) if is_of_road else 0)
            new += 1
    lane = text.replace_strict(labels, default=None, return_dtype=pl.Int64).alias("lane")
    words = f"lanes are texts ({listed(labels, 3)}) and were numbered."
    return frame.with_columns(lane), repaired("lane numbered", new, words)


def parsed(frame: pl.DataFrame, name: str, source: str) -> pl.DataFrame:
    """Return the frame with a column as numbers; times may be texts such as 12:30:05.2, or dates (s).

    Raises:
        DataError: If a cell is no number, or holds several.
    """
    column = frame[name]
    if column.dtype.is_numeric():
        return frame
    _single(column, source)
    if column.dtype == pl.Null:
        return frame.with_columns(column.cast(pl.Float64))
    if column.dtype.is_temporal():
        whole = column.cast(pl.Datetime("us")) if column.dtype == pl.Date else column
        ticks = {"ns": 1e9, "us": 1e6, "ms": 1e3}[getattr(whole.dtype, "time_unit", None) or "ns"]
        return frame.with_columns((whole.to_physical().cast(pl.Float64) / ticks).alias(name))
    text = column.cast(pl.String).str.strip_chars()  # of a Boolean "true", which is no number
    value = text.cast(pl.Float64, strict=False)
    if name == "time_s":
        value = pl.select(pl.coalesce(value, _of_day(text), _of_date(text, source)).alias(name))[name]
    wrong = value.is_null() & text.is_not_null() & ~text.str.to_lowercase().is_in(MISSING_WORDS)
    if wrong.any():
        row = int(wrong.arg_true()[0])
        how = "write it as seconds, 12:30:05.2 or a date" if name == "time_s" else "write it with a decimal point"
        raise DataError(f"{source}: {name} = {text[row]!r} in row {row + 1} is not a number; {how}.")
    return frame.with_columns(value.alias(name))


def _of_day(text: pl.Series) -> pl.Series:
    """Return the seconds since midnight of texts such as 12:30:05.2 or 12:30:05,2; null for others."""
    parts = text.str.extract_groups(r"^(\d{1,3}):(\d{1,2}):(\d{1,2}(?:[.,]\d+)?)$").struct.unnest()
    hours, minutes, seconds = (part.str.replace(",", ".").cast(pl.Float64) for part in parts.iter_columns())
    return 3600 * hours + 60 * minutes + seconds


def _of_date(text: pl.Series, source: str) -> pl.Series:
    """Return the seconds since 1970 of dates such as 2024-05-01 12:30:05.2 or …+02:00; null for others.

    DataError where some have an offset from UTC and others none: these are of an unknown zone.
    """
    parts = text.str.extract_groups(_DATE).struct.unnest()
    day, zone = parts["day"].str.replace("T", " "), parts["zone"]
    seconds = day.str.to_datetime("%Y-%m-%d %H:%M:%S%.f", strict=False, time_unit="us").to_physical() / 1e6
    if zone.null_count() == len(zone):
        return seconds
    bare = seconds.is_not_null() & zone.is_null()
    if bare.any():
        row = int(bare.arg_true()[0])
        raise DataError(
            f"{source}: {text.name} = {text[row]!r} in row {row + 1} has no offset from UTC, and other rows have one; "
            "write all times with it, or none."
        )
    number = zone.str.replace(":", "").str.replace("(?i)Z", "+0000").str.pad_end(5, "0").cast(pl.Int64, strict=False)
    return seconds - 60.0 * (number.abs() // 100 * 60 + number.abs() % 100) * number.sign()


def without_empty(frame: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Leave out rows that have no vehicle or time.

    Raises:
        DataError: If one of the others has no run.
    """
    rows = frame.filter(pl.all_horizontal(pl.col("vehicle_id", "time_s").is_not_null()))
    check_runs(rows.filter(pl.col("run_id").is_null()), source)
    return rows, repaired("no time", frame.height - rows.height, "rows without a vehicle or a time were left out.")


def check_runs(nowhere: pl.DataFrame, source: str) -> None:
    """Raise DataError if there are rows of vehicles without a run."""
    if nowhere.height:
        vehicle = nowhere["vehicle_id"][0]
        raise DataError(f"{source}: run_id is empty for vehicle {vehicle}; name the run of each row, or none.")


@dataclass
class Filled:
    """How many rows a file has, over all its pieces, and in how many each column that every row needs is filled.

    ``lanes`` has the numbers of lanes that are texts.
    """

    rows: int = 0
    whole: int = 0
    filled: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REQUIRED, 0))
    lanes: dict[str, int] = field(default_factory=dict)

    def add(self, frame: pl.DataFrame) -> None:
        """Count the rows of one more piece."""
        present = frame.select(pl.col(REQUIRED).is_not_null())
        self.rows += frame.height
        self.whole += int(present.select(pl.all_horizontal(REQUIRED).sum()).item())
        for name in REQUIRED:
            self.filled[name] += int(present[name].sum())

    def check(self, source: str) -> None:
        """Raise DataError if no row can be used."""
        if not self.rows:
            raise DataError(f"{source}: the table has a header and no rows; give at least one leader and one follower.")
        empty = [name for name, count in self.filled.items() if not count]
        if empty or not self.whole:
            fault = f"{listed(empty)} is empty in every row" if empty else f"no row has all of {listed(REQUIRED)}"
            raise DataError(
                f"{source}: {fault}; fill it: vehicle, time in seconds, position of the front bumper in metres."
            )


def ordered(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair], pl.DataFrame]:
    """Sort by run, vehicle and time, and keep the first of rows that repeat a time.

    Also return who is at two places at one time: run_id, vehicle_id, the first such time and their number (``moved``).
    """
    repairs = []
    backward = pl.col("time_s").diff().over(TRACK) < 0
    unsorted = int(frame.select(backward.sum()).item() or 0)
    if unsorted:
        text = f"Time runs backward at {unsorted} rows; the rows were sorted by time."
        repairs.append(Repair("time not increasing", unsorted, text))
    frame = frame.sort(*NAMES, "time_s", pl.col("position_m").is_null(), maintain_order=True)
    same = (pl.col("run_id") == pl.col("run_id").shift(1)) & (pl.col("vehicle_id") == pl.col("vehicle_id").shift(1))
    repeated = (pl.col("time_s").diff() == 0) & same
    moved = frame.filter(repeated & ((pl.col("position_m") - pl.col("position_m").shift(1)).abs() > 1e-6))
    rows = frame.filter(~repeated.fill_null(False))
    words = "rows repeat a time of their vehicle and were left out; the first of each was kept."
    repairs += repaired("duplicated time", frame.height - rows.height, words)
    twice = moved.group_by(TRACK, maintain_order=True).agg(pl.col("time_s").first(), pl.len().alias("moved"))
    return rows, repairs, twice


def check_recordings(twice: pl.DataFrame, rows: int, source: str) -> None:
    """Raise DataError if vehicles are at two places at one time so often that two recordings must share a run_id.

    ``twice`` is what ``ordered`` tells of all rows of the file.
    """
    moved = int(twice["moved"].sum())
    if moved > max(0.02 * rows, 5):
        run, vehicle, time = twice.sort(*NAMES).select(*TRACK, "time_s").row(0)
        raise DataError(
            f"{source}: vehicle {vehicle} of run {run} is at two positions at t = {time:g} s, as are {moved} rows; two "
            "recordings share a run_id: give each its own."
        )


def natural(name: str) -> pl.Expr:
    """Return a sort key under which vehicle 2 comes before vehicle 10; text identifiers come last."""
    return pl.col(name).cast(pl.Int64, strict=False).fill_null(2**62).alias(f"{name}_number")


NAMES = (natural("run_id"), "run_id", natural("vehicle_id"), "vehicle_id")
"""The order of tracks."""


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
        words = f"single missing values of {name} were interpolated between their neighbours in time."
        repairs += repaired("interpolated", frame[name].null_count() - filled.null_count(), words)
        frame = frame.with_columns(filled)
    return frame, repairs


def hidden(frame: pl.DataFrame) -> pl.DataFrame:
    """Return the rows without a position of vehicles that are known to be there, with about where they are.

    That is between the positions before and after, or at the nearest, no more than ``HIDDEN_S`` away from it.
    """
    keep = [name for name in (*TRACK, "time_s", "position_m", "lane", "ring_length_m") if name in frame.columns]
    if not frame["position_m"].null_count():
        return frame.select(keep).clear()
    position, time = pl.col("position_m"), pl.col("time_s")
    sure = pl.when(position.is_not_null()).then(time)
    near = pl.min_horizontal(time - sure.forward_fill().over(TRACK), sure.backward_fill().over(TRACK) - time)
    about = position.interpolate().forward_fill().backward_fill().over(TRACK)
    rows = frame.with_columns(about, position.is_null().alias("is_hidden"), near.alias("near"))
    return rows.filter(pl.col("is_hidden") & (pl.col("near") <= HIDDEN_S)).select(keep)


def on_clock(rows: pl.DataFrame, frame: pl.DataFrame, steps: dict[str, float]) -> pl.DataFrame:
    """Return ``hidden`` rows with the ``step`` of the clock of their runs, which those of ``frame`` have."""
    if not rows.height:
        return rows.with_columns(pl.lit(None, pl.Int64).alias("step"))
    starts = frame.group_by("run_id").agg((pl.col("time_s") - pl.col("step") * of_run(steps)).first().alias("start"))
    step = ((pl.col("time_s") - pl.col("start")) / of_run(steps)).round().cast(pl.Int64)
    return rows.join(starts, on="run_id", how="inner").with_columns(step.alias("step")).drop("start")


def without_position(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Leave out rows whose position is still missing; tracks are split there."""
    rows = frame.filter(pl.col("position_m").is_not_null())
    count = frame.height - rows.height
    if not count:
        return rows, []
    tracks = frame.filter(pl.col("position_m").is_null()).select(TRACK).unique(maintain_order=True).rows()
    names = listed(vehicle for _, vehicle in tracks)
    text = f"{count} rows without a position were left out; tracks are split there (vehicles {names})."
    return rows, [Repair("no position", count, text)]
