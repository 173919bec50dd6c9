"""Whatever a face returns is the caller's: writing into it changes nothing later, in any task, mode or output."""

from __future__ import annotations

import contextlib
import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import idm_env  # noqa: F401
from idm_env import backends
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import TASKS

FACES = ["single", "single torch", "SameStep", "SameStep torch", "NextStep", "Disabled", "Disabled torch", "each"]


def spoilt(told: Any) -> None:
    """Write into everything that was returned."""
    if isinstance(told, dict):
        for value in told.values():
            spoilt(value)
        told.clear()
    elif isinstance(told, (tuple, list)):
        for value in told:
            spoilt(value)
    elif isinstance(told, torch.Tensor):
        told.detach().copy_(~told if told.dtype == torch.bool else torch.full_like(told, 77))
    elif isinstance(told, np.ndarray):
        told[...] = ~told if told.dtype == bool else None if told.dtype == object else 77


def episode(name: str, face: str, spoil: bool) -> list[Any]:
    """Return copies of all that is told in a few short episodes, whatever is then done to the originals."""
    kept: list[Any] = []

    def seen(told: Any) -> Any:
        kept.append(copy.deepcopy(told))
        if spoil:
            spoilt(told)
        return kept[-1]

    mode, _, output = face.partition(" ")
    choices: dict[str, Any] = {"task": name, "controlled": 2, **({"warmup": 2} if name == "ring" else {})}
    if mode == "each":
        many = parallel_env(max_cycles=9, **choices)
        seen(many.reset(seed=1))
        while many.agents:
            seen(many.step({agent: np.full(1, 0.2, np.float32) for agent in many.agents}))
            seen(many.state())
        return kept
    choices |= {"output": output or "numpy", "max_episode_steps": 4}
    if mode == "single":
        env: Any = gym.make("DiffIDM-v0", **choices).unwrapped
        action = torch.full((2,), 0.2)
    else:
        env = gym.make_vec("DiffIDM-v0", num_envs=3, autoreset_mode=mode, **choices)
        action = torch.full((3, 2), 0.2)
    seen(env.reset(seed=1))
    for t in range(11):
        *_, terminated, truncated, _ = seen(env.step(action if output else action.numpy()))
        seen(env.unwrapped.state)
        over = np.asarray(terminated) | np.asarray(truncated)
        if mode == "single" and over:
            seen(env.reset())
        elif mode == "Disabled" and (over.any() or t == 1):
            seen(env.reset(options={"reset_mask": over | np.array([t == 1, False, False])}))
    return kept


def same(one: Any, other: Any) -> bool:
    """Return whether two of what was told are equal to the last bit; NaN is itself."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return torch.equal(one.nan_to_num(-1.0), other.nan_to_num(-1.0))
    if isinstance(one, np.ndarray) and one.dtype == object:
        return all(map(same, one.tolist(), other.tolist()))
    return np.array_equal(one, other, equal_nan=np.asarray(one).dtype.kind == "f")


def printed(name: str) -> Any:
    """Compiled loops own what they write to in every task alike: one of them is enough, and the others are cheap."""
    return contextlib.nullcontext() if name == "ring" else backends.off()


@pytest.mark.parametrize("name", TASKS)
def test_writing_into_what_was_returned_changes_nothing_later(name: str) -> None:
    with printed(name):
        for face in FACES:
            untouched, written = episode(name, face, spoil=False), episode(name, face, spoil=True)
            assert len(untouched) == len(written) > 5
            for t, (one, other) in enumerate(zip(untouched, written, strict=True)):
                assert same(one, other), (face, t)


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.filterwarnings("error")
def test_gymnasiums_own_checks_pass_in_every_task(name: str) -> None:
    with printed(name):
        env = gym.make("DiffIDM-v0", task=name, **({"warmup": 5} if name == "ring" else {}))
        check_env(env.unwrapped, skip_render_check=True)
