"""What a batch counts as it steps on roads that vehicles enter: stops, and vehicles that pass detectors.

A stop is a vehicle that stands at a decision and did not at the one before. A detector is a loop across one lane. Of
every interval it tells how many front bumpers have passed it, their mean speed (m/s, NaN of none), and the share of
time in which a vehicle was above it; all at every Δt. What a window does in one go (``unroll``) passes uncounted.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from idm_env.tasks.open_lanes import OpenLanesTask
from idm_env.tasks.said_roads import STANDS
from idm_env.types import State


def _array(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy().copy()


class _Seen(NamedTuple):
    """A state as arrays: steps ``(rows,)``, of vehicles ``(rows, n)``; ``trip`` tells the journeys of a slot apart."""

    step: np.ndarray
    speed: np.ndarray
    present: np.ndarray
    trip: np.ndarray
    position: np.ndarray
    lane: np.ndarray

    @classmethod
    def of(cls, state: State, places: bool) -> _Seen:
        assert state.present is not None and state.lanes is not None and state.lanes.trips is not None
        motion = _array(state.speed), _array(state.present) > 0, _array(state.lanes.trips.left)
        where = (_array(state.position), _array(state.lanes.lane)) if places else (motion[0], motion[0])
        return cls(_array(state.step), *motion, *where)

    def same(self, later: _Seen) -> np.ndarray:
        """Return which vehicles are there on the same trip later."""
        both: np.ndarray = self.present & later.present & (self.trip == later.trip)
        return both


class Counters:
    """Stops ``(rows,)``, and a table for each row, of this episode."""

    def __init__(self, task: OpenLanesTask, rows: int) -> None:
        self.loops, self._dt = task.loops, task.simulator.dt
        self.stops = np.zeros(rows, dtype=np.int64)
        self.tables: list[list[dict[str, Any]]] = [[] for _ in range(rows)]
        self._sums = np.zeros((rows, len(self.loops), 3))
        self._decided: _Seen | None = None
        self._last: _Seen | None = None

    def begin(self, rows: np.ndarray, state: State) -> None:
        """Forget what was counted in some rows (indices), whose episodes begin."""
        self.stops[rows], self._sums[rows] = 0, 0.0
        for row in rows:
            self.tables[row] = []
        self._last = self._decided = _Seen.of(state, bool(self.loops))

    def decided(self, state: State) -> None:
        """Count who has come to stand since the decision before, or the beginning."""
        last, now = self._decided, _Seen.of(state, places=False)
        self._decided = now
        assert last is not None
        self.stops += (last.same(now) & (last.speed >= STANDS) & (now.speed < STANDS)).sum(-1)

    def after(self, state: State) -> None:
        """Count who has passed a detector in the step that has led here."""
        last, now = self._last, _Seen.of(state, places=True)
        self._last = now
        assert last is not None
        follows = now.step == last.step + 1
        same, rear = last.same(now) & follows[:, None], now.position - _array(state.length)
        for i, loop in enumerate(self.loops):
            on = now.present & (now.lane == loop.lane) & (now.position >= loop.place)
            passed = same & on & (last.position < loop.place)
            counts = passed.sum(-1), (passed * now.speed).sum(-1), (on & (rear < loop.place)).any(-1)
            self._sums[:, i] += follows[:, None] * np.stack(counts, -1)
            steps = round(loop.every / self._dt)
            for row in np.flatnonzero(follows & (now.step % steps == 0)).tolist():
                self._close(row, i, int(now.step[row]) - steps, steps)

    def _close(self, row: int, i: int, first: int, steps: int) -> None:
        """Write the line of an interval that is over."""
        count, speeds, above = self._sums[row, i].tolist()
        self._sums[row, i] = 0.0
        self.tables[row].append({
            "detector": self.loops[i].name, "begin": first * self._dt, "end": (first + steps) * self._dt,
            "count": int(count), "speed": speeds / count if count else math.nan, "occupancy": above / steps,
        })  # fmt: skip
