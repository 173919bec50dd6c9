"""Capacity drop at a ramp: what flows before traffic breaks down, and what comes out of the jam afterwards.

``python -m benchmarks.lanes capacity``: two lanes, and a ramp from which one merges between 3000 and 3200 m, 400 m
before the end. Demand rises by 25 vehicles an hour each minute, a fifth of it on the ramp. Traffic has broken down when
on the 400 m before the ramp the mean speed falls below 15 m/s and stays there for five minutes. Flow is counted 200 m
behind the ramp, for five minutes that end five minutes before that (flow there falls before speed upstream does), and
from five minutes after it on, for 15 minutes or until the hour is over: so neither is chosen for being high or low. A
run that breaks down before its road is filled and these minutes have passed is too early to be counted. Every row
changes one thing; SUMO (``libsumo``: IDM without noise, LC2013) drives the same road with departures by the same law,
of a demand that begins lower, because its traffic breaks down earlier. Rows are kept in ``out/lanes-capacity.jsonl``.

Beside it, without any merging: what comes out of a standing queue on one lane, over the largest flow of equal gaps and
speeds (Treiber, Hennecke and Helbing 2000 call the former the dynamic capacity).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks import lanes_sumo, workers
from benchmarks.lanes_merge import DRIVER, RAMP
from benchmarks.lanes_sumo import Edge
from idm_env import keep, population
from idm_env import report as page
from idm_env.effects import IDM, Brakes, Courtesy, Effect, MandatoryChange, Mobil, Noise
from idm_env.effects.idm import equilibrium_gap
from idm_env.progress import OnProgress
from idm_env.roads import Lane, Lanes, on_ramp
from idm_env.simulator import Simulator
from idm_env.types import State, Trips

FIRST, LAST, MINUTES = 2800.0, 4300.0, 60
"""Demand at the beginning and in the end (vehicles/h)."""
BEGIN, END, ENTRY, COUNTED, LENGTH = 3000.0, 3200.0, 2700.0, 3400.0, 3600.0
FILLS, BEFORE, AFTER, LEAST, WAIT, STAYS = 3, 5, 15, 5, 5, 5
"""Minutes until the road is filled, that are counted before a breakdown, after it (at most, at least), that pass
between each of these and the breakdown, and that it lasts."""
SLOW = 15.0
DT, SEEDS, SPEED, NOISE = 0.2, 6, 20.0, 0.2
KEPT = Path("out/lanes-capacity.jsonl")


@dataclass(frozen=True)
class Case:
    """Drivers of one row: parameters that differ from ``DRIVER``, further effects, and whether anything is random.

    And their demand in the beginning (vehicles/h), and in how many runs they drive.
    """

    changed: Mapping[str, float] = field(default_factory=dict)
    more: tuple[Effect, ...] = ()
    alike: bool = False
    differ: float = 0.0
    first: float = FIRST
    seeds: int = SEEDS


PUSH = {"mobil.safe_decel": 9.0, "mandatory_change.safe_decel": 9.0}
LET_IN = (Courtesy(),)
CASES: dict[str, Case] = {
    "nobody lets in": Case(),
    "`Courtesy`": Case(more=LET_IN),
    "`Courtesy`, b_safe 9 m/s²": Case(PUSH, LET_IN),
    "… a 0.8 m/s²": Case({**PUSH, "idm.max_accel": 0.8}, LET_IN),
    "… a 0.5 m/s²": Case({**PUSH, "idm.max_accel": 0.5}, LET_IN),
    "… a 0.8, no noise, even departures": Case({**PUSH, "idm.max_accel": 0.8}, LET_IN, alike=True, seeds=1),
    "… a 0.8, v0 and T differ by 15 %": Case({**PUSH, "idm.max_accel": 0.8}, LET_IN, differ=0.15),
    "… a 0.8, MOBIL threshold 1 m/s²": Case({**PUSH, "idm.max_accel": 0.8, "mobil.threshold": 1.0}, LET_IN),
}
THEIRS = {f"a {a:g} m/s²": Case({"idm.max_accel": a}, first=2000.0) for a in (1.5, 0.8, 0.5)}


def departures(seed: int, alike: bool, begins: float = FIRST) -> Trips:
    """Return trips of a demand that rises evenly; at random, or evenly spaced."""
    draw, total = torch.Generator().manual_seed(seed), 60.0 * MINUTES
    departs, lanes = [], []
    for lane, share in {0: RAMP, 1: 0.5 * (1.0 - RAMP), 2: 0.5 * (1.0 - RAMP)}.items():
        first, rise = share * begins / 3600.0, share * (LAST - FIRST) / 3600.0 / total
        most = 2 * int(share * LAST / 3600.0 * total)
        each = torch.ones(most) if alike else torch.empty(most).exponential_(generator=draw)
        number = each.double().cumsum(0)
        # The time t at which that many have departed: first t + rise t²/2 = number.
        at = ((first * first + 2.0 * rise * number).sqrt() - first) / rise
        at = at[at < total]
        departs.append(at)
        lanes.append(torch.full((len(at),), lane))
    when, lane = torch.cat(departs), torch.cat(lanes)
    order = when.argsort(stable=True)
    when, lane = when[order].float(), lane[order]
    none = torch.zeros(len(when), dtype=torch.int64)
    return Trips(when, torch.full_like(when, math.inf), lane, torch.full_like(when, SPEED), none, none.clone())


def ours(case: Case) -> list[dict[str, Any]]:
    """Return what was counted in each run, minute by minute."""
    seeds = case.seeds
    road = Lanes(3, length=LENGTH, ends=(on_ramp(0, begin=BEGIN, end=END, entry=ENTRY),))
    simulator = Simulator(road, (IDM(), Noise(), Mobil(), MandatoryChange(), *case.more, Brakes()), dt=DT)
    each = [departures(seed, case.alike, case.first) for seed in range(1, seeds + 1)]
    most = max(len(given.departs) for given in each)
    given = Trips(*(torch.stack(column) for column in zip(*(_filled(one, most) for one in each), strict=True)))
    params = simulator.defaults(dtype=torch.float32)
    params["idm"].update({name: torch.tensor(value) for name, value in DRIVER.items()})
    params["noise"]["sigma"] = torch.tensor(0.0 if case.alike else NOISE)
    for name, value in case.changed.items():
        effect, _, parameter = name.partition(".")
        params[effect][parameter] = torch.tensor(value)
    if case.differ:
        draw = torch.Generator().manual_seed(99)
        for name in ("time_gap", "desired_speed"):
            aside = torch.randn((seeds, most), generator=draw).clamp(-2.0, 2.0)
            params["idm"][name] = params["idm"][name] * (1.0 + case.differ * aside)
    state = population.waiting(simulator, given, params)
    flow, speed, left = [], [], torch.zeros(seeds, dtype=torch.int64)
    for minute in range(MINUTES):
        paces = []
        for part in range(6):
            state, _ = simulator.rollout(state, {}, params, round(10.0 / DT), keep=None, seed=6 * minute + part)
            paces.append(_pace(state))
        passed = _passed(state)
        flow.append(60 * (passed - left))
        speed.append(torch.stack(paces).nanmean(0))
        left = passed
    queued = population.counts(simulator, state).queued
    return [
        {"flow": [int(x[i]) for x in flow], "speed": [float(x[i]) for x in speed], "queued": int(queued[i])}
        for i in range(seeds)
    ]


def _filled(given: Trips, most: int) -> Trips:
    """Return as many trips; those that are added never begin."""
    more = most - len(given.departs)
    never = torch.full((more,), 1e9)
    none = torch.zeros(more, dtype=torch.int64)
    added = Trips(never, torch.full_like(never, math.inf), none, torch.full_like(never, SPEED), none, none)
    return Trips(*(torch.cat(both) for both in zip(given, added, strict=True)))


def _passed(state: State) -> torch.Tensor:
    """Return how many have passed the place where they are counted."""
    assert state.present is not None and state.trips is not None
    return state.trips.left.sum(-1) + ((state.present > 0) & (state.position > COUNTED)).sum(-1)


def _pace(state: State) -> torch.Tensor:
    """Return the mean speed on the 400 m before the ramp (m/s), NaN where nobody is."""
    assert state.present is not None and state.links is not None
    there = (state.present > 0) & (state.links.lane > 0)
    there = there & (state.position > BEGIN - 400.0) & (state.position <= BEGIN)
    return (state.speed * there).sum(-1) / there.sum(-1)


def sumo(case: Case) -> list[dict[str, Any]] | None:
    """Return the same of SUMO; None without ``libsumo``."""
    found = [_of_sumo(case, seed) for seed in range(1, case.seeds + 1)]
    return None if None in found else found  # type: ignore[return-value]


EDGES = (
    Edge("first", "n0", "n1", 2, 0.0, BEGIN - 400.0, 1), Edge("second", "n1", "n2", 2, BEGIN - 400.0, BEGIN, 1),
    Edge("ramp", "r0", "n2", 1, ENTRY, BEGIN), Edge("merge", "n2", "n3", 3, BEGIN, END),
    Edge("third", "n3", "n4", 2, END, COUNTED, 1), Edge("last", "n4", "n5", 2, COUNTED, LENGTH, 1),
)  # fmt: skip


def _of_sumo(case: Case, seed: int) -> dict[str, Any] | None:
    values = {**DRIVER, **{name.removeprefix("idm."): x for name, x in case.changed.items() if name.startswith("idm.")}}
    given = departures(seed, case.alike, case.first)
    cars = "".join(
        f'<vehicle id="v{i}" type="t" route="{"r" if lane == 0 else "m"}" depart="{when:.2f}" '
        f'departLane="{max(lane - 1, 0)}" departSpeed="{SPEED}"/>'
        for i, (when, lane) in enumerate(zip(given.departs.tolist(), given.lane.tolist(), strict=True))
    )
    routes = (
        f'<routes><vType id="t" {lanes_sumo.idm(values)} speedDev="0"/>'
        '<route id="m" edges="first second merge third last"/><route id="r" edges="ramp merge third last"/>'
        f"{cars}</routes>"
    )
    options = ["--step-method.ballistic", "--collision.action", "none", "--seed", str(seed)]
    with lanes_sumo.started(lanes_sumo.net(EDGES), routes, DT, *options) as libsumo:
        return None if libsumo is None else _driven(libsumo, len(given.departs))


def _driven(libsumo: Any, count: int) -> dict[str, Any]:
    arrived, before, flow, speed, edge = 0, 0, [], [], libsumo.edge
    for _ in range(MINUTES):
        paces = []
        for step in range(round(60.0 / DT)):
            libsumo.simulationStep()
            arrived += libsumo.simulation.getArrivedNumber()
            if step % 50 == 49 and edge.getLastStepVehicleNumber("second"):
                paces.append(edge.getLastStepMeanSpeed("second"))
        passed = arrived + edge.getLastStepVehicleNumber("last")
        flow.append(60 * (passed - before))
        speed.append(float(np.mean(paces)) if paces else math.nan)
        before = passed
    inside = libsumo.vehicle.getIDCount()
    return {"flow": flow, "speed": speed, "queued": count - arrived - inside}


class Part(NamedTuple):
    """One row of the table."""

    who: str
    case: Case


def drive(part: Part, on_progress: OnProgress) -> list[dict[str, Any]] | None:
    """Return what was counted in every run of a row; None without ``libsumo``."""
    return ours(part.case) if part.who == "ours" else sumo(part.case)


def broken(speed: list[float]) -> int | None:
    """Return the minute in which traffic breaks down; None where it does not, or too late to be counted after it."""
    for minute in range(len(speed) - WAIT - LEAST + 1):
        if all(v < SLOW for v in speed[minute : minute + STAYS]):
            return minute
    return None


def drops(runs: list[dict[str, Any]]) -> list[tuple[float, float, float]]:
    """Return flow before and after the breakdown, and the most in as many minutes before, of runs that have both."""
    found = []
    for run in runs:
        minute, flow = broken(run["speed"]), run["flow"]
        if minute is not None and minute >= FILLS + BEFORE + WAIT:
            before = flow[minute - WAIT - BEFORE : minute - WAIT]
            after = flow[minute + WAIT : minute + WAIT + AFTER]
            found.append((float(np.mean(before)), float(np.mean(after)), max(_running(flow[:minute]))))
    return found


def _mean(values: list[float], form: str) -> str:
    """Return a mean with its standard error, which runs that are all the same do not have."""
    error = float(np.std(values, ddof=1)) / len(values) ** 0.5 if len(set(values)) > 1 else math.nan
    return f"{np.mean(values):{form}}" + ("" if math.isnan(error) else f" ± {error:{form.lstrip('+')}}")


COLUMNS = ("", "broke down", "too early", "most in 5 min before", "flow before", "out of the jam", "change", "queued")


def _row(name: str, runs: list[dict[str, Any]] | None) -> list[str]:
    if runs is None:
        return [name, "libsumo is not installed", *[""] * (len(COLUMNS) - 2)]
    found, broke = drops(runs), sum(broken(run["speed"]) is not None for run in runs)
    head = [name, f"{broke} of {len(runs)}", str(broke - len(found))]
    queued = f"{np.mean([run['queued'] for run in runs]):.0f}"
    if not found:
        most = "–" if broke else _mean([max(_running(run["flow"])) for run in runs], ".0f") + " in the hour"
        return [*head, most, "–", "–", "–", queued]
    change = [100.0 * (after / before - 1.0) for before, after, _ in found]
    before, after, most = (_mean([row[k] for row in found], ".0f") for k in (0, 1, 2))
    return [*head, most, before, after, f"{_mean(change, '+.1f')} %", queued]


def _running(flow: list[int]) -> list[float]:
    return [float(np.mean(flow[k : k + BEFORE])) for k in range(len(flow) - BEFORE + 1)]


def queue(
    accels: tuple[float, ...] = (3.0, 1.5, 0.8, 0.5), count: int = 240
) -> list[tuple[float, float, float, float]]:
    """Return, for each maximal acceleration, the static maximum of flow and what comes out of a standing queue.

    Vehicles per hour on one lane, without and with noise, between the 60th and the 220th, 500 m ahead.
    """
    simulator = Simulator(Lane(), (IDM(), Noise(), Brakes()), dt=DT)
    params = simulator.defaults(dtype=torch.float64)
    params["idm"].update({name: torch.tensor(value, dtype=torch.float64) for name, value in DRIVER.items()})
    params["idm"]["max_accel"] = torch.tensor(accels, dtype=torch.float64).unsqueeze(-1)
    speed = torch.linspace(0.1, 0.95 * DRIVER["desired_speed"], 4000, dtype=torch.float64)
    gap = equilibrium_gap(simulator.base.driver(dict(params["idm"])), speed)
    most = float((3600.0 * speed / (gap + 5.0)).max())
    position = (-(5.0 + DRIVER["min_gap"] + 0.2) * torch.arange(count).double()).expand(len(accels), count).contiguous()
    start = simulator.state(position, torch.zeros_like(position), params)
    flows = []
    for sigma in (0.0, NOISE):
        params["noise"]["sigma"] = torch.tensor(sigma, dtype=torch.float64)
        kept = simulator.rollout(start, {}, params, steps=round(900.0 / DT), seed=1)[1]
        assert kept is not None
        passed = DT * (kept.position < 500.0).sum(0).double()
        flows.append(160.0 / (passed[:, 220] - passed[:, 60]) * 3600.0)
    return [(a, most, float(x), float(y)) for a, x, y in zip(accels, *flows, strict=True)]


def picture(found: dict[str, list[dict[str, Any]] | None], path: Path) -> None:
    """Draw one run with a breakdown over time, and flow before and after it in all rows."""
    figure, axes = page.figure(1, 2, size=(10.0, 3.8))
    shown = next((r for r in found["… a 0.8 m/s²"] or [] if drops([r])), None)
    if shown is not None:
        minute = broken(shown["speed"])
        assert minute is not None
        first, second = axes[0, 0], axes[0, 0].twinx()
        flow = _running(shown["flow"])
        first.plot(np.arange(len(flow)) + 0.5 * BEFORE, flow, color="#1e5adc")
        first.plot((0, MINUTES), (FIRST, LAST), "--", color="#9aa0a8")
        second.plot(np.arange(MINUTES) + 0.5, shown["speed"], color="#d1495b", lw=1)
        for begin, end in ((minute - WAIT - BEFORE, minute - WAIT), (minute + WAIT, minute + WAIT + AFTER)):
            first.axvspan(begin, end, color="#e8a33d", alpha=0.2, lw=0)
        first.set(xlabel="minute", ylabel="flow behind the ramp (vehicles/h)", ylim=(1500, LAST))
        first.yaxis.label.set_color("#1e5adc")
        second.set(ylabel="speed before the ramp (m/s)", ylim=(0, 35))
        second.yaxis.label.set_color("#d1495b")
        first.set_title("one run, a 0.8 m/s²; dashed: demand; shaded: counted", fontsize=9)
    rows = [(name, drops(runs)) for name, runs in found.items() if runs is not None and drops(runs)]
    for y, (_, pairs) in enumerate(reversed(rows)):
        for k, colour, label in ((0, "#1e5adc", "before the breakdown"), (1, "#d1495b", "after it")):
            values = [pair[k] for pair in pairs]
            axes[0, 1].plot(values, [y] * len(values), "o", ms=3, color=colour, alpha=0.35)
            axes[0, 1].plot(np.mean(values), y, "D", ms=6, color=colour, label=label if y == 0 else None)
    names = [name.replace("`", "").replace("…", "Courtesy, b_safe 9,", 1) for name, _ in reversed(rows)]
    axes[0, 1].set_yticks(range(len(rows)), names, fontsize=8)
    axes[0, 1].set(xlabel="flow (vehicles/h)")
    axes[0, 1].legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    axes[0, 1].grid(alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    keep.write(path, lambda beside: figure.savefig(beside, dpi=110))


def table(arguments: argparse.Namespace, path: Path = Path("out/lanes-capacity.png")) -> None:
    """Print flow before and after breakdowns, and what comes out of a queue, and draw the former."""
    print("| a (m/s²) | static maximum | out of a queue | with noise |\n| --- | --- | --- | --- |")
    for accel, most, plain, noisy in queue():
        print(f"| {accel:g} | {most:.0f} | {plain:.0f} ({plain / most:.2f}) | {noisy:.0f} ({noisy / most:.2f}) |")
    parts = {name: Part("ours", case) for name, case in CASES.items()}
    parts |= {f"SUMO, {name}": Part("sumo", case) for name, case in THEIRS.items()}
    found = workers.named(drive, parts, KEPT, arguments)
    print(f"\n| {' | '.join(COLUMNS)} |\n|{' --- |' * len(COLUMNS)}")
    for name, runs in found.items():
        print(f"| {' | '.join(_row(name, runs))} |")
    picture(found, path)
    print(f"Picture: {path}")
