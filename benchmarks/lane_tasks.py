"""What it takes to beat human drivers in the tasks of several lanes: ``python -m benchmarks.lane_tasks [NAME ...]``.

A tenth of those who enter are agents, whose commands count only as far as their driver would go himself. Rows are what
learns nothing; a policy that is said to learn must beat the last of them.

* *humans*: nobody is commanded.
* *constant*: the best of seven accelerations.
* *IDM with other numbers*: the best of ``DRAWS`` drivers, numbers drawn evenly in their logarithms.
* *ALINEA* (Papageorgiou, Hadj-Salem, Blosseville 1991, Transp. Res. Rec. 1320), where there is a ramp: a signal on the
  ramp that every vehicle there obeys, ``r ← r + K (ô − o)``, o being the density behind the merge. It is no agent.
* *green-wave speed advice* (GLOSA), where there is a signal: agents drive as fast as one may to arrive in green.
* *speed by lane and place*: the best of ``DRAWS`` rules, each of which holds every agent to a speed on each lane before
  a place of its own, drawn evenly.
* *the same, all vehicles*: that rule where everybody is an agent.

A search drives all that it has drawn for two episodes, and the best quarter for eight others. The best is judged on 32
fresh episodes of 600 s, the same for all rows: mean return (minus the delay of all, vehicle-hours), vehicles an hour
that get out, and that leave the ramp's lane; beside each return its mean difference to *humans* with the 95 % interval
over episodes. ``--policy FILE`` adds a checkpoint of an agent to the rows of its task.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from agents.common import load
from agents.evaluate import judge_lanes
from agents.rollout import Act, episodes_start
from benchmarks import command
from idm_env.effects.idm import interaction
from idm_env.tasks.open_lanes import OpenLanesTask
from idm_env.types import Driver

JOINT = {"controlled": 0.1, "careful": True, "added": False}
DEMANDS: dict[str, dict[str, Any]] = {
    "merge 2400 + 500": {**JOINT, "task": "merge", "inflow": 2400.0, "ramp_inflow": 500.0},
    "merge 3000 + 800": {**JOINT, "task": "merge"},
    "bottleneck 1900": {**JOINT, "task": "bottleneck"},
    "open_highway 5000": {**JOINT, "task": "open_highway"},
    "approach 1200": {**JOINT, "task": "approach", "controlled": 1.0 / 3.0},
}
DRAWS, JUDGED_ON = 24, 32
CONSTANT = (-1.0, -0.5, 0.0, 0.1, 0.25, 0.5, 1.0)
"""Accelerations (m/s²); from 1.5 m/s² on a command is what the driver does."""
IDM_NUMBERS = (5.0, 0.5, 1.0, 0.3, 0.5), (35.0, 3.0, 6.0, 2.0, 4.0)
"""Least and most v0 (m/s), T (s), s0 (m), a and b (m/s²)."""
LEAST = 5.0
"""Speed (m/s) below which green-wave advice does not go."""
GREEN, LINE, SENSOR = 30.0, 350.0, (500.0, 700.0)
"""Seconds between two rates of the signal, its place, and where density is measured (m)."""
DENSITY, GAIN = 25.0, 40.0
"""Density (vehicles per km and lane) that ALINEA keeps, and its gain (vehicles an hour per vehicle and km)."""

Found = dict[str, Any]


class Seen:
    """What agents observe of themselves, in SI units, ``(n, agents)``."""

    def __init__(self, task: OpenLanesTask, seen: Tensor) -> None:
        column = task.by_name(seen.flatten(1))
        self.speed, self.lane, self.position = column["speed"], column["lane"].round().long(), column["position"]
        self.present, self.limit = column["present"] > 0.5, task.command_limits[1]
        self._nearby = [
            [column[f"{what}_{k}"] for k in range(task.seen)] for what in ("there", "ahead", "left", "speed")
        ]
        self._length = task.vehicle_length
        self.signal = tuple(column[name] for name in ("line", "red", "until") if name in column)

    def idm(self, v0: Tensor, headway: Tensor, s0: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Return the action of IDM drivers with these numbers, behind whom they see ahead on their lane."""
        presence, ahead, left, faster = (torch.stack(each, -1) for each in self._nearby)
        way = torch.where((presence > 0.5) & (left.round() == 0) & (ahead > 0.0), ahead, torch.inf)
        gap, first = way.min(-1)
        closing = torch.where(gap.isfinite(), -faster.gather(-1, first.unsqueeze(-1)).squeeze(-1), 0.0)
        driver = Driver(a, b, headway, s0, v0)
        brake = interaction(driver, self.speed, gap - self._length, self.speed - closing)
        return (a * (1.0 - (self.speed / v0) ** 4 - brake) / self.limit).clamp(-1.0, 1.0)

    def towards(self, target: Tensor) -> Tensor:
        """Return the action that reaches a speed (m/s) within 2 s."""
        return ((target - self.speed) / (2.0 * self.limit)).clamp(-1.0, 1.0)


