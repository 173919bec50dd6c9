"""TorchRL over every face of Gymnasium: its checker, and what it collects against our own environments."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from torchrl.envs import GymEnv, GymWrapper, PettingZooWrapper
from torchrl.envs.utils import check_env_specs

import idm_env  # noqa: F401
from idm_env import backends
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import TASKS

LIMIT, COUNT = 4, 3
QUICK = {"warmup": 5, "max_episode_steps": LIMIT}


def vector(**keywords):
    return gym.make_vec("DiffIDM-v0", num_envs=COUNT, **{**QUICK, **keywords})


def ahead(tensordict):
    """Command a little more at every step, so that what is collected depends on the actions."""
    return tensordict.set("action", torch.full((*tensordict.batch_size, 1), 0.3))


@pytest.mark.parametrize("name", ["DiffIDM-v0", "idm_env:DiffIDM-v0"])
def test_an_environment_by_name(name):
    env = GymEnv(name, **QUICK)
    check_env_specs(env)
    own = gym.make("DiffIDM-v0", **QUICK)
    env.set_seed(3)
    seen = env.rollout(LIMIT, ahead, auto_reset=False, tensordict=env.reset(seed=3))
    np.testing.assert_array_equal(seen["observation"][0], own.reset(seed=3)[0])
    for t in range(LIMIT):
        observation, reward, terminated, truncated, _ = own.step(np.full(1, 0.3, np.float32))
        np.testing.assert_array_equal(seen["next", "observation"][t], observation)
        assert seen["next", "reward"][t].item() == pytest.approx(reward)
        assert (seen["next", "terminated"][t].item(), seen["next", "truncated"][t].item()) == (terminated, truncated)


def test_frames_are_skipped_by_torchrl():
    env, plain = GymEnv("DiffIDM-v0", frame_skip=2, **QUICK), GymEnv("DiffIDM-v0", **QUICK)
    seen, every = (e.rollout(2, ahead, auto_reset=False, tensordict=e.reset(seed=1)) for e in (env, plain))
    torch.testing.assert_close(seen["next", "observation"][0], every["next", "observation"][1])


def crash(tensordict):
    """Let the first of the environments run into its leader, so that they end at different steps."""
    return tensordict.set("action", torch.tensor([[1.0], [0.0], [0.1]]))


@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("mode", [None, "SameStep", "Disabled"])
def test_a_vector_is_collected_over_ends_as_gymnasiums_is(mode, output):
    tight = {"warmup": 5, "max_episode_steps": 40, "vehicles": 3, "length": 20.0, "max_command": 5.0}
    ours = GymWrapper(
        gym.make_vec(
            "DiffIDM-v0", num_envs=COUNT, output=output, **tight, **({} if mode is None else {"autoreset_mode": mode})
        )
    )
    theirs = GymWrapper(
        gym.vector.SyncVectorEnv(
            [lambda: gym.make("DiffIDM-v0", **tight)] * COUNT, autoreset_mode=AutoresetMode(mode or "SameStep")
        )
    )
    check_env_specs(ours)
    mine, other = (
        env.rollout(90, crash, auto_reset=False, tensordict=env.reset(seed=5), break_when_any_done=False).detach()
        for env in (ours, theirs)
    )
    done = other["next", "done"].squeeze(-1)
    assert (done.any(0) & ~done.all(0)).any()
    for key in ("observation", ("next", "observation"), ("next", "reward")):
        torch.testing.assert_close(mine[key].double(), other[key].double(), rtol=0.0, atol=1e-5)
    for key in ("terminated", "truncated", "done"):
        assert torch.equal(mine["next", key], other["next", key])


@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("name", TASKS)
def test_a_vector_of_every_task_is_collected_over_ends_with_all_that_infos_tell(name, output):
    quick = {"warmup": 2} if name == "ring" else {}
    with backends.off():
        ours = gym.make_vec("DiffIDM-v0", num_envs=2, task=name, output=output, max_episode_steps=3, **quick)
        told, ids = set(ours.reset(seed=0)[1]) | set(ours.step(None)[-1]), ours.unwrapped.task.vehicle_ids
        seen = GymWrapper(ours).rollout(8, break_when_any_done=False)
    assert seen["next", "done"].sum() == 4
    assert {key for key in told if not key.startswith("_")} <= set(seen["next"].keys())
    if ids is not None:
        (agent,) = ours.unwrapped.task.agents
        assert bytes(seen["next", "vehicle_id"][1, 5, 0].tolist()).rstrip(b"\0").decode() == ids[agent]


def test_the_vector_says_its_mode_as_gymnasiums_vectors_do():
    theirs = gym.make_vec("CartPole-v1", num_envs=1, vectorization_mode="sync")
    assert theirs.autoreset_mode is theirs.metadata["autoreset_mode"]
    for mode in AutoresetMode:
        env = vector(autoreset_mode=mode)
        assert env.autoreset_mode is env.metadata["autoreset_mode"] is mode
    assert vector().autoreset_mode is AutoresetMode.SAME_STEP


def test_the_ego_of_an_open_road_is_one_agent_until_the_end():
    """At the defaults of PettingZoo's face: it leaves and enters again, and is collected all the while."""
    with backends.off():
        env = PettingZooWrapper(
            parallel_env(task="merge", vehicles=30, inflow=2400.0, ramp_inflow=500.0, max_cycles=60)
        )
        seen = env.rollout(70, break_when_any_done=False)
    own = env.unwrapped.task.bounds.names.index("position")
    place = seen["vehicle", "observation"][:60, 0, own]
    assert env.unwrapped.possible_agents == ["vehicle_0"] and seen["next", "done"].sum() == 1
    assert bool((place.diff() < -3.0).any())


@pytest.mark.parametrize("use_mask", [False, True])
def test_fixed_agents_of_an_open_road_are_collected_with_their_mask(use_mask):
    road = {"vehicles": 30, "controlled": [2, 29], "inflow": 2400.0, "ramp_inflow": 500.0, "max_episode_steps": 6}
    with backends.off():
        env = PettingZooWrapper(parallel_env(task="merge", fixed=True, **road), use_mask=use_mask)
        check_env_specs(env)
        own = env.unwrapped.task.bounds.names.index("present")
        seen = env.rollout(15, break_when_any_done=False)
    assert seen["next", "done"].sum() == 2
    present, observed = (seen["next"]["vehicle"][name] for name in (("info", "present"), "observation"))
    assert torch.equal(present > 0, observed[..., own] > 0) and (present > 0).any() and (present == 0).any()
    assert set(seen["vehicle", "info"].keys()) == set(seen["next", "vehicle", "info"].keys())
