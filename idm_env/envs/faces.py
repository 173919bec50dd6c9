"""Entry points of Gymnasium: the environment of a task, on a road or on a network."""

from typing import Any

from gymnasium import Env
from gymnasium.vector import VectorEnv

from idm_env.tasks import is_on_network


def single(task: Any = None, **keywords: Any) -> Env:
    """Return one environment: a ``DiffIDMEnv``, or a ``NetworkEnv`` for tasks on networks."""
    from idm_env.envs.gym import DiffIDMEnv
    from idm_env.envs.network_faces import NetworkEnv

    return (NetworkEnv if is_on_network(task) else DiffIDMEnv)(task=task, **keywords)


def vector(task: Any = None, **keywords: Any) -> VectorEnv:
    """Return a vector: a ``DiffIDMVectorEnv``, or a ``NetworkVectorEnv`` for tasks on networks."""
    from idm_env.envs.network_faces import NetworkVectorEnv
    from idm_env.envs.vector import DiffIDMVectorEnv

    return (NetworkVectorEnv if is_on_network(task) else DiffIDMVectorEnv)(task=task, **keywords)
