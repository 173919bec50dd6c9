"""A window in one call: the same as a loop over steps, in values and gradients, whatever the policy."""

import copy
import gc
import weakref

import pytest
import torch
from torch import nn

import idm_env  # noqa: F401
from idm_env.envs.vector import DiffIDMVectorEnv

pytest.importorskip("numba")

LAYERS = {
    "tanh": lambda width: [nn.Linear(width, 8), nn.Tanh(), nn.Linear(8, 1), nn.Tanh()],
    "all": lambda width: [
        nn.Linear(width, 8), nn.ReLU(), nn.Linear(8, 8), nn.ELU(), nn.LayerNorm(8), nn.SiLU(), nn.Linear(8, 1),
        nn.Tanh(),
    ],
}  # fmt: skip
CASES = [
    ("ring", {"warmup": 20, "max_episode_steps": 12, "failsafe": 3.0}, "all", "float32"),
    ("ring", {"warmup": 5, "effects": ["delay", "memory"], "max_episode_steps": 30}, "tanh", "float64"),
    ("follow", {"max_episode_steps": 25}, "tanh", "float64"),
]


def made(task, keywords, dtype, **more):
    return DiffIDMVectorEnv(5, task=task, dtype=dtype, output="torch", **{**keywords, **more})


def network(layers, env):
    torch.manual_seed(0)
    width = env.single_observation_space.shape[0]
    return nn.Sequential(*LAYERS[layers](width)).to(env.settings.dtype)


def learned(env, policy, act, push):
    """Return two windows that follow one another, and what falls on weights, pushes and a parameter of drivers."""
    env.reset(seed=3)
    base = env.task.simulator.base.name
    scale = torch.ones((), dtype=env.settings.dtype, requires_grad=True)
    env.params = {**env.params, base: {**env.params[base], "time_gap": env.params[base]["time_gap"] * scale}}
    windows = env.unwrapped.unroll(act, 40, push), env.unwrapped.unroll(act, 3)
    loss = sum(w.reward.clamp(-20.0, 20.0).mean() + 0.1 * w.observation.sum() + w.final.mean() for w in windows)
    loss = loss + (windows[0].action ** 2).sum() + env.state.speed.sum()
    sources = [*policy.parameters(), push, scale]
    return windows, torch.autograd.grad(loss, sources)


@pytest.mark.parametrize(("task", "keywords", "layers", "dtype"), CASES)
def test_a_compiled_policy_is_one_between_steps(task, keywords, layers, dtype):
    results, close = [], 2e-6 if dtype == "float32" else 1e-9
    for compiled in (True, False):
        env = made(task, keywords, dtype)
        policy = network(layers, env)
        push = torch.full((5, 1), 0.01, dtype=env.settings.dtype, requires_grad=True)
        windows, found = learned(env, policy, policy if compiled else lambda seen, policy=policy: policy(seen), push)
        name = type(windows[0].reward.grad_fn).__name__
        assert ("Window" in name) == compiled, f"the other way ran: {name}"
        assert bool((windows[0].truncated | windows[0].terminated).any())
        results.append((windows, found, env.batch.episodes.tolist()))
    (ours, mine, episodes), (theirs, wanted, others) = results
    assert episodes == others
    for one, other in zip(ours, theirs, strict=True):
        for x, y in zip(one, other, strict=True):
            torch.testing.assert_close(x, y, rtol=10 * close, atol=10 * close)
    for x, y in zip(mine, wanted, strict=True):
        torch.testing.assert_close(x, y, rtol=0.0, atol=close * float(y.abs().max() + 1e-3))


def test_a_window_is_a_loop_over_steps_to_the_last_bit():
    def act(seen):
        return torch.sin(seen[:, :1]) * 0.3

    window, loop = (made("ring", CASES[0][1], "float32") for _ in range(2))
    window.reset(seed=3)
    seen, _ = loop.reset(seed=3)
    made_at_once = window.unroll(act, 30)
    for t in range(30):
        assert torch.equal(seen, made_at_once.observation[t])
        seen, *told, _ = loop.step(act(seen))
        assert all(torch.equal(x, y[t]) for x, y in zip(told, made_at_once[2:5], strict=True))
    assert torch.equal(seen, made_at_once.observation[30])
    assert torch.equal(window.step(act(seen))[1], loop.step(act(seen))[1])


class Blind(nn.Module):
    def forward(self, seen):
        return seen[:, :1] * torch.nan


@pytest.mark.parametrize(
    ("policy", "steps", "says"),
    [
        (nn.Linear(3, 1), 0, "steps = 0 must be at least 1"),
        (nn.Linear(4, 1), 5, "policy does not take observations of shape"),
        (nn.Linear(3, 2), 5, "policy gives"),
        (Blind(), 20, "policy returned NaN"),
    ],
)
def test_bad_input_is_told_in_one_line_and_changes_nothing(policy, steps, says):
    env = made("ring", CASES[0][1], "float32")
    env.reset(seed=3)
    env.step(torch.zeros(5, 1))
    other = copy.deepcopy(env)
    with pytest.raises(ValueError, match=says) as error:
        env.unroll(policy, steps)
    assert "\n" not in str(error.value)
    for _ in range(15):
        assert torch.equal(env.step(torch.zeros(5, 1))[0], other.step(torch.zeros(5, 1))[0])


def test_numpy_output_and_other_resets_are_refused():
    for keywords, says in (({"output": "numpy"}, "output = 'numpy'"), ({"autoreset_mode": "Disabled"}, "SameStep")):
        env = made("ring", CASES[0][1], "float32", **keywords) if "output" not in keywords else DiffIDMVectorEnv(2)
        with pytest.raises(RuntimeError, match="before reset"):
            env.unroll(nn.Linear(3, 1), 2)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=says):
            env.unroll(nn.Linear(3, 1), 2)


def test_the_tape_goes_with_the_graph():
    env = made("ring", CASES[0][1], "float32")
    env.reset(seed=3)
    window = env.unroll(network("tanh", env), 4)
    tape = weakref.ref(window.reward.grad_fn)
    env.detach()
    del window
    gc.collect()
    assert tape() is None
