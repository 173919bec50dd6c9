"""The compiled step with a graph: the eager path's gradients and those of central differences, over all tasks."""

import copy
import gc
import pickle
import warnings
import weakref

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.simulator import Simulator
from idm_env.tasks import FEATURES, REWARD_TERMS, TASKS

pytest.importorskip("numba")


DECLARED = {"features": list(FEATURES), "vehicles": 2}
WEIGHTS = dict.fromkeys(REWARD_TERMS, 0.1)
CASES = {
    "ring": ("ring", {"start": "wave", "warmup": 20, "failsafe": 3.0}),
    "agents": (
        "ring",
        {
            "warmup": 5,
            "reward": "flow",
            "controlled": 3,
            "failsafe": 3.0,
            "integration": "euler",
            "max_episode_steps": 20,
        },
    ),
    "shock": (
        "ring",
        {"warmup": 5, "controlled": 2, "shock": 4.0, "shock_after": 0.5, "max_command": [-4.5, 2.6]},
    ),
    "past": (
        "ring",
        {"warmup": 5, "effects": ["delay", "memory"], "parameters": {"idm.time_gap": 1.3}, "max_episode_steps": 30},
    ),
    "follow": ("follow", {"max_episode_steps": 25, "fuel_model": "circles"}),
    "platoon": ("platoon", {"controlled": 2, "noise": 0.1, "observation": DECLARED, "reward": WEIGHTS}),
    "replay": ("replay", {"controlled": 2, "model": "all", "max_episode_steps": 20}),
    "single": ("replay", {"reward": "source", "failsafe": 4.0}),
    # Several lanes: who enters and leaves, changes, is let in, is put on a lane by a record, begins anew.
    "highway": (
        "highway",
        {"vehicles": 12, "length": 200.0, "controlled": 2, "noise": 0.1, "failsafe": 3.0, "max_episode_steps": 22},
    ),
    "merge": (
        "merge",
        {
            "vehicles": 20,
            "ramp_inflow": 1500.0,
            "controlled": 2,
            "lane_commands": True,
            "failsafe": 4.5,
            "hold": 0.2,
            "max_episode_steps": 33,
        },
    ),
    "open_highway": (
        "open_highway",
        {
            "vehicles": 12,
            "lanes_count": 2,
            "length": 150.0,
            "controlled": 2,
            "failsafe": 4.5,
            "hold": 0.1,
            "max_episode_steps": 30,
        },
    ),
    "bottleneck": ("bottleneck", {"vehicles": 14, "controlled": 2, "hold": 0.1, "noise": 0.1}),
    "approach": ("approach", {"vehicles": 14, "controlled": 2, "hold": 0.1, "max_episode_steps": 30}),
    "replay_lanes": (
        "replay_lanes",
        {"controlled": 2, "lane_changes": "drivers", "lane_commands": True, "max_episode_steps": 20},
    ),
}
PARAMETERS = ("time_gap", "max_accel")
DRIVERS_ONLY = [case for case in CASES if case not in ("merge", "open_highway", "approach", "replay_lanes")]
"""Where some steps go without an action: a recording of its own, which two tasks of several lanes are enough for."""


def test_every_task_has_a_case():
    assert {task for task, _ in CASES.values()} == set(TASKS)


def made(case, eager, **more):
    """Return an environment of a case, by torch where ``eager``, and its parameters that require a gradient."""
    task, keywords = CASES[case]
    env = DiffIDMVectorEnv(3, task=task, dtype="float64", output="torch", **{**keywords, **more})
    if eager:
        env.batch.values = None
    return env


def run(env, push, speed, shared, own, steps=50, nobody=0):
    """Return a sum of what steps tell, over actions, first speeds and parameters (shared and per vehicle); and ends.

    Every ``nobody``-th step goes without an action.
    """
    env.params = env.task.params(torch.float64, "cpu")
    env.reset(seed=4)
    state = env.state
    env.reset(options={"state": state._replace(speed=state.speed.detach() + speed)})
    params = {name: dict(values) for name, values in env.params.items()}
    base = env.task.simulator.base.name
    params[base][PARAMETERS[0]] = params[base][PARAMETERS[0]].detach() * shared
    params[base][PARAMETERS[1]] = params[base][PARAMETERS[1]].detach() * own
    env.params = params
    draw = np.random.default_rng(0)
    total, ends = torch.zeros((), dtype=torch.float64), 0
    for t in range(steps):
        action = torch.as_tensor(draw.uniform(-0.9, 0.9, env.action_space.shape)) + push
        observation, reward, terminated, truncated, info = env.step(None if nobody and t % nobody == 3 else action)
        total = total + observation.sum() + 0.1 * reward.clamp(-20.0, 20.0).sum()
        total = total + 0.1 * info.get("accel", torch.zeros(())).sum()
        ends += int((terminated | truncated).sum())
    return total + env.state.gap.clamp(-10.0, 100.0).sum(), ends


def leaves(env):
    """Return what is differentiated by: actions, speeds, a shared parameter and one per vehicle."""
    width = env.task.vehicles
    shapes = (env.single_action_space.shape, (3, width), (), (width,))
    ones = (0.0, 0.0, 1.0, 1.0)
    return [torch.full(s, x, dtype=torch.float64, requires_grad=True) for s, x in zip(shapes, ones, strict=True)]


