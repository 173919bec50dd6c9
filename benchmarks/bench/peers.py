"""Other people's simulators, each used as its own documentation shows; absent ones are left out with a word."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmarks.bench.measure import rate, turning


def diffidm_layer() -> Any | None:
    """Return ``diffidm.layer.IDMLayer``, or None where it is not installed."""
    return import_module("diffidm.layer").IDMLayer if find_spec("diffidm") else None


@contextlib.contextmanager
def started(net: str, routes: str, *options: str, step: float = 0.1) -> Iterator[Any]:
    """Give ``libsumo`` on a net with its traffic, where nobody is teleported, and end it; None where it is missing."""
    if not find_spec("libsumo"):
        yield None
        return
    libsumo = import_module("libsumo")
    with tempfile.TemporaryDirectory() as folder:
        at_net, at_routes = Path(folder, "net.xml"), Path(folder, "routes.xml")
        at_net.write_text(net)
        at_routes.write_text(routes)
        libsumo.start([
            "sumo", "-n", str(at_net), "-r", str(at_routes), "--step-length", str(step), "--time-to-teleport", "-1",
            "--no-step-log", "--no-warnings", *options,
        ])  # fmt: skip
        try:
            yield libsumo
        finally:
            libsumo.close()


def sumo(vehicles: int = 1000, steps: int = 500) -> dict[str, float] | None:
    """Return SUMO's vehicle updates per CPU second on one lane with its IDM; None where ``libsumo`` is not installed.

    All vehicles are on a straight edge from the first step on, one lane, Δt = 0.1 s, no output, no lane changes.
    """
    cars = "".join(
        f'<vehicle id="{i}" type="idm" route="r" depart="0" departPos="{10 + 30.0 * i}" departSpeed="10"/>'
        for i in range(vehicles)
    )
    routes = (
        '<routes><vType id="idm" carFollowModel="IDM" accel="1.4" decel="2" tau="1.5" minGap="2" maxSpeed="33"/>'
        f'<route id="r" edges="ab"/>{cars}</routes>'
    )
    options = ("--lanechange.duration", "0", "--max-depart-delay", "-1")
    with started(straight(30.0 * vehicles + 5000.0, 33.0), routes, *options) as libsumo:
        if libsumo is None:
            return None
        for _ in range(5):
            libsumo.simulationStep()
        begin = time.process_time()
        for _ in range(steps):
            libsumo.simulationStep()
        taken = time.process_time() - begin
        return {
            "vehicle_updates_per_cpu_second": vehicles * steps / taken,
            "vehicles_at_end": float(libsumo.vehicle.getIDCount()),
        }


def straight(length: float, limit: float, heights: Sequence[float] = (0.0, 0.0), lanes: int = 1) -> str:
    """Return SUMO's network of one straight road: length (m), speed limit (m/s), heights (m) at even distances."""
    along = [length * i / (len(heights) - 1) for i in range(len(heights))]
    shapes = (
        " ".join(f"{x:.2f},{-1.6 - 3.2 * (lanes - 1 - k):.2f},{z:.3f}" for x, z in zip(along, heights, strict=True))
        for k in range(lanes)
    )
    parts = "".join(
        f'<lane id="ab_{k}" index="{k}" speed="{limit}" length="{length}" shape="{shape}"/>'
        for k, shape in enumerate(shapes)
    )
    bottom = -3.2 * lanes
    return (
        f'<net version="1.20"><location netOffset="0,0" convBoundary="0,0,{length},0" origBoundary="0,0,{length},0"'
        f' projParameter="!"/><edge id="ab" from="a" to="b" priority="-1">{parts}</edge>'
        f'<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,{bottom}"/>'
        f'<junction id="b" type="dead_end" x="{length}" y="0" incLanes="{" ".join(f"ab_{k}" for k in range(lanes))}"'
        f' intLanes="" shape="{length},{bottom} {length},0"/></net>'
    )


def highway(**config: int) -> Any | None:
    """Return HighwayEnv's ``highway-fast-v0``; None where it is not installed."""
    if not find_spec("highway_env"):
        return None
    gymnasium = import_module("gymnasium")
    gymnasium.register_envs(import_module("highway_env"))
    return gymnasium.make("highway-fast-v0", config=config)


def highway_rate(seconds: float = 3.0) -> dict[str, float] | None:
    """Return env steps per CPU second of ``highway``, the same action always; None where it is not installed."""
    env = highway()
    return None if env is None else {"env_steps_per_cpu_second": rate(turning(env, lambda: 1), seconds)}
