"""The single environment: Gymnasium's own checks, keywords, actions, pickling and the JSON of its spec."""

import functools
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env, data_equivalence

import idm_env  # noqa: F401
from idm_env.tasks import make_task

QUICK = {"warmup": 5}


def quick(**keywords):
    return gym.make("DiffIDM-v0", **{**QUICK, **keywords})


@pytest.mark.parametrize(
    "keywords",
    [
        {},
        {"controlled": 3},
        {"dtype": "float64"},
        {"warmup_pool": 4},
        {"task": "follow"},
        {"task": "platoon", "controlled": 2},
        {"task": "replay", "warmup": 0},
    ],
)
@pytest.mark.filterwarnings("error")
def test_check_env(keywords):
    check_env(quick(**keywords).unwrapped, skip_render_check=True)


def test_importing_the_package_imports_no_torch():
    code = "import sys, idm_env, gymnasium; gymnasium.spec('DiffIDM-v0'); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("make", ["make", "make_vec"])
def test_a_process_that_has_not_imported_the_package_finds_it_by_module(make):
    code = f"import sys, gymnasium; assert 'idm_env' not in sys.modules; gymnasium.{make}('idm_env:DiffIDM-v0')"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_spawned_workers_find_it_by_module():
    # A partial is pickled by names alone, so that a worker imports the package only through the module of the id.
    make = functools.partial(gym.make, "idm_env:DiffIDM-v0", **QUICK)
    near = gym.vector.SyncVectorEnv([make] * 2)
    far = gym.vector.AsyncVectorEnv([make] * 2, context="spawn")
    try:
        np.testing.assert_array_equal(near.reset(seed=0)[0], far.reset(seed=0)[0])
    finally:
        far.close()


def test_spec_survives_json_and_makes_the_same_environment():
    env = quick(
        length=[230.0, 240.0], parameters={"idm": {"time_gap": 1.2}}, effects=["drag"], autoreset_mode="SameStep"
    )
    again = EnvSpec.from_json(env.spec.to_json()).make()
    first, second = env.reset(seed=3), again.reset(seed=3)
    assert data_equivalence(first, second, exact=True)


@pytest.mark.filterwarnings("error")
def test_a_task_that_is_an_object_is_checked_and_made_again_from_its_spec():
    task = make_task("ring", warmup=5, max_episode_steps=9)
    env, vector = gym.make("DiffIDM-v0", task=task), gym.make_vec("DiffIDM-v0", num_envs=2, task=task)
    check_env(env.unwrapped, skip_render_check=True)
    for again in (env.spec.make(), gym.make(env.unwrapped.spec), gym.make_vec(vector.spec)):
        assert again.unwrapped.task.warmup == 5 and again.unwrapped.spec.max_episode_steps == 9
    shorter = gym.make("DiffIDM-v0", task=task, max_episode_steps=4)
    assert shorter.spec.max_episode_steps == shorter.unwrapped.task.horizon == 4 and task.horizon == 9


def test_pickled_in_the_middle_of_an_episode_it_goes_on_the_same():
    env = quick()
    env.reset(seed=1)
    for _ in range(3):
        env.step(np.zeros(1, np.float32))
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        assert data_equivalence(env.step(np.ones(1, np.float32)), copy.step(np.ones(1, np.float32)), exact=True)


@pytest.mark.parametrize("action", [np.array([0.5]), np.array([0.5], np.float32), torch.tensor([0.5]), [0.5]])
def test_actions_of_every_type_do_the_same(action):
    env = quick(dtype="float64")
    env.reset(seed=0)
    expected = env.step(np.array([0.5], np.float32))
    env.reset(seed=0)
    assert data_equivalence(env.step(action), expected, exact=True)


def test_actions_are_clipped():
    env = quick()
    env.reset(seed=0)
    inside = env.step(np.array([1.0], np.float32))
    env.reset(seed=0)
    assert data_equivalence(env.step(np.array([7.0], np.float32)), inside, exact=True)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (np.zeros(2), "shape"),
        (np.zeros((1, 1)), "shape"),
        (np.array([np.nan]), "NaN"),
        (np.array([np.inf]), "infinite"),
    ],
)
def test_actions_that_cannot_be_are_errors(action, words):
    env = quick()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=words):
        env.step(action)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"vehicels": 3}, "Did you mean 'vehicles'"),
        ({"otput": "torch"}, "Did you mean 'output'"),
        ({"task": "rign"}, "Did you mean 'ring'"),
        ({"output": "nunpy"}, "Did you mean 'numpy'"),
        ({"dtype": "float46"}, "Did you mean 'float64'"),
        ({"device": "tpu9"}, "Available: cpu"),
        ({"autoreset_mode": "NextSteps"}, "Did you mean 'NextStep'"),
        ({"vehicles": 60}, "do not fit a ring"),
        ({"controlled": 23}, "exceeds the 22 vehicles"),
        ({"controlled": [3, 22]}, "must lie in 0 … 21"),
        ({"effects": ["dellay"]}, "Did you mean 'delay'"),
        ({"parameters": {"idm.time_gab": 1.0}}, "Did you mean 'idm.time_gap'"),
        ({"parameters": {"idm": {"time_gap": 9.0}}}, "outside"),
        ({"length": [270.0, 220.0]}, "must rise"),
        ({"warmup_pool": 4, "warmup": 0}, "no use without warm-up"),
        ({"start": "waves"}, "Did you mean 'wave'"),
    ],
)
def test_bad_keywords_are_errors_of_one_line(keywords, words):
    with pytest.raises(ValueError, match=words) as caught:
        quick(**keywords)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
@pytest.mark.parametrize("given", [{"vehicels": 3}, {"frameskip": 1}, {"task": make_task("ring"), "vehicles": 3}])
def test_a_keyword_that_does_not_exist_is_a_type_error_as_gymnasiums(make, given):
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{list(given)[-1]}'"):
        make("DiffIDM-v0", **given)


def test_a_keyword_of_vectors_is_not_suggested_for_itself():
    with pytest.raises(TypeError, match="unexpected keyword argument 'num_envs'") as told:
        gym.make("DiffIDM-v0", num_envs=3)
    assert "mean 'num_envs'" not in str(told.value)


def test_a_step_before_reset_is_an_error():
    with pytest.raises(RuntimeError, match=r"reset\(\) first"):
        quick().unwrapped.step(np.zeros(1))


def test_effects_and_parameters_change_the_traffic():
    def speed(**keywords):
        env = quick(noise=0.0, length=250.0, warmup=100, **keywords)
        env.reset(seed=0)
        return float(env.unwrapped.state.speed.mean())

    assert speed(parameters={"idm.time_gap": 2.0}) < speed() - 0.5
    assert speed(effects=[{"effect": "drag"}], parameters={"drag.coefficient": 5e-3}) < speed()


def test_none_leaves_everybody_to_the_drivers():
    env = quick(noise=0.0, length=250.0, warmup=0)
    env.reset(seed=0)
    env.step(None)
    speed = env.unwrapped.state.speed
    assert torch.allclose(speed, speed[:, :1].expand_as(speed))
    assert float(speed[0, 0]) > 0.05


def test_nothing_touches_global_generators():
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    env = quick()
    env.reset(seed=0)
    env.step(np.zeros(1))
    env.reset()
    assert torch.equal(torch_state, torch.get_rng_state())
    assert (numpy_state == np.random.get_state()[1]).all()
