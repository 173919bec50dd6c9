"""Single trajectories as they were measured, cut tolerantly, so that one bad track never stops the others.

Unlike ``data.load``, which prepares followers behind leaders for calibration, a track needs neither a leader nor a
regular clock. What is left out is counted, by reason.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import polars as pl

from idm_env.data.schema import TRACK, spans

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


def clock_of(track: TrackPiece, dt: float) -> np.ndarray:
    """Return the regular clock [K] of a track (s): from its first sample on, the last one included."""
    steps = int(np.ceil((track.time_s[-1] - track.time_s[0]) / dt - 1e-6)) + 1
    return track.time_s[0] + dt * np.arange(steps)


class Pieces:
    """Tracks of a table, in the order in which vehicles appear; ``left_out`` counts what could not be used.

    The table has the rows of vehicles, each sorted by time, with ``leader_id`` ("" for none) and a length. ``bridge``
    (s) is the longest hole that stays inside a track; None keeps every hole (reconstruction).
    """

    def __init__(self, table: pl.DataFrame, bridge: float | None = 2.0) -> None:
        self.table = table
        self.bridge = bridge
        self.left_out: list[tuple[str, str]] = []
        self.notes: list[tuple[str, str]] = []

    def __iter__(self) -> Iterator[TrackPiece]:
        """Yield the tracks of all vehicles."""
        lane = pl.col("lane").fill_null(-1) if "lane" in self.table.columns else pl.lit(-1, pl.Int64)
        table = self.table.with_columns(lane.alias("lane")).with_row_index("row")
        time, position, leader, lanes = (table[n].to_numpy() for n in ("time_s", "position_m", "leader_id", "lane"))
        first = pl.col("row", "length_m", "time_s").first()
        vehicles = table.group_by(TRACK, maintain_order=True).agg(first, pl.len().alias("count"))
        vehicles = vehicles.sort("run_id", "time_s", maintain_order=True)
        for run, vehicle, begin, length, count in vehicles.select(*TRACK, "row", "length_m", "count").rows():
            rows = slice(begin, begin + count)
            whole = TrackPiece(run, vehicle, 0, time[rows], position[rows], length, leader[rows], lanes[rows])
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
