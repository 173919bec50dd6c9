"""Measured episodes as flat arrays for the compiled rollout, and the rows (windows) that are rolled out from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from idm_env.data import DataError, Episode, Trajectories
from idm_env.data.samples import VEHICLES, Samples
from idm_env.discovery import march
from idm_env.effects.free import AGO, AGO_S, CARRIED, Now, first_history, next_history, room_behind
from idm_env.fitting.problem import group_of
from idm_env.jobs.storage import Store, fingerprint

WINDOW_S = 5.0
"""Horizon of a prediction: long enough for every effect to show, short enough for drivers' noise not to add up."""
TRIM_S = (8.0, 3.0)
"""Left out at the beginning and end of long records: start-up transients and edges of the smoother."""
SHORT_S = 60.0
"""Records shorter than this lose only 1 s at either end."""


@dataclass(frozen=True, eq=False)
class Records:
    """All records behind one another: ``signals`` [samples, columns], record r in ``bounds[r] : bounds[r + 1]``.

    A record begins with what is known of the driver before the episode does, for memories; the episode itself begins at
    ``first[r]``. ``kept`` has what was solved on them, for a run that goes on.
    ``group`` and ``run`` [records] index ``groups`` (who shares IDM parameters) and ``runs``; ``gap`` and ``speed`` are
    the driver's measured ones [samples]; ``period`` is the length of a lap (m) or 0.
    """

    episodes: tuple[Episode, ...]
    dt: float
    signals: np.ndarray
    bounds: np.ndarray
    first: np.ndarray
    length: np.ndarray
    group: np.ndarray
    groups: tuple[str, ...]
    run: np.ndarray
    runs: tuple[str, ...]
    period: float
    kept: Store | None = None

    @cached_property
    def mark(self) -> str:
        """Digest of the signals and of what tells records apart."""
        return fingerprint(self.signals, self.bounds, self.first, self.length, self.group, self.groups, self.dt)

    @cached_property
    def gap(self) -> np.ndarray:
        """Measured gap (m)."""
        return self.column("lead_rear") - self.column("position")

    @property
    def speed(self) -> np.ndarray:
        """Measured speed (m/s)."""
        return self.column("speed")

    @cached_property
    def past(self) -> dict[str, np.ndarray]:
        """Features of ``HISTORY`` on the measured records [samples], those carried before the sample counts."""
        begin, lengths = self.bounds[:-1], np.diff(self.bounds)
        signals = dict(zip(march.COLUMNS, torch.from_numpy(self.signals).unbind(-1), strict=True))
        behind = signals["position"] - torch.from_numpy(np.repeat(self.length, lengths)) - signals["behind_front"]
        opening = (signals["second_speed"] - signals["lead_speed"]) * signals["second_present"]
        room = room_behind(behind, signals["behind_speed"], signals["behind_present"])
        every = Now(signals["speed"], signals["accel"], signals["lead_accel"], *room, opening)
        order = np.argsort(-lengths, kind="stable")
        begin, lengths = begin[order], lengths[order]
        past = {name: np.empty(len(self.signals)) for name in CARRIED}
        held = first_history(Now(*(x[begin] for x in every)))
        for i in range(int(lengths[0])):
            going = begin[lengths > i]
            held = {name: x[: len(going)] for name, x in held.items()}
            for name, x in held.items():
                past[name][going + i] = x.numpy()
            held = next_history(held, self.dt, Now(*(x[going + i] for x in every)))
        lead, number = self.column("lead_speed"), np.arange(len(self.signals))
        before = np.maximum(number - round(AGO_S / self.dt), np.repeat(self.bounds[:-1], np.diff(self.bounds)))
        past[AGO] = lead - lead[before]
        return past

    def column(self, name: str) -> np.ndarray:
        """Return one of ``march.COLUMNS`` [samples]."""
        return self.signals[:, march.COLUMNS.index(name)]

    def __len__(self) -> int:
        return len(self.episodes)

    def of_runs(self, runs: Sequence[str]) -> Records:
        """Return the records of some runs; groups and their numbers stay."""
        chosen = set(runs)
        return self.some(np.array([e.run_id in chosen for e in self.episodes]))

    def some(self, wanted: np.ndarray) -> Records:
        """Return the records that are ``wanted`` [records]; groups and their numbers stay."""
        keep = np.flatnonzero(wanted).tolist()
        pieces = [self.signals[self.bounds[i] : self.bounds[i + 1]] for i in keep]
        seen = {self.episodes[i].run_id for i in keep}
        names = tuple(r for r in self.runs if r in seen)
        return replace(
            self,
            episodes=tuple(self.episodes[i] for i in keep),
            signals=np.ascontiguousarray(np.concatenate(pieces)),
            bounds=(bounds := np.append(0, np.cumsum([len(p) for p in pieces]))),
            first=bounds[:-1] + (self.first - self.bounds[:-1])[keep],
            length=self.length[keep],
            group=self.group[keep],
            run=np.array([names.index(self.episodes[i].run_id) for i in keep]),
            runs=names,
        )


