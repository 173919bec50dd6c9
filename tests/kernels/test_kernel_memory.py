"""The tape, measured: bytes that stay allocated between a rollout and its gradient."""

import tracemalloc

import pytest
import torch

from idm_env.compiled.kernels import dispatch, lanes
from idm_env.effects import IDM, Brakes
from idm_env.roads import Lane
from idm_env.simulator import Simulator

STEPS, ROWS, SIZE = 160, 400, 50


def held(block: int) -> float:
    """Return bytes per vehicle-step in float32, the four arrays of the last state left out."""
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    params = simulator.defaults()
    params["idm"]["time_gap"].requires_grad_()
    position = (-30.0 * torch.arange(float(SIZE))).expand(ROWS, SIZE).clone()
    state = simulator.state(position, torch.full((ROWS, SIZE), 10.0), params)
    kernel = dispatch.found(simulator, state, {}, params)
    lanes.rollout(kernel, simulator, state, {}, params, STEPS, block=block, keep=False)
    tracemalloc.start()
    last, _ = lanes.rollout(kernel, simulator, state, {}, params, STEPS, block=block, keep=False)
    bytes_now, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert last.speed.requires_grad
    return bytes_now / (STEPS * ROWS * SIZE) - 16.0 / STEPS


@pytest.mark.parametrize("block", [4, 16, 40])
def test_the_tape_is_one_state_per_block(block):
    # 8 bytes (gap, speed: all that the adjoint reads) at the end of every block but the last.
    expected = 8.0 * (STEPS // block - 1) / STEPS
    assert held(block) == pytest.approx(expected, rel=0.05, abs=0.02)


def test_by_default_it_is_less_than_a_byte():
    assert 0.3 < held(lanes.BLOCK) < 1.0
