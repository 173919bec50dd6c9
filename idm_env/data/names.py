"""Columns under names and units of their own: ``position_m=x[ft]``, and the best guess at a header that is unknown."""

import math
import re
import shlex
from collections.abc import Mapping
from typing import Any

import polars as pl

from idm_env.data.clean import parsed
from idm_env.data.errors import DataError, Repair, listed, missing_column, nearest
from idm_env.data.schema import REQUIRED, TIDY

LENGTHS = {"m": 1.0, "ft": 0.3048, "feet": 0.3048, "km": 1000.0, "mi": 1609.344, "cm": 0.01, "mm": 0.001}
TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
SPEEDS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "ft/s": 0.3048, "cm/s": 0.01, "mm/s": 0.001}
SPEEDS |= {"mps": 1.0, "kmh": 1 / 3.6, "kph": 1 / 3.6, "fps": 0.3048, "ftps": 0.3048}
ACCELERATIONS = {"m/s2": 1.0, "m/s^2": 1.0, "m/s²": 1.0, "mps2": 1.0, "ft/s2": 0.3048, "ft/s^2": 0.3048, "g": 9.80665}
UNITS: dict[str, dict[str, float]] = {"time_s": TIMES, "speed_mps": SPEEDS, "accel_mps2": ACCELERATIONS}
UNITS |= dict.fromkeys(("position_m", "length_m", "gap_m", "ring_length_m"), LENGTHS)
"""Units by column, and what they are multiplied by."""
SHORT = {re.sub(r"_(id|s|m|mps2?)$", "", name): name for name in (*TIDY, *UNITS)}
"""``time`` for ``time_s``, and so on."""
GUESSES = {
    "vehicle_id": r"(o|obj|veh|vehicle|car|track|agent|object|actor)?_?(id|no|nr|number|name)?|fahrzeug",
    "time_s": r"t|time|time_?(sta(mp)?|step_time)|stamp|seconds|clock|sim(ulation)?_?(sec|time)|zeit",
    "position_m": r"x|s|y|pos|position|local_y|station|chainage|distance|odometer|x_?pos(ition)?|weg|vehicle_pos",
    "run_id": r"(run|trip|drive|recording|scenario|scene|session|trajectory)_?(id|no|nr)?",
    "leader_id": r"(lead|leader|preceding|predecessor|front)_?(id|vehicle|car)*",
    "lane": r"(vehicle_)?lane_?(id|index|no|nr|number)?|spur|fahrstreifen",
    "speed_mps": r"v|vx|vel|velocity|(vehicle_)?speed|geschwindigkeit",
    "length_m": r"(veh|vehicle)?_?(l|len|length)",
    "gap_m": r"gap|space_?gap|spacing|net_distance",
}
"""What a column is perhaps called that has no tidy name."""
ON_EARTH = dict.fromkeys(("longitude", "lon", "lng", "easting"), "x")
ON_EARTH |= dict.fromkeys(("latitude", "lat", "northing"), "y")
"""Coordinates that point east, and north."""
MOST_ACROSS, WIDEST = 0.25, 12.0
"""Vehicles that move across by such a share of their way, and one by more than three lanes (m), have turned."""
_X, _V, _SENSOR = (
    r"(x|s|y|pos|position|loc|local_?y)",
    r"(v|vel|velocity|spd|speed)",
    r"(radar|lidar|sensor|acc|can|obj(ect)?|mobileye)?_?",
)
_WHO = {"follower": r"(f|fv|sv|fav|fol|foll|follower|following|ego|own|host|subject|self)"}
_WHO["leader"] = r"(l|lv|pv|lead|leader|leading|preceding|front|target)"
_WHAT = {"position_m": _X, "speed_mps": _V, "length_m": "(l|len|length)"}
PAIRS = {f"{who}.{name}": rf"{w}_?{of}|{of}_?{w}" for who, of in _WHO.items() for name, w in _WHAT.items()}
PAIRS["gap_m"] = rf"{_SENSOR}(range|gap|dist|distance|spacing|space_?gap|clearance)(_?x)?"
PAIRS["range_rate_mps"] = rf"{_SENSOR}(range_?rate|rel(ative)?_?{_V}|delta_?v|dv)"
"""The same of a table in which a row holds a follower and its leader."""

