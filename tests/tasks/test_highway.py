"""Task ``highway``: faces, lane commands, gradients."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import idm_env  # noqa: F401
from idm_env import backends
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import make_task

EMPTY = {"task": "highway", "vehicles": 2, "length": 2000.0, "controlled": [1], "lanes_count": 3}


def lanes_of(env: gym.Env, action: np.ndarray, steps: int) -> list[int]:
    """Return the lane of vehicle 1 after every step."""
    env.reset(seed=1)
    seen = []
    for _ in range(steps):
        env.step(action)
        seen.append(int(env.unwrapped.state.lanes.lane[0, 1]))
    return seen


def test_agents_command_lanes_where_that_is_asked_for() -> None:
    """One lane a second to the left until there is none, and back; in every face alike."""
    env = gym.make("DiffIDM-v0", lane_commands=True, **EMPTY)
    assert env.action_space.shape == (2,)
    left = lanes_of(env, np.array([0.0, 1.0], np.float32), 25)
    assert left[0] == left[9] == 2 and left[10] == left[24] == 2
    blocked = int(env.unwrapped.state.lanes.blocked[0, 1])
    assert blocked == 2
    right = lanes_of(env, np.array([0.0, -1.0], np.float32), 25)
    assert right[0] == right[24] == 0
    assert set(lanes_of(env, np.array([0.0, 0.2], np.float32), 25)) == {1}
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, lane_commands=True, **EMPTY)
    vector.reset(seed=1)
    vector.step(np.array([[0.0, 1.0], [0.0, -1.0]], np.float32))
    assert vector.state.lanes.lane[:, 1].tolist() == [2, 0]
    each = parallel_env(lane_commands=True, **EMPTY)
    each.reset(seed=1)
    (agent,) = each.agents
    assert each.action_space(agent).shape == (2,)
    each.step({agent: np.array([0.0, 1.0], np.float32)})
    assert each.batch.world.state.lanes.lane[0, 1] == 2


def test_actions_may_be_whole_numbers_in_every_face() -> None:
    """Three levels of acceleration and of lanes: the middle one of each does nothing, and what is no level is said."""
    made = {**EMPTY, "lane_commands": True, "discrete": 3, "vehicles": 3, "controlled": [1, 2]}
    env, box = (gym.make("DiffIDM-v0", **{**made, "discrete": n}) for n in (3, 0))
    assert env.action_space == gym.spaces.MultiDiscrete([3, 3, 3, 3])
    check_env(gym.make("DiffIDM-v0", **made).unwrapped, skip_render_check=True)
    for whole, number in (([0, 1, 2, 0], [-1, 0, 1, -1]), ([1, 2, 1, 2], [0, 1, 0, 1])):
        env.reset(seed=1), box.reset(seed=1)
        for _ in range(12):
            first = env.step(np.array(whole))
            other = box.step(np.array(number, np.float32))
            np.testing.assert_array_equal(first[0], other[0])
        assert env.unwrapped.state.lanes.lane.tolist() == box.unwrapped.state.lanes.lane.tolist()
    with pytest.raises(ValueError, match="must be whole numbers"):
        env.step(np.array([0, 1, 2, 3]))
    with pytest.raises(ValueError, match="must be whole numbers"):
        env.step(np.array([0.0, 1.0, 2.0, 0.0]))
    with pytest.raises(ValueError, match="discrete = 1 leaves agents no choice"):
        make_task("highway", discrete=1)
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, **made)
    vector.reset(seed=1)
    vector.step(vector.action_space.sample())
    each = parallel_env(**made)
    each.reset(seed=1)
    assert each.action_space("vehicle_1") == gym.spaces.MultiDiscrete([3, 3])
    each.step({agent: np.array([1, 2]) for agent in each.agents})
    assert each.batch.world.state.lanes.lane[0].tolist() == [0, 2, 2]


def test_stable_baselines3_takes_whole_numbers() -> None:
    """PPO acts on a vector of highways with lane commands, and learns from what comes back."""
    sb3 = pytest.importorskip("stable_baselines3")
    from idm_env.envs.sb3 import SB3VecEnv

    choices = {"vehicles": 8, "length": 300.0, "lanes_count": 3, "lane_commands": True, "discrete": 3}
    agent = sb3.PPO("MlpPolicy", SB3VecEnv(gym.make_vec("DiffIDM-v0", num_envs=2, task="highway", **choices)),
                    n_steps=8, batch_size=16, n_epochs=1, seed=1)  # fmt: skip
    agent.learn(32)
    assert agent.num_timesteps == 32


def test_infos_count_changes_and_refusals_from_the_beginning_of_the_episode() -> None:
    """What an agent commands off the road or into another vehicle is refused, and said, in every face."""
    env = gym.make("DiffIDM-v0", lane_commands=True, **EMPTY)
    for _ in range(2):
        env.reset(seed=1)
        for _ in range(31):
            info = env.step(np.array([0.0, 1.0], np.float32))[-1]
        assert info["lane_changes"].tolist() == [1] and info["lane_refusals"].tolist() == [3]
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, lane_commands=True, info=["lane_refusals"], **EMPTY)
    vector.reset(seed=1)
    for _ in range(11):
        info = vector.step(np.array([[0.0, 1.0], [0.0, 0.0]], np.float32))[-1]
    assert info["lane_refusals"].tolist() == [[1], [0]] and "lane_changes" not in info
    each = parallel_env(lane_commands=True, **EMPTY)
    each.reset(seed=1)
    (agent,) = each.agents
    for _ in range(11):
        info = each.step({agent: np.array([0.0, 1.0], np.float32)})[-1]
    assert info[agent]["lane_changes"] == 1 and info[agent]["lane_refusals"] == 1


def test_gradients_flow_through_steps_and_changes() -> None:
    """Of a later reward by an earlier action, which finite differences confirm."""
    env = gym.make("DiffIDM-v0", task="highway", vehicles=16, length=300.0, output="torch", dtype="float64")

    def total(push: torch.Tensor) -> torch.Tensor:
        env.reset(seed=3)
        rewards = [env.step(push if t == 0 else torch.zeros(1, dtype=torch.float64))[1] for t in range(25)]
        return torch.stack(rewards).sum()

    push = torch.tensor([0.2], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(total(push), push)
    h = 1e-5
    expected = (total(push.detach() + h) - total(push.detach() - h)) / (2 * h)
    torch.testing.assert_close(slope[0], expected, rtol=1e-5, atol=1e-8)


def test_few_vehicles_change_lanes_as_many_do() -> None:
    """Of fewer than a vector of the machine, too: gaps to new leaders as torch has them, and as positions say."""
    states = []
    for path in (contextlib.nullcontext(), backends.off()):
        with path:
            env = gym.make("DiffIDM-v0", task="highway", vehicles=5, length=300.0, hold=1.0, warmup=0, dtype="float64")
            env.reset(seed=0)
            for _ in range(10):
                env.step(None)
            states.append(env.unwrapped.state)
    compiled, plain = states
    assert int(plain.lanes.changed.sum()) > 0
    torch.testing.assert_close(compiled.gap, plain.gap, rtol=0.0, atol=1e-9)
    round_ring = compiled.position.gather(-1, compiled.lanes.leader) - 5.0 - compiled.position - compiled.gap
    torch.testing.assert_close(round_ring.remainder(300.0).sub(150.0).abs(), torch.full_like(round_ring, 150.0))


def test_desired_speeds_are_spread_and_bad_roads_are_refused() -> None:
    """In one line each."""
    speeds = make_task("highway", spread=0.2).params(torch.float64, "cpu")["idm"]["desired_speed"]
    assert 24.0 <= speeds.min() < 25.0 and 35.0 < speeds.max() <= 36.0
    with pytest.raises(ValueError, match="do not fit 2 lanes of 100 m"):
        make_task("highway", length=100.0, vehicles=80)
    with pytest.raises(ValueError, match="spread = 1 must be below 1"):
        make_task("highway", spread=1.0)
    with pytest.raises(ValueError, match="takes an input that task 'highway' does not give"):
        make_task("highway", effects=["lane_command"])
