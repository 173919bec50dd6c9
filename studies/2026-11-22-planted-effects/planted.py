"""Is what ``explain`` says "would have been found" found? Effects planted into simulations of the fitted drivers.

    python -m benchmarks.planted [FILE --where acc_run=ACC] [--times 1,0.5] [--repeats 2] [--out planted.jsonl]

Without a file, a generated set without an effect (``--seed``, ``--ou``, ``--runs``). ``explain`` fits its drivers and
says of every effect which strength it would have found: four times in five by lines, times ``BEYOND_LINES``. Then the
drivers are simulated behind their measured leaders with that strength (times ``--times``) of the effect, with
measurement noise, and with their own drift: what every driver's measured acceleration has beside the model as fitted to
predictions of 5 s, begun at a random time of the record. ``explain`` sees the result as it sees a file. Effects of
which no strength would have been found are left out, and named. Beside what is found stands what is told: an effect
that passes the test, and is refused because an error on the runs kept back rises, is ``unexplained`` by name, and no
``none``. One line of JSON per set is kept, so that a run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)
import polars as pl  # noqa: E402
import torch  # noqa: E402
from torch import Tensor  # noqa: E402

from benchmarks import workers  # noqa: E402
from idm_env.data import Trajectories, episodes, load, noise_sigma, synthetic  # noqa: E402
from idm_env.data.samples import VEHICLES  # noqa: E402
from idm_env.discovery import Discovery, discover, judge  # noqa: E402
from idm_env.effects import ALL, Brakes, Effect, Noise, Replay, make  # noqa: E402
from idm_env.fitting.batch import Batch  # noqa: E402
from idm_env.progress import OnProgress, silent  # noqa: E402
from idm_env.roads import Lane  # noqa: E402
from idm_env.simulator import Simulator  # noqa: E402
from idm_env.types import Params  # noqa: E402
from idm_env.types import Record as Replayed  # noqa: E402

DRIVER = VEHICLES.index("driver")


@cache
def drivers(found: Discovery) -> Tensor:
    """Return every driver's own parameters [groups, P] as predictions of 5 s fit them.

    Not those of free simulation, which drift bends: what is then left of the measured accelerations answers to the
    scene, and at another time of the record it is noise, which made errors 5 s ahead 1.3 to 1.8 times as large.
    """
    return torch.from_numpy(np.exp(judge.windowed(found.records, found.task, found.null)[1].theta))


def behind(found: Discovery, *effects: Effect) -> tuple[Simulator, Params]:
    """Return the fitted drivers behind a record, a row per episode, with effects and an acceleration that is given."""
    records, law = found.records, found.null.model.catalogue.base
    theta = drivers(found)[records.group]
    simulator = Simulator(
        Lane(), (law, *effects, Noise(), Replay(), Brakes()), dt=records.dt, integration="midpoint"
    )  # fmt: skip
    params = simulator.defaults(dtype=torch.float64)
    params[law.name] = {p.name: theta[:, [i]] for i, p in enumerate(law.declared)}
    params["noise"] = {"sigma": torch.ones((), dtype=torch.float64)}
    return simulator, params


def beside_the_model(found: Discovery, batch: Batch) -> Tensor:
    """Return what measured accelerations (m/s²) have beside the fitted drivers' [steps, rows], each step by itself."""
    simulator, params = behind(found)
    at, driver = batch.columns(simulator)
    steps, rows = batch.steps, len(batch)

    def flat(x: Tensor) -> Tensor:
        return x.reshape(steps * rows, *x.shape[2:])

    each = {n: {k: x.repeat(steps, 1) if x.dim() else x for k, x in p.items()} for n, p in params.items()}
    state = simulator.state(
        flat(batch.position[:-1, :, at]), flat(batch.all_speed[:-1, :, at]), each,
        length=batch.length[:, at].repeat(steps, 1), accel=flat(batch.accel[:-1, :, at]),
    )  # fmt: skip
    there = [flat(x[1:, :, at]).unsqueeze(0) for x in (batch.position, batch.all_speed, batch.accel)]
    active = torch.arange(there[0].shape[-1]) != driver
    position, velocity, accel = there
    record = Replayed(position, velocity, accel, active.expand_as(position))
    inputs = {"replay": record, "noise": torch.zeros_like(position)}
    _, kept = simulator.rollout(state, inputs, each, 1)
    speed = batch.all_speed[..., at][..., driver]
    return (speed[1:] - kept.speed[0, :, driver].reshape(steps, rows)) / batch.dt


