"""Rows that cannot be: vehicles that jump, and two bodies in one place. Few are counted, many are asked about.

Of 1.57 million rows of six measured sets none moves faster than 70 m/s, and none falls by a metre.
"""

from collections import Counter
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
import polars as pl

from idm_env.data.errors import DataError, Repair, repaired
from idm_env.data.schema import HIGHEST_SPEED_MPS, TRACK, track_numbers

FALL_M, JUMP_M = 5.0, 8.0
"""A position falls, or jumps whatever the time step, only above this (m): less is noise."""
BEND_M, BEND_MPS2 = 8.0, 10.0
"""Two steps that are neighbours differ by less than BEND_M + BEND_MPS2 Δt² (m), of whatever drives."""
BRIEF_ROWS = 3
"""An excursion of so many rows, from which a vehicle comes back to its course, is one of the sensor."""
MISSING = (-1.0, 0.0, *(sign * value for value in (999.0, 9999.0, 99999.0, 999999.0) for sign in (1, -1)), -99.0)
"""Numbers that files write for "no value"."""
MOST_ROWS, MOST_FALLS, MOST_LEAPS, MOST_OVERLAPS, MOST_BLIND = 0.05, 0.1, 0.5, 0.02, 0.2
"""Shares above which a file is refused: of rows that jump, of tracks that fall or leap for good, and of rows with a
leader that overlap by their positions, or have a measured gap that is none."""
FEW_VEHICLES = 10
"""Of so many vehicles one alone can be wrong; of fewer, one that overlaps is taken for one of another lane."""


