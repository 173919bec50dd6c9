"""No episode of any task begins with vehicles inside one another, or beyond the end of their lane."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from idm_env.effects import IDM, Brakes, Delay
from idm_env.model_file import Model, save_model
from idm_env.multilane import demand
from idm_env.tasks import Draw, make_task
from idm_env.tasks.open_lanes import OpenLanesTask

OPEN = ("approach", "bottleneck", "merge", "open_highway")
ROWS = 6


def bus(length: float) -> dict[str, Any]:
    """Return keywords by which every fifth vehicle is so long (m)."""
    return {"classes": {"bus": {"share": 0.2, "length": length}}}


DENSE: list[dict[str, Any]] = [
    {"inflow": 2000.0, **bus(18.0)}, {"inflow": 4400.0, **bus(18.75)}, {"inflow": 6000.0}, {"inflow": 8000.0},
    {"vehicle_length": 40.0}, {"entry_speed": 3.0}, {"entry_speed": 40.0, "inflow": 5000.0},
    {"parameters": {"idm.min_gap": 8.0, "idm.time_gap": 3.0}}, {"randomise": {"idm.time_gap": [0.5, 3.0]}},
    {"vehicles": 8}, {"closures": [{"lane": 0, "begin": 150.0, "end": 200.0}]},
]  # fmt: skip
CASES = [(name, given) for name in OPEN for given in DENSE] + [
    ("approach", {"platoon": 0.1}), ("approach", {"lanes_count": 1, "inflow": 1800.0}),
    ("merge", {"ramp_inflow": 3000.0}), ("open_highway", {"on_ramp": [100.0, 200.0]}),
    ("open_highway", {"on_ramp": [100.0, 200.0], "off_ramp": [300.0, 380.0]}),
    ("highway", {"vehicles": 330, "warmup": 0}), ("highway", {"vehicle_length": 94.0, "warmup": 0}),
    ("ring", {"vehicles": 40, "warmup": 0}), ("ring", {"vehicles": 40, "start": "wave", "warmup": 0}),
    ("platoon", {"vehicle_length": 30.0}), ("follow", {"vehicle_length": 30.0}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "given"), CASES, ids=str)
def test_nobody_begins_inside_somebody_else(name: str, given: dict[str, Any]) -> None:
    """By links and by places: gaps above 0, nobody over the end of a lane, everybody inside, left or queued."""
    task = make_task(name, **given)
    draw = Draw.of(torch.arange(ROWS), torch.zeros(ROWS, dtype=torch.int64))
    state = task.reset(draw, task.params(torch.float64, "cpu")).state
    there = torch.ones_like(state.gap) > 0 if state.present is None else state.present > 0
    assert float(torch.where(there, state.gap, math.inf).min()) > 0.0
    if not isinstance(task, OpenLanesTask):
        return
    assert state.lanes is not None and not bool(task._over(state).any())
    assert not bool((there & (state.lanes.lane == 0) & (state.position > 150.0)).any() and "closures" in given)
    for row in range(ROWS):
        for lane in range(task.road.count):
            mine = there[row] & (state.lanes.lane[row] == lane)
            place, order = state.position[row][mine].sort()
            assert bool((place[1:] - state.length.expand_as(state.gap)[row][mine][order][1:] > place[:-1]).all())
    found = demand.counts(task.simulator, state)
    assert torch.equal(found.due, found.inside + found.left + found.queued) and bool((found.queued >= 0).all())


def test_drivers_who_collide_in_the_warm_up_begin_without_it(tmp_path: Path) -> None:
    """Measured drivers who react late: those rows begin as the ring does without warm-up, told once in words."""
    single = {f"a/{i}": {"idm": {"time_gap": 0.4 + 0.9 * i}} for i in range(2)}
    late = Model((IDM(), Delay(), Brakes()), {"idm": {"max_accel": 3.0}, "delay": {"delay": 1.0}}, drivers=single)
    save_model(tmp_path / "model.yaml", late)
    given = {"vehicles": 8, "length": 90.0, "drivers": str(tmp_path / "model.yaml")}
    draw = Draw.of(torch.arange(12), torch.zeros(12, dtype=torch.int64))
    task, without = make_task("ring", **given), make_task("ring", **given, warmup=0)
    params = task.params(torch.float64, "cpu")
    with pytest.warns(UserWarning, match=r"ran into each other in its warm-up of 1500 steps: .* or warmup=0"):
        world = task.reset(draw, params)
    plain = without.reset(draw, params)
    assert bool((world.state.gap > 0).all()) and bool((world.state.step == 0).all())
    same = (world.state.position == plain.state.position).all(-1)
    assert 0 < int(same.sum()) < 12
