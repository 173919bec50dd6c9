"""What can be won where traffic merges: ``python -m benchmarks.lane_search NAME [--share 0.3]``.

A share of those who enter drive by an IDM of other numbers: its difference to the usual IDM is added to what the driver
does (``added=True``), so that ends of lanes and those who merge are minded as by all.

* *random search*: the rule. One driver for all lanes, drawn evenly in the logarithms of his five numbers.
* *evolution*: five numbers for each lane, by CMA-ES (Hansen 2016, arXiv 1604.00772; library ``cma``), from humans on.
  It sees returns of whole episodes only, and so who merges.
* *gradients*: the same numbers by APG: through traffic and driver, 24 windows of 120 s, from humans on.
* *ppo*, *shac*: networks that see what these tasks show, with added commands of a second, from humans on
  (``configs/merge-ppo.yaml``, ``configs/merge-shac.yaml``), in the CPU time of an evolution times ``--budget``.

The first two have the same ``GENERATIONS · DRIVERS · EPISODES`` episodes. What each seed finds is judged on
``JUDGED_ON`` fresh ones of 600 s, the same for all rows. Each row is kept in ``--out`` when it is done.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from agents.common import load, load_agent
from agents.environments import make_env
from agents.evaluate import judge_lanes
from agents.rollout import Act, episodes_start
from benchmarks import command, named_rows
from benchmarks.lane_tasks import DEMANDS, Found
from idm_env.effects.idm import interaction
from idm_env.jobs.progress import OnProgress
from idm_env.jobs.workers import HERE, Workers
from idm_env.tasks.open_lanes import OpenLanesTask
from idm_env.types import Driver

SEEN = {"features": ["speed", "lead_speed", "gap", "lane"], "scaling": "raw"}
HUMAN = (30.0, 1.2, 2.0, 1.5, 2.0)
"""v0 (m/s), T (s), s0 (m), a and b (m/s²) of drivers in these tasks."""
LEAST, MOST = (20.0, 0.5, 1.0, 0.8, 0.8), (40.0, 2.0, 4.0, 2.5, 3.0)
GENERATIONS, DRIVERS, EPISODES = 9, 10, 10
ROUNDS = (75, 4), (15, 20), (3, 100)
"""Drivers that a random search compares, and on how many episodes: as many in all as an evolution has."""
UPDATES, WINDOW, ROWS, RATE = 24, 120, 8, 0.03
JUDGED_ON, STUDENT = 64, 1.998
NETWORKS = ("ppo", "shac")
CONFIGS = Path(__file__).parents[1] / "configs"


class Drivers(nn.Module):
    """Acts of IDM drivers beside human ones: the difference of two accelerations. ``log`` ``(drivers, lanes, 5)``."""

    def __init__(self, log: Tensor, limit: float, episodes: int) -> None:
        super().__init__()
        self.log, self.limit, self.episodes = nn.Parameter(log), limit, episodes

    def forward(self, seen: Tensor) -> Tensor:
        """Return actions; rows are the episodes of the first driver, then those of the second, and so on."""
        speed, lead_speed, gap, lane = seen.unflatten(-1, (-1, 4)).unbind(-1)
        each = self.log.exp().repeat_interleave(self.episodes, 0) if len(self.log) > 1 else self.log.exp()
        own = [self._on(lane, number) for number in each.unbind(-1)]
        human = torch.tensor(HUMAN).unbind(-1)
        more = self._accel(speed, lead_speed, gap, *own) - self._accel(speed, lead_speed, gap, *human)
        return (more / self.limit).clamp(-1.0, 1.0)

    def _on(self, lane: Tensor, number: Tensor) -> Tensor:
        value = number[:, :1]
        for k in range(1, number.shape[1]):
            value = torch.where(lane > k - 0.5, number[:, k : k + 1], value)
        return value

    def _accel(self, speed: Tensor, lead_speed: Tensor, gap: Tensor, *numbers: Tensor) -> Tensor:
        v0, time_gap, s0, a, b = numbers
        restraint = interaction(Driver(a, b, time_gap, s0, v0), speed, gap.clamp_min(0.5), lead_speed)
        return a * (1.0 - (speed / v0) ** 4 - restraint)


@dataclass(frozen=True)
class Part:
    """A row: a task, how its drivers are found, and a seed."""

    name: str
    share: float
    how: str
    seed: int
    budget: float = 1.0
    """Of a network: the share of its file's updates and CPU seconds."""

    def __str__(self) -> str:
        return f"{self.name}, {self.share:g}, {self.how}, {self.seed}"

    @property
    def given(self) -> dict[str, Any]:
        """The keywords of its environment."""
        added = {"controlled": self.share, "careful": False, "added": True, "observation": SEEN}
        return {**DEMANDS[self.name], **added}


