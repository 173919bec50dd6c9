"""Tasks behind records: the leader is where the record says, episodes end with it, and rewards are what is written."""

import math

import gymnasium as gym
import numpy as np
import polars as pl
import pytest
import torch

import idm_env  # noqa: F401
from idm_env import metrics
from idm_env.tasks import Draw, make_task
from idm_env.tasks.recorded import made_up_leader


def start(task, count=2):
    params = task.params(torch.float64, "cpu")
    return task.reset(Draw.of(torch.arange(count), torch.zeros(count, dtype=torch.int64)), params), params


def roll(task, steps, count=2):
    world, params = start(task, count)
    worlds = [world]
    with torch.no_grad():
        for _ in range(steps):
            worlds.append(task.step(worlds[-1], None, None, params))
    return worlds


def test_the_made_up_leader_drives_like_a_car():
    motion = made_up_leader(0.1).motion[0]
    assert motion[:, 1].min() >= 0.0
    assert motion[:, 1].max() < 32.0
    assert motion[:, 1].min() < 3.0
    assert abs(motion[:, 2]).max() < 2.5
    np.testing.assert_allclose(np.diff(motion[:, 0]), 0.05 * (motion[1:, 1] + motion[:-1, 1]), atol=1e-2)


def test_follow_replays_its_leader_from_a_drawn_start():
    task = make_task("follow")
    worlds = roll(task, 50)
    motion = torch.as_tensor(task.leaders.motion[0])
    first = worlds[0].episode["start"]
    assert int(first[0]) != int(first[1])
    for i, world in enumerate(worlds):
        torch.testing.assert_close(world.state.position[:, 0], motion[first + i, 0])
        torch.testing.assert_close(world.state.speed[:, 0], motion[first + i, 1])
    # Everybody begins in equilibrium: nobody has to accelerate beyond what the leader does.
    assert float(worlds[1].state.accel[:, 1:].abs().max()) < 0.3


@pytest.mark.parametrize(
    ("weight", "lag", "accel"), [(0.1, 0.0, 0.7), (0.7, 0.0, 0.7), (0.1, 0.3, 0.7), (0.1, 0.3, -0.7)]
)
def test_follow_rewards_what_is_written(weight, lag, accel):
    keywords = {**({} if weight == 0.1 else {"fuel_weight": weight}), **({"lag_weight": lag} if lag else {})}
    task = make_task("follow", vehicles=3, reward="source", **keywords)
    world, params = start(task, 1)
    command = torch.tensor([[accel]], dtype=torch.float64)
    after = task.step(world, command, None, params)
    fuel = 0.951 * metrics.fuel(after.state.speed, after.state.accel)[0, 1:].mean()
    gap, speed = float(after.state.gap[0, 1]), float(after.state.speed[0, 1])
    assert gap > 7.0
    short = min(max((1.0 - gap / speed) / 0.2, 0.0), 1.0)
    slower = float(after.state.speed[0, 0]) - speed
    assert slower * accel < 0.0  # it starts as fast as its leader
    expected = 1.0 - weight * float(fuel) - 0.002 * 0.49 - 2.0 * short - lag * slower
    assert float(task.rewards(world, command, after)) == pytest.approx(expected)


@pytest.mark.parametrize("task", ["follow", "platoon", "replay"])
def test_shorter_defaults_truncate_themselves(task):
    horizon = {"follow": 1000, "platoon": 3000, "replay": 300}[task]
    assert make_task(task).horizon == horizon
    env = gym.make("DiffIDM-v0", task=task, max_episode_steps=4)
    env.reset(seed=0)
    assert [env.step(None)[3] for _ in range(4)] == [False, False, False, True]


def test_platoons_clock_is_as_precise_as_its_dtype():
    # An integer times dt is float32 whatever comes after: 2.8e-5 m after 600 steps.
    task = make_task("platoon", vehicles=3)
    waves = torch.tensor([[[0.11, 0.13, 0.15], [0.1, 2.0, 4.0], [1.0, 1.2, 0.8]]], dtype=torch.float64)
    position, speed, _ = task._motion({"waves": waves}, torch.tensor([601]), torch.float64)[0].tolist()
    t, moved, now = 60.1, 0.0, 0.0
    for w, phi, a in waves[0].T.tolist():
        moved += a * ((math.sin(w * t + phi) - math.sin(phi)) / w - math.cos(phi) * 10.0 * (1.0 - math.exp(-0.1 * t)))
        now += a * (math.cos(w * t + phi) - math.cos(phi) * math.exp(-0.1 * t))
    assert position == pytest.approx(10.0 * t + moved, abs=1e-11)
    assert speed == pytest.approx(10.0 + now, abs=1e-12)


def test_platoon_amplifies_towards_its_end_and_starts_at_rest_with_its_head():
    task = make_task("platoon")
    worlds = roll(task, 1500, count=8)
    speed = torch.stack([world.state.speed for world in worlds])
    torch.testing.assert_close(speed[0], torch.full_like(speed[0], 10.0))
    gain = metrics.amplification(speed).mean(0)
    assert float(gain[-1]) > 1.1
    assert bool((gain.diff() > 0).all())
    motion = torch.stack([world.state.position[:, 0] for world in worlds])
    torch.testing.assert_close(motion.diff(dim=0), 0.05 * (speed[1:, :, 0] + speed[:-1, :, 0]), rtol=0, atol=2e-4)
    assert float((speed[..., 0] - 10.0).abs().max()) <= 6.0


