"""Known drift found again: generated drivers of whom nothing is known, and drivers who do not drift.

    python -m benchmarks.drift_sets [--sets 60] [--out drift_sets.jsonl] [--first-seed 1000] [--alone]
                                    [--steady] [--drivers 20] [--seconds 90]

A set is 20 drivers of 90 s, sampled every 0.2 s with errors of 0.1 m and 0.05 m/s, whose parameters differ by 20 %
about others than those that the estimate takes for usual; leaders change their speed every 12 s or so. The sorts of
drift take turns, then none. ``tell`` sees them as it sees a file; with ``--alone`` only the sort that is hidden is
estimated, on sets with drift, which is a fifth of the work; ``--steady`` takes the sets without drift. "Foreseen" is
the median error that the sets' own intervals speak for. One line of JSON per set is kept, all kinds in one file if need
be, so that a run goes on where it stopped.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)
import polars as pl  # noqa: E402
import torch  # noqa: E402
from scipy.stats import t as student  # noqa: E402

from benchmarks import command, rows_of, table  # noqa: E402
from idm_env.data import Trajectories, episodes  # noqa: E402
from idm_env.drift.estimate import estimate, usual  # noqa: E402
from idm_env.drift.kinds import behind_a_record, tell  # noqa: E402
from idm_env.drift.linear import stacked  # noqa: E402
from idm_env.effects import DRIFTS, AccelNoise, Effect, PerceptionNoise, Wander  # noqa: E402
from idm_env.fitting.problem import IDM_NAMES  # noqa: E402
from idm_env.jobs.progress import OnProgress, silent  # noqa: E402
from idm_env.jobs.workers import HERE, Workers  # noqa: E402
from idm_env.types import Record  # noqa: E402

DT, SECONDS, DRIVERS = 0.2, 90.0, 20
MEDIAN = 0.674
"""Median error over the standard deviation, where errors are normal."""
GAP_NOISE, SPEED_NOISE = 0.1, 0.05
CENTRE, SPREAD = np.log([1.4, 1.8, 1.3, 2.2, 30.0]), np.array([0.2, 0.2, 0.2, 0.2, 0.1])
HIDDEN: tuple[tuple[Effect, float, float], ...] = (
    (Wander(), 0.25, 15.0),
    (AccelNoise(), 0.2, 3.0),
    (PerceptionNoise(), 0.1, 10.0),
    (Wander(of="desired_speed"), 0.2, 20.0),
    (Wander(), 0.0, 15.0),
)
"""Drift, σ and τ (s); σ of a set is up to a half more or less."""


def leaders(random: np.random.Generator, steps: int, drivers: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, speed and acceleration [steps + 1, drivers] of vehicles that now and then want another speed."""
    fine, every = 0.025, round(DT / 0.025)
    speed = random.uniform(8.0, 16.0, drivers)
    position, accel, target = np.zeros(drivers), np.zeros(drivers), speed.copy()
    samples = [(position, speed, accel)]
    for k in range(steps * every):
        target = np.where(random.random(drivers) < fine / 12.0, random.uniform(3.0, 22.0, drivers), target)
        accel = accel + fine * (np.clip((target - speed) / 2.5, -2.5, 1.3) - accel)
        faster = np.maximum(speed + accel * fine, 0.0)
        position, speed = position + 0.5 * fine * (speed + faster), faster
        if (k + 1) % every == 0:
            samples.append((position, speed, accel))
    columns = [np.array(x) for x in zip(*samples, strict=True)]
    return columns[0], columns[1], columns[2]


def made(
    seed: int, drift: Effect, sigma: float, memory_time: float, drivers: int = DRIVERS, seconds: float = SECONDS
) -> Trajectories:
    """Return the trajectories of a set."""
    random, simulator = np.random.default_rng(seed), behind_a_record(DT, drift)
    theta = CENTRE + SPREAD * random.normal(size=(drivers, len(CENTRE)))
    params = simulator.defaults(dtype=torch.float64)
    for i, name in enumerate(IDM_NAMES):
        params["idm"][name.removeprefix("idm.")] = torch.tensor(np.exp(theta[:, i])).unsqueeze(-1)
    params[drift.name] = {"sigma": torch.tensor(sigma).double(), "memory_time": torch.tensor(memory_time).double()}
    steps = round(seconds / DT)
    x, v, a = leaders(random, steps, drivers)
    gap = np.exp(theta[:, 3]) + v[0] * np.exp(theta[:, 2])
    both = [torch.tensor(np.stack((y, np.zeros_like(y)), -1)) for y in (x, v, a)]
    record = Record(*(y[1:] for y in both), torch.tensor([True, False]).expand(steps, drivers, 2))
    position = torch.tensor(np.stack((x[0], x[0] - 5.0 - gap), -1))
    start = simulator.state(position, torch.tensor(np.stack((v[0], v[0]), -1)), params, accel=both[2][0], seed=seed)
    _, motion = simulator.rollout(start, {"replay": record}, params, steps, seed=seed + 1)
    tables = []
    for i in range(drivers):
        for vehicle in (0, 1):
            noise = vehicle * random.normal(size=(2, steps))
            measured = motion.gap[:, i, 1].numpy() + GAP_NOISE * noise[0] if vehicle else np.full(steps, np.nan)
            tables.append(pl.DataFrame({
                "run_id": f"{i:02d}", "vehicle_id": vehicle, "leader_id": [0 if vehicle else None] * steps,
                "time_s": DT * np.arange(1, steps + 1), "position_m": motion.position[:, i, vehicle].numpy(),
                "speed_mps": np.maximum(motion.speed[:, i, vehicle].numpy() + SPEED_NOISE * noise[1], 0.0),
                "length_m": 5.0, "gap_m": measured,
            }, schema_overrides={"leader_id": pl.Int64}))  # fmt: skip
    table = pl.concat(tables).with_columns(pl.col("gap_m").fill_nan(None))
    return Trajectories.from_frame(table, source=f"set {seed}")


