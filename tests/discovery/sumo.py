"""Platoons that SUMO drives: data for discovery from a simulator that nobody here wrote.

One straight lane per run; the first vehicle is given a speed profile, the others follow by SUMO's IDM, which acts on
the state of one step earlier and does not react to the slope of the road.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.bench.peers import straight
from idm_env.data import Trajectories, scripted

STEP, LENGTH = 0.1, 4.5


def platoons(
    seed: int, *, slope: float = 0.0, decides_every: float = STEP, runs: int = 8, followers: int = 2,
    seconds: float = 120.0, noise: float = 0.05,
) -> Trajectories:  # fmt: skip
    """Return measured platoons on a road as steep as ``slope`` at most, of drivers who decide so often (s).

    ``noise`` is the white noise of positions (m); speeds are measured to 0.02 m/s.
    """
    import libsumo

    random = np.random.default_rng(seed)
    steps = round(seconds / STEP)
    fine = scripted.leaders(random, runs, 4 * steps + 1, STEP / 4, 24.0)
    tables = []
    for run in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            libsumo.start(["sumo", *_files(Path(folder), random, slope, decides_every, followers)])
            try:
                tables.append(_drive(libsumo, fine.speed[::4, run], followers, steps, f"run{run}"))
            finally:
                libsumo.close()
    rows = runs * steps * (followers + 1)
    table = pl.concat(tables).with_columns(
        position_m=pl.col("position_m") + pl.Series(noise * random.standard_normal(rows)),
        speed_mps=(pl.col("speed_mps") + pl.Series(0.02 * random.standard_normal(rows))).clip(lower_bound=0.0),
    )
    return Trajectories.from_frame(table, source=f"SUMO, seed {seed}")


def _drive(libsumo: Any, speed: np.ndarray, followers: int, steps: int, run: str) -> pl.DataFrame:
    names = ["v0", *(f"v{i + 1}" for i in range(followers))]
    rows: dict[str, list[Any]] = {k: [] for k in ("run_id", "vehicle_id", "time_s", "position_m", "speed_mps")}
    libsumo.simulationStep()
    libsumo.vehicle.setSpeedMode("v0", 0)
    for k in range(steps):
        libsumo.vehicle.setSpeed("v0", float(speed[k]))
        libsumo.simulationStep()
        for name in names:
            rows["run_id"].append(run)
            rows["vehicle_id"].append(name)
            rows["time_s"].append(k * STEP)
            rows["position_m"].append(libsumo.vehicle.getLanePosition(name))
            rows["speed_mps"].append(libsumo.vehicle.getSpeed(name))
    return pl.DataFrame(rows).with_columns(length_m=pl.lit(LENGTH))


def _files(folder: Path, random: np.random.Generator, slope: float, decides_every: float, followers: int) -> list[str]:
    net, routes = folder / "net.xml", folder / "routes.xml"
    x = np.linspace(0.0, 8000.0, 321)
    height = slope * 730.0 / (2 * np.pi) * (1.0 - np.cos(2 * np.pi * x / 730.0))
    net.write_text(straight(float(x[-1]), 60.0, height.tolist()))
    types = [f'<vType id="t0" length="{LENGTH}" accel="10" decel="10" maxSpeed="60" minGap="0" tau="0.1"/>']
    cars = ['<vehicle id="v0" type="t0" route="r" depart="0" departPos="200" departSpeed="10"/>']
    for i in range(1, followers + 1):
        draw = np.exp(0.15 * random.standard_normal(5))
        types.append(
            f'<vType id="t{i}" carFollowModel="IDM" length="{LENGTH}" accel="{1.4 * draw[0]:.3f}"'
            f' decel="{2.0 * draw[1]:.3f}" tau="{1.3 * draw[2]:.3f}" minGap="{2.0 * draw[3]:.3f}"'
            f' maxSpeed="{30.0 * draw[4] ** 0.5:.3f}" speedDev="0" actionStepLength="{decides_every}"/>'
        )
        cars.append(
            f'<vehicle id="v{i}" type="t{i}" route="r" depart="0" departPos="{200 - 25 * i}" departSpeed="10"'
            ' insertionChecks="none"/>'
        )
    routes.write_text(f'<routes>{"".join(types)}<route id="r" edges="ab"/>{"".join(cars)}</routes>')
    return [
        "-n", str(net), "-r", str(routes), "--step-length", str(STEP), "--step-method.ballistic", "--no-step-log",
        "--no-warnings", "--time-to-teleport", "-1", "--max-depart-delay", "-1", "--collision.action", "none",
    ]  # fmt: skip
