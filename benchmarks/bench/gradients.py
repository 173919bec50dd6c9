"""A step with its gradients, forward and backward, as an agent takes it: a 32 × 32 policy in torch, mean reward.

A window is a loop over ``env.step``, or one call of ``unroll``, and goes on where the last one ended. Where JAX is
installed the same ring in JAX is beside them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import torch

from benchmarks.bench import jax_ring
from benchmarks.bench.measure import Case, measure
from idm_env import Effect, Parameter

RING: dict[str, Any] = {"failsafe": 3.0, "max_command": 0.02}
FOUR_LANES = {"vehicles": 50, "lanes_count": 4, "warmup": 0}
COUNTS = ((1, 600), (64, 600), (1024, 100))
"""Environments, and steps of a window."""
MODEL = "configures: model\nschema: 1\neffects: [idm, brakes]\nparameters: {idm: {time_gap: 1.2}}\n"


@dataclass(frozen=True)
class Fatigue(Effect):
    """An effect of the user's own: ``v0 → v0 exp(−k t)``."""

    kind: ClassVar[str] = "fatigue"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("rate", "k", "1/s", 1e-3, -0.01, 0.01, null=0.0),)

    def adapt(self, driver: Any, scene: Any, p: Mapping[str, Any]) -> Any:
        """Return the driver with the desired speed in force."""
        return driver._replace(desired_speed=driver.desired_speed * torch.exp(-p["rate"] * scene.time))


def of(keywords: Mapping[str, Any], count: int, steps: int, window: bool) -> dict[str, Case]:
    """Return a window of a task's environments, by steps and (``window``) in one call."""
    env = gym.make_vec("DiffIDM-v0", num_envs=count, output="torch", **keywords)
    own: Any = env.unwrapped
    seen = [env.reset(seed=0)[0]]
    width, wide = own.observation_space.shape[-1], own.action_space.shape[-1]
    torch.manual_seed(0)
    layers = (torch.nn.Linear(width, 32), torch.nn.Linear(32, 32), torch.nn.Linear(32, wide))
    policy = torch.nn.Sequential(*(part for layer in layers for part in (layer, torch.nn.Tanh())))

    def loop() -> None:
        own.detach()
        observation, total = seen.pop().detach(), torch.zeros(())
        for _ in range(steps):
            observation, reward, *_ = env.step(policy(observation))
            total = total + reward.mean()
        seen.append(observation)
        (total / steps).backward()

    def whole() -> None:
        own.detach()
        own.unroll(policy, steps).reward.mean().backward()

    return {"env.step": Case(loop, steps)} | ({"unroll": Case(whole, steps)} if window else {})


def rows(rounds: int) -> list[dict[str, Any]]:
    """Return least and median milliseconds of CPU time a step of every workload, interleaved within each."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result = [row for what, cases in workloads() for row in _told(what, measure(cases(), rounds))]
    finally:
        torch.set_num_threads(threads)
    return result


def workloads() -> list[tuple[str, Callable[[], dict[str, Case]]]]:
    """Return what is measured: rings beside JAX, lanes, and a ring whose drivers are others."""
    result: list[tuple[str, Callable[[], dict[str, Case]]]] = []
    for count, steps in COUNTS:
        result.append((f"ring, {count} × {steps}", partial(_beside_jax, count, steps)))
    for task in ("highway", "merge"):
        for count, steps in ((1, 100), (64, 50), (1024, 5)):
            lanes = {"task": task, "hold": 0.1, **(FOUR_LANES if task == "highway" else {})}  # a step of Δt
            result.append((f"{task}, {count} × {steps}", partial(of, lanes, count, steps, False)))
    result.append(("ring of other drivers, 64 × 200", _others))
    return result


def _beside_jax(count: int, steps: int) -> dict[str, Case]:
    theirs = jax_ring.window(count, steps)
    return of(RING, count, steps, True) | ({} if theirs is None else {"JAX": Case(theirs, steps)})


def _others() -> dict[str, Case]:
    """Return windows of rings with effects, the plain one first."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.yaml"
        path.write_text(MODEL)
        drivers: dict[str, dict[str, Any]] = {
            "plain": {}, "delay": {"effects": ["delay"]}, "memory": {"effects": ["memory"]},
            "effect of one's own": {"effects": [Fatigue()]}, "a saved model.yaml": {"effects": str(path)},
        }  # fmt: skip
        cases: dict[str, Case] = {}
        for name, keywords in drivers.items():
            for way, case in of({**RING, **keywords}, 64, 200, True).items():
                cases[f"{name}, {way}"] = case
        return cases


def _told(what: str, times: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    return [
        {"environments × steps": what, "way": name, "ms a step, min": t["cpu_min_ms"], "median": t["cpu_median_ms"]}
        for name, t in times.items()
    ]