@dataclass
class Jumps:
    """How often vehicles jump, over all pieces of a file.

    Attributes:
        rows, jumps: Rows, and those at which a vehicle jumps.
        tracks, falls, leaps: Tracks, and those that go on further back, or further ahead, than they can have come to.
        splits: run_id, vehicle_id, time of the first row (s) and name of the parts of such tracks, but the first.
        first: The first jump in words.
    """

    rows: int = 0
    jumps: int = 0
    tracks: int = 0
    falls: int = 0
    leaps: int = 0
    splits: list[tuple[str, str, float, str]] = field(default_factory=list)
    first: str = ""

    def rule(self, frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
        """Return whole, sorted vehicles without positions at which they cannot be; who goes on elsewhere is two.

        What is brief, or a number that stands for "no value", is taken as missing.
        """
        track, time, x = track_numbers(frame), frame["time_s"].to_numpy(), frame["position_m"].to_numpy().copy()
        self.rows, self.tracks = self.rows + frame.height, self.tracks + len(np.unique(track))
        cut, empty, splits = _cuts(track, time, x), int(np.isnan(x).sum()), len(self.splits)
        if not cut.any():
            return frame, []
        x[np.isin(track, track[cut]) & np.isin(x, _stand_ins(x, cut))] = np.nan
        cut = _cuts(track, time, x)
        self.jumps += int(cut.sum())
        if self.jumps > max(MOST_ROWS * self.rows, 50):
            self._example(frame, int(np.flatnonzero(cut)[0]))
            return frame, []
        ids = frame["vehicle_id"].to_list()
        taken = set(ids)
        for number in np.unique(track[cut]):
            rows = np.arange(*np.searchsorted(track, (number, number + 1)))
            self._split(frame, rows[np.isfinite(x[rows])], cut, time, x, ids, taken)
        words = "positions are off the course of their vehicle, or stand for no value, and are taken as missing."
        done = repaired("position jumps", int(np.isnan(x).sum()) - empty, words)
        words = "tracks go on where their vehicle cannot have come to; from there they are of another vehicle."
        done += repaired("track split", len(self.splits) - splits, words)
        columns = pl.Series("position_m", x, nan_to_null=True), pl.Series("vehicle_id", ids, pl.String)
        return frame.with_columns(columns), done

    def _split(self, frame: pl.DataFrame, rows: Any, cut: Any, time: Any, x: Any, ids: list[str], taken: Any) -> None:
        """Take what is off the course of one vehicle (``rows``) as missing; rename it where it goes on elsewhere."""
        course, *waiting = np.split(rows, np.flatnonzero(cut[rows][1:]) + 1)
        name, number, falls, leaps = ids[rows[0]], 0, 0, 0
        while waiting:
            near = enumerate(waiting[:BRIEF_ROWS])
            back = next((n for n, part in near if _goes_on(course, part, time, x)), None)
            if back is not None and sum(map(len, waiting[:back])) <= BRIEF_ROWS:
                for part in waiting[:back]:
                    x[part] = np.nan
                course, waiting = waiting[back], waiting[back + 1 :]
                continue
            part = waiting.pop(0)
            self._example(frame, int(part[0]))
            falls, leaps = falls + (x[part[0]] < x[course[-1]]), leaps + (x[part[0]] > x[course[-1]])
            if len(part) == 1 and not waiting:  # the last sample
                x[part] = np.nan
            elif len(course) == 1 and course[0] == rows[0]:  # the first one
                x[course], course = np.nan, part
            else:
                number = next(n for n in count(number + 1) if f"{name}.{n}" not in taken)
                self.splits.append((frame["run_id"][int(part[0])], name, float(time[part[0]]), f"{name}.{number}"))
                for row in rows[rows >= part[0]]:
                    ids[row] = f"{name}.{number}"
                course = part
        self.falls, self.leaps = self.falls + (falls > 0), self.leaps + (leaps > 0)

    def _example(self, frame: pl.DataFrame, row: int) -> None:
        """Keep the first jump in words: that to a ``row``, from the last position before it."""
        if self.first:
            return
        begin = int(np.flatnonzero(np.isfinite(frame["position_m"][:row].to_numpy()))[-1])
        rows = frame.select(*TRACK, "time_s", "position_m")
        (_, _, since, before), (run, vehicle, time, after) = rows.row(begin), rows.row(row)
        jump = f"from {before:g} to {after:g} m within {time - since:.3g} s"
        self.first = f"vehicle {vehicle} of run {run} at t = {time:g} s {jump}"

    def check(self, source: str) -> None:
        """Raise DataError where vehicles jump so often that positions are not of one road, or names not of one car."""
        way = "is it a position along an edge or a lap? Give the way along the whole road, or --ring-length"
        who = "is vehicle_id of one vehicle each, and time_s in order? Give each its own"
        for verb, some, most, total, what, ask in (
            ("jumps", self.jumps, max(MOST_ROWS * self.rows, 50), self.rows, "rows", way),
            ("falls", self.falls, max(MOST_FALLS * self.tracks, 1), self.tracks, "tracks", way),
            ("leaps", self.leaps, max(MOST_LEAPS * self.tracks, 2), self.tracks, "tracks", who),
        ):
            if some > most:
                raise DataError(f"{source}: position_m {verb} in {some} of {total} {what} ({self.first}); {ask}.")

    def with_leaders(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Return the frame with leaders under the names of the parts of their tracks, by the time of the row."""
        if not self.splits or "leader_id" not in frame.columns:
            return frame
        schema = {"run_id": pl.String, "leader_id": pl.String, "time_s": pl.Float64, "part": pl.String}
        parts = pl.DataFrame(self.splits, schema=schema, orient="row").sort("time_s")
        rows = frame.with_row_index("row").sort("time_s")
        by = ["run_id", "leader_id"]
        joined = rows.join_asof(parts, on="time_s", by=by, strategy="backward", check_sortedness=False)
        return joined.sort("row").with_columns(pl.coalesce("part", "leader_id").alias("leader_id")).drop("row", "part")

    def vehicles(self, index: pl.DataFrame) -> pl.DataFrame:
        """Return run_id and vehicle_id of everybody of ``index``, and of the parts of tracks."""
        named = {"run_id": [run for run, *_ in self.splits], "vehicle_id": [part for *_, part in self.splits]}
        return pl.concat([index.select(TRACK), pl.DataFrame(named, schema=dict.fromkeys(TRACK, pl.String))])


@dataclass
class Overlaps:
    """Rows with a leader and no positive gap, over all pieces of a file, counted by vehicle."""

    rows: int = 0
    overlaps: int = 0
    measured: int = 0
    laned: bool = False
    among: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, gaps: pl.DataFrame) -> None:
        """Count rows with the columns gap_m and gap_measured."""
        self.rows += gaps.height - gaps["gap_m"].null_count()
        overlap = gaps.filter(pl.col("gap_m") <= 0.0)
        self.overlaps += overlap.height
        self.measured += int(overlap["gap_measured"].sum())
        self.laned |= "lane" in gaps.columns and gaps["lane"].null_count() < gaps.height
        for who in ("vehicle_id", "leader_id"):
            for run, vehicle, some in overlap.filter(~pl.col("gap_measured")).group_by("run_id", who).len().rows():
                self.among[run, vehicle] += some

    def check(self, source: str, vehicles: int) -> list[Repair]:
        """Return the repair for one of so many vehicles, without which the others hardly overlap.

        DataError where so many bodies are in one place that they cannot be on one lane.
        """
        if self.measured > MOST_BLIND * self.rows:
            many = f"{self.measured} of {self.rows} rows"
            raise DataError(f"{source}: gap_m is not above 0 in {many}; leave it empty where nobody is seen.")
        overlaps = self.overlaps - self.measured
        if overlaps < 3 or overlaps <= MOST_OVERLAPS * self.rows:
            return []
        (run, _), most = self.among.most_common(1)[0]
        if vehicles >= FEW_VEHICLES and overlaps - most <= MOST_OVERLAPS * self.rows:
            who = " or ".join(sorted(vehicle for (_, vehicle), n in self.among.items() if n == most)[:2])
            words = f"rows overlap with vehicle {who} of run {run}: are its length, position and lane right?"
            return repaired("one vehicle overlaps", most, words)
        ask = "are the lanes of one road" if self.laned else "is a lane missing"
        many = f"vehicles overlap in {overlaps} of {self.rows} rows"
        raise DataError(f"{source}: {many}: {ask}, or is position_m one of two coordinates?")


def _cuts(track: np.ndarray, time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return at which rows [rows] a vehicle is where it cannot have come to from its last position."""
    cut = np.zeros(len(position), bool)
    rows = np.flatnonzero(np.isfinite(position))
    if len(rows) < 2:
        return cut
    same = np.diff(track[rows]) == 0
    step, seconds = np.diff(position[rows]), np.diff(time[rows])
    far = (np.abs(step) > np.maximum(HIGHEST_SPEED_MPS * seconds, JUMP_M)) | (step < -FALL_M)
    bend = np.abs(np.diff(step)) > BEND_M + BEND_MPS2 * seconds[1:] * seconds[:-1]
    sharp = bend & (np.abs(np.diff(seconds)) < 0.5 * seconds[1:]) & same[1:] & same[:-1]
    far[1:-1] |= sharp[1:] & sharp[:-1]  # unlike the steps before and after, which are alike
    cut[rows[1:]] = far & same
    return cut


def _stand_ins(x: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Return the numbers for "no value" from or to which vehicles jump."""
    rows = np.flatnonzero(cut)
    around = np.unique([x[rows], x[rows - 1]])
    return around[np.isin(around, MISSING)]


def _goes_on(course: np.ndarray, part: np.ndarray, time: np.ndarray, x: np.ndarray) -> bool:
    """Tell whether a vehicle can have come from the end of its course to the beginning of a part of its track."""
    last, end, begin = int(course[max(-2, -len(course))]), int(course[-1]), int(part[0])
    seconds, moved = time[begin] - time[end], x[begin] - x[end]
    off = abs(moved - (x[end] - x[last]) / (time[end] - time[last]) * seconds) if last != end else 0.0
    return -FALL_M <= moved <= max(HIGHEST_SPEED_MPS * seconds, JUMP_M) and off <= BEND_M + BEND_MPS2 * seconds**2 / 2
