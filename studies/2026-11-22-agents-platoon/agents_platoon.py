"""One policy for k of forty vehicles behind measured stop-and-go leaders that training has not seen.

    python -m benchmarks.agents_platoon [--seeds 3] [--updates 30] [--out runs/platoon]
        [--data ngsim_i80_pairs.parquet]

Records of I-80 last a minute, and a wave takes a minute through forty vehicles. So leaders are chains of five
records each, every record once, each next one that whose first speed is nearest to where the last one ends; what is
left of the difference fades within five seconds. Leaders of the training pairs make chains for training, those of the
twenty held-out pairs four chains on which everything is judged from the first minute on. Behind them drive forty
vehicles with IDM as calibrated on the training pairs, of which k are controlled, behind a failsafe of 3 m/s². Agents
are trained with k = 4 (10 %), by APG (the gradient through all four at once) and by PPO (each agent a row, the reward
of their team), and judged with 2, 4 and 8. What is done is kept; a training goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch
from torch import Tensor

from agents import apg, common, ppo
from agents.classical import Controller, FollowerStopper, PISaturation, Seen
from agents.environments import task_of
from agents.imitation import default_data
from agents.reference import random_policies
from agents.rollout import SEED, Act, Driven, Start, drive
from benchmarks.agents import once
from benchmarks.agents_energy import pairs
from benchmarks.agents_tables import table
from idm_env import metrics
from idm_env.data import Episode, episodes
from idm_env.tasks import Draw, Task, World, make_task

Row = dict[str, Any]
BEHIND, RECORDS, FADES, JUDGED_FROM = 40, 5, 5.0, 60.0
"""Vehicles behind the leader, records of a chain, and times (s): until a joint has faded, from when it is judged."""
TRAINED_WITH, AGENTS, RANDOM = 4, (2, 4, 8), 10
HEAD = (
    "controlled", "by", "mean speed (m/s)", "deviation of speeds (m/s)", "L/100 km: Kamal et al.", "CIRCLES",
    "gaps of agents (m)", "reward per step", "chains with a collision, of 4",
)  # fmt: skip


def chained(speeds: Sequence[np.ndarray], dt: float) -> list[np.ndarray]:
    """Return chains of ``RECORDS`` records of speeds (m/s) each, every record at most once, as long as the shortest."""
    left, chains = list(range(len(speeds))), []
    while len(left) >= RECORDS:
        made = speeds[left.pop(0)]
        for _ in range(RECORDS - 1):
            nearest = min(left, key=lambda i: abs(float(speeds[i][0] - made[-1])))
            left.remove(nearest)
            after = speeds[nearest]
            fade = np.clip(1.0 - dt * np.arange(len(after)) / FADES, 0.0, 1.0)
            made = np.concatenate((made, np.maximum(after + (made[-1] - after[0]) * fade, 0.0)))
        chains.append(made)
    return [made[: min(map(len, chains))] for made in chains]


def write(path: Path, chains: Sequence[np.ndarray], dt: float) -> Path:
    """Write leaders with these speeds to a trajectory file, each with a vehicle that keeps 20 m behind it."""
    parts = []
    for i, speed in enumerate(chains):
        position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt)))
        for vehicle in (0, 1):
            parts.append(pl.DataFrame({
                "run_id": str(i), "vehicle_id": vehicle, "leader_id": None if vehicle == 0 else 0,
                "time_s": dt * np.arange(len(speed)), "position_m": position - 25.0 * vehicle, "speed_mps": speed,
                "length_m": 5.0,
            }, schema_overrides={"leader_id": pl.Int64}))  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    pl.concat(parts).write_parquet(path)
    return path


def environment(leader: Path, idm: Row, agents: int) -> Row:
    """Return the keywords of task ``follow`` behind these chains."""
    return {
        "task": "follow", "leader": str(leader), "vehicles": BEHIND + 1, "controlled": agents, "failsafe": 3.0,
        "max_command": [-4.5, 2.6], "crash_cost": 50.0, "parameters": {"idm": idm}, "fuel_weight": 1.0,
        "lag_weight": 0.3, "max_episode_steps": 1200,
    }  # fmt: skip


@dataclass
class Rule:
    """A controller of the ring behind a recorded leader."""

    task: Task
    controller: Controller

    def __call__(self, observation: Tensor) -> Tensor:
        """Return actions ``(n, agents)``."""
        own = observation.unflatten(-1, (-1, len(self.task.scales))) * observation.new_tensor(self.task.scales)
        view = Seen(*own.unbind(-1))
        return self.task.action((self.controller.wanted(view) - view.speed) / self.task.simulator.dt)


def whole(leaders: Path, idm: Row, agents: int) -> Start:
    """Return one episode behind each of the leaders of a file, which are equally long, from first to last step."""
    keywords = environment(leaders, idm, agents)
    steps = task_of(keywords).leaders.steps  # type: ignore[attr-defined]
    task = make_task(**{**keywords, "max_episode_steps": int(steps.max()) - 1})
    params = task.params(torch.float32, "cpu")

    def begun(seeds: Sequence[int]) -> World:
        return task.reset(Draw.of(torch.tensor(seeds), torch.zeros(len(seeds), dtype=torch.int64)), params)

    drawn = begun(range(SEED, SEED + 50 * len(steps))).episode["trace"].tolist()
    seeds = tuple(SEED + drawn.index(i) for i in range(len(steps)))
    return Start(task, begun(seeds), seeds, params)


def judged(make: Callable[[Task, Tensor], Act | None], leaders: Path, idm: Row, agents: int) -> Row:
    """Return the figures of a policy behind each chain; ``make(task, mean speed of each leader)`` gives it anew.

    ``speed``: mean of the forty (m/s); ``deviation``: the deviation of each vehicle's speed over time, mean over those
    behind the first agent (m/s); litres per 100 km of the forty by both models; ``nearest`` and ``farthest`` gap of
    agents (m); ``reward``: mean per step; ``collision``.
    """
    start = whole(leaders, idm, agents)
    motion = start.task.leaders.motion  # type: ignore[attr-defined]
    means = torch.as_tensor(motion[:, :, 1].mean(-1, keepdims=True), dtype=torch.float32)
    driven = drive(start, make(start.task, means), motion.shape[1] - 1)
    rows = [_figures(start.task, Driven(*(x[:, i] for x in driven))) for i in range(len(motion))]
    return {name: [r[name] for r in rows] for name in rows[0]}


def _figures(task: Task, driven: Driven) -> Row:
    first = round(JUDGED_FROM / task.simulator.dt)
    speed, accel = (x[first:, 1:].double() for x in (driven.speed, driven.accel))
    gap = task.pick(driven.gap)[first:]
    return {
        "speed": float(speed.mean()),
        "deviation": float(speed[:, task.agents[0] :].std(0, correction=0).mean()),
        **{
            model: 100.0 * float(metrics.fuel(speed, accel, model).sum() / speed.sum()) for model in metrics.FUELS
        },
        "nearest": float(gap.min()),
        "farthest": float(gap.max()),
        "reward": float(driven.reward[first:].mean()),
        "collision": bool(driven.gap[:, 1:].min() <= 0.0),
    }  # fmt: skip


def told(agents: str, name: str, r: Row) -> list[str]:
    """Return the cells of a row: means over chains, with the least and the most of fuel."""
    stands = min(r["speed"]) < 0.1  # fuel per way means nothing
    fuel = ["–" if stands else f"{statistics.mean(r[m]):.2f} ({min(r[m]):.2f}–{max(r[m]):.2f})" for m in metrics.FUELS]
    return [
        agents, name, f"{statistics.mean(r['speed']):.2f}", f"{statistics.mean(r['deviation']):.2f}", *fuel,
        f"{min(r['nearest']):.1f}–{max(r['farthest']):.1f}", f"{statistics.mean(r['reward']):.3f}",
        str(sum(r["collision"])),
    ]  # fmt: skip


def train(agent: str, keywords: Row, seed: int, updates: int, folder: Path) -> Path:
    """Return the checkpoint of an agent, trained now or on as far as it is not yet; all begin as clones of IDM."""
    shared: Row = {
        "environment": keywords, "out": folder, "seed": seed, "updates": updates, "count": 16, "clone": 500,
        "evaluate_every": 1e9,
    }  # fmt: skip
    if agent == "apg":
        return common.completed(apg.train, apg.Arguments(**shared, window=600, learning_rate=3e-3))
    arguments = ppo.Arguments(**shared, n_steps=300, batch_size=4800, learning_rate=3e-4, gamma=0.99, log_std_init=-2.0)
    return common.completed(ppo.train, arguments)


def _same(policy: Act, task: Task, speed: Tensor) -> Act:
    return policy


def makers(keywords: Row, mean: float) -> dict[str, Callable[[Task, Tensor], Act | None]]:
    """Return what makes each policy that nothing trains; ``mean`` is the mean speed of the training leaders (m/s)."""

    def stopper(told_each: bool, task: Task, speed: Tensor) -> Act:
        return Rule(task, FollowerStopper(task, desired=speed if told_each else mean))

    made: dict[str, Callable[[Task, Tensor], Act | None]] = {
        "IDM": lambda task, speed: None,
        "FollowerStopper, the training leaders' mean speed": partial(stopper, False),
        "FollowerStopper, told each leader's mean speed": partial(stopper, True),
        "PI with saturation": lambda task, speed: Rule(task, PISaturation(task)),
    }
    for i, policy in enumerate(random_policies(keywords, RANDOM, (32, 32))):
        made[f"random network {i}"] = partial(_same, policy)
    return made


def leaders_of(items: Sequence[Episode], path: Path) -> tuple[Path, float]:
    """Return the file of the chains of these episodes' leaders, and their mean speed (m/s)."""
    chains = chained([np.asarray(e.leader.speed_mps) for e in items], items[0].dt)
    return write(path, chains, items[0].dt), float(np.concatenate(chains).mean())


