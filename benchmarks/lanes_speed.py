"""How fast several lanes are, in one run: rollouts forward and backward, SUMO, and the task ``highway``."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import idm_env  # noqa: F401  (registers the environments)
from benchmarks.lanes_ring import EACH, changes, traffic
from benchmarks.lanes_sumo import sumo

SIZES = (20_000, 200_000, 2_000_000)


def best(times: int, work: Callable[[], object]) -> float:
    """Return the least CPU time of some calls (s)."""
    found = []
    for _ in range(times):
        begin = time.process_time()
        work()
        found.append(time.process_time() - begin)
    return min(found)


def rollouts(vehicles: int, dtype: torch.dtype) -> tuple[float, float, float]:
    """Return million updates per CPU second forward and forward with backward, and changes per vehicle and hour."""
    simulator, state, params = traffic(max(1, vehicles // EACH), 15.0, dtype)
    few = vehicles > 1_000_000
    state, _ = simulator.rollout(state, {}, params, 100 if few else 300, keep=None)
    steps, end = (50 if few else 100), state

    def forward() -> None:
        nonlocal end
        end, _ = simulator.rollout(state, {}, params, steps, keep=None)

    taken = best(2, forward)
    leaf = params["idm"]["desired_speed"].requires_grad_()

    def both() -> None:
        last, _ = simulator.rollout(state, {}, params, 20, keep=None)
        torch.autograd.grad(last.position.sum(), leaf)

    updates = state.speed.numel() * 1e-6
    rate = (changes(end) - changes(state)) / state.speed.numel() / (steps * simulator.dt) * 3600.0
    return updates * steps / taken, updates * 20 / best(3, both), rate


def env_steps(env: Any, count: int, actions: Callable[[], Any], seconds: float) -> float:
    """Return env steps per CPU second, episodes that end begun anew."""
    env.reset(seed=1)
    for _ in range(12):
        env.step(actions())
    done, begin = 0, time.process_time()
    while time.process_time() - begin < seconds:
        *_, terminated, truncated, _ = env.step(actions())
        done += count
        if count == 1 and (terminated or truncated):
            env.reset()
    return done / (time.process_time() - begin)


def ours(vector: int, seconds: float) -> float:
    """Return env steps per CPU second of ``highway`` with 50 vehicles (51 in a single one), random actions."""
    draw = np.random.default_rng(1)
    if vector == 1:
        single = gymnasium.make("DiffIDM-v0", task="highway", vehicles=51, lanes_count=4)
        return env_steps(single, 1, lambda: draw.uniform(-1, 1, 1).astype(np.float32), seconds)
    many = gymnasium.make_vec("DiffIDM-v0", num_envs=vector, task="highway", vehicles=50, lanes_count=4)
    block = draw.uniform(-1, 1, (vector, 1)).astype(np.float32)
    return env_steps(many, vector, lambda: block, seconds)


def theirs(seconds: float) -> float | None:
    """Return env steps per CPU second of HighwayEnv's ``highway-fast-v0`` with 51 vehicles; None without it."""
    if not find_spec("highway_env"):
        return None
    gymnasium.register_envs(import_module("highway_env"))
    env = gymnasium.make("highway-fast-v0", config={"vehicles_count": 50, "lanes_count": 4})
    draw = np.random.default_rng(1)
    return env_steps(env, 1, lambda: int(draw.integers(5)), seconds)


def table(parts: str = "rollouts,highway") -> None:
    """Print what was measured, with the targets."""
    console = Console()
    if "rollouts" in parts:
        peer = sumo(EACH, 15.0, 30.0)
        beside = None if peer is None else peer[2]
        told = Table("", "vehicles", "forward", "× SUMO", "forward + backward", "changes /vehicle/h",
                     title="Million updates per CPU second: 4 lanes, MOBIL at 1 Hz, Δt 0.1 s, 15 /km/lane")  # fmt: skip
        for dtype in (torch.float32, torch.float64):
            for size in SIZES:
                forward, both, rate = rollouts(size, dtype)
                ratio = "" if beside is None else f"{forward / beside:.0f}"
                name = str(dtype).removeprefix("torch.")
                told.add_row(name, f"{size:,}", f"{forward:.1f}", ratio, f"{both:.1f}", f"{rate:.0f}")
        told.add_row("SUMO", f"{EACH:,}", "not installed" if peer is None else f"{peer[2]:.2f}", "1", "", "")
        console.print(told)
    if "highway" in parts:
        single, peer_steps, vector = ours(1, 3.0), theirs(8.0), ours(1024, 4.0)
        ratio = "" if peer_steps is None else f", {single / peer_steps:.0f} ×"
        told = Table("", "env steps per CPU s", title="Task highway, 4 lanes")
        told.add_row("vector of 1024, 50 vehicles", f"{vector:,.0f}")
        told.add_row("single gym.make, 51 vehicles", f"{single:,.0f}{ratio}")
        other = "not installed" if peer_steps is None else f"{peer_steps:.1f}"
        told.add_row("HighwayEnv highway-fast-v0, 51 vehicles", other)
        console.print(told)
