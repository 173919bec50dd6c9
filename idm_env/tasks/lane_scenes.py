"""Whole recorded roads of several lanes: every vehicle has one slot, and a lane at every time."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from idm_env.tasks.scenes import Track, filled, recorded_tracks, smoothed

if TYPE_CHECKING:
    import torch

    from idm_env.types import State


class LanesScene(NamedTuple):
    """A recorded road of several lanes.

    ``motion`` (time, slots, 3): position (m), speed (m/s) and acceleration (m/s²), finite also where nobody is;
    ``present`` (time, slots): who is there; ``lane`` (time, slots): on which lane, 0 on the right, where nobody is that
    of before; ``led`` (time, slots): who is behind somebody on his lane, and touches nobody there; ``length`` (slots,)
    in metres; ``ids``: ``"run/vehicle"`` of each slot; ``extent`` (lanes, 2): from where to where there are vehicles on
    each lane (m).
    """

    motion: np.ndarray
    present: np.ndarray
    led: np.ndarray
    length: np.ndarray
    ids: tuple[str, ...]
    lane: np.ndarray
    extent: np.ndarray


@lru_cache(maxsize=4)
def recorded_lanes(path: str, dt: float, run: str | None, first_lane: str) -> LanesScene:
    """Return the road of one run of a trajectory file (None: its only one), smoothed, on a clock of ``dt``.

    ``first_lane`` says whether the lane with the lowest number is on the left, as in NGSIM, or on the right.

    Raises:
        ValueError: If a run does not exist or its step does not fit ``dt``.
        DataError: If the file cannot be used, has several runs and none was named, or leaves a lane empty.
    """
    from idm_env.data import DataError

    tracks = recorded_tracks(path, dt, None if run is None else (run,))
    runs = sorted({track.key.rsplit("/", 1)[0] for track in tracks})
    if len(runs) > 1:
        raise DataError(f"{path} has {len(runs)} runs, and they are different roads. Name one: runs=['{runs[0]}'].")
    numbers = np.unique(np.concatenate([track.lanes[np.isfinite(track.lanes)] for track in tracks]))
    if not len(numbers):
        raise DataError(f"{path}: no vehicle has a lane. Give a column 'lane', or take task 'replay'.")
    if len(numbers) == 1:
        raise DataError(f"{path} has one lane, {numbers[0]:g}. Take task 'replay'.")
    for track in tracks:
        nowhere = np.isfinite(track.position) & ~np.isfinite(track.lanes)
        if nowhere.any():
            raise DataError(
                f"{path}: vehicle {track.key} has no lane in {int(nowhere.sum())} rows, first "
                f"{nowhere.argmax() * dt:g} s after the run begins. Fill in its lanes, or leave these rows out."
            )
    lane = np.zeros((len(tracks[0].position), len(tracks)), int)
    for i, track in enumerate(tracks):
        lane[:, i] = filled(np.searchsorted(numbers, track.lanes), np.isfinite(track.lanes))
    return _scene(tracks, len(numbers) - 1 - lane if first_lane == "left" else lane, len(numbers), dt)


def _scene(tracks: list[Track], lane: np.ndarray, count: int, dt: float) -> LanesScene:
    motion = np.zeros((*lane.shape, 3))
    present = np.zeros(lane.shape, bool)
    for i, track in enumerate(tracks):
        motion[:, i], present[:, i] = smoothed(track, None, dt)
    length = np.array([track.length for track in tracks])
    return _seen(motion, present, lane, length, tuple(track.key for track in tracks), count)


def _seen(
    motion: np.ndarray, present: np.ndarray, lane: np.ndarray, length: np.ndarray, ids: tuple[str, ...], count: int
) -> LanesScene:
    """Return the scene of these motions and lanes."""
    time, slot = np.nonzero(present)
    place, on = motion[time, slot, 0], lane[time, slot]
    order = np.lexsort((place, on, time))
    back, front = order[:-1], order[1:]
    pair = (time[back] == time[front]) & (on[back] == on[front])
    back, front = back[pair], front[pair]
    touching = place[front] - length[slot[front]] - place[back] <= 0.0
    led = np.zeros(lane.shape, bool)
    led[time[back], slot[back]] = True
    for one in (back, front):
        led[time[one[touching]], slot[one[touching]]] = False
    extent = np.zeros((count, 2))
    for k in range(count):
        mine = on == k
        if mine.any():
            extent[k] = (place[mine] - length[slot[mine]]).min(), place[mine].max()
    return LanesScene(motion, present, led, length, ids, lane, extent)


@lru_cache(maxsize=4)
def made_up_lanes(dt: float, vehicles: int = 24, seconds: float = 90.0) -> LanesScene:
    """Return the project's own scene: three lanes, drivers with desired speeds of 20 to 32 m/s who change lanes."""
    import torch

    from idm_env.effects import IDM, Brakes, Mobil
    from idm_env.roads import Lanes
    from idm_env.simulator import Simulator

    simulator = Simulator(Lanes(3), (IDM(), Mobil(), Brakes()), dt)
    params: Any = simulator.defaults(dtype=torch.float64)
    index = torch.arange(vehicles)
    share = (0.618033988749895 * index.double()) % 1.0
    params["idm"] |= {"desired_speed": 20.0 + 12.0 * share, "time_gap": torch.tensor(1.2, dtype=torch.float64)}
    position = 300.0 - 36.0 * torch.div(index, 3, rounding_mode="floor").double() + 6.0 * share
    speed = torch.full_like(position, 18.0)
    state = simulator.state(position, speed, params, length=4.5, lane=index % 3)

    def seen(now: State) -> tuple[torch.Tensor, torch.Tensor]:
        assert now.lanes is not None
        return torch.stack((now.position, now.speed, now.accel), -1), now.lanes.lane

    with torch.no_grad():
        _, steps = simulator.rollout(state, {}, params, round(seconds / dt), keep=seen)
    motion, lane = (torch.cat((x[None], later)).numpy() for x, later in zip(seen(state), steps, strict=True))
    present, length = np.ones(lane.shape, bool), np.full(vehicles, 4.5)
    return _seen(motion, present, lane, length, tuple(f"made-up/{i}" for i in range(vehicles)), 3)
