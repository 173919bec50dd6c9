"""How well a model reproduces drivers: errors per episode."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from idm_env.data import Episode
from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import Problem, Simulated, group_of


class Errors(NamedTuple):
    """Per episode [rows]: RMSE and mean absolute error of the gap (m), speed RMSE (m/s), smallest gap (m).

    ``measured_gap`` is the mean gap in the record (m).
    """

    gap_rmse: Tensor
    gap_mae: Tensor
    speed_rmse: Tensor
    smallest_gap: Tensor
    measured_gap: Tensor

    def summary(self) -> dict[str, float]:
        """Return means over episodes, the median gap RMSE, and how many episodes end in a collision."""
        of_gap = {"gap_rmse_m": float(self.gap_rmse.mean()), "gap_rmse_median_m": float(self.gap_rmse.median())}
        others = {"gap_mae_m": float(self.gap_mae.mean()), "speed_rmse_mps": float(self.speed_rmse.mean())}
        counts = {"collisions": int((self.smallest_gap <= 0).sum()), "episodes": len(self.gap_rmse)}
        return of_gap | others | counts


def errors(problem: Problem, own: Tensor, shared: Tensor) -> tuple[Errors, Simulated]:
    """Simulate every driver behind its measured leader and compare; own [G, P], shared [Q].

    The first sample, where simulation starts on the measured state, counts as an error of 0, as in the published
    benchmark.
    """
    with torch.no_grad():
        simulated = problem.simulate(problem.rows(own, shared))
    weight = problem.weight
    count = weight.sum(0) + 1.0
    gap = (simulated.gap - problem.batch.gap[1:]) * weight
    speed = (simulated.speed - problem.batch.speed[1:]) * weight
    gap_rmse, speed_rmse = ((x.square().sum(0) / count).sqrt() for x in (gap, speed))
    smallest = torch.where(weight > 0, simulated.gap, torch.inf).amin(0)
    mean = (problem.batch.gap[1:] * weight).sum(0) / weight.sum(0)
    return Errors(gap_rmse, gap.abs().sum(0) / count, speed_rmse, smallest, mean), simulated


def pooled_errors(problem: Problem, own: Tensor, shared: Tensor, items: Sequence[Episode]) -> Errors:
    """Return the errors on other episodes of values ``own`` [1, free] and ``shared`` that all drivers have."""
    batch = Batch.stack(items, substeps=problem.batch.substeps)
    group, groups = group_of(batch.episodes, "all")
    return errors(dataclasses.replace(problem, batch=batch, group=group, groups=groups), own, shared)[0]
