"""Agents in traffic that flows in and out: the figures by which they are judged, and policies that drive together."""

from __future__ import annotations

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch

from agents import apg, common, evaluate, ppo
from agents.environments import human_driving, make_env, task_of
from agents.policy import Policy
from agents.rollout import SEED, episodes_start

FREE = {"task": "bottleneck", "inflow": 720.0, "vehicles": 40, "controlled": [4], "failsafe": 3.0}


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(evaluate, "STEPS_OF_LANES", 1200)


def test_in_free_traffic_what_comes_goes(short):
    """720 an hour are 24 in 120 s, and nobody waits or stands; a trip of 800 m takes half a minute."""
    found = evaluate.evaluate_lanes(None, FREE, 2)
    assert all(abs(flow - 720.0) <= 6 * 30.0 for flow in found["outflows"])
    assert found["queued"] == found["standing"] == 0 and found["passed"] and 20.0 < found["travel"] < 50.0
    assert found["outflow"] == pytest.approx(sum(found["outflows"]) / 2)


@pytest.mark.usefixtures("torch_path")
@pytest.mark.parametrize("more", [{}, {"noise": 0.2}, {"failsafe": 3.0, "lane_commands": True}], ids=str)
def test_the_return_that_is_judged_is_the_environments(monkeypatch, more):
    """A rollout between two decisions pays what the steps of an environment pay, human drivers or agents."""
    monkeypatch.setattr(evaluate, "STEPS_OF_LANES", 150)
    chosen = {"task": "merge", "vehicles": 30, "controlled": 3, "reward": "delay", **more}
    commands = -torch.ones(2, 6 if "lane_commands" in more else 3)
    for act in (None, lambda seen: commands):
        found = evaluate.evaluate_lanes(act, chosen, 2)
        env = make_env(chosen, 2, output="torch", autoreset_mode="Disabled")
        env.reset(seed=SEED)
        pays = [env.step(None if act is None else commands)[1] for _ in range(15)]
        torch.testing.assert_close(torch.tensor(found["rewards"]).float(), torch.stack(pays).sum(0), rtol=1e-4, atol=0)


def test_policies_that_drive_together_drive_as_alone(monkeypatch):
    monkeypatch.setattr(evaluate, "STEPS_OF_LANES", 300)
    task = task_of(FREE)
    accels = (-3.0, 0.3)

    def constant(accel):
        return lambda seen: task.action(torch.full((len(seen), len(task.agents)), accel))

    family = {f"{a}": constant(a) for a in accels}

    def act(seen):
        return torch.cat([one(part) for one, part in zip(family.values(), seen.chunk(2), strict=True)])

    together = evaluate.judge_lanes(episodes_start(FREE, 2, 2), act, 2)
    alone = [evaluate.evaluate_lanes(one, FREE, 2) for one in family.values()]
    assert together == alone
    assert together[0]["reward"] < together[1]["reward"] - 5.0  # who stands holds up those behind


def test_apg_learns_in_traffic_that_flows(quick, monkeypatch):
    """Gradients go through vehicles that enter, change lanes and leave."""
    monkeypatch.setattr(common, "human_driving", partial(human_driving, count=2, steps=600))
    environment = {**FREE, "vehicles": 24, "max_episode_steps": 60}
    history = apg.train(apg.Arguments(**{**quick, "environment": environment, "updates": 2}, count=2, window=20))
    assert [row["updates"] for row in history] == [0, 1, 2]
    policy, _ = common.load(quick["out"] / "last.pt")
    before, _ = common.begin(apg.Arguments(**{**quick, "environment": environment}), "apg")
    assert all(bool(torch.isfinite(x).all()) for x in policy.parameters())
    assert not torch.equal(policy.body[-1].weight, before.body[-1].weight)


def test_a_ring_of_twice_the_vehicles_is_twice_as_long(monkeypatch):
    made = []
    monkeypatch.setattr(evaluate, "ring_start", lambda e, lengths, *rest: made.append(list(lengths)))
    monkeypatch.setattr(evaluate, "judge_ring", lambda *given: {})
    monkeypatch.setattr(evaluate, "drive", lambda *given: None)
    for vehicles in (22, 44):
        evaluate.evaluate_ring(None, {"task": "ring", "vehicles": vehicles, "length": 1000.0}, (220.0, 270.0))
    assert made == [[220.0, 270.0], [440.0, 540.0]]


def test_nobody_learns_from_who_is_not_on_the_road(monkeypatch):
    """Neither clones nor normalisation, nor PPO's batches; an agent's episode ends with its trip."""
    chosen = {**FREE, "controlled": 0.2, "max_episode_steps": 50}
    seen, actions = human_driving(chosen, 5, count=2, steps=400)
    at = task_of(chosen).bounds.names.index("present")
    assert 0 < len(seen) == len(actions) < 0.9 * 2 * 40 * 8 and bool((seen[:, at] == 1.0).all())
    rows = ppo.Shared(make_env(chosen, 2, output="numpy"))
    rows.seed(3)
    policy = Policy(len(rows.vector_env.task.bounds.names), (4,))
    arguments = ppo.Arguments(environment=chosen, count=2, n_steps=40, batch_size=64, hidden=(4,))
    model = ppo.make_model(arguments, rows, policy, ppo.present_in(rows.vector_env.task))
    model.learn(40 * 16)
    buffer = model.rollout_buffer
    away = buffer.observations.reshape(-1, seen.shape[-1])[:, at] <= 0.0
    # Learning has laid the samples of each agent one after the other.
    there, starts = buffer.observations.reshape(16, 40, -1)[..., at].T > 0.0, buffer.episode_starts > 0.0
    assert starts[1:][~there[1:]].all() and starts[1:][there[1:]].mean() < 0.1
    batches = [part.observations[:, at] for part in buffer.get(64)]
    assert 0 < away.sum() < away.size and sum(map(len, batches)) == (~away).sum()
    assert all(bool((part > 0.0).all()) for part in batches)


