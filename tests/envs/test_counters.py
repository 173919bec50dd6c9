"""Stops and detectors, beside a count by hand from the positions of all vehicles at every step."""

from __future__ import annotations

import math
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import yaml

from idm_env.envs.pettingzoo import parallel_env
from idm_env.tasks import make_task

LOOPS = [
    {"lane": 1, "place": 250.0, "every": 5.0},
    {"lane": 2, "place": 395.0, "name": "before the drop", "every": 8.0},
]
JAM = {"task": "bottleneck", "vehicles": 60, "inflow": 6000.0, "detectors": LOOPS}
STEPS = 560
uncompiled = pytest.mark.usefixtures("torch_path")


def by_hand(states):
    """Return of each interval of each detector: bumpers that passed, speeds, steps with one above."""
    intervals = {}
    for step, (before, after) in enumerate(pairwise(states)):
        for i, loop in enumerate(LOOPS):
            key = (i, int(step * 0.1 / loop["every"] + 1e-9))
            count, speeds, above = intervals.setdefault(key, (0, [], 0))
            covered = False
            for v in range(JAM["vehicles"]):
                if after.lanes.lane[0, v] != loop["lane"] or not after.present[0, v]:
                    continue
                front, place = float(after.position[0, v]), loop["place"]
                covered |= front - float(after.length[0, v]) < place <= front
                if before.present[0, v] and float(before.position[0, v]) < place <= front:
                    count, speeds = count + 1, [*speeds, float(after.speed[0, v])]
            intervals[key] = (count, speeds, above + covered)
    return intervals


def stops_of(states):
    """Return how often somebody stands who did not in the state before."""
    stops = 0
    for before, after in pairwise(states):
        for v in range(JAM["vehicles"]):
            there = (
                before.present[0, v]
                and after.present[0, v]
                and before.lanes.trips.left[0, v] == after.lanes.trips.left[0, v]
            )
            stops += bool(there and before.speed[0, v] >= 0.5 > after.speed[0, v])
    return stops


@pytest.mark.parametrize(("compiled", "output"), [(False, "torch"), (True, "numpy")])
def test_detectors_and_stops_are_a_count_by_hand(compiled, output):
    """By torch and compiled; detectors look at every 0.1 s, and stops are counted at decisions."""
    made = {**JAM, "output": output, "dtype": "float64"}
    each, held = (gym.make("DiffIDM-v0", **made, hold=hold) for hold in (0.1, 1.0))
    for env in (each, held):
        if not compiled:
            env.unwrapped.batch.values = None
        env.reset(seed=3)
    states = [each.unwrapped.state]
    for _ in range(STEPS):
        *_, info = each.step(None)
        states.append(each.unwrapped.state)
    for _ in range(STEPS // 10):
        *_, told = held.step(None)
    intervals = by_hand(states)
    assert set(info["stops"].tolist()) == {stops_of(states)}
    assert set(told["stops"].tolist()) == {stops_of(states[::10])} and stops_of(states[::10]) > 5
    names = ["lane 1 at 250 m", "before the drop"]
    for env in (each, held):
        (table,) = env.unwrapped.detectors
        assert len(table) == STEPS // 50 + STEPS // 80 and sum(row["count"] for row in table) > 10
        for row in table:
            i = names.index(row["detector"])
            count, speeds, above = intervals[i, round(row["begin"] / LOOPS[i]["every"])]
            assert row["count"] == count and row["end"] - row["begin"] == pytest.approx(LOOPS[i]["every"])
            assert row["occupancy"] == pytest.approx(above / (LOOPS[i]["every"] / 0.1))
            assert math.isnan(row["speed"]) if not count else row["speed"] == pytest.approx(np.mean(speeds))


@uncompiled
def test_every_face_tells_of_its_own_rows_and_begins_anew_with_an_episode():
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, autoreset_mode="Disabled", **JAM)
    vector.reset(seed=[3, 4])
    zoo = parallel_env(**JAM)
    zoo.reset(seed=3)
    for _ in range(10):
        vector.step(np.ones(vector.action_space.shape, np.float32))
        zoo.step({agent: np.ones(1, np.float32) for agent in zoo.agents})
    first, second = vector.unwrapped.detectors
    assert len(first) > 2 and repr(first) == repr(zoo.detectors)
    assert repr(first) != repr(second)
    vector.reset(seed=[5, None], options={"reset_mask": np.array([True, False])})
    assert vector.unwrapped.detectors[0] == [] and repr(vector.unwrapped.detectors[1]) == repr(second)


@uncompiled
def test_detectors_in_yaml_tell_what_those_in_python_do(tmp_path):
    path = tmp_path / "jam.yaml"
    path.write_text(yaml.safe_dump({"configures": "environment", **JAM}))
    told = []
    for given in ({"config": str(path)}, JAM):
        env = gym.make("DiffIDM-v0", **given)
        env.reset(seed=3)
        for _ in range(10):
            env.step(None)
        told.append(repr(env.unwrapped.detectors))
    assert told[0] == told[1] and "before the drop" in told[0]


@uncompiled
@pytest.mark.parametrize("asked", ["none", "co2", ("stops", "co2")])
def test_nothing_is_counted_where_nobody_asks(asked):
    env = gym.make("DiffIDM-v0", task="merge", vehicles=12, info=asked).unwrapped
    env.reset(seed=1)
    told = env.step(None)[4]
    assert (env.batch.counters is None) == ("stops" not in asked) and ("stops" in told) == ("stops" in asked)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"lane": 4, "place": 10.0}, r"detectors\[0\].lane = 4 does not exist: this road has lanes 0 to 3"),
        ({"place": 10.0}, "must give lane and place"),
        ({"lane": 1, "place": 900.0}, r"detectors\[0\].place = 900"),
        ({"lane": 1, "place": 10.0, "every": 0.25}, r"detectors\[0\].every = 0.25 s must be whole steps of 0.1 s"),
        ({"lane": 1, "at": 10.0}, "'at'"),
    ],
)
def test_a_detector_that_cannot_be_is_one_line(wrong, says):
    with pytest.raises(ValueError, match=says) as told:
        make_task("bottleneck", detectors=[wrong])
    assert "\n" not in str(told.value)
