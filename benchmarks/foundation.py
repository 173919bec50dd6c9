"""The foundation's figures: the published I-80 benchmark, fits of all its pairs, and recovery of known drivers.

``python -m benchmarks.foundation [--data FOLDER] [--out FILE.json]``; the measured files are described in the README.
Times are CPU seconds of this process and wall seconds beside them.
"""

from __future__ import annotations

import json
import os
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import DATA, command, table
from idm_env.data import Episodes, episodes, load, synthetic
from idm_env.effects import IDM, Brakes, Replay, make
from idm_env.fitting.batch import Batch
from idm_env.fitting.evaluate import errors, pooled_errors
from idm_env.fitting.fit import Fit, fit
from idm_env.fitting.problem import IDM_NAMES, Problem, group_of
from idm_env.roads import Lane
from idm_env.simulator import Simulator

PUBLISHED = [1.206, 1.5, 1.590, 2.262, 34.9]
NAMES = tuple(name.split(".")[1] for name in IDM_NAMES)


def judge(items: Episodes, found: Fit) -> dict[str, float]:
    """Return the errors of a pooled fit on other episodes."""
    return pooled_errors(found.problem, found.own, found.shared, items).summary()


def published(items: Episodes) -> dict[str, float]:
    """Return the errors of the published parameters."""
    batch = Batch.stack(items, substeps=1)
    group, names = group_of(batch.episodes, "all")
    simulator = Simulator(Lane(), (IDM(), Replay(), Brakes()), dt=batch.step)
    problem = Problem(simulator, batch, IDM_NAMES, (), group, names)
    own = torch.tensor([PUBLISHED], dtype=torch.float64)
    return errors(problem, own, own[0, :0])[0].summary()


def benchmark(folder: Path) -> list[dict[str, Any]]:
    """Judge published parameters, pooled fits on spacing and speed, and pooled fits with one effect added."""
    trajectories = load(folder / "ngsim_i80_pairs.parquet").where("in_manifest=true")
    training, test = (episodes(part, max_gap=None) for part in trajectories.split("split=test"))
    rows = [{"model": "IDM, published parameters", **published(test)}]
    base = None
    for objective in ("spacing", "speed"):
        begin = time.process_time()
        result = fit(training, by="all", objective=objective)  # type: ignore[arg-type]
        rows.append(
            {"model": f"IDM, fitted on {objective}", **judge(test, result), "cpu_s": time.process_time() - begin}
        )
        base = base or result
    assert base is not None
    for name in ("asymmetry", "delay", "leader_acceleration", "speed_dependent_gap"):
        begin = time.process_time()
        effect = make(name)
        strength = f"{name}.{effect.parameters[0].name}"
        simulator = Simulator(Lane(), (IDM(), Replay(), Brakes(), effect))
        first = torch.tensor([[(*effect.parameters[0].starts, 0.0)[0]]], dtype=torch.float64)
        start = (torch.cat((base.own, first), dim=-1), base.shared)
        result = fit(
            training, by="all", simulator=simulator, free=(*IDM_NAMES, strength), start=start, substeps=1, iterations=15
        )
        value = f"{strength} = {result.own[0, -1].item():.3f} {effect.parameters[0].unit}"
        rows.append({"model": f"IDM + {value}", **judge(test, result), "cpu_s": time.process_time() - begin})
    return rows


def all_pairs(folder: Path) -> dict[str, Any]:
    """Fit every driver of all 228 pairs by Levenberg-Marquardt, from four starts each."""
    items = episodes(load(folder / "ngsim_i80_pairs.parquet"), max_gap=None)
    cpu, wall = time.process_time(), time.perf_counter()
    result = fit(items, by="driver")
    used = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
    error, _ = errors(result.problem, result.own, result.shared)
    return {"drivers": len(items), **used, **error.summary(), "converged": int(result.converged.sum())}


def recovery() -> list[dict[str, Any]]:
    """Fifty generated drivers of 120 s with 5 cm of position noise: errors and coverage of the 95 % intervals."""
    trajectories, truth = synthetic.generate(17, runs=10, followers=5, seconds=120.0, noise=0.05)
    result = fit(episodes(trajectories, max_gap=None, smooth=True), loss="mse")
    drivers = {f"{r['run_id']}/{r['vehicle_id']}": r for r in truth.drivers.to_dicts()}
    values = np.array([[drivers[g][n] for n in NAMES] for g in result.problem.groups])
    estimate, error = result.values().numpy(), result.uncertainty.standard_error.numpy()
    identified = result.uncertainty.identified.numpy()
    return [
        {
            "parameter": name,
            "identified": int(identified[:, i].sum()),
            "median_relative_error": float(np.median(np.abs(estimate[:, i] / values[:, i] - 1.0)[identified[:, i]])),
            "coverage_of_95": float((np.abs(estimate[:, i] - values[:, i]) < 1.96 * error[:, i]).mean()),
        }
        for i, name in enumerate(NAMES)
    ]


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """Print rows as a Markdown table."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = ((row.get(name, "") for name in names) for row in rows)
    texts = ([f"{c:.4g}" if isinstance(c, float) else str(c) for c in row] for row in cells)
    print(f"\n## {title}\n\n{table(names, texts)}")


def main(data: Path = DATA, out: Path | None = None) -> None:
    """Print the tables.

    Args:
        data: Folder of the measured files.
        out: Also write them as JSON.
    """
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {time.strftime('%Y-%m-%d')}")
    result: dict[str, Any] = {"recovery": recovery()}
    show("50 generated drivers, 120 s, 5 cm of noise", result["recovery"])
    if (data / "ngsim_i80_pairs.parquet").exists():
        result["all_pairs"] = all_pairs(data)
        show("All 228 I-80 pairs, per driver", [result["all_pairs"]])
        result["benchmark"] = benchmark(data)
        show("I-80 benchmark: 100 training pairs, judged on 20 test pairs", result["benchmark"])
    else:
        print(f"\n{data} has no ngsim_i80_pairs.parquet: the measured tables are left out.")
    if out:
        out.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    command(main)
