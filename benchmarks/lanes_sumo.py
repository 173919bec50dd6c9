"""SUMO (``libsumo``) on the ring of ``lanes_ring``: the same drivers, and lane changes of its own."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from benchmarks.lanes_ring import DRIVER, DT, LANES

MODELS = ("LC2013", "SL2015")


@contextmanager
def started(net: str, routes: str, step: float, *options: str) -> Iterator[Any]:
    """Give ``libsumo`` on a net with its traffic, where nobody is teleported, and end it; None where it is missing."""
    if not find_spec("libsumo"):
        yield None
        return
    import libsumo

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


def sumo(
    each: int, per_km: float, seconds: float, model: str = "LC2013", seed: int = 1
) -> tuple[float, float, float] | None:
    """Return mean speed (m/s), changes per vehicle and hour, and million updates per CPU second; None without SUMO.

    ``model`` is SUMO's lane-change model; ``SL2015`` has a lateral resolution of 0.8 m.
    """
    ring = each / LANES / per_km * 1000.0
    routes = _routes(each, ring, min(20.0, 0.5 * (1000.0 / per_km - 7.0)), model)
    options = ["--step-method.ballistic", "--collision.action", "none", "--seed", str(seed)]
    options += ["--lateral-resolution", "0.8"] if model == "SL2015" else []
    with started(_net(ring), routes, DT, *options) as libsumo:
        return None if libsumo is None else _driven(libsumo, seconds)


def _net(ring: float) -> str:
    """Return a net of two edges that lead into each other, without insides of junctions."""
    parts = ['<net version="1.16"><location netOffset="0,0" convBoundary="0,0,1,1" origBoundary="0,0,1,1" '
             'projParameter="!"/>']  # fmt: skip
    for name, begin, end in (("a", "e", "w"), ("b", "w", "e")):
        lanes = "".join(
            f'<lane id="{name}_{k}" index="{k}" speed="60" length="{0.5 * ring:.2f}" width="3.2" '
            f'shape="0,{3 * k} {0.5 * ring:.2f},{3 * k}"/>'
            for k in range(LANES)
        )
        parts.append(f'<edge id="{name}" from="{begin}" to="{end}" priority="1">{lanes}</edge>')
    none = "0" * LANES
    asked = "".join(f'<request index="{k}" response="{none}" foes="{none}" cont="0"/>' for k in range(LANES))
    for name, edge in (("w", "a"), ("e", "b")):
        incoming = " ".join(f"{edge}_{k}" for k in range(LANES))
        parts.append(
            f'<junction id="{name}" type="priority" x="0" y="0" incLanes="{incoming}" intLanes="" '
            f'shape="0,0 0,1 1,1">{asked}</junction>'
        )
    for first, second in (("a", "b"), ("b", "a")):
        parts += [
            f'<connection from="{first}" to="{second}" fromLane="{k}" toLane="{k}" dir="s" state="M"/>'
            for k in range(LANES)
        ]
    return "".join(parts) + "</net>"


def _routes(each: int, ring: float, pace: float, model: str) -> str:
    generator = torch.Generator().manual_seed(1)
    desired = (25.0 + 10.0 * torch.rand(each, generator=generator)).tolist()
    types, cars = [], []
    for i, top in enumerate(desired):
        place = (i // LANES) * ring * LANES / each
        edge, at = ("a", place) if place < 0.5 * ring else ("b", place - 0.5 * ring)
        types.append(
            f'<vType id="t{i}" carFollowModel="IDM" laneChangeModel="{model}" length="5" accel="{DRIVER["max_accel"]}" '
            f'decel="{DRIVER["comfort_decel"]}" tau="{DRIVER["time_gap"]}" minGap="{DRIVER["min_gap"]}" '
            f'maxSpeed="{top:.3f}" speedFactor="1" speedDev="0"/>'
        )
        cars.append(
            f'<vehicle id="v{i}" type="t{i}" route="{edge}" depart="0" departLane="{i % LANES}" '
            f'departPos="{at:.2f}" departSpeed="{pace:.2f}" insertionChecks="none"/>'
        )
    loops = f'<route id="a" edges="{"a b " * 300}"/><route id="b" edges="{"b a " * 300}"/>'
    return f"<routes>{loops}{''.join(types)}{''.join(cars)}</routes>"


def _driven(libsumo: Any, seconds: float) -> tuple[float, float, float]:
    """Drive as long before as during what is measured."""
    for _ in range(int(seconds / DT)):
        libsumo.simulationStep()
    names = libsumo.vehicle.getIDList()
    lanes = {name: libsumo.vehicle.getLaneIndex(name) for name in names}
    changes, way, cpu, steps = 0, 0.0, 0.0, int(seconds / DT)
    for k in range(steps):
        begin = time.process_time()
        libsumo.simulationStep()
        cpu += time.process_time() - begin
        if k % 10 == 0:
            for name in names:
                lane = libsumo.vehicle.getLaneIndex(name)
                changes += lane != lanes[name]
                lanes[name] = lane
            way += sum(libsumo.vehicle.getSpeed(name) for name in names) / len(names)
    return way / math.ceil(steps / 10), changes / len(names) / seconds * 3600.0, len(names) * steps / cpu * 1e-6