def by_place(task: OpenLanesTask, rules: Tensor, episodes: int) -> Act:
    """Return agents who keep below a speed on their lane before a place: ``rules`` ``(n, lanes, 2)``."""
    each = rules.repeat_interleave(episodes, 0)

    def act(seen: Tensor) -> Tensor:
        own = Seen(task, seen)
        speed, place = (each[..., k].gather(-1, own.lane) for k in (0, 1))
        return own.towards(torch.where(own.position < place, speed, 40.0))

    return act


def constants(task: OpenLanesTask, values: Tensor, episodes: int) -> Act:
    """Return agents who always command the same (m/s²)."""
    each = values.repeat_interleave(episodes)
    return lambda seen: task.action(each.unsqueeze(-1).expand(-1, len(task.agents)))


def drivers(task: OpenLanesTask, values: Tensor, episodes: int) -> Act:
    """Return agents who drive by IDM with other numbers."""
    each = values.repeat_interleave(episodes, 0).unsqueeze(1).unbind(-1)
    return lambda seen: Seen(task, seen).idm(*each)


def glosa(task: OpenLanesTask) -> Act:
    """Return agents who follow green-wave speed advice: as fast as one may to arrive when it becomes green.

    Who would arrive in green drives on; nobody is advised to drive below ``LEAST``.
    """
    signal = task.own_parameters["signal"]
    red, v0 = float(signal["red"]), float(task.own_parameters["idm"]["desired_speed"])

    def act(seen: Tensor) -> Tensor:
        own = Seen(task, seen)
        way, stops, until = own.signal
        green = torch.where(stops > 0.5, until, until + red)  # when it becomes green (s)
        catches = (stops < 0.5) & (way / v0 < until)
        late = (stops > 0.5) & (way / v0 > until)
        advice = (way / green.clamp_min(0.1)).clamp_min(LEAST)
        return own.towards(torch.where((way > 0.0) & ~catches & ~late, advice, 40.0))

    return act


class Alinea:
    """A signal on the ramp that all vehicles there obey; everybody must be an agent."""

    def __init__(self, task: OpenLanesTask) -> None:
        self.task, self.step = task, 0
        self.rate, self.credit, self.density = (torch.zeros(0) for _ in range(3))
        self.passed = torch.zeros(0, dtype=torch.long)

    def __call__(self, seen: Tensor) -> Tensor:
        """Return the actions of all vehicles: whoever is not held drives as he would."""
        own, hold = Seen(self.task, seen), self.task.held * self.task.simulator.dt
        if self.step == 0:
            self.rate, self.density = torch.full((len(seen),), 800.0), torch.zeros(len(seen))
            self.credit, self.passed = torch.ones(len(seen)), torch.zeros(len(seen), dtype=torch.long)
        behind = own.present & (own.lane > 0) & (own.position > SENSOR[0]) & (own.position < SENSOR[1])
        lanes = self.task.road.count - 1
        self.density += behind.sum(-1) * hold / (lanes * 1e-3 * (SENSOR[1] - SENSOR[0]))
        self.step += 1
        if self.step % round(GREEN / hold) == 0:
            self.rate = (self.rate + GAIN * (DENSITY - self.density / GREEN)).clamp(240.0, 1800.0)
            self.density.zero_()
        ramp = own.present & (own.lane == 0)
        passed = (ramp & (own.position >= LINE)).sum(-1)
        self.credit = (self.credit + self.rate * hold / 3600.0 - (passed - self.passed).clamp_min(0)).clamp_max(1.0)
        self.passed = passed
        way = torch.where(ramp & (own.position < LINE), LINE - own.position, torch.inf)
        first = way == way.amin(-1, keepdim=True)
        stop = -own.speed.square() / (2.0 * (way - 1.0).clamp_min(0.5))
        held = first & way.isfinite() & (self.credit < 1.0).unsqueeze(-1) & ((stop < -1.0) | (way < 3.0))
        return torch.where(held, (stop / own.limit).clamp(-1.0, 1.0), 1.0)


