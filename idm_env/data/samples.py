"""Episodes as arrays, one behind the other: what fits and discovery lay out as their loops want it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from idm_env.data.episode import Episode, time_step

VEHICLES = ("second_leader", "leader", "driver", "behind")
"""Who is around, front first; the third one drives."""


@dataclass(frozen=True, eq=False)
class Samples:
    """All samples of some episodes on one time step ``dt``; those of episode r are ``bounds[r] : bounds[r + 1]``.

    ``position`` (m), ``speed``, ``accel`` and ``present`` are [samples, 4] in the order of ``VEHICLES``, ``beside``
    [samples, 3] is distance (m), speed and presence of the vehicle in an adjacent lane; ``gap`` (m), ``time`` (s) and
    ``place`` (m) are [samples], ``length`` (m) is [episodes, 4].
    """

    episodes: tuple[Episode, ...]
    dt: float
    bounds: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    accel: np.ndarray
    present: np.ndarray
    beside: np.ndarray
    gap: np.ndarray
    time: np.ndarray
    place: np.ndarray
    length: np.ndarray

    @classmethod
    def from_episodes(cls, episodes: Iterable[Episode]) -> Samples:
        """Return the samples of episodes. DataError if there is none, or if they differ in their time step."""
        items = tuple(episodes)
        dt = time_step(items)
        around = [[getattr(e, name) for name in VEHICLES] for e in items]

        def four(field: str) -> np.ndarray:
            columns = [np.concatenate([getattr(each[i], field) for each in around]) for i in range(len(VEHICLES))]
            return np.stack(columns, axis=1).astype(float)

        def one(field: str) -> np.ndarray:
            return np.concatenate([getattr(e, field) for e in items]).astype(float)

        adjacent = [(e.adjacent.position_m - e.position_m, e.adjacent.speed_mps, e.adjacent.present) for e in items]
        bounds = np.append(0, np.cumsum([len(e) for e in items]))
        motion = four("position_m"), four("speed_mps"), four("accel_mps2"), four("present")
        adjacent_lane = np.concatenate([np.stack(columns, axis=1) for columns in adjacent])
        length = np.array([[record.length_m for record in each] for each in around], float)
        return cls(items, dt, bounds, *motion, adjacent_lane, one("gap_m"), one("time_s"), one("place_m"), length)

    @property
    def lengths(self) -> np.ndarray:
        """Number of samples of every episode."""
        return np.diff(self.bounds)
