"""Tasks ``merge`` and ``bottleneck``: what vehicles that have learned nothing do there, beside what Flow has published.

    python -m benchmarks.agents_lanes [--out runs/lanes] [--train 30] [--agents apg] [--seeds 1]
        [--trained runs/merge-apg/last.pt …]

A tenth of the vehicles is controlled, behind a failsafe of 3 m/s², with commands from −4.5 to 2.6 m/s²; lanes are left
to their drivers. Every row is eight episodes of 300 s, the same for all, of which the last 200 s count. Families of
policies that are there are not driven again. ``--train`` also trains APG and PPO on both tasks, among drivers who let
nobody in and among such who do (``Courtesy``), one policy for all agents, for so many updates of 16 environments × 300
steps; a training goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from agents import apg, common, ppo
from agents.classical import constant
from agents.environments import first_seed, human_driving, task_of
from agents.evaluate import evaluate_lanes, judge_lanes
from agents.policy import Policy
from agents.rollout import Act, episodes_start
from benchmarks.agents import once
from benchmarks.agents_tables import table

Row = dict[str, Any]
CONTROL: Row = {"controlled": 0.1, "failsafe": 3.0, "max_command": [-4.5, 2.6]}
LET_IN: Row = {"effects": ["courtesy"]}
TASKS: dict[str, Row] = {
    "merge": {"task": "merge", **CONTROL},
    "merge, 3000 + 800 an hour": {"task": "merge", "inflow": 3000.0, "ramp_inflow": 800.0, **CONTROL},
    "bottleneck": {"task": "bottleneck", **CONTROL},
    "bottleneck, 1900 an hour": {"task": "bottleneck", "inflow": 1900.0, **CONTROL},
    "merge, drivers let in": {"task": "merge", **LET_IN, **CONTROL},
    "merge, 3000 + 800 an hour, drivers let in": {
        "task": "merge", "inflow": 3000.0, "ramp_inflow": 800.0, **LET_IN, **CONTROL,
    },
    "bottleneck, drivers let in": {"task": "bottleneck", **LET_IN, **CONTROL},
    "bottleneck, 1900 an hour, drivers let in": {"task": "bottleneck", "inflow": 1900.0, **LET_IN, **CONTROL},
}  # fmt: skip
TRAINED = ("merge", "bottleneck", "merge, drivers let in", "bottleneck, drivers let in")
"""Tasks that agents are trained on; they are judged where demand differs, too."""
KINDS = ("idm", "constants", "uniform", "networks")
CONSTANTS = (-0.2, -0.05, 0.0, 0.05, 0.2, 1.0)
NETWORKS, EPISODES, STEPS = 10, 8, 300

Family = dict[str, Act]
"""Policies by the names of their rows, which drive together."""
Figures = dict[str, Row]
"""Figures of a family by the same names."""


def constants(environment: Row) -> Family:
    """Return policies that always command the same acceleration (m/s²)."""
    task = task_of(environment)
    return {f"always {accel:g} m/s²": constant(accel, task) for accel in CONSTANTS}


def uniform(environment: Row) -> Family:
    """Return a policy that draws every action anew, evenly in [−1, 1]."""
    generator, agents = torch.Generator().manual_seed(0), len(task_of(environment).agents)
    return {"random actions": lambda seen: 2.0 * torch.rand(len(seen), agents, generator=generator) - 1.0}


def networks(environment: Row) -> Family:
    """Return unfitted networks, their last layer at a random scale: 0.01 to 3 times torch's own, bias ± 0.1."""
    observations, _ = human_driving(environment, first_seed(0, 0), count=4, steps=1000)
    made: Family = {}
    for seed in range(NETWORKS):
        torch.manual_seed(seed)
        policy = Policy(observations.shape[-1])
        policy.mean.copy_(observations.mean(0))
        policy.scale.copy_(observations.std(0).clamp_min(1e-3))
        with torch.no_grad():
            last = policy.body[-1]
            assert isinstance(last, torch.nn.Linear)
            last.weight.mul_(10.0 ** (2.5 * torch.rand(())))
            last.bias.add_(0.2 * (torch.rand(()) - 0.5))
        made[f"random network {seed}"] = policy
    return made


