"""Whole files: filtering and reconstruction chunk by chunk, resumable, with tidy output and a report.

Memory holds one chunk of tracks: the file is spooled to disk by vehicles (``spool.py``), every finished chunk is a part
on disk (``jobs/shards.py``), and the parts are joined at the end without being read as a whole.
"""

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl

from idm_env.data import DataError
from idm_env.data.errors import repaired
from idm_env.data.folder import stamp
from idm_env.data.names import Columns
from idm_env.jobs import storage
from idm_env.jobs.executor import Executor, Serial
from idm_env.jobs.progress import OnProgress, silent
from idm_env.jobs.shards import Parts
from idm_env.reports.page import account
from idm_env.trajectories import chunks, left_out, paper
from idm_env.trajectories.chunks import CHUNK, OURS, PARAMETERS, TRAJECTORIES, FilePlan, FilterSettings, Recipe
from idm_env.trajectories.noise import fit_noise, is_dense
from idm_env.trajectories.recipe import Filtered, recipe
from idm_env.trajectories.report import space_time, write_report
from idm_env.trajectories.scores import RegularMotion, Tally
from idm_env.trajectories.smoother import PositionNoise
from idm_env.trajectories.spool import Reading, Shelf, Spool
from idm_env.trajectories.tracks import Pieces, TrackPiece

OUTPUT = ("trajectories.parquet", "parameters.parquet", "report.json", "report.html")
SAMPLED = 64
"""Vehicles that noise and step are taken from."""
SHOWN = 4
"""Tracks of which the report has pictures."""


