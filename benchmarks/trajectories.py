"""Filtering and reconstruction side by side with every baseline, on vehicles that no tuning has seen; and their times.

    python -m benchmarks.trajectories --data FOLDER [--part filter|reconstruct|time] [--executor processes]
    python -m benchmarks.trajectories --pictures docs    # those of docs/trajectories.md, from data made here

FOLDER holds the measured files named in ``FILES``. Baselines are tuned on the truth of every other vehicle, for each
figure by itself; ours sees no truth: its noise is fitted to the noisy positions of those same vehicles. The published
recipe is run as published; its speed is compared with a direct implementation on the published layer (diffidm).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import polars as pl
import torch

from benchmarks import command
from idm_env.data import synthetic
from idm_env.data.scenario import Agent, MapLane, Scenario, TrafficControl
from idm_env.jobs.progress import OnProgress, silent
from idm_env.jobs.workers import HERE, Workers
from idm_env.prediction.pictures import scene_picture
from idm_env.prediction.predict import predict
from idm_env.prediction.scene import MapScene
from idm_env.trajectories import paper
from idm_env.trajectories.baselines import BASELINES
from idm_env.trajectories.noise import SPARSE_WHITE_M, fit_noise
from idm_env.trajectories.recipe import overlaps, recipe
from idm_env.trajectories.report import before_and_after
from idm_env.trajectories.scores import RegularMotion, Tally
from idm_env.trajectories.smoother import SPARSE
from idm_env.trajectories.spool import read_table
from idm_env.trajectories.tracks import Pieces, TrackPiece, clock_of

RAW, CLEAN = "ngsim_i80_rawlike.csv.gz", "ngsim_i80_lanes.parquet"
FILES = {
    "I-80": (CLEAN, 100, 30.0),
    "ZalaZone": ("openacc_zalazone.parquet", 20, 60.0),
    "TGSIM": ("tgsim_pairs.parquet", 60, 20.0),
}
SPARSE_S = (1.0, 2.0, 5.0, 10.0)
ENDS_S = (0.0, 0.5, 1.0)
"""Ends of tracks that are not scored (s): the clean tracks speed up as they begin and brake as they end."""


def kalman(
    time_s: np.ndarray, position_m: np.ndarray, clock: np.ndarray, density: float = 0.1, sigma: float = 0.3
) -> RegularMotion:
    """Return the Rauch–Tung–Striebel smoother of a constant-acceleration model with white noise (statsmodels).

    ``density`` is the spectral density of the jerk (m²/s⁵) and ``sigma`` the noise of positions (m). Samples are taken
    at the nearest tick of the clock.
    """
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    dt = (clock[-1] - clock[0]) / (len(clock) - 1)
    values = np.full(len(clock), np.nan)
    values[np.clip(np.round((time_s - clock[0]) / dt).astype(int), 0, len(clock) - 1)] = position_m - position_m[0]
    model = KalmanSmoother(k_endog=1, k_states=3)
    model["transition"] = np.array([[1.0, dt, dt * dt / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    model["selection"] = np.eye(3)
    model["state_cov"] = density * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    model["design"] = np.array([[1.0, 0.0, 0.0]])
    model["obs_cov"] = np.array([[sigma * sigma]])
    duration = max(time_s[-1] - time_s[0], dt)
    model.initialize_known(np.array([0.0, (position_m[-1] - position_m[0]) / duration, 0.0]), np.diag([25.0, 100, 10]))
    model.bind(values[:, None])
    state = model.smooth().smoothed_state
    return RegularMotion(clock, state[0] + position_m[0], state[1], state[2])


METHODS = {**BASELINES, "Kalman/RTS": kalman}
DENSITIES = (0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3)
TUNED: dict[str, tuple[dict[str, Any], ...]] = {
    "linear": ({},),
    "moving average": tuple({"window": w} for w in (5, 9, 15, 21, 31, 41, 51, 61)),
    "exponential": tuple({"width": w} for w in (3, 4, 5, 6, 7, 8, 10, 13, 17, 22)),
    "bounded spline": tuple({"spacing": s} for s in (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)),
    "Savitzky–Golay": tuple({"window": w, "order": o} for o in (2, 3, 5) for w in range(31, 122, 10)),
    "Kalman/RTS": tuple({"density": density} for density in DENSITIES),
}
"""What a tuning tries of the free numbers of each method."""


def truth_errors(pairs: Iterable[tuple[RegularMotion, RegularMotion]]) -> dict[str, float]:
    """Return the errors of motions against true ones on the same clock; samples that have no truth do not count."""
    squares, count = np.zeros(3), 0
    for motion, truth in pairs:
        columns = np.array([[each.position_m, each.speed_mps, each.accel_mps2] for each in (motion, truth)])
        finite = np.isfinite(columns[1]).all(0)
        count += int(finite.sum())
        squares += ((columns[0] - columns[1])[:, finite] ** 2).sum(1)
    names = ("position_rmse_m", "speed_rmse_mps", "accel_rmse_mps2")
    return dict(zip(names, np.sqrt(squares / count).tolist(), strict=True))


def truth_of(frame: pl.DataFrame, with_run: bool) -> Callable[[TrackPiece], RegularMotion]:
    """Return a function from a track to its measured motion at its own samples, NaN where there is none."""
    keys = ["run_id", "vehicle_id"] if with_run else ["vehicle_id"]
    frame = frame.with_columns(pl.col(key).cast(pl.String) for key in keys).sort("time_s")
    parts = dict(iter(frame.group_by(keys)))

    def motion(track: TrackPiece) -> RegularMotion:
        part = parts[(track.run_id, track.vehicle_id) if with_run else (track.vehicle_id,)]
        clock = clock_of(track, 0.1)
        times = part["time_s"].to_numpy()
        index = np.clip(np.searchsorted(times, clock - 0.05), 0, len(times) - 1)
        near = np.abs(times[index] - clock) < 0.051
        position, speed, accel = (part[name].to_numpy() for name in ("position_m", "speed_mps", "accel_mps2"))
        if not np.isfinite(accel).any():
            accel = np.gradient(speed, times)  # of Doppler speeds, in files without accelerations
        columns = (column[index] for column in (position, speed, accel))
        return RegularMotion(clock, *(np.where(near, column, np.nan) for column in columns))

    return motion


def score(
    tracks: list[TrackPiece],
    motions: list[RegularMotion],
    truth: Callable[[TrackPiece], RegularMotion],
    ends: float = 0.0,
) -> dict[str, float | int]:
    """Return the row of a method; the first and last ``ends`` seconds of every track are not compared."""
    tally, pairs = Tally(), []
    for track, motion in zip(tracks, motions, strict=True):
        tally.add(motion, track.time_s, track.position_m)
        true = truth(track)
        inside = np.abs(true.time_s - 0.5 * (true.time_s[0] + true.time_s[-1]))
        inside = inside <= 0.5 * (true.time_s[-1] - true.time_s[0]) - ends + 1e-6
        speed, accel = (np.where(inside, x, np.nan) for x in (true.speed_mps, true.accel_mps2))
        pairs.append((motion, RegularMotion(true.time_s, true.position_m, speed, accel)))
    return tally.row() | truth_errors(pairs)


def line(name: str, row: dict[str, float | int], note: str = "") -> str:
    values = " ".join(f"{row[key]:8.{digits}f}" for key, _, digits in SHOWN)
    return f"  {name:24s} {values}  {note}"


SHOWN = (
    ("position_error_rate_percent", "rate %", 3), ("accel_mean_mps2", "mean |a|", 2), ("accel_std_mps2", "std |a|", 2),
    ("implausible_percent", "impl. %", 1), ("position_rmse_m", "x (m)", 3), ("speed_rmse_mps", "v (m/s)", 3),
    ("accel_rmse_mps2", "a (m/s²)", 3),
)  # fmt: skip
HEAD = f"  {'method':24s} " + " ".join(f"{title:>8s}" for _, title, _ in SHOWN)


def best_of(
    name: str, tuned: list[TrackPiece], scored: list[TrackPiece], truth: Callable[[TrackPiece], RegularMotion],
    ends: float = 0.0, given: dict[str, float] | None = None,
) -> list[str]:  # fmt: skip
    """Tune a baseline on some tracks, for each figure by itself, and return what it does to the others."""
    rows: list[tuple[dict[str, float], dict[str, float | int]]] = []
    for choice in TUNED[name]:
        whole = {**choice, **(given or {})}
        rows.append((whole, score(tuned, _motions(name, tuned, whole), truth, ends)))
    by_choice: dict[tuple, list[str]] = {}
    for what in ("speed_rmse_mps", "accel_rmse_mps2"):
        choice, _ = min(rows, key=lambda row: row[1][what])
        by_choice.setdefault(tuple(choice.items()), []).append(what[:5])
    lines = []
    for choice, what in by_choice.items():
        note = ", ".join(f"{key} {value:g}" for key, value in choice)
        row = score(scored, _motions(name, scored, dict(choice)), truth, ends)
        lines.append(line(name, row, f"{note} for {' and '.join(what)}" if note else ""))
    return lines


def _motions(name: str, tracks: list[TrackPiece], choice: dict[str, float]) -> list[RegularMotion]:
    return [METHODS[name](t.time_s, t.position_m, clock_of(t, 0.1), **choice) for t in tracks]


def halves(tracks: list[TrackPiece]) -> tuple[list[TrackPiece], list[TrackPiece]]:
    """Return the tracks of every other vehicle, and of the rest."""
    names = sorted({(t.run_id, t.vehicle_id) for t in tracks}, key=lambda name: (name[0], len(name[1]), name[1]))
    first = set(names[::2])
    return [t for t in tracks if (t.run_id, t.vehicle_id) in first], [
        t for t in tracks if (t.run_id, t.vehicle_id) not in first
    ]


def filtering(part: tuple[Path, int], _: OnProgress = silent) -> str:
    """Return scores on the half that tuned nothing, with the ends of the tracks and without; (data, which half)."""
    data, number = part
    truth = truth_of(pl.read_parquet(data / CLEAN), with_run=False)
    first, second = halves(list(Pieces(read_table(data / RAW)[0])))
    tuned, scored = (first, second) if number == 1 else (second, first)
    noise = fit_noise([(t.time_s, t.position_m) for t in tuned], 0.1)
    ours = recipe(scored, 0.1, noise)
    published = [result.motion for result in paper.imitate(scored)]
    lines = []
    for ends in ENDS_S:
        counts = f"half {number}: tuned on {len(tuned)} tracks, scored on the other {len(scored)}"
        lines += [f"filtering, {counts}, without the first and last {ends:g} s", HEAD]
        own = score(scored, [f.motion for f in ours], truth, ends)
        lines.append(line("ours", own, f"new overlaps {overlaps(ours)[1]}"))
        lines.append(line("the paper's recipe", score(scored, published, truth, ends)))
        for name in METHODS:
            lines += best_of(name, tuned, scored, truth, ends)
    return "\n".join(lines)


def thinned(track: TrackPiece, seconds: float) -> TrackPiece:
    indices, following = [], track.time_s[0]
    for i, now in enumerate(track.time_s):
        if now >= following - 1e-6:
            indices.append(i)
            following = now + seconds
    return track.part(np.array(indices))


def reconstruction(part: tuple[Path, str, float], _: OnProgress = silent) -> str:
    """Return scores of every method against what thinning left out, (data, place, seconds between samples).

    Baselines are tuned on every other vehicle.
    """
    data, place, seconds = part
    file, count, shortest = FILES[place]
    long = [t for t in Pieces(read_table(data / file)[0]) if t.time_s[-1] - t.time_s[0] >= shortest]
    # evenly over the file, and at most two minutes of each
    chosen = [long[i] for i in np.unique(np.linspace(0, len(long) - 1, 2 * count).astype(int))]
    both = halves([t.part(t.time_s <= t.time_s[0] + 120.0) for t in chosen])
    truth = truth_of(pl.read_parquet(data / file), with_run=True)
    tuned, scored = ([s for s in (thinned(t, seconds) for t in ts) if len(s) >= 3] for ts in both)
    noise = fit_noise([(t.time_s, t.position_m) for t in tuned], 0.1)
    lines = [f"reconstruction: {place}, {len(scored)} tracks, a sample every {seconds:g} s", HEAD]
    ours = recipe(scored, 0.1, noise, SPARSE)
    lines.append(line("ours", score(scored, [f.motion for f in ours], truth)))
    for fixed in (False, True):
        imitation = paper.imitate(scored, paper.RECONSTRUCT_STEP_S, fixed_parameters=fixed)
        steps = [one.motion for one in imitation]
        dense = [_dense(m, clock_of(t, 0.1)) for m, t in zip(steps, scored, strict=True)]
        lines.append(line("  … parameters fixed" if fixed else "the paper's recipe", score(scored, dense, truth)))
    for name in METHODS:
        fixed_choice = {"sigma": SPARSE_WHITE_M} if name == "Kalman/RTS" else None
        lines += best_of(name, tuned, scored, truth, given=fixed_choice)
    return "\n".join(lines)


def _dense(motion: RegularMotion, clock: np.ndarray) -> RegularMotion:
    """Return a coarse motion between its steps: positions and speeds by straight lines, accelerations held."""
    index = np.clip(np.searchsorted(motion.time_s, clock + 1e-9) - 1, 0, len(motion.time_s) - 1)
    position, speed = (np.interp(clock, motion.time_s, x) for x in (motion.position_m, motion.speed_mps))
    return RegularMotion(clock, position, speed, motion.accel_mps2[index])


def timing(count: int, seconds: float) -> None:
    """Time the default recipe, the published one, and the published one written on the published layer, in one run."""
    from tests.trajectories.direct import direct
    from tests.trajectories.test_recipe import correlated
    from tests.trajectories.tracks import swinging, track_of

    rng = np.random.default_rng(0)
    tracks = []
    for i in range(count):
        motion = swinging(seconds, phase=float(rng.uniform(0, 6)))
        tracks.append(track_of(motion, correlated(rng, len(motion.time_s)), str(i)))
    data = [(t.time_s, t.position_m) for t in tracks]
    (
        fit_noise(data[:2], 0.1, evaluations=2),
        recipe(tracks[:1], 0.1, fit_noise(data[:2], 0.1)),
        paper.imitate(tracks[:1], iterations=1),
    )
    begin = time.perf_counter()
    recipe(tracks, 0.1, fit_noise(data, 0.1))
    ours = (time.perf_counter() - begin) / count
    print(f"time: {count} tracks of {seconds:g} s at 10 Hz, {torch.get_num_threads()} torch threads")
    print(f"  default recipe, noise fitted: {1e3 * ours:8.2f} ms per trajectory (the paper states 308 ms)")
    begin = time.perf_counter()
    paper.imitate(tracks)
    own = (time.perf_counter() - begin) / count
    print(f"  published recipe, compiled  : {1e3 * own:8.2f} ms per trajectory, 500 steps, one batch")
    iterations = 5
    begin = time.perf_counter()
    direct(tracks, 0.1, iterations)
    layer = (time.perf_counter() - begin) / count / iterations * paper.ITERATIONS
    print(f"  published recipe, diffidm   : {1e3 * layer:8.2f} ms per trajectory, {iterations} of 500 steps, one batch")
    print(f"  ratio                       : {layer / own:8.1f}")


def noisy_tracks() -> list[TrackPiece]:
    """Return generated drivers whose positions carry noise correlated over 0.3 s, white noise, and jumps."""
    trajectories, _ = synthetic.generate(3, runs=2, followers=4, seconds=60.0)
    rng = np.random.default_rng(0)
    tracks = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "made.parquet"
        trajectories.table.select("run_id", "vehicle_id", "leader_id", "time_s", "position_m").write_parquet(path)
        table = read_table(path)
    for track in Pieces(table):
        fade, noise = np.exp(-0.1 / 0.3), np.empty(len(track))
        noise[0] = 0.3 * rng.normal()
        for k in range(1, len(noise)):
            noise[k] = fade * noise[k - 1] + 0.3 * np.sqrt(1 - fade * fade) * rng.normal()
        noise += 0.1 * rng.normal(size=len(noise))
        noise[rng.integers(0, len(noise), 2)] += 3.0
        tracks.append(dataclasses.replace(track, position_m=track.position_m + noise))
    return tracks


def crossing() -> Scenario:
    """Return a crossing with a stop sign, and a vehicle that halts at it and goes on to the left."""
    east = MapLane(1, np.array([[-80.0, 0.0], [-4.0, 0.0]]), exits=(2, 3))
    across = MapLane(2, np.array([[-4.0, 0.0], [60.0, 0.0]]), exits=())
    angle = np.linspace(0, np.pi / 2, 12)
    bend = np.stack([-4.0 + 8.0 * np.sin(angle), 8.0 - 8.0 * np.cos(angle)], axis=1)
    left = MapLane(3, np.concatenate([bend, [[4.0, 60.0]]]), exits=())
    path = np.concatenate([east.line, left.line])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    speed = np.interp(np.arange(91), [0, 10, 50, 60, 91], [10.5, 10.0, 0.3, 0.3, 5.0])
    along = 76.0 - 2.5 - 21.4 - 10.3 + np.concatenate([[0.0], np.cumsum(0.1 * speed[:-1])])
    position = np.stack([np.interp(along, length, path[:, i]) for i in (0, 1)], axis=1)
    step = np.gradient(position, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    agent = Agent(1, "vehicle", 4.6, 1.9, position, heading, velocity, np.ones(91, bool))
    return Scenario(
        "a crossing", (agent,), (east, across, left), (0,), controls=(TrafficControl("sign", np.array([-6.0, -4.0])),)
    )


def draw(folder: Path) -> None:
    """Draw a filtered track before and after, and the futures of a vehicle at a stop sign beside what it did."""
    tracks = noisy_tracks()
    filtered = recipe(tracks, 0.1, fit_noise([(t.time_s, t.position_m) for t in tracks], 0.1))
    before_and_after(filtered[2].track, filtered[2].motion).savefig(folder / "filtering.png", dpi=90)
    figure, _ = scene_picture(scene := crossing(), predict(MapScene(scene), 0))
    figure.savefig(folder / "prediction.png", dpi=90)


def main(
    data: Path | None = None, part: Literal["filter", "reconstruct", "time"] | None = None, tracks: int = 200,
    seconds: float = 60.0, pictures: Path | None = None, place: Workers = HERE,
) -> None:  # fmt: skip
    """Print the scores of every method, and times.

    Args:
        data: Folder of the measured files; by default only times are taken.
        part: All three, by default.
        tracks: Of which times are taken.
        seconds: Of each of these.
        pictures: Draw the pictures of the documents into this folder, no more.
        place: Where parts run.
    """
    if pictures is not None:
        draw(pictures)
        return
    if part in (None, "time"):
        timing(tracks, seconds)
    if data is None:
        return
    with place.opened() as executor:
        if part in (None, "filter"):
            for _, text in executor.map(filtering, [(data, half) for half in (1, 2)]):
                print(text, flush=True)
        if part in (None, "reconstruct"):
            parts = [(data, name, apart) for name in FILES for apart in SPARSE_S]
            for _, text in executor.map(reconstruction, parts):
                print(text, flush=True)


if __name__ == "__main__":
    command(main)
