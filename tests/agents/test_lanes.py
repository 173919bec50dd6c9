"""Agents in traffic that flows in and out: the figures by which they are judged, and policies that drive together."""

from __future__ import annotations

import json
from functools import partial

import pytest
import torch

from agents import apg, common, evaluate, ppo
from agents.environments import human_driving, make_env, task_of
from agents.policy import Policy
from agents.rollout import episodes_start, ring_start, uniform_speed
from benchmarks import agents_lanes, agents_shared

FREE = {"task": "bottleneck", "inflow": 720.0, "vehicles": 40, "controlled": [4], "failsafe": 3.0}


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(evaluate, "STEPS", 1200)
    monkeypatch.setattr(evaluate, "JUDGED", 600)


def test_in_free_traffic_what_comes_goes(short):
    """720 an hour are 12 in the 60 s that are judged, give or take who is just at an end, and nobody waits."""
    found = evaluate.evaluate_lanes(None, FREE, 2)
    assert all(abs(flow - 720.0) <= 2 * 60.0 for flow in found["outflows"])
    assert found["queued"] == 0 and found["passed"] and 20.0 < found["speed"] < 32.0
    assert found["outflow"] == pytest.approx(sum(found["outflows"]) / 2)


def test_agents_of_one_name_are_rows_of_their_own_tasks(tmp_path):
    """Folders are ``trained/merge/apg-seed0`` and ``trained/bottleneck/apg-seed0``."""
    paths = []
    for task, seconds in (("merge", 3.0), ("bottleneck", 4.0)):
        paths.append(tmp_path / task / "apg-seed0" / "last.pt")
        common.save(paths[-1], Policy(3, (4,)), "apg", {"task": task}, {"cpu_seconds": seconds})
    rows = [list(agents_lanes.trained({"task": task}, paths)) for task in ("merge", "bottleneck")]
    assert rows == [["trained: apg-seed0, 3 CPU s"], ["trained: apg-seed0, 4 CPU s"]]


def test_policies_that_drive_together_drive_as_alone(monkeypatch):
    monkeypatch.setattr(evaluate, "STEPS", 300)
    monkeypatch.setattr(evaluate, "JUDGED", 100)
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
    assert together[0]["speed"] < together[1]["speed"] - 1.0  # who stands holds up those behind


def test_apg_learns_in_traffic_that_flows(quick, monkeypatch):
    """Gradients go through vehicles that enter, change lanes and leave."""
    monkeypatch.setattr(common, "human_driving", partial(human_driving, count=2, steps=60))
    environment = {**FREE, "vehicles": 24, "max_episode_steps": 60}
    history = apg.train(apg.Arguments(**{**quick, "environment": environment, "updates": 2}, count=2, window=20))
    assert [row["updates"] for row in history] == [0, 1, 2]
    policy, _ = common.load(quick["out"] / "last.pt")
    before, _ = common.begin(apg.Arguments(**{**quick, "environment": environment}), "apg")
    assert all(bool(torch.isfinite(x).all()) for x in policy.parameters())
    assert not torch.equal(policy.body[-1].weight, before.body[-1].weight)


def test_rows_of_lanes_are_driven_once(tmp_path, monkeypatch, capsys):
    row = {
        "speed": 9.0,
        "outflow": 1700.0,
        "queued": 40.0,
        "reward": 0.2,
        "collisions": 1,
        "outflows": [1600.0, 1800.0],
    }
    driven = []

    def drive(family, environment):
        driven.append(environment["task"])
        return {name: {**row, "reward": 0.1 * i} for i, name in enumerate(family or {"IDM": None})}

    monkeypatch.setattr(agents_lanes, "driven", drive)
    monkeypatch.setattr(
        agents_lanes, "networks", lambda environment: {"random network 0": None, "random network 1": None}
    )
    monkeypatch.setattr("sys.argv", ["agents_lanes", "--out", str(tmp_path)])
    agents_lanes.main()
    before = len(driven)
    agents_lanes.main()
    assert before == len(driven) == 4 * len(agents_lanes.TASKS)
    told = capsys.readouterr().out
    assert "| bottleneck | best of 6: always 1 m/s² | 9.0 | 1700 (1600–1800) | 40 | 0.500 | 1 |" in told
    assert "best of 2: random network 1" in told


def test_shared_policies_are_judged_on_rings_as_long_as_their_vehicles_need(tmp_path, monkeypatch, capsys):
    judged = []

    def judge(act, environment, draws):
        task = task_of(environment)  # refused where vehicles do not fit the ring
        judged.append((task.vehicles, len(task.agents), act is None))
        return {"speed_ratio": 1.0, "speed_std": 0.1, "time_gap": 1.0, "collisions": 0, "passed": True}

    monkeypatch.setattr(agents_shared, "evaluate_ring", judge)
    monkeypatch.setattr(agents_shared, "oracle", lambda name, environment: name)
    monkeypatch.setattr(agents_shared, "UNTAUGHT", {"always 0 m/s²": lambda environment: "still"})
    monkeypatch.setattr(agents_shared.common, "load", lambda path, task: (path, {}))
    path = tmp_path / "ring-apg/trial0/seed1/training/last.pt"
    monkeypatch.setattr("sys.argv", ["agents_shared", "--out", str(tmp_path), "--checkpoints", str(path)])
    for _ in range(2):
        agents_shared.main()
    assert judged.count((110, 2, True)) == 1 and (110, 5, True) not in judged
    assert judged.count((110, 5, False)) == 2 + len(agents_shared.ORACLES)
    assert "| 110 | 5 (4.5 %) | ring-apg/trial0/seed1 | 1.000 | 0.10 | 1.00 | 0 | yes |" in capsys.readouterr().out
    assert json.loads((tmp_path / "22-1/IDM-for-all/result.json").read_text())["passed"]