def filter_file(
    path: str | Path,
    out: str | Path,
    *,
    task: Literal["filter", "reconstruct"] = "filter",
    dt: float | None = None,
    recipe: Recipe = "default",
    fixed_parameters: bool = False,
    baselines: bool = True,
    model: str | None = None,
    layout: str = "auto",
    columns: Columns = None,
    ring_length: float | None = None,
    chunk: int = CHUNK,
    resume: bool = False,
    executor: Executor | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Filter every track of a file and return the report, also written to ``out``.

    Writes ``trajectories.parquet`` (tidy: position, speed, acceleration, gap where there is a leader, imagined gap and
    standard deviations), ``parameters.parquet``, ``report.json`` and ``report.html``. ``recipe="paper"`` is the
    published one; ``fixed_parameters`` keeps its five parameters, and leaves out the calibration in the default one.
    ``model`` is a model.yaml, such as explain writes, whose effects the calibration keeps.
    Tracks that cannot be used are left out and counted. ``resume`` goes on after the last finished chunk. ``path`` may
    be a folder of parquet files. Runs are done by ``executor`` (None: here), on which no trajectory depends.
    ``task`` and ``dt`` (s; None: of the data) are those of ``reconstruct_file``.

    Raises:
        DataError: If the file as a whole cannot be used, or ``resume`` finds a run with other data or settings.
    """
    if recipe not in OURS:
        raise DataError(f"recipe = {recipe!r} is unknown; use 'default' or 'paper'.")
    settings = FilterSettings(task, dt, recipe, fixed_parameters, baselines, chunk, model)
    how, progress = Reading(layout, columns, ring_length), on_progress or silent
    progress("compiling", 0, 0, "the loops")
    _compile()
    with storage.results(out, OUTPUT, (path, model)) as folder:
        return _run(Path(path), folder.absolute(), settings, how, resume, executor or Serial(), progress)


def reconstruct_file(path: str | Path, out: str | Path, *, dt: float = 0.1, **options: Any) -> dict[str, Any]:
    """Reconstruct dense tracks of step ``dt`` (s) from sparse ones; holes are bridged. Else as ``filter_file``.

    The published recipe keeps its own step of 1 s. DataError for a step outside [0.01, 2] s.
    """
    if not 0.01 <= dt <= 2.0:
        raise DataError(f"dt = {dt:g} s is outside [0.01, 2] s; 0.1 s suits vehicles.")
    return filter_file(path, out, task="reconstruct", dt=dt, **options)


def _run(
    path: Path,
    out: Path,
    settings: FilterSettings,
    how: Reading,
    resume: bool,
    executor: Executor,
    progress: OnProgress,
) -> dict[str, Any]:
    progress("reading", 0, 0, path.name)
    model = None if settings.model is None else Path(settings.model)
    mark = storage.fingerprint(settings, how, stamp(path), model)
    parts = Parts(out / storage.UNFINISHED / settings.task, mark, resume)
    try:
        spool = Spool(path, parts.folder / "spool", settings.chunk, how)
        bridge = 2.0 if settings.task == "filter" else None
        plan = _plan(spool, settings, bridge)
    except DataError:
        parts.remove()  # nothing of it could go on
        raise
    _chunks([_Strand(n, spool.shelf, parts, settings, plan, bridge) for n in spool.strands()], executor, progress)
    summaries = parts.summaries()
    scored = []
    if settings.task == "reconstruct":
        progress("scoring", 0, 0, "points left out of the file")
        scored = left_out.score(spool, plan, settings)
    progress("writing", 0, 0, "the report")
    parts.join(TRAJECTORIES, out / "trajectories.parquet")
    parts.join(PARAMETERS, out / "parameters.parquet")
    report = _report(spool, summaries, settings, plan) | {"left_out_points": scored}
    figures = space_time(out / "trajectories.parquet", spool, bridge)
    parameters = pl.read_parquet(out / "parameters.parquet", glob=False)
    report = write_report(out, report, _shown(out, spool, bridge), parameters, figures)
    parts.remove()
    return report


@dataclass(frozen=True)
class _Strand:
    """Chunks that have to be done one after the other, and all that they need."""

    numbers: tuple[int, ...]
    shelf: Shelf
    parts: Parts
    settings: FilterSettings
    plan: FilePlan
    bridge: float | None

    def __str__(self) -> str:
        begin, end = self.vehicles
        return f"vehicles {begin + 1} to {end}"

    @property
    def vehicles(self) -> tuple[int, int]:
        return self.shelf.borders[self.numbers[0]], self.shelf.borders[self.numbers[-1] + 1]


def _chunks(strands: Sequence[_Strand], executor: Executor, progress: OnProgress) -> None:
    """Do all chunks that are not done yet, a strand wherever the executor has room for it."""
    missing = [s for s in strands if not all(s.parts.done(number) for number in s.numbers)]
    task, everybody = strands[0].settings.task, strands[0].shelf.borders[-1]
    done = everybody - sum(s.vehicles[1] - s.vehicles[0] for s in missing)
    for index, _ in executor.map(_strand, missing, progress):
        done += missing[index].vehicles[1] - missing[index].vehicles[0]
        progress(task, done, everybody, "")


def _strand(strand: _Strand, progress: OnProgress) -> None:
    """Do the chunks of a strand that are not done yet; each meets the vehicles of those before it."""
    parts, settings, borders = strand.parts, strand.settings, strand.shelf.borders
    recent: list[Filtered] = []
    for number in strand.numbers:
        pieces = Pieces(strand.shelf.table(number), strand.bridge)
        tracks = list(pieces)
        recent = [f for f in recent if tracks and _reaches(f, tracks)]
        begin, end = borders[number], borders[number + 1]
        if parts.done(number):
            recent += chunks.restored(parts, number, tracks)
        else:
            remarks = {"left_out": pieces.left_out, "notes": pieces.notes}

            def report(share: float, words: str, begin: int = begin, end: int = end) -> None:
                progress(settings.task, begin + int(share * (end - begin)), borders[-1], words)

            recent += chunks.done(parts, number, tracks, settings, strand.plan, recent, remarks, report)
        progress(settings.task, end, borders[-1], "")


def _compile() -> None:
    """Run every loop once, so that compiling or loading them does not count as a trajectory's time."""
    time_s = 0.1 * np.arange(12)
    nobody = np.full(len(time_s), "")
    track = TrackPiece("", "", 0, time_s, 10.0 * time_s, 4.5, nobody, np.full(len(time_s), -1))
    recipe([track], 0.1, fit_noise([(time_s, track.position_m)], 0.1, evaluations=2))
    paper.imitate([track], iterations=1)


def _plan(spool: Spool, settings: FilterSettings, bridge: float | None) -> FilePlan:
    """Decide by some vehicles, evenly chosen. DataError if no vehicle of the file has a track."""
    count = len(spool.vehicles)
    some = np.unique(np.linspace(0, count - 1, SAMPLED).round().astype(int)).tolist()
    tracks = [(t.time_s, t.position_m) for table in spool.picked(some) for t in Pieces(table, bridge)]
    if not tracks:
        tracks = _any_track(spool, bridge)
    usual = float(np.median(np.concatenate([np.diff(time) for time, _ in tracks])))
    if settings.recipe == "paper":
        dt = paper.FILTER_STEP_S if settings.task == "filter" else paper.RECONSTRUCT_STEP_S
    else:
        dt = settings.dt or round(min(usual, 1.0), 3)
    dense = is_dense([time for time, _ in tracks])
    begin = time.perf_counter()
    enough = any(len(t) >= 3 for t, _ in tracks)
    noise = (fit_noise(tracks, dt) if enough else PositionNoise()) if settings.recipe == "default" else None
    return FilePlan(dt, noise, dense, time.perf_counter() - begin)


def _any_track(spool: Spool, bridge: float | None) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the tracks of the first chunk that has any."""
    lost: list[tuple[str, str]] = []
    for number in range(spool.chunks):
        pieces = Pieces(spool.shelf.table(number), bridge)
        tracks = [(t.time_s, t.position_m) for t in pieces]
        if tracks:
            return tracks
        lost += pieces.left_out
    name, why = lost[0]
    raise DataError(f"{spool.source}: no track can be used ({len(lost)} left out; {name}: {why}).")


def _reaches(filtered: Filtered, tracks: Sequence[TrackPiece]) -> bool:
    """Tell whether an earlier track is still there when some of these begin."""
    return any(filtered.track.run_id == t.run_id and filtered.motion.time_s[-1] >= t.time_s[0] for t in tracks)


def _report(spool: Spool, parts: Sequence[dict[str, Any]], settings: FilterSettings, plan: FilePlan) -> dict[str, Any]:
    """Return the report of all parts."""
    tallies: dict[str, Tally] = {}
    totals = dict.fromkeys(("overlaps", "new_overlaps"), 0)
    lost = [item for part in parts for item in part["left_out"]]
    notes = [item for part in parts for item in part["notes"]]
    for part in parts:
        for name, values in part["tallies"].items():
            tallies.setdefault(name, Tally()).merge(Tally(**values))
        for name in totals:
            totals[name] += part[name]
    ours = tallies[OURS[settings.recipe]]
    ours.seconds += plan.seconds
    noise = dataclasses.asdict(plan.noise) if plan.noise is not None else None
    if noise and not math.isfinite(noise["accel_time"]):
        noise["accel_time"] = None
    return {
        "source": spool.source,
        "settings": dataclasses.asdict(settings) | {"dt": plan.dt},
        "noise": noise,
        "vehicles": len(spool.vehicles),
        "tracks": ours.tracks,
        "left_out": [{"track": name, "reason": why} for name, why in lost],
        "divided": [{"vehicle": name, "note": note} for name, note in notes],
        "repairs": [{"kind": r.kind, "count": r.count, "text": r.text} for r in spool.repairs],
        "methods": [{"method": name, **tally.row()} for name, tally in tallies.items()],
        "overlapping_rows": totals["overlaps"],
        "overlapping_rows_that_did_not_overlap_before": totals["new_overlaps"],
        "account": account(spool.repairs, repaired("tracks", len(lost), "")),
    }


def _shown(out: Path, spool: Spool, bridge: float | None) -> list[tuple[TrackPiece, RegularMotion]]:
    """Return some tracks for pictures, evenly chosen, as they were written."""
    some = np.unique(np.linspace(0, len(spool.vehicles) - 1, 4 * SHOWN).round().astype(int)).tolist()
    tracks = [track for table in spool.picked(some) for track in Pieces(table, bridge)]
    tracks = [track for track in tracks if len(track) >= 20] or tracks
    chosen = [tracks[i] for i in np.unique(np.linspace(0, len(tracks) - 1, SHOWN).round().astype(int))]
    pairs = []
    written = pl.scan_parquet(out / "trajectories.parquet", glob=False)
    for track in chosen:
        mine = (pl.col("run_id") == track.run_id) & (pl.col("vehicle_id") == track.vehicle_id)
        rows = written.filter(mine & (pl.col("piece") == track.piece)).collect()
        pairs.append((track, RegularMotion.from_table(rows)))
    return pairs
