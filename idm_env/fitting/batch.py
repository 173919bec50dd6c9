"""Measured episodes as one batch of tensors: a row per episode, every vehicle of it replayed but the driver.

A row holds [second leader, leader, driver, vehicle behind], front first, of which a simulator gets the columns that its
effects need. Rows of unequal length are padded; ``valid`` tells the samples that were measured.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from idm_env.data import DataError, Episode, Record
from idm_env.simulator import Simulator
from idm_env.types import Adjacent, Inputs, Params, State
from idm_env.types import Record as Replayed

COLUMNS = ("second_leader", "leader", "driver", "behind")


@dataclass(frozen=True, eq=False)
class Batch:
    """Episodes on one time step, padded to one length.

    Time is first: ``gap``, ``speed`` and ``valid`` are [T, rows]; ``position``, ``all_speed``, ``accel`` and
    ``present`` are [T, rows, 4] in the order of ``COLUMNS``, positions in the coordinate of places; ``length`` is
    [rows, 4], ``first_step`` [rows]; ``beside`` is distance, speed and presence of the adjacent vehicle, each [T,
    rows].
    """

    episodes: tuple[Episode, ...]
    dt: float
    gap: Tensor
    speed: Tensor
    valid: Tensor
    position: Tensor
    all_speed: Tensor
    accel: Tensor
    present: Tensor
    length: Tensor
    first_step: Tensor
    beside: tuple[Tensor, Tensor, Tensor]

    @classmethod
    def of(cls, episodes: Iterable[Episode], dtype: torch.dtype = torch.float64) -> Batch:
        """Stack episodes. DataError if there is none, or if they differ in their time step."""
        items = tuple(episodes)
        if not items:
            raise DataError("no episode of a driver behind a leader is left. Loosen the split or the shortest length.")
        dt = items[0].dt
        odd = next((e for e in items if abs(e.dt - dt) > 1e-3 * dt), None)
        if odd is not None:
            raise DataError(
                f"episodes {items[0].key} and {odd.key} have steps of {dt:g} and {odd.dt:g} s. Give one dt."
            )
        steps = max(len(e) for e in items)

        def stack(columns: Sequence[np.ndarray]) -> Tensor:
            padded = [np.pad(c, [(0, steps - len(c))], mode="edge") for c in columns]
            return torch.as_tensor(np.stack(padded, axis=1), dtype=dtype)

        def four(field: str) -> Tensor:
            return torch.stack([stack([_column(e, name, field) for e in items]) for name in COLUMNS], dim=-1)

        return cls(
            episodes=items,
            dt=dt,
            gap=stack([e.gap_m for e in items]),
            speed=stack([e.speed_mps for e in items]),
            valid=stack([np.ones(len(e)) for e in items]) * _inside([len(e) for e in items], steps, dtype),
            position=four("position_m"),
            all_speed=four("speed_mps"),
            accel=four("accel_mps2"),
            present=four("present"),
            length=torch.as_tensor([[_length(e, name) for name in COLUMNS] for e in items], dtype=dtype),
            first_step=torch.as_tensor([round(float(e.time_s[0]) / dt) for e in items]),
            beside=(
                stack([e.adjacent.position_m - e.position_m for e in items]),
                stack([e.adjacent.speed_mps for e in items]),
                stack([e.adjacent.present.astype(float) for e in items]),
            ),
        )

    def __len__(self) -> int:
        return len(self.episodes)

    @property
    def steps(self) -> int:
        """Steps of the longest episode."""
        return len(self.gap) - 1

    def rows(self, index: Sequence[int]) -> Batch:
        """Return some of the rows, without the padding that they do not need."""
        at = torch.as_tensor(list(index))
        steps = max(len(self.episodes[i]) for i in index)
        changes = {
            name: getattr(self, name)[:steps].index_select(1, at)
            for name in ("gap", "speed", "valid", "position", "all_speed", "accel", "present")
        }
        beside = [x[:steps].index_select(1, at) for x in self.beside]
        return dataclasses.replace(
            self,
            episodes=tuple(self.episodes[i] for i in index),
            length=self.length[at],
            first_step=self.first_step[at],
            beside=(beside[0], beside[1], beside[2]),
            **changes,
        )

    def columns(self, simulator: Simulator) -> tuple[slice, int]:
        """Return which of the four columns a simulator needs, and the driver's place among them."""
        needs = frozenset().union(*(e.needs for e in simulator.effects))
        begin = 0 if "second_leader" in needs else 1
        return slice(begin, 4 if "behind" in needs else 3), 2 - begin

    def start(self, simulator: Simulator, params: Params) -> State:
        """Return the measured state at the first sample, in the full shape that the parameters broadcast to."""
        at, _ = self.columns(simulator)
        position = self.position[0, :, at]
        shape = torch.broadcast_shapes(position.shape, *(x.shape for p in params.values() for x in p.values()))
        return simulator.state(
            position.expand(shape),
            self.all_speed[0, :, at].expand(shape),
            params,
            length=self.length[:, at],
            accel=self.accel[0, :, at].expand(shape),
            present=self.present[0, :, at] if at != slice(1, 3) else None,
            step=self.first_step,
        )

    def inputs(self, simulator: Simulator) -> Inputs:
        """Return the record of everybody but the driver, and what other effects take from the measurement."""
        at, driver = self.columns(simulator)
        position = self.position[1:, :, at]
        active = torch.arange(position.shape[-1]) != driver
        inputs: dict[str, object] = {
            "replay": Replayed(
                position,
                self.all_speed[1:, :, at],
                self.accel[1:, :, at],
                active.expand_as(position),
                self.present[1:, :, at] if at != slice(1, 3) else None,
            )
        }
        if "lateral" in simulator.by_name:
            distance, speed, present = (x[:-1, :, None].expand_as(position) for x in self.beside)
            inputs["lateral"] = Adjacent(distance, speed, present)
        return inputs


