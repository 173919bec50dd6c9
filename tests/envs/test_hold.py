"""An action is held for some steps of Δt, in every task: what a step of the environment then is, and pays."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env import backends
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import TASKS, make_task


@pytest.mark.parametrize("name", TASKS)
def test_a_held_action_is_so_many_steps_under_it(name: str) -> None:
    """Observations, ends and infos are those of the last of them, the reward and its parts are their means.

    A decision is a loop over steps, whatever steps: one task of one lane and one of several are compiled.
    """
    choices = {"task": name, "controlled": 1, "warmup": 10} if name == "ring" else {"task": name, "controlled": 1}
    with contextlib.nullcontext() if name in ("ring", "highway") else backends.off():
        once, held = (
            gym.make("DiffIDM-v0", **choices, hold=hold, max_episode_steps=n) for hold, n in ((0.1, 12), (0.3, 4))
        )
    np.testing.assert_array_equal(once.reset(seed=3)[0], held.reset(seed=3)[0])
    for k in range(4):
        action = held.action_space.sample() * 0 + np.float32(0.3 * (-1) ** k)
        total, parts = 0.0, []
        for _ in range(3):
            seen, reward, terminated, truncated, info = once.step(action)
            total += reward / 3
            parts.append(info.pop("rewards"))
        found = held.step(action)
        np.testing.assert_array_equal(found[0], seen)
        assert found[1] == pytest.approx(total, rel=1e-5, abs=1e-6)
        assert found[2:4] == (terminated, truncated) == (False, k == 3)
        np.testing.assert_allclose(found[4].pop("rewards"), np.mean(parts, 0), rtol=1e-5)
        assert all(np.array_equal(found[4][key], value) for key, value in info.items())


def test_rows_that_end_while_an_action_is_held_tell_of_their_end() -> None:
    """Rewards, last observations and reasons are those of the step in which each row crashed."""
    choices = {"task": "ring", "warmup": 10, "max_command": 6.0}
    held = gym.make_vec("DiffIDM-v0", num_envs=4, **choices, hold=2.0)
    held.reset(seed=5)
    ended: dict[int, int] = {}
    for step in range(30):
        _, reward, terminated, _, info = held.step(np.ones((4, 1), np.float32))
        for row in np.flatnonzero(terminated):
            if row in ended:
                continue
            ended[row] = step
            once = gym.make("DiffIDM-v0", **choices)
            once.reset(seed=5 + int(row))
            over, paid, k = False, [], 0
            while not over:
                seen, paid_now, over, _, told = once.step(np.ones(1, np.float32))
                paid.append(paid_now)
                k += 1
            assert k <= 20 * (step + 1) < k + 20
            np.testing.assert_array_equal(info["final_obs"][row], seen)
            assert reward[row] == pytest.approx(sum(paid[20 * step :]) / 20, rel=1e-5)
            assert info["final_info"]["crash_reason"][row] == told["crash_reason"]
    assert len(ended) == 4


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_observations_are_read_once_a_decision(output: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By torch, where every reading costs as much as a step; and where a row ends in between."""
    env = gym.make_vec("DiffIDM-v0", num_envs=2, task="merge", vehicles=12, output=output)
    env.unwrapped.batch.values = None
    env.reset(seed=3)
    task, read = env.unwrapped.task, []
    observe = type(task).observe
    monkeypatch.setattr(type(task), "observe", lambda self, world: (read.append(1), observe(self, world))[1])
    action = torch.zeros(env.action_space.shape)
    for _ in range(3):
        seen = env.step(action if output == "torch" else action.numpy())[0]
    assert task.held == 10 and len(read) == 3
    np.testing.assert_array_equal(np.asarray(seen), observe(task, env.unwrapped.batch.world).flatten(1))


def test_a_hold_that_is_no_whole_number_of_steps_is_one_line() -> None:
    """Value, rule and cure."""
    with pytest.raises(ValueError, match=r"^hold = 0\.25 s must be a whole number of Δt = 0\.1 s, such as 0\.2\.$"):
        make_task("ring", hold=0.25)


@pytest.mark.parametrize(("hold", "fps"), [(None, 10), (0.5, 2), (1.0, 1), (5.0, 1)])
def test_pictures_are_shown_as_fast_as_time_goes_by(hold: float | None, fps: int) -> None:
    """In every face; of longer decisions one a second."""
    single = gym.make("DiffIDM-v0", task="platoon", hold=hold)
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, task="platoon", hold=hold)
    assert single.metadata["render_fps"] == vector.metadata["render_fps"] == fps


@pytest.mark.parametrize(("hold", "each"), [(None, 1), (1.0, 10)])
def test_a_list_of_pictures_has_ten_a_second(hold: float | None, each: int) -> None:
    """A held action's too, in every face; the last of them is that of ``rgb_array``, and a call empties the list."""
    made = {"task": "follow", "hold": hold}
    single, still = (gym.make("DiffIDM-v0", render_mode=x, **made) for x in ("rgb_array_list", "rgb_array"))
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, render_mode="rgb_array_list", **made)
    turns = parallel_env(render_mode="rgb_array_list", **made)
    for env in (single, still, turns, vector):
        env.reset(seed=3)
    still.render()
    assert single.metadata["render_fps"] == vector.metadata["render_fps"] == 10
    assert [len(single.render()), len(turns.render()), *map(len, vector.render())] == [1, 1, 1, 1]
    for env in (single, still, turns, vector):
        env.step(None)
        env.step(None)
    moments = single.render()
    assert [len(moments), len(turns.render()), *map(len, vector.render())] == [2 * each] * 4
    np.testing.assert_array_equal(moments[-1], still.render())
    assert single.render() == [] and (each == 1 or (moments[3] != moments[4]).any())
