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


_AHEAD = 8
"""Episodes that are made ahead where there are fewer rows."""


class Beginnings:
    """Beginnings of ``count`` rows, of which some are made before they are needed; of few rows several of each.

    ``make`` gives each row what it would give it alone. As many are made at once as were needed since ``forget``, at
    most all: no more are made in vain than were used.
    """

    def __init__(self, make: Make, count: int) -> None:
        self._make, self._count, self._depth = make, count, max(1, _AHEAD // count)
        self._ready = np.full((count, self._depth), -1, dtype=np.int64)
        self._begun = np.zeros(count, dtype=np.int64)
        self._asked = 0
        self._worlds: EnvState | None = None

    def forget(self) -> None:
        """Make everything anew from now on."""
        self._ready[:], self._asked = -1, 0

    def take(self, rows: np.ndarray, episodes: np.ndarray) -> EnvState:
        """Return the worlds that ``rows`` [n] (indices) begin with, by the ``episodes`` [rows] that all are in now."""
        numbers = episodes[rows]
        place = numbers % self._depth
        missing = self._ready[rows, place] != numbers
        if self._depth == 1 and len(rows) == self._count and missing.all():
            return self._make(rows, numbers)
        if missing.any():
            self._prepare(rows[missing], rows, episodes)
        self._asked += len(rows)
        self._begun[rows] = self._asked
        self._ready[rows, place] = -1
        where = torch.as_tensor(rows * self._depth + place)
        return mapped(lambda x: x[where.to(x.device)], self._worlds)  # type: ignore[return-value]

    def _prepare(self, missing: np.ndarray, rows: np.ndarray, episodes: np.ndarray) -> None:
        """Make worlds of rows that need them now, of the others that began longest ago, and of episodes after these."""
        ahead = np.asarray((self._ready < 0).all(1))
        ahead[rows] = False
        others, now = np.flatnonzero(ahead), episodes[missing]
        oldest = others[np.argsort(self._begun[others], kind="stable")]
        count = len(missing) + max(0, self._asked - len(missing))
        chosen = np.concatenate((missing, oldest, *[missing] * (self._depth - 1)))[:count]
        numbers = np.concatenate((now, episodes[oldest] + 1, *(now + k for k in range(1, self._depth))))[:count]
        worlds = self._make(chosen, numbers)
        if self._worlds is None:
            self._worlds = mapped(lambda x: x.new_empty((self._count * self._depth, *x.shape[1:])), worlds)
        where = torch.as_tensor(chosen * self._depth + numbers % self._depth)
        mapped(lambda held, new: held.index_put_((where.to(held.device),), new), self._worlds, worlds)
        self._ready[chosen, numbers % self._depth] = numbers
