"""Outflow of a road of 4 → 2 → 1 lanes that 2600 vehicles an hour want to enter: published, ours, and SUMO's today.

``python -m benchmarks.lanes drop`` drives it for 30 minutes and counts in the last 20: IDM with MOBIL and
``MandatoryChange`` here, IDM with LC2013 in SUMO (``libsumo``, where it is installed), on the same road. Lanes end at
500 and 750 m of 1000 m.

The published figures (Yan, Kreidieh, Vinitsky, Bayen and Wu 2022, "Unified automatic control of vehicular systems with
reinforcement learning", IEEE T-ASE) are of another road, known from the authors' code: 100, 100 and 50 m, entered at
standstill, on which nobody changes lanes: pairs of lanes join as zippers. ``drop published`` drives that one
(``lane_drop_zipper.py``), in SUMO as a zipper, here with lanes that end at 100 and 200 m; with human drivers, and with
a fifth of vehicles under the authors' derived controller. ``drop behaviours`` changes one behaviour of ours at a time
on that road. Rows are kept in ``out/lane-drop.jsonl``.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from benchmarks import lane_drop_zipper, lanes_sumo, workers
from benchmarks.lane_drop_zipper import BASE, FLOW
from benchmarks.lanes_sumo import Edge
from idm_env import population
from idm_env.effects import IDM, Brakes, Control, Courtesy, MandatoryChange, Mobil, Noise
from idm_env.progress import OnProgress
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
LETS_GO = 10.0
"""Nearer to a merge than this (m) the derived controller holds nobody back."""
KEPT = Path("out/lane-drop.jsonl")


class Place(NamedTuple):
    """Where the outer lanes, then one of the others, then the road end (m), how fast one enters (m/s), and slots."""

    first: float
    second: float
    end: float
    speed: float
    slots: int


LONG, SHORT = Place(500.0, 750.0, 1000.0, 15.0, 400), Place(100.0, 200.0, 250.0, 0.0, 200)


EDGES = (
    Edge("a", "n0", "n1", 4, 0.0, LONG.first), Edge("b", "n1", "n2", 2, LONG.first, LONG.second, 1),
    Edge("c", "n2", "n3", 1, LONG.second, LONG.end, 1),
)  # fmt: skip


def varied(label: str) -> dict[str, float]:
    """Return the parameters of a row."""
    name, _, value = label.partition(" ")
    return {**BASE, name: float(value)} if name in BASE else dict(BASE)


class Behaviour(NamedTuple):
    """What differs from drivers as they stand: parameters, and how they change lanes."""

    changed: Mapping[str, float] = {}
    courteous: bool = False
    mobil: bool = True
    duration: float = 0.0


LABELS = list(PUBLISHED)
AS_IT_STANDS, COURTEOUS = Behaviour(), Behaviour(courteous=True)
BEHAVIOURS: dict[str, Behaviour] = {
    "as it stands": AS_IT_STANDS,
    "`MandatoryChange` A 20 m/s²": Behaviour({"mandatory_change.strength": 20.0}),
    "D 30 m": Behaviour({"mandatory_change.reach": 30.0}),
    "safe deceleration 1 m/s²": Behaviour({"mandatory_change.safe_decel": 1.0, "mobil.safe_decel": 1.0}),
    "safe deceleration 9 m/s²": Behaviour({"mandatory_change.safe_decel": 9.0, "mobil.safe_decel": 9.0}),
    "a change takes 3 s": Behaviour(duration=3.0),
    "no MOBIL": Behaviour(mobil=False),
    "no MOBIL, D 30 m": Behaviour({"mandatory_change.reach": 30.0}, mobil=False),
    **{f"`Courtesy` w {w:g}": Behaviour({"courtesy.weight": w}, True) for w in (0.25, 0.5, 0.75, 1.0)},
}


class Part(NamedTuple):
    """A part of a table: rows of ours on one road, or one row of SUMO's on the long or on the published one."""

    who: str
    labels: list[str]
    place: Place
    minutes: int
    seeds: int = 1
    derived: bool = False
    behaviour: Behaviour = AS_IT_STANDS


