"""``DiffIDM-v0`` for Gymnasium: one environment, a batch of one of the same code as the vector."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from torch import Tensor

from idm_env import compat
from idm_env.envs.batch import Batch
from idm_env.envs.info import begun, single
from idm_env.envs.recording import Recorder
from idm_env.envs.settings import PICTURES, Settings, affordable, reset_options, settings
from idm_env.envs.spaces import action_of, action_space, observation_box
from idm_env.envs.unrolled import Unrolled, unroll
from idm_env.tasks import Task
from idm_env.types import Params, State, mapped
from idm_env.validation import whole

LIMIT = "max_episode_steps"


def asked_of_make() -> int | None:
    """Return the ``max_episode_steps`` given to a ``gym.make`` that is making this environment; None if there is none.

    Gymnasium keeps it for its own TimeLimit and tells the environment nothing, but a task must know the end: starts in
    a record, the cost of a crash and whether the record is long enough all depend on it. So it is read where it stands.
    """
    frame = compat.locals_of(gymnasium.make.__code__)
    if frame is None:
        return None
    limit = frame.get(LIMIT)
    return getattr(frame.get("env_spec"), LIMIT, None) if limit is None else limit


class Pictures:
    """Mixin: pictures and recordings of a batch's environments, and windows that go with their face."""

    task: Task
    batch: Batch
    render_mode: str | None
    _viewers: tuple[Any, ...] = ()
    _kept: tuple[list[Any], ...] = ()

    def _watch(self, count: int) -> None:
        """Show what has just happened (``human``), or keep its pictures (``rgb_array_list``)."""
        if self.render_mode == "human":
            self._draw(1)
        elif self.render_mode == "rgb_array_list":
            self._kept = (*self._kept, self._draw(count))

    def _pictures(self, count: int) -> list[Any]:
        """Return pictures of the first environments, as ``render``. RuntimeError before ``reset``."""
        if self.render_mode != "rgb_array_list":
            return self._draw(count)
        moments, self._kept = self._kept, ()
        return [[picture for moment in moments for picture in moment[k]] for k in range(count)]

    def _draw(self, count: int) -> list[Any]:
        """Return pictures of the first environments (``rgb_array``), or show them (``human``, and no ``render_mode``).

        RuntimeError before ``reset``.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render was called without a render_mode. Pass render_mode='rgb_array'.")
            return [None] * count
        if not self.batch.begun:
            raise RuntimeError("there is nothing to see before reset. Call reset() first.")
        from idm_env.envs.render import Viewer

        missing = range(len(self._viewers), count)
        self._viewers = (*self._viewers, *(Viewer(self.render_mode) for _ in missing))
        state, params = self.batch.glance().state, self.batch.episode_params()
        return [viewer.show(self.task, state, row, params) for row, viewer in enumerate(self._viewers[:count])]

    def render(self) -> Any:
        """Return a picture (``rgb_array``), or show it (``human``). RuntimeError before ``reset``.

        ``"rgb_array_list"`` is a list of those since the last call, ten a second where an action is held for longer.
        """
        return self._pictures(1)[0]

    def record(self) -> Recorder:
        """Record every vehicle from now on; return a ``Recorder`` with the methods ``table()`` and ``write``.

        ``recording.write("run.parquet")`` writes a trajectory file that ``idm-env plot``, ``fit`` and ``explain`` read.
        """
        batch = self.batch
        batch.recording = Recorder(self.task, batch.count)
        if batch.begun:
            batch.recording.begin(np.arange(batch.count), batch.glance().state)
        return batch.recording

    def close_extras(self, **kwargs: Any) -> None:
        """Close the windows, if there are any."""
        for viewer in self._viewers:
            viewer.close()
        self._viewers = ()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the windows: everything else can be pickled."""
        return {**self.__dict__, "_viewers": ()}


