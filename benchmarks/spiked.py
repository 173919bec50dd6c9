"""What discovery says of measured driving to which an effect was added, at 0, ½, 1 and 2 times its usual strength.

    python -m benchmarks.spiked --data ../shared/data --sets 1 --clean 10 --out spiked.jsonl [--only "I-80"]

IDM is fitted to every measured driver in windows of 5 s. What his measured acceleration has beside it, step by step,
is his own residual: blocks of it in another order push the fitted driver behind his measured leader, with the effect
added. Residuals are cut at three times the driver's usual one: in a few states IDM brakes by far too hard, which moved
elsewhere would be kicks that nobody gave; sets ``none, whole`` have them. One line of JSON per set is kept.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import time
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)
import polars as pl  # noqa: E402
import torch  # noqa: E402
from torch import Tensor  # noqa: E402

from benchmarks import DATA, command, rows_of, table  # noqa: E402
from idm_env.data import Episode, Trajectories, episodes, load, noise_sigma  # noqa: E402
from idm_env.data.episode import windows  # noqa: E402
from idm_env.data.samples import VEHICLES  # noqa: E402
from idm_env.discovery.calibrate import POPULATION, WIDTH  # noqa: E402
from idm_env.effects import IDM, Brakes, Effect, Noise, Replay, make  # noqa: E402
from idm_env.effects.free import DriverCurve  # noqa: E402
from idm_env.fitting.batch import Batch  # noqa: E402
from idm_env.fitting.fit import base_simulator, fit  # noqa: E402
from idm_env.fitting.prior import Prior  # noqa: E402
from idm_env.jobs.workers import IN_PROCESSES, Workers  # noqa: E402
from idm_env.roads import Lane  # noqa: E402
from idm_env.simulator import Simulator  # noqa: E402
from idm_env.types import Record  # noqa: E402

SOURCES: dict[str, tuple[str, tuple[str, ...]]] = {
    "I-80": ("ngsim_i80_pairs.parquet", ()),
    "TGSIM": ("tgsim_pairs.parquet", ()),
    "AstaZero": ("openacc_astazero.parquet", ("acc_run=ACC",)),
}
"""Measured leaders and drivers: file and conditions."""
CATALOGUE = (
    "delay",
    "lag",
    "leader_acceleration",
    "gap_stiffness",
    "asymmetry",
    "brake_light",
    "memory",
    "speed_time_gap",
)
UNDECLARED: dict[str, tuple[str, tuple[float, ...], tuple[float, ...]]] = {
    "T after braking": ("braking_15s", (0.0, 1.0, 3.0), (0.0, 0.3, 0.9)),
    "T when closing in": ("closing_speed", (0.0, 1.0, 3.0), (0.0, 0.1, 0.7)),
}
"""Relative changes of T without a name: the feature, places of it, and changes there."""
TIMES = (0.5, 1.0, 2.0)
STRETCH_S, BLOCK_S, SET_S, CUT = 180.0, 8.0, 4000.0, 3.0
"""Longest stretch of a driver, length of a block of residual, vehicle seconds in a set, and usual residuals at most."""
NOTHING = ("none", "none, whole")
DRIVER = VEHICLES.index("driver")


@dataclasses.dataclass(frozen=True)
class Job:
    """One set: whose drivers, what is added, and by how much of its usual strength."""

    source: str
    effect: str
    times: float
    seed: int
    data: Path = DATA

    @property
    def key(self) -> str:
        """What the set is called in the file of results."""
        return f"{self.source}|{self.effect}|{self.times:g}|{self.seed}"


@dataclasses.dataclass(frozen=True, eq=False)
class Drivers:
    """Stretches of measured drivers, their IDM parameters [stretches, 5], and residuals (m/s²) [steps] by driver."""

    stretches: tuple[Episode, ...]
    theta: Tensor
    residuals: dict[tuple[str, str], np.ndarray]
    noise: tuple[float, float]
    """Standard deviations of measured positions (m) and speeds (m/s)."""


def behind(batch: Batch, theta: Tensor, *effects: Effect) -> tuple[Simulator, dict[str, dict[str, Tensor]]]:
    """Return the drivers of a batch behind what was recorded, with effects and an acceleration that is given."""
    simulator = Simulator(Lane(), (IDM(), *effects, Noise(), Replay(), Brakes()), dt=batch.step, integration="midpoint")
    params = {name: dict(values) for name, values in simulator.defaults(dtype=torch.float64).items()}
    params["idm"] |= {p.name: theta[:, [i]] for i, p in enumerate(IDM.declared)}
    params["noise"] = {"sigma": torch.ones((), dtype=torch.float64)}
    return simulator, params


def residuals(items: Sequence[Episode], theta: Tensor) -> list[np.ndarray]:
    """Return the acceleration (m/s²) that every episode has beside IDM, at every measured state by itself."""
    each = []
    for i, episode in enumerate(items):
        batch = Batch.stack([episode], substeps=1)
        simulator, params = behind(batch, theta[[i]])
        vehicles, driver = batch.columns(simulator)
        now, then = ([x[part, 0][:, vehicles] for x in (batch.position, batch.all_speed, batch.accel)]
                     for part in (slice(None, -1), slice(1, None)))  # fmt: skip
        state = simulator.state(now[0], now[1], params, length=batch.length[:, vehicles], accel=now[2])
        active = (torch.arange(now[0].shape[-1]) != driver).expand(1, *now[0].shape)
        record = Record(then[0][None], then[1][None], then[2][None], active)
        after, _ = simulator.rollout(state, {"replay": record, "noise": torch.zeros_like(now[0])[None]}, params, 1)
        each.append(((then[1] - after.speed)[:, driver] / batch.dt).numpy())
    return each


@cache
def drivers_of(source: str, folder: Path) -> Drivers:
    """Return the fitted drivers of a measured file."""
    file, conditions = SOURCES[source]
    return fitted(load(folder / file).where(conditions))


def fitted(trajectories: Trajectories) -> Drivers:
    """Return the drivers of trajectories: IDM by windows of 5 s, and what they do beside it."""
    raw, items = list(episodes(trajectories)), list(episodes(trajectories, smooth=True, min_seconds=12.0))
    short = windows(items, 5.0, 5.0)
    keys = dict.fromkeys((e.run_id, e.vehicle_id) for e in items)
    centre = torch.tensor([[POPULATION[p.name] for p in IDM.declared]] * len(keys), dtype=torch.float64)
    # Errors within 5 s are one: fifty samples of a metre.
    prior = Prior(centre, torch.full_like(centre, WIDTH), 7.0)
    simulator = dataclasses.replace(base_simulator(), integration="midpoint")
    drivers = fit(short, simulator=simulator, loss="mse", prior=prior, substeps=1, iterations=30)
    of_driver = {(e.run_id, e.vehicle_id): drivers.own[g] for e, g in zip(short, drivers.problem.group, strict=True)}
    theta = torch.stack([of_driver[e.run_id, e.vehicle_id] for e in items])
    by_driver: dict[tuple[str, str], list[np.ndarray]] = {}
    for e, own in zip(items, residuals(items, theta), strict=True):
        by_driver.setdefault((e.run_id, e.vehicle_id), []).append(own)
    stretches = windows(items, STRETCH_S, 60.0)
    of_stretch = torch.stack([of_driver[e.run_id, e.vehicle_id] for e in stretches])
    noise = [float(np.median([noise_sigma(x) for x in each]))
             for each in ([e.position_m for e in raw], [e.speed_mps for e in raw])]  # fmt: skip
    joined = {key: np.concatenate(parts) for key, parts in by_driver.items()}
    return Drivers(tuple(stretches), of_stretch, joined, (noise[0], noise[1]))


def added(effect: str, times: float) -> tuple[tuple[Effect, ...], dict[str, float]]:
    """Return an effect at a multiple of its usual strength, with its parameters; none for times 0."""
    if times == 0.0:
        return (), {}
    if effect in UNDECLARED:
        feature, knots, change = UNDECLARED[effect]
        return (DriverCurve(feature=feature, knots=knots),), {f"knot_{i}": times * c for i, c in enumerate(change)}
    one = make(effect)
    return (one,), {
        p.name: p.default if p.role != "strength" or p.null is None else p.null + times * (p.default - p.null)
        for p in one.parameters
    }  # fmt: skip


def driven(
    batch: Batch, theta: Tensor, push: Tensor, effects: Sequence[Effect] = (), numbers: dict[str, float] | None = None
) -> tuple[Tensor, Tensor]:
    """Return positions and speeds [samples, rows] of drivers with effects, pushed by accelerations [steps, rows]."""
    simulator, params = behind(batch, theta, *effects)
    for one in effects:
        params[one.name] = {name: torch.tensor(x, dtype=torch.float64) for name, x in (numbers or {}).items()}
    vehicles, driver = batch.columns(simulator)
    pushed = torch.zeros(batch.steps, *batch.position[0, :, vehicles].shape, dtype=torch.float64)
    pushed[..., driver] = push
    inputs = {**batch.inputs(simulator.without("noise")), "noise": pushed}
    _, motion = simulator.rollout(batch.start(simulator, params), inputs, params, batch.steps)
    first = batch.position[:1, :, DRIVER], batch.all_speed[:1, :, DRIVER]
    position, speed = (
        torch.cat((x, y[..., driver])) for x, y in zip(first, (motion.position, motion.speed), strict=True)
    )
    return position, speed


def spiked(drivers: Drivers, effect: str, times: float, seed: int, again: int = 0) -> Trajectories:
    """Return trajectories of some of the drivers with an effect, each behind his measured leader, noise as measured.

    The same drivers have other noise ``again``.
    """
    random = np.random.default_rng(seed)
    run_of = [f"{e.run_id}@{e.time_s[0] // STRETCH_S:.0f}" for e in drivers.stretches]
    chosen: list[int] = []
    for run in random.permutation(sorted(set(run_of))):
        if sum(drivers.stretches[i].seconds for i in chosen) > SET_S:
            break
        chosen += [i for i, name in enumerate(run_of) if name == run]
    random = np.random.default_rng((seed, again)) if again else random
    batch = Batch.stack([drivers.stretches[i] for i in chosen], substeps=1)
    push, block = torch.zeros(batch.steps, len(batch), dtype=torch.float64), round(BLOCK_S / batch.dt)
    for row, e in enumerate(batch.episodes):
        own = drivers.residuals[e.run_id, e.vehicle_id]
        if effect != "none, whole":
            middle = np.median(own)
            usual = 1.4826 * np.median(np.abs(own - middle))
            own = np.clip(own, middle - CUT * usual, middle + CUT * usual)
        begins = random.integers(0, len(own), batch.steps // block + 1)
        order = (begins[:, None] + np.arange(block)).ravel()[: batch.steps] % len(own)
        push[:, row] = torch.from_numpy(own[order])
    position, speed = driven(batch, drivers.theta[chosen], push, *added(effect, times))
    tables = []
    for row, (i, e) in enumerate(zip(chosen, batch.episodes, strict=True)):
        own_place = position[: len(e), row] - position[0, row] + e.position_m[0]
        for name, leader, place, its_speed, length in (
            (f"{i}-leader", None, e.leader.position_m, e.leader.speed_mps, e.leader.length_m),
            (f"{i}", f"{i}-leader", own_place.numpy(), speed[: len(e), row].numpy(), e.length_m),
        ):
            one = pl.DataFrame({
                "run_id": run_of[i], "vehicle_id": name, "leader_id": [leader] * len(e), "time_s": e.time_s,
                "position_m": place + drivers.noise[0] * random.standard_normal(len(e)),
                "speed_mps": np.maximum(its_speed + drivers.noise[1] * random.standard_normal(len(e)), 0.0),
                "length_m": float(length),
            }, schema_overrides={"leader_id": pl.String})  # fmt: skip
            tables.append(one)
    return Trajectories.from_frame(pl.concat(tables), source=f"{effect} × {times:g}, seed {seed}")


def measure(job: Job, on_progress: object = None) -> dict[str, Any]:
    """Return what discovery says of one set."""
    from idm_env.discovery import discover

    seed = zlib.crc32(job.key.encode())
    trajectories = spiked(drivers_of(job.source, job.data), job.effect, job.times, seed)
    begin, report = time.process_time(), discover(trajectories, seed=seed).report
    before, after, floor = (report["error"][name] for name in ("before", "after", "floor"))
    return {
        "key": job.key, "source": job.source, "effect": job.effect, "times": job.times,
        "verdict": report["verdict"], "why": report["reason"], "sentence": report["sentence"],
        "found": [f["effect"] or f["label"] for f in report["found"]],
        "named": [n for f in report["found"] if f["effect"] for n in (f["effect"], *f["equivalent"])],
        "law": report["models"]["model.yaml"], "before": before, "after": after, "floor": floor,
        "drivers": report["data"]["drivers"], "cpu_s": time.process_time() - begin,
    }  # fmt: skip


def shown(rows: Sequence[dict[str, Any]]) -> str:
    """Return the tables of sets in which nothing was added, and of what was, by strength."""

    def share(answers: Sequence[bool]) -> str:
        return f"{sum(answers)} of {len(answers)}"

    def errors(these: Sequence[dict[str, Any]]) -> list[str]:
        pairs = [(r["before"][k], r["after"][k] / r["before"][k]) for k in ("gap_rmse_m", "horizon_rmse_m")
                 for r in these if r["before"] and r["after"]]  # fmt: skip
        half = len(pairs) // 2
        return [f"{np.median([p[0] for p in part]):.2f}, {np.median([p[1] for p in part]):.2f}" if part else "–"
                for part in (pairs[:half], pairs[half:])]  # fmt: skip

    verdicts = ("named", "one_of", "shape", "located", "unexplained", "undecided", "none", "cannot_tell")
    lines = []
    for name in NOTHING:
        for source in (*SOURCES, "all"):
            if part := [r for r in rows if r["effect"] == name and source in (r["source"], "all")]:
                answers = [share([r["verdict"] == v for r in part]) for v in verdicts]
                lines.append([f"{name}, {source}", *answers, *errors(part)])
    ends = ("gap m, after / before", "5 s ahead m, after / before")
    nothing = table(("nothing added", *(v.replace("_", " ") for v in verdicts), *ends), lines)
    lines = []
    for effect in (*CATALOGUE, *UNDECLARED):
        for times in TIMES:
            part = [r for r in rows if (r["effect"], r["times"]) == (effect, times)]
            right = {effect} | ({"delay", "lag"} if effect in ("delay", "lag") else set())
            if part:
                names = [set(r["named"]) for r in part]
                lines.append([
                    effect, f"{times:g}", share([bool(right & n) for n in names]),
                    share([bool(n) and not right & n for n in names]),
                    share([bool(r["found"]) or r["verdict"] == "unexplained" for r in part]), *errors(part),
                ])  # fmt: skip
    return f"{nothing}\n\n{table(('added', 'times', 'named', 'another name', 'noticed', *ends), lines)}"


def main(
    data: Path = DATA, sets: int = 1, clean: int = 10, only: str = "",
    out: Path = Path("spiked.jsonl"), place: Workers = IN_PROCESSES,
) -> None:  # fmt: skip
    """Run the sets that are not there yet, and print the tables.

    Args:
        data: Folder of the measured files.
        sets: Sets of every source, effect and strength.
        clean: Sets of every source to which nothing is added.
        only: Part of the keys of the sets to run.
        out: File of rows.
        place: Where sets are worked on.
    """
    sources = [source for source, (file, _) in SOURCES.items() if (data / file).exists()]
    for source in SOURCES.keys() - sources:
        print(f"{source} is skipped: {data / SOURCES[source][0]} is missing.", file=sys.stderr)
    nothing = [Job(source, name, 0.0, n, data) for source in sources for name in NOTHING for n in range(clean)]
    hidden = [
        Job(source, effect, times, n, data)
        for n in range(sets) for source in sources for effect in (*CATALOGUE, *UNDECLARED) for times in TIMES
    ]  # fmt: skip
    # Shuffled, with as many without an effect early on as with one, so that an unfinished table is a fair one.
    order = np.random.default_rng(0).permutation
    rank = {jobs[i].key: (k + 0.5) / len(jobs) for jobs in (nothing, hidden) for k, i in enumerate(order(len(jobs)))}
    parts = {job.key: job for job in sorted((*nothing, *hidden), key=lambda job: rank[job.key]) if only in job.key}
    print(shown(rows_of(measure, parts, out, place, "key", lambda row: f"{row['verdict']} {row['found']}")))


if __name__ == "__main__":
    command(main)
