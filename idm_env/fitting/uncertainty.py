"""Standard errors of fitted parameters, and which of them the data do not tell."""

import dataclasses
from typing import Any, NamedTuple

import torch
from torch import Tensor

from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import Problem
from idm_env.fitting.solver import normal
from idm_env.parameters import Parameter

ENOUGH_ROWS = 10
"""From this many episodes in a group on, their spread itself gives the variance of the group's gradient."""


class Uncertainty(NamedTuple):
    """Per group: covariance [G, N, N], standard errors [G, N], and flags [G, N]."""

    covariance: Tensor
    standard_error: Tensor
    at_bound: Tensor
    identified: Tensor


def estimate_row(
    name: str, p: Parameter, estimate: Tensor, error: Tensor, at_bound: Tensor, identified: Tensor
) -> dict[str, Any]:
    """Return one parameter's row of a table: estimate [], standard error [], 95 % interval, and flags of doubt."""
    middle, half = float(estimate), 1.96 * float(error)
    row: dict[str, Any] = {"parameter": name, "symbol": p.symbol, "unit": p.unit}
    row |= {"estimate": middle, "standard_error": float(error)}
    row |= {"low": max(middle - half, p.low), "high": min(middle + half, p.high)}
    return row | {"at_bound": bool(at_bound), "identified": bool(identified)}


def effective_samples(residual: Tensor, weight: Tensor) -> Tensor:
    """Return how many independent samples a correlated residual is worth, per row: ``n / (1 + 2 Σ ρ_k)``.

    ρ_k is the autocorrelation of the residual about 0 at lag k, [T, rows], summed up to its first non-positive value
    (the initial positive sequence, Geyer 1992). Residuals of free simulation are strongly correlated, and standard
    errors that ignore it are several times too small.
    """
    count = weight.sum(0)
    size = 2 * len(residual)
    spectrum = torch.fft.rfft(residual * weight, size, dim=0)
    covariance = torch.fft.irfft(spectrum.abs().square(), size, dim=0)[: len(residual)]
    rho = covariance / covariance[0].clamp_min(1e-300)
    positive = torch.cumprod((rho > 0).to(rho.dtype), dim=0)
    return count / (2.0 * (rho * positive).sum(0) - 1.0).clamp_min(1.0)


def uncertainty(problem: Problem, own: Tensor, shared: Tensor) -> Uncertainty:
    """Return standard errors by the sandwich ``H⁻¹ M H⁻¹``; own [G, P], shared [Q].

    H is the Gauss–Newton matrix of the loss, M the variance of its gradient. In a group of fewer than ``ENOUGH_ROWS``
    episodes, M adds each row's JᵀJ times its residual variance times n/n_eff, for correlated residuals; in a larger
    one it is the spread of the rows' own gradients, which holds also where drivers differ (cluster-robust, Liang and
    Zeger 1986). Shared parameters add up the information of all groups.

    A parameter is *not identified* when its standard error exceeds half of its value (a quarter of the width of its
    bounds for a strength, whose value may be near 0); it is *at a bound* within 0.1 % of the width. Standard errors
    are of the interior: at a bound they say how flat the loss is, not how far the truth may lie. With a prior the
    covariance is that of the posterior around its mode, ``noise² H⁻¹`` with the prior in H.
    """
    rows, row_weight = problem.row_normal(own[None], shared[None])
    with torch.no_grad():
        residual = problem.residual(problem.simulate(problem.rows(own, shared)))
    sample_weight = problem.weight.repeat(2, 1) if problem.objective == "both" else problem.weight
    independent = effective_samples(residual, sample_weight)
    size = len(problem.own) + len(problem.shared)
    groups = len(problem.groups)
    per_group = own.new_zeros(groups).index_add(0, problem.group, torch.ones_like(problem.samples))
    # Degrees of freedom are spent by the group; every row bears its share.
    spent = size / per_group[problem.group]
    variance = residual.square().sum(0) / (problem.samples - spent).clamp_min(1.0)
    inflation = problem.samples / independent.clamp_min(1.0)
    by_row = rows.hessian[0] * (row_weight[0] * variance * inflation)[:, None, None]
    spread = rows.gradient[0][:, :, None] * rows.gradient[0][:, None, :]
    many = per_group >= ENOUGH_ROWS
    meat = torch.where(many[:, None, None], problem.sum_groups(spread[None])[0], problem.sum_groups(by_row[None])[0])
    if problem.prior is not None:
        covariance = problem.prior.noise**2 * _inverse(normal(problem, own[None], shared[None]).hessian[0])
    else:
        bread = _inverse(problem.sum_groups(rows.hessian)[0])
        drift = integration_error(problem, own, shared)
        covariance = bread @ meat @ bread + drift[:, :, None] * drift[:, None, :]
    if problem.shared and groups > 1:
        covariance = _share(covariance, len(problem.own))
    error = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    value = torch.cat((own, shared.expand(groups, -1)), dim=-1)
    low, high = problem.bounds
    at_bound = ((value - low).abs() <= 1e-3 * (high - low)) | ((value - high).abs() <= 1e-3 * (high - low))
    strength = torch.tensor([p.null is not None for p in problem.parameters])
    limit = torch.where(strength, 0.25 * (high - low), 0.5 * value.abs())
    return Uncertainty(covariance, error, at_bound, error < limit)


def integration_error(problem: Problem, own: Tensor, shared: Tensor) -> Tensor:
    """Return how far the step of the simulation has moved every group's parameters, [G, N], to first order.

    A simulation with half as many substeps moves them as far again (twice as many: half as far back); one Gauss–Newton
    step on it tells how far. Parameters at a bound do not move.
    """
    substeps = problem.batch.substeps
    other, scale = (substeps // 2, 1.0) if substeps > 1 else (2, 2.0)
    batch = Batch.stack(problem.batch.episodes, dtype=problem.batch.gap.dtype, substeps=other)
    coarse = dataclasses.replace(problem, batch=batch, simulator=dataclasses.replace(problem.simulator, dt=batch.step))
    fine, rough = (normal(p, own[None], shared[None]) for p in (problem, coarse))
    value = torch.cat((own, shared.expand(len(own), -1)), dim=-1)
    low, high = problem.bounds
    inside = ((value > low) & (value < high)).to(value.dtype)
    hessian = rough.hessian[0] * inside[:, :, None] * inside[:, None, :] + torch.diag_embed(1.0 - inside)
    pull = (rough.gradient[0] - fine.gradient[0]) * inside
    moved = -scale * (_inverse(hessian) @ pull[..., None])[..., 0]
    return torch.minimum(torch.maximum(moved, low - high), high - low)


def _inverse(matrix: Tensor) -> Tensor:
    """Invert; a direction without information gets a huge variance instead of a failed inverse."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.sqrt(diagonal.clamp_min(1e-12 * diagonal.amax(-1, keepdim=True) + 1e-300))
    eigenvalue, vector = torch.linalg.eigh(matrix / (scale[..., None] * scale[..., None, :]))
    inverse = (vector / eigenvalue.clamp_min(1e-10)[..., None, :]) @ vector.mT
    return inverse / (scale[..., None] * scale[..., None, :])


def _share(covariance: Tensor, own: int) -> Tensor:
    """Combine each group's information on the shared parameters: the inverse variances add up."""
    block = covariance[:, own:, own:]
    result = covariance.clone()
    result[:, own:, own:] = _inverse(_inverse(block).sum(0))
    return result
