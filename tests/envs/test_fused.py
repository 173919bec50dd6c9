"""The fused step against the simulator's own, and rows against each other."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.tasks import Draw, make_task

pytest.importorskip("numba")
from idm_env.envs.fused import FusedStep, fits

CASES = [
    {},
    {"controlled": 3, "integration": "euler"},
    {"noise": 0.0, "vehicles": 5, "length": [40.0, 60.0]},
    {"parameters": {"idm.time_gap": [1.0 + 0.02 * i for i in range(22)]}},
]


@pytest.mark.parametrize("keywords", CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_fused_step_is_the_simulators_to_rounding(keywords, dtype):
    task = make_task("ring", **{"start": "wave", "warmup": 20, **keywords})
    assert fits(task.simulator)
    params, fused = task.params(dtype, "cpu"), FusedStep(task.simulator, dtype)
    draw = Draw.of(torch.arange(9), torch.zeros(9, dtype=torch.int64))
    world = task.reset(draw, params)
    tolerance = 1e-10 if dtype == torch.float64 else 2e-4
    for t in range(30):
        normals = draw.normals(world.state.step, 1, task.vehicles, dtype)[0] if task.noisy else None
        command = torch.full((9, len(task.agents)), 0.3 * (t % 3) - 0.3, dtype=dtype)
        inputs = task.inputs(world, command, normals)
        state, expected = fused(world.state, inputs, params), task.simulator.step(world.state, inputs, params)
        for name in ("position", "speed", "accel", "gap", "step"):
            torch.testing.assert_close(getattr(state, name), getattr(expected, name), rtol=0, atol=tolerance)
        world = world._replace(state=expected)


def test_the_fused_warmup_is_the_loop():
    task = make_task("ring", warmup=300)
    params = task.params(torch.float64, "cpu")
    draw = Draw.of(torch.arange(4), torch.zeros(4, dtype=torch.int64))
    slow, fast = task.reset(draw, params), task.reset(draw, params, FusedStep(task.simulator, torch.float64).run)
    torch.testing.assert_close(fast.state.gap, slow.state.gap, rtol=0, atol=1e-9)
    assert fast.state.step.tolist() == [0] * 4


def test_parameters_that_change_are_noticed():
    env = gym.make("DiffIDM-v0", warmup=1, noise=0.0)
    env.reset(seed=0)
    inner = env.unwrapped
    assert isinstance(inner.batch.advance, FusedStep)
    state = inner.state

    def next_speed():
        inner.batch.world = inner.batch.world._replace(state=state)
        env.step(None)
        return float(inner.state.speed[0, 5])

    before = next_speed()
    inner.params["idm"]["max_accel"].mul_(2.0)
    written = next_speed()
    inner.params["idm"]["max_accel"] = torch.tensor(0.5)
    assert len({before, written, next_speed()}) == 3


def test_it_can_be_switched_off_and_is_left_alone_where_it_does_not_fit(monkeypatch):
    def fused(**keywords):
        return isinstance(gym.make("DiffIDM-v0", warmup=1, **keywords).unwrapped.batch.advance, FusedStep)

    assert fused()
    assert not fused(output="torch")
    assert not fused(effects=["delay"])
    assert not fused(effects=[{"effect": "idm", "exponent": 3.0}])
    assert not fused(effects=[{"effect": "noise", "correlated": True}])
    assert not fused(task="follow")
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    assert not fused()


def test_numpy_and_torch_output_agree():
    envs = [gym.make("DiffIDM-v0", warmup=50, dtype="float64", output=output) for output in ("numpy", "torch")]
    seen = [env.reset(seed=4)[0] for env in envs]
    for _ in range(100):
        seen = [np.asarray(env.step(np.array([0.1]))[0]) for env in envs]
        np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-10)
