"""Platoons that SUMO drives: data for discovery from a simulator that nobody here wrote.

One straight lane per run; the first vehicle is given a speed profile, the others follow by one of SUMO's models. SUMO's
documentation says of them that EIDM and KraussPS react to the slope of the road and IDM does not;
``actionStepLength`` makes drivers decide rarely, which is a latency; ``speedFactor`` spreads desired speeds. Its IDM
acts on the state of one step earlier.

    python -m benchmarks.sumo_sets --sets 2 [--executor processes]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks import workers
from idm_env.bench.peers import straight_lane
from idm_env.data import Trajectories, scripted
from idm_env.progress import OnProgress, silent

STEP = 0.1
LENGTH = 4.5


@dataclasses.dataclass(frozen=True)
class Case:
    """What the followers are: SUMO's model, further attributes of the vehicle type, steepest slope of the road."""

    model: str
    attributes: dict[str, float] = dataclasses.field(default_factory=dict)
    slope: float = 0.0
    speed_spread: float = 0.0


CASES = {
    "IDM": Case("IDM"),
    "IDM, spread of speed factors": Case("IDM", speed_spread=0.1),
    "IDM on slopes": Case("IDM", slope=0.04),
    "IDM, decides every 0.5 s": Case("IDM", {"actionStepLength": 0.5}),
    "IDM, decides every 1 s": Case("IDM", {"actionStepLength": 1.0}),
    "EIDM": Case("EIDM", {"sigmaerror": 0.0, "sigmaleader": 0.0, "sigmagap": 0.0}),
    "EIDM on slopes": Case("EIDM", {"sigmaerror": 0.0, "sigmaleader": 0.0, "sigmagap": 0.0}, slope=0.04),
    "KraussPS": Case("KraussPS", {"sigma": 0.0}),
    "KraussPS on slopes": Case("KraussPS", {"sigma": 0.0}, slope=0.04),
}


def platoons(
    seed: int, case: Case, *, runs: int = 10, followers: int = 3, seconds: float = 180.0, noise: float = 0.05
) -> Trajectories:
    """Return measured platoons; ModuleNotFoundError without ``libsumo``.

    ``noise`` is the white noise of positions (m); speeds are measured to 0.02 m/s.
    """
    import libsumo

    random = np.random.default_rng(seed)
    steps = round(seconds / STEP)
    fine = scripted.leaders(random, runs, 4 * steps + 1, STEP / 4, 24.0)
    tables = []
    for run in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            options = _files(Path(folder), random, case, followers)
            libsumo.start(["sumo", *options])
            try:
                tables.append(_drive(libsumo, fine.speed[::4, run], followers, steps, f"run{run}"))
            finally:
                libsumo.close()
    table = pl.concat(tables).with_columns(
        position_m=pl.col("position_m") + pl.Series(noise * random.standard_normal(runs * steps * (followers + 1))),
        speed_mps=(pl.col("speed_mps") + pl.Series(0.02 * random.standard_normal(runs * steps * (followers + 1)))).clip(
            lower_bound=0.0
        ),
    )
    return Trajectories.from_frame(table, source=f"SUMO, {case.model}, seed {seed}")


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


def _files(folder: Path, random: np.random.Generator, case: Case, followers: int) -> list[str]:
    net, routes = folder / "net.xml", folder / "routes.xml"
    x = np.linspace(0.0, 8000.0, 321)
    height = case.slope * 730.0 / (2 * np.pi) * (1.0 - np.cos(2 * np.pi * x / 730.0))
    # Speed factors act on the limit of the lane, which otherwise nobody reaches.
    limit, top = (28.0, 60.0) if case.speed_spread else (60.0, 30.0)
    straight_lane(net, float(x[-1]), limit, height.tolist())
    more = "".join(f' {k}="{v}"' for k, v in case.attributes.items())
    types = [f'<vType id="t0" length="{LENGTH}" accel="10" decel="10" maxSpeed="60" minGap="0" tau="0.1"/>']
    cars = ['<vehicle id="v0" type="t0" route="r" depart="0" departPos="200" departSpeed="10"/>']
    for i in range(1, followers + 1):
        draw = np.exp(0.15 * random.standard_normal(5))
        factor = 1.0 + case.speed_spread * random.standard_normal()
        types.append(
            f'<vType id="t{i}" carFollowModel="{case.model}" length="{LENGTH}" accel="{1.4 * draw[0]:.3f}"'
            f' decel="{2.0 * draw[1]:.3f}" tau="{1.3 * draw[2]:.3f}" minGap="{2.0 * draw[3]:.3f}"'
            f' maxSpeed="{top * draw[4] ** 0.5:.3f}" speedFactor="{factor:.3f}" speedDev="0"{more}/>'
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


def told(part: tuple[str, int, int], _: OnProgress = silent) -> dict[str, Any]:
    """Return what discovery says of one set (case, seed, number)."""
    from idm_env.discovery import discover

    name, seed, number = part
    found = discover(platoons(seed, CASES[name]), seed=number)
    error = found.report["error"]
    return {
        "case": name, "verdict": found.verdict, "found": [f["effect"] or f["label"] for f in found.report["found"]],
        "parameters": [
            {k: round(v["estimate"], 4) for k, v in list(f["parameters"].items())[:3]} for f in found.report["found"]
        ],
        "gap_rmse_m": [round(error[x]["gap_rmse_m"], 3) for x in ("before", "after", "floor")],
        "why": found.report["reason"],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=1, help="sets of every case")
    parser.add_argument("--first-seed", type=int, default=40_000)
    workers.add(parser)
    arguments = parser.parse_args()
    sets = [(name, arguments.first_seed + number, number) for name in CASES for number in range(arguments.sets)]
    with workers.of(arguments) as executor:
        for _, row in executor.map(told, sets):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
