"""What a step hands out is its receiver's: it stays as it was, and whoever writes to it changes no step."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

from idm_env.envs.pettingzoo import parallel_env
from idm_env.envs.sb3 import SB3VecEnv

STEPS = 25


def arrays(tree: Any) -> Iterator[np.ndarray]:
    """Yield every array of numbers in what a face returns."""
    if isinstance(tree, np.ndarray) and tree.dtype != object:
        yield tree
    elif isinstance(tree, dict):
        yield from arrays(tuple(tree.values()))
    elif isinstance(tree, (tuple, list, np.ndarray)):
        for x in tree:
            yield from arrays(x)


def begun(face: str, task: str) -> tuple[Any, Any]:
    """Return an environment of a face, and what its reset handed out."""
    short = {"warmup": 5} if task == "ring" else {}
    if face == "pettingzoo":
        env: Any = parallel_env(task=task, **short)
    elif face == "single":
        env = gymnasium.make("DiffIDM-v0", task=task, **short)
    else:
        env = gymnasium.make_vec("DiffIDM-v0", num_envs=3, task=task, **short)
    if face == "sb3":
        env = SB3VecEnv(env)
        env.seed(3)
        return env, env.reset()
    return env, env.reset(seed=3)


def action_of(face: str, env: Any, draw: np.random.Generator) -> Any:
    """Return random actions for all that act."""
    if face == "pettingzoo":
        return {agent: draw.uniform(-1, 1, env.action_space(agent).shape).astype(np.float32) for agent in env.agents}
    shape = (3, *env.action_space.shape) if face == "sb3" else env.action_space.shape
    return draw.uniform(-1, 1, shape).astype(np.float32)


def course(face: str, task: str, write: bool) -> tuple[list[list[np.ndarray]], list[list[np.ndarray]]]:
    """Return all that some steps hand out, as it is in the end and as it was; ``write`` writes to it between them."""
    env, out = begun(face, task)
    draw, originals, copies = np.random.default_rng(0), [], []
    for _ in range(STEPS):
        action = action_of(face, env, draw)
        if write:
            for x in arrays(out):
                x[...] = 1 if x.dtype == bool else 7000
        over = not action if face == "pettingzoo" else face == "single" and len(out) == 5 and (out[2] or out[3])
        out = env.reset() if over else env.step(action)
        if write:
            for x in arrays(action):
                x[...] = 7000
        originals.append(list(arrays(out)))
        copies.append([x.copy() for x in originals[-1]])
    return originals, copies


def same(one: list[list[np.ndarray]], other: list[list[np.ndarray]]) -> bool:
    """Whether two courses are equal to the bit."""
    return all(
        len(a) == len(b) and all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in zip(a, b, strict=True))
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("task", ["ring", "highway", "merge"])
@pytest.mark.parametrize("face", ["single", "vector", "sb3", "pettingzoo"])
def test_what_is_handed_out_is_the_receivers(face, task):
    originals, copies = course(face, task, write=False)
    assert same(originals, copies), "it changed later"
    assert same(course(face, task, write=True)[1], copies), "writing to it changed the steps"
