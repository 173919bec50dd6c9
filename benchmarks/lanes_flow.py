"""Flow and lane changes over density: ours, SUMO's two models and HighwayEnv's, with the same IDM, kept row by row.

Rings of four lanes; HighwayEnv has none, and drives a stretch of 1.6 km of which the middle half counts. Its MOBIL, and
ours, have politeness 0.2, threshold 0.1 m/s² and safe deceleration 4 m/s²; SUMO's models have their own parameters.
"""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks import workers
from benchmarks.lanes_ring import DRIVER, DT, LANES, changes, traffic
from benchmarks.lanes_sumo import MODELS, sumo
from idm_env import keep
from idm_env import report as page
from idm_env.progress import OnProgress

DENSITIES = (5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
SECONDS = 300.0
KEPT = Path("out/lanes-flow.jsonl")


def ours(density: float) -> tuple[float, float]:
    """Return mean speed (m/s) and changes per vehicle and hour, over five minutes after five."""
    steps = int(SECONDS / DT)
    simulator, state, params = traffic(4, density, torch.float64, each=200)
    state, _ = simulator.rollout(state, {}, params, steps, keep=None)
    end, _ = simulator.rollout(state, {}, params, steps, keep=None)
    rate = (changes(end) - changes(state)) / state.speed.numel() / SECONDS * 3600.0
    return float((end.position - state.position).mean()) / SECONDS, rate


def highway_env(density: float, seconds: float = 60.0) -> tuple[float, float] | None:
    """Return the same of HighwayEnv's IDM and MOBIL, over the second half of a minute; None without HighwayEnv."""
    if not find_spec("highway_env"):
        return None
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.behavior import IDMVehicle

    stretch, draw = 1600.0, np.random.default_rng(1)
    road = Road(network=RoadNetwork.straight_road_network(LANES, length=6000, speed_limit=60), np_random=draw)
    count, pace = int(density * LANES * stretch / 1000.0), min(20.0, 0.5 * (1000.0 / density - 7.0))
    for i in range(count):
        place = (i // LANES + 0.4 * draw.uniform()) * 1000.0 / density
        car = IDMVehicle.make_on_lane(road, ("0", "1", i % LANES), longitudinal=place, speed=pace)
        car.target_speed = draw.uniform(25.0, 35.0)
        car.COMFORT_ACC_MAX, car.COMFORT_ACC_MIN = DRIVER["max_accel"], -DRIVER["comfort_decel"]
        # Distances are between centres there.
        car.TIME_WANTED, car.DISTANCE_WANTED = DRIVER["time_gap"], DRIVER["min_gap"] + car.LENGTH
        car.POLITENESS, car.LANE_CHANGE_MIN_ACC_GAIN, car.LANE_CHANGE_MAX_BRAKING_IMPOSED = 0.2, 0.1, 4.0
        road.vehicles.append(car)
    order = np.argsort([car.position[0] for car in road.vehicles])
    middle = [road.vehicles[i] for i in order[count // 4 : -count // 4]]
    steps, changed = int(seconds / DT), 0
    half = steps // 2
    for k in range(steps):
        if k == half:
            begin = [car.position[0] for car in middle]
        before = [car.lane_index[2] for car in middle]
        road.act()
        road.step(DT)
        changed += k >= half and sum(car.lane_index[2] != lane for car, lane in zip(middle, before, strict=True))
    way = float(np.mean([car.position[0] - x for car, x in zip(middle, begin, strict=True)]))
    time = (steps - half) * DT
    return way / time, changed / len(middle) / time * 3600.0


class Part(NamedTuple):
    """One simulator at one density (vehicles per km and lane)."""

    who: str
    density: float


WHO = ("idm_env", *(f"SUMO {model}" for model in MODELS), "HighwayEnv")


def drive(part: Part, on_progress: OnProgress) -> tuple[float, float] | None:
    """Return mean speed (m/s) and changes per vehicle and hour; None where the simulator is not installed."""
    who, density = part
    if who == "idm_env":
        return ours(density)
    if who == "HighwayEnv":
        return highway_env(density)
    found = sumo(200, density, SECONDS, who.removeprefix("SUMO "))
    return None if found is None else found[:2]


Rows = dict[str, dict[float, tuple[float, float] | None]]


def picture(found: Rows, path: Path) -> None:
    """Draw flow and change rate over density."""
    figure, axes = page.figure(1, 2, size=(9.0, 3.4))
    for name, colour in zip(WHO, ("#1e5adc", "#d1495b", "#e8a33d", "#6a6f78"), strict=True):
        known = [(d, row) for d, row in found[name].items() if row is not None]
        if known:
            at = [d for d, _ in known]
            axes[0, 0].plot(at, [v * d * 3.6 for d, (v, _) in known], "o-", ms=4, color=colour, label=name)
            axes[0, 1].plot(at, [rate for _, (_, rate) in known], "o-", ms=4, color=colour, label=name)
    axes[0, 0].set(xlabel="density (vehicles/km/lane)", ylabel="flow (vehicles/h/lane)", ylim=(0, None))
    axes[0, 1].set(xlabel="density (vehicles/km/lane)", ylabel="changes per vehicle and hour", ylim=(0, None))
    axes[0, 0].legend(frameon=False, fontsize=8)
    for axis in axes[0]:
        axis.grid(alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    keep.write(path, lambda beside: figure.savefig(beside, dpi=110))


def table(arguments: argparse.Namespace, path: Path = Path("out/lanes-flow.png")) -> None:
    """Print flow (vehicles per hour and lane) and changes per vehicle and hour, and draw them."""
    parts = {f"{name} at {density:g} /km/lane": Part(name, density) for name in WHO for density in DENSITIES}
    driven = workers.named(drive, parts, KEPT, arguments)
    found: Rows = {name: {d: driven[f"{name} at {d:g} /km/lane"] for d in DENSITIES} for name in WHO}
    print("| per km and lane | " + " | ".join(f"{name}: flow, changes" for name in WHO) + " |")
    print("| --- |" + " --- |" * len(WHO))
    for density in DENSITIES:
        cells = []
        for name in WHO:
            row = found[name][density]
            cells.append("not installed" if row is None else f"{row[0] * density * 3.6:.0f}, {row[1]:.0f}")
        print(f"| {density:g} | " + " | ".join(cells) + " |")
    picture(found, path)
    print(f"Picture: {path}; rows are kept in {KEPT}, remove it to drive them again.")
