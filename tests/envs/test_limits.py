"""How long episodes are: the spec says it, every number asked for is honoured, and what cannot be is an error."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import idm_env  # noqa: F401
from idm_env.cli import commands as cli
from idm_env.envs.gym import DiffIDMEnv
from idm_env.envs.pettingzoo import parallel_env
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.jobs import progress

USUAL = {
    "ring": 3000,
    "follow": 1000,
    "platoon": 3000,
    "replay": 300,
    "replay_lanes": 300,
    "highway": 3000,
    "open_highway": 600,
    "merge": 600,
    "bottleneck": 600,
    "approach": 600,
}
QUICK = {"ring": {"warmup": 3}}


def length(env, most=5000):
    """Return the steps of an episode in which human drivers keep the wheel."""
    env.reset(seed=0)
    for step in range(most):
        if np.any(env.step(None)[3]):
            return step + 1
    return None


@pytest.mark.parametrize("task", USUAL)
def test_the_spec_says_after_how_many_steps_an_episode_ends(task):
    env = gym.make("DiffIDM-v0", task=task, **QUICK.get(task, {}))
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, task=task, **QUICK.get(task, {}))
    assert env.spec.max_episode_steps == vector.spec.max_episode_steps == USUAL[task]
    if USUAL[task] * env.unwrapped.task.held <= 1000:
        assert length(env) == length(vector) == USUAL[task]
    again = EnvSpec.from_json(env.spec.to_json()).make()
    assert again.spec.max_episode_steps == USUAL[task]


@pytest.mark.parametrize(
    ("task", "asked"), [("follow", 1500), ("follow", 7), ("replay", 450), ("platoon", 9), ("merge", 3)]
)
def test_what_is_asked_for_is_honoured_in_every_face(task, asked):
    single = gym.make("DiffIDM-v0", task=task, max_episode_steps=asked)
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, task=task, max_episode_steps=asked)
    bare = DiffIDMEnv(task=task, max_episode_steps=asked)
    for env in (single, vector, bare):
        assert length(env) == asked
    assert single.spec.max_episode_steps == vector.spec.max_episode_steps == asked
    assert single.unwrapped.task.horizon == asked
    many = parallel_env(task=task, max_cycles=asked)
    many.reset(seed=0)
    assert many.max_cycles == asked
    # A respawned environment has the same end.
    assert length(EnvSpec.from_json(single.spec.to_json()).make()) == asked


def test_a_file_gives_the_limit_and_a_keyword_wins(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text("configures: environment\ntask: follow\nmax_episode_steps: 12\n")
    said = gym.make("DiffIDM-v0", config=str(path))
    assert said.spec.max_episode_steps == length(said) == 12
    longer = gym.make("DiffIDM-v0", config=str(path), max_episode_steps=1200)
    assert longer.spec.max_episode_steps == length(longer) == 1200


@pytest.mark.parametrize("face", [gym.make, gym.make_vec])
@pytest.mark.parametrize("task", ["follow", "replay"])
def test_more_than_the_record_has_is_an_error(task, face):
    with pytest.raises(ValueError, match=r"max_episode_steps = 60000 exceeds the \d+ steps") as caught:
        face("DiffIDM-v0", task=task, max_episode_steps=60000)
    assert "\n" not in str(caught.value).split(" was raised")[0]
    with pytest.raises(ValueError, match=r"exceeds the \d+ steps"):  # of a second each
        face("DiffIDM-v0", task=task, max_episode_steps=5000, hold=1.0)


def test_no_limit_is_no_limit():
    env = DiffIDMVectorEnv(1, task="platoon", max_episode_steps=-1)
    assert env.batch.limit is None
    assert length(env, 20) is None


@pytest.mark.parametrize("bad", [0, -2, 2.5, True])
def test_what_is_no_number_of_steps_is_an_error(bad):
    with pytest.raises(ValueError, match="max_episode_steps"):
        DiffIDMEnv(task="platoon", max_episode_steps=bad)


def test_the_cost_of_a_crash_knows_the_episodes_length():
    short, long = (gym.make("DiffIDM-v0", reward="flow", max_episode_steps=n).unwrapped.task for n in (10, 10000))
    assert (short.cost_of_crash, long.cost_of_crash) == (121.0, 120001.0)


def test_a_picture_is_as_long_as_it_was_asked_for(tmp_path, monkeypatch):
    # The usual 3000 steps are no limit of it: plot's ring is drawn over 400 s.
    monkeypatch.setattr(cli, "_work_begins", lambda: None)
    path = tmp_path / "ring.yaml"
    path.write_text("configures: environment\ntask: ring\nvehicles: 3\nlength: 60.0\nwarmup: 1\n")
    (panel,) = cli._rollout_panels(path, 310.0, 0, progress.silent)
    assert [len(line.time) for line in panel.lines] == [3100] * 3


@pytest.mark.usefixtures("torch_path")
def test_a_picture_of_a_task_whose_actions_are_held_is_as_long_as_it_was_asked_for(monkeypatch):
    """Its lines lie at the seconds of the environment: a vehicle's way over them is its speed."""
    monkeypatch.setattr(cli, "_work_begins", lambda: None)
    config = Path(__file__).resolve().parents[2] / "configs" / "motorway.yaml"
    panels = cli._rollout_panels(config, 20.0, 0, progress.silent)
    lines = [line for panel in panels for line in panel.lines if len(line.time) > 5]
    assert lines and max(line.time[-1] for line in lines) == 20.0
    for line in lines:
        driven = np.diff(line.position) / np.diff(line.time)
        assert np.all(np.abs(driven - 0.5 * (line.speed[1:] + line.speed[:-1])) < 1.0)
