"""Faces of tasks on networks: a vector, one environment, and PettingZoo, where every signal or vehicle is an agent.

All worlds begin and end together: an episode has as many steps in each of them, and nothing ends it before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from pettingzoo import ParallelEnv

from idm_env.envs.settings import reset_options
from idm_env.tasks import with_keywords
from idm_env.tasks.checks import by_name
from idm_env.tasks.junction import JunctionTask
from idm_env.tasks.network_task import NetworkStep, NetworkTask
from idm_env.tasks.random import Draw
from idm_env.tasks.signals import SignalsTask
from idm_env.validation import shown, whole

KINDS: dict[str, type[SignalsTask] | type[JunctionTask]] = {x.name: x for x in (SignalsTask, JunctionTask)}
"""Tasks on networks by name."""


class _Worlds:
    """Some worlds of a task, their seeds and the numbers of their episodes."""

    def __init__(self, count: int, choices: dict[str, Any]) -> None:
        kind = KINDS[choices.pop("task", SignalsTask.name)]
        if (limit := choices.pop("max_episode_steps", None)) is not None:
            NetworkTask.ranges["hold"].check("hold", hold := choices.get("hold", kind.hold))
            choices["duration"] = whole("max_episode_steps", limit, 1, round(86_400 / hold)) * hold
        self.task: Any = with_keywords(kind.name, kind, choices)
        self.count = count
        self.seeds, self.episodes = np.zeros(count, np.int64), np.full(count, -1)
        self.world: Any = None
        self.done = 0

    def seed(self, seeds: Sequence[int]) -> None:
        """Begin anew with the first episodes of these seeds."""
        self.seeds, self.episodes = np.array([s % (1 << 63) for s in seeds], np.int64), np.full(self.count, -1)

    def begin(self, options: Any = None) -> np.ndarray:
        """Begin the next episode in all worlds; return observations ``[B, S, F]``. ValueError for options."""
        reset_options(options, ())
        self.episodes += 1
        self.done = 0
        draw = Draw.of(torch.from_numpy(self.seeds), torch.from_numpy(self.episodes))
        self.world = self.task.begin(draw)
        return self.task.observe(self.world)

    def step(self, actions: Any, shape: tuple[int, ...]) -> tuple[np.ndarray, NetworkStep, bool]:
        """Do a step; return observations ``[B, S, F]``, the outcome, and whether the episodes are over.

        RuntimeError before ``begin``; ValueError for actions that cannot be, or are not of this shape.
        """
        if self.world is None:
            raise RuntimeError("step was called before reset. Call reset() first.")
        if self.done >= self.task.horizon:
            raise RuntimeError("the episodes are over. Call reset() first.")
        if actions is not None:
            actions = self.task.check_actions(actions, shape).reshape(self.count, -1)
        self.world, outcome = self.task.step(self.world, actions)
        self.done += 1
        return self.task.observe(self.world), outcome, self.done == self.task.horizon


def _actions(task: Any, counts: Any = None) -> gymnasium.Space[Any]:
    """Return the space of all agents' actions, or of one agent's with so many (``counts``)."""
    if task.counts is None:
        return Box(-1.0, 1.0, (len(task.names) if counts is None else 1,), np.float32)
    return MultiDiscrete(task.counts) if counts is None else Discrete(int(counts))


def _info(outcome: NetworkStep) -> dict[str, np.ndarray]:
    """Return an outcome's figures for infos, of each world ``[B]``."""
    return {name: np.asarray(x) for name, x in outcome._asdict().items() if name != "reward"}


