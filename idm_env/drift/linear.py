"""One step of drivers behind records, linearised about a path: the only thing that a filter has to know of a driver.

Nothing here knows an equation: derivatives are those of ``Simulator.step``, at every sample of every driver at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from idm_env.fitting.batch import Batch
from idm_env.parameters import catalogue
from idm_env.simulator import Simulator
from idm_env.types import Record

STILL = 600.0
"""A memory time (s) at which a level stays as it is over a step."""


@dataclass(frozen=True, eq=False)
class Path:
    """Where drivers are linearised: gap (m) and speed (m/s) [T, rows], levels [T, rows, 1 + k], log θ [rows, p].

    Levels are a driver's own log time gap less the population's, which stays, and σn of every drift.

    A level belongs to the step that ends at its sample, as the level of a step is that after its normal.
    """

    gap: np.ndarray
    speed: np.ndarray
    level: np.ndarray
    theta: np.ndarray


@dataclass(frozen=True, eq=False)
class Linear:
    """Steps about a path: gap and speed after a step ``to`` [T − 1, rows, 2], and their derivatives.

    ``by_state`` [T − 1, rows, 2, 2] by gap and speed, ``by_level`` [T − 1, rows, 2, 1 + k] by levels of the step.
    """

    path: Path
    to: np.ndarray
    by_state: np.ndarray
    by_level: np.ndarray


class Drivers:
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
        known = catalogue(simulator.effects)
        self.bounds = np.log([[known[name].low, known[name].high] for name in free])
        self.at, self.driver = batch.columns(simulator)

    def params(self, theta: Tensor, style: Tensor) -> dict[str, dict[str, Tensor]]:
        """Return parameters of drivers with log θ [..., p], and drift in units of its level: σ = 1, standing still.

        ``style`` is added to the log time gap.
        """
        params = self.simulator.defaults(dtype=torch.float64)
        for i, name in enumerate(self.free):
            effect, parameter = name.split(".")
            by = style if parameter == "time_gap" else 0.0
            params[effect][parameter] = (theta[..., i] + by).exp().unsqueeze(-1)
        for name in self.drifts:
            one = torch.ones((), dtype=torch.float64)
            params[name] = {**params[name], "sigma": one, "memory_time": STILL * one}
        return params

    def linearise(self, path: Path, first: int = 0, last: int | None = None) -> Linear:
        """Return the steps from the samples ``first`` to ``last`` − 1 (all but the last sample), about the path."""
        batch, simulator, d = self.batch, self.simulator, self.driver
        begin, end = first, len(batch.gap) - 1 if last is None else last
        gap, speed = (torch.tensor(x[begin:end], requires_grad=True) for x in (path.gap, path.speed))
        level = [
            torch.tensor(path.level[begin + 1 : end + 1, :, j], requires_grad=True) for j in range(1 + len(self.drifts))
        ]
        params = self.params(torch.tensor(path.theta), level[0])
        now, later = batch.position[begin:end, :, self.at], batch.position[begin + 1 : end + 1, :, self.at]
        ahead = now[..., d - 1] - batch.length[:, self.at][:, d - 1] - gap
        position = torch.cat((now[..., :d], ahead.unsqueeze(-1), now[..., d + 1 :]), -1)
        speeds, accels = (x[begin:end, :, self.at] for x in (batch.all_speed, batch.accel))
        speeds = torch.cat((speeds[..., :d], speed.unsqueeze(-1), speeds[..., d + 1 :]), -1)
        present = batch.present[..., self.at] if self.at != slice(1, 3) else None
        state = simulator.state(
            position, speeds, params, length=batch.length[:, self.at], accel=accels,
            present=None if present is None else present[begin:end],
            step=batch.first_step + torch.arange(begin, end)[:, None],
        )  # fmt: skip
        levels = {name: level[j + 1].unsqueeze(-1).expand(position.shape) for j, name in enumerate(self.drifts)}
        there, faster = (x[begin + 1 : end + 1, :, self.at] for x in (batch.all_speed, batch.accel))
        record = Record(
            later, there, faster,
            (torch.arange(position.shape[-1]) != d).expand(position.shape),
            None if present is None else present[begin + 1 : end + 1],
        )  # fmt: skip
        still = torch.zeros_like(position)
        inputs = {"replay": record, **dict.fromkeys(simulator.draws, still)}
        after = simulator.step(state._replace(memory={**state.memory, **levels}), inputs, params)
        made = [after.gap[..., d], after.speed[..., d]]
        slopes = [torch.autograd.grad(x.sum(), (gap, speed, *level), retain_graph=True) for x in made]

        def both(part: slice) -> np.ndarray:
            return np.stack([np.stack([g.numpy() for g in s[part]], -1) for s in slopes], -2)

        return Linear(
            path,
            np.stack([x.detach().numpy() for x in made], -1),
            both(slice(0, 2)),
            both(slice(2, None)),
        )
