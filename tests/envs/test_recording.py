"""A recording of an environment is a trajectory file: read back to the bit, and parameters come back from it."""

import gymnasium as gym
import numpy as np
import polars as pl
import pytest

import idm_env  # noqa: F401
from idm_env.data import load
from idm_env.envs.pettingzoo import parallel_env
from idm_env.fitting.job import fit_file
from idm_env.fitting.options import Options, Source

ROADS = [
    {"task": "ring", "warmup": 5, "hold": 0.5},
    {"task": "merge", "vehicles": 30, "controlled": 2, "inflow": 2400.0, "ramp_inflow": 500.0},
    {"task": "replay"},
    {"task": "highway", "vehicles": 6, "warmup": 5},
]


@pytest.mark.parametrize("keywords", ROADS, ids=lambda x: x["task"])
def test_a_recording_is_read_back_to_the_bit(tmp_path, keywords):
    env = gym.make("DiffIDM-v0", **keywords)
    recording = env.unwrapped.record()
    env.reset(seed=1)
    while env.unwrapped.state.step < 70:
        env.step(None)
    table, last = recording.table(), env.unwrapped.state
    for ending in ("parquet", "csv"):
        recording.write(tmp_path / f"run.{ending}")
        read = load(tmp_path / f"run.{ending}").table
        same = [x.select(table.columns).sort("vehicle_id", "time_s") for x in (read, table)]
        assert same[0].equals(same[1].filter(pl.col("vehicle_id").is_in(read["vehicle_id"].unique().implode())))
    now = table.filter(pl.col("time_s") == table["time_s"].max())
    here = np.ones(last.speed.shape[-1], bool) if last.present is None else last.present[0].numpy() > 0
    for name, x in (("position_m", last.position), ("speed_mps", last.speed)):
        assert sorted(now[name]) == sorted(x[0].double().numpy()[here])
    assert np.allclose(np.diff(np.unique(table["time_s"])), env.unwrapped.task.simulator.dt)


def test_parameters_come_back(tmp_path):
    own = {"time_gap": 1.37, "max_accel": 1.1}
    env = gym.make("DiffIDM-v0", task="follow", vehicles=3, noise=0.0, parameters={"idm": own}, max_episode_steps=500)
    recording = env.unwrapped.record()
    env.reset(seed=0)
    for _ in range(500):
        env.step(None)
    recording.write(tmp_path / "run.parquet")
    source = Source(tmp_path / "run.parquet")
    rows = fit_file(source, Options(by="all", starts=1, substeps=1), tmp_path / "fit")["parameters"]
    values = {row["parameter"].removeprefix("idm."): row["estimate"] for row in rows}
    expected = {**env.unwrapped.task.own_parameters["idm"], **own}
    assert values == {name: pytest.approx(x, rel=1e-2) for name, x in expected.items()}


def test_episodes_are_runs_and_what_drives_on_after_an_end_is_no_part_of_them():
    tight = {"vehicles": 3, "length": 20.0, "max_command": 5.0, "max_episode_steps": 20, "warmup": 5, "hold": 1.0}
    env = gym.make_vec("DiffIDM-v0", num_envs=2, **tight)
    recording, ends = env.unwrapped.record(), []
    env.reset(seed=0)
    for _ in range(4):
        terminated = env.step(np.array([[1.0], [0.0]], np.float32))[2]
        ends.append(terminated.tolist())
    assert ends[0][0] and not any(end[1] for end in ends)
    table = recording.table()
    gaps = table.group_by("run_id").agg(pl.col("gap_m").min(), pl.col("time_s").n_unique()).sort("run_id")
    assert gaps["run_id"].to_list() == ["0-0", "0-1", "0-2", "0-3", "0-4", "1-0"]
    touched = table.filter(pl.col("gap_m") <= 0.0).group_by("run_id").agg(pl.col("time_s").n_unique())
    assert set(touched["time_s"]) == {1} and gaps["time_s"].to_list()[-2:] == [1, 41]


def test_episodes_of_seeds_are_runs_of_their_own(tmp_path):
    """A new seed begins its first episode anew: the file has as many runs as there were resets, and is read."""
    env = gym.make("DiffIDM-v0", task="follow", vehicles=3)
    recording = env.unwrapped.record()
    for seed in (0, 1, 0):
        env.reset(seed=seed)
        for _ in range(10):
            env.step(None)
    recording.write(tmp_path / "run.csv")
    assert load(tmp_path / "run.csv").table["run_id"].unique().sort().to_list() == ["0-0", "0-1", "0-2"]


def test_what_cannot_be_recorded_is_told_in_one_line(tmp_path):
    env = gym.make("DiffIDM-v0", warmup=5, output="torch")
    recording = env.unwrapped.record()
    with pytest.raises(ValueError, match=r"nothing is recorded yet\. Call reset\(\) and step\(\) first\."):
        recording.table()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"'run.txt' must end in \.parquet or \.csv\."):
        recording.write("run.txt")
    with pytest.raises(ValueError, match="a window of unroll is not recorded"):
        env.unwrapped.unroll(lambda seen: 0.0 * seen[:, :1], steps=3)
    many = parallel_env(controlled=2, warmup=5)
    recording = many.record()
    many.reset(seed=0)
    many.step(None)
    assert recording.table().height == 44