class NetworkVectorEnv(VectorEnv):
    """Signals or vehicles of a network as agents; keywords: ``task``, ``"signals"`` or ``"junction"``, and those of it.

    A world's agents are one joint agent: observations one after the other, an action for each, the mean of rewards.
    Signals choose phases, vehicles numbers from −1 (brake) to 1; see ``SignalsTask`` and ``JunctionTask``. With
    ``shared`` every agent of every world is an environment of its own, as one policy for all needs: ``num_envs``
    times agents rows. Worlds reset within the step that ends them (``"SameStep"``). ``step(None)`` leaves signals to
    their plans, and vehicles to their drivers. Infos tell, of each world, vehicles ``inside``, ``waiting``,
    ``halting`` and ``arrived``, and the time ``lost`` in the step (s).

    Raises:
        TypeError: For a keyword that does not exist, with a suggestion.
        ValueError: For a value that cannot be; in one line, with value, rule and cure.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, num_envs: int = 1, shared: bool = False, **choices: Any) -> None:
        if not isinstance(shared, bool):
            raise ValueError(f"shared = {shown(shared)} must be True or False.")
        self.worlds = _Worlds(whole("num_envs", num_envs, 1), choices)
        self.task, agents = self.worlds.task, len(self.worlds.task.names)
        self._shared, self._each = shared, agents if shared else 1
        self.num_envs = num_envs * self._each
        wide = self.task.features * (1 if shared else agents)
        self.single_observation_space = Box(0.0, 1.0, (wide,), np.float32)
        most = 1 if self.task.counts is None else self.task.counts.max()
        self.single_action_space = _actions(self.task, most if shared else None)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes in all worlds, with a seed s the first of s + i in world i; return observations ``[n, F]``.

        Of seeds in a sequence, one for each row, the first ones are those of worlds. ValueError for any others.
        """
        if isinstance(seed, Sequence):
            if len(seed) != self.num_envs:
                raise ValueError(f"seed = {shown(seed)} must be a number, or one for each of {self.num_envs} rows.")
            self.worlds.seed([whole("seed", s, 0) for s in seed[: self.worlds.count]])
        elif seed is not None or self.worlds.world is None:
            super().reset(seed=None if seed is None else whole("seed", seed, 0))
            self.worlds.seed([int(self.np_random_seed or 0) + i for i in range(self.worlds.count)])
        return self.worlds.begin(options).reshape(self.num_envs, -1), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all worlds by ``hold`` seconds with actions ``[n]`` or ``[n, S]``; ValueError for what is none."""
        seen, outcome, over = self.worlds.step(actions, self.action_space.shape or ())
        reward = outcome.reward.reshape(-1) if self._shared else outcome.reward.mean(1)
        rows = seen.reshape(self.num_envs, -1)
        info: dict[str, Any] = {name: np.repeat(x, self._each) for name, x in _info(outcome).items()}
        info |= {f"_{name}": np.full(self.num_envs, True) for name in info}
        ends = np.full(self.num_envs, over)
        if over:
            last, rows = rows, self.worlds.begin().reshape(rows.shape)
            info = {"final_obs": last, "final_info": info, "_final_obs": ends, "_final_info": ends}
        return rows, reward, np.zeros(self.num_envs, bool), ends, info


class NetworkEnv(gymnasium.Env):
    """One world: ``gym.make("DiffIDM-v0", task="signals")`` or ``"junction"``; as a row of ``NetworkVectorEnv``."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, **choices: Any) -> None:
        self.worlds = _Worlds(1, choices)
        self.task, agents = self.worlds.task, len(self.worlds.task.names)
        self.observation_space = Box(0.0, 1.0, (agents * self.task.features,), np.float32)
        self.action_space = _actions(self.task)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the first episode of ``seed`` if that is given, else the next one; return observations ``[S F]``."""
        super().reset(seed=None if seed is None else whole("seed", seed, 0))
        if seed is not None or self.worlds.world is None:
            self.worlds.seed([self.np_random_seed])
        return self.worlds.begin(options).reshape(-1), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by ``hold`` seconds with actions ``[S]``; None for no agents."""
        seen, outcome, over = self.worlds.step(action, self.action_space.shape or ())
        info = {name: x[0].item() for name, x in _info(outcome).items()}
        return seen.reshape(-1), float(outcome.reward.mean(1)[0]), False, over, info


class network_parallel_env(ParallelEnv[str, np.ndarray, Any]):  # noqa: N801  (as PettingZoo names environments)
    """PettingZoo: an agent is a signal, by its name, in task ``"signals"``, a vehicle's slot in ``"junction"``."""

    metadata: dict[str, Any] = {"name": "diffidm_networks_v0", "is_parallelizable": True, "render_modes": []}  # noqa: RUF012

    def __init__(self, max_cycles: int | None = None, **choices: Any) -> None:
        if max_cycles is not None:
            choices["max_episode_steps"] = max_cycles
        self.worlds = _Worlds(1, choices)
        self.task, self.render_mode = self.worlds.task, None
        self.possible_agents = [*self.task.names]
        self.agents: list[str] = []
        wide = self.task.features
        self.observation_spaces = {a: Box(0.0, 1.0, (wide,), np.float32) for a in self.possible_agents}
        counts = [1] * len(self.possible_agents) if self.task.counts is None else self.task.counts
        self.action_spaces = {a: _actions(self.task, n) for a, n in zip(self.possible_agents, counts, strict=True)}

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the space of an agent's observations: the same object at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the space of an agent's actions: the same object at every call."""
        return self.action_spaces[agent]

    def _by_agent(self, values: Any) -> dict[str, Any]:
        return dict(zip(self.possible_agents, values, strict=True))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode: the first one of ``seed`` if that is given, the next one otherwise."""
        if seed is not None or self.worlds.world is None:
            self.worlds.seed([seeding.np_random(None if seed is None else whole("seed", seed, 0))[1]])
        self.agents = [*self.possible_agents]
        return self._by_agent(self.worlds.begin()[0]), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any] | None) -> tuple[Any, Any, Any, Any, Any]:
        """Advance by ``hold`` seconds with an action of every agent; None in place of all of them.

        ValueError for an agent without an action, or with several.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        if actions is not None:
            by_agent = by_name("actions", actions)
            for agent in self.agents:
                if np.size(by_agent.get(agent, ())) != 1:
                    raise ValueError(f"there is no action for agent '{agent}'. Give one for each of env.agents.")
        chosen = None if actions is None else [np.asarray(by_agent[agent]).item() for agent in self.agents]
        seen, outcome, over = self.worlds.step(chosen, (len(self.agents),))
        infos = {agent: {name: x[0].item() for name, x in _info(outcome).items()} for agent in self.agents}
        ends = dict.fromkeys(self.agents, over)
        self.agents = [] if over else self.agents
        paid, ended = self._by_agent(outcome.reward[0].tolist()), dict.fromkeys(self.possible_agents, False)
        return self._by_agent(seen[0]), paid, ended, ends, infos
