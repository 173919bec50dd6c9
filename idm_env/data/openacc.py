"""Reader of the original OpenACC csv files: five lines about the run, then one column per quantity and vehicle.

The five lines are Date, Vehicle_order, Number_of_vehicles, ACC and Distance_setting; the table has Time and, for each
place n of the platoon, Speedn (Doppler, m/s), En, Nn, Un, Latn, Lonn, Altn, Drivern, and IVSn, the bumper-to-bumper gap
in m between places n and n + 1. Source: Makridis, Mattas, Anesiadou, Ciuffo 2021, Transportation Research C 125, and
the notes published with the data by the European Commission's Joint Research Centre.
"""

import re

import numpy as np
import polars as pl

from idm_env.data.errors import DataError, Repair
from idm_env.data.schema import DEFAULT_LENGTH_M

HEADER_LINES = 5
SEARCHED_LINES = 12
_SLOT = re.compile(r"^(Speed|IVS|Alt|Lat|Lon|Driver|E|N|U)_?(\d+)$", re.IGNORECASE)
_EXTRA = {"alt": "altitude_m", "e": "east_m", "n": "north_m", "lat": "latitude", "lon": "longitude", "driver": "driver"}


def header_line(lines: list[str]) -> int | None:
    """Return the number of lines above the table's header, or None if these are not an OpenACC file's first lines."""
    for number, line in enumerate(lines):
        names = [name.strip().strip('"').lower() for name in line.split(",")]
        if "time" in names and any(re.fullmatch(r"speed_?\d+", name) for name in names):
            return number
    return None


def about(lines: list[str]) -> dict[str, str | list[str]]:
    """Return the facts in the lines above the table: names, setting and mode, under the names of the tidy table."""
    cells = {}
    for line in lines:
        key, *values = [cell.strip().strip('"') for cell in line.strip().split(",")]
        cells[key.strip().lower().replace(" ", "_")] = [value for value in values if value]
    facts: dict[str, str | list[str]] = {"vehicles": cells.get("vehicle_order", [])}
    for key, name in (("acc", "acc_run"), ("distance_setting", "time_gap_setting"), ("date", "date")):
        if cells.get(key):
            facts[name] = "-".join(cells[key])
    return facts


def read(frame: pl.DataFrame, lines: list[str], run: str, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the tidy table of an OpenACC table.

    Positions are the integral of the Doppler speed, started so that the first gaps fit: the antennas' coordinates are
    too noisy for gaps, and the measured gap is kept beside them.

    Raises:
        DataError: If Time or the speeds are missing.
    """
    frame = frame.rename({name: name.strip() for name in frame.columns})
    time = next((name for name in frame.columns if name.lower() == "time"), None)
    slots: dict[int, dict[str, str]] = {}
    for name in frame.columns:
        if match := _SLOT.match(name):
            slots.setdefault(int(match[2]), {})[match[1].lower()] = name
    slots = {slot: names for slot, names in slots.items() if "speed" in names}
    if time is None or not slots:
        has = ", ".join(frame.columns[:8])
        raise DataError(f"{source}: an OpenACC file needs a column Time and at least Speed1; it has {has}.")
    facts = about(lines)
    repairs: list[Repair] = []
    parts: list[pl.DataFrame] = []
    clock = _numbers(frame, time)
    start = 0.0
    for slot in sorted(slots):
        ahead = slots.get(slot - 1)
        gap = _numbers(frame, ahead["ivs"]) if ahead and "ivs" in ahead else None
        if ahead and (gap is None or np.isnan(gap).all()):
            repairs.append(Repair("no gap", 1, f"Vehicle {slot} has no IVS{slot - 1} and is taken as without leader."))
            gap = None
        speed = _numbers(frame, slots[slot]["speed"])
        if gap is not None:
            start -= DEFAULT_LENGTH_M + float(gap[np.isfinite(gap)][0])
        part = _track(frame, slots[slot], clock, speed, start)
        names = facts["vehicles"]
        vehicle = names[slot - 1] if slot - 1 < len(names) else f"vehicle {slot}"
        leader = pl.lit(None if gap is None else str(slot - 1), pl.String)
        gaps = pl.Series("gap_m", np.full(len(clock), np.nan) if gap is None else gap, nan_to_null=True)
        names_of = {"vehicle_id": pl.lit(str(slot)), "leader_id": leader, "vehicle_name": pl.lit(vehicle)}
        parts.append(part.with_columns(gaps, **names_of).filter(pl.col("speed_mps").is_not_null()))
    labels = [pl.lit(value).alias(name) for name, value in facts.items() if isinstance(value, str)]
    return pl.concat(parts).with_columns(pl.lit(run).alias("run_id"), pl.lit(1).alias("lane"), *labels), repairs


def _track(
    frame: pl.DataFrame, names: dict[str, str], clock: np.ndarray, speed: np.ndarray, start: float
) -> pl.DataFrame:
    good = np.isfinite(speed) & np.isfinite(clock)
    position = np.full(len(clock), np.nan)
    if good.any():
        times, rates = clock[good], speed[good]
        moved = np.concatenate([[0.0], np.cumsum(np.diff(times) * (rates[1:] + rates[:-1]) / 2)])
        position[good] = start + moved
    extras = {_EXTRA[key]: pl.Series(_numbers(frame, names[key])) for key in _EXTRA if key in names and key != "driver"}
    if "driver" in names:
        extras[_EXTRA["driver"]] = frame[names["driver"]].cast(pl.String)
    columns = {"time_s": clock, "position_m": position, "speed_mps": speed, **extras}
    return pl.DataFrame(columns).with_columns(pl.col(pl.Float64).exclude("time_s", "position_m").fill_nan(None))


def _numbers(frame: pl.DataFrame, name: str) -> np.ndarray:
    return frame[name].cast(pl.Float64, strict=False).fill_null(np.nan).to_numpy()
