"""Stable-Baselines3: its checker, its algorithms through the adapter, and SuperSuit over the PettingZoo face."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

import idm_env  # noqa: F401
from idm_env.envs.pettingzoo import parallel_env
from idm_env.envs.sb3 import SB3VecEnv

QUICK = {"warmup": 5}


def adapter(mode=None, limit=20, count=4, **keywords):
    """Return the adapter over a vector, by default in the vector's own mode."""
    chosen = {**QUICK, **keywords} | ({} if mode is None else {"autoreset_mode": mode})
    return SB3VecEnv(gym.make_vec("DiffIDM-v0", num_envs=count, max_episode_steps=limit, **chosen))


@pytest.mark.parametrize("keywords", [{}, {"controlled": 2}])
def test_check_env_without_warnings(keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make("DiffIDM-v0", **QUICK, **keywords))


@pytest.mark.parametrize("mode", [None, "SameStep", "Disabled"])
def test_the_ends_are_told_as_sb3_wants_them(mode):
    env = adapter(mode, limit=6)
    loop = [gym.make("DiffIDM-v0", max_episode_steps=6, **QUICK) for _ in range(4)]
    env.seed(7)
    observation = env.reset()
    for i, one in enumerate(loop):
        np.testing.assert_allclose(observation[i], one.reset(seed=7 + i)[0], atol=1e-6)
    for _ in range(14):
        observation, reward, done, infos = env.step(np.zeros((4, 1), np.float32))
        assert observation.dtype == reward.dtype == np.float32
        for i, one in enumerate(loop):
            last, expected, terminated, truncated, _ = one.step(np.zeros(1, np.float32))
            assert reward[i] == pytest.approx(expected, abs=1e-6)
            assert done[i] == (terminated or truncated)
            if done[i]:
                np.testing.assert_allclose(infos[i]["terminal_observation"], last, atol=1e-6)
                assert infos[i]["TimeLimit.truncated"] is True
                last, _ = one.reset()
            np.testing.assert_allclose(observation[i], last, atol=1e-6)


def test_a_crash_is_no_truncation():
    env = adapter(vehicles=3, length=20.0, limit=100, max_command=5.0, count=1)
    env.reset()
    for _ in range(100):
        _, _, done, infos = env.step(np.ones((1, 1), np.float32))
        if done[0]:
            break
    assert done[0]
    assert infos[0]["TimeLimit.truncated"] is False


@pytest.mark.parametrize("keywords", [{"mode": "NextStep"}, {"output": "torch"}])
def test_what_does_not_fit_is_an_error(keywords):
    with pytest.raises(ValueError, match="does not fit SB3"):
        adapter(**keywords)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "choices"),
    [(PPO, {"n_steps": 32, "batch_size": 64}), (A2C, {}), (SAC, {"learning_starts": 50, "batch_size": 32})],
)
def test_algorithms_run(algorithm, choices):
    env = VecMonitor(adapter())
    model = algorithm("MlpPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [16]}, **choices)
    model.learn(300)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=4)
    assert np.isfinite(mean)


@pytest.mark.slow
def test_supersuit_and_sb3_on_the_pettingzoo_face():
    import supersuit

    many = parallel_env(controlled=2, max_cycles=20, **QUICK)
    env = supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(many), 1, num_cpus=0, base_class="stable_baselines3"
    )
    PPO("MlpPolicy", env, n_steps=32, batch_size=32, device="cpu", policy_kwargs={"net_arch": [16]}).learn(128)
