"""What drivers saw in the last steps of a batch, as an array that a step adds to in front and never moves."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from idm_env.delay_buffer import PAST
from idm_env.types import State

Array = np.ndarray
ROOM = 64
"""Steps that fit in before the last ones are carried back to the end: their copying is shared by so many steps."""


class Past:
    """The past of worlds of one shape: ``numbers`` (rows, steps, signals, vehicles), newest first.

    ``newest`` is the index of the last step; ``slots`` steps from there on count. Without a past in the state it is
    empty, with no slots. ``writes_once`` says that what was written stays as it is, for those who have the array.
    """

    def __init__(self, state: State, writes_once: bool = False) -> None:
        self.writes_once = writes_once
        past, kind = state.memory.get(PAST), state.speed.detach().numpy().dtype
        self.slots, self._signals = (0, 1) if past is None else tuple(past.shape[-2:])
        rows, size = state.speed.shape
        self.newest = ROOM if self.slots else -1
        self.numbers = np.zeros((rows, self.slots + ROOM, self._signals, size) if self.slots else (1, 1), kind)

    def copy(self) -> Past:
        """Return another one of the same steps, with memory of its own."""
        other = Past.__new__(Past)
        other.__dict__.update(self.__dict__)
        other.numbers = self.numbers.copy()
        return other

    def load(self, state: State) -> None:
        """Take over the past of all worlds."""
        if self.slots:
            self.newest = ROOM
            self._last()[:] = self._of(state)

    def replace(self, worlds: Array, fresh: State) -> None:
        """Take over the past of some worlds (indices)."""
        if self.slots:
            self._last()[worlds] = self._of(fresh)

    def room(self) -> int:
        """Return how many more steps fit in, at least one."""
        if self.newest == 0:
            last = self._last().copy()
            if self.writes_once:
                self.numbers = np.zeros_like(self.numbers)
            self.newest = ROOM
            self._last()[:] = last
        return self.newest

    def tensor(self) -> Tensor:
        """Return a copy as the state holds it: ``(rows, vehicles, slots, signals)``."""
        return torch.from_numpy(self._last().copy()).movedim(-1, 1)

    def _last(self) -> Array:
        """Return a view of the steps that count, ``(rows, slots, signals, vehicles)``."""
        return self.numbers[:, self.newest : self.newest + self.slots]

    def _of(self, state: State) -> Array:
        """Return what a state holds, ``(rows, slots, signals, vehicles)``."""
        past = state.memory[PAST].detach()
        return past.expand(*state.speed.shape, self.slots, self._signals).movedim(1, -1).numpy()
