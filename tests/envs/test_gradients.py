"""What the graph carries, where it is cut, and what it costs nothing to leave out."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from packaging.version import Version

import idm_env  # noqa: F401
from idm_env.wrappers import (
    VectorNormalizeObservation,
    VectorRecordEpisodeStatistics,
)

SMALL = {"vehicles": 5, "length": [60.0, 70.0], "warmup": 10, "output": "torch", "dtype": "float64"}


def single(**keywords):
    return gym.make("DiffIDM-v0", **{**SMALL, **keywords})


def vector(mode="SameStep", limit=5, **keywords):
    return gym.make_vec("DiffIDM-v0", num_envs=3, autoreset_mode=mode, max_episode_steps=limit, **{**SMALL, **keywords})


@pytest.mark.parametrize("keywords", [{}, {"controlled": 2, "reward": "flow"}, {"start": "wave"}])
def test_gradcheck_of_the_return_by_actions(keywords):
    def total(actions):
        env = single(**keywords)
        env.reset(seed=0)
        return sum(env.step(action)[1] for action in actions)

    agents = keywords.get("controlled", 1)
    actions = torch.linspace(-0.9, 0.8, 6 * agents, dtype=torch.float64).view(6, agents).requires_grad_()
    assert torch.autograd.gradcheck(total, (actions,))


def test_gradcheck_of_the_return_by_parameters():
    names = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")

    def total(*values):
        env = single(start="wave", warmup=30)
        env.reset(seed=0)
        params = env.unwrapped.params
        env.unwrapped.params = {**params, "idm": {**params["idm"], **dict(zip(names, values, strict=True))}}
        return sum(env.step(torch.zeros(1))[1] for _ in range(12))

    values = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (1.0, 1.5, 1.0, 2.0, 30.0)]
    assert torch.autograd.gradcheck(total, values)
    grads = torch.autograd.grad(total(*values), values)
    assert all(float(g) != 0.0 for g in grads)


def test_a_parameter_given_by_keyword_carries_its_graph():
    time_gap = torch.tensor(1.2, dtype=torch.float64, requires_grad=True)
    env = single(start="wave", parameters={"idm": {"time_gap": time_gap}})
    env.reset(seed=0)
    for _ in range(5):
        _, reward, *_ = env.step(torch.zeros(1))
    reward.backward()
    assert float(time_gap.grad) != 0.0


def test_gradient_by_the_initial_state():
    env = single()
    env.reset(seed=0)
    state = env.unwrapped.state
    speed = state.speed.clone().requires_grad_()
    observation, _ = env.reset(options={"state": state._replace(speed=speed)})
    assert observation.requires_grad
    _, reward, *_ = env.step(torch.zeros(1))
    assert bool((torch.autograd.grad(reward, speed)[0] != 0).all())


def test_no_graph_where_nothing_requires_grad_and_the_same_bits_with_one():
    def run(requires_grad):
        env = single(warmup=50)
        env.reset(seed=3)
        seen = []
        for i in range(30):
            action = torch.full((1,), 0.1 * (i % 5), requires_grad=requires_grad)
            observation, reward, *_ = env.step(action)
            assert observation.requires_grad == reward.requires_grad == requires_grad
            seen.append(torch.cat((observation, reward.view(1))).detach())
        return torch.stack(seen)

    assert torch.equal(run(False), run(True))


def test_clipped_actions_have_no_gradient():
    env = single(controlled=2)
    env.reset(seed=0)
    action = torch.tensor([1.5, 0.5], requires_grad=True)
    env.step(action)[1].backward()
    assert float(action.grad[0]) == 0.0
    assert float(action.grad[1]) != 0.0


def test_detach_cuts():
    env = single()
    env.reset(seed=0)
    action = torch.zeros(1, requires_grad=True)
    env.step(action)
    env.unwrapped.detach()
    assert not env.unwrapped.state.speed.requires_grad
    assert not env.step(torch.zeros(1))[1].requires_grad


def test_same_step_cuts_the_new_observation_and_keeps_the_last_one():
    env = vector()
    env.reset(seed=0)
    actions = torch.zeros(3, 1, requires_grad=True)
    for _ in range(5):
        observation, _, _, truncated, info = env.step(actions)
    assert bool(truncated.all())
    assert not observation.requires_grad
    assert info["final_obs"].requires_grad
    assert bool((torch.autograd.grad(info["final_obs"].sum(), actions)[0] != 0).all())
    assert not env.step(torch.zeros(3, 1))[1].requires_grad


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_no_gradient_leaks_across_episodes_or_environments(mode):
    env = vector(mode, limit=50)
    env.reset(seed=0)
    old = torch.zeros(3, 1, requires_grad=True)
    env.step(old)
    # The middle environment ends by a crash: its gap is made to vanish.
    batch = env.unwrapped.batch
    state = batch.world.state
    gap = state.gap.clone()
    gap[1, 0] = -1.0
    batch.world = batch.world._replace(state=state._replace(gap=gap))
    _, _, terminated, _, _ = env.step(torch.zeros(3, 1))
    assert terminated.tolist() == [False, True, False]
    if mode == "Disabled":
        env.reset(options={"reset_mask": terminated.numpy()})
    if mode == "NextStep":
        _, reward, *_ = env.step(torch.zeros(3, 1))
        assert float(reward[1].detach()) == 0.0
    observation, reward, *_ = env.step(torch.zeros(3, 1))
    for i in range(3):
        grad = torch.autograd.grad(observation[i].sum() + reward[i], old, retain_graph=True)[0].flatten()
        expected = [j == i and i != 1 for j in range(3)]
        assert [bool(g != 0) for g in grad] == expected


def test_vector_wrappers_keep_the_graph_and_count_as_gymnasium_does():
    # Of vectors that reset within the step Gymnasium counts the first reward of an episode from 1.4 on.
    modes = ("SameStep", "NextStep") if Version(gym.__version__) >= Version("1.4") else ("NextStep",)
    for mode in modes:
        ours = VectorRecordEpisodeStatistics(vector(mode))
        theirs = gym.wrappers.vector.RecordEpisodeStatistics(vector(mode, output="numpy"))
        ours.reset(seed=0)
        theirs.reset(seed=0)
        for _ in range(13):
            actions = torch.zeros(3, 1, requires_grad=True)
            _, reward, _, _, info = ours.step(actions)
            other = theirs.step(np.zeros((3, 1), np.float32))[4]
            assert ("episode" in info) == ("episode" in other)
            assert mode == "NextStep" or reward.requires_grad
            if "episode" in info:
                np.testing.assert_allclose(info["episode"]["r"], other["episode"]["r"], atol=1e-10)
                np.testing.assert_array_equal(info["episode"]["l"], other["episode"]["l"])


def test_normalised_observations_have_unit_variance_and_a_graph():
    env = VectorNormalizeObservation(vector(limit=100, start="wave"))
    seen = [env.reset(seed=0)[0]]
    for _ in range(80):
        observation, *_ = env.step(torch.full((3, 1), 0.1, requires_grad=True))
        assert observation.requires_grad
        seen.append(observation.detach())
    late = env.moments
    assert bool((late.var > 0).all())
    env.update_running_mean = False
    before = late.mean.clone()
    env.step(torch.zeros(3, 1))
    assert torch.equal(before, env.moments.mean)
