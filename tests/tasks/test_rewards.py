"""Rewards lie in their bounds and a crash never pays, in every task: by bounds of terms, and in wild rollouts."""

import re

import gymnasium
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401 (registers the environments)
from idm_env import backends
from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import REWARD_TERMS, TASKS, Draw, Transition, make_task
from idm_env.tasks.crash import floored

CASES = {
    "ring": {"task": "ring", "warmup": 60},
    "ring, wave": {"task": "ring", "warmup": 60, "start": "wave", "controlled": 3},
    "ring, flow": {"task": "ring", "warmup": 60, "reward": "flow", "max_command": 4.0},
    "ring, real brakes": {"task": "ring", "warmup": 60, "max_command": [-4.5, 2.6], "shock": 4.0, "shock_after": 3.0},
    "ring, terms": {
        "task": "ring",
        "warmup": 60,
        "reward": {"speed": 0.2, "effort": -4.0, "fuel": -3.0, "tailgating": -2.0},
    },
    "follow": {"task": "follow"},
    "follow, hard": {"task": "follow", "max_command": 30.0, "controlled": 2},
    "follow, thrifty": {"task": "follow", "reward": "source", "fuel_weight": 2.0},
    "follow, in time": {"task": "follow", "reward": "source", "lag_weight": 2.0},
    "platoon": {"task": "platoon", "controlled": 2},
    "platoon, costs": {"task": "platoon", "controlled": 2, "reward": "quadratic"},
    "replay, imitation": {"task": "replay", "reward": "imitation"},
    "merge, delay": {
        "task": "merge",
        "vehicles": 40,
        "max_command": 4.0,
        "controlled": 3,
        "added": False,
        "reward": "delay",
    },
    "approach, delay": {
        "task": "approach",
        "vehicles": 40,
        "controlled": 8,
        "added": False,
        "reward": "delay",
        "max_command": 4.0,
    },
    "replay": {"task": "replay"},
    "replay lanes": {"task": "replay_lanes", "controlled": 2, "lane_commands": True},
    "highway": {"task": "highway", "vehicles": 30, "length": 300.0, "max_command": 4.0, "controlled": 3},
    "open highway": {"task": "open_highway", "vehicles": 40, "max_command": 4.0, "controlled": 3, "added": False},
    "merge": {"task": "merge", "vehicles": 40, "max_command": 4.0, "controlled": 3, "added": False},
    "bottleneck": {"task": "bottleneck", "vehicles": 40, "max_command": 4.0, "controlled": 12, "added": False},
    "approach": {"task": "approach", "vehicles": 40, "max_command": 4.0, "controlled": 8, "added": False},
    "replay, follow": {"task": "replay", "controlled": 3, "reward": "source"},
}
STEPS, COUNT = 150, 24


def wild(task, step):
    """Actions that try to end early, to waste, or neither: COUNT rows of each kind, [4 · COUNT, agents]."""
    generator = torch.Generator().manual_seed(step)
    noise = 2.0 * torch.rand(COUNT, len(task.agents), generator=generator, dtype=torch.float64) - 1.0
    return torch.cat((noise, *(torch.full_like(noise, x) for x in (1.0 if step % 2 else -1.0, 1.0, -1.0))))


def returns(task):
    """Roll COUNT environments of each kind out, as single ones pay; return their returns and whether they crashed."""
    params = task.params(torch.float64, "cpu")
    draw = Draw.of(torch.arange(COUNT).repeat(4), torch.zeros(4 * COUNT, dtype=torch.int64))
    world = task.reset(draw, params)
    normals = task.normals(draw, world.state.step, STEPS, torch.float64)
    total, live = torch.zeros(4 * COUNT, dtype=torch.float64), torch.ones(4 * COUNT, dtype=torch.bool)
    for t in range(STEPS):
        command = task.command(wild(task, t))
        after = task.step(world, command, {name: x[t] for name, x in normals.items()}, params)
        total += torch.where(live, task.rewards(world, command, after).mean(-1), 0.0)
        live &= ~task.ended(after).terminated.any(-1)
        world = after
    return total, ~live


@pytest.mark.parametrize("name", CASES)
def test_no_crash_pays(name):
    """In [0, 1] it ends what was in store; under a reward that can be negative it returns less than every survival."""
    crashed, survived = [], []
    with torch.no_grad():
        for failsafe in (0.0, 3.0):
            task = make_task(**CASES[name], failsafe=failsafe, max_episode_steps=STEPS)
            total, over = returns(task)
            crashed += total[over].tolist()
            survived += total[~over].tolist()
    assert len(crashed) > 5
    assert len(survived) > 50
    if task.reward_range.low < 0.0:
        assert max(crashed) < min(survived)
    else:
        assert task.cost_of_crash == 0.0 <= min(*crashed, *survived)