def test_what_has_learned_nothing_drives_every_agent(monkeypatch):
    environment = {
        "task": "ring",
        "vehicles": 44,
        "controlled": 3,
        "length": [440.0, 540.0],
        "failsafe": 3.0,
        "warmup": 9,
    }
    monkeypatch.setattr(
        agents_shared, "judged_rings", lambda *_, **__: ring_start(environment, (440.0, 500.0), warmup=9)
    )
    seen = ring_start(environment, (440.0, 500.0), warmup=9)
    observed = seen.task.observe(seen.world).flatten(1)
    for name, make in agents_shared.UNTAUGHT.items():
        if name.startswith("random network") and name[-1] != "1":
            continue
        action = make(environment)(observed)
        assert action.shape == (2, 3) and bool((action.abs() <= 1.0).all()), name
    always = agents_shared.UNTAUGHT["always 0.3 m/s²"](environment)(observed)
    assert torch.allclose(seen.task.command(always), torch.full((2, 3), 0.3))


def test_an_oracle_is_slow_first_and_then_faster_behind_krauss():
    environment = {"task": "ring", "vehicles": 8, "controlled": 2, "length": [80.0, 90.0], "failsafe": 3.0}
    start = ring_start(environment, (80.0, 90.0), warmup=20)
    task, uniform = start.task, uniform_speed(start).unsqueeze(-1)
    act = agents_shared.Oracle(start, first=0.5, last=1.0, after=1.0, gain=0.1)
    seen = torch.tensor([[0.4, 0.0, 9.0, 0.4, 0.0, 9.0]] * 2)  # 2 m/s, far behind a leader who is as fast
    shares = [(task.command(act(seen)) / 0.1 + 2.0) / uniform for _ in range(700)]
    for step, share in ((0, 0.5), (10, 0.5), (310, 0.75), (610, 1.0), (699, 1.0)):
        assert torch.allclose(shares[step], torch.full((2, 2), share), atol=1e-4)
    close = torch.tensor([[0.4, 0.0, 0.5, 0.4, 0.0, 9.0]] * 2)  # the first of both has touched its leader
    assert task.command(act(close))[:, 0].tolist() == [-1.0, -1.0]


def test_a_ring_of_twice_the_vehicles_is_twice_as_long(monkeypatch):
    made = []
    monkeypatch.setattr(evaluate, "ring_start", lambda e, lengths, *rest: made.append(list(lengths)))
    monkeypatch.setattr(evaluate, "judge_ring", lambda *given: {})
    monkeypatch.setattr(evaluate, "drive", lambda *given: None)
    for vehicles in (22, 44):
        evaluate.evaluate_ring(None, {"task": "ring", "vehicles": vehicles, "length": 1000.0}, (220.0, 270.0))
    assert made == [[220.0, 270.0], [440.0, 540.0]]


def test_ppo_learns_one_policy_for_all_agents_of_an_environment(quick, monkeypatch):
    """Every agent is a row of its own, with what it observes; the team's reward goes to all."""
    monkeypatch.setattr(common, "human_driving", partial(human_driving, count=2, steps=60))
    environment = {**FREE, "vehicles": 24, "controlled": [4, 5, 6], "max_episode_steps": 30}
    vector = make_env(environment, 2, output="numpy")
    rows = ppo.Shared(vector)
    rows.seed(3)
    seen = rows.reset()
    assert seen.shape == (6, len(vector.task.bounds.names)) and rows.observation_space.contains(seen[4])
    together = vector.task.observe(vector.batch.world).reshape(6, -1)
    assert torch.equal(torch.as_tensor(seen), together)
    ended = 0
    for _ in range(35):
        seen, reward, done, infos = rows.step(0.1 * torch.arange(6).reshape(6, 1).numpy())
        assert reward.shape == done.shape == (6,) and len(infos) == 6
        for world in (slice(0, 3), slice(3, 6)):
            assert len(set(reward[world])) == 1 and len(set(done[world])) == 1
        ended += int(done.sum())
        assert all(infos[i]["terminal_observation"].shape == seen[i].shape for i in done.nonzero()[0])
    assert ended >= 6
    arguments = {**quick, "environment": environment, "updates": 2}
    history = ppo.train(ppo.Arguments(**arguments, count=2, n_steps=10, batch_size=30, n_epochs=1))
    assert [row["steps"] for row in history] == [0, 20, 40]
    policy, _ = common.load(quick["out"] / "last.pt")
    assert all(bool(torch.isfinite(x).all()) for x in policy.parameters())
