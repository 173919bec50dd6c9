"""Single trajectories as they were measured, cut tolerantly, so that one bad track never stops the others.

Unlike ``data.load``, which prepares followers behind leaders for calibration, a track needs neither a leader nor a
regular clock. What is left out is counted, by reason.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import polars as pl

from idm_env.data import Repair
from idm_env.data.schema import spans

REVERSED_M = 3.0
"""A vehicle whose smoothed position falls by more than this drives backwards, which the simulator never does (m)."""


@dataclasses.dataclass(frozen=True, eq=False)
class TrackPiece:
    """One unbroken stretch of one vehicle; arrays are [N], times rising strictly.

    Attributes:
        run_id, vehicle_id: Identifiers, as text.
        piece: Number of the stretch, from 0, where holes divide a vehicle's track.
        time_s: Times of the samples (s), not necessarily regular.
        position_m: Front bumper along the lane (m), as measured.
        length_m: Length of the vehicle (m).
        leader: Identifier of the vehicle ahead at every sample, "" where there is none.
        lane: Lane at every sample, −1 where it is not known.
    """

    run_id: str
    vehicle_id: str
    piece: int
    time_s: np.ndarray
    position_m: np.ndarray
    length_m: float
    leader: np.ndarray
    lane: np.ndarray

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def key(self) -> str:
        """``run/vehicle/piece``."""
        return f"{self.run_id}/{self.vehicle_id}/{self.piece}"

    def part(self, at: slice | np.ndarray, piece: int | None = None) -> TrackPiece:
        """Return some of the samples."""
        cut = {name: getattr(self, name)[at] for name in ("time_s", "position_m", "leader", "lane")}
        return dataclasses.replace(self, piece=self.piece if piece is None else piece, **cut)


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of vehicles, each sorted by time, with ``leader_id`` ("" for none) and a length; what was repaired."""

    frame: pl.DataFrame
    source: str
    repairs: tuple[Repair, ...] = ()

    def vehicles(self) -> list[tuple[str, str, int, int]]:
        """Return (run, vehicle, first row, rows) of every vehicle, in order of the time at which it appears."""
        rows = self.frame.with_row_index("row").group_by("run_id", "vehicle_id", maintain_order=True)
        table = rows.agg(pl.col("row").first(), pl.len().alias("count"), pl.col("time_s").first().alias("begin"))
        return table.sort("run_id", "begin", maintain_order=True).select("run_id", "vehicle_id", "row", "count").rows()


class Pieces:
    """Tracks of a table, in the order in which vehicles appear; ``left_out`` counts what could not be used.

    ``bridge`` (s) is the longest hole that stays inside a track; None keeps every hole (reconstruction).
    """

    def __init__(self, table: Table, bridge: float | None = 2.0) -> None:
        self.table = table
        self.bridge = bridge
        self.left_out: list[tuple[str, str]] = []
        self.notes: list[tuple[str, str]] = []
        frame = table.frame
        self._time, self._position = (frame[name].to_numpy() for name in ("time_s", "position_m"))
        self._leader = frame["leader_id"].to_numpy()
        nowhere = np.full(frame.height, -1, np.int64)
        self._lane = frame["lane"].fill_null(-1).to_numpy() if "lane" in frame.columns else nowhere
        self._length = frame["length_m"].to_numpy()
        self.vehicles = table.vehicles()

    def __iter__(self) -> Iterator[TrackPiece]:
        """Yield the tracks of all vehicles."""
        for run, vehicle, first, count in self.vehicles:
            rows = slice(first, first + count)
            time, position, length = self._time[rows], self._position[rows], float(self._length[first])
            whole = TrackPiece(run, vehicle, 0, time, position, length, self._leader[rows], self._lane[rows])
            yield from self._usable(whole)

    def _usable(self, whole: TrackPiece) -> Iterator[TrackPiece]:
        name = f"{whole.run_id}/{whole.vehicle_id}"
        if len(whole) < 2:
            self.left_out.append((name, "a single point has no motion"))
            return
        number = 0
        for begin, end in self._spans(whole):
            track = whole.part(slice(begin, end), number)
            if len(track) < 2:
                self.left_out.append((name, f"a single point at t = {whole.time_s[begin]:g} s, apart from the rest"))
                continue
            fallen = reversing(track)
            if fallen > REVERSED_M:
                self.left_out.append((track.key, f"drives backwards by {fallen:.1f} m; positions must rise"))
                continue
            number += 1
            yield track
        if number > 1:
            self.notes.append((name, f"divided into {number} tracks at holes"))

    def _spans(self, whole: TrackPiece) -> list[tuple[int, int]]:
        """Return [begin, end) of stretches without a long hole; jumps are none of a vehicle (``data.plausible``)."""
        steps = np.diff(whole.time_s)
        longest = np.inf if self.bridge is None else max(self.bridge, 2.5 * float(np.median(steps)))
        return spans(steps <= longest, np.ones(len(whole), bool))


def reversing(track: TrackPiece) -> float:
    """Return by how much (m) the position, as a running median over 5 samples, falls below what it had reached."""
    x = track.position_m
    if len(x) >= 5:
        x = np.median(np.lib.stride_tricks.sliding_window_view(x, 5), axis=1)
    return float((np.maximum.accumulate(x) - x).max())