@pytest.mark.parametrize("case", CASES)
def test_gradients_are_those_of_the_torch_path_and_of_differences(case):
    results = []
    nobody = 7 if case in DRIVERS_ONLY else 0
    for eager in (True, False):
        env = made(case, eager)
        own = leaves(env)
        total, ends = run(env, *own, nobody=nobody)
        found = torch.autograd.grad(total, own, allow_unused=True)
        found = [torch.zeros_like(x) if g is None else g for g, x in zip(found, own, strict=True)]
        results.append((total.detach(), found))
        assert (env.batch.values is None) == eager, "the other path ran"
    assert ends or "max_episode_steps" not in CASES[case][1]
    (wanted, torchs), (value, found) = results
    torch.testing.assert_close(value, wanted, rtol=1e-10, atol=1e-9)
    for ours, theirs in zip(found, torchs, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9 * float(theirs.abs().max() + 1.0))
    # New episodes begin from the parameters in force, through which no gradient flows.
    steps = CASES[case][1].get("max_episode_steps", 51) - 1
    total, ended = run(env, *own, steps, nobody)
    found = torch.autograd.grad(total, own, allow_unused=True)
    found = [torch.zeros_like(x) if g is None else g for g, x in zip(found, own, strict=True)]
    with torch.no_grad():
        for i, (x, g) in enumerate(zip(own, found, strict=True)):
            if ended and i > 1:
                continue
            towards = torch.rand(x.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(i))
            ends = [
                run(env, *[y.detach() + sign * 1e-6 * towards if y is x else y.detach() for y in own], steps, nobody)[0]
                for sign in (1.0, -1.0)
            ]
            slope = float((ends[0] - ends[1]) / 2e-6)
            assert slope == pytest.approx(float((g * towards).sum()), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("case", ["agents", "replay"])
def test_gradients_after_single_agents_have_left(case):
    """Their vehicles go back to the drivers, through whom gradients flow on; their commands count no more."""
    results = []
    for eager in (False, True):
        batch = made(case, eager).batch
        batch.seed(np.arange(3), [4, 5, 6])
        batch.reset()
        push = torch.zeros(3, len(batch.task.agents), dtype=torch.float64, requires_grad=True)
        total, live = torch.zeros((), dtype=torch.float64), torch.ones(push.shape, dtype=torch.bool)
        for t in range(12):
            live[t % 3, -1] &= t < 5
            told = batch.step(0.3 + push, live.clone())
            total = total + told.observation.sum() + told.whole.reward.clamp(-20.0, 20.0).sum()
        results.append((total.detach(), *torch.autograd.grad(total, push)))
        assert (batch.values is None) == eager, "the other path ran"
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9 * float(theirs.abs().max() + 1.0))
    assert results[0][1].abs().min() > 0.0


def test_nothing_is_stepped_by_torch_and_values_are_the_same_bits_without_a_graph(monkeypatch):
    def stepped(self, *arguments):
        raise AssertionError("the torch path ran")

    def run(requires_grad, output):
        env = DiffIDMVectorEnv(3, warmup=20, output=output, failsafe=3.0, max_episode_steps=12)
        env.reset(seed=3)
        kept = []
        with monkeypatch.context() as patch:
            patch.setattr(Simulator, "step", stepped)
            for i in range(30):
                action = torch.full((3, 1), 0.1 * (i % 5), requires_grad=requires_grad)
                observation, reward, *_ = env.step(action)
                kept.append(
                    np.append(*(np.asarray(torch.as_tensor(x).detach(), np.float32) for x in (observation, reward)))
                )
        return np.stack(kept), env

    (graph, env), (plain, _), (arrays, _) = run(True, "torch"), run(False, "torch"), run(False, "numpy")
    np.testing.assert_array_equal(graph, plain)
    np.testing.assert_array_equal(graph, arrays)
    # In mid-window: copies go on alike, without the graph; cutting the graph frees it.
    tape = weakref.ref(env.batch.values.now.blocks.grad_fn)
    others = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    action = torch.zeros(3, 1)
    mine = env.step(action)
    for other in others:
        theirs = other.step(action)
        assert torch.equal(mine[0].detach(), theirs[0]) and not theirs[0].requires_grad
    env.detach()
    del mine
    gc.collect()
    assert tape() is None


def test_second_derivatives():
    env = DiffIDMVectorEnv(2, vehicles=4, length=60.0, warmup=5, dtype="float64", output="torch", effects=["delay"])

    def total(push):
        env.reset(seed=1)
        env.step(push.expand(2, 1) ** 2)
        return env.step(push.expand(2, 1))[1].sum() + env.step(push.expand(2, 1) * 0.5)[0].sum()

    push = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(total, (push,))


def test_what_cannot_be_recorded_steps_by_torch_and_is_named():
    class Asks(type(gym.make("DiffIDM-v0").unwrapped.task)):
        def observe(self, world):
            return (
                super().observe(world) * float(world.state.speed.max() > -1.0)
                + torch.sort(world.state.gap).values[:, :1, None] * 0.0
            )

    env = DiffIDMVectorEnv(2, task=Asks(warmup=0), output="torch")
    env.reset(seed=0)
    action = torch.zeros(2, 1, requires_grad=True)
    with pytest.warns(UserWarning, match="a fork on values"):
        env.step(action)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert env.step(action)[1].requires_grad