def _inside(lengths: list[int], steps: int, dtype: torch.dtype) -> Tensor:
    return (torch.arange(steps)[:, None] < torch.as_tensor(lengths)).to(dtype)


def _record(episode: Episode, name: str) -> Record | None:
    return None if name == "driver" else getattr(episode, name)


def _column(episode: Episode, name: str, field: str) -> np.ndarray:
    record = _record(episode, name)
    if field == "position_m":
        # Everything is moved along with the driver, so that places are those of its own track at the start.
        moved = float(episode.place_m[0] - episode.position_m[0])
        return (episode.position_m if record is None else record.position_m) + moved
    if record is not None:
        return np.asarray(getattr(record, field), dtype=float)
    if field == "speed_mps":
        return episode.speed_mps
    if field == "accel_mps2":
        return np.gradient(episode.speed_mps, episode.dt)
    return np.ones(len(episode))


def _length(episode: Episode, name: str) -> float:
    record = _record(episode, name)
    return episode.length_m if record is None else record.length_m


def windows(episodes: Iterable[Episode], seconds: float, shortest: float = 20.0) -> list[Episode]:
    """Cut long episodes into windows of ``seconds``; each starts from its own measured state.

    A rest shorter than ``shortest`` (s) stays with the window before it.
    """
    cut = []
    for episode in episodes:
        size = round(seconds / episode.dt)
        begins = list(range(0, max(len(episode) - round(shortest / episode.dt), 1), size))
        for number, begin in enumerate(begins):
            end = len(episode) if number == len(begins) - 1 else begin + size
            cut.append(part(episode, begin, end))
    return cut


def part(episode: Episode, begin: int, end: int) -> Episode:
    """Return the samples [begin, end) of an episode, under the same key."""
    at = slice(begin, end)

    def cut(record: Record) -> Record:
        return Record(
            record.position_m[at], record.speed_mps[at], record.accel_mps2[at], record.length_m, record.present[at]
        )

    return dataclasses.replace(
        episode,
        time_s=episode.time_s[at],
        position_m=episode.position_m[at],
        speed_mps=episode.speed_mps[at],
        gap_m=episode.gap_m[at],
        place_m=episode.place_m[at],
        columns={name: column[at] for name, column in episode.columns.items()},
        leader=cut(episode.leader),
        second_leader=cut(episode.second_leader),
        behind=cut(episode.behind),
        adjacent=cut(episode.adjacent),
    )