def task_of(environment: dict[str, Any]) -> OpenLanesTask:
    """Return the task."""
    task = episodes_start(environment, 1).task
    assert isinstance(task, OpenLanesTask)
    return task


def numbers_of(shares: Tensor) -> Tensor:
    """Return logarithms of numbers, ``(…, 5)``, from 0 (least) to 1 (most)."""
    low, high = torch.tensor(LEAST).log(), torch.tensor(MOST).log()
    return low + (high - low) * shares


def driven(environment: dict[str, Any], log: Tensor, episodes: int, draw: int) -> list[Found]:
    """Return the figures of each of some drivers in the same episodes."""
    start = episodes_start(environment, episodes, len(log), draws=(draw,))
    act: Act = Drivers(log, start.task.command_limits[1], episodes)
    return judge_lanes(start, act, len(log))


def returns(environment: dict[str, Any], log: Tensor, episodes: int, draw: int) -> Tensor:
    """Return the mean return (vehicle-hours) of each of some drivers; a crash is worse than any delay."""
    rows = driven(environment, log, episodes, draw)
    return torch.tensor([row["reward"] / 3600.0 - 1e3 * row["collisions"] for row in rows])


def blind(environment: dict[str, Any], seed: int) -> Tensor:
    """Return the best driver of a random search, ``(1, 1, 5)``."""
    generator = torch.Generator().manual_seed(seed)
    log = numbers_of(torch.rand(ROUNDS[0][0], 1, 5, generator=generator))
    for i, (count, episodes) in enumerate(ROUNDS):
        left = ROUNDS[i + 1][0] if i + 1 < len(ROUNDS) else 1
        log = log[returns(environment, log[:count], episodes, 1000 + 500 * seed + i).topk(left).indices]
    return log


def evolved(environment: dict[str, Any], seed: int) -> Tensor:
    """Return the mean of the last generation of CMA-ES, ``(1, lanes, 5)``."""
    import cma

    lanes, (low, high) = task_of(environment).road.count, numbers_of(torch.tensor([[0.0] * 5, [1.0] * 5]))
    begin = ((torch.tensor(HUMAN).log() - low) / (high - low)).clamp(0.05, 0.95).repeat(lanes).tolist()
    options = {"seed": seed + 1, "bounds": [0.0, 1.0], "verbose": -9, "popsize": DRIVERS}
    search = cma.CMAEvolutionStrategy(begin, 0.2, options)
    for generation in range(GENERATIONS):
        population = search.ask()
        log = numbers_of(torch.from_numpy(np.array(population, np.float32)).view(DRIVERS, lanes, 5))
        search.tell(population, (-returns(environment, log, EPISODES, 1001 + 500 * seed + generation)).tolist())
    return numbers_of(torch.tensor(search.result.xfavorite, dtype=torch.float32).view(1, lanes, 5))


def pathwise(environment: dict[str, Any], seed: int) -> Tensor:
    """Return what gradients through traffic make of humans, ``(1, lanes, 5)``; their choices of lanes are frozen."""
    task = task_of(environment)
    drivers = Drivers(torch.tensor(HUMAN).log().repeat(1, task.road.count, 1), task.command_limits[1], 1)
    env = make_env(environment, ROWS, output="torch")
    env.reset(seed=1000 * seed + 5)
    optimiser = torch.optim.Adam(drivers.parameters(), lr=RATE)
    for update in range(UPDATES):
        optimiser.param_groups[0]["lr"] = RATE * (1.0 - update / UPDATES)
        env.detach()
        optimiser.zero_grad()
        (-env.unroll(drivers, WINDOW).reward.mean()).backward()
        nn.utils.clip_grad_norm_(drivers.parameters(), 1.0)
        optimiser.step()
    return drivers.log.detach()


