"""What a step of an environment is: pure functions of torch, which compiled loops are recorded from.

Shapes: rows are environments: states ``[rows, n]``, actions and commands ``[rows, agents, …]``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from idm_env.envs.settings import Settings
from idm_env.tasks import EnvState
from idm_env.tasks.types import Maybe, Normals
from idm_env.types import Params, worthwhile


class Moves:
    """The functions of a step, of what environments are made of."""

    def __init__(self, settings: Settings) -> None:
        self.task, self._info = settings.task, settings.info
        self._limit = None if settings.limit is None else settings.limit * settings.task.held
        # With torch output always the step itself, so that values are the same bits with and without a graph.
        self._advance = self.task.simulator.step if settings.output == "torch" else self.task.simulator.advance

    def by(self, advance: Callable[..., Any]) -> Moves:
        """Return the same functions, with another one that advances the traffic by Δt."""
        other = copy.copy(self)
        other._advance = advance
        return other

    def step(
        self, world: EnvState, action: Maybe, live: Maybe, normals: Normals, driven: Params, observed: bool = True
    ) -> tuple[EnvState, dict[str, Tensor]]:
        """Return the worlds Δt later and all that faces tell of the step; ``driven`` are ``task.episode_params``.

        Without ``observed`` observations are read only where an episode ends, and otherwise empty.
        """
        command, limited, inputs = self.commanded(world, action, normals, live)
        after = world._replace(state=self._advance(world.state, inputs, driven))
        if command is None:
            none = after.state.speed.new_zeros(len(after.state.speed), len(self.task.agents))
            return after, self.told(world, none, limited, after, False, observed)
        return after, self.told(world, command, limited, after, True, observed)

    def commanded(
        self, world: EnvState, action: Maybe, normals: Normals = None, live: Maybe = None
    ) -> tuple[Maybe, Maybe, Mapping[str, Any]]:
        """Return commands, commands as the failsafe lets them pass, and the inputs of a step."""
        task = self.task
        command = None if action is None else task.command(action)
        limited = None if command is None else task.limit(world, command)
        inputs = task.with_lane_commands(task.inputs(world, limited, normals, live), action, live)
        if command is not None and live is not None:
            command = torch.where(live, command, 0.0)
        return command, limited, inputs

    def told(
        self, before: EnvState, command: Tensor, given: Maybe, after: EnvState, commanded: bool, observed: bool = True
    ) -> dict[str, Tensor]:
        """Return everything that faces tell of a step, by name."""
        task = self.task
        terminated, truncated = task.ended(after)
        details = self._details(after, command if commanded else None, given, terminated)
        if self._limit is not None:
            truncated = truncated | (after.state.step >= self._limit).unsqueeze(-1)
        parts = task.reward_parts(before, command, after, terminated)
        reward = reduce(torch.add, parts.values())
        if "rewards" in self._info:
            details["rewards"] = torch.stack(tuple(parts.values()), -1).detach()
        if len(task.agents) == 1:
            ends, cut = terminated[..., 0], truncated[..., 0]
        else:
            ends, cut = terminated.any(-1), (truncated | terminated).all(-1) & truncated.any(-1)
        reads = observed or worthwhile(ends | cut)
        return {
            "observation": task.observe(after) if reads else reward.new_empty(0),
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "whole_reward": reward.mean(-1),
            "whole_terminated": ends,
            "whole_truncated": cut,
            **{f"info_{name}": x for name, x in details.items()},
        }

    def _details(self, after: EnvState, command: Maybe, limited: Maybe, crashed: Tensor) -> dict[str, Tensor]:
        """Return what infos tell of a step (``idm_env.envs.info``) and no more, shape ``(n, agents)`` each."""
        task, names, details = self.task, self._info, dict[str, Tensor]()
        if "accel" in names:
            details["accel"] = task.there(after.state, task.pick(after.state.accel))
        if "command" in names:
            shape = (len(after.state.speed), len(task.agents))
            details["command"] = (
                after.state.accel.new_full(shape, torch.nan) if command is None else task.there(after.state, command)
            )
        if "failsafe" in names:
            if command is None or limited is None or not task.failsafe:
                details["failsafe"] = torch.zeros_like(crashed)
            else:
                details["failsafe"] = task.there(after.state, limited < command)
        if "crash" in names:
            details["crash"] = crashed
        return details | {name: x for name, x in task.info(after).items() if name in names} if names else details
