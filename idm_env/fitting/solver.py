"""One solver for the parameters of drivers: Levenberg–Marquardt over all groups at once, nested in shared parameters.

A problem has own parameters θ_g of every group and shared ones φ, and costs ``Σ_g C_g(θ_g, φ)`` and what is known
beforehand. Every group has its own damping and is accepted or refused by itself. Bounds are kept exactly: a parameter
that the gradient pushes out of its bounds is held there (an active set), so a bound never stalls the others. Shared
parameters follow variable projection (Golub and Pereyra 1973): their step comes from the normal equations with the own
parameters eliminated, so it already knows how these will follow.

Shapes: θ is ``[groups, p]``, φ ``[q]``, costs are ``[groups]``; units are those of the problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

SIZES = (1.0, 0.4, 0.1)
"""Shares of a step of own and shared parameters that are tried at once."""
FOLLOWING = 3
"""Steps by which own parameters follow a trial of the shared ones."""


@dataclass(frozen=True)
class Normal:
    """Normal equations per group: cost [..., G], gradient [..., G, N] and Gauss–Newton matrix [..., G, N, N].

    Gradient and matrix are halved, as those of ``½ Σ r²`` are: Jᵀr and JᵀJ. Own parameters come first.
    """

    cost: Tensor
    gradient: Tensor
    hessian: Tensor


class Box(NamedTuple):
    """Lower and upper bounds of parameters and the longest step of one iteration, each [P] or [Q]."""

    low: Tensor
    high: Tensor
    reach: Tensor

    def clip(self, value: Tensor) -> Tensor:
        """Return values inside the bounds."""
        return torch.minimum(torch.maximum(value, self.low), self.high)


class Known(Protocol):
    """Prior of the own parameters."""

    def equations(self, own: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return its parts of cost [..., G], gradient [..., G, P] and Gauss–Newton matrix; own [..., G, P]."""

    def following(self, own: Tensor) -> Known:
        """Return the same at other values, for a population whose centre is that of its drivers."""


class LeastSquares(Protocol):
    """Problem of nonlinear least squares; S are copies, starts or trials side by side."""

    @property
    def boxes(self) -> tuple[Box, Box]:
        """Bounds and longest steps of own and of shared parameters."""

    @property
    def prior(self) -> Known | None:
        """Prior of the own parameters."""

    @property
    def stiffness(self) -> Tensor:
        """Inverse variances [Q] of the shared parameters about 0; 0 where nothing is known."""

    @property
    def costs(self) -> Callable[[Tensor, Tensor], Tensor] | None:
        """Cost alone, as in ``normal``, if that is much cheaper; it judges trials of shared parameters.

        Without it they are judged after the own ones have followed for ``FOLLOWING`` steps.
        """

    def normal(self, own: Tensor, shared: Tensor) -> Normal:
        """Return the normal equations at own [S, G, P] and shared [S, Q], without what is known beforehand."""


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
    shared_damping: float = 1e-3
    finished: bool = False

    @classmethod
    def begin(cls, own: Tensor, shared: Tensor, damping: float = 1e-2) -> Progress:
        """Return the beginning of a search at these values."""
        return cls(own, shared, torch.full_like(own[..., 0], damping), torch.zeros_like(own[..., 0], dtype=torch.bool))


def normal(problem: LeastSquares, own: Tensor, shared: Tensor) -> Normal:
    """Linearise at these values; what is known of the own parameters is in it."""
    return _add_prior(problem.prior, problem.normal(own, shared), own)


def _add_prior(prior: Known | None, data: Normal, own: Tensor) -> Normal:
    if prior is None:
        return data
    count = own.shape[-1]
    cost, gradient, hessian = prior.equations(own)
    total = Normal(data.cost + cost, data.gradient.clone(), data.hessian.clone())
    total.gradient[..., :count] += gradient
    total.hessian[..., :count, :count] += hessian
    return total


def _solve(hessian: Tensor, gradient: Tensor, damping: Tensor, free: Tensor) -> Tensor:
    """Return the damped Gauss–Newton step, 0 for parameters that are not free."""
    return -torch.linalg.solve(_damped(hessian, damping, free), (gradient * free)[..., None])[..., 0]


def _damped(hessian: Tensor, damping: Tensor, free: Tensor) -> Tensor:
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    # A direction without information keeps a matrix that can be inverted.
    scale = diagonal.clamp_min(1e-9 * diagonal.amax(-1, keepdim=True) + 1e-12)
    matrix = hessian * (free[..., None] & free[..., None, :])
    return matrix + torch.diag_embed(torch.where(free, damping[..., None] * scale, 1.0))


