"""Other people's simulators, each used as its own documentation shows; absent ones are left out with a word."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
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
    netconvert = _program("netconvert")
    if not find_spec("libsumo") or netconvert is None:
        return None
    libsumo = import_module("libsumo")
    with tempfile.TemporaryDirectory() as folder:
        options = _scenario(Path(folder), netconvert, vehicles)
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


def _program(name: str) -> str | None:
    if find_spec("sumo"):
        home = Path(import_module("sumo").SUMO_HOME)
        os.environ.setdefault("SUMO_HOME", str(home))
        if (home / "bin" / name).exists():
            return str(home / "bin" / name)
    return shutil.which(name)


def _scenario(folder: Path, netconvert: str, vehicles: int) -> list[str]:
    nodes, edges, net, routes = (folder / name for name in ("n.nod.xml", "e.edg.xml", "net.xml", "r.rou.xml"))
    reach = 30.0 * vehicles + 5000.0
    nodes.write_text(f'<nodes><node id="a" x="0" y="0"/><node id="b" x="{reach}" y="0"/></nodes>')
    edges.write_text('<edges><edge id="ab" from="a" to="b" numLanes="1" speed="33"/></edges>')
    subprocess.run(
        [netconvert, "-n", str(nodes), "-e", str(edges), "-o", str(net)], check=True, capture_output=True
    )  # fmt: skip
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