def trained(environment: Row, paths: Sequence[Path]) -> Family:
    """Return the agents among these checkpoints that were trained on the task, among drivers of this kind."""
    loaded = [(path.parent.name, *common.load(path)) for path in paths]
    return {
        f"trained: {name}, {content['training']['cpu_seconds']:.0f} CPU s": policy
        for name, policy, content in loaded
        if (content["task"], content["environment"].get("effects")) == (environment["task"], environment.get("effects"))
    }


def train(name: str, agent: str, seed: int, updates: int, folder: Path) -> Path:
    """Return the checkpoint of an agent trained on a task, trained now or on as far as it is not yet."""
    shared: Row = {
        "environment": TASKS[name], "out": folder, "seed": seed, "updates": updates, "count": 16,
        "evaluate_every": 1e9,
    }  # fmt: skip
    if agent == "apg":
        return common.completed(apg.train, apg.Arguments(**shared, window=STEPS, learning_rate=3e-3))
    arguments = ppo.Arguments(**shared, n_steps=STEPS, batch_size=4800, gamma=0.99, n_epochs=5)
    return common.completed(ppo.train, arguments)


def driven(family: Family, environment: Row) -> dict[str, Row]:
    """Return the figures of every policy of a family; an empty one stands for IDM."""
    if not family:
        return {"IDM, nobody controlled": evaluate_lanes(None, environment, EPISODES)}
    start = episodes_start(environment, EPISODES, len(family))

    def act(seen: Tensor) -> Tensor:
        return torch.cat([one(part) for one, part in zip(family.values(), seen.chunk(len(family)), strict=True)])

    return dict(zip(family, judge_lanes(start, act, len(family)), strict=True))


def told(name: str, row: str, r: Row) -> list[str]:
    """Return the cells of a row: means over episodes, and the range of outflows."""
    low, high = min(r["outflows"]), max(r["outflows"])
    flow = f"{r['outflow']:.0f} ({low:.0f}–{high:.0f})"
    return [name, row, f"{r['speed']:.1f}", flow, f"{r['queued']:.0f}", f"{r['reward']:.3f}", str(r["collisions"])]


def _driven(make: Callable[[], Family], environment: Row) -> dict[str, Row]:
    return driven(make(), environment)


def figures(out: Path, name: str, paths: Sequence[Path] = (), kinds: Sequence[str] = KINDS) -> dict[str, Figures]:
    """Return the figures of a task's families by kind, and of agents among ``paths``: driven now if not kept in out."""
    environment, folder = TASKS[name], out / name.replace(" ", "-")
    makers: dict[str, Callable[[], Family]] = {
        "idm": dict,
        "constants": partial(constants, environment),
        "uniform": partial(uniform, environment),
        "networks": partial(networks, environment),
    }
    found: dict[str, Figures] = {}
    for kind in kinds:
        found[kind] = once(folder / kind, partial(_driven, makers[kind], environment)) or {}
        print(f"{name}: {kind}", file=sys.stderr, flush=True)
    for row, policy in trained(environment, paths).items():
        kept = folder / row.replace(": ", "-").replace(", ", "-").replace(" ", "-")
        found[row] = once(kept, partial(driven, {row: policy}, environment)) or {}
    return found


def main() -> None:
    """Drive what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/lanes"))
    parser.add_argument("--trained", nargs="*", type=Path, default=[], help="checkpoints of agents, as further rows")
    parser.add_argument("--train", type=int, metavar="UPDATES", help="also train agents for so many updates")
    parser.add_argument("--agents", nargs="+", choices=("apg", "ppo"), default=["apg", "ppo"])
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.train:
        options.trained += [
            train(
                name,
                agent,
                seed,
                options.train,
                options.out / "trained" / name.replace(" ", "-") / f"{agent}-seed{seed}",
            )
            for seed, name, agent in itertools.product(range(options.seeds), TRAINED, options.agents)
        ]
    rows = []
    for name in TASKS:
        found = figures(options.out, name, options.trained)
        for kind, family in found.items():
            shown = family
            if kind in ("constants", "networks") and family:
                best = max(family, key=lambda row: family[row]["reward"])
                shown = {f"best of {len(family)}: {best}": family[best]}
            rows += [told(name, row, r) for row, r in shown.items()]
    table(
        ("task", "vehicles controlled by", "mean speed (m/s)", "outflow (vehicles an hour)", "queued at the end",
         "reward per step", f"episodes with a crash, of {EPISODES}"), rows,
    )  # fmt: skip


if __name__ == "__main__":
    main()