def planted(found: Discovery, noise: tuple[float, float], effect: Effect, numbers: dict[str, float], seed: int,
            turned: bool = True) -> Trajectories:  # fmt: skip
    """Return trajectories of the fitted drivers with the effect, each behind copies of the measured vehicles.

    Args:
        found: A discovery on the measured data.
        noise: Standard deviations of measured positions (m) and speeds (m/s).
        effect: What is planted.
        numbers: Its parameters.
        seed: Of drift and noise.
        turned: Whether the drift begins at a random time; else the drivers do again what they did.
    """
    random, batch = np.random.default_rng(seed), Batch.of(found.records.episodes, substeps=1)
    simulator, usual = behind(found, effect)
    own_params = {n: torch.tensor(x, dtype=torch.float64) for n, x in numbers.items()}
    params = {**usual, effect.name: own_params}
    at, driver = batch.columns(simulator)
    own = beside_the_model(found, batch)
    added = torch.zeros(batch.steps, len(batch), batch.position[:, :, at].shape[-1], dtype=torch.float64)
    for i, episode in enumerate(batch.episodes):
        count = len(episode) - 1
        added[:count, i, driver] = own[:count, i].roll(int(random.integers(count)) if turned else 0)
    inputs = {**batch.inputs(simulator.without("noise")), "noise": added}
    _, kept = simulator.rollout(batch.start(simulator, params), inputs, params, batch.steps)
    tables = []
    for i, episode in enumerate(batch.episodes):
        first, count = batch.position[0, i, DRIVER] - episode.position_m[0], len(episode)
        simulated = [torch.cat((x[:1, i, DRIVER], y[: count - 1, i, driver])).numpy()
                     for x, y in ((batch.position, kept.position), (batch.all_speed, kept.speed))]  # fmt: skip
        simulated[0] = simulated[0] - float(first)
        around = [getattr(episode, name) for name in VEHICLES]
        names = [None, *(f"{i}-{v}" for v in range(len(VEHICLES)))]
        for v, one in enumerate(around):
            position, speed = simulated if v == DRIVER else (one.position_m, one.speed_mps)
            there = np.ones(count, bool) if v == DRIVER else one.present
            tables.append(pl.DataFrame({
                "run_id": episode.run_id, "vehicle_id": names[v + 1], "leader_id": [names[v]] * count,
                "time_s": episode.time_s, "position_m": position + noise[0] * random.standard_normal(count),
                "speed_mps": np.maximum(speed + noise[1] * random.standard_normal(count), 0.0),
                "length_m": float(one.length_m),
            }, schema_overrides={"leader_id": pl.String}).filter(pl.Series(there)))  # fmt: skip
    followers = frozenset((e.run_id, f"{i}-{DRIVER}") for i, e in enumerate(batch.episodes))
    return replace(Trajectories.from_frame(pl.concat(tables), source=f"planted, seed {seed}"), drivers=followers)


def parameters(found: Discovery, name: str) -> dict[str, float]:
    """Return an effect's parameters as the strength was told of: as the first round fitted them."""
    at = next(s for s in found.rounds[0].scored if s.term.label == name)
    assert at.solution is not None
    values = at.solution.values[at.solution.model.where(name)]
    return {p.name: float(x) for p, x in zip(at.term.parameters, values, strict=True)}


@cache
def fitted(seed: int, ou: float, runs: int, file: Path | None, where: tuple[str, ...]
           ) -> tuple[Discovery, tuple[float, float]]:  # fmt: skip
    """Return what ``explain`` finds on the data themselves, and the noise of their positions (m) and speeds (m/s)."""
    trajectories = synthetic.generate(seed, ou=ou, runs=runs)[0] if file is None else load(file)
    trajectories = trajectories.where(where)
    raw = list(episodes(trajectories))
    noise = [float(np.median([noise_sigma(x) for x in each])) for each in (
        [e.position_m for e in raw], [e.speed_mps for e in raw],
    )]  # fmt: skip
    return discover(trajectories), (noise[0], noise[1])


