"""What foresight is worth where traffic merges, the oracle of open roads: ``python -m benchmarks.lane_planner``.

A tenth of those who enter are agents, whose commands count only as far as their driver would go himself. A planner
knows model, state and arrivals. Every ``EVERY`` s it drives copies of the present world ``AHEAD`` s on, under each of
five rules, and commands the best until it chooses anew. A rule holds agents before ``PLACE`` to a speed on each lane;
the first one commands nobody. Rows, on the same episodes of 600 s:

* *humans*: nobody is commanded.
* *planner*: without drivers' noise it knows the future. With noise its copies have another one: the mean of
  several counts (``--branches``).
* *planner, seldom*: it commands only what saves ``WORTH`` vehicle-seconds more than no command.
* *another's plan*: what the planner chose in the next episode, which tells what the same commands are worth blindly.

Beside each: return (minus the delay of all), the paired difference to humans with its 95 % interval, the least one that
so many episodes show with 80 % power, episodes that break down (a delay beyond ``BROKEN``) and crash, the share of
decisions that command somebody, and CPU seconds. Rules and ``EVERY`` were chosen on other episodes (``--draw 2``).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from agents.rollout import SEED
from benchmarks import command, table
from benchmarks.lane_tasks import DEMANDS, by_place
from benchmarks.tasks import batch_of
from idm_env.envs.batch import Batch
from idm_env.tasks.open_lanes import OpenLanesTask
from idm_env.types import mapped

RULES = (40.0, 40.0, 40.0), (20.0, 20.0, 20.0), (15.0, 15.0, 15.0), (10.0, 10.0, 10.0), (40.0, 15.0, 40.0)
"""Speeds (m/s) on the ramp's lane, on the one beside it and on the left one; 40 holds nobody."""
PLACE, EVERY, AHEAD, SECONDS = 500.0, 20, 60, 600
"""Where rules end (m), seconds between decisions, those that one looks ahead, and of an episode; a step is one."""
WORTH, BROKEN = 30.0, 4.0
"""Vehicle-seconds, and vehicle-hours."""
OTHER_NOISE = 1 << 42
"""First seed of the copies' noise, above those of all episodes."""

Choose = Callable[[Batch, int], Tensor]
"""Episodes and the number of a decision to the rule of each, ``(n,)``."""


def episodes_of(name: str, noise: float, seeds: Sequence[int]) -> Batch:
    """Return episodes of a row of tasks as they begin, one for each seed."""
    keywords: dict[str, Any] = {**DEMANDS[name], "reward": "delay", "crash_cost": 0.0, "noise": noise}
    return batch_of(seeds, **keywords)


def drive(batch: Batch, choices: Tensor, seconds: int) -> tuple[Tensor, Tensor]:
    """Drive on under a rule for each row; return what that pays (vehicle-s) and crashes, ``(n,)``."""
    task, world, speeds = batch.task, batch.world, torch.tensor(RULES)[choices]
    assert isinstance(task, OpenLanesTask) and world is not None
    act = by_place(task, torch.stack((speeds, torch.full_like(speeds, PLACE)), -1), 1)
    paid, crashed = torch.zeros(batch.count, dtype=torch.float64), torch.zeros(batch.count, dtype=torch.bool)
    seen = task.observe(world).flatten(1)
    for _ in range(seconds):
        outcome = batch.step(act(seen).numpy())
        seen = torch.tensor(outcome.observation).flatten(1)
        paid += torch.tensor(outcome.reward)[:, 0]
        crashed |= torch.tensor(outcome.terminated).any(-1)
    return paid, crashed


