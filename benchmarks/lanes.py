"""Several lanes with MOBIL: how fast, beside SUMO, and how often lanes change at which flow.

``python -m benchmarks.lanes speed [vehicles]`` prints million vehicle updates per CPU second of one thread: rings of
1000 vehicles on four lanes at 15 /km/lane, Δt 0.1 s, MOBIL at 1 Hz, desired speeds of 25 to 35 m/s.
``python -m benchmarks.lanes sumo`` drives the same ring in SUMO (IDM, LC2013, ``libsumo``), in the same minute.
``python -m benchmarks.lanes laws [vehicle-steps]`` counts what breaks a law in random traffic (``lanes_laws.py``).
``python -m benchmarks.lanes gradients [scenes]`` tells how good gradients through choices are (``lanes_gradients``).
``python -m benchmarks.lanes flow`` prints flow and changes over density, beside SUMO's where ``libsumo`` is there.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from benchmarks import lanes_gradients, lanes_laws
from idm_env import progress
from idm_env.effects import IDM, Brakes, Mobil
from idm_env.roads import Lanes
from idm_env.simulator import Simulator
from idm_env.types import State

LANES, EACH, DT = 4, 1000, 0.1
DRIVER = {"max_accel": 1.4, "comfort_decel": 2.0, "time_gap": 1.5, "min_gap": 2.0}


def traffic(rows: int, per_km: float, dtype: torch.dtype, each: int = EACH) -> tuple[Simulator, State, Any]:
    """Return rings of ``each`` vehicles in the order of the road, and their parameters."""
    ring = each / LANES / per_km * 1000.0
    simulator = Simulator(Lanes(LANES, ring=ring), (IDM(), Mobil(), Brakes()), dt=DT)
    generator = torch.Generator().manual_seed(1)
    params = simulator.defaults(dtype=dtype)
    params["idm"].update({name: torch.tensor(value, dtype=dtype) for name, value in DRIVER.items()})
    params["idm"]["desired_speed"] = (25.0 + 10.0 * torch.rand((rows, each), generator=generator)).to(dtype)
    index = torch.arange(each)
    spacing = ring * LANES / each
    # Uneven gaps: evenly spaced traffic sees no lane that is better than its own.
    shift = 0.4 * spacing * torch.rand((rows, each), generator=generator)
    position = (shift - torch.div(index, LANES, rounding_mode="floor") * spacing).to(dtype)
    pace = torch.full_like(position, min(20.0, 0.5 * (1000.0 / per_km - 7.0)))
    return simulator, simulator.state(position, pace, params, lane=index % LANES), params


def speed(vehicles: int) -> None:
    """Print million updates per CPU second, forward, and forward with the gradient by every driver's desired speed."""
    steps, warm = 100, 300
    for dtype in (torch.float32, torch.float64):
        simulator, state, params = traffic(max(1, vehicles // EACH), 15.0, dtype)
        state, _ = simulator.rollout(state, {}, params, warm, keep=None)
        begin, changed = time.process_time(), _changes(state)
        end, _ = simulator.rollout(state, {}, params, steps, keep=None)
        forward = time.process_time() - begin
        leaf = params["idm"]["desired_speed"].requires_grad_()
        for _ in range(2):  # the first compiles
            begin = time.process_time()
            last, _ = simulator.rollout(state, {}, params, 20, keep=None)
            torch.autograd.grad(last.position.sum(), leaf)
            both = time.process_time() - begin
        updates = state.speed.numel() * 1e-6
        print(
            f"{dtype!s:14s} {state.speed.numel():8d} vehicles: forward {updates * steps / forward:6.1f} M/s, forward "
            f"and backward {updates * 20 / both:6.1f} M/s, {_changes(end) - changed} changes",
            flush=True,
        )


def _changes(state: State) -> int:
    assert state.links is not None
    return int(state.links.changed.sum())


def flow(densities: tuple[float, ...] = (5.0, 10.0, 15.0, 20.0, 30.0, 40.0)) -> None:
    """Print flow (vehicles per hour and lane) and changes per vehicle and hour over five minutes after five."""
    steps = int(300 / DT)
    print("per km and lane   flow /h/lane   changes /vehicle/h        SUMO: flow   changes")
    for density in densities:
        simulator, state, params = traffic(4, density, torch.float64, each=200)
        state, _ = simulator.rollout(state, {}, params, steps, keep=None)
        end, _ = simulator.rollout(state, {}, params, steps, keep=None)
        mean = float((end.position - state.position).mean()) / 300.0
        rate = (_changes(end) - _changes(state)) / state.speed.numel() / 300.0 * 3600.0
        theirs = _sumo(200, density, 300.0)
        other = "" if theirs is None else f"{theirs[0] * density * 3.6:10.0f} {theirs[1]:9.1f}"
        print(f"{density:15.0f} {mean * density * 3.6:14.0f} {rate:20.1f} {other:>28s}", flush=True)


def sumo() -> None:
    """Print SUMO's million updates per CPU second on a ring of 1000 vehicles."""
    theirs = _sumo(EACH, 15.0, 30.0)
    print("libsumo is not installed" if theirs is None else f"SUMO: {theirs[2]:.2f} M updates per CPU second")


def _sumo(each: int, per_km: float, seconds: float) -> tuple[float, float, float] | None:
    """Return mean speed (m/s), changes per vehicle and hour, and million updates per CPU second; None without SUMO."""
    try:
        import libsumo
    except ImportError:
        return None
    ring = each / LANES / per_km * 1000.0
    with tempfile.TemporaryDirectory() as folder:
        net, routes = Path(folder, "net.xml"), Path(folder, "routes.xml")
        net.write_text(_net(ring))
        routes.write_text(_routes(each, ring, min(20.0, 0.5 * (1000.0 / per_km - 7.0))))
        libsumo.start([
            "sumo", "-n", str(net), "-r", str(routes), "--step-length", str(DT), "--step-method.ballistic",
            "--no-step-log", "--no-warnings", "--time-to-teleport", "-1", "--collision.action", "none", "--seed", "1",
        ])  # fmt: skip
        try:
            return _driven(libsumo, seconds)
        finally:
            libsumo.close()


def _net(ring: float) -> str:
    """Return a net of two edges that lead into each other, without insides of junctions."""
    parts = ['<net version="1.16"><location netOffset="0,0" convBoundary="0,0,1,1" origBoundary="0,0,1,1" '
             'projParameter="!"/>']  # fmt: skip
    for name, begin, end in (("a", "e", "w"), ("b", "w", "e")):
        lanes = "".join(
            f'<lane id="{name}_{k}" index="{k}" speed="60" length="{0.5 * ring:.2f}" '
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


def _routes(each: int, ring: float, pace: float) -> str:
    generator = torch.Generator().manual_seed(1)
    desired = (25.0 + 10.0 * torch.rand(each, generator=generator)).tolist()
    types, cars = [], []
    for i, top in enumerate(desired):
        place = (i // LANES) * ring * LANES / each
        edge, at = ("a", place) if place < 0.5 * ring else ("b", place - 0.5 * ring)
        types.append(
            f'<vType id="t{i}" carFollowModel="IDM" length="5" accel="{DRIVER["max_accel"]}" '
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


def laws(steps: float) -> None:
    """Print how often random traffic broke a law, and what else it did."""
    with progress.shown(Console(stderr=True)) as on_progress:
        found = lanes_laws.check(steps, on_progress)
    print(lanes_laws.table(found))


def main() -> None:
    """Run what is asked for."""
    torch.set_num_threads(1)
    what = sys.argv[1] if len(sys.argv) > 1 else "speed"
    if what == "speed":
        speed(int(sys.argv[2]) if len(sys.argv) > 2 else 200_000)
    elif what == "sumo":
        sumo()
    elif what == "flow":
        flow()
    elif what == "laws":
        laws(float(sys.argv[2]) if len(sys.argv) > 2 else 1e9)
    elif what == "gradients":
        with progress.shown(Console(stderr=True)) as on_progress:
            lanes_gradients.table(int(sys.argv[2]) if len(sys.argv) > 2 else 50, on_progress)
    else:
        sys.exit(f"unknown benchmark '{what}'. Take speed, sumo, flow, laws or gradients.")


if __name__ == "__main__":
    main()
