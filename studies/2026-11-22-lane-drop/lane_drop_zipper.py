"""SUMO (``libsumo``) on the published road of 4 → 2 → 1 lanes: pairs of lanes that join as zippers.

After the description in the code of Yan, Kreidieh, Vinitsky, Bayen and Wu 2022 (github.com/mit-wu-lab/
automatic_vehicular_control): edges of 100, 100 and 50 m whose junctions take 20 m on either side, steps of 0.5 s,
entered at standstill, lane changes switched off, whoever cannot enter within 0.5 s given up. Their SUMO had noise in
IDM; today's has none.
"""

from __future__ import annotations

import os
import random
from collections.abc import Mapping
from typing import Any

from benchmarks.lanes_sumo import idm, started

BASE = {"max_accel": 2.6, "comfort_decel": 4.5, "time_gap": 1.0, "min_gap": 2.5, "desired_speed": 30.0}
FLOW = 2600.0
SHARE, REACH, SIGHT = 0.2, 20.0, 30.0
"""Share of vehicles under the derived controller; how far before a merge it acts (ours to choose: 10, 20 and 30 m gave
1809, 1825 and 1804 vehicles an hour in SUMO), and how near to it a human counts (m)."""
STEP = 0.5


def sumo(values: Mapping[str, float], derived: bool, warmup: int = 1000, steps: int = 2000) -> float | None:
    """Return vehicles per hour out, after 500 s, in 1000 s; None without ``libsumo``."""
    options = ["--collision.action", "remove", "--collision.check-junctions", "true", "--max-depart-delay", "0.5"]
    with started(_net(), _routes(values), STEP, *options, "--error-log", os.devnull, "--seed", "1") as libsumo:
        return None if libsumo is None else _driven(libsumo, values, derived, warmup, steps)


def _driven(libsumo: Any, values: Mapping[str, float], derived: bool, warmup: int, steps: int) -> float:
    draw, chosen, left = random.Random(1), set[str](), 0
    for k in range(warmup + steps):
        if derived:
            for name in chosen.intersection(libsumo.vehicle.getIDList()):
                _control(libsumo, name, chosen, values)
        libsumo.simulationStep()
        for name in libsumo.simulation.getDepartedIDList():
            libsumo.vehicle.setLaneChangeMode(name, 0)
            if draw.random() < SHARE:
                chosen.add(name)
        left += libsumo.simulation.getArrivedNumber() if k >= warmup else 0
    return left / (steps * STEP / 3600.0)


def _control(libsumo: Any, name: str, chosen: set[str], values: Mapping[str, float]) -> None:
    """Let a vehicle stop before a merge while the next one behind it on the other lane is a human close to it."""
    vehicle = libsumo.vehicle
    edge, place = vehicle.getRoadID(name), vehicle.getLanePosition(name)
    go = True
    if edge in ("a", "b"):
        lane = vehicle.getLaneIndex(name)
        to_end = libsumo.lane.getLength(f"{edge}_{lane}") - place
        beside = libsumo.lane.getLastStepVehicleIDs(f"{edge}_{lane ^ 1}")
        behind = [(vehicle.getLanePosition(other), other) for other in beside]
        behind = [(at, other) for at, other in behind if at <= place]
        if to_end < REACH and behind:
            at, other = max(behind)
            go = other in chosen or place - at + to_end >= SIGHT
    accel = values["max_accel"] if go else -values["comfort_decel"]
    vehicle.slowDown(name, max(0.0, vehicle.getSpeed(name) + accel * STEP), 0.0)


def _net() -> str:
    """Return edges of 80, 60 and 30 m with zipper junctions of 40 m between them."""
    parts = ['<net version="1.20" limitTurnSpeed="5.5"><location netOffset="0,0" convBoundary="0,0,250,0" '
             'origBoundary="0,0,250,0" projParameter="!"/>']  # fmt: skip
    joined = {"n1": ("a", 4, "b", 80.0), "n2": ("b", 2, "c", 180.0)}
    for node, (_, count, _, begin) in joined.items():
        lanes = [(k, count, count // 2, k // 2) for k in range(count)]
        parts.append(f'<edge id=":{node}_0" function="internal">' + "".join(
            _lane(f":{node}_0_{k}", k, begin, begin + 40.0, _side(k, of), _side(to, then)) for k, of, then, to in lanes
        ) + "</edge>")  # fmt: skip
    for i, (name, count, begin, end) in enumerate(
        (("a", 4, 0.0, 80.0), ("b", 2, 120.0, 180.0), ("c", 1, 220.0, 250.0))
    ):
        lanes_of = "".join(_lane(f"{name}_{k}", k, begin, end, *(_side(k, count),) * 2) for k in range(count))
        parts.append(f'<edge id="{name}" from="n{i}" to="n{i + 1}" priority="-1">{lanes_of}</edge>')
    parts.append('<junction id="n0" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,6 0,-6"/>')
    for node, (name, count, _, begin) in joined.items():
        # A lane yields to the other of its pair, and that one to it: who goes first is the zipper's to say.
        yields = ["".join("1" if other == k ^ 1 else "0" for other in reversed(range(count))) for k in range(count)]
        asked = "".join(f'<request index="{k}" response="{y}" foes="{y}" cont="0"/>' for k, y in enumerate(yields))
        incoming, inside = (" ".join(f"{what}_{k}" for k in range(count)) for what in (name, f":{node}_0"))
        parts.append(
            f'<junction id="{node}" type="zipper" x="{begin + 20}" y="0" incLanes="{incoming}" intLanes="{inside}" '
            f'shape="{begin + 40},4 {begin + 40},-4 {begin},-7 {begin},7">{asked}</junction>'
        )
    parts.append('<junction id="n3" type="dead_end" x="250" y="0" incLanes="c_0" intLanes="" shape="250,-2 250,2"/>')
    for node, (name, count, then, _) in joined.items():
        for k in range(count):
            to = f'to="{then}" fromLane="{k}" toLane="{k // 2}" dir="s"'
            parts.append(f'<connection from="{name}" {to} via=":{node}_0_{k}" state="Z"/>')
            parts.append(f'<connection from=":{node}_0" {to} state="M"/>')
    return "".join(parts) + "</net>"


def _side(lane: int, count: int) -> float:
    return 3.2 * (lane - 0.5 * (count - 1))


def _lane(name: str, index: int, begin: float, end: float, first: float, last: float) -> str:
    shape = f"{begin},{first:.2f} {end},{last:.2f}"
    return f'<lane id="{name}" index="{index}" speed="30" length="{end - begin}" shape="{shape}"/>'


def _routes(values: Mapping[str, float]) -> str:
    kind = f'<vType id="t" {idm(values)} speedDev="0.1" impatience="0.5"/><route id="r" edges="a b c"/>'
    flows = "".join(
        f'<flow id="f{k}" type="t" route="r" begin="1" end="86400" vehsPerHour="{FLOW / 4}" departLane="{k}" '
        'departSpeed="0"/>'
        for k in range(4)
    )
    return f"<routes>{kind}{flows}</routes>"