def test_a_clone_of_held_actions_learns_what_they_came_to():
    """The mean acceleration of a second, not that of its last tenth."""
    chosen = {"task": "ring", "hold": 1.0, "warmup": 50, "max_command": 4.0}
    env = make_env(chosen, 2, output="numpy")
    env.reset(seed=5)
    before = env.state.speed
    env.step(None)
    _, actions = human_driving(chosen, 5, count=2, steps=1)
    torch.testing.assert_close(env.task.command(actions.view(2, 1)), env.task.pick(env.state.speed - before))


def test_ppo_learns_one_policy_for_all_agents_of_an_environment(quick, monkeypatch):
    """Every agent is a row of its own, with what it observes; the team's reward goes to all."""
    monkeypatch.setattr(common, "human_driving", partial(human_driving, count=2, steps=600))
    environment = {**FREE, "vehicles": 24, "controlled": [4, 5, 6], "max_episode_steps": 30}
    vector = make_env(environment, 2, output="numpy")
    rows = ppo.Shared(vector)
    rows.seed(3)
    seen = rows.reset()
    assert seen.shape == (6, len(vector.task.bounds.names)) and rows.observation_space.contains(seen[4])
    away = vector.task.bounds.names.index("present")
    together = vector.task.observe(vector.batch.world).reshape(6, -1)
    assert torch.equal(torch.as_tensor(seen), together)
    ended = 0
    for _ in range(35):
        seen, reward, done, infos = rows.step(0.1 * torch.arange(6).reshape(6, 1).numpy())
        assert reward.shape == done.shape == (6,) and len(infos) == 6
        for world in (slice(0, 3), slice(3, 6)):
            assert len(set(reward[world])) == 1
        over = ["terminal_observation" in info for info in infos]
        assert done[over].all() and (seen[done & ~np.array(over), away] == 0.0).all()
        assert all(infos[i]["terminal_observation"].shape == seen[i].shape for i in np.flatnonzero(over))
        ended += sum(over)
    assert ended >= 6
    arguments = {**quick, "environment": environment, "updates": 2}
    history = ppo.train(ppo.Arguments(**arguments, count=2, n_steps=10, batch_size=30, n_epochs=1))
    assert [row["steps"] for row in history] == [0, 20, 40]
    policy, _ = common.load(quick["out"] / "last.pt")
    assert all(bool(torch.isfinite(x).all()) for x in policy.parameters())


@pytest.mark.parametrize("squash", ["tanh", "clip"])
def test_a_new_policy_does_as_the_driver_where_a_task_has_such_an_action(monkeypatch, squash):
    """Training begins at humans: the same return in the same episodes."""
    monkeypatch.setattr(evaluate, "STEPS_OF_LANES", 600)
    chosen = {"task": "merge", "vehicles": 30, "controlled": 0.1, "careful": True, "added": False}
    task = task_of(chosen)
    policy = Policy(len(task.bounds.names), squash=squash)
    policy.starts_with(task.as_driver)
    policy.scale.copy_(torch.full_like(policy.scale, 30.0))
    humans, new = (evaluate.evaluate_lanes(act, chosen, 2)["rewards"] for act in (None, policy))
    torch.testing.assert_close(torch.tensor(new), torch.tensor(humans), rtol=2e-3, atol=0)
    assert task_of({**chosen, "careful": False}).as_driver == 0.0


def test_sac_draws_nobody_who_is_away_and_rewards_are_scaled_by_those_who_are_there():
    """Of a memory in which one of four samples was on the road, and of returns that are huge where nobody is."""
    space = gymnasium.spaces.Box(-10.0, 10.0, (2,), np.float32)
    memory = ppo.RoadReplay(40, space, gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32), n_envs=4, present=1)
    for step in range(10):
        seen = np.array([[step, float(i == 0)] for i in range(4)], np.float32)
        memory.add(seen, seen, np.zeros((4, 1)), np.zeros(4), np.zeros(4), [{}] * 4)
    drawn = memory.sample(64)
    assert drawn.observations.shape == (64, 2) and bool((drawn.observations[:, 1] > 0).all())
    made = make_env({"task": "merge", "vehicles": 12, "controlled": 3}, 2, output="numpy")
    env = ppo.RoadRewards(ppo.Shared(made), ppo.present_in(made.task), 0.9)
    env.reset()
    env.old_obs = np.zeros((6, len(made.task.bounds.names)), np.float32)
    env.old_obs[:2, ppo.present_in(made.task)] = 1.0
    before = env.ret_rms.count
    env._update_reward(np.array([1.0, 3.0, 1e6, 1e6, 1e6, 1e6]))
    assert env.ret_rms.count - before == pytest.approx(2.0) and env.ret_rms.mean == pytest.approx(2.0, rel=1e-3)
