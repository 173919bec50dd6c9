"""Every task runs with every car-following law, named beside the task's own effects or by a file of drivers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401 (registers the environments)
from idm_env import backends
from idm_env.effects import BASES, Brakes, Mobil, base_named
from idm_env.model_file import Model, save_model
from idm_env.tasks import TASKS
from idm_env.tasks.lanes import LanesTask


@pytest.fixture(scope="module")
def drivers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of two drivers of each law, who change lanes by MOBIL where there are several."""
    folder = tmp_path_factory.mktemp("drivers")
    for law in BASES:
        base = base_named(law)
        single = {f"a/{i}": {law: {"desired_speed": v}} for i, v in enumerate((27.0, 30.0))}
        for name, more in (("one", ()), ("lanes", (Mobil(),))):
            save_model(folder / f"{law}-{name}.yaml", Model((base, *more, Brakes()), {}, drivers=single))
    return folder


@pytest.mark.parametrize("how", ["effects", "drivers"])
@pytest.mark.parametrize("name", TASKS)
def test_every_task_takes_every_law(name: str, how: str, drivers: Path) -> None:
    """It starts, drives on for two decisions about lanes without an agent, and nobody crashes or stands still."""
    many = "lanes" if issubclass(TASKS[name], LanesTask) else "one"
    choices: dict[str, Any] = {"task": name, "dtype": "float64", "hold": 0.1}
    choices |= {"warmup": 0} if name == "ring" else {}
    for law in BASES:
        given = [law] if how == "effects" else str(drivers / f"{law}-{many}.yaml")
        with backends.off():
            env = gymnasium.make("DiffIDM-v0", **choices, **{how: given})
            env.reset(seed=3)
            for _ in range(12):
                _, reward, terminated, _, _ = env.step(None)
                assert np.isfinite(reward) and not terminated, law
        state, task = env.unwrapped.state, env.unwrapped.task  # type: ignore[attr-defined]
        assert task.simulator.base.name == law
        assert torch.isfinite(state.position).all() and (state.gap > 0).all() and state.speed.max() > 0.1, law


@pytest.mark.parametrize("name", ["ring", "highway"])
def test_every_law_is_compiled(name: str) -> None:
    """A task of one lane and one of several: what a task says is recorded beside its drivers, whatever their law."""
    pytest.importorskip("numba")
    choices = {"task": name, "dtype": "float64", "vehicles": 8, "length": 120.0, "controlled": 1}
    choices |= {"warmup": 0} if name == "ring" else {}
    for law in BASES:
        ours = gymnasium.make("DiffIDM-v0", **choices, effects=[law])
        with backends.off():
            theirs = gymnasium.make("DiffIDM-v0", **choices, effects=[law])
        for env in (ours, theirs):
            env.reset(seed=3)
        for step in range(12):
            told = [env.step(np.full(1, 0.3 * (-1) ** step, np.float32)) for env in (ours, theirs)]
            for mine, torchs in zip(told[0][:4], told[1][:4], strict=True):
                np.testing.assert_allclose(mine, torchs, rtol=1e-9, atol=1e-9, err_msg=law)
        compiled = [env.unwrapped.batch.values is not None for env in (ours, theirs)]  # type: ignore[attr-defined]
        assert compiled == [True, False], law


@pytest.mark.parametrize("law", BASES)
def test_lane_changes_are_judged_by_the_law_that_is_there(law: str) -> None:
    """Where only one lane is free ahead, a driver of each law wants it for what this law gains there."""
    from idm_env.multilane.incentives import lane_scene, wished
    from idm_env.roads import Lanes
    from idm_env.simulator import Simulator

    simulator = Simulator(Lanes(2), (base_named(law), Mobil(), Brakes()))
    params = simulator.defaults(dtype=torch.float64)
    position, speed = torch.tensor([40.0, 0.0], dtype=torch.float64), torch.tensor([5.0, 20.0], dtype=torch.float64)
    state = simulator.state(position, speed, params, lane=torch.tensor([0, 0]))
    view = simulator.road.view(state)
    order = view.order(None)  # type: ignore[attr-defined]
    sides = view.side(order, 1, state), view.side(order, -1, state)  # type: ignore[attr-defined]
    wish = wished(simulator, lane_scene(simulator, view, sides, state, {}, params), params)  # type: ignore[arg-type]
    alone = simulator.state(position[1:], speed[1:], params, lane=torch.tensor([0]))
    free = simulator.wanted(simulator.scene(alone, {}), params)[0]
    here = simulator.wanted(simulator.scene(state, {}), params)[0]
    torch.testing.assert_close(wish.left[1], free[0] - here[1] - params["mobil"]["threshold"])
    assert wish.left[1] > 0.1