def gather(
    episodes: Sequence[Episode], by: str = "driver", period: float = 0.0, trajectories: Trajectories | None = None
) -> Records:
    """Return the flat arrays of smoothed episodes; DataError if there is none or their steps differ.

    ``trajectories`` tell how fast drivers went before their episodes began.
    """
    samples = Samples.from_episodes(episodes)
    group, groups = group_of(episodes, by)
    runs = tuple(dict.fromkeys(e.run_id for e in episodes))
    before = _histories(episodes, trajectories)
    parts = np.split(_signals(samples, period), samples.bounds[1:-1])
    pieces = [_with_history(part, h, samples.dt) for part, h in zip(parts, before, strict=True)]
    bounds = np.append(0, np.cumsum([len(p) for p in pieces]))
    return Records(
        episodes=samples.episodes,
        dt=samples.dt,
        signals=np.ascontiguousarray(np.concatenate(pieces)),
        bounds=bounds,
        first=bounds[:-1] + np.array([len(h) for h in before]),
        length=samples.length[:, VEHICLES.index("driver")].copy(),  # a loop is compiled for each layout
        group=group.numpy(),
        groups=groups,
        run=np.array([runs.index(e.run_id) for e in episodes]),
        runs=runs,
        period=period,
    )


def _signals(samples: Samples, period: float) -> np.ndarray:
    """Return the columns of the loop, [samples, columns]."""
    second, leader, driver, behind = range(len(VEHICLES))
    place = samples.place
    if period > 0.0:
        place = np.concatenate([np.unwrap(p, period=period) for p in np.split(place, samples.bounds[1:-1])])
    rear = samples.position - np.repeat(samples.length, samples.lengths, axis=0)
    position, speed, accel, present = samples.position, samples.speed, samples.accel, samples.present
    columns = [x[:, leader] for x in (rear, speed, accel)]
    columns += [x[:, second] for x in (rear, speed, accel, present)]
    columns += [*(x[:, behind] for x in (position, speed, accel, present)), *samples.beside.T]
    columns += [*(x[:, driver] for x in (position, speed, accel)), samples.time, place, np.ones(len(place))]
    assert len(columns) == len(march.COLUMNS)
    return np.stack(columns, axis=1)


def _histories(episodes: Sequence[Episode], trajectories: Trajectories | None) -> list[np.ndarray]:
    """Return the measured speeds before every episode, on its clock, back to the first hole in time."""
    if trajectories is None:
        return [np.zeros(0)] * len(episodes)
    tracks = {
        key: (part["time_s"].to_numpy(), part["speed_mps"].to_numpy())
        for key, part in trajectories.table.partition_by(
            ["run_id", "vehicle_id"], as_dict=True, maintain_order=True
        ).items()
    }
    histories = []
    for e in episodes:
        time, speed = tracks[e.run_id, e.vehicle_id]
        end = int(np.searchsorted(time, e.time_s[0] - 1e-6))
        step = trajectories.steps[e.run_id]
        holes = np.flatnonzero(np.diff(time[: end + 1]) > 1.5 * step)
        begin = int(holes[-1]) + 1 if len(holes) else 0
        stride = max(1, round(e.dt / step))
        past = speed[end - stride : begin - 1 if begin else None : -stride][::-1]
        histories.append(past if end > stride else speed[:0])
    return histories


def _with_history(signals: np.ndarray, speeds: np.ndarray, dt: float) -> np.ndarray:
    """Put the driver's past in front: his own speeds, everything else as at the episode's first sample."""
    before = np.repeat(signals[:1], len(speeds), axis=0)
    column = march.COLUMNS.index
    before[:, column("speed")] = speeds
    # Nobody knows where the others were: they stand still in the driver's eyes, rather than accelerate for minutes.
    for name in ("lead_accel", "second_accel", "behind_accel"):
        before[:, column(name)] = 0.0
    if len(speeds):
        before[:, column("accel")] = np.gradient(np.append(speeds, signals[0, column("speed")]), dt)[:-1]
    before[:, column("time")] -= dt * np.arange(len(speeds), 0, -1)
    return np.concatenate([before, signals])