def judged(given: Mapping[str, Any], act: Callable[[OpenLanesTask, int], Act | None]) -> Found:
    """Return the figures of fresh episodes."""
    start = episodes_start(given, JUDGED_ON, draws=(1,))
    assert isinstance(start.task, OpenLanesTask)
    return judge_lanes(start, act(start.task, JUDGED_ON), 1)[0]


def searched(given: Mapping[str, Any], values: Tensor, make: Callable[[OpenLanesTask, Tensor, int], Act]) -> Tensor:
    """Return the best of some values: of those that were best on two episodes that on eight others."""
    for draw, episodes, left in ((2, 2, -(-len(values) // 4)), (3, 8, 1)):
        start = episodes_start(given, episodes, len(values), draws=(draw,))
        assert isinstance(start.task, OpenLanesTask)
        tried = judge_lanes(start, make(start.task, values, episodes), len(values))
        values = values[torch.tensor([row["reward"] for row in tried]).topk(left).indices]
    return values


def rows_of(given: Mapping[str, Any], policies: Sequence[Path]) -> dict[str, Found]:
    """Return the rows of a task, with the CPU seconds that each took."""
    generator, rows = torch.Generator().manual_seed(0), dict[str, Found]()
    begin = time.process_time()

    def row(name: str, found: Found) -> None:
        nonlocal begin
        rows[name] = {**found, "seconds": time.process_time() - begin}
        begin = time.process_time()

    row("humans", judged(given, lambda task, n: None))
    best = searched(given, torch.tensor(CONSTANT), constants)
    row(f"constant {float(best):+.2g} m/s²", judged(given, lambda task, n: constants(task, best, n)))
    low, high = torch.tensor(IDM_NUMBERS).log()
    numbers = (low + (high - low) * torch.rand(DRAWS, 5, generator=generator)).exp()
    chosen = searched(given, numbers, drivers)
    row("IDM with other numbers", judged(given, lambda task, n: drivers(task, chosen, n)))
    if given["task"] == "merge":
        row("ALINEA (no agent)", judged({**given, "controlled": "all"}, lambda task, n: Alinea(task)))
    if given["task"] == "approach":
        row("green-wave speed advice", judged(given, lambda task, n: glosa(task)))
        row("that advice, all vehicles", judged({**given, "controlled": "all"}, lambda task, n: glosa(task)))
    task = episodes_start(given, 1).task
    assert isinstance(task, OpenLanesTask)
    numbers_of_rules = torch.rand(DRAWS, task.road.count, 2, generator=generator)
    places = torch.stack((4.0 + 24.0 * numbers_of_rules[..., 0], 200.0 + 500.0 * numbers_of_rules[..., 1]), -1)
    place = searched(given, places, by_place)
    row("speed by lane and place", judged(given, lambda task, n: by_place(task, place, n)))
    everybody = {**given, "controlled": "all"}
    row("the same, all vehicles", judged(everybody, lambda task, n: by_place(task, place, n)))
    for path in policies:
        policy, content = load(path)
        if content["task"] == given["task"]:
            row(str(path), judged(given, lambda task, n, policy=policy: policy))
    return rows


def shown(name: str, rows: dict[str, Found]) -> Table:
    """Return the rows as a table."""
    table = Table(title=name)
    for head in ("row", "return, vehicle-h", "more than humans", "out, 1/h", "ramp, 1/h", "crashes", "CPU s"):
        table.add_column(head)
    humans = torch.tensor(rows["humans"]["rewards"])
    for who, figures in rows.items():
        more = (torch.tensor(figures["rewards"]) - humans) / 3600.0
        half = 2.040 * float(more.std()) / JUDGED_ON**0.5  # Student's t of 31 degrees of freedom
        table.add_row(
            who, f"{figures['reward'] / 3600.0:.2f}", f"{float(more.mean()):+.2f} ± {half:.2f}",
            f"{figures['outflow']:.0f}", f"{figures['ramp']:.0f}", str(figures["collisions"]),
            f"{figures['seconds']:.0f}",
        )  # fmt: skip
    return table


def main(names: tyro.conf.Positional[tuple[Literal[tuple(DEMANDS)], ...]] = (), policy: Sequence[Path] = ()) -> None:
    """Print the rows of the tasks that are asked for.

    Args:
        names: Of rows of tasks; by default all.
        policy: Checkpoints of agents.
    """
    torch.set_num_threads(1)
    for name in names or DEMANDS:
        Console(width=140).print(shown(name, rows_of(DEMANDS[name], policy)))


if __name__ == "__main__":
    command(main)
