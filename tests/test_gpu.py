"""On a GPU everything is as on the CPU: steps, gradients, rollouts, environments. Skipped where there is none."""

from functools import partial

import gymnasium
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.envs.cuda_graph import Replayed
from tests.laws.members import DTYPE, MEMBERS, N, around, inputs_for, label, start

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here: its tests have not run")

STEPS = 20


def moved(value, device):
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {k: moved(v, device) for k, v in value.items()}
    if isinstance(value, tuple):
        return type(value)(*(moved(v, device) for v in value))
    return value


def outcome(effect, device):
    """Return the trajectory's tensors and the gradients by every parameter of the effect, on the CPU."""
    simulator = around(effect)
    params = moved(simulator.defaults(dtype=DTYPE), device)
    leaves = {name: x.clone().requires_grad_() for name, x in params[effect.name].items()}
    params = {**params, effect.name: leaves}
    state = moved(start(simulator, moved(params, "cpu")), device)
    inputs = moved(inputs_for(simulator, STEPS, torch.zeros(N, dtype=DTYPE)), device)
    _, kept = simulator.rollout(state, inputs, params, STEPS)
    loss = sum((0.01 * x).sin().sum() for x in kept)
    if leaves and loss.requires_grad:  # torch has no graph where nothing depends on a leaf; a kernel says 0 there
        loss.backward()
    slopes = [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves.values()]
    return [x.detach().cpu() for x in kept], slopes


def test_every_effect_is_the_same_on_a_gpu():
    for effect in MEMBERS:
        here, there = outcome(effect, "cpu"), outcome(effect, "cuda")
        said = partial("{}: {}".format, label(effect))
        for mine, other in zip(here[0], there[0], strict=True):
            torch.testing.assert_close(other, mine, rtol=1e-10, atol=1e-9, msg=said)
        for mine, other in zip(here[1], there[1], strict=True):
            torch.testing.assert_close(other.cpu(), mine, rtol=1e-8, atol=1e-9, msg=said)


@pytest.mark.parametrize("task", ["ring", "follow", "platoon", "highway", "merge", "approach"])
def test_environments_give_on_a_gpu_what_they_give_on_the_cpu(task):
    seen = {}
    for device in ("cpu", "cuda"):
        seen[device] = driven(made(task, device), device)
    for mine, other in zip(seen["cpu"], seen["cuda"], strict=True):
        torch.testing.assert_close(other, mine, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("task", ["ring", "merge"])
def test_a_step_is_one_cuda_graph(task, recwarn):
    """With and without gradients; the steps that torch does one by one give the same bits."""
    seen = []
    for replayed in (True, False):
        env = made(task, "cuda")
        assert isinstance(env.batch._step, Replayed)
        if not replayed:
            env.batch._step = env.batch._stepped
        with torch.no_grad():
            before = [env.step(torch.zeros(env.action_space.shape, device="cuda"))[0] for _ in range(3)]
        seen.append([*before, *driven(env, "cuda")])
        assert not replayed or len(env.batch._step._forms) >= 2  # None where it could not be recorded
    for mine, other in zip(*seen, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-12, atol=1e-12)
    assert not [w for w in recwarn if "CUDA graph" in str(w.message)]


def made(task, device):
    """Return eight environments."""
    short = {"warmup": 50} if task == "ring" else {}
    env = gymnasium.make_vec(
        "DiffIDM-v0", num_envs=8, task=task, output="torch", device=device, dtype="float64", **short
    )
    env.reset(seed=3)
    return env.unwrapped


def driven(env, device):
    """Return the last observation and reward of ten steps, and the gradient by the action, on the CPU."""
    action = torch.full(env.action_space.shape, 0.3, dtype=torch.float64, device=device, requires_grad=True)
    total = torch.zeros((), dtype=torch.float64, device=device)
    for _ in range(10):
        observation, reward, *_ = env.step(action)
        total = total + reward.sum()
    total.backward()
    assert observation.device.type == device
    return observation.detach().cpu(), reward.detach().cpu(), action.grad.cpu()
