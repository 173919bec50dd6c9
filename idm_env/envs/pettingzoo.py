"""PettingZoo: every controlled vehicle is an agent of its own, in any of the tasks.

``parallel_env(**keywords)`` steps all agents at once; ``env(**keywords)`` and ``raw_env(**keywords)`` are the same
turn by turn. Keywords are those of ``gym.make("DiffIDM-v0", …)``, with ``max_cycles`` as another name of
``max_episode_steps``.

Shapes: an agent observes ``[features]``; the state of the traffic is one row, ``[features of all]``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import torch
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from idm_env.envs.batch import Batch, Outcome
from idm_env.envs.gym import Pictures
from idm_env.envs.info import ids
from idm_env.envs.network_faces import network_parallel_env
from idm_env.envs.settings import PICTURES, reset_options, settings
from idm_env.envs.spaces import action_of, action_space, numpy_dtype, observation_box
from idm_env.tasks import is_on_network
from idm_env.validation import shown, whole

_SPEED_SCALE, _GAP_SCALE, _FARTHEST = 30.0, 100.0, 1000.0


class parallel_env(Pictures, ParallelEnv[str, np.ndarray, np.ndarray]):  # noqa: N801  (PettingZoo's name)
    """All agents step at once: agent ``vehicle_i`` commands vehicle i.

    An agent that has terminated or been truncated leaves ``agents``, and its vehicle goes back to its driver. Where
    vehicles enter and leave, every trip is an agent of its own, ``vehicle_i_trip_k``: it appears when its vehicle
    enters, and terminates when that has left. While no agent is there traffic goes on until one is, or the end. The ego
    of ``controlled=1`` is one agent until the end, which observes zeros while it is away.
    With ``fixed`` agents are the slots ``vehicle_i``, there until the end, as TorchRL's ``PettingZooWrapper`` needs.
    The mask ``info["present"]`` says whose vehicle is on the road; others observe zeros, and their actions do nothing.
    Infos then hold numbers alone, and after ``reset`` the same names as after a step.
    ``state()`` is the whole traffic: speed/30 of every vehicle, then gap/100 (capped at 1000 m). Numpy only:
    gradients are the business of the Gymnasium faces.

    Raises:
        TypeError: For a keyword that does not exist, with a suggestion.
        ValueError: In one line, for values that cannot be, and for actions that are missing or not finite.
    """

    metadata: dict[str, Any] = {"name": "diffidm_v0", "is_parallelizable": True, **PICTURES}  # noqa: RUF012

    def __new__(cls, **keywords: Any) -> Any:
        """Return the environment of a task: of ``signals`` and ``junction`` that of networks."""
        if is_on_network(keywords.get("task")):
            return network_parallel_env(**keywords)
        return super().__new__(cls)

    def __init__(
        self, *, max_cycles: int | None = None, render_mode: str | None = None, fixed: bool = False, **keywords: Any
    ) -> None:
        limit = keywords.pop("max_episode_steps", max_cycles)
        if max_cycles not in (None, limit):
            raise ValueError(f"max_cycles = {max_cycles} and max_episode_steps = {limit} are one limit. Leave one out.")
        own = settings(max_episode_steps=limit, render_mode=render_mode, **keywords)
        if own.output != "numpy":
            raise ValueError("output = 'torch' has no meaning for PettingZoo. Use gym.make_vec for gradients.")
        self.settings = own
        self.task = own.task
        self.max_cycles = own.limit
        self.render_mode = own.render_mode
        self.batch = Batch(own, 1)
        self._fixed, self._journeys = fixed, 0 if fixed or self.task.ego else self.task.journeys
        trips = [f"_trip_{k}" for k in range(1, self._journeys + 1)] or [""]
        self.possible_agents = [f"vehicle_{i}{trip}" for i in self.task.agents for trip in trips]
        self.agents: list[str] = []
        self._slots: list[str] = []
        seen, done = (partial(observation_box, self.task, own.dtype, 1), partial(action_space, self.task, 1))
        # Agents that begin later share one space: whoever seeds those of the first ones has seeded theirs.
        later = bool(self._journeys)
        self.observation_spaces, self.action_spaces = (
            dict.fromkeys(self.possible_agents, make()) if later else {a: make() for a in self.possible_agents}
            for make in (seen, done)
        )
        kind, n = numpy_dtype(own.dtype), self.task.vehicles
        low = np.repeat(np.array([0.0, -1.0], kind), n)
        high = np.repeat(np.array([10.0, _FARTHEST / _GAP_SCALE], kind), n)
        self.state_space = Box(low, high, dtype=kind)

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the space of an agent's observations: the same object at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the space of an agent's actions: the same object at every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Begin an episode: the first one of ``seed`` if that is given, the next one otherwise.

        ``options`` are those of ``DiffIDMEnv``; PettingZoo's own tests give another, ``"options"``, which says nothing.
        """
        chosen = reset_options(options, ("state", "options", *self.task.begins_with))
        self.batch.choose({name: x for name, x in chosen.items() if name in self.task.begins_with})
        if seed is not None or not self.batch.begun:
            self.batch.seed([0], [seeding.np_random(None if seed is None else whole("seed", seed, 0))[1]])
        # PettingZoo's own tests set it between episodes.
        self.batch.limit = self.max_cycles
        seen = np.asarray(self.batch.reset(state=chosen.get("state"))[0]).copy()
        self.agents = self._appear()
        while not self.agents:
            seen = np.array(self.batch.step(None).observation[0])
            self.agents = self._appear()
        self._watch(1)
        return self._by_agent(seen), {agent: self._begun(i) for i, agent in enumerate(self._slots) if agent}

    def step(
        self, actions: dict[str, Any] | None
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Advance by the time for which an action is held, with one action for every agent that is still there.

        None as an action leaves an agent's vehicle to its driver; None in place of all of them leaves all.
        """
        if not isinstance(actions, dict | None):
            raise ValueError(f"actions = {shown(actions)} must map each of env.agents to its action.")
        if not self.agents:
            return {}, {}, {}, {}, {}
        before = self._slots
        live = [agent in self.agents for agent in before]
        chosen = [self._action(a, actions) if here else None for a, here in zip(before, live, strict=True)]
        act = [x is not None for x in chosen]
        commands = np.zeros((1, len(self.task.commands), len(live)), numpy_dtype(self.settings.dtype))
        for i in np.flatnonzero(act):
            commands[0, :, i] = chosen[i]
        with torch.no_grad():
            outcome = self.batch.step(
                torch.from_numpy(commands.reshape(1, -1)).to(self.settings.device) if any(act) else None,
                None if all(act) or not any(act) else torch.tensor([act], device=self.settings.device),
            )
        observations = self._by_agent(np.array(outcome.observation[0]))
        rewards, terminated, truncated = (self._by_agent(x[0].tolist()) for x in outcome[1:4])
        infos = {agent: self._info(i, outcome) for i, agent in enumerate(before) if live[i]}
        self.agents = [agent for agent in self.agents if not (terminated[agent] or truncated[agent])]
        if self._journeys and self.agents:
            self._arrived(outcome, (observations, rewards, terminated, truncated, infos))
        self._watch(1)
        return observations, rewards, terminated, truncated, infos

    def _appear(self) -> list[str]:
        """Return the agents that are there now, and note whose every slot is ("" for nobody's)."""
        if not self._journeys:
            self._slots = list(self.possible_agents)
            return list(self._slots)
        state = self.batch.glance().state
        assert state.present is not None and state.lanes is not None and state.lanes.trips is not None
        presence, trip = (self.task.pick(x)[0].tolist() for x in (state.present, state.lanes.trips.entered))
        self._slots = [
            f"vehicle_{i}_trip_{k}" if here else "" for i, here, k in zip(self.task.agents, presence, trip, strict=True)
        ]
        return [agent for agent in self._slots if agent]

    def _arrived(self, outcome: Outcome, columns: tuple[dict[str, Any], ...]) -> None:
        """End the agents whose trips are over, and begin those of whose vehicles have entered."""
        seen, rewards, terminated, truncated, infos = columns
        now = self._appear()
        for agent in set(self.agents) - set(now):
            terminated[agent], seen[agent] = True, np.zeros_like(seen[agent])
        while not now:
            outcome = self.batch.step(None)
            if bool(outcome.whole.terminated[0] | outcome.whole.truncated[0]):
                break
            now = self._appear()
        for i, agent in enumerate(self._slots):
            if agent and agent not in self.agents:
                seen[agent], infos[agent] = np.array(outcome.observation[0, i]), self._info(i, outcome)
                rewards[agent], terminated[agent], truncated[agent] = 0.0, False, False
        self.agents = now

    def _begun(self, i: int) -> dict[str, Any]:
        """Return the recorded id of an agent's vehicle, where there is one; of fixed agents all that a step tells."""
        if self._fixed:
            none = np.zeros(len(self.task.reward_names))
            first = {"accel": 0.0, "command": np.nan, "failsafe": False, "crash": False, "rewards": none}
            first |= {} if self.batch.counters is None else {"stops": 0}
            first |= {name: x[0, i].item() for name, x in self.task.info(self.batch.glance()).items()}
            return {name: x for name, x in first.items() if name in self.settings.info}
        names = ids(self.batch)
        return {} if names is None else {"vehicle_id": names[i]}

    def _info(self, i: int, outcome: Outcome) -> dict[str, Any]:
        """Return what ``idm_env.envs.info`` says of a step, as numbers of one agent."""
        info: dict[str, Any] = {
            name: value[0, i].copy() if name == "rewards" else value[0, i].item()
            for name, value in outcome.details.items()
        }
        if self._fixed:
            return info
        if info.get("crash"):
            info["crash_reason"] = self.batch.crash_reason(0, i if self.task.shares > 1 else None)
        return info | self._begun(i)

    def _action(self, agent: str, actions: dict[str, Any] | None) -> Any:
        """Return the commands of an agent, None where its vehicle is left to its driver."""
        if actions is None or (agent in actions and actions[agent] is None):
            return None
        if agent not in actions:
            raise ValueError(f"there is no action for agent '{agent}'. Give one for each of env.agents.")
        try:
            return action_of(actions[agent], (len(self.task.commands),), self.settings)
        except ValueError as error:
            raise ValueError(f"agent '{agent}': {error}") from None

    def _by_agent(self, values: Any) -> dict[str, Any]:
        return {agent: values[i] for i, agent in enumerate(self._slots) if agent in self.agents}

    @property
    def detectors(self) -> list[dict[str, Any]]:
        """What the task's ``detectors`` have told in this episode, as of ``DiffIDMEnv``."""
        return [] if self.batch.counters is None else list(self.batch.counters.tables[0])

    def state(self) -> np.ndarray:
        """Return the whole traffic, within ``state_space``. RuntimeError before ``reset``."""
        world = self.batch.world
        if world is None:
            raise RuntimeError("there is no state before reset. Call reset() first.")
        traffic = world.state
        gap = traffic.gap.clamp_max(_FARTHEST) / _GAP_SCALE
        seen = torch.cat((traffic.speed / _SPEED_SCALE, gap), dim=-1)[0].cpu().numpy()
        return np.clip(seen, self.state_space.low, self.state_space.high)

    def close(self) -> None:
        """Close the window, if there is one."""
        self.close_extras()


def raw_env(**keywords: Any) -> Any:
    """Return the environment turn by turn (AEC)."""
    return parallel_to_aec(parallel_env(**keywords))


def env(**keywords: Any) -> Any:
    """Return the environment turn by turn, with PettingZoo's check of the order of calls."""
    turns = raw_env(**keywords)
    return turns if isinstance(turns, OrderEnforcingWrapper) else OrderEnforcingWrapper(turns)


if hasattr(pettingzoo, "register"):  # from 1.27 on ``pettingzoo.make("parallel", "diffidm_v0")``
    for kind, face in ("parallel", "parallel_env"), ("aec", "env"):
        pettingzoo.register(kind, "diffidm_v0", f"{__name__}:{face}")
