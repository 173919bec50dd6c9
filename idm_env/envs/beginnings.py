"""Worlds at the begin of episodes to come, made many at a time.

A warm-up is hundreds of steps. For one row it costs as much as for dozens of them, and in a large batch of agents that
still crash some row begins anew at every step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from idm_env.tasks import EnvState
from idm_env.types import mapped

Make = Callable[[np.ndarray, np.ndarray], EnvState]
"""Rows and their episodes → the worlds that these episodes begin with."""


class Beginnings:
    """Beginnings of ``count`` rows, of which some are made before they are needed.

    ``make`` gives each row what it would give it alone. As many are made at once as were needed so far, at most all:
    no more are made in vain than were used.
    """

    def __init__(self, make: Make, count: int) -> None:
        self._make, self._count = make, count
        self._ready = np.full(count, -1, dtype=np.int64)
        self._begun = np.zeros(count, dtype=np.int64)
        self._asked = 0
        self._worlds: EnvState | None = None

    def forget(self) -> None:
        """Make everything anew from now on."""
        self._ready[:] = -1

    def take(self, rows: np.ndarray, episodes: np.ndarray) -> EnvState:
        """Return the worlds that ``rows`` [n] (indices) begin with, by the ``episodes`` [rows] that all are in now."""
        missing = self._ready[rows] != episodes[rows]
        if len(rows) == self._count and missing.all():
            return self._make(rows, episodes[rows])
        if missing.any():
            self._prepare(rows[missing], rows, episodes)
        self._asked += len(rows)
        self._begun[rows] = self._asked
        self._ready[rows] = -1
        where = torch.as_tensor(rows)
        return mapped(lambda x: x[where.to(x.device)], self._worlds)  # type: ignore[return-value]

    def _prepare(self, missing: np.ndarray, rows: np.ndarray, episodes: np.ndarray) -> None:
        """Make the missing worlds, and the next ones of the rows that have been under way for longest."""
        ahead = self._ready < 0
        ahead[rows] = False
        others = np.flatnonzero(ahead)
        oldest = others[np.argsort(self._begun[others], kind="stable")][: max(0, self._asked - len(missing))]
        chosen = np.concatenate((missing, oldest))
        numbers = np.concatenate((episodes[missing], episodes[oldest] + 1))
        worlds = self._make(chosen, numbers)
        if self._worlds is None:
            self._worlds = mapped(lambda x: x.new_empty((self._count, *x.shape[1:])), worlds)
        where = torch.as_tensor(chosen)
        mapped(lambda held, new: held.index_put_((where.to(held.device),), new), self._worlds, worlds)
        self._ready[chosen] = numbers
