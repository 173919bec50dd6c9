"""Entry points of Gymnasium: the environment of a task, whose agents are vehicles or signals."""

from typing import Any

from gymnasium import Env
from gymnasium.vector import VectorEnv

from idm_env.tasks.signals import SignalsTask


def single(task: Any = None, **keywords: Any) -> Env:
    """Return one environment: a ``DiffIDMEnv``, or a ``SignalsEnv`` for task ``signals``."""
    from idm_env.envs.gym import DiffIDMEnv
    from idm_env.envs.signal_faces import SignalsEnv

    return SignalsEnv(**keywords) if task == SignalsTask.name else DiffIDMEnv(task=task, **keywords)


def vector(task: Any = None, **keywords: Any) -> VectorEnv:
    """Return a vector: a ``DiffIDMVectorEnv``, or a ``SignalsVectorEnv`` for task ``signals``."""
    from idm_env.envs.signal_faces import SignalsVectorEnv
    from idm_env.envs.vector import DiffIDMVectorEnv

    return SignalsVectorEnv(**keywords) if task == SignalsTask.name else DiffIDMVectorEnv(task=task, **keywords)
