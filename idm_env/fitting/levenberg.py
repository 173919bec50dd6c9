"""Levenberg–Marquardt over all groups of drivers at once, with bounds kept exactly and parameters shared by the fleet.

Every group has its own damping and is accepted or refused by itself. Parameters at a bound that the gradient pushes
outwards are held there (an active set), so a bound never stalls the others. Shared parameters follow variable
projection: their step comes from the normal equations with the own parameters eliminated, and a trial is judged only
after the own parameters have been re-optimised at it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.fitting.problem import Problem


@dataclass(frozen=True)
class Normal:
    """Normal equations per group: cost [..., G], gradient [..., G, N] and Gauss–Newton matrix [..., G, N, N]."""

    cost: Tensor
    gradient: Tensor
    hessian: Tensor


@dataclass(frozen=True)
class Progress:
    """Everything that an interrupted fit needs to go on as if nothing had happened.

    ``own`` [S, G, P], ``shared`` [S, Q]; ``damping`` and ``done`` [S, G]; ``iteration`` counts from 0.
    """

    own: Tensor
    shared: Tensor
    damping: Tensor
    done: Tensor
    iteration: int = 0
    shared_damping: float = 1e-2
    finished: bool = False


def row_equations(problem: Problem, own: Tensor, shared: Tensor) -> tuple[Normal, Tensor]:
    """Linearise and return the equations of every row, and its weight in the loss [S, rows].

    With ``loss="mse"`` a row costs ``Σ r²``; with ``"rmse"`` it costs ``√(Σ r²/n)``, whose gradient and majorising
    matrix are those of Σ r² with weight ``1/(n · RMSE)``: iteratively reweighted least squares, which never raises
    the cost.
    """
    square, gradient, hessian = problem.equations(own, shared)
    if problem.loss == "mse":
        return Normal(square, gradient, hessian), torch.ones_like(square)
    samples = problem.samples.clamp_min(1.0)
    cost = torch.sqrt(square / samples + 1e-12)
    weight = 1.0 / (samples * cost)
    return Normal(cost, gradient * weight[..., None], hessian * weight[..., None, None]), weight


def normal(problem: Problem, own: Tensor, shared: Tensor) -> Normal:
    """Linearise at these values and sum the normal equations over the rows of every group, and the prior's."""
    rows, _ = row_equations(problem, own, shared)
    total = Normal(*(sum_groups(problem, x) for x in (rows.cost, rows.gradient, rows.hessian)))
    if problem.prior is not None:
        count = len(problem.own)
        cost, gradient, hessian = problem.prior.equations(own)
        total.gradient[..., :count] += gradient
        total.hessian[..., :count, :count] += hessian
        total = dataclasses.replace(total, cost=total.cost + cost)
    return total


def sum_groups(problem: Problem, x: Tensor) -> Tensor:
    """Sum [S, rows, ...] over the rows of every group: [S, G, ...]."""
    total = x.new_zeros(x.shape[0], len(problem.groups), *x.shape[2:])
    return total.index_add(1, problem.group, x)


def _solve(hessian: Tensor, gradient: Tensor, damping: Tensor, free: Tensor) -> Tensor:
    """Return the damped Gauss–Newton step, 0 for parameters that are not free."""
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.clamp_min(1e-9 * diagonal.amax(-1, keepdim=True) + 1e-300)
    mask = free.to(hessian.dtype)
    matrix = hessian * mask[..., None] * mask[..., None, :]
    matrix = matrix + torch.diag_embed(torch.where(free, damping[..., None] * scale, 1.0))
    return -torch.linalg.solve(matrix, (gradient * mask)[..., None])[..., 0]


