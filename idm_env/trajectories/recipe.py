"""The default recipe: noise fitted to the file, imagined inputs fitted to every track, exact bounds, no overlaps.

Shapes: a track has ``[samples]`` (s, m).
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from idm_env.data.columns import nearest_of
from idm_env.trajectories.imagined import Driven, drive
from idm_env.trajectories.scores import RegularMotion
from idm_env.trajectories.smoother import PositionNoise, Smoothed, SmootherOptions, TrackObservations, smooth
from idm_env.trajectories.tracks import TrackPiece, clock_of

SMALLEST_GAP_M = 0.1
"""Where two vehicles would overlap that did not before, they are held this far apart (m)."""
MOST_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Filtered:
    """A track and its physical motion on a regular clock [K].

    Attributes:
        track: What was measured.
        motion: The simulator's rollout.
        imagined_gap: The input that it got (m).
        sigma: Standard deviations of position, speed and acceleration [K, 3], of the prior and the noise fitted.
        leader: Identifier of the leader at every step, "" for none.
        lane: Lane at every step, −1 for unknown.
        gap: Bumper-to-bumper gap to the leader's filtered position (m), NaN where there is none.
    """

    track: TrackPiece
    motion: RegularMotion
    imagined_gap: np.ndarray
    sigma: np.ndarray
    leader: np.ndarray
    lane: np.ndarray
    gap: np.ndarray


@dataclass(frozen=True)
class Meeting:
    """Steps at which one motion follows another: indices of the follower's steps, and the leader's times there."""

    follower: int
    leader: int
    steps: np.ndarray


def nearest(track: TrackPiece, clock: np.ndarray) -> np.ndarray:
    """Return the index of the sample nearest in time to every tick."""
    return nearest_of(track.time_s, clock)


class Neighbourhood:
    """Followers and leaders among tracks, old ones (already written) included; all by index."""

    def __init__(self, tracks: Sequence[TrackPiece], clocks: Sequence[np.ndarray]) -> None:
        self.clocks = clocks
        self.tracks = tracks
        self.leaders = [track.leader[nearest(track, clock)] for track, clock in zip(tracks, clocks, strict=True)]
        self._by_vehicle: dict[tuple[str, str], list[int]] = {}
        for i, track in enumerate(tracks):
            self._by_vehicle.setdefault((track.run_id, track.vehicle_id), []).append(i)

    def meetings(self) -> Iterator[Meeting]:
        """Yield every pair of a follower and a leader that are there at the same time."""
        for i, (track, clock, leader) in enumerate(zip(self.tracks, self.clocks, self.leaders, strict=True)):
            for name in np.unique(leader):
                for j in self._by_vehicle.get((track.run_id, str(name)), ()) if name else ():
                    other = self.clocks[j]
                    inside = (clock >= other[0] - 1e-9) & (clock <= other[-1] + 1e-9)
                    steps = np.flatnonzero((leader == name) & inside)
                    if len(steps):
                        yield Meeting(i, j, steps)


def recipe(
    tracks: Sequence[TrackPiece],
    dt: float,
    noise: PositionNoise,
    options: SmootherOptions = SmootherOptions(),  # noqa: B008
    before: Sequence[Filtered] = (),
) -> list[Filtered]:
    """Return the filtered tracks: smooth, keep apart, and drive through the simulator.

    ``before`` are tracks of an earlier chunk, which stay as they are: where one of them would overlap with a track
    of this chunk, this chunk's track gives way.
    """
    clocks = [clock_of(track, dt) for track in tracks]
    pairs = zip(tracks, clocks, strict=True)
    observed = [TrackObservations.on_clock(t.time_s, t.position_m, dt, len(clock)) for t, clock in pairs]
    smoothed = _smoothed(observed, noise, options)
    around = Neighbourhood([*tracks, *(f.track for f in before)], [*clocks, *(f.motion.time_s for f in before)])
    meetings = list(around.meetings())
    fixed = [f.motion.position_m for f in before]
    driven = _drive(smoothed, dt, options)
    for _ in range(MOST_ROUNDS):
        positions = [*(d.position for d in driven), *fixed]
        ties = _ties(meetings, around, positions, len(tracks))
        if not ties:
            break
        changed = sorted(ties)
        for i in changed:
            for steps, value in ties[i]:
                observed[i] = observed[i].bounded(steps, 0, value)
            smoothed[i] = smooth(observed[i], noise, options)
        again = _drive([smoothed[i] for i in changed], dt, options)
        for i, d in zip(changed, again, strict=True):
            driven[i] = d
    gaps = [np.full(len(clock), np.nan) for clock in around.clocks]
    positions = [*(d.position for d in driven), *fixed]
    for m in meetings:
        gaps[m.follower][m.steps] = _gap(m, around, positions)
    filtered = []
    for i, (track, clock, d, s) in enumerate(zip(tracks, clocks, driven, smoothed, strict=True)):
        motion, lane = RegularMotion(clock, d.position, d.speed, d.accel), track.lane[nearest(track, clock)]
        filtered.append(Filtered(track, motion, d.gap, s.sigma, around.leaders[i], lane, gaps[i]))
    return filtered


def _smoothed(observed: Sequence[TrackObservations], noise: PositionNoise, options: SmootherOptions) -> list[Smoothed]:
    """Fit every track, on as many threads as torch has; the compiled loops release the interpreter lock."""
    threads = min(torch.get_num_threads(), len(observed))
    if threads < 2:
        return [smooth(o, noise, options) for o in observed]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda o: smooth(o, noise, options), observed))


def _drive(smoothed: Sequence[Smoothed], dt: float, options: SmootherOptions) -> list[Driven]:
    return drive([(s.position, s.speed, s.accel) for s in smoothed], dt, options.highest, options.lowest)


def _gap(m: Meeting, around: Neighbourhood, positions: Sequence[np.ndarray]) -> np.ndarray:
    """Return bumper-to-bumper gaps (m) at the steps of a meeting."""
    ahead = np.interp(around.clocks[m.follower][m.steps], around.clocks[m.leader], positions[m.leader])
    return ahead - around.tracks[m.leader].length_m - positions[m.follower][m.steps]


def _measured_gap(m: Meeting, around: Neighbourhood) -> np.ndarray:
    clock = around.clocks[m.follower][m.steps]
    leader, follower = around.tracks[m.leader], around.tracks[m.follower]
    ahead = np.interp(clock, leader.time_s, leader.position_m) - leader.length_m
    return ahead - np.interp(clock, follower.time_s, follower.position_m)


def _ties(
    meetings: Sequence[Meeting], around: Neighbourhood, positions: Sequence[np.ndarray], count: int
) -> dict[int, list[tuple[np.ndarray, np.ndarray]]]:
    """Return, per track to change, steps and positions that keep it clear of others."""
    ties: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for m in meetings:
        gap = _gap(m, around, positions)
        wrong = (gap < 0.5 * SMALLEST_GAP_M) & (_measured_gap(m, around) > 0)
        if not wrong.any() or (m.follower >= count and m.leader >= count):
            continue
        steps = m.steps[wrong]
        if m.follower < count:
            back = positions[m.follower][steps] + gap[wrong] - SMALLEST_GAP_M
            ties.setdefault(m.follower, []).append((steps, back))
        else:
            clock = around.clocks[m.leader]
            ticks = np.clip(np.round((around.clocks[m.follower][steps] - clock[0]) / (clock[1] - clock[0])), 0, None)
            ticks = np.minimum(ticks.astype(int), len(clock) - 1)
            ahead = positions[m.leader][ticks] - gap[wrong] + SMALLEST_GAP_M
            ties.setdefault(m.leader, []).append((ticks, ahead))
    return ties


def overlaps(filtered: Sequence[Filtered], before: Sequence[Filtered] = ()) -> tuple[int, int]:
    """Return how many steps of followers overlap with their leader, and how many of these did not before."""
    everybody = [*filtered, *before]
    around = Neighbourhood([f.track for f in everybody], [f.motion.time_s for f in everybody])
    positions = [f.motion.position_m for f in everybody]
    total, new = 0, 0
    for m in around.meetings():
        if m.follower < len(filtered) or m.leader < len(filtered):
            wrong = _gap(m, around, positions) <= 0
            total += int(wrong.sum())
            new += int((wrong & (_measured_gap(m, around) > 0)).sum())
    return total, new
