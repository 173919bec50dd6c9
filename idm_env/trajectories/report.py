"""The report of a filtered or reconstructed file: JSON for machines, one self-contained HTML page for people."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from idm_env.effects import IDM
from idm_env.reports import diagrams, page
from idm_env.trajectories.scores import RegularMotion
from idm_env.trajectories.spool import Spool
from idm_env.trajectories.tracks import Pieces, TrackPiece

BEFORE, AFTER = "#b8b8b8", "#0b5fa5"
COLUMNS = (
    ("position_error_rate_percent", "position error rate (%)", 3),
    ("accel_mean_mps2", "mean |a| (m/s²)", 2),
    ("accel_std_mps2", "std |a| (m/s²)", 2),
    ("implausible_percent", "tracks with |a| > 10 m/s² anywhere (%)", 1),
    ("milliseconds_per_trajectory", "time per trajectory (ms)", 2),
)
DIGITS = {title: digits for _, title, digits in COLUMNS}
MOST_LISTED = 100


def write_report(
    out: Path,
    report: dict[str, Any],
    shown: Sequence[tuple[TrackPiece, RegularMotion]],
    parameters: pl.DataFrame,
    figures: Sequence[page.Block],
) -> dict[str, Any]:
    """Write and return the report: the table of methods, and pictures before and after.

    ``figures`` are pictures in space and time.
    """
    how = "filtered" if report["settings"]["task"] == "filter" else "reconstructed"
    lost = [f"{item['track']}: {item['reason']}" for item in report["left_out"]]
    repaired = [item["text"] for item in report["repairs"]]
    repaired += [f"{item['vehicle']}: {item['note']}" for item in report["divided"]]
    lines = {"Left out": page.shortened(lost, MOST_LISTED), "Repaired": page.shortened(repaired, MOST_LISTED)}
    before = [page.picture(before_and_after(track, motion), f"Track {track.key}") for track, motion in shown]
    names: dict[str, Any] = {"figures": figures, "before": before, "lines": lines, "digits": DIGITS}
    names |= {"methods": methods, "points": points, "parameters": _parameters(parameters)}
    template, title = Path(__file__).with_name("filter.html"), f"{report['source']}: {how} trajectories"
    return page.write_report(out, title, template, report, **names)


def points(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the errors of methods on points that were left out under their names in words."""
    names = {"rmse_m": "RMSE (m)", "mae_m": "mean |error| (m)", "p95_m": "95 % below (m)", "bias_m": "mean error (m)"}
    return [{"method": row["method"], **{title: row[key] for key, title in names.items()}} for row in rows]


def methods(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of methods, ours first, under their names in words."""
    return [{"method": row["method"], **{title: row[key] for key, title, _ in COLUMNS}} for row in rows]


def before_and_after(track: TrackPiece, motion: RegularMotion) -> Figure:
    """Return position against the data, speed and acceleration over time: grey raw differences, blue filtered."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(2, 3, 3))
    begin = track.time_s[0]
    step = np.diff(track.time_s)
    middle = track.time_s[:-1] + step / 2 - begin
    speed = np.diff(track.position_m) / step
    clock = motion.time_s - begin
    apart = track.position_m - motion.position_at(track.time_s)
    axes[0].plot(track.time_s - begin, apart, ".", color=BEFORE, ms=3)
    reach = max(0.05, 1.1 * float(np.abs(apart).max()))
    axes[0].set_ylim(-reach, reach)
    axes[0].axhline(0, color=AFTER, lw=1.2)
    axes[0].set_ylabel("raw − filtered (m)")
    axes[1].plot(middle, speed, color=BEFORE, lw=0.8, label="differences of the data")
    axes[1].plot(clock, motion.speed_mps, color=AFTER, lw=1.5, label="filtered")
    axes[1].set_ylabel("speed (m/s)")
    axes[1].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, ncols=2, borderaxespad=0.1)
    if len(speed) > 1:
        change = np.diff(speed) / step[1:]
        # differences of noisy data go far beyond the picture: thin, so that they stay behind
        thin = float(np.median(np.abs(change))) > 4.0
        width, alpha = (0.4, 0.5) if thin else (1.0, 1.0)
        axes[2].plot(middle[:-1] + step[1:] / 2, change, color=BEFORE, lw=width, alpha=alpha)
    axes[2].plot(clock, motion.accel_mps2, color=AFTER, lw=1.5)
    low, high = min(-4.0, motion.accel_mps2.min() - 1), max(4.0, motion.accel_mps2.max() + 1)
    axes[2].set(ylabel="acceleration (m/s²)", xlabel="time (s)", ylim=(low, high))
    spread = max(1.0, float(np.ptp(motion.speed_mps)))
    axes[1].set_ylim(motion.speed_mps.min() - 0.6 * spread, motion.speed_mps.max() + 0.6 * spread)
    return figure


def _parameters(parameters: pl.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of the inferred parameters; nothing where there are none."""
    if "max_accel" not in parameters.columns or parameters["max_accel"].drop_nulls().is_empty():
        return []
    rows = []
    for p in IDM.declared:
        finite = parameters.filter(pl.col(p.name).is_not_null())
        low, middle, high = np.percentile(finite[p.name].to_numpy(), [25, 50, 75])
        identified = finite[f"{p.name}_identified"].drop_nulls()
        share = f"{100 * identified.to_numpy().mean():.0f} %" if len(identified) else "–"
        row = {"parameter": f"{p.symbol} {p.name}", "unit": p.unit, "median": float(middle)}
        row |= {"quartiles": f"{low:.2f} – {high:.2f}", "tracks": finite.height, "identified": share}
        rows.append(row)
    return rows


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
