"""Published figures beside ours, and platoons behind chains of recorded leaders: what is told is what was driven."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from agents import evaluate
from agents.classical import FollowerStopper
from agents.evaluate import judged_rings
from agents.rollout import drive
from benchmarks import agents_lanes, agents_platoon, agents_published, lane_drop
from idm_env.tasks import make_task
from idm_env.tasks.recorded import recorded_leaders

RING = {"task": "ring", "vehicles": 8, "length": [80.0, 100.0], "noise": 0.0, "failsafe": 3.0}


def test_speeds_of_rings_are_means_of_all_vehicles_by_length(monkeypatch):
    monkeypatch.setattr(agents_published, "STEPS", 60)
    monkeypatch.setattr(evaluate, "JUDGED", 20)
    monkeypatch.setattr(agents_published, "FRESH", (1, 2))
    monkeypatch.setattr(agents_published, "judged_rings", partial(judged_rings, warmup=300))
    found = agents_published.speeds(None, RING)
    driven = drive(judged_rings(RING, agents_published.LENGTHS, 300, (1, 2)), None, 60)
    wanted = driven.speed[-20:].mean((0, 2)).view(5, 2).mean(-1)
    assert found["speeds"] == pytest.approx(wanted.tolist(), rel=1e-5) and found["collisions"] == 0
    assert found["speeds"] == sorted(found["speeds"]) and found["speeds"][0] < 0.9 * found["speeds"][4]


def test_the_table_has_every_published_row_beside_ours(tmp_path, monkeypatch, capsys):
    judged = []

    def speeds(act, environment):
        judged.append((act, environment.get("shock", 0.0)))
        return {"speeds": [2.0, 2.5, 3.0, 3.5, 4.0] if act is None else [3.0, 3.5, 4.0, 4.5, 5.0], "collisions": 0}

    lanes = {"speed": 20.0, "outflow": 1500.0, "outflows": [1400.0, 1600.0]}
    monkeypatch.setattr(agents_published, "speeds", speeds)
    monkeypatch.setattr(agents_published.common, "load", lambda path, task: (path, {}))
    monkeypatch.setattr(
        agents_lanes, "figures", lambda out, name, paths, kinds: {"idm": {"IDM": lanes}, "trained": {"apg": lanes}}
    )
    rows = {name: [[1000.0 + i, 5.0, 0.0] for i in range(8)] for name in lane_drop.on_the_published_road()}
    monkeypatch.setattr(agents_published.workers, "named", lambda *given: rows)
    path = tmp_path / "trial0/seed1/training/last.pt"
    monkeypatch.setattr("sys.argv", ["x", "--out", str(tmp_path), "--lanes", str(tmp_path), "--checkpoints", str(path)])
    for _ in range(2):
        agents_published.main()
    assert judged == [(None, 0.0), (path, 0.0), (None, 4.0), (path, 4.0)]  # once each
    told = capsys.readouterr().out
    assert "| ring of 270 m, m/s | 4.0 → 5.2 | 4.00 | 5.00 (5.00–5.00) |" in told
    assert "| `merge` | Flow's merge, threshold 13.0 m/s | 20.0 m/s | 20.0 m/s |" in told
    assert "| lane drop, min gap 3 | 1440 → 1736 | 1007 ± 5; 1007 ± 5 | 1007 ± 5; 1007 ± 5 |" in told
    assert told.count("|\n") == 2 * (2 + 10 + 6 + 9)


def test_chains_have_every_record_once_and_no_jump():
    dt, draw = 0.1, np.random.default_rng(1)
    speeds = [np.full(200, x) for x in draw.uniform(2.0, 9.0, 11)]
    chains = agents_platoon.chained(speeds, dt)
    assert [len(x) for x in chains] == [1000, 1000]
    assert max(np.abs(np.diff(x)).max() for x in chains) < 7.0 * dt / agents_platoon.FADES + 1e-9
    ends = [x[199::200] for x in chains]  # by then a joint has faded
    assert len(set(np.concatenate(ends).round(6))) == 10
    assert {round(x, 6) for end in ends for x in end} <= {round(float(x[0]), 6) for x in speeds}


def test_behind_steady_leaders_all_are_as_fast_and_only_agents_differ(tmp_path):
    idm = {"max_accel": 1.1, "comfort_decel": 1.2, "time_gap": 1.4, "min_gap": 2.2, "desired_speed": 35.0}
    path = agents_platoon.write(tmp_path / "leaders.parquet", [np.full(1202, 6.0), np.full(1202, 8.0)], 0.1)
    assert recorded_leaders(str(path), 0.1).motion[1, :, 1] == pytest.approx(np.full(1202, 8.0))
    means = []

    def human(task, mean):
        means.append(mean)

    r = agents_platoon.judged(human, path, idm, 4)
    assert means[0].tolist() == [[pytest.approx(6.0)], [pytest.approx(8.0)]]
    assert r["speed"] == pytest.approx([6.0, 8.0], abs=1e-3) and max(r["deviation"]) < 1e-3
    slower = agents_platoon.judged(lambda task, mean: lambda seen: -0.01 * torch.ones(2, 4), path, idm, 4)
    assert slower["speed"][1] < 7.5 and slower["farthest"][1] > r["farthest"][1] + 10.0
    task = make_task(**agents_platoon.environment(path, idm, 4))
    seen = torch.tensor([[[6.0, 5.0, 3.0]] * 4]) / torch.tensor(task.scales)  # nearer than its first zone: stop
    rule = agents_platoon.Rule(task, FollowerStopper(task, desired=8.0))
    assert task.command(rule(seen.flatten(1))).tolist() == [[-4.5] * 4]
