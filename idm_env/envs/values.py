"""The worlds of a batch as arrays that compiled loops step (``plan.py``), without a graph."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.envs.past import Past
from idm_env.envs.plan import After, Array, Before, Plan, named
from idm_env.history import PAST
from idm_env.tasks import Task, World
from idm_env.types import Params, State


class Values:
    """The worlds of a batch as arrays, and their steps.

    Raises:
        Untraceable: From ``step``, before anything has changed, where the task or its simulator cannot be recorded.
    """

    def __init__(self, task: Task, before: Before, after: After) -> None:
        self.task = task
        self._before, self._after = before, after
        self._plans: dict[tuple[bool, bool], Plan] = {}
        self._key: Any = None
        self.arrays: tuple[dict[str, Array], dict[str, Array]] = ({}, {})
        self.past: Past
        self.side = 0
        self.world: World | None = None

    def load(self, world: World) -> None:
        """Take over worlds; they are copied."""
        key = (world.state.speed.shape, world.state.speed.dtype, tuple(world.state.memory), tuple(world.episode))
        if key != self._key:
            self._key, self._plans, self.arrays, self.past = key, {}, ({}, {}), Past(world.state)
        self.world = world
        state = world.state
        for name, x in named(world).items():
            self._put(name, x)
        self._put("clock", _clock(state))
        self.past.load(state)

    def replace(self, rows: Array, fresh: World) -> None:
        """Replace some rows (indices) by the worlds of ``fresh``."""
        held, other = self.arrays[self.side], self.arrays[1 - self.side]
        count = len(held["state_step"])
        for name, x in (*named(fresh).items(), ("clock", _clock(fresh.state))):
            values = x.detach().numpy()
            held[name].reshape(count, *values.shape[1:])[rows] = values
            if other[name] is not held[name] and name not in _DYNAMIC:
                other[name].reshape(count, *values.shape[1:])[rows] = values
        self.past.replace(rows, fresh.state)

    def _put(self, name: str, x: Tensor) -> None:
        held, other = self.arrays[self.side], self.arrays[1 - self.side]
        if name in held:
            np.copyto(held[name].reshape(x.shape), x.detach().numpy())
            if other[name] is not held[name] and name not in _DYNAMIC:
                # What no step changes must be the same on both sides.
                np.copyto(other[name], held[name])
            return
        held[name] = np.array(x.detach().numpy(), order="C").reshape(-1)
        other[name] = held[name] if name.startswith("episode_") or name == "state_length" else held[name].copy()

    def current(self, own: bool = True) -> World:
        """Return the worlds as tensors of their own, or without the past as views that hold until the next step."""
        assert self.world is not None
        state, held = self.world.state, self.arrays[self.side]
        if own:
            held = {name: x.copy() for name, x in held.items()}
        leaves = {n: torch.from_numpy(held[n]).view(x.shape) for n, x in named(self.world).items()}
        memory = {name: leaves.get(f"memory_{name}", x) for name, x in state.memory.items()}
        if PAST in memory and own:
            memory[PAST] = self.past.tensor()
        fields: Any = {n.removeprefix("state_"): x for n, x in leaves.items() if n.startswith("state_")}
        episode = {n.removeprefix("episode_"): x for n, x in leaves.items() if n.startswith("episode_")}
        return World(state._replace(**fields, memory=memory), episode)

    def clock(self) -> Tensor:
        """Return the steps of all rows, as they are now."""
        return torch.from_numpy(self.arrays[self.side]["state_step"])

    def step(
        self, action: Array | None, live: Array | None, normals: dict[str, Array] | None, at: int, params: Params
    ) -> dict[str, Array]:
        """Advance all rows; ``normals`` are blocks (steps, rows, vehicles) by effect, ``at`` the step in them.

        ``live`` says whose actions count (all, where it is None).
        """
        kind = (action is None, live is None)
        plan = self._plans.get(kind)
        if plan is None:
            assert self.world is not None
            draws = tuple(normals or ())
            plan = Plan(self.task, self._before, self._after, self.world, self.arrays, self.past, kind, draws)
            self._plans[kind] = plan
        told = plan.run(self.side, action, live, normals, at, params)
        self.side = 1 - self.side
        return told


_DYNAMIC = {f"state_{name}" for name in ("position", "speed", "accel", "gap", "step")}


def _clock(state: State) -> Tensor:
    return state.step.to(state.speed.dtype).unsqueeze(-1).expand(state.speed.shape)
