"""Rollouts that judge: the worlds in which evaluations begin, a policy driven through them, and what is recorded."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from agents.environments import task_of
from idm_env.tasks import Draw, Task, World
from idm_env.types import Params

LENGTHS = (220.0, 230.0, 240.0, 250.0, 260.0, 270.0)
UNSEEN = tuple(float(x) for x in range(200, 301, 10))
WARMUP = 3000
"""Steps of human driving before the take-over: the wave has grown by then. A vehicle that keeps its speed, with no
command at all, dissolves the young wave that is there after 750 steps."""
BLOCK = 250
"""Steps for which the drivers' noise is drawn at once."""
SEED = 1 << 40
"""Of evaluations; training uses smaller seeds."""
FRESH = range(1, 6)
"""Draws of noise and starts on which agents are reported; draw 0 is the one that chooses checkpoints and trials."""

Act = Callable[[Tensor], Tensor]
"""Observations ``(n, agents · features)`` to actions ``(n, agents)``."""


class Driven(NamedTuple):
    """What an evaluation keeps of every step, ``(steps, n, vehicles)``, and the actions ``(steps, n, agents)``."""

    speed: Tensor
    accel: Tensor
    gap: Tensor
    action: Tensor
    reward: Tensor


class Start(NamedTuple):
    """A task with the worlds in which its evaluation begins."""

    task: Task
    world: World
    draw: Draw
    params: Params


def drive(start: Start, act: Act | None, steps: int, rewards: bool = False) -> Driven:
    """Roll a policy out from given worlds; ``act`` None leaves everybody to the human drivers."""
    task, world, draw, params = start
    like = world.state.speed
    none = like.new_zeros(len(like), len(task.agents))
    kept: list[tuple[Tensor, ...]] = []
    with torch.inference_mode():
        for t in range(steps):
            if t % BLOCK == 0:
                normals = task.normals(draw, world.state.step, BLOCK, like.dtype)
            action = None if act is None else act(task.observe(world).flatten(1))
            command = None if action is None else task.command(action)
            now = {name: x[t % BLOCK] for name, x in normals.items()}
            after = task.step(world, command, now, params, advance=task.simulator.advance)
            reward = task.reward(world, none if command is None else command, after) if rewards else none
            world = after
            kept.append(
                (after.state.speed, after.state.accel, after.state.gap, none if action is None else action, reward)
            )
    return Driven(*(torch.stack(column) for column in zip(*kept, strict=True)))


@lru_cache(maxsize=64)
def _ring_start(environment: str, lengths: tuple[float, ...], warmup: int, draws: tuple[int, ...]) -> Start:
    """Return one ring of every draw and length after its warm-up; the environment's keywords come as JSON."""
    chosen = {**json.loads(environment), "warmup_pool": 0, "start": "uniform", "warmup": warmup}
    task = task_of({**chosen, "length": [min(lengths), max(lengths)]})
    params = task.params(torch.float32, "cpu")
    keys, states, episodes = [], [], []
    for i, length in enumerate(lengths):
        draw = Draw.of(torch.tensor([SEED + 1000 * k + i for k in draws]), torch.zeros(len(draws), dtype=torch.int64))
        one = task_of({**chosen, "length": length})
        world = one.reset(draw, params)
        states.append(world.state)
        episodes.append(world.episode)
        keys.append(draw.key)
    memory = {name: torch.cat([s.memory[name] for s in states]) for name in states[0].memory}
    columns: Any = {
        k: torch.cat([getattr(s, k) for s in states]) for k in ("position", "speed", "accel", "gap", "length", "step")
    }
    episode = {name: torch.cat([e[name] for e in episodes]) for name in episodes[0]}
    world = World(states[0]._replace(**columns, memory=memory), episode)
    return Start(task, world, Draw(torch.cat(keys)), params)


def ring_start(
    environment: Mapping[str, Any],
    lengths: Sequence[float] = LENGTHS,
    warmup: int = WARMUP,
    draws: Sequence[int] = (0,),
) -> Start:
    """Return one ring of every length and draw after its warm-up, the draws of a length together."""
    return _ring_start(json.dumps(dict(environment), sort_keys=True), tuple(lengths), warmup, tuple(draws))


def uniform_speed(start: Start) -> Tensor:
    """Return the speed (m/s) at which all vehicles of each ring, as human drivers, keep their gaps for ever.

    Solves ``Σ (s0 + v T)/√(1 − (v/v0)^4) = L − Σ l`` by bisection; drivers may differ.
    """
    p = start.task.driven(start.world.episode, start.params)["idm"]
    free = start.world.state.gap.sum(-1)
    low, high = torch.zeros_like(free), torch.full_like(free, 0.95) * p["desired_speed"].min()
    for _ in range(60):
        v = (0.5 * (low + high)).unsqueeze(-1)
        gaps = (p["min_gap"] + v * p["time_gap"]) / torch.sqrt(1.0 - (v / p["desired_speed"]) ** 4)
        fits = gaps.expand_as(start.world.state.gap).sum(-1) < free
        middle = v.squeeze(-1)
        low, high = torch.where(fits, middle, low), torch.where(fits, high, middle)
    return 0.5 * (low + high)


@lru_cache(maxsize=8)
def _follow_start(environment: str, count: int) -> Start:
    task = task_of(json.loads(environment))
    params = task.params(torch.float32, "cpu")
    draw = Draw.of(torch.arange(SEED, SEED + count), torch.zeros(count, dtype=torch.int64))
    return Start(task, task.reset(draw, params), draw, params)


def follow_start(environment: Mapping[str, Any], count: int) -> Start:
    """Return ``count`` queues behind drawn stretches of the recorded leaders."""
    return _follow_start(json.dumps(dict(environment), sort_keys=True), count)
