"""Measured episodes as one batch of tensors: a row per episode, every vehicle of it replayed but the driver.

A row holds [second leader, leader, driver, vehicle behind], front first, of which a simulator gets the columns that its
effects need. Rows of unequal length are padded; ``valid`` tells the samples that were measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from idm_env.data import DataError, Episode
from idm_env.data.samples import VEHICLES, Samples
from idm_env.simulator import Simulator
from idm_env.types import Adjacent, Inputs, Params, Record as Replayed, State

INTEGRATION_STEP_S = 0.025
"""Largest step (s) by which measured data are simulated: at 0.1 s the first-order error of a step biases parameters
by up to 1 %, which is more than the noise of good data does."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Episodes on one time step ``dt``, padded to one length, and simulated with ``substeps`` steps per sample.

    Time is first. Measured on T samples: ``gap``, ``speed`` and ``valid``, [T, rows]. Records on the steps in
    between too, (T − 1) · substeps + 1 of them: ``position``, ``all_speed``, ``accel`` and ``present`` [·, rows, 4]
    in the order of ``VEHICLES``, positions in the coordinate of places; ``beside`` is distance, speed and presence of
    the adjacent vehicle, each [·, rows]. ``length`` is [rows, 4], ``first_step`` [rows].
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
    substeps: int = 1

    @classmethod
    def stack(
        cls, episodes: Iterable[Episode], dtype: torch.dtype = torch.float64, substeps: int | None = None
    ) -> Batch:
        """Stack episodes. DataError if there is none, or if they differ in their time step.

        ``substeps`` None takes as many as ``INTEGRATION_STEP_S`` asks for.
        """
        samples = Samples.from_episodes(episodes)
        begin, end, steps = samples.bounds[:-1], samples.bounds[1:], int(samples.lengths.max())
        index = np.minimum(begin + np.arange(steps)[:, None], end - 1)  # padded with its last sample

        def rows(x: np.ndarray) -> Tensor:
            return torch.as_tensor(x[index], dtype=dtype)

        fine = substeps or max(1, math.ceil(samples.dt / INTEGRATION_STEP_S - 1e-6))
        # Everything is moved along with the driver, so that places are those of its own track at the start.
        driver = VEHICLES.index("driver")
        moved = torch.as_tensor(samples.place[begin] - samples.position[begin, driver], dtype=dtype)
        position, speed, adjacent = rows(samples.position) + moved[:, None], rows(samples.speed), rows(samples.beside)
        return cls(
            episodes=samples.episodes,
            dt=samples.dt,
            gap=rows(samples.gap),
            speed=speed[..., driver].contiguous(),
            valid=torch.as_tensor(np.arange(steps)[:, None] < samples.lengths, dtype=dtype),
            position=_between_positions(position, speed, samples.dt, fine),
            all_speed=_interpolate(speed, fine),
            accel=_interpolate(rows(samples.accel), fine),
            present=_held(rows(samples.present), fine),
            length=torch.as_tensor(samples.length, dtype=dtype),
            first_step=torch.as_tensor(np.round(samples.time[begin] / samples.dt * fine).astype(int)),
            beside=(
                _interpolate(adjacent[..., 0], fine),
                _interpolate(adjacent[..., 1], fine),
                _held(adjacent[..., 2], fine),
            ),
            substeps=fine,
        )

    def __len__(self) -> int:
        return len(self.episodes)

    @property
    def steps(self) -> int:
        """Simulated steps of the longest episode."""
        return (len(self.gap) - 1) * self.substeps

    @property
    def step(self) -> float:
        """Step of the simulation (s)."""
        return self.dt / self.substeps

    def columns(self, simulator: Simulator) -> tuple[slice, int]:
        """Return which of the four columns a simulator needs, and the driver's place among them."""
        needs = frozenset().union(*(e.needs for e in simulator.effects))
        begin = 0 if "second_leader" in needs else 1
        return slice(begin, 4 if "behind" in needs else 3), 2 - begin

    def start(self, simulator: Simulator, params: Params) -> State:
        """Return the measured state at the first sample, in the full shape that the parameters broadcast to."""
        vehicles, _ = self.columns(simulator)
        position = self.position[0, :, vehicles]
        # Of numpy: torch's own imports sympy at its first call, a CPU second.
        shape = np.broadcast_shapes(position.shape, *(x.shape for p in params.values() for x in p.values()))
        return simulator.state(
            position.expand(shape),
            self.all_speed[0, :, vehicles].expand(shape),
            params,
            length=self.length[:, vehicles],
            accel=self.accel[0, :, vehicles].expand(shape),
            present=self.present[0, :, vehicles] if vehicles != slice(1, 3) else None,
            step=self.first_step,
        )

    def inputs(self, simulator: Simulator, seed: int = 0) -> Inputs:
        """Return the record of everybody but the driver, and the measured inputs of other effects.

        Normals are drawn with ``seed``. DataError for an effect whose input no measurement has.
        """
        vehicles, driver = self.columns(simulator)
        position = self.position[1:, :, vehicles]
        speed, accel, present = (x[1:, :, vehicles] for x in (self.all_speed, self.accel, self.present))
        active = (torch.arange(position.shape[-1]) != driver).expand_as(position)
        record = Replayed(position, speed, accel, active, present if vehicles != slice(1, 3) else None)
        adjacent = Adjacent(*(x[:-1, :, None].expand_as(position) for x in self.beside))
        measured = {Replayed: record, Adjacent: adjacent}
        taking = {e.name: e.takes for e in simulator.effects if e.takes is not None}
        for name, what in taking.items():
            if what not in measured:
                raise DataError(f"effect '{name}' takes an input that measured data do not have. Remove it.")
        inputs = {name: measured[what] for name, what in taking.items()}
        return simulator.drawn(position[0], inputs, len(position), seed)


def _interpolate(x: Tensor, substeps: int) -> Tensor:
    """Interpolate linearly between samples, time first."""
    share = torch.arange(substeps, dtype=x.dtype) / substeps
    share = share.reshape(1, -1, *(1,) * (x.dim() - 1))
    fine = x[:-1, None] + share * (x[1:] - x[:-1])[:, None]
    return torch.cat((fine.flatten(0, 1), x[-1:]))


def _held(x: Tensor, substeps: int) -> Tensor:
    """Hold every sample until the next: for presence."""
    return torch.cat((x[:-1].repeat_interleave(substeps, 0), x[-1:]))


def _between_positions(position: Tensor, speed: Tensor, dt: float, substeps: int) -> Tensor:
    """Interpolate positions by cubics that meet the samples' positions and speeds (Hermite)."""
    s = (torch.arange(substeps, dtype=position.dtype) / substeps).reshape(1, -1, *(1,) * (position.dim() - 1))
    a, b = position[:-1, None], position[1:, None]
    u, v = dt * speed[:-1, None], dt * speed[1:, None]
    cubic = a + s * u + s * s * (3 * (b - a) - 2 * u - v) + s**3 * (u + v - 2 * (b - a))
    # Where a vehicle is exchanged for another, or speeds do not belong to positions, a cubic would overshoot.
    plain = a + s * (b - a)
    fine = torch.where((b - a - 0.5 * (u + v)).abs() < 0.5, cubic, plain)
    return torch.cat((fine.flatten(0, 1), position[-1:]))
