"""Every task has an id of its own, which makes it in both faces, and which a process finds by the package's name."""

import gymnasium as gym
import pytest

import idm_env
from idm_env.tasks import TASKS

IDS = {task: idm_env._task_id(task) for task in TASKS}


def test_ids_are_those_of_the_tasks() -> None:
    """No task without an id, no id without a task, and the words of a name each with a capital."""
    assert {name for name in gym.registry if name.startswith("DiffIDM/")} == {
        *IDS.values(),
        "DiffIDM/Signals-v0",
        "DiffIDM/Junction-v0",
    }
    assert IDS["ring"] == "DiffIDM/Ring-v0" and IDS["open_highway"] == "DiffIDM/OpenHighway-v0"


@pytest.mark.parametrize("task", TASKS)
def test_an_id_makes_its_task(task: str) -> None:
    """Single and vector, with the spaces and the length of ``DiffIDM-v0`` of that task; keywords are taken."""
    single, vector = gym.make(f"idm_env:{IDS[task]}"), gym.make_vec(IDS[task], num_envs=2, output="torch")
    wanted = gym.make("DiffIDM-v0", task=task)
    for made in (single.unwrapped, vector.unwrapped):
        assert made.task.name == task and made.spec.id == IDS[task]
    assert single.spec.max_episode_steps == vector.spec.max_episode_steps == wanted.spec.max_episode_steps
    assert single.observation_space == vector.single_observation_space == wanted.observation_space
    assert single.spec.make().unwrapped.task.name == task
