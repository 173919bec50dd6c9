"""A batch of environments of one task, in torch: what every face wraps, and the only place where gradients are cut.

Gradients are cut in three ways, all here: an episode begins from constants (the warm-up builds no graph), a reset
replaces the rows that ended, so that nothing flows back into another episode, and ``detach`` cuts the whole batch for
truncated back-propagation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from idm_env.envs.advance import advance_of
from idm_env.envs.settings import Settings
from idm_env.tasks import Draw, World
from idm_env.types import Params, State

_POOL_STREAM = 2
_NORMALS_AT_ONCE = 1 << 12


class Outcome(NamedTuple):
    """What a step gives: observations ``(n, agents, features)``, the others ``(n, agents)``, by name in ``details``."""

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    details: Mapping[str, Tensor]


class Batch:
    """``count`` environments that step together; row i draws what a single environment with its seed draws."""

    def __init__(self, made: Settings, count: int) -> None:
        self.settings = made
        self.task = made.task
        self.count = count
        self.params: Params = self.task.params(made.dtype, made.device)
        self.advance = advance_of(self.task.simulator, made.output, made.device)
        self.limit = made.limit
        self.seeds = np.zeros(count, dtype=np.int64)
        self.episodes = np.full(count, -1, dtype=np.int64)
        self.world: World | None = None
        self._draw: Draw | None = None
        self._pool: World | None = None
        self._block: Tensor | None = None
        self._used = 0

    # -- beginnings ----------------------------------------------------------------------------------------------

    def seed(self, rows: Sequence[int] | np.ndarray, seeds: Sequence[int]) -> None:
        """Give rows new seeds; their next episode is the first of that seed."""
        # Seeds beyond 63 bits are folded: Gymnasium allows any whole number.
        self.seeds[rows] = [int(s) & ((1 << 63) - 1) for s in seeds]
        self.episodes[rows] = -1

    def reset(self, rows: np.ndarray | None = None, state: State | None = None) -> Tensor:
        """Begin a new episode in all or in some rows (indices); return the observations of all of them.

        ``state`` replaces what would be drawn, with its graph. Everything else begins from constants.
        """
        every = rows is None or len(rows) == self.count
        index = np.arange(self.count) if rows is None else rows
        self.episodes[index] += 1
        device = self.settings.device
        draw = Draw.of(
            torch.as_tensor(self.seeds[index], device=device), torch.as_tensor(self.episodes[index], device=device)
        )
        with torch.no_grad():
            fresh = self._begin(draw)
        if state is not None:
            fresh = fresh._replace(state=self._given(state, len(index)))
        if every or self.world is None or self._draw is None:
            self.world, self._draw = fresh, draw
        else:
            where = torch.as_tensor(index, device=device)
            self.world = _map(lambda old, new: old.index_put((where,), new), self.world, fresh)
            self._draw = Draw(self._draw.key.index_put((where,), draw.key))
        self._block = None
        return self.task.observe(self.world)

    def _begin(self, draw: Draw) -> World:
        if not self.task.warmup_pool:
            return self.task.reset(draw, self.params)
        if self._pool is None:
            size, device = self.task.warmup_pool, self.settings.device
            seeds = torch.arange(size, device=device)
            self._pool = self.task.reset(Draw.of(seeds, torch.full_like(seeds, -1)), self.params)
        picked = (draw.uniforms(_POOL_STREAM, 1, torch.float64).squeeze(-1) * self.task.warmup_pool).long()
        return _map(lambda pooled: pooled[picked], self._pool)

    def _given(self, state: State, rows: int) -> State:
        if state.position.shape != (rows, self.task.vehicles):
            raise ValueError(
                f"options['state'] has positions of shape {tuple(state.position.shape)}; "
                f"{(rows, self.task.vehicles)} is "
                "needed: environments, vehicles."
            )
        return state._replace(step=state.step.expand(rows))

    def set_params(self, params: Params) -> None:
        """Replace the parameters (tensors, which may require grad); they hold from the next step on."""
        self.task.simulator.check(params)
        self.params = params
        self._pool = None

    # -- steps ---------------------------------------------------------------------------------------------------

    def _normals(self, state: State) -> Tensor | None:
        """Return the normals of this step, from a block that is drawn ahead where the batch is small."""
        if not self.task.noisy:
            return None
        if self._block is None or self._used >= len(self._block):
            assert self._draw is not None
            steps = max(1, _NORMALS_AT_ONCE // (self.count * self.task.vehicles))
            self._block = self._draw.normals(state.step, steps, self.task.vehicles, state.speed.dtype)
            self._used = 0
        self._used += 1
        return self._block[self._used - 1]

    def step(self, action: Tensor | None, live: Tensor | None = None) -> Outcome:
        """Advance every row; ``action`` has shape ``(n, agents)``, None leaves everybody to the drivers.

        ``live`` (bool, ``(n, agents)``) leaves only single agents' vehicles to their drivers, and drops their commands.
        """
        before, task = self.world, self.task
        assert before is not None
        normals = self._normals(before.state)
        command = None if action is None else task.command(action)
        given = None if command is None else task.limit(before, command)
        after = task.step(before, given, normals, self.params, live=live, advance=self.advance, limited=True)
        if command is None:
            command = after.state.speed.new_zeros(self.count, len(task.agents))
        elif live is not None:
            command = torch.where(live, command, 0.0)
        self.world = after
        terminated, truncated = task.ended(after)
        details = self._details(after, None if action is None else command, given, terminated)
        if self.limit is not None:
            truncated = truncated | (after.state.step >= self.limit).unsqueeze(-1)
        reward = task.reward(before, command, after, terminated)
        return Outcome(task.observe(after), reward, terminated, truncated, details)

    def _details(
        self, after: World, command: Tensor | None, given: Tensor | None, crashed: Tensor
    ) -> dict[str, Tensor]:
        """Return what infos tell of a step (``idm_env.envs.info``) and no more, shape ``(n, agents)`` each."""
        task, asked, found = self.task, self.settings.info, dict[str, Tensor]()
        if "accel" in asked:
            # A copy: what is told of a step is not the state itself.
            found["accel"] = task.pick(after.state.accel).clone()
        if "command" in asked:
            shape = (self.count, len(task.agents))
            found["command"] = after.state.accel.new_full(shape, torch.nan) if command is None else command
        if "failsafe" in asked:
            if command is None or given is None or not task.failsafe:
                found["failsafe"] = torch.zeros_like(crashed)
            else:
                found["failsafe"] = given < command
        if "crash" in asked:
            found["crash"] = crashed
        return found

    def detach(self) -> None:
        """Cut the graph behind the present state, for truncated back-propagation."""
        if self.world is not None:
            self.world = _map(lambda x: x.detach(), self.world)


Tree = TypeVar("Tree")


def _map(function: Callable[..., Tensor], first: Tree, *rest: Any) -> Tree:
    """Apply a function to every tensor of like-shaped tuples and mappings; None stays None."""
    if first is None:
        return first
    if isinstance(first, Tensor):
        return function(first, *rest)  # type: ignore[return-value]
    if isinstance(first, Mapping):
        return {k: _map(function, v, *(r[k] for r in rest)) for k, v in first.items()}  # type: ignore[return-value]
    assert isinstance(first, tuple)
    return type(first)(*(_map(function, *parts) for parts in zip(first, *rest, strict=True)))  # type: ignore[return-value]
