"""Beginnings that were made ahead, and a past that is never moved, are those that a single environment has."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.delay_buffer import PAST
from idm_env.envs.batch import Batch
from idm_env.envs.beginnings import Beginnings
from idm_env.envs.past import Past
from idm_env.envs.settings import settings

RING = {"warmup": 4, "effects": ["delay"], "dtype": "float64", "noise": 0.3}


def test_rows_that_end_again_and_again_begin_as_single_environments_do():
    count, steps = 6, 60
    vector = gym.make_vec("DiffIDM-v0", num_envs=count, autoreset_mode="SameStep", max_episode_steps=7, **RING)
    singles = [gym.make("DiffIDM-v0", max_episode_steps=7, **RING) for _ in range(count)]
    rows, _ = vector.reset(seed=3)
    seen = np.stack([env.reset(seed=3 + i)[0] for i, env in enumerate(singles)])
    np.testing.assert_array_equal(rows, seen)
    made = vector.unwrapped.batch
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (steps, count, 1))
    for t, action in enumerate(actions):
        if t % 9 == 4:  # rows end one by one too, as after a crash
            one = np.arange(count) == t % count
            rows = vector.unwrapped._out(made.reset(np.flatnonzero(one)))
            seen[t % count] = singles[t % count].reset()[0]
            np.testing.assert_allclose(rows, seen, rtol=1e-12)
        rows, _, ended, cut, _ = vector.step(action)
        for i, env in enumerate(singles):
            seen[i], _, over, short, _ = env.step(action[i])
            assert (over, short) == (ended[i], cut[i])
            if over or short:
                seen[i] = env.reset()[0]
        np.testing.assert_allclose(rows, seen, rtol=1e-12)


@pytest.mark.parametrize("count", [1, 50])
def test_no_more_are_made_in_vain_than_were_used(count):
    """Of few rows several episodes are made ahead."""
    made = []

    def make(rows, episodes):
        made.append(len(rows))
        return {"x": torch.as_tensor(1000 * rows + episodes)}

    beginnings, episodes = Beginnings(make, count), np.zeros(count, dtype=np.int64)
    beginnings.take(np.arange(count), episodes)
    del made[:]
    generator = np.random.default_rng(0)
    used = 0
    for _ in range(300):
        rows = generator.choice(count, min(count, generator.integers(1, 4)), replace=False)
        episodes[rows] += 1
        assert torch.equal(beginnings.take(rows, episodes)["x"], torch.as_tensor(1000 * rows + episodes[rows]))
        used += len(rows)
        assert sum(made) <= used + min(used + count, max(count, 8))
    assert len(made) < 100  # of 300 calls


@pytest.mark.parametrize("change", ["seed", "params"])
def test_what_was_made_ahead_is_forgotten_with_the_seed_and_the_parameters(change):
    def episodes(early):
        batch = Batch(settings(task="ring", warmup=20, start="wave", dtype="float64"), 4)
        batch.seed(np.arange(4), range(4))
        batch.reset()
        if early:
            for i in range(4):
                batch.reset(np.array([i]))
            batch.episodes[:] = 0
        if change == "seed":
            batch.seed(np.arange(4), range(10, 14))
        else:
            slow = {**batch.params["idm"], "time_gap": batch.params["idm"]["time_gap"] + 0.5}
            batch.set_params({**batch.params, "idm": slow})
        return np.asarray(batch.reset(np.arange(3)))[:3]

    np.testing.assert_array_equal(episodes(True), episodes(False))


def test_a_past_returns_to_its_begin_and_keeps_what_counts():
    batch = Batch(settings(task="ring", warmup=0, effects=["delay"]), 2)
    state = batch.task.begin(batch._draws(np.arange(2), np.zeros(2, np.int64)), batch.params).state
    past, told = Past(state), np.random.default_rng(0).normal(size=(200, 2, *state.memory[PAST].shape[-1:], 22))
    past.load(state)
    expected = list(past.tensor().movedim((-2, -1), (0, 2)).numpy())
    for signals in told.astype(np.float32):
        past.room()
        past.newest -= 1
        past.numbers[:, past.newest] = signals
        expected = [signals, *expected[:-1]]
        np.testing.assert_array_equal(past.tensor().movedim((-2, -1), (0, 2)).numpy(), np.stack(expected))
