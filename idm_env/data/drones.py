"""Readers of four published layouts: highD and exiD (leveLXData), pNEUMA, and I-24 MOTION.

Made from the formats as their authors publish them; no file of theirs is part of the project.

============  ==========================================================================================================
highD         Krajewski et al. 2018, ``NN_tracks.csv``: 25 frames/s; x, y the upper left corner of the bounding box (m),
              ``width`` along the road; ``precedingId`` 0 for nobody. Lanes of both directions, told by ``xVelocity``.
exiD          Moers et al. 2022, ``NN_tracks.csv``: 25 frames/s; centre, heading, and the way travelled since the track
              began (m); ``leadId`` −1 for nobody. Ways of two vehicles share no origin, so that gaps come from centres.
pNEUMA        Barmpounakis and Geroliminis 2020: one vehicle per line, separated by semicolons, latitude, longitude,
              speed (km/h), two accelerations and time (s) repeated. No lanes and no leaders: tracks to filter.
I-24 MOTION   Gloudemans et al. 2023: JSON, one document per vehicle with arrays; back centre, feet, ``direction`` 1 or
              −1, y from the left yellow line, lanes of 12 feet.
============  ==========================================================================================================
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from idm_env.data import clock
from idm_env.data.errors import DataError, Repair, refuse_missing, repaired
from idm_env.data.schema import TRACK
from idm_env.data.sizes import refuse_size

FRAME_S = 0.04
FOOT_M = 0.3048
LANE_FT = 12.0
NO_LEADERS = "no leaders"
"""Kind of the repair that says that a file tells of nobody whom he follows."""
LENGTHS_M = {"car": 5.0, "taxi": 5.0, "motorcycle": 2.5, "medium vehicle": 5.83, "heavy vehicle": 12.5, "bus": 12.5}
"""Nominal lengths by the types of pNEUMA, which measures none."""

Read = tuple[pl.DataFrame, list[Repair]]


def is_highd(columns: list[str]) -> bool:
    """Say whether the header is highD's."""
    return {"frame", "id", "xVelocity", "laneId"} <= {name.strip() for name in columns}


def is_exid(columns: list[str]) -> bool:
    """Say whether the header is exiD's."""
    return {"frame", "trackId", "xCenter", "traveledDistance"} <= {name.strip() for name in columns}


def highd(frame: pl.DataFrame, source: str) -> Read:
    """Return the tidy table of a highD recording; each direction is a run."""
    refuse_missing(("frame", "id", "x", "width", "xVelocity", "laneId"), frame.columns, source)
    right = (pl.col("xVelocity").mean() > 0).over("id")
    front = pl.when(right).then(pl.col("x") + pl.col("width")).otherwise(-pl.col("x"))
    leader = pl.when(pl.col("precedingId") > 0).then(pl.col("precedingId"))
    table = frame.select(
        pl.when(right).then(pl.lit("right")).otherwise(pl.lit("left")).alias("run_id"),
        pl.col("id").alias("vehicle_id"),
        (pl.col("frame") * FRAME_S).round(6).alias("time_s"),
        front.alias("position_m"),
        pl.col("xVelocity").abs().alias("speed_mps"),
        pl.col("width").median().over("id").alias("length_m"),
        pl.col("laneId").alias("lane"),
        *([leader.alias("leader_id")] if "precedingId" in frame.columns else []),
    )
    return table, []


def exid(frame: pl.DataFrame, source: str) -> Read:
    """Return the tidy table of an exiD recording, with gaps between the bodies of a vehicle and its leader."""
    needed = ("frame", "trackId", "xCenter", "yCenter", "length", "traveledDistance", "leadId")
    refuse_missing(needed, frame.columns, source)
    run = pl.col("recordingId").cast(pl.String) if "recordingId" in frame.columns else pl.lit("0")
    frame = frame.with_columns(run.alias("run_id"))
    ahead = frame.select("run_id", "frame", "trackId", "xCenter", "yCenter", "length").rename({"trackId": "leadId"})
    joined = frame.join(ahead, on=["run_id", "frame", "leadId"], how="left", suffix="_lead", maintain_order="left")
    dx, dy = (pl.col(f"{name}_lead") - pl.col(name) for name in ("xCenter", "yCenter"))
    apart = (dx**2 + dy**2).sqrt()
    speed = "lonVelocity" if "lonVelocity" in frame.columns else None
    table = joined.select(
        "run_id",
        pl.col("trackId").alias("vehicle_id"),
        (pl.col("frame") * FRAME_S).round(6).alias("time_s"),
        (pl.col("traveledDistance") + pl.col("length") / 2).alias("position_m"),
        *([pl.col(speed).alias("speed_mps")] if speed else []),
        pl.col("length").alias("length_m"),
        (apart - (pl.col("length") + pl.col("length_lead")) / 2).alias("gap_m"),
        pl.when(pl.col("leadId") >= 0).then(pl.col("leadId")).alias("leader_id"),
    )
    return table, []


