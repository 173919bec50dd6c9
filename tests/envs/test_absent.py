"""An agent whose vehicle waits or has left is absent: in what it sees, is told and gets, and in the traffic itself."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import polars as pl
import pytest
import torch

import idm_env  # noqa: F401
from idm_env import IDM, Brakes, Lane, Simulator, backends
from idm_env.effects import Control
from idm_env.types import Command

ROADS: dict[str, dict[str, Any]] = {
    "has left": {"task": "open_highway", "length": 200.0, "vehicles": 30, "controlled": [0, 9], "inflow": 2000.0},
    "waits": {"task": "open_highway", "controlled": [40, 79]},
    "waits at a ramp": {"task": "merge", "controlled": [60, 79], "failsafe": 3.0},
    "waits at a bottleneck": {"task": "bottleneck", "controlled": [60, 79], "lane_commands": True},
    "has left a record": {"task": "replay", "controlled": ["b", "c"]},
    "has left another record": {"task": "replay", "controlled": ["b", "c"], "reward": "source"},
    "has left recorded lanes": {"task": "replay_lanes", "controlled": ["b", "c"], "reward": "source"},
}


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three vehicles on a lane, the last of which is gone after three seconds, and one on another lane."""
    rows = [
        {"run_id": "r", "vehicle_id": name, "lane": 2 if name == "d" else 1, "time_s": 0.1 * t,
         "position_m": first + 1.5 * t, "speed_mps": 15.0, "length_m": 5.0}
        for name, first, steps in (("a", 100.0, 100), ("b", 60.0, 100), ("c", 20.0, 30), ("d", 0.0, 100))
        for t in range(steps)
    ]  # fmt: skip
    path = tmp_path_factory.mktemp("absent") / "record.csv"
    pl.DataFrame(rows).write_csv(path)
    return str(path)


@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("case", ROADS)
def test_an_absent_agent_sees_gets_and_changes_nothing(case: str, output: str, record: str) -> None:
    """Two episodes, in which it commands otherwise while it is absent, are the same, and all that is its own is 0."""
    choices = ROADS[case] | ({"data": record} if "record" in case else {})
    with backends.off():
        pair = [gym.make("DiffIDM-v0", output=output, dtype="float64", **choices).unwrapped for _ in range(2)]
        for env in pair:
            env.reset(seed=2)
        task, agents, absent = pair[0].task, 2, 0
        numbers = len(task.bounds.names)
        for _ in range(70 if case.startswith("has left") else 12):
            there = [task.pick(env.state.present)[0].numpy() > 0 for env in pair]  # type: ignore[attr-defined]
            told = []
            for env, push in zip(pair, (0.9, -0.7), strict=True):
                action = np.full((len(task.commands), agents), 0.05)
                action[:, ~there[0]] = push
                told.append(env.step(action.ravel() if output == "numpy" else torch.as_tensor(action.ravel())))
            state = pair[0].state  # type: ignore[attr-defined]
            gone = ~there[0] & (task.pick(state.present)[0].numpy() <= 0)
            for i in np.flatnonzero(gone):
                absent += 1
                assert not np.asarray(told[0][0]).reshape(agents, numbers)[i].any()
                for name in ("accel", "command", "failsafe"):
                    assert not told[0][-1][name][i]
                assert not state.speed[0, task.agents[i]] and not state.accel[0, task.agents[i]]
            if (gone == ~there[0]).all():  # nobody has just entered, and heard his command
                one, other = ([np.asarray(x) for x in (*t[:4], t[4]["accel"], t[4]["command"])] for t in told)
                for x, y in zip(one, other, strict=True):
                    np.testing.assert_array_equal(x, y)
            else:
                break
            if told[0][2] or told[0][3]:
                break
        assert absent > 5


def test_who_is_not_there_stands_still_whatever_he_is_commanded() -> None:
    """In a step and, to the last bits of it, in what runs instead of it; his state is none of the others' either."""
    simulator = Simulator(Lane(), (IDM(), Control(), Brakes()))
    params = simulator.defaults(dtype=torch.float64)
    position = torch.tensor([[90.0, 60.0, 30.0, 0.0]], dtype=torch.float64)
    present = torch.tensor([[1.0, 1.0, 0.0, 1.0]], dtype=torch.float64)
    start = simulator.state(position, torch.full_like(position, 12.0), params, present=present)
    command = Command(
        torch.full((50, 1, 1), 2.0, dtype=torch.float64), torch.tensor([[[False, False, True, False]]]).expand(50, 1, 4)
    )
    fast = simulator.rollout(start, {"control": command}, params, 50)[0]
    with backends.off():
        slow = simulator.rollout(start, {"control": command}, params, 50)[0]
    for end in (fast, slow):
        assert end.position[0, 2] == 30.0 and end.speed[0, 2] == 0.0 and end.accel[0, 2] == 0.0
        assert end.position[0, 3] > 40.0 and end.gap[0, 3] > 9e3
    torch.testing.assert_close(fast.position, slow.position)