Part = tuple[int, bool, int, float]
"""Seed, whether only what is hidden is estimated, drivers, and seconds of each."""


def scored(part: Part, on_progress: OnProgress = silent) -> dict[str, Any]:
    """Return what ``tell`` says of a set, beside what is hidden in it; alone: the estimate of what is hidden."""
    seed, only_hidden, drivers, seconds = part
    drift, sigma, memory_time = HIDDEN[seed % len(HIDDEN)]
    sigma *= float(np.exp(np.random.default_rng(seed).uniform(-0.4, 0.4)))
    begin, trajectories = time.process_time(), made(seed, drift, sigma, memory_time, drivers, seconds)
    smooth, measured = list(episodes(trajectories, smooth=True)), list(episodes(trajectories))
    row: dict[str, Any] = {
        "key": key(part), "seed": seed, "drivers": drivers, "hidden": drift.name if sigma else "none",
        "sigma": sigma, "memory_time": memory_time, "one_of": None, "gain": {},
    }  # fmt: skip
    if only_hidden:
        batch, raw = (stacked(x) for x in (smooth, measured))
        estimates = estimate(behind_a_record(batch.step, drift), batch, IDM_NAMES, usual(IDM_NAMES), measured=raw)
    else:
        drift_of_set = tell(smooth, measured, DRIFTS)
        estimates, row["one_of"], row["gain"] = drift_of_set.found[drift.name], drift_of_set.one_of, drift_of_set.gain
    rows = {str(r["name"]): r for r in estimates.table()}
    row["estimates"] = [rows[f"{drift.name}.{key}"] for key in ("sigma", "memory_time")]
    return row | {"cpu_s": time.process_time() - begin}


def key(part: Part) -> str:
    """Return what a set is called in the file of results."""
    seed, only_hidden, drivers, seconds = part
    size = "" if (drivers, seconds) == (DRIVERS, SECONDS) else f"|{drivers} drivers of {seconds:g} s"
    return f"{seed}{size}|alone" if only_hidden else f"{seed}{size}"


def shown(sets: list[dict[str, Any]]) -> str:
    """Return what came out, by sort and of all."""
    head = ("hidden", "sets", "right name alone", "among those named",
            "sigma: median error (foreseen); estimate / true, median; covered", "tau: the same")  # fmt: skip
    lines = []
    drifting = [s for s in sets if s["hidden"] != "none"]
    for name in dict.fromkeys([*(s["hidden"] for s in drifting), "all"]):
        rows = [s for s in drifting if name in (s["hidden"], "all")]
        complete = [s for s in rows if s["one_of"] is not None]
        single, among = (
            sum(s["one_of"] == [s["hidden"]] for s in complete),
            sum(s["hidden"] in s["one_of"] for s in complete),
        )
        texts = [str(single), str(among)] if complete else ["–", "–"]
        texts += [recovered(rows, i, number) for i, number in enumerate(("sigma", "memory_time"))]
        lines.append([name, str(len(rows)), *texts])
    steady = [not s["one_of"] for s in sets if s["hidden"] == "none"]
    if steady:
        lines.append(["none", str(len(steady)), str(sum(steady)), "–", "–", "–"])
    return "\n".join([table(head, lines), f"CPU seconds per set, median: {np.median([s['cpu_s'] for s in sets]):.0f}"])


def recovered(rows: list[dict[str, Any]], i: int, number: str) -> str:
    """Return how well a number, the estimate ``i``, is known of sets: error, foreseen error, ratio and coverage."""
    if not rows:
        return "–"
    ratio = np.array([r["estimates"][i]["estimate"] / r[number] for r in rows])
    inside = [r["estimates"][i]["low"] <= r[number] <= r["estimates"][i]["high"] for r in rows]
    width = [0.5 * math.log(r["estimates"][i]["high"] / r["estimates"][i]["low"]) for r in rows]
    reach = [float(student.ppf(0.975, r.get("drivers", DRIVERS) - 1)) for r in rows]
    foreseen = MEDIAN * np.median(np.array(width) / reach)
    error = np.median(np.abs(ratio - 1.0))
    return f"{100 * error:.0f} % ({100 * foreseen:.0f} %); {np.median(ratio):.2f}; {sum(inside)} of {len(rows)}"


def main(
    sets: int = 60, first_seed: int = 1000, out: Path = Path("drift_sets.jsonl"), drivers: int = DRIVERS,
    seconds: float = SECONDS, alone: bool = False, steady: bool = False, place: Workers = HERE,
) -> None:  # fmt: skip
    """Run the sets that are not there yet, and print the table.

    Args:
        sets: How many, those of other seeds left out by ``alone`` and ``steady`` included.
        first_seed: Of the first set.
        out: File of rows.
        drivers: Of a set.
        seconds: Of every driver.
        alone: Estimate only what is hidden, on sets with drift.
        steady: Only sets without drift, a fifth of them.
        place: Where sets are worked on.
    """
    if alone and steady:
        raise SystemExit("error: --alone and --steady leave no set. Give one of them.")
    seeds: Sequence[int] = range(first_seed, first_seed + sets)
    if alone or steady:
        seeds = [s for s in seeds if bool(HIDDEN[s % len(HIDDEN)][1]) == alone]
    parts = {key(part): part for part in ((s, alone, drivers, seconds) for s in seeds)}
    print(shown(rows_of(scored, parts, out, place, "key", lambda row: f"{row['hidden']}, told {row['one_of']}")))


if __name__ == "__main__":
    command(main)
