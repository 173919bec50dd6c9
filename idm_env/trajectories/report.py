"""The report of a filtered or reconstructed file: JSON for machines, one self-contained HTML page for people."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.figure import Figure

from idm_env.effects import IDM
from idm_env.trajectories.scores import Motion
from idm_env.trajectories.tracks import Track

BEFORE, AFTER = "#b8b8b8", "#0b5fa5"
COLUMNS = (
    ("position_error_rate_percent", "position error rate (%)", 3),
    ("accel_mean_mps2", "mean |a| (m/s²)", 2),
    ("accel_std_mps2", "std |a| (m/s²)", 2),
    ("implausible_percent", "implausible, |a| > 10 m/s² (%)", 1),
    ("milliseconds_per_trajectory", "time per trajectory (ms)", 2),
)


def write_report(
    out: Path, report: dict[str, Any], shown: Sequence[tuple[Track, Motion]], parameters: pl.DataFrame
) -> None:
    """Write ``report.json`` and ``report.html`` with the table of methods, pictures before and after, and histograms.

    Numbers that are not finite become null in JSON, which knows none.
    """
    (out / "report.json").write_text(json.dumps(finite(report), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    pictures = [(track.key, embedded(before_and_after(track, motion))) for track, motion in shown]
    environment = Environment(loader=PackageLoader("idm_env.trajectories", "."), autoescape=select_autoescape())
    histograms = parameter_histograms(parameters)
    page = environment.get_template("report.html").render(
        report=report,
        columns=[(key, title) for key, title, _ in COLUMNS],
        rows=[_cells(row) for row in report["methods"]],
        pictures=pictures,
        histograms=embedded(histograms) if histograms is not None else None,
        parameters=_parameter_lines(parameters),
    )  # fmt: skip
    (out / "report.html").write_text(page)


def _cells(row: dict[str, Any]) -> list[str]:
    return [row["method"], *(shown_number(row[key], digits) for key, _, digits in COLUMNS)]


def finite(value: Any) -> Any:
    """Return a copy in which every number that is not finite is None."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def shown_number(value: float, digits: int) -> str:
    """Return a number for a table, a dash where there is none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def embedded(figure: Figure) -> str:
    """Return a figure as a data address for an HTML page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def before_and_after(track: Track, motion: Motion) -> Figure:
    """Return position against the data, speed and acceleration over time: grey differences of the data, blue ours."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    begin = track.time_s[0]
    step = np.diff(track.time_s)
    middle = track.time_s[:-1] + step / 2 - begin
    speed = np.diff(track.position_m) / step
    clock = motion.time_s - begin
    axes[0].plot(track.time_s - begin, track.position_m - motion.at(track.time_s), ".", color=BEFORE, ms=3)
    axes[0].axhline(0, color=AFTER, lw=1.2)
    axes[0].set_ylabel("data − ours (m)")
    axes[1].plot(middle, speed, color=BEFORE, lw=0.8, label="differences of the data")
    axes[1].plot(clock, motion.speed_mps, color=AFTER, lw=1.5, label="ours")
    axes[1].set_ylabel("speed (m/s)")
    axes[1].legend(loc="upper right", frameon=False, ncols=2)
    if len(speed) > 1:
        axes[2].plot(middle[:-1] + step[1:] / 2, np.diff(speed) / step[1:], color=BEFORE, lw=0.8)
    axes[2].plot(clock, motion.accel_mps2, color=AFTER, lw=1.5)
    low, high = min(-4.0, motion.accel_mps2.min() - 1), max(4.0, motion.accel_mps2.max() + 1)
    axes[2].set(ylabel="acceleration (m/s²)", xlabel="time (s)", ylim=(low, high))
    spread = max(1.0, float(np.ptp(motion.speed_mps)))
    axes[1].set_ylim(motion.speed_mps.min() - 0.6 * spread, motion.speed_mps.max() + 0.6 * spread)
    return figure


def parameter_histograms(parameters: pl.DataFrame) -> Figure | None:
    """Return histograms of the inferred parameters, those that the data tell in blue; None where there are none."""
    if "max_accel" not in parameters.columns or parameters["max_accel"].drop_nulls().is_empty():
        return None
    figure = Figure(figsize=(12, 2.8), layout="constrained")
    for axis, p in zip(figure.subplots(1, 5), IDM.declared, strict=True):
        values = parameters[p.name].drop_nulls().to_numpy()
        bins = np.linspace(values.min(), max(values.max(), values.min() + 1e-6), 25)
        axis.hist(values, bins, color=BEFORE, label="all")
        if f"{p.name}_identified" in parameters.columns:
            told = parameters.filter(pl.col(f"{p.name}_identified") & pl.col(p.name).is_not_null())[p.name].to_numpy()
            axis.hist(told, bins, color=AFTER, label="told by the data")
        axis.set_xlabel(f"{p.symbol}: {p.name} ({p.unit})")
    figure.axes[0].set_ylabel("tracks")
    figure.axes[0].legend(frameon=False, fontsize=8)
    return figure


def _parameter_lines(parameters: pl.DataFrame) -> list[list[str]]:
    """Return name, median, quartiles and share identified of every parameter."""
    lines = []
    for p in IDM.declared:
        if p.name not in parameters.columns or parameters[p.name].drop_nulls().is_empty():
            continue
        values = parameters[p.name].drop_nulls().to_numpy()
        low, middle, high = np.percentile(values, [25, 50, 75])
        flags = f"{p.name}_identified"
        share = "–"
        if flags in parameters.columns:
            share = f"{100 * parameters.filter(pl.col(p.name).is_not_null())[flags].to_numpy().mean():.0f} %"
        lines.append([f"{p.symbol} {p.name}", p.unit, f"{middle:.2f}", f"{low:.2f} – {high:.2f}", share])
    return lines
