"""Task ``replay_lanes``: the recording comes back as it is, and whoever is handed over meets who is on his lane."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import polars as pl
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.data import DataError
from idm_env.envs.pettingzoo import parallel_env
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.tasks import Draw, make_task
from idm_env.types import Command, Record

DT = 0.1


def driven(first: float, speed: float, accel: float, steps: range) -> list[tuple[int, float, float]]:
    """Return steps, positions and speeds of a constant acceleration from step 0 on, so many of them."""
    return [(t, first + speed * DT * t + 0.5 * accel * (DT * t) ** 2, speed + accel * DT * t) for t in steps]


@pytest.fixture
def road(tmp_path):
    """Three lanes of which lane 3, a ramp on the right, ends at 180 m: entries, exits and changes, all exact.

    a leads lane 2; b leaves lane 2 for lane 1 at step 50; c is behind b; d merges from the ramp between b and c at step
    30; e enters lane 1 at step 20 and is gone at step 90.
    """
    tracks = {
        "a": (driven(200.0, 15.0, 0.0, range(150)), lambda t: 2),
        "b": (driven(140.0, 14.0, 0.2, range(150)), lambda t: 2 if t < 50 else 1),
        "c": (driven(110.0, 14.0, 0.05, range(150)), lambda t: 2),
        "d": (driven(120.0, 15.0, 0.0, range(150)), lambda t: 3 if t < 30 else 2),
        "e": (driven(60.0, 20.0, 0.0, range(20, 90)), lambda t: 1),
    }
    rows = [
        {"run_id": "r", "vehicle_id": name, "lane": lane(t), "time_s": DT * t, "position_m": x, "speed_mps": v,
         "length_m": 5.0}
        for name, (track, lane) in tracks.items()
        for t, x, v in track
    ]  # fmt: skip
    path = tmp_path / "lanes.csv"
    pl.DataFrame(rows).write_csv(path)
    return str(path)


def started(task, count: int = 1, at: int | None = None):
    params = task.params(torch.float64, "cpu")
    if at is not None:
        task.__dict__["_starts"] = np.array([at])
    return task.reset(Draw.of(torch.arange(count), torch.zeros(count, dtype=torch.int64)), params), params


def everybody(task, first: int, steps: int) -> Record:
    """Return a record in which nobody is handed over."""
    motion, present, lane = (
        torch.as_tensor(x[first + 1 : first + steps + 1])
        for x in (task.scene.motion, task.scene.present, task.scene.lane)
    )
    place, speed, accel = (x.unsqueeze(1) for x in motion.unbind(-1))
    return Record(place, speed, accel, torch.ones_like(place) > 0, present.unsqueeze(1).double(), lane.unsqueeze(1))


def check_links(task, state, at: int) -> None:
    """Leaders, followers, gaps and lanes are those of the record at this time."""
    scene, links = task.scene, state.lanes
    place, there, lane = scene.motion[at, :, 0], scene.present[at], scene.lane[at]
    np.testing.assert_array_equal(links.lane[0].numpy()[there], lane[there])
    for i in np.flatnonzero(there):
        ahead = [j for j in np.flatnonzero(there & (lane == lane[i])) if place[j] > place[i]]
        leader = min(ahead, key=lambda j: place[j]) if ahead else i
        assert int(links.leader[0, i]) == leader
        assert leader == i or int(links.follower[0, leader]) == i
        gap = place[leader] - scene.length[leader] - place[i] if leader != i else 1e4
        assert float(state.gap[0, i]) == pytest.approx(gap, abs=1e-9)


def all_states(task, steps: int, at: int):
    """Return every state of a replay in which nobody is handed over."""
    world, params = started(task, at=at)
    record, state = everybody(task, at, steps), world.state
    none = torch.zeros_like(state.speed)
    for t in range(steps):
        now = Record(*(x[t] for x in record))
        state = task.simulator.step(
            state, {"replay": now, "lane_command": none, "control": Command(none, none > 0)}, params
        )
        yield at + t + 1, state


def test_with_nobody_handed_over_the_file_comes_back(road):
    task = make_task("replay_lanes", data=road, controlled=["c"])
    table = pl.read_csv(road)
    for at, state in all_states(task, 140, 0):
        rows = table.filter((pl.col("time_s") - DT * at).abs() < 1e-6)
        assert sorted(np.array(task.scene.ids)[(state.present[0] > 0).numpy()]) == [
            f"r/{x}" for x in sorted(rows["vehicle_id"])
        ]
        for row in rows.iter_rows(named=True):
            slot = task.scene.ids.index(f"r/{row['vehicle_id']}")
            assert float(state.position[0, slot]) == pytest.approx(row["position_m"], abs=1e-6)
            assert float(state.speed[0, slot]) == pytest.approx(row["speed_mps"], abs=1e-6)
            assert int(state.lanes.lane[0, slot]) == 3 - row["lane"]
        check_links(task, state, at)
    changed = dict(zip(task.scene.ids, state.lanes.changed[0].tolist(), strict=True))
    assert changed == {"r/a": 0, "r/b": 1, "r/c": 0, "r/d": 1, "r/e": 0}


@pytest.mark.parametrize("vehicle", ["b", "c"])
def test_whoever_drives_as_recorded_stays_on_the_record(road, vehicle):
    """Through a change of its own and those in front of it."""
    task = make_task("replay_lanes", data=road, controlled=[vehicle], max_command=9.0)
    world, params = started(task, at=0)
    (own,) = task.agents
    speed = torch.as_tensor(task.scene.motion[:, own, 1])
    for t in range(140):
        world = task.step(world, ((speed[t + 1] - speed[t]) / DT).view(1, 1), None, params)
        assert float(task.distance(world)) < 1e-3
        assert not task.crashed(world).any()
        assert int(world.state.lanes.lane[0, own]) == task.scene.lane[t + 1, own]


def test_the_leader_is_whoever_is_ahead_on_the_lane_now(road):
    """c stands still; d, who merges in front of it, is its leader from then on, at the gap that positions say."""
    task = make_task("replay_lanes", data=road, controlled=["c"], max_command=9.0, reward="source")
    world, params = started(task, at=0)
    ids, (own,) = task.scene.ids, task.agents
    for t in range(1, 61):
        world = task.step(world, torch.full((1, 1), -9.0, dtype=torch.float64), None, params)
        state = world.state
        leader = int(state.lanes.leader[0, own])
        assert ids[leader] == ("r/b" if t < 30 else "r/d")
        gap = float(state.position[0, leader] - 5.0 - state.position[0, own])
        assert float(state.gap[0, own]) == pytest.approx(gap, abs=1e-9)
        seen = dict(zip(task.bounds.names, task.observe(world)[0, 0].tolist(), strict=True))
        assert 100.0 * seen["gap"] == pytest.approx(gap, abs=1e-9)
        assert 20.0 * seen["lead_speed"] == pytest.approx(float(state.speed[0, leader]), abs=1e-9)


@pytest.mark.parametrize(("vehicle", "action", "words"), [
    ("c", 1.0, r"vehicle r/c \(an agent\) touched vehicle r/(b|d)"),
    ("b", -1.0, r"vehicle r/c touched vehicle r/b \(an agent\)"),
])  # fmt: skip
def test_a_collision_is_reported(road, vehicle, action, words):
    """With the leader, and with a recorded vehicle from behind that does not react."""
    env = gym.make("DiffIDM-v0", task="replay_lanes", data=road, controlled=[vehicle], max_command=6.0)
    env.reset(seed=1)
    for _ in range(145):
        _, reward, terminated, truncated, info = env.step(np.full(1, action, np.float32))
        if terminated or truncated:
            break
    assert terminated
    assert reward == 0.0
    assert pl.Series([info["crash_reason"]]).str.contains(words)[0], info["crash_reason"]


def test_drivers_and_agents_may_change_lanes_themselves():
    """Nobody but those handed over leaves his record."""
    for choices in (
        {"lane_changes": "drivers", "model": "all", "spread": 0.4},
        {"lane_commands": True, "controlled": 3},
    ):
        task = make_task("replay_lanes", max_command=3.0, **choices)
        world, params = started(task, count=3)
        count, own = len(task.agents), torch.as_tensor(task._simulated)
        generator = torch.Generator().manual_seed(2)
        with torch.no_grad():
            for _ in range(150):
                lane = 2.0 * torch.rand((3, count), generator=generator, dtype=torch.float64) - 1.0
                action = torch.cat((torch.zeros_like(lane), lane), -1) if task.lane_commands else None
                command = None if action is None else task.command(action)
                inputs = task.with_lane_commands(task.inputs(world, command, None), action)
                world = world._replace(state=task.simulator.step(world.state, inputs, params))
        at = (world.episode["start"] + 150).numpy()
        lanes = world.state.lanes.lane.numpy()
        place = world.state.position.numpy()
        recorded = ~own.numpy()
        np.testing.assert_array_equal(lanes[:, recorded], task.scene.lane[at][:, recorded])
        np.testing.assert_allclose(place[:, recorded], task.scene.motion[at][:, recorded, 0], atol=1e-9)
        assert (world.state.lanes.changed[:, own] > 0).any()
        assert (lanes[:, ~recorded] != task.scene.lane[at][:, ~recorded]).any()


def test_faces_replay_the_same(road):
    choices = {"task": "replay_lanes", "data": road, "controlled": ["b", "c"]}
    single = gym.make("DiffIDM-v0", **choices)
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, **choices)
    each = parallel_env(**choices)
    one, _ = single.reset(seed=4)
    many, _ = vector.reset(seed=[4, 9])
    own, _ = each.reset(seed=4)
    action = np.array([0.05, -0.05], np.float32)
    for _ in range(60):
        np.testing.assert_array_equal(one, many[0])
        np.testing.assert_array_equal(one, np.stack([own[agent] for agent in each.possible_agents]).reshape(one.shape))
        one, reward, *_ = single.step(action)
        many, rewards, *_ = vector.step(np.stack([action, action]))
        own, earned, *_ = each.step({agent: action[i : i + 1] for i, agent in enumerate(each.possible_agents)})
        assert reward == pytest.approx(float(rewards[0]))
        assert reward == pytest.approx(np.mean(list(earned.values())))


def test_gradients_are_finite_differences(road):
    """Behind leaders who change lanes."""
    task = make_task("replay_lanes", data=road, controlled=["c"], reward="source")
    world, params = started(task, at=10)

    def total(push):
        now, rewards = world, []
        for _ in range(60):
            after = task.step(now, push.view(1, 1), None, params)
            rewards.append(task.rewards(now, push.view(1, 1), after) + 0.01 * task.pick(after.state.gap))
            now = after
        return torch.stack(rewards).sum()

    push = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(total(push), push)
    expected = (total(push.detach() + 1e-5) - total(push.detach() - 1e-5)) / 2e-5
    torch.testing.assert_close(slope, expected, rtol=1e-6, atol=1e-8)


def test_lanes_may_be_counted_from_either_side(road):
    left, right = (make_task("replay_lanes", data=road, first_lane=side).scene for side in ("left", "right"))
    np.testing.assert_array_equal(left.lane, 2 - right.lane)
    assert left.ids == right.ids


def test_bad_choices_are_one_line(road, tmp_path):
    table = pl.read_csv(road)
    two, none = tmp_path / "two.csv", tmp_path / "none.csv"
    pl.concat([table, table.with_columns(run_id=pl.lit("q"))]).write_csv(two)
    pair = table.filter(pl.col("vehicle_id").is_in(["a", "c"])).drop("lane")
    pair.with_columns(leader_id=pl.when(pl.col("vehicle_id") == "c").then(pl.lit("a"))).write_csv(none)
    assert make_task("replay_lanes", data=str(two), runs=["q"]).scene.ids[0] == "q/a"
    partly, half = tmp_path / "partly.csv", tmp_path / "half.csv"
    here = (pl.col("vehicle_id") == "c") & pl.col("time_s").is_between(1.0, 2.0)
    table.with_columns(lane=pl.when(~here).then("lane")).write_csv(partly)
    table.with_columns(lane=pl.when(here).then(1.5).otherwise("lane")).write_csv(half)
    for error, choices, words in (
        (DataError, {"data": str(two)}, r"2 runs.*Name one: runs=\['q'\]"),
        (DataError, {"data": str(none)}, "no vehicle has a lane"),
        (
            DataError,
            {"data": str(partly)},
            r"partly\.csv: vehicle r/c has no lane in 1\d rows, first 1 s after",
        ),
        (DataError, {"data": str(half)}, r"half\.csv: lane = 1\.5 in row \d+ is between two lanes"),
        (ValueError, {"data": road, "lane_changes": "driver"}, "Did you mean 'drivers'"),
        (ValueError, {"data": road, "first_lane": "middle"}, "first_lane"),
        (ValueError, {"data": str(two), "runs": ["q", "r"]}, "must name one run"),
        (ValueError, {"data": road, "seen": 0}, "seen = 0"),
    ):
        with pytest.raises(error, match=words) as told:
            make_task("replay_lanes", **choices)
        assert "\n" not in str(told.value)


def test_a_road_of_one_lane_takes_no_lanes():
    from idm_env.effects import IDM, Replay

    simulator = Simulator(Lane(), (IDM(), Replay()))
    params = simulator.defaults(dtype=torch.float64)
    one = torch.tensor([30.0, 0.0], dtype=torch.float64)
    state = simulator.state(one, 0 * one, params)
    record = Record(one, one, one, one > 9.0, None, torch.tensor([0, 0]))
    with pytest.raises(ValueError, match="Lane has one lane"):
        simulator.step(state, {"replay": record}, params)


def test_the_whole_i75_recording(measured):
    """88 vehicles, 51 changes: lanes as in the file, positions as the smoother leaves them (at most 0.12 m)."""
    path = str(measured("highsim_i75_lanes.parquet"))
    task = make_task("replay_lanes", data=path)
    assert len(task.scene.ids) == 88 and task.road.count == 4
    table = pl.read_parquet(path)
    last = None
    for at, state in all_states(task, 799, 0):
        if at % 47 == 0:
            check_links(task, state, at)
            rows = table.filter((pl.col("time_s") - table["time_s"].min() - DT * at).abs() < 1e-3)
            slots = [task.scene.ids.index(f"i75/{v}") for v in rows["vehicle_id"]]
            np.testing.assert_array_equal(state.lanes.lane[0, slots].numpy(), 4 - rows["lane"].to_numpy())
            np.testing.assert_allclose(state.position[0, slots].numpy(), rows["position_m"].to_numpy(), atol=0.12)
        last = state
    assert int(last.lanes.changed.sum()) == 51
