"""Whole files: filtering and reconstruction chunk by chunk, resumable, with tidy output and a report.

Memory holds the table that was read and one chunk of tracks; every finished chunk is a part on disk, and the parts are
joined at the end without being read as a whole.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl

from idm_env.data import DataError
from idm_env.trajectories import baselines, paper
from idm_env.trajectories.drivers import parameter_rows
from idm_env.trajectories.noise import fit_noise, is_dense
from idm_env.trajectories.recipe import Filtered, clock_of, nearest, overlaps, recipe
from idm_env.trajectories.report import write_report
from idm_env.trajectories.scores import Motion, Tally
from idm_env.trajectories.smoother import SPARSE, Choices, Noise
from idm_env.trajectories.tracks import Pieces, Table, Track, read_table

Recipe = Literal["default", "paper"]
OnProgress = Callable[[int, int], None]
"""Called with tracks done and tracks in all."""
CHUNK = 200
SHOWN = 4
"""Tracks of which the report has pictures."""
OURS = {"default": "simulator, imagined leader", "paper": "the paper's recipe"}


@dataclass(frozen=True)
class Settings:
    """What determines a run: task, step (s; None takes the file's), recipe, ablation, baselines, vehicles per chunk."""

    task: Literal["filter", "reconstruct"]
    dt: float | None = None
    recipe: Recipe = "default"
    fixed_parameters: bool = False
    baselines: bool = True
    chunk: int = CHUNK


def filter_file(
    path: str | Path,
    out: str | Path,
    *,
    recipe: Recipe = "default",
    fixed_parameters: bool = False,
    baselines: bool = True,
    layout: str = "auto",
    chunk: int = CHUNK,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Filter every track of a file and return the report, also written to ``out``.

    Writes ``trajectories.parquet`` (tidy: position, speed, acceleration, gap where there is a leader, imagined gap and
    standard deviations), ``parameters.parquet``, ``report.json`` and ``report.html``. ``recipe="paper"`` is the
    published one; ``fixed_parameters`` keeps its five parameters, and leaves out the calibration in the default one.
    Tracks that cannot be used are left out and counted. ``resume`` goes on after the last finished chunk.

    Raises:
        DataError: If the file as a whole cannot be used, or ``resume`` finds a run with other data or settings.
    """
    settings = Settings("filter", None, recipe, fixed_parameters, baselines, chunk)
    return run(path, out, settings, layout=layout, resume=resume, on_progress=on_progress)


def reconstruct_file(
    path: str | Path,
    out: str | Path,
    *,
    dt: float = 0.1,
    recipe: Recipe = "default",
    fixed_parameters: bool = False,
    baselines: bool = True,
    layout: str = "auto",
    chunk: int = CHUNK,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Reconstruct dense tracks of step ``dt`` (s) from sparse ones; holes are bridged. Else as ``filter_file``.

    The published recipe keeps its own step of 1 s.
    """
    if not 0.01 <= dt <= 2.0:
        raise DataError(f"dt = {dt:g} s is outside [0.01, 2] s; 0.1 s suits vehicles.")
    settings = Settings("reconstruct", dt, recipe, fixed_parameters, baselines, chunk)
    return run(path, out, settings, layout=layout, resume=resume, on_progress=on_progress)


def run(
    path: str | Path,
    out: str | Path,
    settings: Settings,
    *,
    layout: str = "auto",
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Do what ``filter_file`` and ``reconstruct_file`` say."""
    if settings.recipe not in OURS:
        raise DataError(f"recipe = {settings.recipe!r} is unknown; use 'default' or 'paper'.")
    out = Path(out)
    table = read_table(path, layout)
    bridge = 2.0 if settings.task == "filter" else None
    plan = _plan(table, settings, bridge)
    parts = _parts(out, plan, resume)
    pieces = Pieces(table, bridge)
    recent: list[Filtered] = []
    done = 0
    for number, begin in enumerate(range(0, len(pieces.vehicles), settings.chunk)):
        vehicles = pieces.vehicles[begin : begin + settings.chunk]
        tracks = list(pieces.of(vehicles))
        recent = [f for f in recent if tracks and _reaches(f, tracks)]
        part = parts / f"{number:05d}"
        if not part.with_suffix(".json").exists():
            filtered = _chunk(part, tracks, settings, plan, recent)
        else:
            filtered = _restored(part, tracks)
        recent += filtered
        done += len(vehicles)
        if on_progress is not None:
            on_progress(done, len(pieces.vehicles))
    return _finish(out, parts, table, pieces, settings, plan)


@dataclass(frozen=True)
class Plan:
    """What is decided for the whole file: step (s), noise, density, and a fingerprint of data and settings."""

    dt: float
    noise: Noise | None
    dense: bool
    noise_seconds: float
    fingerprint: str

    @property
    def choices(self) -> Choices:
        """Dense samples are reweighted for outliers and bursts, sparse ones are not."""
        return Choices() if self.dense else SPARSE


def _plan(table: Table, settings: Settings, bridge: float | None) -> Plan:
    # a reader of its own: what cannot be used is counted once, by the run itself
    tracks = [(t.time_s, t.position_m) for t in Pieces(table, bridge)]
    if not tracks:
        pieces = Pieces(table, bridge)
        list(pieces)
        name, why = pieces.left_out[0]
        raise DataError(f"{table.source}: no track can be used ({len(pieces.left_out)} left out; {name}: {why}).")
    intervals = np.concatenate([np.diff(time) for time, _ in tracks])
    usual = float(np.median(intervals))
    if settings.recipe == "paper":
        dt = paper.FILTER_STEP_S if settings.task == "filter" else paper.RECONSTRUCT_STEP_S
    else:
        dt = settings.dt or round(min(usual, 1.0), 3)
    digest = hashlib.sha256(repr(settings).encode())
    for name in ("time_s", "position_m"):
        digest.update(table.frame[name].to_numpy().tobytes())
    dense = is_dense([time for time, _ in tracks])
    begin = time.perf_counter()
    enough = any(len(t) >= 3 for t, _ in tracks)
    noise = (fit_noise(tracks, dt) if enough else Noise()) if settings.recipe == "default" else None
    return Plan(dt, noise, dense, time.perf_counter() - begin, digest.hexdigest())


def _parts(out: Path, plan: Plan, resume: bool) -> Path:
    """Return the folder of parts, emptied unless a run with the same fingerprint is to go on."""
    parts = out / "parts"
    mark = parts / "run.json"
    if parts.exists() and resume and mark.exists():
        if json.loads(mark.read_text())["fingerprint"] != plan.fingerprint:
            raise DataError(f"{parts} was left by a run on other data or settings; leave out resume to start afresh.")
        return parts
    if parts.exists():
        shutil.rmtree(parts)
    parts.mkdir(parents=True)
    mark.write_text(json.dumps({"fingerprint": plan.fingerprint}))
    return parts


def _reaches(filtered: Filtered, tracks: Sequence[Track]) -> bool:
    """Tell whether an earlier track is still there when some of these begin."""
    return any(
        filtered.track.run_id == t.run_id and filtered.motion.time_s[-1] >= t.time_s[0] for t in tracks
    )  # fmt: skip


def _chunk(
    part: Path, tracks: list[Track], settings: Settings, plan: Plan, recent: Sequence[Filtered]
) -> list[Filtered]:
    """Do one chunk and write its part: the table, the parameters, and last the tallies, whose file marks it done."""
    tallies: dict[str, Tally] = {}
    begin = time.perf_counter()
    rows: list[dict[str, Any]]
    if settings.recipe == "paper":
        filtered, rows = _imitated(tracks, plan.dt, settings.fixed_parameters)
        seconds, calibration = time.perf_counter() - begin, 0.0
    else:
        assert plan.noise is not None
        filtered = recipe(tracks, plan.dt, plan.noise, plan.choices, recent) if tracks else []
        seconds = time.perf_counter() - begin
        rows = [] if settings.fixed_parameters else parameter_rows(filtered, recent)
        calibration = time.perf_counter() - begin - seconds
    tallies[OURS[settings.recipe]] = _tally([f.motion for f in filtered], tracks, seconds)
    for name in baselines.available() if settings.baselines else ():
        begin = time.perf_counter()
        motions = [baselines.run(name, t.time_s, t.position_m, clock_of(t, plan.dt)) for t in tracks]
        tallies[name] = _tally(motions, tracks, time.perf_counter() - begin)
    total, new = overlaps(filtered, recent)
    _table(filtered).write_parquet(part.with_suffix(".parquet"))
    pl.DataFrame(rows, infer_schema_length=None).write_parquet(part.with_name(part.name + ".parameters.parquet"))
    summary = {
        "tallies": {name: vars(tally) for name, tally in tallies.items()},
        "overlaps": total,
        "new_overlaps": new,
        "calibration_seconds": calibration,
    }
    beside = part.with_suffix(".part")
    beside.write_text(json.dumps(summary))
    beside.replace(part.with_suffix(".json"))
    return filtered


def _tally(motions: Sequence[Motion], tracks: Sequence[Track], seconds: float) -> Tally:
    tally = Tally(seconds=seconds)
    for motion, track in zip(motions, tracks, strict=True):
        tally.add(motion, track.time_s, track.position_m)
    return tally


def _imitated(tracks: Sequence[Track], dt: float, fixed: bool) -> tuple[list[Filtered], list[dict[str, Any]]]:
    filtered, rows = [], []
    for track in tracks:
        found = paper.imitate(track, dt, fixed_parameters=fixed)
        clock = found.motion.time_s
        unknown = np.full((len(clock), 3), np.nan)
        at = nearest(track, clock)
        gap = np.full(len(clock), np.nan)
        filtered.append(Filtered(track, found.motion, found.gap, unknown, track.leader[at], track.lane[at], gap))
        names = {"run_id": track.run_id, "vehicle_id": track.vehicle_id, "piece": track.piece, "source": "imagined"}
        rows.append(names | dict(zip(paper.NAMES, found.values.tolist(), strict=True)))
    return filtered, rows


def _table(filtered: Sequence[Filtered]) -> pl.DataFrame:
    """Return the tidy table of filtered tracks."""
    schema: dict[str, Any] = {
        "run_id": pl.String, "vehicle_id": pl.String, "piece": pl.Int32, "leader_id": pl.String, "lane": pl.Int64,
        "time_s": pl.Float64, "position_m": pl.Float64, "speed_mps": pl.Float64, "accel_mps2": pl.Float64,
        "length_m": pl.Float64, "gap_m": pl.Float64, "imagined_gap_m": pl.Float64, "position_sigma_m": pl.Float64,
        "speed_sigma_mps": pl.Float64, "accel_sigma_mps2": pl.Float64,
    }  # fmt: skip
    frames = []
    for f in filtered:
        count = len(f.motion.time_s)
        columns: dict[str, Any] = {
            "run_id": [f.track.run_id] * count, "vehicle_id": [f.track.vehicle_id] * count,
            "piece": np.full(count, f.track.piece), "leader_id": f.leader.tolist(), "lane": f.lane.astype(np.int64),
            "time_s": f.motion.time_s, "position_m": f.motion.position_m, "speed_mps": f.motion.speed_mps,
            "accel_mps2": f.motion.accel_mps2, "length_m": np.full(count, f.track.length_m), "gap_m": f.gap,
            "imagined_gap_m": f.imagined_gap, "position_sigma_m": f.sigma[:, 0], "speed_sigma_mps": f.sigma[:, 1],
            "accel_sigma_mps2": f.sigma[:, 2],
        }  # fmt: skip
        frames.append(pl.DataFrame(columns, schema=schema))
    table = pl.concat(frames) if frames else pl.DataFrame(schema=schema)
    floats = [name for name, kind in schema.items() if kind == pl.Float64]
    return table.with_columns(
        pl.col(floats).fill_nan(None),
        pl.when(pl.col("leader_id") != "").then(pl.col("leader_id")).alias("leader_id"),
        pl.when(pl.col("lane") >= 0).then(pl.col("lane")).alias("lane"),
    )


def _restored(part: Path, tracks: Sequence[Track]) -> list[Filtered]:
    """Return the filtered tracks of a finished part, so that the next chunk meets the same neighbours."""
    table = pl.read_parquet(part.with_suffix(".parquet"))
    by_key = dict(iter(table.group_by(["run_id", "vehicle_id", "piece"], maintain_order=True)))
    filtered = []
    for track in tracks:
        rows = by_key[(track.run_id, track.vehicle_id, track.piece)]
        names = ("time_s", "position_m", "speed_mps", "accel_mps2")
        motion = Motion(*(rows[name].to_numpy() for name in names))
        sigma = rows.select("position_sigma_m", "speed_sigma_mps", "accel_sigma_mps2").to_numpy()
        filtered.append(
            Filtered(
                track, motion, rows["imagined_gap_m"].to_numpy(), sigma, rows["leader_id"].fill_null("").to_numpy(),
                rows["lane"].fill_null(-1).to_numpy(), rows["gap_m"].to_numpy(),
            )
        )  # fmt: skip
    return filtered


def _finish(
    out: Path, parts: Path, table: Table, pieces: Pieces, settings: Settings, plan: Plan
) -> dict[str, Any]:  # fmt: skip
    """Join the parts, write parameters and report, and remove the parts."""
    done = sorted(path for path in parts.glob("*.json") if path.name != "run.json")
    tallies: dict[str, Tally] = {}
    totals: dict[str, float] = {"overlaps": 0, "new_overlaps": 0, "calibration_seconds": 0.0}
    for path in done:
        part = json.loads(path.read_text())
        for name, values in part["tallies"].items():
            tallies.setdefault(name, Tally()).merge(Tally(**values))
        for name in totals:
            totals[name] += part[name]
    names = [path.with_suffix("") for path in done]
    pl.scan_parquet([name.with_suffix(".parquet") for name in names]).sink_parquet(out / "trajectories.parquet")
    frames = [pl.read_parquet(name.with_name(name.name + ".parameters.parquet")) for name in names]
    parameters = pl.concat([f for f in frames if f.height] or [pl.DataFrame()], how="diagonal_relaxed")
    parameters.write_parquet(out / "parameters.parquet")
    ours = tallies[OURS[settings.recipe]]
    ours.seconds += plan.noise_seconds
    report: dict[str, Any] = {
        "source": table.source,
        "settings": dataclasses.asdict(settings) | {"dt": plan.dt},
        "noise": dataclasses.asdict(plan.noise) if plan.noise is not None else None,
        "vehicles": len(pieces.vehicles),
        "tracks": ours.tracks,
        "left_out": [{"track": name, "reason": why} for name, why in pieces.left_out],
        "divided": [{"vehicle": name, "note": note} for name, note in pieces.notes],
        "repairs": [{"kind": r.kind, "count": r.count, "text": r.text} for r in table.repairs],
        "methods": [{"method": name, **tally.row()} for name, tally in tallies.items()],
        "calibration_milliseconds_per_trajectory": 1e3 * totals["calibration_seconds"] / max(ours.tracks, 1),
        "overlapping_rows": totals["overlaps"],
        "overlapping_rows_that_did_not_overlap_before": totals["new_overlaps"],
    }
    if report["noise"] and not np.isfinite(report["noise"]["accel_time"]):
        report["noise"]["accel_time"] = None
    shown = _shown(out, pieces)
    write_report(out, report, shown, parameters)
    shutil.rmtree(parts)
    return report


def _shown(out: Path, pieces: Pieces) -> list[tuple[Track, Motion]]:
    """Return some tracks for pictures, evenly chosen, as they were written."""
    vehicles = [v for v in pieces.vehicles if v[3] >= 20] or pieces.vehicles
    chosen = [vehicles[i] for i in np.unique(np.linspace(0, len(vehicles) - 1, SHOWN).round().astype(int))]
    pairs = []
    written = pl.scan_parquet(out / "trajectories.parquet")
    for track in Pieces(pieces.table, pieces.bridge).of(chosen):
        mine = (pl.col("run_id") == track.run_id) & (pl.col("vehicle_id") == track.vehicle_id)
        rows = written.filter(mine & (pl.col("piece") == track.piece)).collect()
        names = ("time_s", "position_m", "speed_mps", "accel_mps2")
        pairs.append((track, Motion(*(rows[name].to_numpy() for name in names))))
    return pairs[:SHOWN]