def measure(job: tuple[str, float, int, tuple[Any, ...]], on_progress: OnProgress = silent) -> dict[str, Any]:
    """Plant an effect and say what ``explain`` makes of it."""
    name, times, _, data = job
    found, noise = fitted(*data)
    said = next(e for e in found.report["excluded"] if e["effect"] == name)
    effect = make(name)
    own = next(p for p in effect.parameters if p.name == said["parameter"])
    null = own.null or 0.0
    away = 1.0 if own.default > null else -1.0
    strength = null + away * times * said["would_be_found"]
    begin, seed = time.process_time(), zlib.crc32(key(job).encode())
    numbers = parameters(found, name) | {own.name: strength}
    report = discover(planted(found, noise, effect, numbers, seed)).report
    names = [f["effect"] or f["label"] for f in report["found"]]
    others = [n for f in report["found"] for n in f["equivalent"]]
    alike = {name} | ({"delay", "lag"} if name in ("delay", "lag") else set())
    # What errors on runs kept back have refused stands in the report, too: no "none" comes out.
    partial = report["partial"] or {"terms": []}
    refused = {t["effect"] for t in partial["terms"]} if report["verdict"] == "unexplained" else set()
    first = next((c for c in report["candidates"] if c["effect"] == name), None)
    return {
        "key": key(job), "effect": name, "times": times, "strength": strength, "would": said["would_be_found"],
        "verdict": report["verdict"], "why": report["reason"], "found": names,
        "right": bool(alike & {*names, *others}), "told": bool(alike & {*names, *others, *refused}),
        "first": first and {k: first[k] for k in ("p_value", "held_out_gain")},
        "ratio": {k: h["ratio"] for k, h in report["helps"].items()},
        "before": report["error"]["before"], "measured": found.report["error"]["before"],
        "cpu_s": time.process_time() - begin,
    }  # fmt: skip


def told(excluded: list[dict[str, Any]], only: list[str]) -> tuple[list[str], list[str]]:
    """Return which effects, of ``only`` where not empty, would have been found, and which at no strength."""
    asked = [e for e in excluded if ALL[e["effect"]].sought == "anywhere" and e["effect"] in (only or ALL)]
    seen = [e["effect"] for e in asked if e["would_be_found"] is not None]
    return seen, [e["effect"] for e in asked if e["effect"] not in seen]


def key(job: tuple[str, float, int, tuple[Any, ...]]) -> str:
    """Return what a set is called in the file of results."""
    name, times, number, (seed, ou, runs, file, where) = job
    return "|".join(map(str, (name, times, number, file or (seed, ou, runs), *where)))


def table(rows: list[dict[str, Any]]) -> str:
    """Return by effect and strength how often it was found, and how often found or refused by name."""
    times = sorted({r["times"] for r in rows}, reverse=True)
    lines = [" | ".join(["planted", *(f"{t:g} times what is said: found, or told" for t in times)])]
    lines.append(" | ".join(["---"] * (1 + len(times))))
    for name in [*dict.fromkeys(r["effect"] for r in rows), "all"]:
        cells = []
        for t in times:
            mine = [r for r in rows if r["times"] == t and name in (r["effect"], "all")]
            usual = float(np.median([abs(r["would"] * t) for r in mine])) if name != "all" and mine else None
            found, seen = (sum(r[which] for r in mine) for which in ("right", "told"))
            cells.append(f"{found}, {seen} of {len(mine)}" + (f" ({usual:.2g})" if usual else ""))
        lines.append(" | ".join([name, *cells]))
    return "\n".join(lines)


def main() -> None:
    """Run the sets that are not there yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--where", action="append", default=[])
    parser.add_argument("--times", default="1,0.5", help="strengths, in units of what is said to be found")
    parser.add_argument("--effects", default="", help="names; default: all of which a strength is said")
    parser.add_argument("--repeats", type=int, default=2, help="sets of every effect and strength")
    parser.add_argument("--seed", type=int, default=4242, help="of the generated set; every repetition its own")
    parser.add_argument("--ou", type=float, default=0.1)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("planted.jsonl"))
    workers.add(parser)
    arguments = parser.parse_args()
    # Rows of before 2026-11-22 are of drivers simulated in another way.
    done = {name: row for name, row in workers.kept(arguments.out, "key").items() if "told" in row}
    wanted = []
    for number in range(arguments.repeats):
        seed = arguments.seed + number if arguments.file is None else arguments.seed
        data = (seed, arguments.ou, arguments.runs, arguments.file, tuple(arguments.where))
        names, hidden = told(fitted(*data)[0].report["excluded"], [n for n in arguments.effects.split(",") if n])
        if hidden:
            print(f"set {number}: not planted, as seen at no strength: {', '.join(hidden)}", file=sys.stderr)
        wanted += [(n, float(t), number, data) for n in names for t in arguments.times.split(",")]
    missing = [job for job in wanted if key(job) not in done]
    for row in workers.rows(measure, missing, arguments.out, arguments):
        done[row["key"]] = row
        print(f"{row['key']}: {row['verdict']} {row['found']}", file=sys.stderr, flush=True)
    print(table([done[key(job)] for job in wanted]))


if __name__ == "__main__":
    main()
