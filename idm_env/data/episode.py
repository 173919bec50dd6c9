"""One driver behind one leader over one unbroken stretch of time, with everybody around them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, overload

import numpy as np

from idm_env.data.errors import DataError, Repair
from idm_env.data.records import VehicleRecord


@dataclass(frozen=True, eq=False)
class Episode:
    """One follower behind one leader; arrays are [T] in SI units, finite everywhere.

    Attributes:
        run_id, vehicle_id, leader_id: Identifiers, as text.
        key: ``"run/vehicle/k"`` with k counting the stretches of this vehicle.
        dt: Time step in s.
        time_s: The file's clock.
        position_m, speed_mps, gap_m: The driver's front bumper, speed and measured bumper-to-bumper gap.
        length_m: The driver's length.
        leader: Its record; leader.position_m − leader.length_m − position_m equals gap_m.
        second_leader, behind, adjacent: Records on the same clock, ``present`` where they were there: the leader's
            leader, the vehicle that follows this driver, and the nearest one in a lane beside.
        place_m: Coordinate of places, such as the position on a lap.
        columns: Further numeric columns of the file.
        labels: Further columns that are constant here, such as ``vehicle_name`` or ``split``.
    """

    run_id: str
    vehicle_id: str
    leader_id: str
    key: str
    dt: float
    time_s: np.ndarray
    position_m: np.ndarray
    speed_mps: np.ndarray
    gap_m: np.ndarray
    length_m: float
    leader: VehicleRecord
    second_leader: VehicleRecord
    behind: VehicleRecord
    adjacent: VehicleRecord
    place_m: np.ndarray
    columns: dict[str, np.ndarray]
    labels: dict[str, str]

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def seconds(self) -> float:
        """Duration in s."""
        return len(self) * self.dt

    @property
    def driver(self) -> VehicleRecord:
        """The driver's own record."""
        accel = np.gradient(self.speed_mps, self.dt)
        return VehicleRecord(self.position_m, self.speed_mps, accel, self.length_m, np.ones(len(self), dtype=bool))

    def part(self, begin: int, end: int) -> Episode:
        """Return the samples [begin, end), under the same key."""

        def cut(value: Any) -> Any:
            if isinstance(value, np.ndarray):
                return value[begin:end]
            if isinstance(value, VehicleRecord):
                return replace(value, **{f.name: cut(getattr(value, f.name)) for f in fields(value)})
            return value

        columns = {name: cut(column) for name, column in self.columns.items()}
        return replace(self, **{f.name: cut(getattr(self, f.name)) for f in fields(self)} | {"columns": columns})


@dataclass(frozen=True, eq=False)
class Episodes(Sequence[Episode]):
    """Episodes in the order of the table, and the rows left out, counted by reason."""

    items: tuple[Episode, ...]
    left_out: tuple[Repair, ...]

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Episode]:
        return iter(self.items)

    @overload
    def __getitem__(self, index: int) -> Episode: ...
    @overload
    def __getitem__(self, index: slice) -> Episodes: ...
    def __getitem__(self, index: int | slice) -> Episode | Episodes:
        if isinstance(index, slice):
            return Episodes(self.items[index], self.left_out)
        return self.items[index]


def windows(episodes: Iterable[Episode], seconds: float, shortest: float = 20.0) -> list[Episode]:
    """Cut long episodes into windows of ``seconds``; each starts from its own measured state.

    A rest shorter than ``shortest`` (s) stays with the window before it.
    """
    cut = []
    for episode in episodes:
        size = round(seconds / episode.dt)
        begins = list(range(0, max(len(episode) - round(shortest / episode.dt), 1), size))
        cut += [episode.part(*ends) for ends in zip(begins, [*begins[1:], len(episode)], strict=True)]
    return cut


def time_step(episodes: Sequence[Episode]) -> float:
    """Return the time step (s) of all episodes. DataError if there is none, or if they differ in it."""
    if not episodes:
        raise DataError("no episode of a driver behind a leader is left. Loosen the split or the shortest length.")
    first = episodes[0]
    odd = next((e for e in episodes if abs(e.dt - first.dt) > 1e-3 * first.dt), None)
    if odd is not None:
        raise DataError(f"episodes {first.key} and {odd.key} have steps of {first.dt:g} and {odd.dt:g} s. Give one dt.")
    return first.dt
