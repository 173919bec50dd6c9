"""Other people's simulators, each used as its own documentation shows; absent ones are left out with a word."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def diffidm_layer() -> Any | None:
    """Return ``diffidm.layer.IDMLayer``, or None where it is not installed."""
    return import_module("diffidm.layer").IDMLayer if find_spec("diffidm") else None


def sumo(vehicles: int = 1000, steps: int = 500) -> dict[str, float] | None:
    """Return SUMO's vehicle updates per CPU second on one lane with its IDM; None where ``libsumo`` is not installed.

    All vehicles are on a straight edge from the first step on, one lane, Δt = 0.1 s, no output, no lane changes.
    """
    if not find_spec("libsumo"):
        return None
    libsumo = import_module("libsumo")
    with tempfile.TemporaryDirectory() as folder:
        options = _scenario(Path(folder), vehicles)
        libsumo.start(["sumo", *options])
        try:
            for _ in range(5):
                libsumo.simulationStep()
            updates, begin = 0, time.process_time()
            for _ in range(steps):
                libsumo.simulationStep()
                updates += vehicles
            taken = time.process_time() - begin
            alive = libsumo.vehicle.getIDCount()
        finally:
            libsumo.close()
    return {"vehicle_updates_per_cpu_second": updates / taken, "vehicles_at_end": float(alive)}


def straight_lane(path: Path, length: float, limit: float, heights: Sequence[float] = (0.0, 0.0)) -> None:
    """Write SUMO's network of one straight lane: length (m), speed limit (m/s), heights (m) at even distances."""
    along = [length * i / (len(heights) - 1) for i in range(len(heights))]
    shape = " ".join(f"{x:.2f},-1.60,{z:.3f}" for x, z in zip(along, heights, strict=True))
    path.write_text(
        f'<net version="1.20"><location netOffset="0,0" convBoundary="0,0,{length},0" origBoundary="0,0,{length},0"'
        ' projParameter="!"/><edge id="ab" from="a" to="b" priority="-1">'
        f'<lane id="ab_0" index="0" speed="{limit}" length="{length}" shape="{shape}"/></edge>'
        '<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-3.2"/>'
        f'<junction id="b" type="dead_end" x="{length}" y="0" incLanes="ab_0" intLanes=""'
        f' shape="{length},-3.2 {length},0"/></net>'
    )


def _scenario(folder: Path, vehicles: int) -> list[str]:
    net, routes = folder / "net.xml", folder / "r.rou.xml"
    straight_lane(net, 30.0 * vehicles + 5000.0, 33.0)
    cars = "".join(
        f'<vehicle id="{i}" type="idm" route="r" depart="0" departPos="{10 + 30.0 * i}" departSpeed="10"/>'
        for i in range(vehicles)
    )
    routes.write_text(
        '<routes><vType id="idm" carFollowModel="IDM" accel="1.4" decel="2" tau="1.5" minGap="2" maxSpeed="33"/>'
        f'<route id="r" edges="ab"/>{cars}</routes>'
    )
    return [
        "-n", str(net), "-r", str(routes), "--step-length", "0.1", "--no-step-log", "--no-warnings",
        "--time-to-teleport", "-1", "--lanechange.duration", "0", "--max-depart-delay", "-1",
    ]  # fmt: skip


def highway(seconds: float = 3.0) -> dict[str, float] | None:
    """Return env steps per CPU second of HighwayEnv's ``highway-fast-v0``; None where it is not installed."""
    if not find_spec("highway_env"):
        return None
    gymnasium = import_module("gymnasium")
    gymnasium.register_envs(import_module("highway_env"))
    env = gymnasium.make("highway-fast-v0")
    env.reset(seed=0)
    count, begin = 0, time.process_time()
    while time.process_time() - begin < seconds:
        *_, terminated, truncated, _ = env.step(1)
        count += 1
        if terminated or truncated:
            env.reset()
    return {"env_steps_per_cpu_second": count / (time.process_time() - begin)}
