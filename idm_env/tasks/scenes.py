"""Whole recorded roads as slots: all vehicles of all lanes on one clock, everybody right behind whom he follows.

The simulator's leader of slot i is slot i − 1. So vehicles are laid out in chains of leader and follower, each chain
after an empty slot that nobody ever occupies. A vehicle that follows different leaders over time begins a chain of
its own, behind a *seat*: a slot that is placed wherever its recorded leader of the moment is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from idm_env.tasks.types import NOBODY


class Scene(NamedTuple):
    """A recorded road.

    ``motion`` (time, slots, 3): position (m), speed (m/s) and acceleration (m/s²), finite also where nobody is;
    ``present`` (time, slots): who is there; ``led`` (time, slots): who follows a recorded leader; ``length``
    (slots,) in metres; ``ids``: ``"run/vehicle"`` of each slot; ``lane``: an index of its run and lane, for pictures.
    """

    motion: np.ndarray
    present: np.ndarray
    led: np.ndarray
    length: np.ndarray
    ids: tuple[str, ...]
    lane: tuple[int, ...]


@dataclass
class Track:
    """One vehicle on the common clock: arrays (time,), NaN where it is not there; ``leader`` holds ids or ''.

    ``lane`` is an id of its run and first lane, ``lanes`` (time,) the file's numbers.
    """

    key: str
    lane: str
    length: float
    position: np.ndarray
    speed: np.ndarray
    gap: np.ndarray
    measured: np.ndarray
    leader: np.ndarray
    lanes: np.ndarray


@lru_cache(maxsize=4)
def recorded_scene(path: str, dt: float, runs: tuple[str, ...] | None) -> Scene:
    """Return the road of a trajectory file, smoothed, on a clock of ``dt``; ``runs`` picks some of its runs.

    Raises:
        ValueError: If a run does not exist or its step does not fit ``dt``.
        DataError: If the file cannot be used.
    """
    return _laid_out(recorded_tracks(path, dt, runs), dt)


def recorded_tracks(path: str, dt: float, runs: tuple[str, ...] | None) -> list[Track]:
    """Return the tracks of the chosen runs of a file, on a clock of ``dt``; errors as in ``recorded_scene``.

    ValueError for a run that is not there, or a ``dt`` that does not divide.
    """
    from idm_env.data import load

    trajectories = load(path)
    for run in runs or ():
        if run not in trajectories.steps:
            raise ValueError(f"run '{run}' is not in {path}. It has {', '.join(list(trajectories.steps)[:8])}.")
    chosen = runs or tuple(trajectories.steps)
    for run in chosen:
        stride = dt / trajectories.steps[run]
        if stride < 0.99 or abs(stride - round(stride)) > 0.01:
            step = trajectories.steps[run]
            raise ValueError(f"dt = {dt:g} s is no multiple of the step of run '{run}', {step:g} s. Give dt={step:g}.")
    return _tracks(trajectories.table, chosen, dt)


def _tracks(table: Any, runs: Sequence[str], dt: float) -> list[Track]:
    """Return the tracks of the chosen runs, every row whose time falls on the clock."""
    columns = {name: np.asarray(table[name]) for name in ("run_id", "vehicle_id", "leader_id", "time_s", "position_m")}
    columns |= {name: np.asarray(table[name]) for name in ("speed_mps", "gap_m", "length_m", "gap_measured", "lane")}
    rows = np.isin(columns["run_id"].astype(str), list(runs))
    columns = {name: values[rows] for name, values in columns.items()}
    time = (columns["time_s"].astype(float) - columns["time_s"].astype(float).min()) / dt
    step = np.round(time).astype(int)
    on_clock = np.abs(time - step) < 0.25
    keys = np.char.add(np.char.add(columns["run_id"].astype(str), "/"), columns["vehicle_id"].astype(str))
    rows_of: dict[str, list[int]] = {key: [] for key in keys.tolist()}
    for row in np.flatnonzero(on_clock).tolist():
        rows_of[keys[row]].append(row)
    tracks = []
    for key, mine in rows_of.items():
        steps = step[mine]
        # A step of time to which two rows are rounded keeps the first.
        steps, first = np.unique(steps, return_index=True)
        part = {name: values[mine][first] for name, values in columns.items()}

        def laid(name: str, steps: np.ndarray = steps, part: dict[str, np.ndarray] = part) -> np.ndarray:
            values = np.full(step.max() + 1, np.nan)
            values[steps] = part[name].astype(float)
            return values

        run, leader = part["run_id"][0], np.full(step.max() + 1, "", object)
        leader[steps] = ["" if x is None else f"{run}/{x}" for x in part["leader_id"]]
        motion, length = (laid("position_m"), laid("speed_mps"), laid("gap_m")), float(part["length_m"][0])
        lane, measured = f"{run}/{part['lane'][0]}", laid("gap_measured") == 1.0
        tracks.append(Track(key, lane, length, *motion, measured, leader, laid("lane")))
    return tracks


def _laid_out(tracks: list[Track], dt: float) -> Scene:
    """Lay tracks out in chains, behind empty slots and seats."""
    by_key = {track.key: track for track in tracks}
    ahead = {track.key: _only_leader(track, by_key) for track in tracks}
    follower: dict[str, str] = {}
    for key, leader in ahead.items():
        if leader is not None and leader not in follower:
            follower[leader] = key
    ahead = {key: leader if follower.get(leader or "") == key else None for key, leader in ahead.items()}
    lanes = {lane: i for i, lane in enumerate(sorted({track.lane for track in tracks}))}
    slots: list[tuple[str, Track | None, np.ndarray | None]] = []
    for track in tracks:
        if ahead[track.key] is not None:
            continue
        slots.append((NOBODY, None, None))
        if (track.leader != "").any():
            slots.append((NOBODY, track, _seat(track, by_key)))
        last = track
        slots.append((last.key, last, None))
        while last.key in follower and ahead[follower[last.key]] == last.key:
            _align(by_key[follower[last.key]], last)
            last = by_key[follower[last.key]]
            slots.append((last.key, last, None))
    return _scene(slots, lanes, len(tracks[0].position), dt)


def _only_leader(track: Track, by_key: dict[str, Track]) -> str | None:
    """Return the one vehicle that this one always follows while that is there, or None."""
    leaders = {leader for leader in track.leader if leader}
    if len(leaders) != 1:
        return None
    leader = leaders.pop()
    if leader not in by_key:
        return None
    both = np.isfinite(track.position) & np.isfinite(by_key[leader].position)
    return leader if bool((track.leader[both] == leader).all()) else None


def _align(track: Track, leader: Track) -> None:
    """Shift positions so that measured gaps hold; between them the last shift holds."""
    rows = np.flatnonzero(track.measured & np.isfinite(track.gap) & np.isfinite(leader.position))
    if len(rows):
        shift = leader.position[rows] - leader.length - track.gap[rows] - track.position[rows]
        track.position += np.interp(np.arange(len(track.position)), rows, shift)


def _seat(track: Track, by_key: dict[str, Track]) -> np.ndarray:
    """Return position and speed (2, time) of whoever leads: as far ahead as the gap says, of the follower's length."""
    position = np.where(track.leader != "", track.position + track.gap + track.length, np.nan)
    speed = track.speed.copy()
    for leader in set(track.leader) & set(by_key):
        mine = track.leader == leader
        speed[mine] = by_key[leader].speed[mine]
    return np.stack((position, speed))


