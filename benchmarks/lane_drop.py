"""Outflow of a road of 4 → 2 → 1 lanes that 2600 vehicles an hour want to enter: published, ours, and SUMO's today.

``python -m benchmarks.lanes drop`` drives it for 30 minutes and counts in the last 20: IDM with MOBIL and
``MandatoryChange`` here, IDM with LC2013 in SUMO (``libsumo``, where it is installed), on the same road. Lanes end at
500 and 750 m of 1000 m; the road of the published figures is not known to the metre.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import torch

from idm_env import population
from idm_env.effects import IDM, Brakes, MandatoryChange, Mobil, Noise
from idm_env.roads import Lanes, lane_drop
from idm_env.simulator import Simulator

PUBLISHED: dict[str, float] = {
    "as published": 1476, "time_gap 0.5": 1696, "time_gap 0.75": 1540, "time_gap 1.25": 1456, "desired_speed 15": 1463,
    "desired_speed 20": 1474, "min_gap 2": 1514, "min_gap 3": 1440,
}  # fmt: skip
"""Vehicles per hour out of the bottleneck with human drivers: IDM with a 2.6, b 4.5, T 1, s0 2.5, v0 30, σ 0.2."""


BASE = {"max_accel": 2.6, "comfort_decel": 4.5, "time_gap": 1.0, "min_gap": 2.5, "desired_speed": 30.0}
DT, FLOW = 0.25, 2600.0


def varied(label: str) -> dict[str, float]:
    """Return the parameters of a row."""
    name, _, value = label.partition(" ")
    return {**BASE, name: float(value)} if name in BASE else BASE


def ours(seeds: int, minutes: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return vehicles per hour out in the last two thirds of the time, and how many are queued: (rows, seeds)."""
    ends = (lane_drop(0, at=500.0), lane_drop(3, at=500.0), lane_drop(2, at=750.0))
    own = (IDM(), Noise(), Mobil(), MandatoryChange(), Brakes())
    simulator = Simulator(Lanes(4, length=1000.0, ends=ends), own, dt=DT)
    given = population.trips(dict.fromkeys(range(4), FLOW / 4), 3600.0, speed=15.0, slots=400)
    rows, n = len(PUBLISHED) * seeds, len(given.departs)
    params = simulator.defaults(dtype=torch.float32)
    for name in BASE:
        column = torch.tensor([varied(label)[name] for label in PUBLISHED])
        params["idm"][name] = column.repeat_interleave(seeds).unsqueeze(-1)
    params["noise"]["sigma"] = torch.tensor(0.2)
    begin = state = population.waiting(simulator, population.spread(given, (rows, n)), params)
    for part in range(3 * minutes):
        state, _ = simulator.rollout(state, {}, params, int(20.0 / DT), keep=None, seed=part)
        begin = state if part + 1 == minutes else begin
    assert begin.trips is not None and state.trips is not None
    out = (state.trips.left - begin.trips.left).sum(-1).view(-1, seeds) / (minutes * 40.0 / 3600.0)
    return out.double(), population.counts(simulator, state).queued.view(-1, seeds).double()


def sumo(minutes: int, values: dict[str, float]) -> float | None:
    """Return vehicles per hour out of the same road in SUMO (IDM, LC2013); None without ``libsumo``."""
    try:
        import libsumo
    except ImportError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        net, routes = Path(folder, "net.xml"), Path(folder, "routes.xml")
        net.write_text(_net())
        routes.write_text(_routes(minutes * 60.0, values))
        libsumo.start([
            "sumo", "-n", str(net), "-r", str(routes), "--step-length", str(DT), "--step-method.ballistic",
            "--error-log", str(Path(folder, "errors")), "--no-step-log", "--no-warnings", "--time-to-teleport", "-1",
            "--collision.action", "none", "--seed", "1",
        ])  # fmt: skip
        try:
            left = 0
            for k in range(int(minutes * 60.0 / DT)):
                libsumo.simulationStep()
                left += libsumo.simulation.getArrivedNumber() if k * DT >= minutes * 20.0 else 0
            return left / (minutes * 40.0 / 3600.0)
        finally:
            libsumo.close()