def main() -> None:
    """Train and judge what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--updates", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("runs/platoon"))
    parser.add_argument("--data", type=Path, default=default_data())
    options = parser.parse_args()
    torch.set_num_threads(1)
    training, held_out, idm = pairs(options.data)
    leaders, mean = leaders_of(list(episodes(training, max_gap=None, smooth=True)), options.out / "training.parquet")
    others, _ = leaders_of(held_out, options.out / "held-out.parquet")
    keywords = environment(leaders, idm, TRAINED_WITH)
    policies = makers(keywords, mean)
    for seed in range(options.seeds):
        for agent in ("apg", "ppo"):
            path = train(agent, keywords, seed, options.updates, options.out / f"{agent}-seed{seed}")
            policy, content = common.load(path, "follow")
            name = f"{agent.upper()}, seed {seed}, {content['training']['cpu_seconds']:.0f} CPU s"
            policies[name] = partial(_same, policy)
    rows = []
    for agents in AGENTS:
        found: dict[str, Row] = {}
        for name, make in policies.items():
            folder = options.out / f"{agents}" / name.replace(", ", "-").replace(" ", "-")
            r = once(folder, partial(judged, make, others, idm, agents))
            if r is not None and (name != "IDM" or agents == TRAINED_WITH):
                found[name] = r
        drawn = [name for name in found if name.startswith("random network")]
        best = max(drawn, key=lambda name: statistics.mean(found[name]["reward"]))
        for name, r in found.items():
            if name == best or name not in drawn:
                shown = f"best of {len(drawn)}: {name}" if name == best else name
                share = "" if name == "IDM" else f"{agents} ({100.0 * agents / BEHIND:.0f} %)"
                rows.append(told(share, shown, r))
    table(HEAD, rows)


if __name__ == "__main__":
    main()
