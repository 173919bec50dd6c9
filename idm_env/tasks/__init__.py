"""Tasks: what is to be achieved in traffic, as pure functions over the simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from idm_env.parameters import nearest
from idm_env.tasks.base import Advance, Bounds, Ended, Features, Pay, Task, World
from idm_env.tasks.follow import FollowTask
from idm_env.tasks.platoon import PlatoonTask
from idm_env.tasks.random import Draw
from idm_env.tasks.replay import ReplayTask
from idm_env.tasks.ring import RingTask

TASKS: dict[str, type[Task]] = {task.name: task for task in (RingTask, FollowTask, PlatoonTask, ReplayTask)}


def make_task(task: str = "ring", *, others: Iterable[str] = (), **choices: Any) -> Task:
    """Return a task by name with its static choices; ValueError with a suggestion for a misspelled one.

    ``others`` are keywords that the caller takes himself: they are suggested too.
    """
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}.{nearest(str(task), TASKS)}")
    known = [f.name for f in dataclasses.fields(TASKS[task]) if f.init]
    for choice in choices:
        if choice not in known:
            raise ValueError(f"task '{task}' has no keyword '{choice}'.{nearest(choice, [*known, *others])}")
    return TASKS[task](**choices)


__all__ = [
    "TASKS",
    "Advance",
    "Bounds",
    "Draw",
    "Ended",
    "Features",
    "FollowTask",
    "Pay",
    "PlatoonTask",
    "ReplayTask",
    "RingTask",
    "Task",
    "World",
    "make_task",
]