def _net() -> str:
    """Return three edges of 4, 2 and 1 lanes; lanes 0 and 3, then 1 of 2, have nowhere to go."""
    edges = (("a", 4, 500.0, 0.0), ("b", 2, 250.0, 500.0), ("c", 1, 250.0, 750.0))
    parts = ['<net version="1.16"><location netOffset="0,0" convBoundary="0,0,1000,20" origBoundary="0,0,1000,20" '
             'projParameter="!"/>']  # fmt: skip
    shift = {"a": 0, "b": 1, "c": 1}
    for i, (name, count, length, begin) in enumerate(edges):
        lanes = "".join(
            f'<lane id="{name}_{k}" index="{k}" speed="60" length="{length}" '
            f'shape="{begin},{3 * (k + shift[name])} {begin + length},{3 * (k + shift[name])}"/>'
            for k in range(count)
        )
        parts.append(f'<edge id="{name}" from="n{i}" to="n{i + 1}" priority="1">{lanes}</edge>')
    joined = {"n1": (("a", 1, "b", 0), ("a", 2, "b", 1)), "n2": (("b", 0, "c", 0),)}
    for i, (incoming, x) in enumerate((("", 0), ("a_0 a_1 a_2 a_3", 500), ("b_0 b_1", 750), ("c_0", 1000))):
        links = joined.get(f"n{i}", ())
        none = "0" * len(links)
        asked = "".join(f'<request index="{k}" response="{none}" foes="{none}" cont="0"/>' for k in range(len(links)))
        kind = "priority" if links else "dead_end"
        parts.append(
            f'<junction id="n{i}" type="{kind}" x="{x}" y="0" incLanes="{incoming}" intLanes="" '
            f'shape="{x},0 {x},12 {x},6">{asked}</junction>'
        )
    parts += [
        f'<connection from="{a}" to="{b}" fromLane="{i}" toLane="{j}" dir="s" state="M"/>'
        for links in joined.values()
        for a, i, b, j in links
    ]
    return "".join(parts) + "</net>"


def _routes(seconds: float, values: dict[str, float]) -> str:
    kind = (
        f'<vType id="t" carFollowModel="IDM" length="5" accel="{values["max_accel"]}" sigma="0.2" '
        f'decel="{values["comfort_decel"]}" tau="{values["time_gap"]}" minGap="{values["min_gap"]}" '
        f'maxSpeed="{values["desired_speed"]}" speedFactor="1" speedDev="0"/><route id="r" edges="a b c"/>'
    )
    flows = "".join(
        f'<flow id="f{k}" type="t" route="r" begin="0" end="{seconds}" vehsPerHour="{FLOW / 4}" departLane="{k}" '
        'departSpeed="15"/>'
        for k in range(4)
    )
    return f"<routes>{kind}{flows}</routes>"


def main(seeds: int = 4, minutes: int = 30) -> None:
    """Print all rows."""
    torch.set_num_threads(1)
    out, queued = ours(seeds, minutes)
    print("IDM                published   ours, queued at the end    SUMO on the same road")
    for label, theirs, mine, waits in zip(PUBLISHED, PUBLISHED.values(), out, queued, strict=True):
        beside = sumo(minutes, varied(label))
        error = float(mine.std()) / math.sqrt(seeds)
        told = "libsumo is not installed" if beside is None else f"{beside:.0f}"
        us = f"{float(mine.mean()):5.0f} ± {error:3.0f} {float(waits.mean()):10.0f}"
        print(f"{label:18s} {theirs:9.0f}   {us} {told:>24s}", flush=True)


if __name__ == "__main__":
    main()
