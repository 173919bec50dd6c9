"""What actions command: limits that may differ for braking and accelerating, their inverse, and their gradient."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import TASKS, make_task

REAL = [-4.5, 2.6]


@pytest.mark.parametrize("task", TASKS)
def test_braking_and_accelerating_have_limits_of_their_own(task):
    made = make_task(task, max_command=REAL)
    action = torch.tensor([[-3.0], [-1.0], [-0.5], [0.0], [0.5], [1.0], [2.0]], dtype=torch.float64)
    expected = torch.tensor([[-4.5], [-4.5], [-2.25], [0.0], [1.3], [2.6], [2.6]], dtype=torch.float64)
    torch.testing.assert_close(made.command(action), expected, rtol=0.0, atol=1e-15)
    torch.testing.assert_close(made.action(expected), action.clamp(-1.0, 1.0))
    torch.testing.assert_close(made.action(10.0 * expected), torch.sign(action))


def test_one_number_is_both_limits():
    action = torch.linspace(-1.5, 1.5, 31).unsqueeze(-1)
    assert torch.equal(make_task("ring", max_command=3.0).command(action), action.clamp(-1.0, 1.0) * 3.0)
    torch.testing.assert_close(make_task("ring", max_command=[-3.0, 3.0]).command(action), action.clamp(-1.0, 1.0) * 3)


def test_the_gradient_of_a_command_is_the_limit_of_its_side():
    action = torch.tensor([[-2.0], [-0.3], [0.3], [2.0]], requires_grad=True)
    make_task("ring", max_command=REAL).command(action).sum().backward()
    torch.testing.assert_close(action.grad, torch.tensor([[0.0], [4.5], [2.6], [0.0]]))


def test_every_face_commands_within_them():
    chosen = {"task": "ring", "warmup": 300, "noise": 0.0, "max_command": REAL, "length": 260.0}
    for action, accel in ((-1.0, -4.5), (-0.5, -2.25), (0.5, 1.3), (1.0, 2.6)):
        single, many, zoo = (
            gym.make("DiffIDM-v0", **chosen),
            gym.make_vec("DiffIDM-v0", 2, **chosen),
            parallel_env(**chosen),
        )
        for env in (single, many, zoo):
            env.reset(seed=0)
        told = [
            single.step(np.full(1, action))[4],
            many.step(np.full((2, 1), action))[4],
            zoo.step({agent: np.full(1, action, np.float32) for agent in zoo.agents})[4][zoo.possible_agents[0]],
        ]
        for info in told:
            for name in ("command", "accel"):
                assert np.allclose(info[name], accel)


@pytest.mark.parametrize(
    "wrong", [0.0, -3.0, [1.0], [-1.0, 2.0, 3.0], [2.6, -4.5], [0.0, 2.0], [-2.0, 0.0], [-4.5, float("nan")], "3"]
)
def test_limits_that_cannot_be_are_told(wrong):
    with pytest.raises(ValueError, match="max_command = ") as told:
        make_task("ring", max_command=wrong)
    assert "\n" not in str(told.value)
