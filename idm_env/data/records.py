"""The motions of a driver and of everybody around it, on the driver's clock and consistent with the measured gaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from idm_env.data import speeds
from idm_env.data.neighbours import Neighbours
from idm_env.data.schema import DEFAULT_LENGTH_M, of_run, spans
from idm_env.data.smooth import fuse
from idm_env.data.trajectories import Trajectories

FAR_M = 1000.0
"""Where a neighbour that is not there is put: finite, and out of everybody's reach."""


@dataclass(frozen=True, eq=False)
class VehicleRecord:
    """One measured vehicle on the clock of an episode; arrays are [T], finite also where ``present`` is False.

    Attributes:
        position_m: Front bumper, consistent with the measured gaps.
        speed_mps: Speed.
        accel_mps2: Derivative of the smoothed speed; accelerations in files are not trusted.
        length_m: Length.
        present: Whether the vehicle was there and measured.
    """

    position_m: np.ndarray
    speed_mps: np.ndarray
    accel_mps2: np.ndarray
    length_m: float
    present: np.ndarray


@dataclass(frozen=True, eq=False)
class RecordColumns:
    """The columns of a table as arrays [rows], with the acceleration of every row; cut into records span by span."""

    position: np.ndarray
    speed: np.ndarray
    accel: np.ndarray
    gap: np.ndarray
    length: np.ndarray
    measured: np.ndarray
    place: np.ndarray
    ring: np.ndarray | None
    around: Neighbours
    step: np.ndarray

    @classmethod
    def from_table(cls, trajectories: Trajectories, table: pl.DataFrame, around: Neighbours) -> RecordColumns:
        """Return the arrays of a table with ``step``, smoothing every track once for its acceleration."""
        position, speed = table["position_m"].to_numpy(), table["speed_mps"].to_numpy()
        step = table.select(of_run(trajectories.steps))["run_id"].to_numpy()
        accel = np.zeros(table.height)
        for begin, end in speeds.stretches(table):
            accel[begin:end] = fuse(position[begin:end], speed[begin:end], float(step[begin])).accel
        ring = table["ring_length_m"].to_numpy() if "ring_length_m" in table.columns else None
        place = table[trajectories.place].cast(pl.Float64).to_numpy()
        if ring is not None and trajectories.place == "position_m":
            place = np.where(np.isfinite(ring), place % np.where(np.isfinite(ring), ring, 1.0), place)
        gap, length, measured = (table[name].to_numpy() for name in ("gap_m", "length_m", "gap_measured"))
        return cls(position, speed, accel, gap, length, measured, place, ring, around, step)

    def motions(self, span: slice, smooth: bool) -> dict[str, Any]:
        """Return the fields of an episode that are motions, for the rows `span`."""
        rows = np.arange(len(self.position))[span]
        dt = float(self.step[rows[0]]) * (span.step or 1)
        position, speed, gap = self.position[rows].copy(), self.speed[rows].copy(), self.gap[rows].copy()
        length = float(self.length[rows[0]])
        leader_rows = self.around.leader[rows]
        leader_length = float(self.length[leader_rows[0]])
        if smooth:
            own = fuse(position, speed, dt)
            speed = own.speed
            position = own.position if self.measured[rows[0]] else position
        lead = self._record(leader_rows, position + gap + leader_length, dt, smooth, speed)
        if smooth and self.measured[rows[0]]:
            position = lead.position_m - leader_length - gap
        elif smooth:
            gap = lead.position_m - leader_length - position
        second_rows = self.around.second_leader[rows]
        second_at = lead.position_m + self._gap_of(leader_rows) + self._length_of(second_rows)
        behind_rows = self.around.behind[rows]
        behind_at = position - length - self._gap_of(behind_rows)
        side_rows = self.around.adjacent[rows]
        return {
            "position_m": position,
            "speed_mps": speed,
            "gap_m": gap,
            "leader": lead,
            "second_leader": self._record(second_rows, second_at, dt, smooth, speed, lead.position_m + FAR_M),
            "behind": self._record(behind_rows, behind_at, dt, smooth, speed, position - FAR_M),
            "adjacent": self._record(side_rows, self._adjacent(rows, side_rows), dt, smooth, speed, position + FAR_M),
        }

    def _gap_of(self, rows: np.ndarray) -> np.ndarray:
        return np.where(rows >= 0, self.gap[rows], np.nan)

    def _length_of(self, rows: np.ndarray) -> np.ndarray:
        return np.where(rows >= 0, self.length[rows], DEFAULT_LENGTH_M)

    def _adjacent(self, rows: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return where the vehicles beside are, on the nearer side of the ring where there is one."""
        away = self.position[others] - self.position[rows]
        if self.ring is not None:
            ring = self.ring[rows]
            closed = np.isfinite(ring)
            away[closed] -= ring[closed] * np.round(away[closed] / ring[closed])
        return np.where(others >= 0, self.position[rows] + away, np.nan)

    def _record(
        self,
        rows: np.ndarray,
        position: np.ndarray,
        dt: float,
        smooth: bool,
        own_speed: np.ndarray,
        elsewhere: np.ndarray | None = None,
    ) -> VehicleRecord:
        present = (rows >= 0) & np.isfinite(position)
        length = float(self.length[rows[present][0]]) if present.any() else DEFAULT_LENGTH_M
        # Where one neighbour takes the place of another of other length, its rear end is what a gap is measured to.
        position = position - self._length_of(rows) + length
        place = np.where(present, position, position if elsewhere is None else elsewhere)
        speed = np.where(present, self.speed[rows], own_speed)
        accel = np.where(present, self.accel[rows], 0.0)
        if smooth:
            stride = round(dt / float(self.step[rows[present][0]])) if present.any() else 1
            for begin, end in spans(np.diff(rows) == stride, present):
                part = slice(begin, end)
                if end - begin >= 4:
                    place[part], speed[part], accel[part] = fuse(place[part], speed[part], dt)
        return VehicleRecord(place, speed, accel, length, present)
