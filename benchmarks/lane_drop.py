"""Outflow of a road of 4 → 2 → 1 lanes that 2600 vehicles an hour want to enter: published, ours, and SUMO's today.

``python -m benchmarks.lanes drop`` drives it for 30 minutes and counts in the last 20: IDM with MOBIL and
``MandatoryChange`` here, IDM with LC2013 in SUMO (``libsumo``, where it is installed), on the same road. Lanes end at
500 and 750 m of 1000 m.

The published figures (Yan, Kreidieh, Vinitsky, Bayen and Wu 2022, "Unified automatic control of vehicular systems with
reinforcement learning", IEEE T-ASE) are of another road, known from the authors' code: 100, 100 and 50 m, entered at
standstill, on which nobody changes lanes: pairs of lanes join as zippers. ``drop published`` drives that one
(``lane_drop_zipper.py``), in SUMO as a zipper, here with lanes that end at 100 and 200 m; with human drivers, and with
a fifth of vehicles under the authors' derived controller. Rows are kept in ``out/lane-drop.json``.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from benchmarks import lane_drop_zipper
from benchmarks.lane_drop_zipper import BASE, FLOW
from benchmarks.lanes_sumo import started
from idm_env import keep, population
from idm_env.effects import IDM, Brakes, Control, MandatoryChange, Mobil, Noise
from idm_env.roads import Lanes, lane_drop
from idm_env.simulator import Simulator
from idm_env.types import Command, State

PUBLISHED: dict[str, tuple[float, float]] = {
    "as published": (1476, 1787), "time_gap 0.5": (1696, 2040), "time_gap 0.75": (1540, 1953),
    "time_gap 1.25": (1456, 1632), "desired_speed 15": (1463, 1679), "desired_speed 20": (1474, 1750),
    "min_gap 2": (1514, 1843), "min_gap 3": (1440, 1736),
}  # fmt: skip
"""Vehicles per hour out with human drivers, and with the derived controller: IDM with a 2.6, b 4.5, T 1, s0 2.5, v0 30,
σ 0.2, and one parameter changed. Of twelve published changes these seven are known to us."""
DT = 0.25
KEPT = Path("out/lane-drop.json")


class Place(NamedTuple):
    """Where the outer lanes, then one of the others, then the road end (m), how fast one enters (m/s), and slots."""

    first: float
    second: float
    end: float
    speed: float
    slots: int


LONG, SHORT = Place(500.0, 750.0, 1000.0, 15.0, 400), Place(100.0, 200.0, 250.0, 0.0, 200)


def varied(label: str) -> dict[str, float]:
    """Return the parameters of a row."""
    name, _, value = label.partition(" ")
    return {**BASE, name: float(value)} if name in BASE else dict(BASE)


def ours(place: Place, labels: list[str], seeds: int, minutes: int, derived: bool = False) -> list[list[float]]:
    """Return vehicles per hour out in the last two thirds of the time, and how many are queued, for every row."""
    ends = (lane_drop(0, at=place.first), lane_drop(3, at=place.first), lane_drop(2, at=place.second))
    own = (IDM(), Noise(), Mobil(), MandatoryChange(), Control(), Brakes())
    simulator = Simulator(Lanes(4, length=place.end, ends=ends), own, dt=DT)
    given = population.trips(dict.fromkeys(range(4), FLOW / 4), 3600.0, speed=place.speed, slots=place.slots)
    rows, n = len(labels) * seeds, len(given.departs)
    params = simulator.defaults(dtype=torch.float32)
    for name in BASE:
        column = torch.tensor([varied(label)[name] for label in labels])
        params["idm"][name] = column.repeat_interleave(seeds).unsqueeze(-1)
    params["noise"]["sigma"] = torch.tensor(0.2)
    begin = state = population.waiting(simulator, population.spread(given, (rows, n)), params)
    chosen = torch.rand((rows, n), generator=torch.Generator().manual_seed(1)) < lane_drop_zipper.SHARE
    steps = 1 if derived else int(20.0 / DT)
    for part in range(60 * minutes * int(1.0 / DT) // steps):
        stop = stands(state, chosen, place) if derived else torch.zeros((rows, n), dtype=torch.bool)
        brake = Command(torch.full((steps, 1, 1), -BASE["comfort_decel"]), stop.expand(steps, rows, n))
        state, _ = simulator.rollout(state, {"control": brake}, params, steps, keep=None, seed=part)
        begin = state if (part + 1) * steps == int(20.0 * minutes / DT) else begin
    assert begin.trips is not None and state.trips is not None
    out = (state.trips.left - begin.trips.left).sum(-1).view(-1, seeds) / (minutes * 40.0 / 3600.0)
    queued = population.counts(simulator, state).queued.view(-1, seeds).double().mean(-1)
    error = out.double().std(-1) / math.sqrt(seeds) if seeds > 1 else torch.zeros(len(labels))
    return [list(row) for row in zip(out.double().mean(-1).tolist(), error.tolist(), queued.tolist(), strict=True)]


def stands(state: State, chosen: torch.Tensor, place: Place) -> torch.Tensor:
    """Return which of the chosen vehicles stop for a human beside them, by the derived controller (bool).

    Within 20 m of where its lane and the other of its pair become one, a vehicle stops while the next one behind it on
    that other lane is a human within 30 m of there.
    """
    assert state.links is not None and state.present is not None
    lane, position = state.links.lane, state.position
    early = position < place.first
    other = torch.where(early, torch.tensor([1, 0, 3, 2])[lane], torch.tensor([0, 2, 1, 3])[lane])
    to_end = torch.where(early, place.first, place.second) - position
    behind = position.unsqueeze(-1) - position.unsqueeze(-2)
    there = (state.present > 0).unsqueeze(-2) & (other.unsqueeze(-1) == lane.unsqueeze(-2)) & (behind >= 0)
    there = there & (early.unsqueeze(-1) == early.unsqueeze(-2)) & (other != lane).unsqueeze(-1)
    way, slot = torch.where(there, behind, torch.inf).min(-1)
    human = ~chosen.gather(-1, slot)
    near = (to_end >= 0) & (to_end < lane_drop_zipper.REACH) & (position < place.second) & (state.present > 0)
    return chosen & near & human & (way + to_end < lane_drop_zipper.SIGHT)


def sumo(minutes: int, values: Mapping[str, float]) -> float | None:
    """Return vehicles per hour out of the long road in SUMO (IDM, LC2013); None without ``libsumo``."""
    options = ["--step-method.ballistic", "--collision.action", "none", "--error-log", os.devnull, "--seed", "1"]
    with started(_net(), _routes(minutes * 60.0, values), DT, *options) as libsumo:
        if libsumo is None:
            return None
        left = 0
        for k in range(int(minutes * 60.0 / DT)):
            libsumo.simulationStep()
            left += libsumo.simulation.getArrivedNumber() if k * DT >= minutes * 20.0 else 0
        return left / (minutes * 40.0 / 3600.0)


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


def _routes(seconds: float, values: Mapping[str, float]) -> str:
    kind = f'<vType id="t" {lane_drop_zipper.idm(values)} speedDev="0"/><route id="r" edges="a b c"/>'
    flows = "".join(
        f'<flow id="f{k}" type="t" route="r" begin="0" end="{seconds}" vehsPerHour="{FLOW / 4}" departLane="{k}" '
        'departSpeed="15"/>'
        for k in range(4)
    )
    return f"<routes>{kind}{flows}</routes>"


def kept(name: str, drive: Callable[..., Any], *given: Any) -> Any:
    """Return what was driven before under a name, or drive it now and keep it."""
    found = json.loads(KEPT.read_text()) if KEPT.is_file() else {}
    if name not in found:
        print(f"driving {name}", flush=True)
        found[name] = drive(*given)
        KEPT.parent.mkdir(parents=True, exist_ok=True)
        keep.write_text(KEPT, json.dumps(found, indent=1))
    return found[name]


def _told(found: Any) -> str:
    if found is None:
        return "libsumo is not installed"
    return f"{found:.0f}" if isinstance(found, float) else f"{found[0]:.0f} ± {found[1]:.0f}"


def published(seeds: int = 4, minutes: int = 15) -> None:
    """Print all rows on the published road: humans, then the derived controller."""
    labels, both = list(PUBLISHED), (False, True)
    mine = [kept(f"short, derived {derived}", ours, SHORT, labels, seeds, minutes, derived) for derived in both]
    print("| IDM | published | SUMO | ours | published, derived | SUMO | ours |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for i, label in enumerate(labels):
        cells = []
        for k, derived in enumerate(both):
            name = f"zipper, derived {derived}, {label}"
            beside = kept(name, lane_drop_zipper.sumo, varied(label), derived)
            cells += [f"{PUBLISHED[label][k]:.0f}", _told(beside), _told(mine[k][i])]
        print(f"| {label} | {' | '.join(cells)} |", flush=True)


def main(seeds: int = 4, minutes: int = 30) -> None:
    """Print all rows on the long road."""
    mine = kept("long", ours, LONG, list(PUBLISHED), seeds, minutes)
    print("| IDM | published | ours | SUMO, same road | ours / SUMO |")
    print("| --- | --- | --- | --- | --- |")
    for row, (label, (theirs, _)) in zip(mine, PUBLISHED.items(), strict=True):
        beside = kept(f"long, SUMO, {label}", sumo, minutes, varied(label))
        ratio = "" if beside is None else f"{row[0] / beside:.2f}"
        print(f"| {label} | {theirs:.0f} | {_told(row)} | {_told(beside)} | {ratio} |", flush=True)
