"""One step of drivers behind records, linearised about a path: the only thing that a filter has to know of a driver.

Nothing here knows an equation: derivatives are those of ``Simulator.step``, at every sample of every driver at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from idm_env.data import Episode
from idm_env.fitting.batch import Batch
from idm_env.parameters import catalogue, replaced
from idm_env.simulator import Simulator
from idm_env.types import mapped

STILL = 600.0
"""A memory time (s) at which a level stays as it is over a step."""
NARROW = 1e-3
"""Points of a level closer than this tell no slope."""
FINEST_S = 0.1
"""Longest step (s) of the simulator between two samples.

In one of 0.5 s what the step leaves out is taken for drift: σ of T came out as 0.64 for 0.3, τ as 83 s for 12 s.
"""


def stacked(episodes: Iterable[Episode]) -> Batch:
    """Return a batch with as many steps per sample as ``FINEST_S`` asks for."""
    items = tuple(episodes)
    return Batch.stack(items, substeps=max(1, math.ceil(items[0].dt / FINEST_S - 1e-6)))


@dataclass(frozen=True, eq=False)
class Path:
    """Where drivers are linearised: gap (m) and speed (m/s) [T, rows], levels [T, rows, p + k], log θ [rows, p].

    Levels are what a driver's own log θ has more than ``theta``, which stays, and σn of every drift.

    A level belongs to the step that ends at its sample, as the level of a step is that after its normal. ``unsure`` is
    the standard deviation of drifts' levels about the path [T, rows, k].
    """

    gap: np.ndarray
    speed: np.ndarray
    level: np.ndarray
    theta: np.ndarray
    unsure: np.ndarray

    @classmethod
    def without_drift(cls, drivers: MeasuredDrivers, theta: np.ndarray) -> Path:
        """Return the path of drivers on their records who do not drift, known for sure."""
        gap, speed = drivers.batch.gap.numpy(), drivers.batch.speed.numpy()
        k = len(drivers.drifts)
        return cls(gap, speed, np.zeros((*gap.shape, len(drivers.free) + k)), theta, np.zeros((*gap.shape, k)))


@dataclass(frozen=True, eq=False)
class LinearSteps:
    """Steps about a path: gap and speed after a step ``to`` [T − 1, rows, 2], and their derivatives.

    ``by_state`` [T − 1, rows, 2, 2] by gap and speed, ``by_level`` [T − 1, rows, 2, p + k] by levels of the step.
    """

    to: np.ndarray
    by_state: np.ndarray
    by_level: np.ndarray


class MeasuredDrivers:
    """Measured drivers as a simulator steps them: one step per sample, everybody else on the record.

    ``batch`` are the records, smoothed; ``measured`` the same samples with gap and speed as measured: the noise of a
    leader's record would else move the gap. ``free`` are full names of the parameters that differ between drivers,
    positive ones. ValueError for effects that look back: a step about a path knows no past.
    """

    def __init__(self, simulator: Simulator, batch: Batch, measured: Batch, free: tuple[str, ...]) -> None:
        if simulator.looks_back:
            late = next(e.name for e in simulator.effects if e.looks_back)
            raise ValueError(f"effect '{late}' looks back, and a filter of drift does not. Leave it out here.")
        self.simulator, self.batch, self.measured, self.free = simulator, batch, measured, free
        self.drifts = tuple(e.name for e in simulator.effects if e.draws and e.remembers)
        parameters = catalogue(simulator.effects)
        self.bounds = np.log([[parameters[name].low, parameters[name].high] for name in free]).T
        self.at, self.driver = batch.columns(simulator)

    @property
    def levels(self) -> int:
        """Number of levels: every parameter of a driver, and every drift."""
        return len(self.free) + len(self.drifts)

    def params(self, theta: Tensor) -> dict[str, dict[str, Tensor]]:
        """Return parameters of drivers with log θ [..., p], and drift in units of its level: σ = 1, standing still."""
        params = self.simulator.defaults(dtype=torch.float64)
        own = {name: theta[..., i].exp().unsqueeze(-1) for i, name in enumerate(self.free)}
        params = replaced(params, own)
        for name in self.drifts:
            one = torch.ones((), dtype=torch.float64)
            params[name] = {**params[name], "sigma": one, "memory_time": STILL * one}
        return params

    def linearise(self, path: Path) -> LinearSteps:
        """Return the steps from all samples but the last, linear about the path.

        Where a drift is unsure a step is the best line over what it may be, by three points of Gauss and Hermite: a
        time gap that varies brakes more than its mean does.
        """
        gap, speed = (torch.tensor(x[:-1], requires_grad=True) for x in (path.gap, path.speed))
        level = [torch.tensor(path.level[1:, :, j], requires_grad=True) for j in range(self.levels)]
        after = self._stepped(path, gap, speed, level)
        slopes = [torch.autograd.grad(x.sum(), (gap, speed, *level), retain_graph=True) for x in after]

        def both(part: slice) -> np.ndarray:
            return np.stack([np.stack([g.numpy() for g in s[part]], -1) for s in slopes], -2)

        to, by_level = np.stack([x.detach().numpy() for x in after], -1), both(slice(2, None))
        middle = to.copy()
        for j in range(len(self.drifts)):
            off, slot = math.sqrt(3.0) * path.unsure[1:, :, j], len(self.free) + j
            if not off.any():
                continue
            with torch.no_grad():
                moves = (torch.tensor(off), -torch.tensor(off))
                ends = [[*level[:slot], level[slot] + move, *level[slot + 1 :]] for move in moves]
                high, low = (np.stack([x.numpy() for x in self._stepped(path, gap, speed, end)], -1) for end in ends)
            to += (high + low - 2.0 * middle) / 6.0
            slope = (high - low) / (2.0 * np.maximum(off, NARROW))[..., None]
            by_level[..., slot] = np.where(off[..., None] > NARROW, slope, by_level[..., slot])
        return LinearSteps(to, both(slice(0, 2)), by_level)

    def _stepped(self, path: Path, gap: Tensor, speed: Tensor, level: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return gap and speed a sample after every sample but the last; levels hold until then."""
        batch, simulator, d, own, fine = self.batch, self.simulator, self.driver, len(self.free), self.batch.substeps
        params = self.params(torch.tensor(path.theta) + torch.stack(level[:own], -1))
        records = (batch.position, batch.all_speed, batch.accel, batch.present)
        position, speeds, accel, present = (x[:-1:fine, :, self.at].clone() for x in records)
        length, step = batch.length[:, self.at], batch.first_step + fine * torch.arange(len(gap))[:, None]
        position[..., d], speeds[..., d] = position[..., d - 1] - length[:, d - 1] - gap, speed
        others = present if self.at != slice(1, 3) else None
        state = simulator.state(position, speeds, params, length=length, accel=accel, present=others, step=step)
        levels = {name: level[own + j].unsqueeze(-1).expand(position.shape) for j, name in enumerate(self.drifts)}
        state = state._replace(memory={**state.memory, **levels})
        inputs = dict(batch.inputs(simulator.without(*simulator.draws)))
        still = dict.fromkeys(simulator.draws, torch.zeros_like(position))
        for i in range(fine):
            state = simulator.step(state, mapped(lambda x, i=i: x[i::fine], inputs) | still, params)
        return state.gap[..., d], state.speed[..., d]
