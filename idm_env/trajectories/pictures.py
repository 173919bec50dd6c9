"""Trajectories in space and time, before and after: the largest run and lane, coloured by speed."""

from pathlib import Path

import numpy as np
import polars as pl

from idm_env.reports import diagrams, page
from idm_env.trajectories.spool import Spool
from idm_env.trajectories.tracks import Pieces, TrackPiece

MOST_VEHICLES = 150


def space_time(written: Path, spool: Spool, bridge: float | None) -> list[page.Block]:
    """Return one picture: the data with speeds by their differences on the left, what was written on the right."""
    table = pl.scan_parquet(written, glob=False)
    where = ["run_id", "lane"]
    sizes = table.group_by(where).agg(pl.len()).sort("len", *where, descending=[True, False, False]).collect()
    run, lane, _ = sizes.row(0)
    inside = (pl.col("run_id") == run) & pl.col("lane").eq_missing(lane)
    after = table.filter(inside).select("vehicle_id", "piece", "time_s", "position_m", "speed_mps").collect()
    names = set(after["vehicle_id"].unique(maintain_order=True).head(MOST_VEHICLES).to_list())
    numbers = [i for i, (r, vehicle) in enumerate(spool.vehicles) if r == run and vehicle in names]
    tracks = [track for t in spool.picked(numbers) for track in Pieces(t, bridge)]
    before = [_measured(track, lane) for track in tracks]
    lines = []
    mine = after.filter(pl.col("vehicle_id").is_in(sorted(names)))
    for (vehicle, piece), rows in mine.group_by("vehicle_id", "piece", maintain_order=True):
        time, position, speed = (rows[name].to_numpy() for name in ("time_s", "position_m", "speed_mps"))
        lines.append(diagrams.VehicleLine(f"{vehicle}/{piece}", time, position, speed))
    fastest = 1.05 * max(float(line.speed.max()) for line in lines) or 1.0
    both = [diagrams.Panel("the data", tuple(before)), diagrams.Panel("filtered", tuple(lines))]
    words = f"run {run}" + (f", lane {lane}" if lane is not None else "")
    more = f", the first {len(names)} vehicles" if len(names) == MOST_VEHICLES else ""
    caption = (
        f"{words} ({sizes.height} in all), the largest{more}. Left the data, coloured by differences of positions over "
        "time; right what was written, coloured by its speeds."
    )
    return [page.picture(diagrams.figure_of(both, fastest=fastest, columns=2), f"{caption[0].upper()}{caption[1:]}")]


def _measured(track: TrackPiece, lane: int | None) -> diagrams.VehicleLine:
    """Return a track as it was measured, its speeds differences of positions; elsewhere than in the lane left out."""
    speed = np.diff(track.position_m) / np.diff(track.time_s)
    speed = np.append(speed, speed[-1])
    inside = np.full(len(track), True) if lane is None else track.lane == lane
    return diagrams.VehicleLine(track.key, track.time_s[inside], track.position_m[inside], speed[inside])