def _free(value: Tensor, gradient: Tensor, box: Box) -> Tensor:
    """Tell which parameters may move: all but those at a bound whose descent direction leads out."""
    return ~(((value <= box.low) & (gradient > 0)) | ((value >= box.high) & (gradient < 0)))


def _tried(value: Tensor, gradient: Tensor, hessian: Tensor, damping: Tensor, box: Box) -> Tensor:
    """Return trial values inside their bounds: what a bound stops stays there, the rest adapts.

    A step that is only clipped may lead uphill, because the parameters that move freely were meant for the whole step.
    """
    free = _free(value, gradient, box)
    low, high = torch.maximum(box.low, value - box.reach), torch.minimum(box.high, value + box.reach)
    target = value + _solve(hessian, gradient, damping, free)
    stopped = (target < low) | (target > high)
    at_bound = torch.where(stopped, target.clamp(low, high) - value, 0.0)
    left = gradient + (hessian @ at_bound[..., None])[..., 0]
    step = torch.where(stopped, at_bound, _solve(hessian, left, damping, free & ~stopped))
    return torch.minimum(torch.maximum(value + step, low), high)


def minimise(
    problem: LeastSquares,
    progress: Progress,
    iterations: int,
    *,
    tolerance: float = 1e-6,
    on_step: Callable[[Progress, Normal], None] | None = None,
) -> tuple[Progress, Normal]:
    """Find own and shared parameters; return them and the normal equations there, with the prior.

    Without shared parameters a group has converged when an accepted step lowers its cost by less than ``tolerance`` of
    it, when a refused step promised no more than that, or when no damping up to 1e8 finds a lower one; the search ends
    when all have. With shared ones, of which there must be one start, it ends when a step gains less of the total.
    ``on_step`` is called after every iteration. ValueError for several starts with shared parameters.
    """
    together = bool(progress.shared.shape[-1])
    if together and len(progress.own) != 1:
        raise ValueError(f"{len(progress.own)} starts with shared parameters: give one start at a time.")
    prior = problem.prior
    data = problem.normal(progress.own, progress.shared)
    while progress.iteration < iterations and not progress.finished:
        prior = None if prior is None else prior.following(progress.own)
        progress, data = (_together if together else _apart)(problem, prior, progress, data, tolerance)
        if on_step is not None:
            on_step(progress, _add_prior(prior, data, progress.own))
    prior = None if prior is None else prior.following(progress.own)
    return progress, _add_prior(prior, data, progress.own)


def _apart(
    problem: LeastSquares, prior: Known | None, progress: Progress, data: Normal, tolerance: float
) -> tuple[Progress, Normal]:
    """Try one step of every group's own parameters, which stands or falls by itself."""
    own, now = progress.own, _add_prior(prior, data, progress.own)
    trial = _own_tried(now, progress, problem.boxes[0])
    trial = torch.where(progress.done[..., None], own, trial)
    # Where a cost alone is cheap, equations are made of accepted trials only.
    fresh = None
    if problem.costs is None:
        fresh = problem.normal(trial, progress.shared)
        data_cost = fresh.cost
    else:
        data_cost = problem.costs(trial, progress.shared)
    cost = data_cost if prior is None else data_cost + prior.equations(trial)[0]
    better = (cost < now.cost) & ~progress.done
    small = now.cost - cost <= tolerance * now.cost
    promised = -(now.gradient[..., : own.shape[-1]] * (trial - own)).sum(-1)
    # A clipped step that promises nothing says nothing either: more damping shortens it until it lies inside.
    hopeless = ~better & (promised >= 0.0) & (promised <= tolerance * now.cost)
    damping = _redamped(progress.damping, better)
    done = progress.done | (better & small) | hopeless | (damping > 1e8)
    own, count = torch.where(better[..., None], trial, own), progress.iteration + 1
    fresh = fresh or problem.normal(own, progress.shared)
    data = Normal(
        torch.where(better, fresh.cost, data.cost),
        torch.where(better[..., None], fresh.gradient, data.gradient),
        torch.where(better[..., None, None], fresh.hessian, data.hessian),
    )
    return replace(progress, own=own, damping=damping, done=done, iteration=count, finished=bool(done.all())), data


def _own_tried(now: Normal, progress: Progress, box: Box) -> Tensor:
    count = progress.own.shape[-1]
    return _tried(progress.own, now.gradient[..., :count], now.hessian[..., :count, :count], progress.damping, box)


