"""One chunk of tracks: filtered or imitated, compared with the baselines, and written as a part."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import polars as pl

from idm_env.jobs.shards import Parts
from idm_env.trajectories import paper
from idm_env.trajectories.baselines import BASELINES
from idm_env.trajectories.drivers import parameter_rows
from idm_env.trajectories.recipe import Filtered, nearest, overlaps, recipe
from idm_env.trajectories.scores import RegularMotion, Tally
from idm_env.trajectories.smoother import SPARSE, PositionNoise, SmootherOptions
from idm_env.trajectories.tracks import TrackPiece, clock_of

Recipe = Literal["default", "paper"]
CHUNK = 200
OURS = {"default": "simulator, imagined leader", "paper": "the paper's recipe"}
TRAJECTORIES, PARAMETERS = "trajectories", "parameters"
MOTION = tuple(field.name for field in dataclasses.fields(RegularMotion))
SIGMAS = ("position_sigma_m", "speed_sigma_mps", "accel_sigma_mps2")
SCHEMA: dict[str, Any] = {"run_id": pl.String, "vehicle_id": pl.String, "piece": pl.Int32, "leader_id": pl.String}
SCHEMA |= {"lane": pl.Int64, **dict.fromkeys((*MOTION, "length_m", "gap_m", "imagined_gap_m", *SIGMAS), pl.Float64)}
PARAMETER_SCHEMA: dict[str, Any] = {"run_id": pl.String, "vehicle_id": pl.String, "piece": pl.Int64}
PARAMETER_SCHEMA |= {"source": pl.String, **dict.fromkeys(paper.NAMES, pl.Float64)}
PARAMETER_SCHEMA |= {f"{name}_error": pl.Float64 for name in paper.NAMES}
PARAMETER_SCHEMA |= {f"{name}_identified": pl.Boolean for name in paper.NAMES}


@dataclasses.dataclass(frozen=True)
class FilterSettings:
    """Settings of a run: task, step (s; None takes the file's), recipe, ablation, baselines, vehicles per chunk.

    ``model`` is a model.yaml whose effects are behind the drivers' own parameters; None is IDM.
    """

    task: Literal["filter", "reconstruct"]
    dt: float | None = None
    recipe: Recipe = "default"
    fixed_parameters: bool = False
    baselines: bool = True
    chunk: int = CHUNK
    model: str | None = None


@dataclasses.dataclass(frozen=True)
class FilePlan:
    """Decisions for the whole file: step (s), noise, and whether samples are dense; ``seconds`` it took."""

    dt: float
    noise: PositionNoise | None
    dense: bool
    seconds: float

    @property
    def options(self) -> SmootherOptions:
        """Dense samples are reweighted for outliers and bursts, sparse ones are not."""
        return SmootherOptions() if self.dense else SPARSE


def done(
    parts: Parts, number: int, tracks: list[TrackPiece], settings: FilterSettings, plan: FilePlan,
    recent: Sequence[Filtered], remarks: dict[str, Any],
    on_stage: Callable[[float, str], None] = lambda share, words: None,
) -> list[Filtered]:  # fmt: skip
    """Do one chunk and write its part: the table, the parameters, and last the tallies, which mark it done.

    ``remarks`` are what else is to be known of it. ``on_stage`` is called with the share done and what comes next.
    """
    others = BASELINES if settings.baselines else {}
    stages = 2 + len(others)
    on_stage(0.0, "filtering")
    tallies: dict[str, Tally] = {}
    begin = time.perf_counter()
    rows: list[dict[str, Any]]
    if settings.recipe == "paper":
        filtered, rows = _imitated(tracks, plan.dt, settings.fixed_parameters)
        seconds = time.perf_counter() - begin
    else:
        assert plan.noise is not None
        filtered = recipe(tracks, plan.dt, plan.noise, plan.options, recent) if tracks else []
        seconds = time.perf_counter() - begin
        on_stage(1 / stages, "drivers' parameters")
        rows = [] if settings.fixed_parameters else parameter_rows(filtered, recent, settings.model)
    tallies[OURS[settings.recipe]] = _tally([f.motion for f in filtered], tracks, seconds)
    for i, (name, smoother) in enumerate(others.items()):
        on_stage((2 + i) / stages, f"to compare: {name}")
        begin = time.perf_counter()
        motions = [smoother(t.time_s, t.position_m, clock_of(t, plan.dt)) for t in tracks]
        tallies[name] = _tally(motions, tracks, time.perf_counter() - begin)
    total, new = overlaps(filtered, recent)
    parts.write(number, TRAJECTORIES, _table(filtered))
    parts.write(number, PARAMETERS, pl.DataFrame(rows, schema=PARAMETER_SCHEMA))
    sums = {name: vars(tally) for name, tally in tallies.items()}
    parts.finish(number, {"tallies": sums, "overlaps": total, "new_overlaps": new, **remarks})
    return filtered


def _tally(motions: Sequence[RegularMotion], tracks: Sequence[TrackPiece], seconds: float) -> Tally:
    tally = Tally(seconds=seconds)
    for motion, track in zip(motions, tracks, strict=True):
        tally.add(motion, track.time_s, track.position_m)
    return tally


def _imitated(tracks: Sequence[TrackPiece], dt: float, fixed: bool) -> tuple[list[Filtered], list[dict[str, Any]]]:
    filtered, rows = [], []
    for track, fit in zip(tracks, paper.imitate(tracks, dt, fixed_parameters=fixed), strict=True):
        clock = fit.motion.time_s
        unknown = np.full((len(clock), 3), np.nan)
        sample = nearest(track, clock)
        gap = np.full(len(clock), np.nan)
        filtered.append(Filtered(track, fit.motion, fit.gap, unknown, track.leader[sample], track.lane[sample], gap))
        names = {"run_id": track.run_id, "vehicle_id": track.vehicle_id, "piece": track.piece, "source": "imagined"}
        rows.append(names | dict(zip(paper.NAMES, fit.values.tolist(), strict=True)))
    return filtered, rows


def _table(filtered: Sequence[Filtered]) -> pl.DataFrame:
    """Return the tidy table of filtered tracks."""
    frames = []
    for f in filtered:
        count = len(f.motion.time_s)
        columns: dict[str, Any] = {"run_id": [f.track.run_id] * count, "vehicle_id": [f.track.vehicle_id] * count}
        columns |= {"piece": np.full(count, f.track.piece), "leader_id": f.leader.tolist()}
        columns |= {"lane": f.lane.astype(np.int64), **{name: getattr(f.motion, name) for name in MOTION}}
        columns |= {"length_m": np.full(count, f.track.length_m), "gap_m": f.gap, "imagined_gap_m": f.imagined_gap}
        columns |= dict(zip(SIGMAS, f.sigma.T, strict=True))
        frames.append(pl.DataFrame(columns, schema=SCHEMA))
    table = pl.concat(frames) if frames else pl.DataFrame(schema=SCHEMA)
    floats = [name for name, kind in SCHEMA.items() if kind == pl.Float64]
    return table.with_columns(
        pl.col(floats).fill_nan(None),
        pl.when(pl.col("leader_id") != "").then(pl.col("leader_id")).alias("leader_id"),
        pl.when(pl.col("lane") >= 0).then(pl.col("lane")).alias("lane"),
    )


def restored(parts: Parts, number: int, tracks: Sequence[TrackPiece]) -> list[Filtered]:
    """Return the filtered tracks of a finished part, so that the next chunk meets the same neighbours."""
    table = pl.read_parquet(parts.path(number, TRAJECTORIES), glob=False)
    by_key = dict(iter(table.group_by(["run_id", "vehicle_id", "piece"], maintain_order=True)))
    filtered = []
    for track in tracks:
        rows = by_key[(track.run_id, track.vehicle_id, track.piece)]
        motion, sigma = RegularMotion.from_table(rows), rows.select(SIGMAS).to_numpy()
        leader, lane = rows["leader_id"].fill_null("").to_numpy(), rows["lane"].fill_null(-1).to_numpy()
        gap, imagined_gap = rows["gap_m"].to_numpy(), rows["imagined_gap_m"].to_numpy()
        filtered.append(Filtered(track, motion, imagined_gap, sigma, leader, lane, gap))
    return filtered
