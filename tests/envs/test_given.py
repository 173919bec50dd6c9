"""A state that a user gives to begin with: every one of the task's own is taken, any other is refused in one line."""

from __future__ import annotations

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env import backends
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import TASKS
from idm_env.types import Moving, State, mapped

QUICK: dict[str, dict[str, Any]] = {"ring": {"warmup": 0, "start": "wave"}, "replay": {"effects": ["delay"]}}
SEVERAL = [name for name in TASKS if "highway" in name or name in ("merge", "bottleneck", "replay_lanes", "approach")]
OPEN = ("open_highway", "merge", "bottleneck", "approach")


def begun(name: str, face: str = "single") -> tuple[Any, State]:
    """Return an environment and its state after a few steps."""
    choices = {"task": name, "dtype": "float64", **QUICK.get(name, {})}
    if face == "each":
        env: Any = parallel_env(**choices)
        env.reset(seed=3)
        return env, mapped(lambda x: x.clone(), env.batch.world.state)
    env = gym.make("DiffIDM-v0", **choices) if face == "single" else gym.make_vec("DiffIDM-v0", num_envs=3, **choices)
    env.reset(seed=3)
    return env, env.unwrapped.state


@pytest.fixture(autouse=True)
def uncompiled():
    """What is checked does not depend on what steps."""
    with backends.off():
        yield


@pytest.mark.parametrize("name", TASKS)
def test_every_state_on_the_way_is_taken_as_it_is(name: str) -> None:
    """In every task, after 0, 40 and 80 steps, which hold decisions about lanes, entries and exits."""
    env, state = begun(name, "vector")
    other, _ = begun(name, "vector")
    for _ in range(3):
        other.reset(seed=3, options={"state": state})
        for got, want in zip(other.unwrapped.state, state, strict=True):
            mapped(lambda a, b: torch.testing.assert_close(a, b, rtol=0.0, atol=0.0) or a, got, want)
        for _ in range(40):
            env.step(None)
        state = env.unwrapped.state


def put(path: str, value: Any):
    """Return the change of one number of a state, of its first environment and second vehicle."""

    def written(part: Any, names: list[str]) -> Any:
        if names:
            return part._replace(**{names[0]: written(getattr(part, names[0]), names[1:])})
        x = part.clone()
        x[(0, 1) if x.dim() > 1 else 0] = value
        return x

    return lambda state: written(state, path.split("."))


NUMBERS = [
    *((put(field, bad), f"{field} = ") for field in ("position", "speed", "accel", "gap", "length")
      for bad in (np.nan, np.inf, -np.inf, 1e30)),
    *((put(field, -1), f"{field} = -1") for field in ("speed", "length", "step")),
    (lambda s: s._replace(gap=torch.where(s.gap == s.gap.amin(), 7777.0, s.gap)),
     r"gap = .* m of vehicle \d+ of environment \d, and positions say"),
    (lambda s: s._replace(position=torch.where(s.gap == s.gap.amin(), s.position - 10.0, s.position)),
     r"gap = .* and positions say"),
]  # fmt: skip
SHAPES = [
    (lambda s: 7, "is of type int: give a State"),
    (lambda s: tuple(s), "is of type tuple"),
    (lambda s: s._replace(position=s.position[:, 1:]), "position has shape"),
    (lambda s: s._replace(speed=s.speed[..., None]), "speed has shape"),
    (lambda s: s._replace(speed=s.speed.repeat(2, 1)), "speed has shape"),
    (lambda s: s._replace(gap=s.gap.float()), "gap is a torch.Tensor of torch.float32"),
    (lambda s: s._replace(accel=s.accel.tolist()), "accel is a list, and a"),
    (lambda s: s._replace(step=s.step.double()), "step is a torch.Tensor of torch.float64"),
    (lambda s: s._replace(length=None), "length is missing"),
    (lambda s: s._replace(memory={"lag": s.speed}), r"memory\.(lag is no part|(past|gap_acceptance) is missing)"),
]  # fmt: skip
LINKS = [
    *((put("lanes.lane", lane), f"lanes.lane = {lane} is outside") for lane in (100_000, 50, -3)),
    *((put(f"lanes.{part}", slot), f"lanes.{part} = {slot} is outside") for slot in (100_000, -1)
      for part in ("leader", "follower")),
    (lambda s: s._replace(lanes=s.lanes._replace(moving=Moving(*[s.lanes.lane] * 2, s.lanes.lane + 100_000))),
     "moving.shadow = "),
    (lambda s: s._replace(lanes=None), "lanes.lane is missing"),
    (lambda s: s._replace(lanes=s.lanes._replace(lane=s.lanes.lane.float())), "lane is a torch.Tensor of torch.f"),
    (lambda s: s._replace(lanes=s.lanes._replace(leader=s.lanes.leader.roll(1, -1))), "do not follow"),
    (lambda s: s._replace(lanes=s.lanes._replace(lane=s.lanes.lane.clamp_max(0))), "do not follow"),
    (lambda s: s._replace(lanes=s.lanes._replace(leader=s.lanes.follower, follower=s.lanes.leader)), "do not follow"),
]  # fmt: skip
TRIPS = [
    (lambda s: s._replace(lanes=s.lanes._replace(trips=None)), "lanes.trips.departs is missing"),
    (lambda s: s._replace(present=None), "present is missing"),
    (put("lanes.trips.departs", np.nan), "lanes.trips.departs = nan"),
    (put("lanes.trips.lane", 100_000), "lanes.trips.lane = 100000 is outside"),
    (put("present", 2.0), "present = 2 is outside"),
]  # fmt: skip
BAD = [
    *((name, *case) for name in TASKS for case in NUMBERS + SHAPES),
    *((name, *case) for name in SEVERAL for case in LINKS),
    *((name, *case) for name in OPEN for case in TRIPS),
    ("ring", lambda s: s._replace(present=torch.ones_like(s.speed)), "present is no part of this task's state"),
]  # fmt: skip


@pytest.mark.parametrize("face", ["single", "vector", "each"])
@pytest.mark.parametrize("name", TASKS)
def test_a_state_that_does_not_fit_is_refused_in_one_line_and_nothing_begins(name: str, face: str) -> None:
    env, state = begun(name, face)
    batch = env.unwrapped.batch
    before, episodes = batch.world, batch.episodes.copy()
    for task, change, words in BAD:
        if task == name:
            with pytest.raises(ValueError) as told:
                env.reset(options={"state": change(state)})
            text = str(told.value)
            assert re.search(words, text) and text.startswith("options['state']") and "\n" not in text, (words, text)
            assert len(text) < 250 and batch.world is before and (batch.episodes == episodes).all()
    env.reset(options={"state": state if state.memory else state._replace(memory=None)})


@pytest.mark.parametrize("face", ["single", "vector", "each"])
def test_what_is_given_stays_the_givers(face: str) -> None:
    """Neither side sees what the other one does to its tensors later."""
    env, state = begun("highway", face)
    env.reset(options={"state": state})
    held = env.unwrapped.batch.world.state
    want = held.speed.clone()
    mapped(lambda x: x.zero_(), state)
    assert torch.equal(held.speed, want) and held.length.min() > 0
