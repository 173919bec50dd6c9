"""Environments for training: vectors of a task, episodes out of step with each other, and what human drivers do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.envs.settings import KEYWORDS
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.tasks import Task, make_task
from idm_env.types import LaneState, Moving, State, Trips


def task_of(environment: Mapping[str, Any]) -> Task:
    """Return the task of an environment's keywords."""
    own = ("task", "max_episode_steps")
    return make_task(**{k: v for k, v in environment.items() if k in own or k not in KEYWORDS})


def make_env(environment: Mapping[str, Any], count: int, **keywords: Any) -> DiffIDMVectorEnv:
    """Return a vector of environments that reset within the step (final observations are in the info)."""
    chosen: dict[str, Any] = {"autoreset_mode": "SameStep", "info": "none", **environment, **keywords}
    return DiffIDMVectorEnv(count, **chosen)


def first_seed(seed: int, count: int) -> int:
    """Return the seed of the first of ``count`` environments."""
    return 10_000 * (seed + 1) + count


def desynchronise(env: DiffIDMVectorEnv) -> Tensor:
    """Set the clocks of the first episodes apart, so that not all end at once; return the observations.

    Environment i of n starts at step ``i · limit / n``; traffic and records are as they were at step 0.
    """
    batch, state = env.batch, env.state
    step = (torch.arange(env.num_envs) * (batch.limit or 0)) // env.num_envs * env.task.held
    batch.episodes -= 1
    observation: Tensor = env.reset(options={"state": state._replace(step=state.step + step)})[0]
    assert batch.world is not None
    episode = dict(batch.world.episode)
    if "start" in episode:
        episode["start"] = episode["start"] - step
        batch.world = batch.world._replace(episode=episode)
    return observation


def snapshot(env: DiffIDMVectorEnv) -> dict[str, Any]:
    """Return everything that ``restore`` needs to continue the episodes of a vector exactly."""
    batch, world = env.batch, env.batch.world
    assert world is not None
    state = {k: v for k, v in world.state._asdict().items() if k not in ("memory", "lanes")}
    lanes = {} if world.state.lanes is None else world.state.lanes._asdict()
    parts = {k: lanes.pop(k) for k in ("trips", "moving") if k in lanes}
    return {
        "state": state,
        # As plain mappings, which a checkpoint may hold.
        "parts": {"links": lanes} | {k: dict(v._asdict()) for k, v in parts.items() if v is not None} if lanes else {},
        "memory": dict(world.state.memory),
        "episode": dict(world.episode),
        "seeds": batch.seeds.tolist(),
        "numbers": batch.episodes.tolist(),
    }


def restore(env: DiffIDMVectorEnv, saved: Mapping[str, Any]) -> Tensor:
    """Continue the episodes of a snapshot; return the observations."""
    batch = env.batch
    env.reset(seed=list(saved["seeds"]))
    batch.episodes[:] = np.asarray(saved["numbers"]) - 1
    parts = saved.get("parts", {})
    more: Any = {name: kind(**parts[name]) for name, kind in (("trips", Trips), ("moving", Moving)) if name in parts}
    lanes = LaneState(**parts["links"], **more) if parts else None
    state = State(**saved["state"], memory=saved["memory"], lanes=lanes)
    env.reset(options={"state": state})
    assert batch.world is not None
    batch.world = batch.world._replace(episode=saved["episode"])
    return env.task.observe(batch.world).flatten(1)


def human_driving(
    environment: Mapping[str, Any], seed: int, count: int = 16, steps: int = 1500
) -> tuple[Tensor, Tensor]:
    """Return what agents observe while human drivers keep the wheel for ``steps`` of Δt, and actions that do as much.

    Shapes ``(samples, features)`` and ``(samples,)``; actions would command what drivers do, clipped. Where an action
    is held that is their mean acceleration. Whoever is not on the road, from one decision to the next, is no sample.
    """
    env = make_env(environment, count, output="numpy")
    seen, done = [env.reset(seed=seed)[0]], []
    state = env.state
    for _ in range(max(1, steps // env.task.held)):
        before = state
        observation, _, terminated, truncated, _ = env.step(None)
        seen.append(observation)
        state = env.state
        accel = state.accel if env.task.held == 1 else (state.speed - before.speed) / env.task.step_time
        # The first step of a new episode has no acceleration yet.
        over = torch.as_tensor(terminated | truncated).unsqueeze(-1).expand_as(accel)
        if state.present is not None and before.present is not None:
            over = over | (state.present <= 0) | (before.present <= 0)
        done.append(env.task.pick(torch.where(over, torch.nan, accel)))
    observations = torch.as_tensor(np.stack(seen[:-1])).float().reshape(-1, len(env.task.bounds.names))
    actions = env.task.action(torch.stack(done).float()).flatten()
    finite = actions.isfinite()
    return observations[finite], actions[finite]