def _free(value: Tensor, gradient: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Tell which parameters may move: all but those at a bound whose descent direction leads out."""
    return ~(((value <= low) & (gradient > 0)) | ((value >= high) & (gradient < 0)))


def own_step(problem: Problem, now: Normal, own: Tensor, damping: Tensor) -> Tensor:
    """Return trial values of the own parameters, inside their bounds: what a bound stops stays there, the rest adapts.

    A step that is only clipped may lead uphill, because the parameters that move freely were meant for the whole step.
    """
    count = len(problem.own)
    low, high = (bound[:count] for bound in problem.bounds)
    gradient, hessian = now.gradient[..., :count], now.hessian[..., :count, :count]
    free = _free(own, gradient, low, high)
    wanted = own + _solve(hessian, gradient, damping, free)
    stopped = (wanted < low) | (wanted > high)
    at_bound = torch.where(stopped, wanted.clamp(low, high) - own, 0.0)
    left = gradient + (hessian @ at_bound[..., None])[..., 0]
    step = torch.where(stopped, at_bound, _solve(hessian, left, damping, free & ~stopped))
    return torch.minimum(torch.maximum(own + step, low), high)


def refine(
    problem: Problem,
    progress: Progress,
    iterations: int,
    *,
    tolerance: float = 1e-6,
    on_step: Callable[[Progress, Normal], None] | None = None,
) -> tuple[Progress, Normal]:
    """Improve the own parameters at fixed shared ones until every group has converged or ``iterations`` have passed.

    A group has converged when an accepted step lowers its cost by less than ``tolerance`` of it, when a refused step
    promised no more than that, or when no damping up to 1e8 finds a lower one. ``on_step`` is called after every
    iteration.
    """
    now = normal(problem, progress.own, progress.shared)
    while progress.iteration < iterations and not bool(progress.done.all()):
        trial = own_step(problem, now, progress.own, progress.damping)
        trial = torch.where(progress.done[..., None], progress.own, trial)
        then = normal(problem, trial, progress.shared)
        better = (then.cost < now.cost) & ~progress.done
        small = now.cost - then.cost <= tolerance * now.cost
        promised = -(now.gradient[..., : len(problem.own)] * (trial - progress.own)).sum(-1)
        # A clipped step that promises nothing says nothing either: more damping shortens it until it lies inside.
        hopeless = ~better & (promised >= 0.0) & (promised <= tolerance * now.cost)
        damping = torch.where(better, progress.damping * 0.2, progress.damping * 5.0).clamp_min(1e-9)
        now = Normal(
            torch.where(better, then.cost, now.cost),
            torch.where(better[..., None], then.gradient, now.gradient),
            torch.where(better[..., None, None], then.hessian, now.hessian),
        )
        progress = dataclasses.replace(
            progress,
            own=torch.where(better[..., None], trial, progress.own),
            damping=damping,
            done=progress.done | (better & small) | hopeless | (damping > 1e8),
            iteration=progress.iteration + 1,
        )
        if on_step is not None:
            on_step(progress, now)
    return progress, now


def eliminate(problem: Problem, now: Normal, own: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the shared parameters' gradient [S, Q] and matrix [S, Q, Q] with the own ones projected out, and the map.

    The map [S, G, P, Q] gives ``−dθ/dφ``, how own parameters follow a step of the shared ones.
    """
    count = len(problem.own)
    low, high = (bound[:count] for bound in problem.bounds)
    g_own, g_shared = now.gradient[..., :count], now.gradient[..., count:].sum(1)
    free = _free(own, g_own, low, high).to(own.dtype)
    inner = now.hessian[..., :count, :count] * free[..., None] * free[..., None, :]
    scale = inner.diagonal(dim1=-2, dim2=-1)
    inner = inner + torch.diag_embed(torch.where(free > 0, 1e-9 * scale.amax(-1, keepdim=True) + 1e-12, 1.0))
    cross = now.hessian[..., :count, count:] * free[..., None]
    follow = torch.linalg.solve(inner, cross)
    matrix = (now.hessian[..., count:, count:] - cross.mT @ follow).sum(1)
    gradient = g_shared - (follow.mT @ (g_own * free)[..., None])[..., 0].sum(1)
    return gradient, matrix, follow


def minimise(
    problem: Problem,
    progress: Progress,
    iterations: int,
    *,
    tolerance: float = 1e-3,
    inner: int = 3,
    on_step: Callable[[Progress, Normal], None] | None = None,
) -> tuple[Progress, Normal]:
    """Find own and shared parameters; without shared ones this is ``refine``.

    Each iteration steps the shared parameters by their projected normal equations, lets the own ones follow,
    re-optimises these for ``inner`` iterations, and keeps the result only if the total cost is lower.
    """
    if not problem.shared:
        progress, now = refine(problem, progress, iterations, on_step=on_step)
        return dataclasses.replace(progress, finished=bool(progress.done.all())), now
    if progress.own.shape[0] != 1:
        raise ValueError(f"{progress.own.shape[0]} starts with shared parameters: give one start at a time.")
    count = len(problem.own)
    low, high = (bound[count:] for bound in problem.bounds)
    now = normal(problem, progress.own, progress.shared)
    while progress.iteration < iterations and not progress.finished:
        gradient, matrix, follow = eliminate(problem, now, progress.own)
        free = _free(progress.shared, gradient, low, high)
        step = _solve(matrix, gradient, torch.full_like(gradient[..., 0], progress.shared_damping), free)
        shared = torch.minimum(torch.maximum(progress.shared + step, low), high)
        own = progress.own - (follow @ (shared - progress.shared)[:, None, :, None])[..., 0]
        own = torch.minimum(torch.maximum(own, problem.bounds[0][:count]), problem.bounds[1][:count])
        fresh = Progress(own, shared, torch.full_like(progress.damping, 1e-3), torch.zeros_like(progress.done))
        trial, then = refine(problem, fresh, inner)
        before, after = float(now.cost.sum()), float(then.cost.sum())
        if after < before:
            finished = before - after <= tolerance * before
            progress = dataclasses.replace(
                trial,
                iteration=progress.iteration + 1,
                shared_damping=max(progress.shared_damping * 0.2, 1e-9),
                finished=finished,
            )
            now = then
        else:
            damping = progress.shared_damping * 10.0
            progress = dataclasses.replace(
                progress, iteration=progress.iteration + 1, shared_damping=damping, finished=damping > 1e6
            )
        if on_step is not None:
            on_step(progress, now)
    return progress, now
