"""What drivers saw in the last steps of a batch, as arrays that a step adds to and never moves."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from idm_env.delay_buffer import PAST
from idm_env.kernels.lanes import past_rows, past_tensor
from idm_env.types import State

Array = np.ndarray
_ROOM = 64
"""Steps that fit in before the last ones are carried back to the begin: their copying is shared by so many steps."""


class Past:
    """The past of worlds of one shape: ``rows`` (steps · signals, vehicles), oldest first; ``newest`` is the last step.

    ``slots`` of these steps count. Without a past in the state it is empty, with no slots. ``writes_once`` says that
    what was written stays as it is, for those who have the array.
    """

    def __init__(self, state: State, writes_once: bool = False) -> None:
        self.writes_once = writes_once
        self._shape = tuple(state.speed.shape)
        past = state.memory.get(PAST)
        self.slots, self._signals = (0, 1) if past is None else tuple(past.shape[-2:])
        self.newest = self.slots - 1
        kind = state.speed.detach().numpy().dtype
        count = math.prod(self._shape) if self.slots else 1
        self.rows = np.zeros(((self.slots + (_ROOM if self.slots else 1)) * self._signals, count), kind)

    def copy(self) -> Past:
        """Return another one of the same steps, with memory of its own."""
        other = Past.__new__(Past)
        other.__dict__.update(self.__dict__)
        other.rows = self.rows.copy()
        return other

    def load(self, state: State) -> None:
        """Take over the past of all worlds."""
        if self.slots:
            self.newest = self.slots - 1
            self._last()[:] = self._of(state)

    def replace(self, worlds: Array, fresh: State) -> None:
        """Take over the past of some worlds (indices)."""
        if self.slots:
            apart = self._last().reshape(self.slots, self._signals, self._shape[0], -1)
            steps = self._of(fresh)
            apart[:, :, worlds] = steps.reshape(len(steps), self._signals, len(worlds), -1)

    def make_room(self) -> None:
        """See that one more step fits in."""
        if (self.newest + 2) * self._signals > len(self.rows):
            last = self._last().copy()
            if self.writes_once:
                self.rows = np.zeros_like(self.rows)
            self.newest = self.slots - 1
            self._last()[:] = last

    def room(self) -> int:
        """Return how many more steps fit in, at least one."""
        self.make_room()
        return len(self.rows) // self._signals - self.newest - 1

    def tensor(self) -> Tensor:
        """Return a copy as the state holds it: newest step first."""
        newest_first = np.ascontiguousarray(self._last()[::-1])
        return past_tensor(newest_first.reshape(-1, self.rows.shape[1]), self.slots, self._shape)

    def _last(self) -> Array:
        """Return a view of the steps that count, ``(slots, signals, vehicles)``."""
        end = (self.newest + 1) * self._signals
        return self.rows[end - self.slots * self._signals : end].reshape(self.slots, self._signals, -1)

    def _of(self, state: State) -> Array:
        """Return what a state holds, oldest step first; one step may stand for all."""
        rows = past_rows(state.memory[PAST], tuple(state.speed.shape))
        return rows.reshape(-1, self._signals, rows.shape[1])[::-1]
