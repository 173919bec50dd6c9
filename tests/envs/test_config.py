"""YAML: a model goes out and comes back the same, configs/ can be made, and mistakes are one line with a cure."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import yaml

import idm_env  # noqa: F401
from idm_env.effects import IDM, Brakes, Curve, Delay
from idm_env.envs.pettingzoo import parallel_env
from idm_env.envs.settings import settings
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.model_file import Model, load_environment, load_model, save_model
from idm_env.tasks import TASKS, make_task

pytestmark = pytest.mark.usefixtures("torch_path")
CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
GOOD = {"configures": "model", "effects": ["idm", "brakes"], "parameters": {"idm": {"time_gap": 1.1}}}


def write(path, content):
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return str(path)


def test_a_model_comes_back_the_same(tmp_path):
    model = Model(
        (IDM(), Brakes(), Delay(max_delay=1.0), Curve(feature="gap", knots=(0.0, 20.0))),
        {"idm": {"time_gap": 1.2}, "delay": {"delay": 0.4}, "curve_over_gap": {"knot_0": 0.3}},
        0.2,
        "euler",
        {"r/1": {"idm": {"time_gap": 0.9}}},
    )
    save_model(tmp_path / "model.yaml", model)
    assert load_model(tmp_path / "model.yaml") == model
    assert float(model.params("r/1")["idm"]["time_gap"]) == pytest.approx(0.9)
    assert float(model.params()["idm"]["time_gap"]) == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"effects": ["idm", "brakess"]}, "Did you mean 'brakes'"),
        ({"effects": ["idm", {"effect": "delay", "max_dealy": 1}]}, "Did you mean 'max_delay'"),
        ({"effects": []}, "needs effects"),
        ({"effects": "idm"}, "must be a list"),
        ({"parameters": {"idm": {"time_gab": 1.0}}}, "Did you mean 'idm.time_gap'"),
        ({"parameters": {"imd": {"time_gap": 1.0}}}, "Did you mean 'idm'"),
        ({"parameters": {"idm": {"time_gap": 50.0}}}, "outside"),
        ({"parameters": {"idm": {"time_gap": "long"}}}, "must be a number"),
        ({"parameters": {"idm": 3}}, "must be a mapping"),
        ({"drivers": {"x": {"idm": {"time_gap": 50.0}}}}, "driver 'x'"),
        ({"parameter": {}}, "Did you mean 'parameters'"),
        ({"schema": 9}, "reads schema 1"),
        ({"integration": "eulr"}, "Did you mean 'euler'"),
        ({"configures": "environment"}, "not a model"),
        ({"dt": 0}, "dt = 0 s is outside"),
        ({"dt": 100}, "dt = 100 s is outside .0, 5. s: no step is longer than a time gap"),
        ({"dt": 2}, "dt = 2 s is longer than the shortest time gap, idm.time_gap = 1.1 s"),
    ],
)
def test_mistakes_in_a_model_are_one_line(tmp_path, change, words):
    path = write(tmp_path / "model.yaml", {**GOOD, **change})
    with pytest.raises(ValueError, match=words) as caught:
        make_task("ring", effects=path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("effects: [idm, brakes]\ndt: 0.1\ndt: 0.2\n", "line 3: key 'dt' is there twice"),
        (
            "effects: [idm]\nparameters: {idm: {time_gap: 1.1, time_gap: 1.2}}\n",
            "line 2: key 'time_gap' is there twice",
        ),
        ("effects: [idm]\nparameters: {idm: {time_gap: 1.1}, idm.time_gap: 1.2}\n", "'idm.time_gap' is given twice"),
    ],
)
def test_nothing_is_given_twice(tmp_path, text, words):
    (tmp_path / "model.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=words) as caught:
        load_model(tmp_path / "model.yaml")
    assert "model.yaml" in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_no_yaml(tmp_path):
    (tmp_path / "bad.yaml").write_text("a: [1,", encoding="utf-8")
    with pytest.raises(ValueError, match="not valid YAML") as caught:
        load_model(tmp_path / "bad.yaml")
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="is not a file"):
        load_model(tmp_path / "none.yaml")


def test_a_saved_model_makes_the_environment(tmp_path):
    save_model(tmp_path / "model.yaml", Model((IDM(), Brakes(), Delay()), {"idm": {"time_gap": 1.3}}, 0.2))
    env = gym.make("DiffIDM-v0", effects=str(tmp_path / "model.yaml"), warmup=5)
    task = env.unwrapped.task
    assert task.simulator.dt == 0.2
    assert [e.name for e in task.simulator.effects] == ["idm", "brakes", "delay", "control", "noise"]
    params = env.unwrapped.params
    assert float(params["idm"]["time_gap"]) == pytest.approx(1.3)
    # What neither the file nor a keyword names is the effect's default, not the task's.
    assert float(params["idm"]["max_accel"]) == pytest.approx(1.4)
    env.reset(seed=0)
    env.step(None)


def test_keywords_win_over_the_model(tmp_path):
    save_model(tmp_path / "model.yaml", Model((IDM(), Brakes()), {"idm": {"time_gap": 1.3}}))
    task = make_task("follow", effects=str(tmp_path / "model.yaml"), parameters={"idm.time_gap": 1.6}, dt=0.2)
    assert float(task.params(torch.float64, "cpu")["idm"]["time_gap"]) == pytest.approx(1.6)
    assert task.simulator.dt == 0.2


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_shipped_file_does_what_it_says(path):
    kind = yaml.safe_load(path.read_text(encoding="utf-8"))["configures"]
    if kind == "model":
        assert load_model(path).effects
    elif kind == "environment":
        env = gym.make("DiffIDM-v0", config=str(path), **({"warmup": 3} if "warmup" in load_environment(path) else {}))
        env.reset(seed=0)
        env.step(None)


RING = next(path for path in CONFIGS if path.stem == "ring")
FACES = {
    "make": lambda **kw: gym.make("DiffIDM-v0", **kw),
    "make_vec": lambda **kw: gym.make_vec("DiffIDM-v0", num_envs=2, **kw),
    "vector": lambda **kw: DiffIDMVectorEnv(2, **kw),
    "parallel": lambda **kw: parallel_env(**kw),
}


@pytest.mark.parametrize("face", FACES)
def test_every_face_takes_a_file_and_keywords_beside_it(face):
    env = FACES[face](config=str(RING), task="ring", warmup=3, vehicles=5)
    env.reset(seed=0)
    assert env.unwrapped.task.vehicles == 5
    env.close()


@pytest.mark.parametrize(("said", "given", "steps"), [(4, None, 4), (4, 6, 6), (6, 4, 4)])
@pytest.mark.parametrize("face", FACES)
def test_a_files_limit_holds_unless_a_keyword_gives_another(face, said, given, steps, tmp_path):
    path = write(tmp_path / "short.yaml", {"configures": "environment", "task": "platoon", "max_episode_steps": said})
    name = "max_cycles" if face == "parallel" else "max_episode_steps"
    env = FACES[face](config=path, **({} if given is None else {name: given}))
    env.reset(seed=0)
    if face == "parallel":
        ends = [any(env.step({name: env.action_space(name).sample() for name in env.agents})[3].values())
                for _ in range(steps)]  # fmt: skip
    else:
        ends = [bool(np.any(env.step(env.action_space.sample() * 0.0)[3])) for _ in range(steps)]
    assert ends == [False] * (steps - 1) + [True]
    env.close()


def test_ring_yaml_is_the_default_ring():
    path = RING
    spelled, plain = (gym.make("DiffIDM-v0", warmup=20, **kw) for kw in ({"config": str(path)}, {}))
    assert (spelled.reset(seed=5)[0] == plain.reset(seed=5)[0]).all()


def test_an_environment_file_must_say_so(tmp_path):
    with pytest.raises(ValueError, match="configures: environment"):
        gym.make("DiffIDM-v0", config=write(tmp_path / "x.yaml", {"task": "ring"}))
    with pytest.raises(ValueError, match="Did you mean 'vehicles'"):
        gym.make("DiffIDM-v0", config=write(tmp_path / "y.yaml", {"configures": "environment", "vehicels": 9}))


@pytest.mark.parametrize("word", ["foobarbaz", "others", "x" * 3000, "lenght_of_ring", "trustd"])
@pytest.mark.parametrize("task", TASKS)
def test_an_unknown_keyword_is_a_short_line(task, word):
    with pytest.raises(TypeError, match="got an unexpected keyword argument") as told:
        settings(task=task, **{word: 1})
    assert len(str(told.value)) < 240 and "\n" not in str(told.value)


@pytest.mark.parametrize(
    "seed",
    [["a", "b"], "ab", 1.5, [1.5, 2], -1, [-1, 2], True, [True, 2], [[1], 2], float("nan"), [1], {}, [None, "b"]],
)
@pytest.mark.parametrize("face", FACES)
def test_a_seed_that_is_none_is_told_as_such(face, seed):
    env = FACES[face](task="ring", warmup=1)
    with pytest.raises(Exception, match=r"(?i)\bseed\b") as told:
        env.reset(seed=seed)
    assert "\n" not in str(told.value) and isinstance(told.value, (ValueError, gym.error.Error))
    env.close()
