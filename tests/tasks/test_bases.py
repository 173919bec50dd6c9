"""Tasks run with any car-following law, named beside the task's own effects in the place of IDM."""

from __future__ import annotations

import pytest
import torch

from idm_env.tasks import Draw, make_task


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("ring", "gipps"),
        ("platoon", "constant_time_gap"),
        ("follow", "fvdm"),
        ("replay", "iidm"),
        ("follow", "idm_plus"),
    ],
)
def test_a_task_takes_another_law(name: str, law: str) -> None:
    """It starts, drives on without an agent, and nobody crashes within ten seconds."""
    task = make_task(name, effects=[law], noise=0.0)
    assert task.simulator.base.name == law
    params = task.params(torch.float64, "cpu")
    world = task.reset(Draw.of(torch.arange(2), torch.zeros(2, dtype=torch.int64)), params)
    with torch.no_grad():
        for _ in range(100):
            world = task.step(world, None, None, params)
    assert torch.isfinite(world.state.position).all() and (world.state.gap[world.state.gap < 9e3] > 0).all()
    assert world.state.speed.max() > 0.5
