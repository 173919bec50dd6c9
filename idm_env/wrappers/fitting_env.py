"""``DiffIDM-Fit-v0``: a fitting problem as a Gymnasium environment, so that any method that acts can search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box

from idm_env.validation import shown
from idm_env.wrappers.fitting import ParameterFitting


class FittingEnv(gymnasium.Env):
    """``gym.make("DiffIDM-Fit-v0", trajectories="pairs.parquet", task="ring", …)``: one step, one guess.

    Action ``(free,)``: every free parameter, scaled from its bounds to [−1, 1] (clipped). Reward: minus the root mean
    square residual. Observation: the last guess, zeros at first. Info: its ``parameters`` by full name, after a reset
    also their ``bounds``, what [−1, 1] spans, and after a step ``root_mean_squared_error``. Episodes have one step.
    ``free`` and ``objective`` are those of ``ParameterFitting``, with one set of parameters for all drivers; all other
    keywords make the environment whose drivers are fitted.

    ``bounds`` narrows what [−1, 1] spans: ``{"idm.time_gap": [0.5, 3.0]}``.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (Gymnasium declares it so)

    def __init__(
        self,
        trajectories: Any = None,
        *,
        free: Sequence[str] | None = None,
        objective: str = "spacing",
        bounds: Mapping[str, Sequence[float]] | None = None,
        render_mode: None = None,
        **keywords: Any,
    ) -> None:
        from idm_env.envs.settings import settings

        if trajectories is None:
            raise ValueError("trajectories = None, and a fit needs a file. Give trajectories='file.parquet'.")
        self.problem = ParameterFitting(settings(**keywords).task, trajectories, free=free, objective=objective)
        low, high = (x.numpy().copy() for x in self.problem.problem.bounds)
        for name, (lowest, highest) in (bounds or {}).items():
            if name not in self.problem.free:
                raise ValueError(f"bounds name '{name}', which is not free. Free: {', '.join(self.problem.free)}.")
            i = self.problem.free.index(name)
            low[i], high[i] = max(low[i], lowest), min(high[i], highest)
        self.low, self.high = low, high
        count = len(self.problem.free)
        self.render_mode = None
        self.action_space = Box(-1.0, 1.0, (count,), np.float32)
        self.observation_space = Box(-1.0, 1.0, (count,), np.float32)
        self._last = np.zeros(count, np.float32)

    def values(self, action: Any) -> np.ndarray:
        """Return the parameters of an action, in the order of ``free``; ValueError for a wrong shape or NaN."""
        guess = np.asarray(action, dtype=np.float64)
        if guess.shape != self.action_space.shape or not np.isfinite(guess).all():
            raise ValueError(f"action = {shown(action)} must be {len(self.low)} finite numbers in [-1, 1].")
        return self.low + 0.5 * (np.clip(guess, -1.0, 1.0) + 1.0) * (self.high - self.low)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the last guess."""
        super().reset(seed=seed)
        if seed is not None:
            self._last = np.zeros_like(self._last)
        spans = zip(self.low.tolist(), self.high.tolist(), strict=True)
        bounds = dict(zip(self.problem.free, spans, strict=True))
        return self._last.copy(), {"parameters": self._named(self.values(self._last)), "bounds": bounds}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Judge a guess; the episode ends."""
        values = self.values(action)
        with torch.no_grad():
            error = float(self.problem.root_mean_squared_error(values))
        self._last = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        info = {"parameters": self._named(values), "root_mean_squared_error": error}
        return self._last.copy(), -error, True, False, info

    def _named(self, values: np.ndarray) -> dict[str, float]:
        return dict(zip(self.problem.free, values.tolist(), strict=True))