def foresee(batch: Batch, copies: Batch, first: int) -> Tensor:
    """Return what each rule pays in copies of present worlds, ``(n, rules)``, with the noise of seeds from one on.

    Copies lie by episode, rule and branch; a branch has the same noise under all rules.
    """
    each = copies.count // batch.count
    branches = each // len(RULES)
    seeds = torch.arange(first, first + batch.count * branches).view(-1, 1, branches).expand(-1, len(RULES), -1)
    copies.seed(range(copies.count), seeds.flatten().tolist())
    copies.reset()  # forgets the normals that were drawn
    copies.world = mapped(lambda x: x.repeat_interleave(each, 0), batch.world)
    choices = torch.arange(len(RULES)).repeat_interleave(branches).repeat(batch.count)
    return drive(copies, choices, AHEAD)[0].view(batch.count, len(RULES), branches).mean(-1)


def planner(name: str, noise: float, count: int, branches: int, worth: float) -> Choose:
    """Return what chooses the best rule, and no command where none saves so many vehicle-seconds more."""
    copies = episodes_of(name, noise, range(count * len(RULES) * (branches if noise else 1)))
    free = torch.tensor([worth] + [0.0] * (len(RULES) - 1))
    return lambda batch, i: (foresee(batch, copies, OTHER_NOISE + i * copies.count) + free).argmax(-1)


def rows_of(
    name: str, noise: float, seeds: Sequence[int], branches: int
) -> dict[str, tuple[Tensor, Tensor, Tensor, float]]:
    """Return returns (vehicle-h) and crashes ``(n,)``, chosen rules ``(decisions, n)`` and CPU s, by row."""
    count, rows = len(seeds), dict[str, tuple[Tensor, Tensor, Tensor, float]]()
    ways: dict[str, Callable[[], Choose]] = {
        "humans": lambda: lambda batch, i: torch.zeros(count, dtype=torch.long),
        "planner": lambda: planner(name, noise, count, branches, 0.0),
        "planner, seldom": lambda: planner(name, noise, count, branches, WORTH),
        "another's plan": lambda: lambda batch, i: rows["planner"][2][i].roll(-1),
    }
    for who, way in ways.items():
        begin, batch, choose, parts = time.process_time(), episodes_of(name, noise, seeds), way(), list[list[Tensor]]()
        for i in range(SECONDS // EVERY):
            choices = choose(batch, i)
            parts.append([*drive(batch, choices, EVERY), choices])
        paid, crashes, every = (torch.stack(each) for each in zip(*parts, strict=True))
        rows[who] = paid.sum(0) / 3600.0, crashes.any(0), every, time.process_time() - begin
    return rows


def main(
    name: Literal["merge 3000 + 800", "merge 2400 + 500"] = "merge 3000 + 800",
    noise: Sequence[float] = (0.0, 0.2), episodes: int = 64, draw: int = 1, branches: int = 4,
) -> None:  # fmt: skip
    """Print the rows of a task.

    Args:
        name: Row of tasks.
        noise: Of drivers (m/s² per √s), each in turn.
        episodes: How many are judged.
        draw: Of these episodes.
        branches: Copies of a world for each rule under noise.
    """
    torch.set_num_threads(1)
    head = "noise, row, return in vehicle-h, more than humans, least shown, broken down, crashes, commands, CPU s"
    lines = list[list[str]]()
    for sigma in noise:
        rows = rows_of(name, sigma, range(SEED + 1000 * draw, SEED + 1000 * draw + episodes), branches)
        for who, (paid, crashed, choices, spent) in rows.items():
            more = paid - rows["humans"][0]
            error, share = float(more.std()) / episodes**0.5, 100.0 * float((choices > 0).float().mean())
            broken = f"{int((paid < -BROKEN).sum())} of {episodes}"
            compared = f"{float(more.mean()):+.2f} ± {1.96 * error:.2f}", f"{2.8 * error:.2f}"
            row = (f"{sigma:g}", who, f"{float(paid.mean()):.2f}", *compared, broken, str(int(crashed.sum())))
            lines.append([*row, f"{share:.0f} %", f"{spent:.0f}"])
    print(table(head.split(", "), lines))


if __name__ == "__main__":
    command(main)
