"""Tasks: what is to be achieved in traffic, as pure functions over the simulator."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from idm_env.jobs import trust
from idm_env.tasks.approach import ApproachTask as ApproachTask
from idm_env.tasks.base import EnvState as EnvState, Task as Task
from idm_env.tasks.checks import KeywordError as KeywordError
from idm_env.tasks.features import FEATURES as FEATURES, AgentView as AgentView, Feature as Feature
from idm_env.tasks.follow import FollowTask as FollowTask
from idm_env.tasks.highway import HighwayTask as HighwayTask
from idm_env.tasks.open_roads import (
    BottleneckTask as BottleneckTask,
    MergeTask as MergeTask,
    OpenHighwayTask as OpenHighwayTask,
)
from idm_env.tasks.platoon import PlatoonTask as PlatoonTask
from idm_env.tasks.random import Draw as Draw
from idm_env.tasks.replay import ReplayTask as ReplayTask
from idm_env.tasks.replay_lanes import ReplayLanesTask as ReplayLanesTask
from idm_env.tasks.reward_terms import REWARD_TERMS as REWARD_TERMS, RewardTerm as RewardTerm, Transition as Transition
from idm_env.tasks.ring import RingTask as RingTask
from idm_env.validation import nearest, shown

_TASKS: list[type[Task]] = [RingTask, FollowTask, PlatoonTask, ReplayTask, ReplayLanesTask, HighwayTask]
_TASKS += [OpenHighwayTask, MergeTask, BottleneckTask, ApproachTask]
TASKS = {task.name: task for task in _TASKS}
ON_NETWORKS = ("signals", "junction")


def make_task(task: str = "ring", *, trusted: bool = False, **choices: Any) -> Task:
    """Return a task by name with its static choices; ``trusted``: code that a model file among them names is run.

    Raises:
        KeywordError: A TypeError, with a suggestion, for a keyword that does not exist.
        ValueError: For an unknown task, or a value that cannot be.
    """
    with trust.trusting(trusted):
        return task_with(task, choices)


def task_with(task: str, choices: Mapping[str, Any], others: Iterable[str] = ()) -> Task:
    """Return what ``make_task`` does; ``others``, keywords that the caller takes himself, are suggested too.

    ValueError for an unknown task, KeywordError for an unknown keyword.
    """
    if is_on_network(task):
        raise ValueError(f"task '{task}' stands on a network, which only Gymnasium and PettingZoo make. Use gym.make.")
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(f"unknown task {shown(task)}.{nearest(shown(task), [*TASKS, *ON_NETWORKS])}")
    return with_keywords(task, TASKS[task], choices, others)


def is_on_network(task: object) -> bool:
    """Tell whether a task, whatever its type, is one on a network: only environments of networks make it."""
    return isinstance(task, str) and task in ON_NETWORKS


def with_keywords(task: str, kind: Any, choices: Mapping[str, Any], others: Iterable[str] = ()) -> Any:
    """Return the task of a kind, a dataclass; KeywordError for a keyword that is none, nor one of ``others``."""
    names = [f.name for f in dataclasses.fields(kind) if f.init]
    for choice in choices:
        if choice not in names:
            like = nearest(str(choice), [name for name in (*names, *others) if name != choice])
            raise KeywordError(f"task '{task}' got an unexpected keyword argument {shown(choice)}.{like}")
    return kind(**choices)