def _redamped(damping: Tensor, better: Tensor) -> Tensor:
    return torch.where(better, damping * 0.2, damping * 5.0).clamp_min(1e-9)


def _together(
    problem: LeastSquares, prior: Known | None, progress: Progress, data: Normal, tolerance: float
) -> tuple[Progress, Normal]:
    """Try shares of one step of all parameters, and one of the own ones alone; keep what costs least in all."""
    own, shared, stiff = progress.own, progress.shared, problem.stiffness
    now = _add_prior(prior, data, own)
    own_only = _own_tried(now, progress, problem.boxes[0])
    trials = _shares(now, progress, own_only - own, stiff, problem.boxes)
    trial_shared = torch.cat((trials[1], shared))
    trial_own, costs = _judged(problem, prior, torch.cat((trials[0], own_only)), trial_shared)
    # The last trial leaves φ where it is, and every group decides for itself.
    better = costs[-1:] < now.cost
    costs[-1:] = torch.where(better, costs[-1:], now.cost)
    total = float(now.cost.sum() + (stiff * shared.square()).sum())
    sums = costs.sum(-1) + (stiff * trial_shared.square()).sum(-1)
    best = int(sums.argmin())
    gain = total - float(sums[best])
    moved = torch.cat((trials[0][:1] - own, (trials[1][:1] - shared).expand(own.shape[1], -1)[None]), dim=-1)
    promised = -float((now.gradient * moved).sum() + (stiff * shared * (trials[1][0] - shared)).sum())
    shared_damping = progress.shared_damping
    if best == len(SIZES):
        own = torch.where(better[..., None], trial_own[-1:], own)
        shared_damping *= 10.0
    elif gain > 0.0:
        own, shared = trial_own[best : best + 1], trial_shared[best : best + 1]
        shared_damping *= 0.3 if best == 0 else 1.0
    if gain > 0.0:
        data = problem.normal(own, shared)
    # Own parameters that gain little alone say nothing of a step of the shared ones that was refused.
    decisive = (gain > 0.0 and best < len(SIZES)) or 0.0 <= promised <= tolerance * total or shared_damping > 1e6
    damping, finished = _redamped(progress.damping, better), gain <= tolerance * total and decisive
    progress = replace(progress, own=own, shared=shared, damping=damping, iteration=progress.iteration + 1)
    return replace(progress, shared_damping=max(shared_damping, 1e-9), finished=finished), data


def _judged(problem: LeastSquares, prior: Known | None, own: Tensor, shared: Tensor) -> tuple[Tensor, Tensor]:
    """Return own parameters [K, G, P] of trials, which may have followed the shared ones, and the costs [K, G]."""
    if problem.costs is not None:
        cost = problem.costs(own, shared)
        return own, cost if prior is None else cost + prior.equations(own)[0]
    trial, data = Progress.begin(own, shared, 1e-3), problem.normal(own, shared)
    for _ in range(FOLLOWING):
        trial, data = _apart(problem, prior, trial, data, 0.0)
    return trial.own, _add_prior(prior, data, trial.own).cost


def _shares(
    now: Normal, progress: Progress, own_only: Tensor, stiff: Tensor, boxes: tuple[Box, Box]
) -> tuple[Tensor, Tensor]:
    """Return own [K, G, P] and shared [K, Q] values after shares of a step; ``own_only`` is that of own ones [1, G, P].

    With the own parameters eliminated, ``S = Σ_g (H_φφ − H_φθ H_θθ⁻¹ H_θφ)`` is the matrix of the shared ones.
    """
    own, shared, count = progress.own, progress.shared, progress.own.shape[-1]
    free = _free(own, now.gradient[..., :count], boxes[0])
    pull = now.gradient[..., :count] * free
    cross = now.hessian[..., :count, count:] * free[..., None]
    follow = torch.linalg.solve(_damped(now.hessian[..., :count, :count], progress.damping, free), cross)
    matrix = (now.hessian[..., count:, count:] - cross.mT @ follow).sum(1) + torch.diag(stiff)
    gradient = (now.gradient[..., count:] - (follow.mT @ pull[..., None])[..., 0]).sum(1) + stiff * shared
    damping = torch.full_like(gradient[..., 0], progress.shared_damping)
    step = _tried(shared, gradient, matrix, damping, boxes[1]) - shared
    reach = boxes[0].reach
    together = (own_only - (follow @ step[:, None, :, None])[..., 0]).clamp(-reach, reach)
    share = own.new_tensor(SIZES)[:, None]
    return boxes[0].clip(own + share[..., None] * together), boxes[1].clip(shared + share * step)
