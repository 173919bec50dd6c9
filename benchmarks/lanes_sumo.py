"""SUMO (``libsumo``): begun and ended, roads of several lanes for it, and the ring of ``lanes_ring`` driven."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

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


class Edge(NamedTuple):
    """An edge between two nodes, from ``begin`` to ``end`` (m); its lane 0 is lane ``right`` of the whole road."""

    name: str
    begins: str
    ends: str
    lanes: int
    begin: float
    end: float
    right: int = 0


def idm(values: Mapping[str, float]) -> str:
    """Return the attributes of a type of vehicle that drives by IDM in SUMO."""
    return (
        f'carFollowModel="IDM" laneChangeModel="LC2013" length="5" accel="{values["max_accel"]}" sigma="0.2" '
        f'decel="{values["comfort_decel"]}" tau="{values["time_gap"]}" minGap="{values["min_gap"]}" '
        f'maxSpeed="{values["desired_speed"]}" speedFactor="1"'
    )


def net(edges: Sequence[Edge]) -> str:
    """Return a straight road: lanes go on into the edges that follow where these have them, otherwise they end."""
    last = max(edge.end for edge in edges)
    parts = [f'<net version="1.16"><location netOffset="0,0" convBoundary="0,0,{last},20" '
             f'origBoundary="0,0,{last},20" projParameter="!"/>']  # fmt: skip
    for e in edges:
        lanes = "".join(
            f'<lane id="{e.name}_{k}" index="{k}" speed="60" length="{e.end - e.begin}" '
            f'shape="{e.begin},{3 * (k + e.right)} {e.end},{3 * (k + e.right)}"/>'
            for k in range(e.lanes)
        )
        parts.append(f'<edge id="{e.name}" from="{e.begins}" to="{e.ends}" priority="1">{lanes}</edge>')
    places = {node: at for e in edges for node, at in ((e.begins, e.begin), (e.ends, e.end))}
    connections = []
    for node, x in places.items():
        incoming = [e for e in edges if e.ends == node]
        links = [
            (a.name, i, b.name, i + a.right - b.right)
            for a in incoming for i in range(a.lanes)
            for b in edges if b.begins == node and b.right <= i + a.right < b.right + b.lanes
        ]  # fmt: skip
        connections += links
        none = "0" * len(links)
        asked = "".join(f'<request index="{k}" response="{none}" foes="{none}" cont="0"/>' for k in range(len(links)))
        arriving = " ".join(f"{e.name}_{k}" for e in incoming for k in range(e.lanes))
        parts.append(
            f'<junction id="{node}" type="{"priority" if links else "dead_end"}" x="{x}" y="0" incLanes="{arriving}" '
            f'intLanes="" shape="{x},0 {x},12 {x},6">{asked}</junction>'
        )
    parts += [
        f'<connection from="{a}" to="{b}" fromLane="{i}" toLane="{j}" dir="s" state="M"/>' for a, i, b, j in connections
    ]
    return "".join(parts) + "</net>"


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
