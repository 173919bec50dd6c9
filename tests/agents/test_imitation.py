"""Imitation: observations, closed-loop errors, the table, and the measured pairs."""

from __future__ import annotations

import contextlib
import dataclasses

import pytest
import torch

from agents import common, environments, imitation
from idm_env.data import episodes, synthetic
from idm_env.data.episode import windows
from idm_env.fitting.batch import Batch
from idm_env.tasks import make_task

FOLLOW = make_task("follow", max_command=4.0)


@pytest.fixture
def data(tmp_path):
    """Three runs of one follower, in a file; run 3 is held out."""
    trajectories, _ = synthetic.generate(seed=1, runs=3, followers=1, seconds=40.0, noise=0.02, spread=0.0)
    path = tmp_path / "pairs.csv"
    trajectories.table.write_csv(path)
    return path


def arguments(data, tmp_path, **changes):
    return imitation.Arguments(
        data=data, only="", test="run_id=3", out=tmp_path / "out", cloning_steps=200, updates=4, window=20.0,
        hidden=(16,), **changes,
    )  # fmt: skip


def test_observations_are_those_of_task_follow():
    env = environments.make_env({"task": "follow"}, 3, output="torch")
    observation = env.reset(seed=0)[0]
    state = env.state
    ours = imitation.observe(state.speed[:, 1], state.speed[:, 0], state.gap[:, 1])
    assert torch.allclose(ours, observation, atol=1e-5) and len(FOLLOW.bounds.names) == len(imitation.SCALES)


def test_a_policy_that_does_what_idm_does_is_idm(data):
    """The rollout of the policy is that of the simulator: IDM's own acceleration as the policy gives IDM's rollout."""
    from idm_env.fitting.fit import base_simulator

    batch = Batch.stack(episodes(imitation.load(data), max_gap=None), dtype=torch.float32, substeps=1)
    simulator = base_simulator(0.1)
    params = simulator.defaults(dtype=torch.float32)
    driver = {k: float(v) for k, v in params["idm"].items()}

    def idm(seen):
        speed, lead, gap = seen[..., 0] * 40.0, seen[..., 1] * 40.0, seen[..., 2] * 100.0
        root = 2.0 * (driver["max_accel"] * driver["comfort_decel"]) ** 0.5
        wanted = driver["min_gap"] + torch.relu(speed * driver["time_gap"] + speed * (speed - lead) / root)
        accel = driver["max_accel"] * (1.0 - (speed / driver["desired_speed"]) ** 4 - (wanted / gap) ** 2)
        return accel.unsqueeze(-1) / 20.0

    gap, _ = imitation.simulate(idm, batch, make_task("follow", max_command=20.0))
    _, kept = simulator.rollout(batch.start(simulator, params), batch.inputs(simulator), params, batch.steps)
    assert torch.allclose(gap, kept.gap[..., 1], atol=2e-2)


def test_the_closed_loop_lowers_the_error_that_it_follows(data, tmp_path):
    torch.manual_seed(0)
    a = arguments(data, tmp_path)
    training, _ = imitation.split(a)
    batch = Batch.stack(windows(training, 20.0), dtype=torch.float32, substeps=1)
    policy = imitation.cloned(a, training)
    optimiser = torch.optim.Adam(policy.parameters(), lr=3e-3)
    losses = []
    for update in range(5):
        loss = imitation.spacing_error(imitation.simulate(policy, batch, FOLLOW)[0], batch).mean()
        common.descend(loss, policy.parameters(), optimiser, 1.0, update, a.out)
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]


def test_the_table_and_resuming(data, tmp_path):
    a = arguments(data, tmp_path)
    first = imitation.train(a)
    assert [r["model"].split()[0] for r in first] == ["IDM,", "behaviour", "cloning"]
    assert all(r["episodes"] == 1 and r["gap_rmse_m"] > 0.0 for r in first)
    policy, content = common.load(a.out / "last.pt", "follow", "imitation")
    assert content["training"]["update"] == 3
    # The saved policy drives in task follow.
    env = environments.make_env(content["environment"], 2, output="torch")
    assert env.action_space.contains(policy.predict(env.reset(seed=0)[0])[0])
    part = dataclasses.replace(a, out=tmp_path / "part")
    imitation.train(dataclasses.replace(part, cpu_seconds=1e-9))
    assert common.load(part.out / "last.pt")[1]["training"]["update"] == 0
    resumed = imitation.train(dataclasses.replace(part, resume=True))
    assert resumed[-1]["gap_rmse_m"] == pytest.approx(first[-1]["gap_rmse_m"], rel=1e-5)


def test_missing_data_are_told(tmp_path):
    with pytest.raises(ValueError, match=r"is not a file\. Give a trajectory file with --data"):
        imitation.train(arguments(tmp_path / "none.parquet", tmp_path))


def test_measured_pairs_are_split_as_published_and_can_be_driven(measured, tmp_path):
    a = imitation.Arguments(data=measured("ngsim_i80_pairs.parquet"), out=tmp_path, cloning_steps=300)
    training, test = imitation.split(a)
    assert (len(training), len(test)) == (100, 20)
    torch.manual_seed(0)
    found = imitation.judge(imitation.cloned(a, training), test, FOLLOW)
    assert found["episodes"] == 20 and 1.0 < found["gap_rmse_m"] < 20.0


@pytest.mark.parametrize("way_out", [None, KeyboardInterrupt, OSError])
def test_the_log_is_closed_on_every_way_out(way_out, data, tmp_path, loggers, monkeypatch):
    def fail(*given: object) -> None:
        raise way_out

    if way_out is not None:
        monkeypatch.setattr(common, "save", fail)
    with pytest.raises(way_out) if way_out else contextlib.nullcontext():
        imitation.train(arguments(data, tmp_path))
    assert len(loggers) == 1
    assert all(part.file.closed for part in loggers[0].output_formats)