@pytest.mark.parametrize("name", CASES)
def test_no_state_pays_beyond_the_bounds(name):
    task = make_task(**CASES[name])
    if "reward" not in CASES[name]:
        assert task.reward_range == (0.0, 1.0)
    steps, shared = task.steps // task.held, task.cost_of_crash / task.shares
    if task.reward_range.low < 0.0:
        assert (steps - 1) * task.reward_range.high - shared < steps * task.reward_range.low
    params = task.params(torch.float64, "cpu")
    draw = Draw.of(torch.arange(500), torch.zeros(500, dtype=torch.int64))
    world = task.begin(draw, params)
    u = draw.uniforms(3, 3 * task.vehicles, torch.float64).view(500, 3, task.vehicles)
    state = world.state._replace(
        speed=200.0 * u[:, 0] ** 3, accel=20.0 * u[:, 1] - 10.0, gap=1e4 * u[:, 2] ** 4 + 1e-9,
        position=world.state.position + 1e5 * u[:, 0], step=world.state.step + 9,
    )  # fmt: skip
    command = task.command(2.0 * u[:, 1, : len(task.agents)] - 1.0)
    earned = task.held * sum(
        task.weighted.parts(Transition(task, world, command, world._replace(state=state))).values()
    )
    assert bool(torch.isfinite(earned).all())
    assert task.reward_range.low <= float(earned.min()) < float(earned.max()) <= task.reward_range.high + 1e-9


@pytest.mark.parametrize("keywords", [{"task": "highway", "hold": 0.5}, {"task": "merge", "reward": "delay"}])
def test_infos_have_the_parts_of_a_held_step(keywords):
    """On every face; their sum is the reward. Compiled infos are torch's in tests/envs/test_values.py."""
    with backends.off():
        env = gymnasium.make("DiffIDM-v0", **keywords)
        batch = gymnasium.make_vec("DiffIDM-v0", num_envs=2, **keywords)
        agents = parallel_env(**keywords)
    for each in (env, batch, agents):
        each.reset(seed=0)
    assert len(env.unwrapped.task.reward_names) == len(env.unwrapped.task.weighted.terms) + ("reward" in keywords)
    for _ in range(2):
        _, reward, _, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert float(info["rewards"].sum(-1).mean()) == pytest.approx(reward)
        told = batch.step(np.zeros(batch.action_space.shape, np.float32))
        np.testing.assert_allclose(told[4]["rewards"].sum(-1).mean(-1), told[1], rtol=1e-5)
        _, rewards, _, _, infos = agents.step({a: np.zeros(1, np.float32) for a in agents.agents})
        first = agents.agents[0]
        assert first not in infos or infos[first]["rewards"].sum() == pytest.approx(rewards[first])


def test_every_task_is_tried():
    assert {case["task"] for case in CASES.values()} == set(TASKS)


def test_the_floor_changes_nothing_above_its_knee_and_has_a_gradient_everywhere():
    reward = torch.tensor([1.0, -3.9, -4.0, -4.0001, -5.0, -1e3, -1e9], dtype=torch.float64, requires_grad=True)
    kept = floored(reward, -4.0, -8.0)
    kept.sum().backward()
    torch.testing.assert_close(kept[:3], reward[:3])
    torch.testing.assert_close(reward.grad[[0, 1, 3]], torch.ones(3, dtype=torch.float64), rtol=0, atol=1e-4)
    assert bool((kept > -8.0).all())
    assert bool((reward.grad > 0.0).all())
    assert float(kept[4].detach()) == pytest.approx(-4.8)


def test_a_crash_pays_its_price_and_nothing_else():
    for keywords, price in (({}, 0.0), ({"crash_cost": 50.0}, 50.0), ({"reward": "source"}, 5001.0)):
        task = make_task("follow", **keywords)
        params = task.params(torch.float64, "cpu")
        world = task.begin(Draw.of(torch.tensor([0]), torch.tensor([0])), params)
        gap = world.state.gap.clone()
        gap[0, 3] = -0.1
        touched = world._replace(state=world.state._replace(gap=gap))
        assert float(task.rewards(world, torch.zeros(1, 1, dtype=torch.float64), touched)) == -price


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        ({"reward": "flows"}, "reward = 'flows' is unknown. Did you mean 'flow'?"),
        ({"reward": {"speed": 0.0}}, "reward gives no term a weight: speed"),
        ({"reward": {REWARD_TERMS["speed"]: 1.0, "speed": 2.0}}, "give each once"),
    ],
)
def test_a_reward_that_cannot_be_is_told_in_one_line(keywords, said):
    with pytest.raises(ValueError, match=re.escape(said)) as told:
        make_task("ring", **keywords)
    assert "\n" not in str(told.value)
    with pytest.raises(ValueError, match=r"lag_weight = 2.0 weighs a term of reward = 'source', and reward = None"):
        make_task("follow", lag_weight=2.0)