Columns = Mapping[str, str] | str | None
"""``"time_s=t,position_m=x[ft]"``, or the same as a mapping from the tidy name to the file's."""


def entries(columns: Columns) -> list[tuple[str, str]]:
    """Return the names of columns and the texts behind them. DataError for a text that names no column."""
    items: list[tuple[Any, ...]]
    if isinstance(columns, str):
        items = [tuple(part.strip() for part in text.split("=", 1)) for text in columns.split(",")]
    else:
        items = list((columns or {}).items()) if isinstance(columns, Mapping | None) else [()]
    if not all(len(item) == 2 and all(isinstance(text, str) and text for text in item) for item in items):
        text = str(columns)[:200]
        raise DataError(f"columns = {text!r} is no text such as time_s=t,vehicle_id=car,position_m=x[ft].")
    return [(name, text) for name, text in items]


def pairs(columns: Columns) -> tuple[tuple[str, str], ...]:
    """Return pairs of a tidy name and the text behind it. DataError for a name of no column."""
    columns_by_name: dict[str, str] = {}
    for pair in entries(columns):
        name = SHORT.get(pair[0], pair[0])
        if name not in SHORT.values():
            guess = nearest(name, [*SHORT, *SHORT.values()])
            cure = f"did you mean {guess!r}?" if guess else f"use one of {listed(TIDY, 20)}."
            raise DataError(f"columns: {name!r} is no column that is read; {cure}")
        if name in columns_by_name:
            both = f"{columns_by_name[name]!r} and {pair[1]!r}"
            raise DataError(f"columns: {name} is given twice, as {both}; leave one of them out.")
        columns_by_name[name] = pair[1]
    return tuple(columns_by_name.items())


def place(name: str, text: str, columns: list[str], source: str) -> tuple[str, float | None]:
    """Return the column of a file that ``text`` names for ``name``, and the factor of its unit; None without one.

    A name that a column has with its brackets is that column, and the brackets are its unit where they hold one.
    DataError for a column that is not among ``columns``, and for an unknown unit.
    """
    column, unit = text, None
    if match := re.fullmatch(r"(.+?)\s*[\[(]([^\[\]()]+)[\])]", text):
        unit = match[2].strip()
        has_unit = unit in UNITS.get(name, {})
        column, unit = (text, unit if has_unit else None) if text in columns else (match[1], unit)
    if column not in columns:
        guess = nearest(column, columns)
        cure = f"did you mean {guess!r}?" if guess else f"it has {listed(columns)}."
        raise DataError(f"{source}: there is no column {column!r} for {name}; {cure}")
    if unit is None:
        return column, None
    factor = UNITS.get(name, {}).get(unit)
    if factor is None and name in UNITS:
        factor = float(unit) if re.fullmatch(r"\d*\.?\d+(e-?\d+)?", unit) else None
    if not factor or not math.isfinite(factor):
        known_units = f"use one of {', '.join(UNITS[name])}, or a factor" if name in UNITS else "leave it out"
        raise DataError(f"{source}: {name} = {text} has the unit {unit!r}; {known_units}.")
    return column, factor


