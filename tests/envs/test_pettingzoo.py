"""PettingZoo's own tests on the face, and agents that come to their ends one by one."""

import pickle

import gymnasium
import numpy as np
import pettingzoo
import pytest
import torch
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, seed_test
from pettingzoo.test.max_cycles_test import max_cycles_test
from pettingzoo.test.state_test import state_test

from idm_env.envs import pettingzoo as diffidm
from idm_env.envs.pettingzoo import env, parallel_env, raw_env

uncompiled = pytest.mark.usefixtures("torch_path")
"""For what is asked of many environments; those of QUICK are compiled."""
QUICK = {"controlled": 3, "warmup": 5}

EVERYBODY = [
    {"controlled": "all", "vehicles": 5, "length": 80.0, "warmup": 5},
    {"controlled": 0.25, "warmup": 5},
    {"task": "follow", "controlled": "all"},
    {"task": "platoon", "controlled": 0.5},
    {"task": "replay", "controlled": "all"},
]
TRIPS = [
    {"task": "merge", "vehicles": 20, "controlled": 0.2},
    {"task": "bottleneck", "vehicles": 8, "controlled": [1], "inflow": 2000.0},
]


@uncompiled
@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("keywords", [QUICK, *EVERYBODY], ids=str)
def test_parallel_api(keywords):
    parallel_api_test(parallel_env(**keywords, max_cycles=40), num_cycles=60)


@uncompiled
@pytest.mark.filterwarnings("ignore:No agents present but not all possible_agents")
@pytest.mark.parametrize("keywords", TRIPS, ids=str)
def test_parallel_api_where_agents_come_and_go(keywords):
    """Of the trips that an episode may have not all begin in it."""
    parallel_api_test(parallel_env(**keywords, max_cycles=40), num_cycles=60)


@uncompiled
@pytest.mark.parametrize("keywords", [QUICK, *EVERYBODY, TRIPS[0]], ids=str)
@pytest.mark.parametrize("make", [env, raw_env])
def test_api(make, keywords):
    api_test(make(**keywords, max_cycles=30), num_cycles=60)


def test_max_cycles():
    max_cycles_test(diffidm)


def test_pettingzoos_registry_knows_it():
    if not hasattr(pettingzoo, "make"):
        pytest.skip("this PettingZoo has no registry")
    many = pettingzoo.make("parallel", "diffidm_v0", max_cycles=5, **QUICK)
    assert isinstance(many, parallel_env)
    assert many.max_cycles == 5
    assert pettingzoo.make("aec", "diffidm_v0", **QUICK).possible_agents == many.possible_agents


def test_seeds():
    parallel_seed_test(lambda: parallel_env(**QUICK), num_cycles=20)
    seed_test(lambda: env(**QUICK), num_cycles=20)


@uncompiled
def test_whoever_seeds_the_first_agents_has_seeded_those_that_begin_later():
    """The official test seeds the spaces of the agents that are there after ``reset``, and samples those of all."""
    seed_test(lambda: env(task="merge", controlled=0.1), num_cycles=30)
    made = parallel_env(task="merge", controlled=0.3)
    assert len({id(made.action_space(a)) for a in made.possible_agents}) == 1 < len(made.possible_agents)


def test_state():
    state_test(env(**QUICK), parallel_env(**QUICK), num_cycles=5)


def test_render():
    render_test(lambda **keywords: env(**QUICK, **keywords))


def test_spaces_are_the_same_object_and_metadata_is_whole():
    made = parallel_env(**QUICK)
    agent = made.possible_agents[0]
    assert made.observation_space(agent) is made.observation_space(agent)
    assert made.action_space(agent) is made.action_space(agent)
    assert made.metadata["name"] == "diffidm_v0"
    assert made.metadata["is_parallelizable"]
    assert str(raw_env(**QUICK)) == "diffidm_v0"


def test_it_agrees_with_the_single_environment():
    import gymnasium as gym

    single = gym.make("DiffIDM-v0", **QUICK)
    many = parallel_env(**QUICK)
    seen, _ = many.reset(seed=2)
    np.testing.assert_array_equal(np.concatenate(list(seen.values())), single.reset(seed=2)[0])
    for _ in range(5):
        seen, rewards, *_ = many.step({a: np.array([0.3], np.float32) for a in many.agents})
        observation, reward, *_ = single.step(np.full(3, 0.3, np.float32))
        np.testing.assert_allclose(np.concatenate(list(seen.values())), observation, atol=1e-6)
        assert np.mean(list(rewards.values())) == pytest.approx(reward)