def pneuma(path: Path) -> Read:
    """Return the tidy table of a pNEUMA file: the way of every vehicle, without leaders.

    DataError where no line holds a track.
    """
    parts, broken = [], 0
    refuse_size(path.stat().st_size, path.name)
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines()[1:]:
        cells = [cell.strip() for cell in line.strip().rstrip(";").split(";")]
        try:
            numbers = np.array([float(cell) for cell in cells[4:]]).reshape(-1, 6)
        except ValueError:
            numbers = np.empty((0, 6))
        if len(numbers) < 2:
            broken += bool(line.strip())
            continue
        _, _, speed, _, _, time = numbers.T
        kind = cells[1].lower()
        columns: dict[str, Any] = {"vehicle_id": cells[0], "time_s": time, "speed_mps": speed / 3.6}
        columns |= {"length_m": LENGTHS_M.get(kind, 5.0), "position_m": _way(speed / 3.6, time, cells[2])}
        parts.append(pl.DataFrame({**columns, "vehicle_class": cells[1]}))
    if not parts:
        raise DataError(f"{path.name}: no line holds a track of pNEUMA's layout; is it the unzipped csv?")
    repairs = repaired("length assumed", len(parts), "vehicles have the nominal length of their type.")
    repairs += repaired("broken line", broken, "lines that hold no whole track were left out.")
    repairs.append(Repair(NO_LEADERS, 1, "pNEUMA has no lanes and no leaders."))
    return pl.concat(parts).with_columns(pl.lit(None, pl.String).alias("leader_id")), repairs


def _way(speed: np.ndarray, time: np.ndarray, travelled: str) -> np.ndarray:
    """Return the way (m): speeds (m/s) integrated, and scaled to the whole distance that the file gives.

    Distances between its points, which are of six decimals of a degree, add up to more: by 18 % at 2 m/s.
    """
    way = np.concatenate([[0.0], np.cumsum(np.diff(time) * (speed[1:] + speed[:-1]) / 2)])
    try:
        scale = float(travelled) / way[-1]
    except (ValueError, ZeroDivisionError):
        return way
    return way * scale if 0.5 < scale < 2.0 else way


def i24(path: Path) -> Read:
    """Return the tidy table of an I-24 MOTION file; each direction is a run, its vehicles driving towards larger x.

    DataError for what is no JSON, and where no document holds a track.
    """
    refuse_size(path.stat().st_size, path.name)
    try:
        documents = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path.name} is no JSON ({str(error)[:80]}); is it complete?") from None
    parts, broken = [], 0
    for document in documents if isinstance(documents, list) else [documents]:
        try:
            direction = 1.0 if float(document["direction"]) > 0 else -1.0
            time, x, y = (np.asarray(document[name], float) for name in ("timestamp", "x_position", "y_position"))
            length, name = float(np.median(document["length"])), document["_id"]
            name = str(name["$oid"] if isinstance(name, dict) else name)
            names = {"run_id": "east" if direction > 0 else "west", "vehicle_id": name}
            motion = {"time_s": time, "position_m": (direction * x + length) * FOOT_M, "length_m": length * FOOT_M}
            lane = np.floor(np.abs(y) / LANE_FT).astype(np.int64) + 1
            parts.append(pl.DataFrame({**names, **motion, "lane": lane}))
        except (KeyError, TypeError, ValueError, pl.exceptions.PolarsError):
            broken += 1
    if not parts:
        raise DataError(
            f"{path.name}: no document has _id, direction, timestamp, x_position, y_position and length, as those of "
            "I-24 MOTION, whose JSON is read; predict takes Waymo's scenarios."
        )
    table = pl.concat(parts)
    # Vehicles are sampled by their own clocks: one clock for all, so that leaders are measured at the same times.
    table = table.with_columns(pl.col("time_s") - pl.col("time_s").min()).sort(*TRACK, "time_s")
    runs = table["run_id"].unique()
    table = table.unique([*TRACK, "time_s"], maintain_order=True)
    table, _ = clock.regularise(table, dict.fromkeys(runs, FRAME_S), dict.fromkeys(runs, 0.0))
    return table.drop("step"), repaired("broken document", broken, "documents without a whole track were left out.")


FILES: dict[str, Callable[[Path], Read]] = {"pneuma": pneuma, "i24": i24}
"""Layouts, by name, that read the file themselves."""