def drive(part: Part, on_progress: OnProgress) -> Any:
    """Return outflow: of ours rows of mean, standard error and queue; of SUMO a number, None without ``libsumo``."""
    if part.who == "ours":
        return ours(part)
    values = varied(part.labels[0])
    return sumo(part.minutes, values) if part.who == "sumo" else lane_drop_zipper.sumo(values, part.derived)


def ours(part: Part) -> list[list[float]]:
    """Return vehicles per hour out in the last two thirds of the time, its error and how many queue, for every row."""
    _, labels, place, minutes, seeds, derived, behaviour = part
    ends = (lane_drop(0, at=place.first), lane_drop(3, at=place.first), lane_drop(2, at=place.second))
    lateral = (*([Mobil()] if behaviour.mobil else []), MandatoryChange(), *([Courtesy()] * behaviour.courteous))
    road = Lanes(4, length=place.end, ends=ends, duration=behaviour.duration)
    simulator = Simulator(road, (IDM(), Noise(), *lateral, Control(), Brakes()), dt=DT)
    given = population.trips(dict.fromkeys(range(4), FLOW / 4), 3600.0, speed=place.speed, slots=place.slots)
    rows, n = len(labels) * seeds, len(given.departs)
    params = simulator.defaults(dtype=torch.float32)
    for name in BASE:
        column = torch.tensor([varied(label)[name] for label in labels])
        params["idm"][name] = column.repeat_interleave(seeds).unsqueeze(-1)
    params["noise"]["sigma"] = torch.tensor(0.2)  # at every step: 0.4 m/s² per √s, twice what is published
    for name, value in behaviour.changed.items():
        effect, _, parameter = name.partition(".")
        params[effect][parameter] = torch.tensor(value)
    begin = state = population.waiting(simulator, population.spread(given, (rows, n)), params)
    chosen = torch.rand((rows, n), generator=torch.Generator().manual_seed(1)) < lane_drop_zipper.SHARE
    steps = 1 if derived else int(20.0 / DT)
    for number in range(60 * minutes * int(1.0 / DT) // steps):
        stop = stands(state, chosen, place) if derived else torch.zeros((rows, n), dtype=torch.bool)
        brake = Command(torch.full((steps, 1, 1), -BASE["comfort_decel"]), stop.expand(steps, rows, n))
        state, _ = simulator.rollout(state, {"control": brake}, params, steps, keep=None, seed=number)
        begin = state if (number + 1) * steps == int(20.0 * minutes / DT) else begin
    assert begin.trips is not None and state.trips is not None
    out = (state.trips.left - begin.trips.left).sum(-1).view(-1, seeds) / (minutes * 40.0 / 3600.0)
    queued = population.counts(simulator, state).queued.view(-1, seeds).double().mean(-1)
    error = out.double().std(-1) / math.sqrt(seeds) if seeds > 1 else torch.zeros(len(labels))
    return [list(row) for row in zip(out.double().mean(-1).tolist(), error.tolist(), queued.tolist(), strict=True)]


def stands(state: State, chosen: torch.Tensor, place: Place) -> torch.Tensor:
    """Return which of the chosen vehicles stop for a human beside them, by the derived controller (bool).

    Within 20 m of where its lane and the other of its pair become one, a vehicle stops while the next one behind it on
    that other lane is a human within 30 m of there. In the last 10 m it goes on: here, unlike at a zipper, whoever has
    to change lanes beside one that stands would wait for ever.
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
    near = (to_end > LETS_GO) & (to_end < lane_drop_zipper.REACH) & (position < place.second) & (state.present > 0)
    return chosen & near & human & (way + to_end < lane_drop_zipper.SIGHT)


def sumo(minutes: int, values: Mapping[str, float]) -> float | None:
    """Return vehicles per hour out of the long road in SUMO (IDM, LC2013); None without ``libsumo``."""
    options = ["--step-method.ballistic", "--collision.action", "none", "--error-log", os.devnull, "--seed", "1"]
    with lanes_sumo.started(lanes_sumo.net(EDGES), _routes(minutes * 60.0, values), DT, *options) as libsumo:
        if libsumo is None:
            return None
        left = 0
        for k in range(int(minutes * 60.0 / DT)):
            libsumo.simulationStep()
            left += libsumo.simulation.getArrivedNumber() if k * DT >= minutes * 20.0 else 0
        return left / (minutes * 40.0 / 3600.0)


def _routes(seconds: float, values: Mapping[str, float]) -> str:
    kind = f'<vType id="t" {lanes_sumo.idm(values)} speedDev="0"/><route id="r" edges="a b c"/>'
    flows = "".join(
        f'<flow id="f{k}" type="t" route="r" begin="0" end="{seconds}" vehsPerHour="{FLOW / 4}" departLane="{k}" '
        'departSpeed="15"/>'
        for k in range(4)
    )
    return f"<routes>{kind}{flows}</routes>"


def _told(found: Any) -> str:
    if found is None:
        return "libsumo is not installed"
    return f"{found:.0f}" if isinstance(found, float) else f"{found[0]:.0f} ± {found[1]:.0f}"


def on_the_published_road(seeds: int = 4, minutes: int = 15) -> dict[str, Part]:
    """Return our parts of that table by name: humans, then the controller, each without and with ``Courtesy``."""
    return {
        f"short, {name}, derived {derived}": Part("ours", LABELS, SHORT, minutes, seeds, derived, how)
        for derived in (False, True)
        for name, how in (("nobody lets in", AS_IT_STANDS), ("courtesy", COURTEOUS))
    }


def published(arguments: argparse.Namespace, minutes: int = 15) -> None:
    """Print all rows on the published road: humans, ours without and with ``Courtesy``; then the controller."""
    mine = on_the_published_road(minutes=minutes)
    theirs = {
        f"zipper, {label}, derived {derived}": Part("zipper", [label], SHORT, minutes, derived=derived)
        for derived in (False, True)
        for label in LABELS
    }
    found = workers.named(drive, {**mine, **theirs}, KEPT, arguments)
    three = "SUMO | nobody lets in | Courtesy"
    print(f"| IDM | published | {three} | controller: published | {three} |")
    print("| --- |" + " --- |" * 8)
    for i, label in enumerate(LABELS):
        cells = []
        for k, derived in enumerate((False, True)):
            cells += [f"{PUBLISHED[label][k]:.0f}", _told(found[f"zipper, {label}, derived {derived}"])]
            cells += [_told(found[name][i]) for name, part in mine.items() if part.derived == derived]
        print(f"| {label} | {' | '.join(cells)} |")


def behaviours(arguments: argparse.Namespace, seeds: int = 4, minutes: int = 15) -> None:
    """Print outflow on the published road with one behaviour changed at a time, over what is published."""
    parts = {
        f"short, {name}": Part("ours", LABELS, SHORT, minutes, seeds, behaviour=b) for name, b in BEHAVIOURS.items()
    }
    found = workers.named(drive, parts, KEPT, arguments)
    print(f"| ours / published | {' | '.join(LABELS)} | within 10 % |")
    print("| --- |" + " --- |" * (len(LABELS) + 1))
    for name in BEHAVIOURS:
        ratios = [row[0] / PUBLISHED[label][0] for row, label in zip(found[f"short, {name}"], LABELS, strict=True)]
        near = sum(abs(ratio - 1.0) <= 0.1 for ratio in ratios)
        print(f"| {name} | {' | '.join(f'{ratio:.2f}' for ratio in ratios)} | {near} of {len(ratios)} |")


def main(arguments: argparse.Namespace, seeds: int = 4, minutes: int = 30) -> None:
    """Print all rows on the long road."""
    mine = {
        f"long, {name}": Part("ours", LABELS, LONG, minutes, seeds, behaviour=how)
        for name, how in (("nobody lets in", AS_IT_STANDS), ("courtesy", COURTEOUS))
    }
    theirs = {f"long, SUMO, {label}": Part("sumo", [label], LONG, minutes) for label in LABELS}
    found = workers.named(drive, {**mine, **theirs}, KEPT, arguments)
    print("| IDM | SUMO, same road | nobody lets in | / SUMO | Courtesy | / SUMO |")
    print("| --- | --- | --- | --- | --- | --- |")
    for i, label in enumerate(LABELS):
        beside, cells = found[f"long, SUMO, {label}"], []
        for name in mine:
            row = found[name][i]
            cells += [_told(row), "" if beside is None else f"{row[0] / beside:.2f}"]
        print(f"| {label} | {_told(beside)} | {' | '.join(cells)} |")