def _scene(
    slots: list[tuple[str, Track | None, np.ndarray | None]], lanes: dict[str, int], steps: int, dt: float
) -> Scene:
    motion = np.zeros((steps, len(slots), 3))
    present = np.zeros((steps, len(slots)), bool)
    for i, (_, track, seat) in enumerate(slots):
        if track is not None:
            motion[:, i], present[:, i] = smoothed(track, seat, dt)
    ahead = np.zeros_like(present)
    ahead[:, 1:] = present[:, :-1]
    return Scene(
        motion=motion,
        present=present,
        led=present & ahead,
        length=np.array([4.5 if track is None else track.length for _, track, _ in slots]),
        ids=tuple(key for key, _, _ in slots),
        lane=tuple(0 if track is None else lanes[track.lane] for _, track, _ in slots),
    )


def smoothed(track: Track, seat: np.ndarray | None, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the smooth motion [T, 3] (m, m/s, m/s²) and presence [T]; an absent vehicle stands where it was last."""
    from idm_env.data.smooth import fuse

    position, speed = (track.position, track.speed) if seat is None else seat
    present = np.isfinite(position) & np.isfinite(speed)
    motion = np.zeros((len(position), 3))
    edges = np.flatnonzero(np.diff(np.concatenate(([0], present.view(np.int8), [0]))))
    for begin, end in edges.reshape(-1, 2):
        part = slice(begin, end)
        motion[part, 0], motion[part, 1] = position[part], np.clip(speed[part], 0.0, None)
        # A seat jumps where the leader changes: it is not smoothed, and its acceleration counts as 0.
        if seat is None and end - begin >= 4:
            smooth = fuse(position[part], speed[part], dt)
            motion[part] = np.stack((smooth.position, np.clip(smooth.speed, 0.0, None), smooth.accel), axis=-1)
    motion[:, 0] = filled(motion[:, 0], present)
    return motion, present


def filled(values: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return values [T] where nobody is as they were before; at the beginning as they are first."""
    rows = np.flatnonzero(present)
    if not len(rows):
        return np.zeros_like(values)
    return np.asarray(values[rows[np.clip(np.searchsorted(rows, np.arange(len(values)), side="right") - 1, 0, None)]])


@lru_cache(maxsize=4)
def made_up_scene(dt: float, followers: int = 6, seconds: float = 600.0) -> Scene:
    """Return the project's own scene: the made-up leader, and drivers behind it who differ a little in T and a."""
    import torch

    from idm_env.effects import IDM, Brakes, Replay
    from idm_env.effects.idm import equilibrium_gap
    from idm_env.roads import Lane
    from idm_env.simulator import Simulator
    from idm_env.tasks.recorded import head, made_up_leader, queue

    leader = torch.as_tensor(made_up_leader(dt, seconds).motion[0])
    simulator = Simulator(Lane(), (IDM(), Brakes(), Replay()), dt)
    spread = torch.linspace(-1.0, 1.0, followers + 1, dtype=torch.float64)
    params: Any = simulator.defaults(dtype=torch.float64)
    params["idm"] |= {"time_gap": 1.3 + 0.3 * spread, "max_accel": 1.2 - 0.2 * spread}
    speed = leader[0, 1].expand(1, followers + 1).contiguous()
    gaps = equilibrium_gap(IDM().driver(params["idm"]), speed)[:, 1:]
    state = simulator.state(queue(leader[:1, :1], gaps, 4.5), speed, params, length=4.5)
    first = torch.arange(followers + 1) == 0
    seen = [torch.stack((state.position, state.speed, state.accel), -1)]
    with torch.no_grad():
        for t in range(1, len(leader)):
            state = simulator.step(state, {"replay": head(leader[t : t + 1], first)}, params)
            seen.append(torch.stack((state.position, state.speed, state.accel), -1))
    motion = torch.cat(seen).numpy()
    present = np.ones(motion.shape[:2], bool)
    led = present.copy()
    led[:, 0] = False
    ids = tuple(f"made-up/{i}" for i in range(followers + 1))
    return Scene(motion, present, led, np.full(followers + 1, 4.5), ids, (0,) * (followers + 1))