class Face(Pictures):
    """Mixin: a ``spec`` that says after how many steps episodes are cut off, and what gradients go through."""

    metadata: dict[str, Any]
    _spec: EnvSpec | None = None
    _flat: tuple[int, ...] = ()

    def _take(self, own: Settings, count: int) -> int:
        """Take over what ``count`` environments are made of; return how many agents each has."""
        self.settings, self.task, self.render_mode = own, own.task, own.render_mode
        self.batch, self._numpy = Batch(own, count), own.output == "numpy"
        fps = 10.0 if own.render_mode == "rgb_array_list" else 1.0 / self.task.step_time
        self.metadata = {**type(self).metadata, "render_fps": max(1, round(fps))}
        return len(self.task.agents)

    def _out(self, observation: Any) -> Any:
        """Return observations as they are handed out: flat, and with numpy output nobody else's."""
        flat = observation.reshape(*self._flat, -1)
        own = flat.detach().cpu().numpy() if self._numpy and isinstance(flat, Tensor) else flat
        return own.copy() if self._numpy else own

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made this environment from, with the ``max_episode_steps`` in force."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else dataclasses.replace(spec, max_episode_steps=self.task.horizon)

    @property
    def state(self) -> State:
        """A copy of the state of the traffic, with its graph, one row per environment.

        RuntimeError before ``reset``.
        """
        world = self.batch.world
        if world is None:
            raise RuntimeError("there is no state before reset. Call reset() first.")
        return mapped(lambda x: x.clone(), world.state)

    @property
    def detectors(self) -> list[list[dict[str, Any]]]:
        """What the task's ``detectors`` have told in the present episodes, one list of intervals per environment.

        An interval has ``detector`` (name), ``begin``, ``end`` (s), ``count``, ``speed`` (mean, m/s) and ``occupancy``.
        """
        counters = self.batch.counters
        return [] if counters is None else [list(table) for table in counters.tables]

    @property
    def params(self) -> Params:
        """The parameters in force; assign tensors that require grad to differentiate with respect to them."""
        return self.batch.params

    @params.setter
    def params(self, params: Params) -> None:
        self.batch.set_params(params)

    def unroll(
        self, policy: Callable[..., Any], steps: int, push: Tensor | None = None, hidden: Tensor | None = None
    ) -> Unrolled:
        """Do a window of steps with a policy between them, in one call; needs ``output="torch"``.

        ``policy`` maps observations ``(n, features)`` to actions ``(n, actions)``; ``push`` is added to its
        actions. With ``hidden`` ``(n, …)`` it maps (observations, hidden) to (actions, hidden) as
        ``torch.nn.GRUCell`` does; the window's own ``hidden`` is what the next one is given, and 0 where an episode
        begins. Episodes that end begin anew within the window, and gradients are cut there. A torch module of small
        layers (linear, tanh, ReLU, ELU, SiLU, layer norm, GRU cell, sums and products with constants), which agents may
        share, is compiled with the steps, and the window is one node of autograd, with rewards, observations and
        actions as outputs; what such a policy does is torch's to rounding. Every other callable runs between compiled
        steps. Kept are the worlds of all steps.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: While recording, for steps below 1 or beyond the memory, numpy output, ``hidden`` of other rows,
                and a policy whose actions or hidden numbers are not finite or of another shape; with a compiled policy
                nothing has changed then.
        """
        if not self.batch.begun:
            raise RuntimeError("unroll was called before reset. Call reset() first.")
        if self.batch.settings.output != "torch":
            raise ValueError("output = 'numpy' has no gradients to unroll. Make the environment with output='torch'.")
        if self.batch.recording is not None:
            raise ValueError("a window of unroll is not recorded. Call step() while recording, or make another batch.")
        mode = self.batch.settings.autoreset_mode
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"autoreset_mode = '{mode.value}': unroll begins anew within the step. Use 'SameStep'.")
        affordable(self.batch.settings, self.batch.count, whole("steps", steps, 1, 10**9))
        return unroll(self.batch, policy, steps, push, hidden)

    def detach(self) -> None:
        """Cut the graph behind the present states, for truncated back-propagation."""
        self.batch.detach()


class DiffIDMEnv(Face, gymnasium.Env):
    """One environment: ``gym.make("DiffIDM-v0", task="ring", …)``.

    ``task`` is one of ``idm_env.tasks.TASKS``; its docstring defines the task, and its fields are further keywords,
    as are those of ``idm_env.envs.settings.settings``. All controlled vehicles are one agent here: their observations
    one after the other, the mean of their rewards, terminated with the first and truncated with the last of them.

    With ``output="numpy"`` observations are arrays and rewards floats. With ``output="torch"`` they are tensors that
    carry the graph from actions, parameters and the initial state; ``detach()`` cuts it. Actions are a float32 box of
    [−1, 1], scaled by ``max_command``; values beyond are clipped and have no gradient; ``None`` as an action leaves
    all vehicles to their drivers. ``info`` tells commands, what became of them, and crashes (``idm_env.envs.info``).

    Episodes are cut off after ``max_episode_steps``, or the task's own number of steps, which ``spec`` tells; a task
    that cannot have so many raises ValueError.

    ``reset(seed=s)`` begins the first episode of seed s, ``reset()`` the next one. ``reset(options={"state":
    state})`` starts from a given ``State`` of shape ``(1, vehicles)``, with its graph.

    Raises:
        TypeError: For a keyword that does not exist, with a suggestion.
        ValueError: For a value that cannot be; in one line, with value, rule and cure.
    """

    metadata: dict[str, Any] = {**PICTURES}  # noqa: RUF012  (Gymnasium declares it so)

    def __init__(self, render_mode: str | None = None, **keywords: Any) -> None:
        limit = asked_of_make()
        own = settings(render_mode=render_mode, **(keywords if limit is None else {**keywords, LIMIT: limit}))
        agents = self._take(own, 1)
        self.observation_space = observation_box(self.task, own.dtype, agents)
        self._shape = (agents * len(self.task.commands),)
        self.action_space = action_space(self.task, agents)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see the class for ``seed`` and ``options``."""
        chosen = reset_options(options, ("state", *self.task.begins_with))
        self.batch.choose({name: x for name, x in chosen.items() if name in self.task.begins_with})
        seed = None if seed is None else whole("seed", seed, 0)
        super().reset(seed=seed)
        if seed is not None or not self.batch.begun:
            # Without any seed the one that Gymnasium draws from the operating system is used.
            self.batch.seed([0], [self.np_random_seed if seed is None else seed])
        observation = self.batch.reset(state=chosen.get("state"))
        self._watch(1)
        return self._out(observation), begun(self.batch)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance by Δt; return observation, reward, terminated, truncated and info. RuntimeError before ``reset``."""
        if not self.batch.begun:
            raise RuntimeError("step was called before reset. Call reset() first.")
        actions = None if action is None else action_of(action, self._shape, self.settings)[None]
        outcome = self.batch.step(actions)
        self._watch(1)
        reward, terminated, truncated = outcome.whole
        value = reward.item() if self._numpy else reward[0]
        ends = terminated.item(), truncated.item()
        return self._out(outcome.observation), value, *ends, single(self.batch, outcome)

    def close(self) -> None:
        """Close the window, if there is one."""
        self.close_extras()
