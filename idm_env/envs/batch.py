"""A batch of environments of one task, in torch: what every face wraps, and the only place where gradients are cut.

Gradients are cut in three ways, all here: an episode begins from constants (the warm-up builds no graph), a reset
replaces the rows that ended, so that nothing flows back into another episode, and ``detach`` cuts the whole batch for
truncated back-propagation.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.checks import whole
from idm_env.envs.beginnings import Beginnings
from idm_env.envs.given import checked
from idm_env.envs.settings import INFO, Settings
from idm_env.kernels import dispatch
from idm_env.scalar.record import Untraceable
from idm_env.tasks import Draw, World
from idm_env.types import Params, State, mapped

if TYPE_CHECKING:
    from idm_env.envs.values import Values

_POOL_STREAM = 2
_NORMALS_AT_ONCE = 1 << 12


class Whole(NamedTuple):
    """Of whole environments, ``(n,)``: mean reward, terminated with the first agent, truncated with the last.

    Tensors, or arrays with numpy output.
    """

    reward: Any
    terminated: Any
    truncated: Any


class Outcome(NamedTuple):
    """What a step gives: observations ``(n, agents, features)``, the others ``(n, agents)``, by name in ``details``.

    Tensors, or arrays with numpy output.
    """

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    whole: Whole
    details: Mapping[str, Any]

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Outcome:
        """Return what ``Batch.told`` tells, sorted."""
        rest = {name: told[key] for name, key in _DETAILS if key in told}
        whole = Whole(told["whole_reward"], told["whole_terminated"], told["whole_truncated"])
        return cls(told["observation"], told["reward"], told["terminated"], told["truncated"], whole, rest)


_DETAILS = tuple((name, f"info_{name}") for name in INFO)


class Batch:
    """``count`` environments that step together; row i draws what a single environment with its seed draws."""

    def __init__(self, made: Settings, count: int) -> None:
        self.settings = made
        self.task = made.task
        self.count = count
        self.params: Params = self.task.params(made.dtype, made.device)
        self.limit = made.limit
        self.seeds = np.zeros(count, dtype=np.int64)
        self.episodes = np.full(count, -1, dtype=np.int64)
        self._world: World | None = None
        self._values = self._compiled()
        self._loaded = False
        self._seen: np.ndarray | None = None
        self._draw: Draw | None = None
        self._driven: Params | None = None
        self._pool: World | None = None
        self._beginnings = Beginnings(self._begin, count)
        self._block: dict[str, Tensor] | None = None
        self._drawn: dict[str, np.ndarray] = {}
        self._used = 0
        self._ahead = max(1, _NORMALS_AT_ONCE // (count * self.task.vehicles))

    def _compiled(self) -> Values | None:
        """Return what steps without a graph, where that can be."""
        made = self.settings
        if made.output != "numpy" or made.device.type != "cpu" or dispatch.surroundings() is not None:
            return None
        from idm_env.envs.values import Values

        return Values(self.task, self._commanded, self._told)

    @property
    def begun(self) -> bool:
        """Whether there was a reset."""
        return self._loaded or self._world is not None

    @property
    def world(self) -> World | None:
        """The worlds as they are now, or None before the first reset."""
        if self._world is None and self._loaded and self._values is not None:
            self._world = self._values.current()
        return self._world

    @world.setter
    def world(self, world: World | None) -> None:
        self._world, self._loaded = world, False

    def glance(self) -> World:
        """Return the worlds as they are now, for reading only and until the next step."""
        if self._world is None and self._loaded and self._values is not None:
            return self._values.current(own=False)
        assert self._world is not None
        return self._world

    # -- beginnings ----------------------------------------------------------------------------------------------

    def seed(self, rows: Sequence[int] | np.ndarray, seeds: Sequence[int]) -> None:
        """Give rows new seeds; their next episode is the first of that seed."""
        # Seeds beyond 63 bits are folded: Gymnasium allows any whole number.
        self.seeds[rows] = [whole("seed", s, 0) & ((1 << 63) - 1) for s in seeds]
        self.episodes[rows] = -1
        self._beginnings.forget()

    def reset(self, rows: np.ndarray | None = None, state: State | None = None) -> Tensor | np.ndarray:
        """Begin a new episode in all or in some rows (indices); return the observations of all of them.

        ``state`` replaces what would be drawn, with its graph. Everything else begins from constants. ValueError, with
        nothing begun, for a state that does not fit (``idm_env.envs.given``).
        """
        every = rows is None or len(rows) == self.count
        index = np.arange(self.count) if rows is None else rows
        device = self.settings.device
        draw = self._draws(index, self.episodes[index] + 1)
        if state is not None:
            state = self._given(state, draw)
        self.episodes[index] += 1
        fresh, self._driven = self._beginnings.take(index, self.episodes), None
        if state is not None:
            fresh = fresh._replace(state=state)
        if every or not self.begun or self._draw is None:
            self.world, self._draw = fresh, draw
        elif self._values is not None and self._loaded and self._seen is not None:
            self._values.replace(index, fresh)
            self._draw = Draw(self._draw.key.index_put((torch.as_tensor(index),), draw.key))
            self._world = self._block = None
            # Only these rows look anew.
            self._seen[index] = self.task.observe(fresh).detach().numpy()
            return self._seen.copy()
        else:
            where = torch.as_tensor(index, device=device)
            self.world = mapped(lambda old, new: old.index_put((where,), new), self.world, fresh)
            self._draw = Draw(self._draw.key.index_put((where,), draw.key))
        self._block = None
        assert self.world is not None
        return self.task.observe(self.world).clone()

    def _draws(self, rows: np.ndarray, episodes: np.ndarray) -> Draw:
        device = self.settings.device
        return Draw.of(torch.as_tensor(self.seeds[rows], device=device), torch.as_tensor(episodes, device=device))

    @torch.no_grad()
    def _begin(self, rows: np.ndarray, episodes: np.ndarray) -> World:
        draw = self._draws(rows, episodes)
        if not self.task.warmup_pool:
            return self.task.reset(draw, self.params)
        if self._pool is None:
            size, device = self.task.warmup_pool, self.settings.device
            seeds = torch.arange(size, device=device)
            self._pool = self.task.reset(Draw.of(seeds, torch.full_like(seeds, -1)), self.params)
        picked = (draw.uniforms(_POOL_STREAM, 1, torch.float64).squeeze(-1) * self.task.warmup_pool).long()
        return mapped(lambda pooled: pooled[picked], self._pool)

    @torch.no_grad()
    def _like(self, draw: Draw) -> State:
        """Return the state with which the task would begin, before any warm-up."""
        return self.task.begin(draw, self.task.driven(self.task.who(draw), self.params)).state

    def _given(self, state: Any, draw: Draw) -> State:
        return checked(state, self._like(draw), self.task.road)

    def set_params(self, params: Params) -> None:
        """Replace the parameters (tensors, which may require grad); they hold from the next step on."""
        self.task.simulator.check(params)
        self.params, self._driven = params, None
        self._pool = None
        self._beginnings.forget()

    # -- steps ---------------------------------------------------------------------------------------------------

    def _normals(self, clock: Callable[[], Tensor]) -> dict[str, Tensor] | None:
        """Return the normals of a block of steps, drawn ahead where the batch is small; ``_used − 1`` is this step."""
        if not self.task.simulator.draws:
            return None
        if self._block is None or self._used >= self._ahead:
            assert self._draw is not None
            self._block = self.task.normals(self._draw, clock(), self._ahead, self.settings.dtype)
            self._used = 0
            if self._values is not None:
                self._drawn = {name: x.numpy().reshape(-1) for name, x in self._block.items()}
        self._used += 1
        return self._block

    def step(self, action: Tensor | np.ndarray | None, live: Tensor | None = None) -> Outcome:
        """Advance every row; ``action`` has shape ``(n, agents)``, None leaves everybody to the drivers.

        It is a tensor, or an array of the simulation's precision with numpy output.

        ``live`` (bool, ``(n, agents)``) leaves only single agents' vehicles to their drivers, and drops their commands.
        """
        if self._values is not None and not self.task.simulator.untried:
            told = self._step_values(action, live)
            if told is not None:
                return Outcome.of(told)
        with torch.no_grad() if self.settings.output == "numpy" else contextlib.nullcontext():
            return Outcome.of(self._step_torch(action, live))

    def _step_torch(self, action: Tensor | np.ndarray | None, live: Tensor | None) -> dict[str, Any]:
        if isinstance(action, np.ndarray):
            action = torch.as_tensor(action, device=self.settings.device)
        before, task = self.world, self.task
        assert before is not None
        block = self._normals(lambda: before.state.step)
        normals = None if block is None else {name: x[self._used - 1] for name, x in block.items()}
        command, given, inputs = self._commanded(before, action, normals, live)
        # With torch output always the step itself, so that values are the same bits with and without a graph.
        simulator = task.simulator
        advance = simulator.step if self.settings.output == "torch" else simulator.advance
        state = advance(before.state, inputs, task.driven(before.episode, self.params))
        after = before._replace(state=state)
        if command is None:
            command = state.speed.new_zeros(self.count, len(task.agents))
        self.world = after
        told = self._told(before, command, given, after, action is not None)
        # What a task tells may be a part of its state: whoever is told gets numbers of his own.
        told = {name: x.clone() for name, x in told.items()}
        return {n: x.cpu().numpy() for n, x in told.items()} if self.settings.output == "numpy" else told

    def _step_values(self, action: Tensor | np.ndarray | None, live: Tensor | None) -> dict[str, Any] | None:
        """Return what is told of a step by compiled loops; None, with nothing changed, where there are none."""
        values, world = self._values, self._world
        assert values is not None
        if world is not None and not self._loaded:
            values.load(world)
        given = None if action is None else np.asarray(action).reshape(-1)
        used, block = self._used, self._block
        try:
            normals = self._normals(values.clock)
            noise = None if normals is None else self._drawn
            who = None if live is None else live.numpy().reshape(-1)
            if self._driven is None:
                self._driven = self.task.driven(self.glance().episode, self.params)
            told = values.step(given, who, noise, max(self._used - 1, 0), self._driven)
        except Untraceable:
            # Said once, as a warning, where an effect is why (``kernels.printed``); NaN the step itself tells.
            self._world = self.world
            self._values, self._used, self._block = None, used, block
            return None
        # What is told is written to by whom it pleases.
        self._world, self._loaded, self._seen = None, True, told["observation"].copy()
        return told

    def _commanded(
        self,
        world: World,
        action: Tensor | None,
        normals: Mapping[str, Tensor] | None = None,
        live: Tensor | None = None,
    ) -> tuple[Tensor | None, Tensor | None, Mapping[str, Any]]:
        """Return commands, commands as the failsafe lets them pass, and the inputs of a step."""
        task = self.task
        command = None if action is None else task.command(action)
        given = None if command is None else task.limit(world, command)
        inputs = task.wishes(task.inputs(world, given, normals, live), action, live)
        if command is not None and live is not None:
            command = torch.where(live, command, 0.0)
        return command, given, inputs

    def _told(
        self, before: World, command: Tensor, given: Tensor | None, after: World, commanded: bool
    ) -> dict[str, Tensor]:
        """Return everything that faces tell of a step, by name."""
        task = self.task
        terminated, truncated = task.ended(after)
        details = self._details(after, command if commanded else None, given, terminated)
        if self.limit is not None:
            truncated = truncated | (after.state.step >= self.limit).unsqueeze(-1)
        reward = task.reward(before, command, after, terminated)
        if len(task.agents) == 1:
            ends, cut = terminated[..., 0], truncated[..., 0]
        else:
            ends, cut = terminated.any(-1), (truncated | terminated).all(-1) & truncated.any(-1)
        return {
            "observation": task.observe(after),
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "whole_reward": reward.mean(-1),
            "whole_terminated": ends,
            "whole_truncated": cut,
            **{f"info_{name}": x for name, x in details.items()},
        }

    def _details(
        self, after: World, command: Tensor | None, given: Tensor | None, crashed: Tensor
    ) -> dict[str, Tensor]:
        """Return what infos tell of a step (``idm_env.envs.info``) and no more, shape ``(n, agents)`` each."""
        task, asked, found = self.task, self.settings.info, dict[str, Tensor]()
        if "accel" in asked:
            found["accel"] = task.pick(after.state.accel)
        if "command" in asked:
            shape = (len(after.state.speed), len(task.agents))
            found["command"] = after.state.accel.new_full(shape, torch.nan) if command is None else command
        if "failsafe" in asked:
            if command is None or given is None or not task.failsafe:
                found["failsafe"] = torch.zeros_like(crashed)
            else:
                found["failsafe"] = given < command
        if "crash" in asked:
            found["crash"] = crashed
        return found | {name: x for name, x in task.told(after).items() if name in asked} if asked else found

    def detach(self) -> None:
        """Cut the graph behind the present state, for truncated back-propagation."""
        if self.world is not None:
            self.world = mapped(lambda x: x.detach(), self.world)
