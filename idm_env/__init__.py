"""Differentiable, vectorised lanes of Intelligent-Driver-Model vehicles, and a closed loop with measured traffic.

Public names are loaded when first used, so ``import idm_env`` is quick and imports no torch; it registers the
Gymnasium ids ``DiffIDM-v0`` and one more for each task (``DiffIDM/Ring-v0``). Gymnasium (1.1 and later) loads no
plug-ins: a process that has not imported this package, such as a remote worker, finds them as ``"idm_env:DiffIDM-v0"``.
"""

import importlib
from typing import TYPE_CHECKING, Any

from idm_env import backends

__version__ = "0.1.0"

_LAZY = {
    "effects": ("IDM", "Brakes", "Control", "Effect", "Replay"),
    "parameters": ("Parameter",),
    "roads": ("Lane", "Lanes", "Ring"),
    "simulator": ("Simulator", "Trajectory"),
    "types": ("Command", "Record", "State"),
}

_LANES_TASKS = ("highway", "open_highway", "merge", "bottleneck", "replay_lanes", "approach")
_TASKS = ("follow", "platoon", "replay", "ring", *_LANES_TASKS)
_ON_NETWORKS = ("signals", "junction")
"""The keys of ``idm_env.tasks.TASKS`` and its ``ON_NETWORKS``, which need torch."""

__all__ = ["__version__", *(name for names in _LAZY.values() for name in names)]

if TYPE_CHECKING:
    from idm_env.effects import IDM as IDM, Brakes as Brakes, Control as Control, Effect as Effect, Replay as Replay
    from idm_env.parameters import Parameter as Parameter
    from idm_env.roads import Lane as Lane, Lanes as Lanes, Ring as Ring
    from idm_env.simulator import Simulator as Simulator, Trajectory as Trajectory
    from idm_env.types import Command as Command, Record as Record, State as State


def _task_id(task: str) -> str:
    """Return the Gymnasium id of a task: ``open_highway`` is ``DiffIDM/OpenHighway-v0``."""
    return f"DiffIDM/{task.title().replace('_', '')}-v0"


def _register() -> None:
    """Register the environment ids; entry points are text, so that nothing heavy is imported here."""
    from gymnasium.envs.registration import register, registry

    tasks = {_task_id(t): {"task": t} for t in (*_TASKS, *_ON_NETWORKS)}
    for name, keywords in {"DiffIDM-v0": {}, **tasks}.items():
        if name not in registry:
            register(
                id=name,
                entry_point="idm_env.envs.faces:single",
                vector_entry_point="idm_env.envs.faces:vector",
                kwargs=keywords,
                # Each task has its own number of steps: the environment cuts episodes off, and its own spec says when.
                # The checker's wrapper costs more than a step; tests run the full checker instead.
                disable_env_checker=True,
            )


_register()
backends.enter("idm_env.compiled.kernels.dispatch:rollout")


def __getattr__(name: str) -> Any:
    for module, names in _LAZY.items():
        if name in names:
            return getattr(importlib.import_module(f"idm_env.{module}"), name)
    if name == "plot":
        return importlib.import_module("idm_env.plot")
    raise AttributeError(f"module 'idm_env' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
