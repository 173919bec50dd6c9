"""A window in one call: the same as a loop over steps, in values and gradients, whatever the policy."""

import copy
import gc
import os
import pickle
import re
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import idm_env  # noqa: F401
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.envs.window import driver_of

pytest.importorskip("numba")

LAYERS = {
    "tanh": lambda width: [nn.Linear(width, 8), nn.Tanh(), nn.Linear(8, 1), nn.Tanh()],
    "all": lambda width: [
        nn.Linear(width, 8), nn.ReLU(), nn.Linear(8, 8), nn.ELU(), nn.LayerNorm(8), nn.SiLU(), nn.Linear(8, 1),
        nn.Tanh(),
    ],
}  # fmt: skip


class Recurrent(nn.Module):
    """A policy that each agent has, with a memory of its own."""

    def __init__(self, width, agents):
        super().__init__()
        self.scale, self.norm = nn.Parameter(torch.full((width // agents,), 0.5)), nn.LayerNorm(4)
        self.cell, self.out = nn.GRUCell(width // agents, 4), nn.Linear(4, 1)

    def forward(self, seen, hidden):
        own = seen.unflatten(-1, (hidden.shape[1], -1)) * self.scale
        hidden = self.cell(own.flatten(0, 1), hidden.flatten(0, 1)).view_as(hidden)
        return torch.tanh(self.out(self.norm(hidden))).squeeze(-1), hidden


CASES = [
    ("ring", {"warmup": 20, "max_episode_steps": 12, "failsafe": 3.0}, "all", "float32"),
    ("ring", {"warmup": 5, "effects": ["delay", "memory"], "hold": 0.2, "max_episode_steps": 30}, "tanh", "float64"),
    ("merge", {"vehicles": 24, "controlled": 1, "hold": 0.3, "max_episode_steps": 9}, "tanh", "float64"),
    ("follow", {"max_episode_steps": 25}, "tanh", "float64"),
]
REMEMBERING = [
    ("ring", {"warmup": 20, "max_episode_steps": 12, "failsafe": 3.0}, "recurrent", "float32"),
    ("platoon", {"max_episode_steps": 25, "controlled": 2}, "recurrent", "float64"),
    ("ring", {"warmup": 5, "max_episode_steps": 15, "controlled": [3, 7, 9]}, "recurrent", "float64"),
]


def made(task, keywords, dtype, **more):
    return DiffIDMVectorEnv(5, task=task, dtype=dtype, output="torch", **{**keywords, **more})


def network(layers, env):
    torch.manual_seed(0)
    width = env.single_observation_space.shape[0]
    if layers == "recurrent":
        return Recurrent(width, len(env.task.agents)).to(env.settings.dtype)
    return nn.Sequential(*LAYERS[layers](width)).to(env.settings.dtype)


def learned(env, policy, act, push):
    """Return two windows that follow one another, and what falls on weights, pushes and a parameter of drivers.

    What a policy remembers at the beginning is a source, too, and what it remembers at the end counts.
    """
    env.reset(seed=3)
    hidden = None
    if isinstance(policy, Recurrent):
        hidden = torch.full((5, len(env.task.agents), 4), 0.1, dtype=env.settings.dtype, requires_grad=True)
    base = env.task.simulator.base.name
    scale = torch.ones((), dtype=env.settings.dtype, requires_grad=True)
    env.params = {**env.params, base: {**env.params[base], "time_gap": env.params[base]["time_gap"] * scale}}
    first = env.unwrapped.unroll(act, 40, push, hidden)
    windows = first, env.unwrapped.unroll(act, 3, hidden=first.hidden)
    loss = sum(w.reward.clamp(-20.0, 20.0).mean() + 0.1 * w.observation.sum() + w.final.mean() for w in windows)
    loss = loss + (windows[0].action ** 2).sum() + env.state.speed.sum()
    sources = [*policy.parameters(), push, scale]
    if hidden is not None:
        loss, sources = loss + (windows[1].hidden ** 2).sum(), [*sources, hidden]
    return windows, torch.autograd.grad(loss, sources)


@pytest.mark.parametrize(("task", "keywords", "layers", "dtype"), [*CASES, *REMEMBERING])
def test_a_compiled_policy_is_one_between_steps(task, keywords, layers, dtype):
    results, close = [], 2e-6 if dtype == "float32" else 1e-9
    for compiled in (True, False):
        env = made(task, keywords, dtype)
        policy = network(layers, env)
        push = torch.full((5, len(env.task.agents)), 0.01, dtype=env.settings.dtype, requires_grad=True)
        windows, found = learned(env, policy, policy if compiled else lambda *seen, policy=policy: policy(*seen), push)
        name = type(windows[0].reward.grad_fn).__name__
        assert ("Window" in name) == compiled, f"the other way ran: {name}"
        assert bool((windows[0].truncated | windows[0].terminated).any())
        results.append((windows, found, env.batch.episodes.tolist()))
    (ours, mine, episodes), (theirs, wanted, others) = results
    assert episodes == others
    for one, other in zip(ours, theirs, strict=True):
        assert (one.hidden is None) == (layers != "recurrent")
        for x, y in zip(one, other, strict=True):
            assert x is y is None or torch.allclose(x, y, rtol=10 * close, atol=10 * close)
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


@pytest.mark.parametrize(("task", "keywords", "layers", "dtype"), CASES)
def test_a_compiled_window_with_a_fixed_policy_is_the_loop_to_the_last_bit(task, keywords, layers, dtype):
    """Resets, failsafe, memories and the past included; a policy that rounds as torch does says the same in both."""
    window, loop = (made(task, keywords, dtype) for _ in range(2))
    policy = nn.Linear(window.single_observation_space.shape[0], 1).to(window.settings.dtype)
    nn.init.zeros_(policy.weight)
    nn.init.constant_(policy.bias, 0.3)
    window.reset(seed=3)
    seen, _ = loop.reset(seed=3)
    told = window.unroll(policy, 40)
    assert "Window" in type(told.reward.grad_fn).__name__ and bool(told.truncated.any())
    for t in range(40):
        assert torch.equal(seen, told.observation[t])
        seen, *rest, _ = loop.step(policy(seen))
        assert all(torch.equal(x, y[t]) for x, y in zip(rest, told[2:5], strict=True))
    assert torch.equal(seen, told.observation[40])


class Counting(nn.Module):
    """A policy that remembers how many steps its episode has gone on."""

    def forward(self, seen, hidden):
        hidden = hidden + 0.0625
        return hidden - 0.25, hidden


def test_a_large_window_has_the_same_bits_on_any_number_of_threads():
    """Values, and gradients of weights, which are sums over rows."""
    env = DiffIDMVectorEnv(480, task="ring", warmup=0, output="torch", failsafe=3.0)
    policy, threads, results = network("all", env), torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            env.reset(seed=1)
            out = env.unroll(policy, 5)
            gradients = torch.autograd.grad(out.reward.sum(), list(policy.parameters()))
            results.append([out.observation.detach(), *gradients])
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


def test_what_a_policy_remembers_begins_anew_with_an_episode():
    """As in a loop of one's own, to the last bit; the next window is given what this one remembers."""
    window, loop = (made(*CASES[0][:2], "float32") for _ in range(2))
    policy, hidden = Counting(), torch.zeros(5, 1)
    first, _ = window.reset(seed=3)
    seen, _ = loop.reset(seed=3)
    told = window.unroll(policy, 17, hidden=hidden)
    later = window.unroll(policy, 20, hidden=told.hidden)
    ended = torch.cat([told.truncated | told.terminated, later.truncated | later.terminated])
    assert bool(ended[:17].any()) and bool((told.hidden > 0.0).any()) and torch.equal(told.observation[0], first)
    for t, action in enumerate(torch.cat([told.action, later.action])):
        mine, hidden = policy(seen, hidden)
        assert torch.equal(mine, action)
        seen, _, terminated, truncated, _ = loop.step(mine)
        assert torch.equal(terminated | truncated, ended[t])
        hidden = hidden * ~(terminated | truncated).unsqueeze(-1)
    assert torch.equal(seen, later.observation[-1]) and torch.equal(hidden, later.hidden)


class ForFive(nn.Linear):
    """A policy with an offset for each of five environments."""

    def forward(self, seen):
        return super().forward(seen) + 0.01 * torch.arange(5.0).unsqueeze(-1)


def test_a_policy_of_so_many_environments_runs_between_steps():
    env, loop = (made("ring", CASES[0][1], "float32") for _ in range(2))
    policy = ForFive(env.single_observation_space.shape[0], 1)
    env.reset(seed=3)
    seen, _ = loop.reset(seed=3)
    told = env.unroll(policy, 15)
    for t in range(15):
        assert torch.equal(seen, told.observation[t])
        seen = loop.step(policy(seen))[0]


@pytest.mark.parametrize(
    "between",
    [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), lambda env: env],
    ids=["copied", "pickled", "detached"],
)
def test_a_copy_goes_on_without_the_graph_and_leaves_it(between):
    """In the middle of training: between two windows of which the first is not yet differentiated."""
    env, plain = (made("ring", CASES[0][1], "float32") for _ in range(2))
    policy = network("tanh", env)
    for each in (env, plain):
        each.reset(seed=3)
    first, wanted = env.unroll(policy, 15), plain.unroll(policy, 15)
    other = between(env)
    other.detach()
    second, following = other.unroll(policy, 15), plain.unroll(policy, 15)
    assert torch.equal(second.observation, following.observation)
    found, one = (torch.autograd.grad(w.reward.sum(), policy.parameters()) for w in (first, wanted))
    assert all(torch.equal(x, y) for x, y in zip(found, one, strict=True))
    (cut,) = torch.autograd.grad(second.reward.sum(), first.action, allow_unused=True)
    assert cut is None


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="Linux tells the memory of a process")
def test_memory_does_not_grow_with_windows():
    env = made("ring", {"warmup": 5, "max_episode_steps": 100}, "float32")
    policy = network("tanh", env)
    env.reset(seed=3)

    def resident(windows):
        for i in range(windows):
            env.detach()
            env.unroll(policy, 40).reward.mean().backward()
            if i % 50 == 49:  # tests collect seldom, and what lies about takes room
                gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    gc.collect()
    gc.freeze()  # of other tests, which collecting would go through each time
    before = resident(100)
    # A window's tape is some 100 kB: a tenth of those kept would be 10 MB; the allocator alone takes up to 1.3 MB.
    after = resident(1000)
    gc.unfreeze()
    assert after - before < 4 << 20


class Blind(nn.Module):
    def forward(self, seen):
        return seen[:, :1] * torch.nan


class Forgetful(nn.Linear):
    def forward(self, seen, hidden):
        return super().forward(seen)


@pytest.mark.parametrize(
    ("policy", "more", "says"),
    [
        (nn.Linear(3, 1), {"steps": 0}, "steps = 0 must be at least 1"),
        (nn.Linear(4, 1), {}, "policy does not take observations of shape"),
        (nn.Linear(3, 2), {}, "policy gives"),
        (Blind(), {"steps": 20}, "policy returned NaN"),
        (nn.Linear(3, 1), {"hidden": torch.zeros(5, 2)}, "policy does not take observations .* and hidden of shape"),
        (Forgetful(3, 1), {"hidden": torch.zeros(5, 2)}, r"policy gives .* \(actions, hidden of shape \(n, 2\)\)"),
        (Recurrent(3, 1), {"hidden": torch.zeros(4, 1, 4)}, "Give one row for each of 5"),
        (Recurrent(3, 1), {"hidden": torch.zeros(5, 1, 4).double()}, "in torch.float32"),
    ],
)
def test_bad_input_is_told_in_one_line_and_changes_nothing(policy, more, says):
    env = made("ring", CASES[0][1], "float32")
    env.reset(seed=3)
    env.step(torch.zeros(5, 1))
    other = copy.deepcopy(env)
    with pytest.raises(ValueError, match=says) as error:
        env.unroll(policy, **{"steps": 5, **more})
    assert "\n" not in str(error.value)
    for _ in range(15):
        assert torch.equal(env.step(torch.zeros(5, 1))[0], other.step(torch.zeros(5, 1))[0])


def _writing(seen):
    seen[:, 0] = 0.5
    return ACT(seen)


def _writing_hidden(seen, hidden):
    return ACT(seen), hidden.add_(1.0)


ACT, REMEMBERED = nn.Linear(3, 1), {"hidden": torch.zeros(5, 4)}
BETWEEN = {
    "hidden of another width": (lambda x, h: (ACT(x), h[:, :2]), REMEMBERED, r"hidden of shape \(n, 4\)"),
    "hidden None": (lambda x, h: (ACT(x), None), REMEMBERED, "NoneType"),
    "hidden numpy": (lambda x, h: (ACT(x), h.numpy()), REMEMBERED, "ndarray"),
    "hidden tuple": (lambda x, h: (ACT(x), (h, h)), REMEMBERED, "tuple"),
    "hidden in doubles": (lambda x, h: (ACT(x), h.double()), REMEMBERED, "in torch.float32"),
    "hidden nan": (lambda x, h: (ACT(x), h * torch.nan), REMEMBERED, "NaN or infinite hidden"),
    "no hidden": (lambda x, h: ACT(x), REMEMBERED, "policy gives"),
    "a list": (lambda x, h: [ACT(x), h], REMEMBERED, "policy gives list"),
    "three": (lambda x, h: (ACT(x), h, h), REMEMBERED, "policy gives"),
    "first hidden numpy": (lambda x, h: (ACT(x), h), {"hidden": np.zeros((5, 4))}, "hidden is of type ndarray"),
    "first hidden tuple": (lambda x, h: (ACT(x), h), {"hidden": (torch.zeros(5, 4),)}, "hidden is of type tuple"),
    "first hidden a number": (lambda x, h: (ACT(x), h), {"hidden": 0.0}, "hidden is of type float"),
    "nothing": (lambda x: None, {}, "policy gives NoneType"),
    "numpy": (lambda x: ACT(x).detach().numpy(), {}, "policy gives ndarray"),
    "a number": (lambda x: 0.5, {}, "policy gives float"),
    "one row": (lambda x: ACT(x)[:1], {}, "1 rows"),
    "a tuple": (lambda x: (ACT(x), ACT(x)), {}, "policy gives"),
    "bool": (lambda x: ACT(x) > 0.0, {}, "torch.bool"),
    "complex": (lambda x: ACT(x) + 0j, {}, "torch.complex64"),
    "nan": (lambda x: ACT(x) * torch.nan, {}, "NaN or infinite actions"),
    "weights in doubles": (nn.Linear(3, 1).double(), {}, r"does not take .*float32.*Double"),
    "doubles in a function": (lambda x: ACT.double()(x), {}, r"does not take .*float32.*Double"),
    "no policy": (None, {}, "not callable"),
    "writes": (_writing, {}, "writes to the observations"),
    "writes hidden": (_writing_hidden, {"hidden": torch.zeros(5, 4)}, "writes to the observations or hidden"),
    "push of other rows": (lambda x: ACT(x), {"push": torch.zeros(4, 1)}, r"push is .*\(4, 1\)"),
    "push of other actions": (lambda x: ACT(x), {"push": torch.zeros(5, 3)}, r"push is .*\(5, 3\)"),
    "push of every step": (lambda x: ACT(x), {"push": torch.zeros(5, 5, 1)}, r"push is .*\(5, 5, 1\)"),
    "push numpy": (lambda x: ACT(x), {"push": np.zeros((5, 1))}, "push is of type ndarray"),
    "push nan": (nn.Linear(3, 1), {"push": torch.full((5, 1), torch.nan)}, "push is .* NaN"),
}  # fmt: skip


def test_what_a_policy_between_steps_must_not_do_is_told_in_one_line_and_changes_nothing():
    env = made("ring", CASES[0][1], "float32")
    env.reset(seed=3)
    before, wrong = env.step(torch.zeros(5, 1))[0], {}
    for name, (policy, more, says) in BETWEEN.items():
        try:
            env.unroll(policy, 5, **more)
            wrong[name] = "returned"
        except ValueError as error:
            if not re.search(says, str(error)) or "\n" in str(error):
                wrong[name] = error
        ACT.float()
        if not torch.equal(env.batch.seen(), before):
            wrong[name] = "it has stepped"
    assert wrong == {}


@pytest.mark.parametrize(
    "around", [lambda act: act, lambda act: lambda x: act(x), lambda act: lambda x: act(x).double()]
)
@pytest.mark.parametrize("bias", [0.0, -1.1], ids=["within", "beyond"])
def test_doubles_are_the_numbers_that_they_are(around, bias):
    """Loops in single precision read eight bytes as two numbers; an action is clipped with its push, not before."""
    torch.manual_seed(0)
    act = nn.Linear(3, 1)
    nn.init.constant_(act.bias, bias)
    env, other = (made("ring", CASES[0][1], "float32") for _ in range(2))
    env.reset(seed=3), other.reset(seed=3)
    window = env.unroll(around(act), 3, push=torch.full((5, 1), 0.25, dtype=torch.float64))
    wanted = other.unroll(act, 3, push=torch.full((5, 1), 0.25))
    assert window.action.dtype == torch.float32
    torch.testing.assert_close(window.reward, wanted.reward)


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


class Tuned(nn.Module):
    """A policy that depends on more than its weights: a number, a flag, a tensor that is no buffer, a global."""

    def __init__(self):
        super().__init__()
        self.layer, self.norm, self.bend = nn.Linear(3, 1), nn.LayerNorm(3), nn.Tanh()
        self.gain, self.mean, self.cut = 0.5, torch.zeros(3), False

    def forward(self, seen):
        seen = self.norm(seen - self.mean)
        return self.bend(self.layer(seen.detach() if self.cut else seen)) * self.gain + GLOBAL["offset"]


GLOBAL = {"offset": 0.0}


def _hooked(policy):
    policy.layer.register_forward_hook(lambda module, given, out: out * 0.5)


def _bent(policy):
    policy.bend = nn.Sigmoid()


def _replaced(policy):
    policy.forward = lambda seen: seen[:, :1] * policy.layer.weight[0, 0]


CHANGES = {
    "number": lambda p: setattr(p, "gain", -0.7),
    "tensor": lambda p: setattr(p, "mean", torch.ones(3)),
    "tensor in place": lambda p: p.mean.add_(1.0),
    "flag of the gradient": lambda p: setattr(p, "cut", True),
    "eps": lambda p: setattr(p.norm, "eps", 1.0),
    "global": lambda p: GLOBAL.update(offset=0.3),
    "activation": _bent,
    "hook": _hooked,
    "forward": _replaced,
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_window_drives_the_policy_as_it_is_now(change):
    env, plain = (made("ring", {"warmup": 5, "max_episode_steps": 100}, "float64") for _ in range(2))
    torch.manual_seed(0)
    policy = Tuned().double()
    policy.mean = policy.mean.double()
    GLOBAL["offset"] = 0.0
    for again in range(2):
        for each in (env, plain):
            each.reset(seed=3)
        first, wanted = env.unroll(policy, 4), plain.unroll(lambda x: policy(x), 4)
        if again == 0:
            CHANGES[change](policy)
    torch.testing.assert_close(first.action, wanted.action)
    found, own = (
        torch.autograd.grad(w.reward.sum(), policy.parameters(), allow_unused=True, materialize_grads=True)
        for w in (first, wanted)
    )
    for x, y in zip(found, own, strict=True):
        torch.testing.assert_close(x, y)
    GLOBAL["offset"] = 0.0


class Restless(nn.Linear):
    """A policy that is another one at every call."""

    calls = 0

    def forward(self, seen):
        self.calls += 1
        return super().forward(seen) * (1.0 / self.calls)


def test_a_policy_that_changes_by_being_called_runs_between_steps():
    env = made("ring", CASES[0][1], "float32")
    env.reset(seed=3)
    policy = Restless(3, 1)
    env.unroll(policy, 3)
    before = policy.calls
    window = env.unroll(policy, 3)
    assert policy.calls == before + 3
    wanted = nn.Linear.forward(policy, window.observation[1]) / (before + 2)
    torch.testing.assert_close(window.action[1], wanted)


def test_a_tensor_with_a_gradient_that_is_no_parameter_has_it():
    env = made("ring", CASES[0][1], "float32")
    env.reset(seed=3)
    policy = Tuned()
    policy.gain = torch.tensor(0.5, requires_grad=True)
    (gradient,) = torch.autograd.grad(env.unroll(policy, 5).action.sum(), policy.gain)
    assert bool(gradient != 0.0)


def test_an_annealed_number_is_compiled_once():
    env = made("ring", CASES[0][1], "float32")
    env.reset(seed=3)
    policy = Tuned()
    calls = set()
    for step in range(4):
        policy.gain = 0.5 - 0.01 * step
        driver = driver_of(policy, env.unroll(policy, 2).observation[-1], 1)
        calls |= {driver.forward.call, driver.backward.call}
    assert len(calls) == 2
