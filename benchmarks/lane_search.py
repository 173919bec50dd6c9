"""Advice of few numbers for the tasks of several lanes, found by evolution: ``python -m benchmarks.lane_search NAME``.

A tenth of those who enter drive by IDM with a desired speed that depends on lane and place, and with a time gap that
depends on the lane; a command counts only as far as the driver would go himself. These numbers are found by CMA-ES
(Hansen 2016, arXiv 1604.00772; library ``cma``), which sees returns of whole episodes only, and so who merges, too.
It begins beside human drivers. *random search* has the same CPU time for the rule of ``benchmarks.lane_tasks``: blocks
of ``DRAWS``, each reduced to its best; of these the best on 32 other episodes.

What each seed finds is judged on ``JUDGED_ON`` fresh episodes of 600 s, the same for all rows and never searched on.
Each row is kept in ``--out`` when it is done, and not done again.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from agents.evaluate import judge_lanes
from agents.rollout import Act, episodes_start, held_moments
from benchmarks import kept_rows
from benchmarks.lane_tasks import DEMANDS, DRAWS, Found, Seen, by_place, searched
from idm_env.tasks.open_lanes import OpenLanesTask

KNOTS = (100.0, 300.0, 500.0, 700.0)
"""Places (m) between which the advised speed is linear."""
FASTEST, SLOWEST = 36.0, 8.0
"""Advised speeds (m/s): at the first, with the shortest time gap, everybody is a human driver."""
SHORTEST, LONGEST = 0.6, 3.0
"""Advised time gaps (s)."""
EPISODES, JUDGED_ON = 12, 128


def advised(task: OpenLanesTask, numbers: Tensor, episodes: int) -> Act:
    """Return agents who follow advice: ``numbers`` ``(n, lanes, knots + 1)``, from 0 (as a human) to 1."""
    each = numbers.clamp(0.0, 1.0).repeat_interleave(episodes, 0)
    speeds = FASTEST + (SLOWEST - FASTEST) * each[..., :-1]
    time_gaps = SHORTEST + (LONGEST - SHORTEST) * each[..., -1]
    knots = torch.tensor(KNOTS)

    def act(seen: Tensor) -> Tensor:
        own = Seen(task, seen)
        on = own.lane.clamp(0, task.road.count - 1)
        table = speeds.gather(1, on.unsqueeze(-1).expand(-1, -1, len(KNOTS)))
        at = torch.searchsorted(knots, own.position.contiguous()).clamp(1, len(KNOTS) - 1)
        share = ((own.position - knots[at - 1]) / (knots[at] - knots[at - 1])).clamp(0.0, 1.0)
        before, after = (table.gather(-1, i.unsqueeze(-1)).squeeze(-1) for i in (at - 1, at))
        advice, time_gap = before + share * (after - before), time_gaps.gather(1, on)
        return own.idm(advice, time_gap, *(torch.tensor(x) for x in (2.0, 1.5, 2.0)))

    return act


def returns(given: dict[str, Any], numbers: Tensor, episodes: int, draw: int) -> list[float]:
    """Return the mean return (vehicle-hours) of each row of numbers in the same episodes."""
    start = episodes_start(given, episodes, len(numbers), draws=(draw,))
    task = start.task
    assert isinstance(task, OpenLanesTask)
    act = advised(task, numbers, episodes)
    lost = torch.zeros(len(numbers) * episodes)
    for t, (_, _, world) in enumerate(held_moments(start, act, task.steps)):
        if (t + 1) % task.held == 0:  # once a decision is enough to compare by
            lost += task.step_time * task.delay(world)
    return (-lost.view(len(numbers), episodes).mean(-1) / 3600.0).tolist()


def evolved(given: dict[str, Any], seed: int, seconds: float) -> tuple[Tensor, int]:
    """Return the mean of the last generation that CMA-ES makes within some CPU seconds, and how many it made."""
    import cma

    lanes = lanes_of(given)
    size = lanes * (len(KNOTS) + 1)
    # The first generations are drawn beside human drivers, at 0.
    search = cma.CMAEvolutionStrategy([0.1] * size, 0.2, {"seed": seed + 1, "bounds": [0.0, 1.0], "verbose": -9})
    begin = time.process_time()
    while time.process_time() - begin < seconds:
        asked = search.ask()
        numbers = torch.from_numpy(np.array(asked, np.float32)).view(-1, lanes, len(KNOTS) + 1)
        draw = 1000 + 500 * seed + search.countiter  # episodes that nobody is judged on
        search.tell(asked, [-x for x in returns(given, numbers, EPISODES, draw)])
    found = torch.tensor(search.result.xfavorite, dtype=torch.float32)
    return found.view(lanes, -1), int(search.countiter)


def blind(given: dict[str, Any], seed: int, seconds: float) -> tuple[Tensor, int]:
    """Return the best rule of a random search within some CPU seconds, and how many were drawn."""
    generator, lanes = torch.Generator().manual_seed(seed), lanes_of(given)
    begin, winners = time.process_time(), list[Tensor]()
    while time.process_time() - begin < seconds:
        drawn = torch.rand(DRAWS, lanes, 2, generator=generator)
        places = torch.stack((4.0 + 24.0 * drawn[..., 0], 200.0 + 500.0 * drawn[..., 1]), -1)
        winners.append(searched(given, places, by_place))
    rules = torch.cat(winners)
    start = episodes_start(given, 32, len(rules), draws=(4,))
    assert isinstance(start.task, OpenLanesTask)
    found = [row["reward"] for row in judge_lanes(start, by_place(start.task, rules, 32), len(rules))]
    return rules[torch.tensor(found).argmax()], DRAWS * len(winners)


def lanes_of(given: dict[str, Any]) -> int:
    """Return how many lanes the road of a task has."""
    task = episodes_start(given, 1).task
    assert isinstance(task, OpenLanesTask)
    return task.road.count


def judged(given: dict[str, Any], found: Tensor | None, how: str) -> Found:
    """Return the figures of the fresh episodes."""
    start = episodes_start(given, JUDGED_ON, draws=(1,))
    assert isinstance(start.task, OpenLanesTask)
    make = advised if how == "advice" else by_place
    act = None if found is None else make(start.task, found.unsqueeze(0), JUDGED_ON)
    return judge_lanes(start, act, 1)[0]


def row_of(name: str, given: dict[str, Any], how: str, seed: int, seconds: float) -> dict[str, Any]:
    """Return one row: who was found, how, and how he is judged."""
    begin, found, tried = time.process_time(), None, 0
    if how != "humans":
        found, tried = (evolved if how == "advice" else blind)(given, seed, seconds)
    spent = time.process_time() - begin
    numbers = None if found is None else found.tolist()
    return {
        "row": f"{name}, {how}, {seed}", "task": name, "how": how, "seed": seed, "seconds": spent, "tried": tried,
        "numbers": numbers, "found": judged(given, found, how),
    }  # fmt: skip


def shown(name: str, rows: list[dict[str, Any]]) -> Table:
    """Return the rows of a task as a table."""
    table = Table(title=name)
    for head in ("row", "seed", "return, vehicle-h", "more than humans", "out, 1/h", "ramp, 1/h", "crashes", "CPU s"):
        table.add_column(head)
    humans = torch.tensor(next(row for row in rows if row["how"] == "humans")["found"]["rewards"])
    for row in rows:
        found = row["found"]
        more = (torch.tensor(found["rewards"]) - humans) / 3600.0
        half = 1.979 * float(more.std()) / len(more) ** 0.5  # Student's t of 127 degrees of freedom
        table.add_row(
            row["how"], str(row["seed"]), f"{found['reward'] / 3600.0:.2f}", f"{float(more.mean()):+.2f} ± {half:.2f}",
            f"{found['outflow']:.0f}", f"{found['ramp']:.0f}", str(found["collisions"]), f"{row['seconds']:.0f}",
        )  # fmt: skip
    return table


def main() -> None:
    """Search where that is not done yet, and print all rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=tuple(DEMANDS), help="row of tasks")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=120.0, help="CPU seconds of a search")
    parser.add_argument("--out", type=Path, default=Path("runs/lane_search.jsonl"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    done = kept_rows(options.out, "row")
    wanted = [("humans", 0), *((how, seed) for seed in range(options.seeds) for how in ("advice", "random search"))]
    for how, seed in wanted:
        if f"{options.name}, {how}, {seed}" not in done:
            row = row_of(options.name, DEMANDS[options.name], how, seed, options.seconds)
            done[row["row"]] = row
            with options.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    rows = [done[f"{options.name}, {how}, {seed}"] for how, seed in sorted(wanted, key=lambda x: (x[0] != "humans", x))]
    Console(width=140).print(shown(options.name, rows))


if __name__ == "__main__":
    main()
