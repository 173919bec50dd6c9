"""Stepping in place gives what rollouts give."""

import pytest
import torch

from idm_env.effects import IDM, Brakes, Control, Drag, Noise
from idm_env.kernels.fleet import Fleet, rings_step
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.types import Command


def start(road, dtype, rows=700, size=22):
    simulator = Simulator(road, (IDM(), Brakes(), Control(), Noise()))
    params = simulator.defaults(dtype=dtype)
    params["idm"]["time_gap"] = 0.8 + torch.rand(size, dtype=dtype)
    speed = 10 * torch.rand(rows, size, dtype=dtype)
    position = -torch.arange(size, dtype=dtype).expand(rows, size) * 11.0
    around = {"circumference": 11.0 * size} if isinstance(road, Ring) else {}
    return simulator, simulator.state(position, speed, params, **around), params


@pytest.mark.parametrize("road", [Lane(), Ring()])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("threads", [1, 2])
def test_steps_in_place_are_rollouts(road, dtype, threads):
    torch.manual_seed(0)
    simulator, state, params = start(road, dtype)
    fleet = Fleet(simulator, state, params)
    active = torch.arange(22) == 0
    inputs = {
        "control": Command(torch.randn(9, 700, 1, dtype=dtype), active.expand(9, 1, 22)),
        "noise": torch.randn(9, 700, 22, dtype=dtype),
    }
    rings_step(fleet, 8, inputs, threads=threads)
    rings_step(fleet, 1, {"control": Command(*(x[8:] for x in inputs["control"])), "noise": inputs["noise"][8:]})
    last, _ = simulator.rollout(state, inputs, params, 9)
    for name in ("gap", "speed", "position", "accel"):
        assert torch.equal(getattr(fleet.state(), name), getattr(last, name))
    assert int(fleet.state().step) == 9


def test_without_inputs_everybody_drives():
    simulator, state, params = start(Ring(), torch.float64, rows=3)
    fleet = Fleet(simulator, state, params)
    rings_step(fleet, 5)
    alone = simulator.without("control", "noise")
    last, _ = alone.rollout(state, {}, params, 5)
    assert torch.equal(fleet.state().speed, last.speed)
    fleet.speed[1] = 0.0
    rings_step(fleet)
    assert fleet.speed[1].max() < fleet.speed[0].max()


def test_errors_name_the_cure():
    simulator, state, params = start(Ring(), torch.float64, rows=3)
    with pytest.raises(ValueError, match=r"effect 'drag' has no kernel.*Use simulator.step"):
        Fleet(simulator.adding(Drag()), state, params)
    _, long, _ = start(Lane(), torch.float32, rows=1, size=1100)
    with pytest.raises(ValueError, match=r"Use simulator.rollout"):
        Fleet(simulator, long, params)
