"""Features, rewards and effects of one's own that read something beside their arguments: compiled steps see it change.

Every case is an environment that steps in compiled loops beside one that torch steps; both read the same things.
"""

import random
import types
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

from idm_env import backends
from idm_env.effects import IDM, Effect
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.tasks import Feature
from idm_env.tasks.reward_terms import RewardTerm
from tests.laws.test_own_effects import own

OWN = {"gain": 1.07, "items": [1.0, 2.03], "weight": torch.tensor([0.93]), "array": np.full(3, 1.19, np.float32)}
GAIN = 1.13
"""No number is another one's: the printed loops are the same then, and compiled once."""
SETTINGS = types.ModuleType("settings_of_mine")
SETTINGS.GAIN = 0.91
LAYER = nn.Linear(1, 1).requires_grad_(False)


class Mine:
    """A feature that is an object."""

    gain, __slots__ = 1.11, ("__dict__", "bias")

    def __init__(self):
        self.bias = 0.17

    def __call__(self, view, scale=1.23):
        return scale * (speed(view) * self.gain + self.bias + self.more)

    @property
    def more(self):
        return OWN["items"][1] - 2.21


MINE = Mine()


def speed(view):
    return view.own(view.state.speed)


def read_global(view):
    return speed(view) * scaled(GAIN)


def scaled(x):
    return x * OWN["gain"] * SETTINGS.GAIN


def read_tensors(view):
    table = torch.from_numpy(OWN["array"])
    return speed(view) * LAYER.weight[0, 0] * OWN["weight"] * table[1].item()


def imported(view):
    from test_reads import GAIN as OTHER

    return speed(view) * OTHER


def closure():
    gain = 1.31

    def feature(view):
        return speed(view) * gain

    def put(x):
        nonlocal gain
        gain = x

    return feature, put


closed, PUT = closure()
FEATURES = {
    "global": read_global, "tensors": read_tensors, "object": MINE, "closure": closed,
    "imported": imported,
}  # fmt: skip


def term(step):
    return speed(step.view) * GAIN * MINE.gain


def put_global(name, x):
    globals()[name] = x


CHANGES = {
    "global": lambda: put_global("GAIN", 2.17),
    "entry of a dict": lambda: OWN.update(gain=0.53),
    "entry of a list": lambda: OWN["items"].__setitem__(1, 3.07),
    "attribute of a module": lambda: setattr(SETTINGS, "GAIN", 3.11),
    "closure": lambda: PUT(2.41),
    "attribute over the class's": lambda: setattr(MINE, "gain", 2.59),
    "attribute of the class": lambda: (MINE.__dict__.pop("gain"), setattr(Mine, "gain", 4.19)),
    "slot": lambda: setattr(MINE, "bias", 1.37),
    "tensor": lambda: OWN["weight"].mul_(1.7),
    "tensor unseen by autograd": lambda: OWN["weight"].data.mul_(1.7),
    "array": lambda: OWN["array"].__setitem__(1, 2.77),
    "weights": lambda: torch.nn.init.constant_(LAYER.weight, 0.33),
    "helper": lambda: put_global("scaled", lambda x: x * OWN["gain"] * 5.23),
    "default": lambda: setattr(Mine.__call__, "__defaults__", (0.57,)),
}


def made(output, features=FEATURES, **keywords):
    own = [Feature(name, "m", "m", 10.0, -1e4, 1e4, read) for name, read in features.items()]
    env = DiffIDMVectorEnv(
        num_envs=2, task="ring", vehicles=5, warmup=20, output=output, observation={"features": ["speed", *own]},
        reward={RewardTerm("mine", "r", "1", -1e4, 1e4, term): 1.0}, **keywords,
    )  # fmt: skip
    env.reset(seed=1)
    return env


def plain(monkeypatch, *given, **keywords):
    """Return an environment that torch steps."""
    with monkeypatch.context() as m:
        m.setenv("IDM_ENV_KERNELS", "0")
        return made(*given, **keywords)


