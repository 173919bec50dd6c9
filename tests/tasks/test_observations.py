"""What agents see: about unit size by default, SI units on request, and never outside its space."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import TASKS, make_task

WILD = {"random": None, "throttle": 1.0, "brake": -1.0}


# Both kinds are clamped alike: each is tried with one of two bounds of commands, of which each is compiled anew.
@pytest.mark.parametrize(("observation", "command"), [("scaled", 60.0), ("raw", 1.0)])
@pytest.mark.parametrize("task", TASKS)
def test_nothing_leaves_the_space_whatever_happens(task, command, observation):
    # Nobody stops at a crash: vehicles drive through each other, at absurd speeds.
    env = gym.make("DiffIDM-v0", task=task, max_command=command, controlled=2, observation=observation).unwrapped
    generator = np.random.default_rng(0)
    for action in WILD.values():
        seen, _ = env.reset(seed=1)
        assert env.observation_space.contains(seen)
        for _ in range(120):
            wanted = generator.uniform(-1.0, 1.0, 2) if action is None else np.full(2, action)
            seen, *_ = env.step(wanted)
            assert env.observation_space.contains(seen)


@pytest.mark.parametrize("task", TASKS)
def test_the_state_of_pettingzoo_is_met_too(task):
    env = parallel_env(task=task, max_command=60.0)
    for action in (1.0, -1.0):
        env.reset(seed=0)
        for _ in range(100):
            env.step({agent: np.full(1, action, np.float32) for agent in env.agents})
            assert env.state_space.contains(env.state())


@pytest.mark.parametrize(
    "keywords", [{"task": "ring"}, {"task": "ring", "warmup": 3000, "warmup_pool": 16}, {"task": "follow"},
                 {"task": "platoon"}, {"task": "replay"}],
)  # fmt: skip
def test_entries_are_about_unit_size(keywords):
    vector = gym.make_vec("DiffIDM-v0", num_envs=16, autoreset_mode="SameStep", **keywords)
    seen = [vector.reset(seed=0)[0]]
    generator = np.random.default_rng(0)
    for step in range(600):
        action = None if step < 300 else generator.uniform(-0.2, 0.2, (16, 1))
        seen.append(vector.step(action)[0])
    size = np.sqrt(np.square(np.concatenate(seen)).mean(0))
    names = vector.unwrapped.task.bounds.names
    # Differences of speeds are small where the traffic is calm.
    low = [0.02 if name in ("relative_speed", "deviation") else 0.1 for name in names]
    assert (size > low).all(), dict(zip(names, size, strict=True))
    assert (size < 4.0).all(), dict(zip(names, size, strict=True))


def test_the_ring_varies_by_more_than_hundredths():
    # Over Flow's 15, 15 and 270 these are 0.04, 0.004 and 0.002: a network cannot see them.
    vector = gym.make_vec("DiffIDM-v0", num_envs=16)
    seen = [vector.reset(seed=0)[0], *(vector.step(None)[0] for _ in range(600))]
    assert (np.concatenate(seen).std(0) > 0.05).all()


@pytest.mark.parametrize("task", TASKS)
def test_raw_is_si_and_scaled_is_raw_over_documented_scales(task):
    scaled, raw = (gym.make("DiffIDM-v0", task=task, observation=kind) for kind in ("scaled", "raw"))
    first, second = scaled.reset(seed=3)[0], raw.reset(seed=3)[0]
    scales = np.tile(scaled.unwrapped.task.scales, len(scaled.unwrapped.task.agents))
    np.testing.assert_allclose(first * scales, second, rtol=1e-6)
    agent = raw.unwrapped.task.agents[0]
    state = raw.unwrapped.state
    there = 1.0 if state.present is None else float(state.present[0, agent])  # on merge the ego comes within 3 s
    assert second[0] == pytest.approx(there * float(state.speed[0, agent]))
    high = np.tile(np.float32(raw.unwrapped.task.bounds.high), len(raw.unwrapped.task.agents))
    np.testing.assert_array_equal(raw.observation_space.high, high)


def test_a_misspelled_kind_has_a_suggestion():
    with pytest.raises(ValueError, match="Did you mean 'scaled'"):
        make_task("ring", observation="scale")


def test_scaling_is_not_differentiated_away():
    env = gym.make("DiffIDM-v0", task="ring", output="torch", warmup=5, max_command=1.0)
    env.reset(seed=0)
    action = torch.zeros(1, requires_grad=True)
    seen, *_ = env.step(action)
    seen[0].backward()
    assert float(action.grad) == pytest.approx(0.1 / 5.0)
