"""Vehicles at a junction as agents: ``python -m benchmarks.junction [--network crossing]``, rules beside PPO.

Delay is the time that vehicles lose, those who wait to enter included, per vehicle that was due (s), over fresh
episodes; ± is 95 % of the paired difference to *human*: nobody holds back, and to *searched*. Rows:

* *random* actions, and *constant* ones: all agents hold back a little, all the time;
* *polite*: whoever goes first brakes 10 to 40 m before his line while foes stand before theirs;
* *searched*: actions are a sum of seven observations, weighed by what a cross-entropy search finds on other episodes in
  ``--search-seconds`` of CPU time;
* *PPO*: Stable-Baselines3's with ``VecNormalize``, one policy for all agents; several seeds, each its last policy.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks import command
from benchmarks.bench.search import cross_entropy
from benchmarks.signals import OTHERS, Policy, Row, delays, learners, made, print_delays, trained
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
    rows, each = 32, 4
    env = made(rows * each, **keywords)

    def costs(weights: np.ndarray, turn: int) -> np.ndarray:
        # Two worlds of one seed would not differ: every candidate has episodes of its own.
        lost = delays(env, weighed(np.repeat(weights, each, 0)), OTHERS + turn * rows * each)
        return lost.reshape(rows, each).mean(1)

    mean, width = np.zeros(len(WEIGHED)), np.full(len(WEIGHED), 0.5)
    options: dict[str, Any] = {"rows": rows, "keep": 6, "floor": 0.03, "inertia": 0.5, "seconds": seconds}
    weights, _, spent = cross_entropy(costs, mean, width, **options)
    return weights, spent


def main(
    network: str = "crossing", inflow: float = 300.0, agents: int = 8, search_seconds: float = 60.0,
    steps: int = 300_000, seeds: int = 5, episodes: int = 256,
) -> None:  # fmt: skip
    """Delay per vehicle of rules and of PPO, on the same fresh episodes."""
    keywords: dict[str, Any] = {"task": "junction", "network": network, "inflow": inflow, "agents": agents}
    random = np.random.default_rng(0)
    held = lambda x: lambda env, seen: np.full((len(seen), agents), x)  # noqa: E731
    rows: list[Row] = [
        ("human", lambda env, seen: None, 0.0, {}),
        ("random", lambda env, seen: random.uniform(-1.0, 1.0, (len(seen), agents)), 0.0, {}),
        *((f"constant {x}", held(x), 0.0, {}) for x in (-0.1, -0.3)),
        ("polite", polite, 0.0, {}),
    ]
    search = (lambda: searched(search_seconds, **keywords)) if search_seconds > 0 else None
    rows += learners(search, weighed, seeds, lambda seed: trained(seed, steps, PPO, **keywords))
    print_delays(rows, episodes, keywords)


if __name__ == "__main__":
    command(main)