FOUND_BY = {"random search": blind, "evolution": evolved, "gradients": pathwise}


def network(part: Part) -> dict[str, Any]:
    """Return the row of a policy of ``agents``, trained as its file says but for where."""
    module: Any = importlib.import_module(f"agents.{part.how}")
    environment = {name: x for name, x in part.given.items() if name != "observation"}
    with TemporaryDirectory() as folder:
        arguments = load_agent(CONFIGS / f"merge-{part.how}.yaml", module.Arguments, part.how)
        updates, seconds = round(part.budget * arguments.updates), part.budget * arguments.cpu_seconds
        own = {"updates": updates, "evaluate_every": updates, "cpu_seconds": seconds}
        arguments = replace(arguments, environment=environment, seed=part.seed, out=Path(folder), **own)
        spent = module.train(arguments)[-1]["cpu_seconds"]
        policy, _ = load(arguments.out / "last.pt")
    figures = judge_lanes(episodes_start(environment, JUDGED_ON, draws=(1,)), policy, 1)[0]
    return {"seconds": spent, "numbers": None, "found": figures}


def row_of(part: Part, on_progress: OnProgress) -> dict[str, Any]:
    """Return one row: who was found, in how many CPU seconds, and how he is judged."""
    torch.set_num_threads(1)
    if part.how in NETWORKS:
        return network(part)
    if part.how == "humans":
        figures = judge_lanes(episodes_start(part.given, JUDGED_ON, draws=(1,)), None, 1)[0]
        return {"seconds": 0.0, "numbers": None, "found": figures}
    begin = time.process_time()
    log = FOUND_BY[part.how](part.given, part.seed)
    spent = time.process_time() - begin
    figures = driven(part.given, log, JUDGED_ON, 1)[0]
    return {"seconds": spent, "numbers": log.exp().tolist(), "found": figures}


def shown(title: str, rows: dict[Part, dict[str, Any]]) -> Table:
    """Return the rows of a task as a table."""
    table = Table(title=title)
    for head in ("row", "seed", "return, vehicle-h", "more than humans", "out, 1/h", "ramp, 1/h", "crashes", "CPU s"):
        table.add_column(head)
    humans = torch.tensor(next(row for part, row in rows.items() if part.how == "humans")["found"]["rewards"])
    for part, row in rows.items():
        figures = row["found"]
        more = (torch.tensor(figures["rewards"]) - humans) / 3600.0
        half = STUDENT * float(more.std()) / len(more) ** 0.5
        table.add_row(
            part.how, str(part.seed), f"{figures['reward'] / 3600.0:.2f}", f"{float(more.mean()):+.2f} ± {half:.2f}",
            f"{figures['outflow']:.0f}", f"{figures['ramp']:.0f}", str(figures["collisions"]), f"{row['seconds']:.0f}",
        )  # fmt: skip
    return table


def main(
    name: tyro.conf.Positional[Literal[tuple(DEMANDS)]], share: float = 0.3,
    how: Sequence[Literal[(*FOUND_BY, *NETWORKS)]] = (*FOUND_BY, *NETWORKS), seeds: int = 5, budget: float = 1.0,
    out: Path = Path("runs/lane_search.jsonl"), place: Workers = HERE,
) -> None:  # fmt: skip
    """Search where that is not done yet, and print all rows.

    Args:
        name: Row of tasks.
        share: Of those who enter.
        how: Ways to find drivers.
        seeds: Of each way.
        budget: Of ppo and shac: share of their files' updates and CPU seconds.
        out: File of rows.
        place: Where searches run.
    """
    searches = [("humans", 0), *((way, seed) for seed in range(seeds) for way in how)]
    budgets = dict.fromkeys(NETWORKS, budget)
    rows = [Part(name, share, way, seed, budgets.get(way, 1.0)) for way, seed in searches]
    parts = {str(part): part for part in rows}
    done = named_rows(row_of, parts, out, place)
    Console(width=140).print(shown(name, {part: done[label] for label, part in parts.items()}))


if __name__ == "__main__":
    command(main)
