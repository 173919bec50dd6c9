"""What a batch counts as it steps on roads that vehicles enter: stops, and vehicles that pass detectors.

A stop is a vehicle that stands at a decision and did not at the one before. A detector is a loop across one lane. Of
every interval it tells how many front bumpers have passed it, their mean speed (m/s, NaN of none), and the share of
time in which a vehicle was above it; all at every Δt. What a window does in one go (``unroll``) passes uncounted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.tasks.said_roads import STANDS, Loop
from idm_env.types import State


def _numbers(x: Tensor) -> Any:
    """Return numbers where they lie: of few of them an array knows sooner."""
    return x.detach().numpy() if x.is_cpu else x.detach()


class _Seen(NamedTuple):
    """Vehicles ``(rows, n)`` as they were, arrays or tensors; ``trip`` tells the journeys of a slot apart."""

    stands: Any
    present: Any
    trip: Any

    @classmethod
    def of(cls, state: State) -> _Seen:
        assert state.present is not None and state.lanes is not None and state.lanes.trips is not None
        return cls(_numbers(state.speed) < STANDS, _numbers(state.present) > 0, _numbers(state.lanes.trips.left) + 0)

    def same(self, later: _Seen) -> Any:
        """Return which vehicles are there on the same trip later."""
        return self.present & later.present & (self.trip == later.trip)


class Counters:
    """Stops ``(rows,)``, and a table for each row, of this episode."""

    def __init__(self, loops: Sequence[Loop], dt: float, rows: int, device: torch.device) -> None:
        self.loops, self._dt = loops, dt
        self.stops: Any = _numbers(torch.zeros(rows, dtype=torch.int64, device=device))
        self.tables: list[list[dict[str, Any]]] = [[] for _ in range(rows)]
        self._sums = np.zeros((rows, len(self.loops), 3))
        self._decided: _Seen | None = None
        self._last: tuple[_Seen, Tensor, Tensor] | None = None

    def begin(self, rows: np.ndarray, state: State) -> None:
        """Forget what was counted in some rows (indices), whose episodes begin."""
        self.stops[rows], self._sums[rows] = 0, 0.0
        for row in rows:
            self.tables[row] = []
        self._decided = _Seen.of(state)
        self._last = self._decided, state.step.clone(), state.position.detach().clone()

    def decided(self, state: State) -> None:
        """Count who has come to stand since the decision before, or the beginning."""
        last, now = self._decided, _Seen.of(state)
        self._decided = now
        assert last is not None
        self.stops = self.stops + (last.same(now) & now.stands & ~last.stands).sum(-1)

    def after(self, state: State) -> None:
        """Count who has passed a detector in the step that has led here."""
        now, step, position = _Seen.of(state), state.step.clone(), state.position.detach().clone()
        assert self._last is not None and state.lanes is not None
        (last, step_then, then), self._last = self._last, (now, step, position)
        follows, rear = step == step_then + 1, position - state.length
        same, present = (torch.as_tensor(x) for x in (last.same(now) & _numbers(follows.unsqueeze(-1)), now.present))
        for i, loop in enumerate(self.loops):
            on = present & (state.lanes.lane == loop.lane) & (position >= loop.place)
            passed = same & on & (then < loop.place)
            counts = passed.sum(-1), (passed * state.speed.detach()).sum(-1), (on & (rear < loop.place)).any(-1)
            self._sums[:, i] += (follows.unsqueeze(-1) * torch.stack([x.double() for x in counts], -1)).cpu().numpy()
            steps = round(loop.every / self._dt)
            for row in torch.nonzero(follows & (step % steps == 0)).squeeze(-1).tolist():
                self._close(row, i, int(step[row]) - steps, steps)

    def _close(self, row: int, i: int, first: int, steps: int) -> None:
        """Write the line of an interval that is over."""
        count, speeds, above = self._sums[row, i].tolist()
        self._sums[row, i] = 0.0
        line = {"detector": self.loops[i].name, "begin": first * self._dt, "end": (first + steps) * self._dt}
        line |= {"count": int(count), "speed": speeds / count if count else math.nan, "occupancy": above / steps}
        self.tables[row].append(line)