@dataclass(frozen=True, eq=False)
class Rows:
    """What is rolled out: row i is ``steps`` steps from sample ``start[i]`` of ``record[i]``.

    ``valid`` [rows, samples] says which kept samples (every ``every``-th) are inside the record and count; ``joined``
    says that row i − 1 ends where row i begins; ``block`` numbers blocks of a record that are held out in turn.
    """

    records: Records
    record: np.ndarray
    start: np.ndarray
    steps: int
    every: int
    valid: np.ndarray
    joined: np.ndarray
    block: np.ndarray

    def __len__(self) -> int:
        return len(self.record)

    def some(self, wanted: np.ndarray) -> Rows:
        """Return some of the rows, whole records of them."""
        each = {name: getattr(self, name)[wanted] for name in ("record", "start", "valid", "joined", "block")}
        return replace(self, **each)

    @cached_property
    def group(self) -> np.ndarray:
        """Group of every row."""
        return self.records.group[self.record]

    @property
    def run(self) -> np.ndarray:
        """Run of every row."""
        return self.records.run[self.record]

    def settled(self) -> Rows:
        """Return the rows without the first seconds of records, for calibrations in free simulation.

        What the driver saw and did before a record begins is not known, and a delay, a memory or a smoother's edge
        makes errors of it that no parameter explains: fitted to them, parameters err where they matter.
        """
        span = (self.records.bounds[1:] - self.records.first)[self.record] * self.records.dt
        begin = np.where(span >= SHORT_S, TRIM_S[0], 1.0)
        since = (self.samples - self.records.first[self.record][:, None]) * self.records.dt
        return replace(self, valid=self.valid & (since >= begin[:, None]))

    @cached_property
    def seconds(self) -> np.ndarray:
        """Steps from the start at which the parts of about a second begin and end that a row is cut into [J + 1]."""
        return np.linspace(0, self.steps, max(1, round(self.steps * self.records.dt)) + 1).round().astype(int)

    @cached_property
    def middle(self) -> np.ndarray:
        """Index of the sample in the middle of every such part, [rows, J]."""
        return self.start[:, None] + self.seconds[:-1] + np.diff(self.seconds) // 2

    @cached_property
    def samples(self) -> np.ndarray:
        """Index of every kept sample, [rows, samples], inside the record."""
        ahead = self.start[:, None] + self.every * (1 + np.arange(self.steps // self.every))
        return np.minimum(ahead, self.records.bounds[self.record + 1][:, None] - 1)


def windows(records: Records, seconds: float = WINDOW_S, every_s: float = 0.5) -> Rows:
    """Return contiguous windows of ``seconds`` over every record; short or trimmed-away records give none.

    DataError where no record is long enough.
    """
    dt = records.dt
    every = max(1, round(every_s / dt))
    steps = max(2, round(seconds / dt / every)) * every
    record, start, joined, block = [], [], [], []
    sizes = block_seconds((records.bounds[1:] - records.first) * dt)
    for r in range(len(records)):
        begin, end = int(records.first[r]), int(records.bounds[r + 1])
        span = (end - begin) * dt
        before, after = TRIM_S if span >= SHORT_S else (1.0, 1.0)
        starts = np.arange(begin + round(before / dt), end - round(after / dt) - steps, steps)
        record += [r] * len(starts)
        start += starts.tolist()
        joined += [i > 0 for i in range(len(starts))]
        block += ((starts - begin) * dt // sizes[r]).astype(int).tolist()
    if not record:
        raise DataError(f"no record is longer than {seconds + 2:g} s; discovery needs longer tracks.")
    valid = np.ones((len(record), steps // every), bool)
    return Rows(records, np.array(record), np.array(start), steps, every, valid, np.array(joined), np.array(block))


def whole(records: Records, longest_s: float = 300.0, every_s: float = 0.5) -> Rows:
    """Return rows that cover every record from its first sample, cut where it is longer than ``longest_s``."""
    dt = records.dt
    every = max(1, round(every_s / dt))
    record, start, lasts = [], [], []
    for r in range(len(records)):
        begin, end = int(records.first[r]), int(records.bounds[r + 1])
        pieces = max(1, int(np.ceil((end - begin) * dt / longest_s - 0.2)))
        cuts = np.linspace(begin, end, pieces + 1).astype(int)
        record += [r] * pieces
        start += cuts[:-1].tolist()
        lasts += cuts[1:].tolist()
    first = np.array(start)
    count = int(max(np.array(lasts) - first) - 1) // every
    samples = first[:, None] + every * (1 + np.arange(count))
    valid = samples < np.array(lasts)[:, None]
    none = (np.zeros(len(first), kind) for kind in (bool, int))
    return Rows(records, np.array(record), first, count * every, every, valid, *none)


def block_seconds(span: np.ndarray) -> np.ndarray:
    """Return lengths (s) [records] of blocks held out in turn: 30 s, or a quarter of a shorter record, at least 5 s."""
    return np.clip(span / 4.0, 5.0, 30.0)
