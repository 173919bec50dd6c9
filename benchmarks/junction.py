"""Vehicles at a junction as agents: ``python -m benchmarks.junction [--network crossing]``, rules beside PPO.

Delay is the time that vehicles lose, those who wait to enter included, per vehicle that was due (s), over fresh
episodes; ± is 95 % of the paired difference to *human*: nobody holds back. Rows:

* *random* actions, and *constant* ones: all agents hold back a little, all the time;
* *polite*: whoever goes first brakes 10 to 40 m before his line while foes stand before theirs;
* *searched*: actions are a sum of seven observations, weighed by what a cross-entropy search finds on other episodes in
  ``--search-seconds`` of CPU time;
* *PPO*: Stable-Baselines3's with ``VecNormalize``, one policy for all agents; several seeds, each its last policy.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks import command, table
from benchmarks.bench.measure import machine
from benchmarks.signals import FRESH, OTHERS, Policy, delays, interval, made, trained
from idm_env.tasks.junction import FEATURES

PPO: dict[str, Any] = {"n_steps": 64, "batch_size": 512, "n_epochs": 5, "gamma": 0.97}
"""What PPO is given beside SB3's defaults; a step is 1 s."""
WEIGHED = ("present", "speed", "line", "told", "yields", "foe_arrives", "foes_waiting")
"""Observations that the searched rule weighs."""


def columns(env: Any, seen: np.ndarray, *names: str) -> np.ndarray:
    """Return what agents observe of some name, ``(worlds, agents, names)``."""
    return seen.reshape(len(seen), env.task.agents, -1)[..., [FEATURES.index(name) for name in names]]


def weighed(weights: Any) -> Policy:
    """Return the rule whose action is a sum of ``WEIGHED``; weights ``(7,)`` or one row for each world."""

    def choose(env: Any, seen: np.ndarray) -> np.ndarray:
        x = columns(env, seen, *WEIGHED)
        return np.einsum("bsw,bw->bs", x, np.broadcast_to(np.atleast_2d(weights), (len(x), len(WEIGHED))))

    return choose


def polite(env: Any, seen: np.ndarray) -> np.ndarray:
    """Return braking of whoever goes first, 10 to 40 m before his line, while foes stand before theirs."""
    line, yields, waiting, speed = np.moveaxis(columns(env, seen, "line", "yields", "foes_waiting", "speed"), -1, 0)
    return np.where((yields == 0) & (waiting > 0) & (line > 0.1) & (line < 0.4) & (speed > 0.2), -1.0, 0.0)


def searched(seconds: float, **keywords: Any) -> tuple[np.ndarray, float]:
    """Return the weights of a cross-entropy search, which judges each by four worlds' delay, and its CPU time (s)."""
    rows, each, keep, random, start = 32, 4, 6, np.random.default_rng(0), time.process_time()
    mean, width, env, turn = np.zeros(len(WEIGHED)), np.full(len(WEIGHED), 0.5), made(32 * 4, **keywords), 0
    while time.process_time() - start < seconds:
        weights = mean + width * random.standard_normal((rows, len(WEIGHED)))
        # Two worlds of one seed would not differ: every candidate has episodes of its own.
        lost = (
            delays(env, weighed(np.repeat(weights, each, 0)), OTHERS + turn * rows * each).reshape(rows, each).mean(1)
        )
        best = weights[lost.argsort()[:keep]]
        mean, width, turn = 0.5 * mean + 0.5 * best.mean(0), 0.5 * width + 0.5 * (best.std(0) + 0.03), turn + 1
    return mean, time.process_time() - start


def main(
    network: str = "crossing", inflow: float = 300.0, agents: int = 8, search_seconds: float = 60.0,
    steps: int = 300_000, seeds: int = 5, episodes: int = 256,
) -> None:  # fmt: skip
    """Delay per vehicle of rules and of PPO, on the same fresh episodes."""
    keywords: dict[str, Any] = {"task": "junction", "network": network, "inflow": inflow, "agents": agents}
    about, random = machine(), np.random.default_rng(0)
    print(f"Delay per vehicle, {network}, {inflow:g} veh/h an entry ({about['processor']}, {about['date']})\n")
    held = lambda x: lambda env, seen: np.full((len(seen), agents), x)  # noqa: E731
    rows: list[tuple[str, Policy, float]] = [
        ("human", lambda env, seen: None, 0.0),
        ("random", lambda env, seen: random.uniform(-1.0, 1.0, (len(seen), agents)), 0.0),
        *((f"constant {x}", held(x), 0.0) for x in (-0.1, -0.3)),
        ("polite", polite, 0.0),
    ]
    if search_seconds > 0:
        weights, seconds = searched(search_seconds, **keywords)
        rows.append((f"searched {np.round(weights, 2).tolist()}", weighed(weights), seconds))
    for seed in range(seeds):
        policy, seconds = trained(seed, steps, PPO, **keywords)
        rows.append((f"PPO, seed {seed}", policy, seconds))
    cells, other = [], None
    for name, policy, seconds in rows:
        env, start = made(episodes, **keywords), time.process_time()
        each = delays(env, policy, FRESH)
        speed = episodes * env.task.horizon / (time.process_time() - start)
        other = each if other is None else other
        cells.append([name, f"{each.mean():.1f}", interval(each - other), f"{seconds:.0f}", f"{speed:.0f}"])
        print(*cells[-1], flush=True)
    print()
    print(table(["", "delay (s)", "beside human", "CPU s", "env steps per CPU s"], cells))


if __name__ == "__main__":
    command(main)