def renamed(frame: pl.DataFrame, columns: Columns, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with the columns that were asked for under their tidy names, in SI units.

    Raises:
        DataError: If a column is not there, a unit is unknown, a cell is no number, or the position is one coordinate
            of vehicles that move along two.
    """
    repairs, taken, table = [], set(), frame
    places = {name: place(name, source_column, frame.columns, source) for name, source_column in pairs(columns)}
    _check_plane(frame, {name: column for name, (column, _) in places.items()}, source)
    for name, (column, factor) in places.items():
        table = table.with_columns(frame[column].alias(name))
        taken.add(column)
        if factor is not None:
            table = parsed(table, name, source).with_columns(pl.col(name).cast(pl.Float64) * factor)
        text = f"Column {column!r} was read as {name}" + (f" (× {factor:.6g})." if factor is not None else ".")
        repairs.append(Repair("column named", 1, text))
    left = taken.difference(name for name, _ in pairs(columns))
    return pl.DataFrame([table[name] for name in table.columns if name not in left]), repairs


def without_patterns(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame without names that polars reads as patterns: ``*`` is called ``column *``, counted."""
    names = {n: f"column {n}" for n in frame.columns if n == "*" or re.fullmatch(r"\^.*\$", n, re.DOTALL)}
    if not names:
        return frame, []
    table = pl.DataFrame([column.alias(names.get(column.name, column.name)) for column in frame])
    words = f"columns have names that read as patterns ({listed(names)}); each is called 'column …' with its name."
    return table, [Repair("column named", len(names), f"{len(names)} {words}")]


def check_columns(columns: list[str], source: str) -> None:
    """Raise DataError if the table lacks a required column, or seems to misspell an optional one."""
    for name in REQUIRED:
        if name not in columns:
            error = missing_column(name, columns, source, others=TIDY)
            raise DataError(f"{error} Or name it: {guessed(columns)}")
    others = [name for name in columns if name not in TIDY]
    for name in TIDY:
        guess = None if name in columns or name == "accel_mps2" else nearest(name, others, cutoff=0.85)
        if guess:
            # Taking a misspelt column as an extra one would silently estimate what was measured.
            raise DataError(f"{source}: column {name!r} is missing and {guess!r} looks like it; rename or remove it.")


def guessed(columns: list[str]) -> str:
    """Return the option ``--columns`` that a header may need, with remarks; ``?`` where nothing fits.

    One of two coordinates is never proposed as a position along the road, nor a frame as a time without its rate.
    """
    if option := _pair(columns):
        return f"--pair {shlex.quote(option)}"
    guesses: dict[str, str] = {}
    remarks = []
    plane = coordinates(columns)
    for name, pattern in GUESSES.items():
        if name in columns:
            continue
        likely = [guess for column in columns if (guess := _like(name, pattern, column))]
        if plane and name in ("position_m", "speed_mps"):
            likely = [guess for guess in likely if not re.match(r"(?i)(local_?|v|pos_?|vel_?)?[xy](?![a-z])", guess)]
        if likely and likely[0] not in guesses.values():
            guesses[name] = likely[0]
        elif name in REQUIRED:
            guesses[name] = "?"
    if plane and guesses.get("position_m") == "?":
        two = " and ".join(plane[axis] for axis in "xy")
        remarks.append(f". {two} are two coordinates: position_m is the way along the road, and lane a number")
    if len(several := [column for column in columns if re.fullmatch(r"(?i)[a-z_]*[a-z]_?\d+", column)]) > 3:
        remarks.append(f". {listed(several, 4)} look like vehicles side by side: give a row per vehicle and time")
    frame = next((column for column in columns if re.fullmatch(r"(?i)frame_?(id|no|nr|number)?", column)), None)
    if frame is not None and guesses.get("time_s") == "?":
        guesses["time_s"] = f"{frame}[0.04]"
        remarks.append(f". {frame} counts pictures: [0.04] is right for 25 a second, else give 1/rate")
    option = ",".join(f"{name}={column}" for name, column in guesses.items())
    return f"--columns {shlex.quote(option)}{''.join(remarks)}"


def _pair(columns: list[str]) -> str:
    """Return the option ``--pair`` for a table of followers and leaders in one row; nothing for other tables."""
    patterns = {"time_s": GUESSES["time_s"], "run_id": GUESSES["run_id"], **PAIRS}
    likely = {
        name: guess
        for name, pattern in patterns.items()
        if (guess := next((g for column in columns if (g := _like(name, pattern, column))), None))
    }
    if "follower.position_m" not in likely and "follower.speed_mps" not in likely and "gap_m" in likely:
        own = next((g for c in columns if (g := _like("speed_mps", rf"(veh|vehicle|can)?_?{_V}", c))), None)
        likely |= {"follower.speed_mps": own} if own else {}
    if "leader.position_m" in likely and (length := next((c for c in columns if re.fullmatch(r"len(gth)?", c)), None)):
        likely.setdefault("leader.length_m", length)
    has = likely.keys()
    both = has & {"follower.position_m", "follower.speed_mps"} and has & {"leader.position_m", "gap_m"}
    if not both or "time_s" not in has or any(_like("vehicle_id", GUESSES["vehicle_id"], c) for c in columns):
        return ""
    return ",".join(f"{name}={column}" for name, column in likely.items())


def coordinates(columns: list[str]) -> dict[str, str]:
    """Return the columns of a header that are two coordinates: x and y, as ``x_m`` or ``xCenter``, too, or on earth.

    Nothing where one of them is missing.
    """
    noise = r"[\[(].*|(?<=[xy])_?m$|[^a-z]|pos(ition)?|utm|local|center|coord(inate)?|vehicle|obj(ect)?"
    plain = {column: re.sub(noise, "", column.lower()) for column in columns}
    plane = {ON_EARTH.get(axis, axis): column for column, axis in plain.items() if axis in ("x", "y", *ON_EARTH)}
    return plane if len(plane) == 2 else {}


def _check_plane(frame: pl.DataFrame, taken: Mapping[str, str], source: str) -> None:
    """Raise DataError if the position is one coordinate of two, and vehicles move along the other one as well."""
    plane = coordinates(frame.columns)
    along, vehicle = taken.get("position_m", ""), taken.get("vehicle_id", "vehicle_id")
    if along not in plane.values() or vehicle not in frame.columns:
        return
    across = next(column for column in plane.values() if column != along)
    number = [pl.col(name).cast(pl.Float64, strict=False) for name in (along, across)]
    ways = frame.group_by(vehicle).agg((x.max() - x.min()) for x in number)
    total, sideways = (float(ways[name].sum()) for name in (along, across))
    if sideways > MOST_ACROSS * total and (ways[across] > WIDEST).any():
        raise DataError(
            f"{source}: {along} is one of two coordinates: vehicles move by {total:.5g} along it and by {sideways:.5g} "
            f"along {across}. position_m is the way along the road: project them on it first."
        )


def unread(columns: list[str]) -> list[Repair]:
    """Return the repair that names unread columns which look like tidy ones that are missing."""
    looks: dict[str, str] = {}
    for name, pattern in GUESSES.items():
        others = [c for c in columns if name not in columns and c not in (*TIDY, *looks) and _like(name, pattern, c)]
        looks |= dict.fromkeys(others[:1], name)
    listing = ", ".join(f"{column} (like {name})" for column, name in looks.items())
    words = f"columns were not read, and look like some that are: {listing}. Name them with --columns if they are."
    return [Repair("columns not read", len(looks), f"{len(looks)} {words}")] if looks else []


def _like(name: str, pattern: str, column: str) -> str | None:
    """Return a column with its unit, if it may be what ``name`` wants."""
    plain = re.sub(r"\W+", "_", re.sub(r"\s*[\[(].*[\])]\s*$", "", column).lower()).strip("_")
    units = UNITS.get("speed_mps" if name == "range_rate_mps" else name.rpartition(".")[2], {})
    unit = next((u for u in units if plain.endswith(f"_{u}")), None)
    stem = plain.removesuffix(f"_{unit}") if unit else plain
    if not stem or not re.fullmatch(pattern, stem):
        return None
    return f"{column}[{unit}]" if unit and units[unit] != 1.0 else column
