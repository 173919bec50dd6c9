"""``gym.make_vec("DiffIDM-v0", num_envs=4096)``: a native batch, with all three modes of automatic reset."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from idm_env.envs.batch import Outcome
from idm_env.envs.gym import Face
from idm_env.envs.info import Rows
from idm_env.envs.settings import PICTURES, affordable, reset_options, settings
from idm_env.envs.spaces import action_of, action_space, observation_box
from idm_env.validation import shown, whole


class DiffIDMVectorEnv(Face, VectorEnv):
    """``num_envs`` environments in one batch; keywords as for ``DiffIDMEnv``.

    Environment i equals a single environment seeded with ``seed + i``. ``autoreset_mode`` is ``"SameStep"`` (the
    default, which Stable-Baselines3 and TorchRL take: the returned observation is the new episode's, the last one is
    in ``info["final_obs"]``), ``"NextStep"`` (Gymnasium's own default, which its observation wrappers for vectors need:
    the step after an end resets, with reward 0) or ``"Disabled"`` (the caller resets with ``options={"reset_mask":
    mask}``); the attribute and ``metadata`` say which.

    With ``output="torch"`` observations and rewards carry their graph; the observation of a fresh episode has none, and
    ``info["final_obs"]`` is a dense tensor with the graph of the ended episodes (rows of ``_final_obs`` hold; the
    others are 0).

    Raises:
        TypeError: For a keyword that does not exist, with a suggestion.
        ValueError: For a value that cannot be; in one line, with value, rule and cure.
    """

    metadata: dict[str, Any] = {**PICTURES, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  (as gymnasium's)

    def __init__(self, num_envs: int = 1, render_mode: str | None = None, **keywords: Any) -> None:
        own = settings(render_mode=render_mode, **keywords)
        self.num_envs = whole("num_envs", num_envs, 1, 10**18)
        affordable(own, num_envs)
        agents = self._take(own, num_envs)
        self.autoreset_mode = own.autoreset_mode
        self.metadata["autoreset_mode"] = own.autoreset_mode
        self.single_observation_space = observation_box(self.task, own.dtype, agents)
        self.single_action_space = action_space(self.task, agents)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rows = Rows(self.batch)
        self._flat = (num_envs,)
        self._shape = (num_envs, agents * len(self.task.commands))
        self._ended = np.zeros(num_envs, dtype=bool)

    # -- reset and step ------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes: in all environments, or in those of ``options["reset_mask"]``.

        A number seeds environment i with ``seed + i``; a sequence gives every one its own. ``options["state"]`` is a
        ``State`` to start from, one row per environment that is reset.
        """
        chosen = reset_options(options, ("state", "reset_mask", *self.task.begins_with))
        self.batch.choose({name: x for name, x in chosen.items() if name in self.task.begins_with})
        rows = self._masked(chosen.get("reset_mask"))
        self._seed(seed, rows)
        observation = self.batch.reset(rows, chosen.get("state"))
        self._ended[rows] = False
        self._watch(self.num_envs)
        return self._out(observation), self._rows.begun(np.isin(np.arange(self.num_envs), rows))

    def _masked(self, mask: Any) -> np.ndarray:
        if mask is None:
            return np.arange(self.num_envs)
        mask = mask.cpu().numpy() if isinstance(mask, Tensor) else mask
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(
                f"options['reset_mask'] = {shown(mask)} must be a bool array of shape ({self.num_envs},) with at "
                f"least one True."
            )
        if not self.batch.begun and not mask.all():
            raise ValueError("options['reset_mask'] leaves environments out before the first reset. Reset all once.")
        return np.flatnonzero(mask)

    def _seed(self, seed: int | Sequence[int | None] | None, rows: np.ndarray) -> None:
        seeds: list[int | None] = [None] * self.num_envs
        if isinstance(seed, Iterable) and getattr(seed, "ndim", True):
            seeds = list(seed)
        elif seed is not None:
            super().reset(seed=(first := whole("seed", seed, 0)))
            seeds = [first + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed has {len(seeds)} values for {self.num_envs} environments: give 1 or as many.")
        if not self.batch.begun and None in seeds:
            self.batch.seed(np.arange(self.num_envs), self._entropy())
        if seeded := [(row, number) for row in rows if (number := seeds[row]) is not None]:
            self.batch.seed(*map(list, zip(*seeded, strict=True)))

    def _entropy(self) -> list[int]:
        """Return the seeds that follow the one that Gymnasium draws from the operating system."""
        first = int(self.np_random_seed or 0)
        return [first + i for i in range(self.num_envs)]

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all environments by Δt; ``None`` as actions leaves all vehicles to their drivers.

        RuntimeError before ``reset``, and for environments that have ended.
        """
        if not self.batch.begun:
            raise RuntimeError("step was called before reset. Call reset() first.")
        mode = self.autoreset_mode
        over = np.flatnonzero(self._ended)
        if len(over) and mode is AutoresetMode.DISABLED:
            raise RuntimeError(f"environments {over[:5].tolist()} are over. Reset with options={{'reset_mask': mask}}.")
        batch_actions = None if actions is None else action_of(actions, self._shape, self.settings)
        with torch.no_grad() if self._numpy else contextlib.nullcontext():
            outcome = self.batch.step(batch_actions)
            observation, (reward, terminated, truncated) = outcome.observation, outcome.whole
            # Episodes that ended with the step before begin in this one: it is no step of theirs.
            stepped = ~self._ended
            if len(over):
                observation = self.batch.reset(over)
                went_on = stepped if self._numpy else torch.as_tensor(stepped, device=reward.device)
                reward, terminated, truncated = reward * went_on, terminated & went_on, truncated & went_on
            ended = terminated | truncated
            self._ended = ended if self._numpy else ended.cpu().numpy()
            same = mode is AutoresetMode.SAME_STEP and bool(self._ended.any())
            info = self._rows.stepped(outcome, ~self._ended if same else stepped)
            info |= self._rows.begun(np.ones_like(stepped))
            if same:
                info |= self._final(observation, outcome)
                observation = self.batch.reset(np.flatnonzero(self._ended))
                self._ended = np.zeros(self.num_envs, dtype=bool)
        self._watch(self.num_envs)
        if self._numpy:
            reward, terminated, truncated = reward.astype(np.float64), terminated.copy(), truncated.copy()
        return self._out(observation), reward, terminated, truncated, info

    def _final(self, observation: Any, outcome: Outcome) -> dict[str, Any]:
        """Return the last observations and infos of the episodes that ended, as Gymnasium does; dense for torch."""
        ended, flat = self._ended.copy(), self._out(observation)
        last = self._rows.stepped(outcome, ended) | self._rows.begun(ended)
        if not self._numpy:
            mask = torch.as_tensor(ended, device=flat.device)
            final = torch.where(mask.unsqueeze(-1), flat, 0.0)
            return {"final_obs": final, "_final_obs": mask, "final_info": last, "_final_info": mask.clone()}
        observations = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            observations[i] = flat[i]
        return {"final_obs": observations, "_final_obs": ended, "final_info": last, "_final_info": ended.copy()}

    def render(self) -> Any:
        """Return pictures of every environment, as ``DiffIDMEnv.render``, or show the first one (``human``).

        RuntimeError before ``reset``.
        """
        pictures = self._pictures(1 if self.render_mode == "human" else self.num_envs)
        return None if self.render_mode == "human" else tuple(pictures)