def test_compiled_steps_read_what_is_there_now(monkeypatch):
    """Frozen in the recording, the old value went on for ever, in observations, rewards and gradients."""
    monkeypatch.setattr("idm_env.envs.values._WORTHWHILE", 2)
    env, other, torch_env = made("torch"), made("numpy"), plain(monkeypatch, "torch")
    held, wrong = [x.batch.values for x in (env, other)], []
    for name, change in {"nothing": lambda: None, **CHANGES}.items():
        change()
        for again in range(3):
            push = torch.full((2, 1), 0.3, requires_grad=True)
            (seen, reward, *_), (own, paid, *_) = env.step(push), torch_env.step(push)
            both = other.step(push.detach().numpy())[:2]
            pairs = [(seen, own), (reward, paid), (both[0], own.detach()), (both[1], paid.detach())]
            sums = seen.sum() + reward.sum(), own.sum() + paid.sum()
            pairs.append(tuple(torch.autograd.grad(x, push)[0] for x in sums))
            same = [torch.allclose(torch.as_tensor(x).to(y), y, rtol=1e-4, atol=1e-6) for x, y in pairs]
            wrong += [] if all(same) else [(name, again, same)]
            env.detach(), torch_env.detach()
        assert all(x._plans for x in held), f"{name}: the step is not compiled again"
    assert wrong == []
    assert [x.batch.values for x in (env, other)] == held


class Restless:
    def __init__(self):
        self.calls = 0

    def __call__(self, view):
        self.calls += 1
        return speed(view) / self.calls


def chance(view):
    return speed(view) * random.random()


@pytest.mark.parametrize(("feature", "warns"), [(Restless(), False), (chance, True)])
def test_a_feature_that_is_another_one_at_every_call_is_called_at_every_step(feature, warns, recwarn):
    env = made("numpy", {"mine": feature})
    values = [float(env.step(np.zeros((2, 1), np.float32))[0][0, 1]) for _ in range(6)]
    assert len(set(values)) == 6
    assert not warns or env.batch.values is None


def test_a_tensor_that_requires_a_gradient_has_it():
    """A weight of a reward that is learned: a recording has it as a constant."""
    OWN["weight"] = torch.tensor([0.5], requires_grad=True)
    with pytest.warns(UserWarning, match="requires a gradient"):
        env = made("torch", {"mine": read_tensors})
        seen = env.step(torch.zeros(2, 1))[0]
    assert torch.autograd.grad(seen.sum(), OWN["weight"])[0] != 0.0
    OWN["weight"] = torch.tensor([1.0])


def test_a_window_reads_what_is_there_now_and_is_recorded_once_for_it(monkeypatch):
    monkeypatch.setattr("idm_env.envs.values._WORTHWHILE", 8)
    policy = nn.Linear(3, 1)
    env, torch_env = (f("torch", {"a": read_global, "b": closed}) for f in (made, partial(plain, monkeypatch)))
    for gain in (1.01, 1.57, 2.03):
        put_global("GAIN", gain)
        env.reset(seed=1), torch_env.reset(seed=1)
        window, own = (x.unroll(policy, 8) for x in (env, torch_env))
        torch.testing.assert_close(window.observation[1:], own.observation[1:])
        torch.testing.assert_close(window.reward, own.reward)
        assert env.batch.values._plans


class Pulls(Effect):
    kind = "pulls"

    def accelerate(self, scene, driver, p):
        return 0.0 * scene.speed + 0.1 * GAIN


def test_an_effect_reads_what_is_there_now():
    simulator = Simulator(Lane(), (IDM(), Pulls()))
    params = simulator.defaults(dtype=torch.float64)
    state = simulator.state(torch.tensor([60.0, 30.0]).double(), torch.tensor([9.0, 9.0]).double(), params)
    for gain in (1.01, 2.03):
        put_global("GAIN", gain)
        last = simulator.rollout(state, {}, params, 5)[0]
        with backends.off():
            own = simulator.rollout(state, {}, params, 5)[0]
        torch.testing.assert_close(last.speed, own.speed)


@pytest.mark.filterwarnings("error:no compiled step")
@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_steps_with_effects_of_ones_own_are_compiled(output: str) -> None:
    """Watching what they return asks no number of a step that is recorded."""
    effect = own("accelerate", lambda s, d, p: -0.1 * s.speed)
    env = DiffIDMVectorEnv(2, task="ring", effects=(effect,), output=output)
    env.reset(seed=1)
    action = torch.zeros(2, 1) if output == "torch" else np.zeros((2, 1), np.float32)
    assert np.isfinite(np.asarray(env.step(action)[0])).all()
