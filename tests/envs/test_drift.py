"""Environments draw what drivers who drift need: agents train among drivers as unsteady as a saved model says."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401 (registers the environments)
from idm_env.compiled.kernels import dispatch
from idm_env.effects import IDM, AccelNoise, Brakes, PerceptionNoise, Wander
from idm_env.model_file import Model, save_model

UNSTEADY = (IDM(), Wander(), PerceptionNoise(signal="closing_speed"), AccelNoise(), Brakes())
SMALL = {"task": "ring", "vehicles": 6, "length": 120.0, "warmup": 20}


def speeds(**keywords: object) -> np.ndarray:
    """Return the observations of ten steps after a reset with one seed."""
    env = gym.make("DiffIDM-v0", **{**SMALL, **keywords})
    seen = [np.asarray(env.reset(seed=3)[0])]
    seen += [np.asarray(env.step(0.0 * env.action_space.sample())[0]) for _ in range(10)]
    return np.stack(seen)


def test_drivers_of_a_saved_model_drift_and_the_same_seed_repeats_every_bit(tmp_path) -> None:
    """The path of a model.yaml is enough; nobody has to pass normals."""
    path = tmp_path / "model.yaml"
    save_model(path, Model(UNSTEADY, {"wander": {"sigma": 0.3}, "accel_noise": {"memory_time": 1.0}}))
    once, again = speeds(effects=str(path)), speeds(effects=str(path))
    assert np.array_equal(once, again)
    steady = speeds(effects=str(path), parameters={f"{e.name}.sigma": 0.0 for e in UNSTEADY if e.draws})
    assert np.abs(once - steady).max() > 1e-3


def test_compiled_steps_draw_what_torch_steps_draw() -> None:
    """Several streams of normals beside the task's own noise, in numpy and on the torch path."""
    pytest.importorskip("numba")
    many = {"effects": UNSTEADY, "noise": 0.1, "dtype": "float64"}
    fast = speeds(**many)
    with dispatch.off():
        slow = speeds(**many)
    np.testing.assert_allclose(fast, slow, rtol=1e-6, atol=1e-7)


def test_an_episode_begins_with_drivers_as_they_are_in_the_long_run() -> None:
    """Not all of them at their mean."""
    from idm_env.tasks import Draw, make_task

    task = make_task("ring", effects=[Wander()], warmup=0)
    draw = Draw.of(torch.arange(300), torch.zeros(300, dtype=torch.int64))
    world = task.reset(draw, task.params(torch.float64, "cpu"))
    assert world.state.memory["wander"].std().item() == pytest.approx(1.0, abs=0.05)
