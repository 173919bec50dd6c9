"""Task ``approach``: the signal that agents see is the one that stops, platoons come, and fuel has its price."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import lane_tasks
from idm_env.effects import IDM, Brakes
from idm_env.model_file import Model, save_model
from idm_env.tasks import Draw, make_task
from idm_env.tasks.approach import LINE
from idm_env.types import Command

ROWS = 4


def rolled(seconds: int, **choices: Any) -> Any:
    """Return a task and its worlds, a second each, with nobody commanded."""
    task = make_task("approach", vehicles=60, controlled="all", **choices)
    params = task.params(torch.float64, "cpu")
    world = task.reset(Draw.of(torch.arange(ROWS), torch.zeros(ROWS, dtype=torch.int64)), params)
    idle = Command(torch.zeros((), dtype=torch.float64), torch.zeros(60, dtype=torch.bool))
    inputs = {"control": Command(*(x.expand(10, *x.shape) for x in idle))}
    worlds = [world]
    driven = task.episode_params(world.episode, params)
    for _ in range(seconds):
        state, _ = task.simulator.rollout(worlds[-1].state, inputs, driven, 10)
        worlds.append(world._replace(state=state))
    return task, worlds


def test_agents_see_the_signal_that_stops_traffic() -> None:
    """It changes when ``until`` says, at another phase in each episode; late in red nobody crosses the line."""
    task, worlds = rolled(120, observation="raw")
    names = task.bounds.names
    seen = torch.stack([task.observe(world) for world in worlds])
    there = seen[..., names.index("present")] > 0
    red, until, line = (seen[..., names.index(name)] for name in ("red", "until", "line"))
    both = there[:-1] & there[1:]
    same = both & (until[:-1] > 1.05)
    assert torch.allclose((until[:-1] - until[1:])[same], torch.ones_like(until[1:][same]), atol=1e-6)
    assert bool((red[:-1] == red[1:])[same].all())
    assert bool((red[:-1] != red[1:])[both & (until[:-1] < 0.95)].all())
    assert len(worlds[0].episode["signal_offset"][:, 0].unique()) == ROWS
    crossed = both & (line[:-1] > 0) & (line[1:] == 0)
    assert int((crossed & (red[1:] == 0)).sum()) > 20
    assert int((crossed & (red[:-1] > 0) & (until[:-1] < 22.0)).sum()) == 0


def test_a_queue_crosses_the_line_as_engineers_measure_it() -> None:
    """20 vehicles stand on each lane until it is green at 10 s: headways of front ends at the line, after the HCM.

    Saturation headway is the mean of the fifth on; start-up lost time what the first four take beyond four of these.
    """
    task = make_task("approach", vehicles=40, cycle=200.0, green=100.0)
    simulator, params = task.simulator.without("control"), task.params(torch.float64, "cpu")
    params["signal"]["offset"] = torch.tensor(10.0, dtype=torch.float64)
    place = LINE - 2.0 - 7.0 * torch.arange(20, dtype=torch.float64)  # 5 m and s0 each
    lane = torch.arange(2).repeat_interleave(20)
    state = simulator.state(place.repeat(2).unsqueeze(0), torch.zeros(1, 40).double(), params, lane=lane.unsqueeze(0),
                            present=torch.ones(1, 40).double())  # fmt: skip
    _, kept = simulator.rollout(state, {}, params, 700)
    before = kept.position[:, 0, :] < LINE
    last = before.sum(0) - 1  # row k is after step k + 1
    here, speed = (x[:, 0, :].gather(0, last.unsqueeze(0))[0] for x in (kept.position, kept.speed))
    crossed = (0.1 * (last + 1) + (LINE - here) / speed - 10.0).view(2, 20)
    headway = torch.cat((crossed[:, :1], crossed.diff(dim=-1)), -1)
    saturation = headway[:, 4:].mean(-1, keepdim=True)
    flow, lost = 3600.0 / saturation, (headway[:, :4] - saturation).sum(-1)
    assert bool(((flow > 1800.0) & (flow < 1900.0)).all()), flow
    assert bool(((lost > 1.7) & (lost < 2.4)).all()), lost
    assert float(kept.speed[:110].max()) < 0.05  # the first starts a second late


@pytest.mark.parametrize("platoon", [0.4, 1.0])
def test_vehicles_come_in_platoons(platoon: float) -> None:
    """In the first part of every cycle of the signal upstream, in later trips of a slot, too."""
    _, worlds = rolled(0, platoon=platoon)
    trips = worlds[0].state.lanes.trips
    some = trips.again.isfinite()
    assert torch.allclose(trips.again[some].remainder(60.0), torch.zeros(()).double())
    departs = (trips.departs[some] + 300.0 / 14.0).remainder(60.0)
    assert bool((departs <= 60.0 * platoon + 1e-9).all()) and float(departs.max()) > 50.0 * platoon


def test_fuel_has_its_price() -> None:
    """What a step pays is the delay of all, and each millilitre as many vehicle-seconds."""
    (cheap, worlds), (dear, _) = rolled(20, reward="delay", fuel_weight=0.0), rolled(0, reward="delay", fuel_weight=2.0)
    before, after = worlds[-2:]
    command = torch.zeros(ROWS, 60, dtype=torch.float64)
    less, more = (task.rewards(before, command, after)[:, 0] for task in (cheap, dear))
    burnt = cheap.burnt(after.state)
    assert bool((burnt > 1.0).all())
    torch.testing.assert_close(less - more, 0.1 * 2.0 * burnt)


def test_green_wave_advice_arrives_when_it_becomes_green() -> None:
    """At 10 m/s from 200 m in 20 s; who would arrive in green, is past the line or far too slow is left alone."""
    task = make_task("approach", vehicles=5, controlled="all")
    names, seen = task.bounds.names, torch.zeros(1, 5, len(task.bounds.names))
    for name, values in {
        "speed": [12.0] * 5, "present": [1.0] * 5, "line": [200.0, 200.0, 0.0, 350.0, 200.0],
        "red": [1.0, 0.0, 1.0, 1.0, 0.0], "until": [20.0, 20.0, 20.0, 20.0, 5.0],
    }.items():  # fmt: skip
        seen[0, :, names.index(name)] = torch.tensor(values) / task.scales[names.index(name)]
    action = lane_tasks.glosa(task)(seen.flatten(1))[0].tolist()
    # the last one: green ends in 5 s, and begins again in 35 s, so 200 m at 5.7 m/s
    assert action == pytest.approx([-0.5, 1.0, 1.0, 1.0, -1.0], abs=1e-5)


@pytest.mark.parametrize(
    ("choices", "says"),
    [({"green": 70.0}, "green = 70 s must not exceed the cycle of 60 s"), ({"lanes_count": 4}, "lanes_count = 4")],
    ids=str,
)
def test_what_cannot_be_is_one_line(choices: dict[str, Any], says: str) -> None:
    """The value and the rule."""
    with pytest.raises(ValueError, match=says) as error:
        make_task("approach", **choices)
    assert "\n" not in str(error.value)


def test_the_signal_stays_where_drivers_come_from_a_file(tmp_path: Path) -> None:
    """A model of drivers alone says nothing of the road: its signal is at the line, with the cycle asked for."""
    save_model(tmp_path / "model.yaml", Model((IDM(), Brakes()), {"idm": {"time_gap": 1.7}}))
    task = make_task("approach", effects=str(tmp_path / "model.yaml"), cycle=40.0, green=10.0)
    params = task.params(torch.float64, "cpu")
    expected = {"signal": {"place": 500.0, "cycle": 40.0, "red": 30.0}, "idm": {"time_gap": 1.7}}
    for effect, values in expected.items():
        for name, value in values.items():
            assert bool((params[effect][name] == value).all()), name
