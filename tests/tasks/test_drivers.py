"""Drivers drawn from a saved model: every vehicle of every episode drives as one of them."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401 (registers the environments)
from idm_env.effects import IDM, Brakes
from idm_env.model_file import Model, save_model
from idm_env.tasks import Draw, make_task

GAPS = (0.9, 1.3, 1.7)
SPEEDS = (24.0, 28.0, 33.0)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A model of three drivers."""
    single = {
        f"a/{i}": {"idm": {"time_gap": t, "desired_speed": v}}
        for i, (t, v) in enumerate(zip(GAPS, SPEEDS, strict=True))
    }
    made = Model((IDM(), Brakes()), {"idm": {"max_accel": 1.1}}, drivers=single)
    file = tmp_path_factory.mktemp("drivers") / "model.yaml"
    save_model(file, made)
    return str(file)


def begun(name: str, path: str, count: int = 40, **more: object):
    task = make_task(name, drivers=path, **more)
    params = task.params(torch.float64, "cpu")
    seeds = torch.arange(count)
    return task, params, task.reset(Draw.of(seeds, torch.zeros_like(seeds)), params)


@pytest.mark.parametrize("name", ["ring", "follow", "platoon", "highway", "merge"])
def test_every_vehicle_has_the_parameters_of_one_driver(name: str, path: str) -> None:
    task, params, world = begun(name, path, warmup=3)
    who, made = world.episode["driver"], task.episode_params(world.episode, params)["idm"]
    assert who.shape == (40, task.vehicles) and set(who.flatten().tolist()) == {0, 1, 2}
    assert torch.equal(made["time_gap"], torch.tensor(GAPS, dtype=torch.float64)[who])
    assert torch.equal(made["desired_speed"], torch.tensor(SPEEDS, dtype=torch.float64)[who])
    assert float(made["max_accel"]) == 1.1
    draw = Draw.of(*[torch.arange(40)] * 2)
    normals = {n: x[0] for n, x in task.normals(draw, world.state.step, 1, torch.float64).items()}
    inputs = task.inputs(world, None, normals)
    after = task.step(world, None, normals, params)
    full = {**params, "idm": {**params["idm"], **{n: made[n] for n in ("time_gap", "desired_speed")}}}
    assert torch.equal(after.state.speed, task.simulator.step(world.state, inputs, full).speed)
    alike = task.simulator.step(world.state, inputs, params).speed
    assert not torch.equal(after.state.speed, alike)  # it matters who drives


def test_episodes_draw_anew_and_rows_as_single_environments_do(path: str) -> None:
    keywords = {"task": "ring", "drivers": path, "vehicles": 8, "length": 170.0, "max_episode_steps": 5}
    many = gymnasium.make_vec("DiffIDM-v0", num_envs=3, **keywords)
    alone = [gymnasium.make("DiffIDM-v0", **keywords) for _ in range(3)]
    seen = many.reset(seed=[4, 5, 6])[0]
    for i, env in enumerate(alone):
        np.testing.assert_array_equal(env.reset(seed=4 + i)[0], seen[i])
    drawn = []
    for _ in range(12):
        seen, _, _, cut, _ = many.step(np.zeros((3, 1), np.float32))
        for i, env in enumerate(alone):
            told = env.step(np.zeros(1, np.float32))
            np.testing.assert_array_equal(env.reset()[0] if told[3] else told[0], seen[i])
        if cut.all() or not drawn:
            drawn.append(many.unwrapped.batch.world.episode["driver"].clone())
    assert len(drawn) == 3 and not torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[1], drawn[2])


def test_compiled_loops_and_torch_drive_alike_also_where_single_rows_begin_anew(path: str) -> None:
    keywords = {"task": "ring", "drivers": path, "vehicles": 6, "length": [60.0, 130.0], "num_envs": 6, "warmup": 20}
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (60, 6, 1)).astype(np.float32)
    actions[:, ::2] = 1.0  # these run into their leaders
    both = []
    for output in ("numpy", "torch"):
        env = gymnasium.make_vec("DiffIDM-v0", output=output, max_command=6.0, **keywords)
        env.reset(seed=1)
        steps = [env.step(torch.as_tensor(a) if output == "torch" else a) for a in actions]
        both.append([(np.asarray(s[0].detach() if output == "torch" else s[0]), np.asarray(s[2])) for s in steps])
    ended = np.array([e for _, e in both[0]])
    assert ended.any() and not ended.all(axis=1).any()  # some rows begin anew by themselves
    for (a, e), (b, f) in zip(*both, strict=True):
        np.testing.assert_array_equal(e, f)
        np.testing.assert_allclose(a, b, atol=2e-6)


def test_what_parameters_name_is_everybodys(path: str) -> None:
    task, params, world = begun("ring", path, parameters={"idm.time_gap": 2.0})
    made = task.episode_params(world.episode, params)["idm"]
    assert float(made["time_gap"]) == 2.0 and made["desired_speed"].shape == (40, task.vehicles)


def test_what_cannot_be_drawn_is_said(path: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"drivers = .* has effects of its own"):
        make_task("ring", drivers=path, effects=["delay"])
    nobody = tmp_path / "model.yaml"
    save_model(nobody, Model((IDM(), Brakes())))
    with pytest.raises(ValueError, match=r"has no single drivers to draw\. Give a model\.yaml of `idm-env fit"):
        make_task("ring", drivers=str(nobody))