def test_pickles():
    made = parallel_env(**QUICK)
    made.reset(seed=0)
    copy = pickle.loads(pickle.dumps(made))
    actions = {a: np.zeros(1, np.float32) for a in made.agents}
    np.testing.assert_array_equal(list(made.step(actions)[0].values()), list(copy.step(actions)[0].values()))


@pytest.mark.parametrize("bad", [{}, {"vehicle_0": np.array([np.nan])}, {"vehicle_0": np.zeros(2)}])
def test_bad_actions_are_errors(bad):
    made = parallel_env(vehicles=5, length=80.0, warmup=1)
    made.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        made.step(bad)


def test_a_misspelled_keyword_has_a_suggestion_and_the_limit_two_names():
    with pytest.raises(TypeError, match="Did you mean 'vehicles'"):
        parallel_env(vehicels=3)
    assert parallel_env(max_episode_steps=7, **QUICK).max_cycles == parallel_env(max_cycles=7, **QUICK).max_cycles == 7
    with pytest.raises(ValueError, match=r"max_cycles = 7 and max_episode_steps = 8 are one limit\. Leave one out\."):
        parallel_env(max_cycles=7, max_episode_steps=8)


@uncompiled
@pytest.mark.filterwarnings("error::UserWarning")
def test_fixed_agents_are_there_until_the_end():
    """PettingZoo's own test; and slots without a vehicle observe zeros."""
    parallel_api_test(parallel_env(**TRIPS[0], fixed=True, max_cycles=30), num_cycles=60)
    many = parallel_env(**TRIPS[0], fixed=True, max_cycles=30)
    seen, infos = many.reset(seed=0)
    assert many.agents == many.possible_agents == [f"vehicle_{i}" for i in many.task.agents]
    for _ in range(30):
        assert all(infos[agent]["present"] or not seen[agent].any() for agent in many.agents)
        seen, _, _, truncated, infos = many.step({a: np.ones(1, np.float32) for a in many.agents})
    assert all(truncated.values()) and not many.agents


@uncompiled
def test_agents_of_trips_come_and_go():
    """Every trip is an agent: it appears with its vehicle, and terminates with it, however long none is there."""
    road = {"task": "merge", "vehicles": 30, "controlled": [2, 9], "inflow": 2400.0, "ramp_inflow": 500.0}
    many = parallel_env(**road, reward="traffic", max_cycles=150)
    seen, _ = many.reset(seed=4)
    at = many.task.bounds.names.index("present")
    began, ended, last = set(many.agents), set(), None
    while many.agents:
        assert set(seen) >= set(many.agents) and all(seen[agent][at] == 1.0 for agent in many.agents)
        seen, reward, terminated, truncated, _ = many.step({a: np.zeros(1, np.float32) for a in many.agents})
        over = {a for a in terminated if terminated[a] or truncated[a]}
        assert not over & ended and not ended & set(many.agents)
        assert all(seen[a][at] == 0.0 and reward[a] > 0.0 for a in terminated if terminated[a])
        ended, began, last = ended | over, began | set(many.agents), truncated
    assert began == ended <= set(many.possible_agents) and len(began) >= 5
    assert {name.split("_trip_")[0] for name in began} == {"vehicle_2", "vehicle_9"}
    assert last is not None


@pytest.mark.parametrize(
    "actions", [1.0, True, b"1", [0.0], np.zeros(1), {0.0}, lambda: 1, torch.zeros(1)], ids=lambda x: type(x).__name__
)
def test_actions_that_are_no_mapping_are_one_line(actions):
    """Told by name before a step is done, as they are of a single environment."""
    faces = parallel_env(task="follow")
    faces.reset(seed=1)
    with pytest.raises(ValueError, match=r"^actions = .* must map each of env\.agents to its action\.$"):
        faces.step(actions)


def test_options_of_a_reset_are_those_of_a_single_environment():
    """What holds from now on does; an unknown one is refused, and PettingZoo's own is left aside."""
    faces, single = parallel_env(task="ring", warmup=5), gymnasium.make("DiffIDM/Ring-v0", warmup=5)
    seen, _ = faces.reset(seed=3, options={"length": 230.0, "options": 1})
    np.testing.assert_array_equal(seen["vehicle_0"], single.reset(seed=3, options={"length": 230.0})[0])
    for wrong, words in ({"lenght": 230.0}, "Did you mean 'length'"), ([1], "must be a mapping"):
        with pytest.raises(ValueError, match=words):
            faces.reset(options=wrong)