def test_replay_stays_on_the_record_but_for_those_handed_over():
    task = make_task("replay", model=["3"], reward="imitation")
    worlds = roll(task, 40, count=1)
    record = torch.as_tensor(task.scene.motion)[int(worlds[0].episode["start"]) + 40]
    off = (worlds[-1].state.position[0] - record[:, 0]).abs()
    handed = sorted({*task.agents, 3})
    assert all(float(off[i]) > 1e-3 for i in handed)
    assert all(float(off[i]) < 1e-9 for i in range(7) if i not in handed)
    distance = task.distance(worlds[-1])
    torch.testing.assert_close(distance[0, 0], off[task.agents[0]])
    none = torch.zeros(1, 1, dtype=torch.float64)
    torch.testing.assert_close(task.rewards(worlds[-2], none, worlds[-1]), -0.1 * distance)


@pytest.fixture
def recording(tmp_path):
    """Three vehicles: b follows a and leaves the road early; c follows b, then a."""
    rows = []
    for vehicle, first, gap, last in (("a", 0, 0.0, 200), ("b", 0, 25.0, 120), ("c", 20, 50.0, 200)):
        for t in range(first, last):
            leader = {"a": None, "b": "a", "c": "b" if t < 120 else "a"}[vehicle]
            ahead = {None: None, "a": 0.0, "b": 25.0}[leader]
            rows.append(
                {
                    "run_id": "r",
                    "vehicle_id": vehicle,
                    "leader_id": leader,
                    "lane": 1,
                    "time_s": 0.1 * t,
                    "position_m": 100.0 + 10.0 * 0.1 * t - gap,
                    "speed_mps": 10.0,
                    "length_m": 5.0,
                    "gap_m": None if ahead is None else gap - ahead - 5.0,
                }
            )
    path = tmp_path / "road.csv"
    pl.DataFrame(rows, infer_schema_length=None).write_csv(path)
    return str(path)


def test_the_made_up_scene_is_simulated_once(monkeypatch):
    first = make_task("replay").scene
    monkeypatch.setattr("idm_env.simulator.Simulator.step", None)
    assert make_task("replay", controlled=2).scene is first


def test_a_file_is_replayed_with_its_gaps_and_changing_leaders(recording):
    task = make_task("replay", data=recording, controlled=["c"])
    scene = task.scene
    a, b, c = (scene.ids.index(f"r/{x}") for x in "abc")
    assert b == a + 1
    assert scene.ids[c - 1] == "—"
    assert scene.present[:, b].sum() == 120
    assert scene.led[:, c].sum() == 180
    params = task.params(torch.float64, "cpu")
    world = task.begin(Draw.of(torch.tensor([0]), torch.tensor([0])), params)
    early = int(world.episode["start"])
    assert early >= 20
    assert float(world.state.gap[0, c]) == pytest.approx(20.0 if early < 120 else 45.0, abs=0.05)


def test_agents_end_one_by_one(recording):
    from idm_env.envs.pettingzoo import parallel_env

    env = parallel_env(task="replay", data=recording, controlled=["b", "c"])
    env.reset(seed=0)
    ends = {}
    for t in range(300):
        if not env.agents:
            break
        _, _, terminated, truncated, _ = env.step({agent: np.zeros(1, np.float32) for agent in env.agents})
        for agent in terminated:
            if terminated[agent] or truncated[agent]:
                ends[agent] = (t, terminated[agent], truncated[agent])
    first, second = env.possible_agents
    assert ends[first][0] < ends[second][0]
    assert ends[first][1:] == ends[second][1:] == (False, True)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"controlled": ["z"]}, "is not recorded"),
        ({"controlled": 3}, "Control fewer"),
        ({"runs": ["q"]}, "run 'q' is not in"),
        ({"model": "some"}, "'all' or a list"),
        ({"reward": "imitations"}, "Did you mean 'imitation'"),
        ({"vehicles": 5}, "Leave it out"),
        ({"dt": 0.25}, r"no multiple of the step of run '\w+', 0.1 s. Give dt=0.1.$"),
    ],
)
def test_bad_choices_are_errors(recording, keywords, words):
    with pytest.raises(ValueError, match=words) as caught:
        make_task("replay", data=recording, **keywords)
    assert "\n" not in str(caught.value)


def test_follow_takes_a_file(recording):
    task = make_task("follow", leader=recording)
    assert task.leaders.steps.max() >= 100
    env = gym.make("DiffIDM-v0", task="follow", leader=recording)
    env.reset(seed=0)
    ends = [env.step(None)[2:4] for _ in range(int(task.leaders.steps.max()))]
    assert (False, True) in ends


def test_the_whole_i80_recording(measured):
    task = make_task("replay", data=str(measured("ngsim_i80_lanes.parquet")))
    assert len(set(task.lanes)) == 3
    assert sum(key != "—" for key in task.scene.ids) == 222
    worlds = roll(task, 20, count=1)
    state = worlds[-1].state
    at = int(worlds[0].episode["start"]) + 20
    led = torch.as_tensor(task.scene.led[at]).clone()
    led[list(task.agents)] = False
    position, length = state.position[0], state.length[0]
    gap = position.roll(1) - length.roll(1) - position
    torch.testing.assert_close(state.gap[0][led], gap[led], rtol=0, atol=1e-6)
