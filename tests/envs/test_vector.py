"""The vector against a loop of single environments, in all three modes of automatic reset."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

import idm_env  # noqa: F401

COUNT = 3
QUICK = {"warmup": 5, "dtype": "float64"}


def vector(mode="NextStep", limit=7, **keywords):
    return gym.make_vec(
        "DiffIDM-v0", num_envs=COUNT, max_episode_steps=limit, autoreset_mode=mode, **{**QUICK, **keywords}
    )


def singles(limit=7, **keywords):
    return [gym.make("DiffIDM-v0", max_episode_steps=limit, **{**QUICK, **keywords}) for _ in range(COUNT)]


def actions(steps, agents=1):
    return np.random.default_rng(0).uniform(-1.2, 1.2, (steps, COUNT, agents))


def close(a, b):
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)


# Controlled vehicles that brake and accelerate at random crash on a short ring, so ends come at different steps.
CASES = [{}, {"warmup_pool": 4}, {"vehicles": 4, "length": [26.0, 30.0], "start": "wave"}, {"controlled": 2}]
CASES += [{"task": "follow", "warmup": 0}, {"task": "platoon", "controlled": 2}, {"task": "replay", "warmup": 0}]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_equals_gymnasiums_loop(mode, case):
    agents = case.get("controlled", 1)
    ours = vector(mode, **case)
    theirs = gym.vector.SyncVectorEnv(
        [lambda: gym.make("DiffIDM-v0", max_episode_steps=7, **{**QUICK, **case})] * COUNT,
        autoreset_mode=AutoresetMode(mode),
    )
    close(ours.reset(seed=11)[0], theirs.reset(seed=11)[0])
    for action in actions(30, agents):
        a, b = ours.step(action), theirs.step(action)
        for mine, other in zip(a[:4], b[:4], strict=True):
            close(mine, other)
            assert mine.dtype == other.dtype
        assert a[4].keys() == b[4].keys()
        if "final_obs" in a[4]:
            assert (a[4]["_final_obs"] == b[4]["_final_obs"]).all()
            for i in np.flatnonzero(a[4]["_final_obs"]):
                close(a[4]["final_obs"][i], b[4]["final_obs"][i])


def test_disabled_resets_by_mask_and_refuses_to_step_what_has_ended():
    ours, loop = vector("Disabled", vehicles=4, length=[26.0, 30.0]), singles(vehicles=4, length=[26.0, 30.0])
    observation, _ = ours.reset(seed=5)
    for i, env in enumerate(loop):
        close(observation[i], env.reset(seed=5 + i)[0])
    for action in actions(20):
        observation, reward, terminated, truncated, _ = ours.step(action)
        for i, env in enumerate(loop):
            single = env.step(action[i])
            close(observation[i], single[0])
            close(reward[i], single[1])
            assert (terminated[i], truncated[i]) == single[2:4]
        mask = terminated | truncated
        if mask.any():
            with pytest.raises(RuntimeError, match="reset_mask"):
                ours.step(action)
            observation, _ = ours.reset(options={"reset_mask": mask})
            for i in np.flatnonzero(mask):
                close(observation[i], loop[i].reset()[0])


def test_a_whole_episode_agrees():
    calm = {"limit": 400, "warmup": 50, "shock": 0.0}
    ours, loop = vector(**calm), singles(**calm)
    ours.reset(seed=1)
    for i, env in enumerate(loop):
        env.reset(seed=1 + i)
    for action in 0.1 * actions(399):
        observation, reward, terminated, *_ = ours.step(action)
        assert not terminated.any()
        for i, env in enumerate(loop):
            single = env.step(action[i])
            close(observation[i], single[0])
            close(reward[i], single[1])


def test_seeds_one_each_and_episodes_that_differ():
    ours = vector()
    first, _ = ours.reset(seed=[4, 4, 9])
    assert (first[0] == first[1]).all()
    assert (first[0] != first[2]).any()
    again, _ = ours.reset()
    assert (again != first).any()
    repeated, _ = ours.reset(seed=[4, 4, 9])
    assert (repeated == first).all()


def test_metadata_and_spec():
    ours = vector("SameStep")
    assert ours.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert ours.spec.kwargs["num_envs"] == COUNT


@pytest.mark.parametrize("limit", [4, 9])
def test_it_truncates_itself(limit):
    ours = vector(limit=limit)
    ours.reset(seed=0)
    ends = [bool(ours.step(np.zeros((COUNT, 1)))[3].all()) for _ in range(limit)]
    assert ends == [False] * (limit - 1) + [True]


@pytest.mark.parametrize(
    ("mask", "words"),
    [(np.zeros(COUNT, bool), "at least one True"), (np.ones(2, bool), "shape"), ([True], "bool array")],
)
def test_bad_masks_are_errors(mask, words):
    ours = vector("Disabled")
    ours.reset(seed=0)
    with pytest.raises(ValueError, match=words):
        ours.reset(options={"reset_mask": mask})


def test_torch_output_has_the_dense_layout():
    ours = vector("SameStep", output="torch")
    ours.reset(seed=0)
    for _ in range(7):
        observation, reward, terminated, truncated, info = ours.step(torch.zeros(COUNT, 1))
    assert all(isinstance(x, torch.Tensor) for x in (observation, reward, terminated, truncated))
    assert info["final_obs"].shape == (COUNT, 3)
    assert info["_final_obs"].all()
    assert info["_final_info"].all()
    final = info["final_info"]
    assert final["command"].shape == (COUNT, 1) and all(
        final[f"_{name}"].all() for name in ("command", "accel", "crash")
    )


def test_a_seed_may_be_an_array_without_a_dimension():
    """It is one number then: refused as of a single environment, where it is of another type."""
    env = gym.make_vec("DiffIDM-v0", num_envs=2, task="follow")
    for seed in np.array(3), torch.tensor(3):
        with pytest.raises(ValueError, match=r"^seed = .* must be a whole number"):
            env.reset(seed=seed)
