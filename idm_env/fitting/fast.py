"""Fits of plain IDM behind recorded leaders by fused kernels, where numba is installed and the problem fits.

The same numbers as the torch path of ``Problem``, to rounding; a parity test holds both together.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from idm_env import kernels
from idm_env.effects import IDM, Brakes, Replay
from idm_env.roads import Lane

if TYPE_CHECKING:
    from idm_env.fitting.problem import Problem

NAMES = tuple(f"idm.{p.name}" for p in IDM.declared)


def matches(problem: Problem) -> bool:
    """Tell whether kernels can do this problem: IDM and Brakes in their default form, nothing else but replay."""
    effects = problem.simulator.effects
    brakes = problem.simulator.by_name.get("brakes")
    return (
        problem.kernels
        and kernels.available()
        and isinstance(problem.simulator.road, Lane)
        and problem.simulator.integration != "midpoint"
        and {e.name for e in effects} == {"idm", "brakes", "replay"}
        and all(e == type(e)() for e in effects if not isinstance(e, Brakes))
        and all(isinstance(e, IDM | Brakes | Replay) for e in effects)
        and isinstance(brakes, Brakes)
        and brakes.sharpness is None
        and set(problem.own + problem.shared) <= set(NAMES)
    )


def _arguments(problem: Problem, values: dict[str, Tensor]) -> tuple[tuple[Tensor, ...], dict[str, object], torch.Size]:
    """Return what kernels take, with every leading dimension flattened into drivers, and those dimensions."""
    params = problem.params(values)
    shape = torch.broadcast_shapes(*(params["idm"][p.name].shape for p in IDM.declared), (len(problem.batch),))
    copies = shape[:-1].numel()
    packed = torch.stack([params["idm"][p.name].expand(shape).reshape(-1) for p in IDM.declared], dim=-1)
    batch = problem.batch
    brakes = problem.simulator.by_name["brakes"]
    assert isinstance(brakes, Brakes)
    # The kernels measure gaps between front bumpers' displacements only, so lengths are in the first gap alone.
    first_gap = batch.position[0, :, 1] - batch.length[:, 1] - batch.position[0, :, 2]
    given = (
        first_gap.repeat(copies),
        batch.all_speed[0, :, 2].repeat(copies),
        batch.position[:, :, 1].repeat(1, copies),
        batch.all_speed[:, :, 1].repeat(1, copies),
        packed,
    )
    options: dict[str, object] = {
        "max_decel": params["brakes"]["max_decel"],
        "dt": problem.simulator.dt,
        "width": brakes.width,
        "integration": problem.simulator.integration,
    }
    return given, options, shape


def simulate(problem: Problem, values: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Return gap (m) and speed (m/s) after every step, [T−1, ..., rows], differentiable in the values."""
    from idm_env.kernels import recorded

    given, options, shape = _arguments(problem, values)
    followed = recorded.rollout(*given, **options)  # type: ignore[arg-type]
    every = problem.batch.substeps
    return (
        followed.gap.reshape(-1, *shape)[every - 1 :: every],
        followed.speed.reshape(-1, *shape)[every - 1 :: every],
    )


def equations(problem: Problem, values: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return Σr² [S, rows], Jᵀr [S, rows, N] and JᵀJ [S, rows, N, N] in the order of the problem's parameters."""
    from idm_env.kernels import recorded

    given, options, shape = _arguments(problem, values)
    copies = shape[:-1].numel()
    by_gap, by_speed = (_sparse(weight, problem.batch.substeps) for weight in problem.weights)
    gap, speed = (_sparse(x[1:], problem.batch.substeps) for x in (problem.batch.gap, problem.batch.speed))
    found = recorded.normal_equations(
        *given,
        gap_target=gap.repeat(1, copies),
        speed_target=speed.repeat(1, copies),
        gap_weight=by_gap.repeat(1, copies),
        speed_weight=by_speed.repeat(1, copies),
        **options,  # type: ignore[arg-type]
    )
    order = [NAMES.index(name) for name in problem.own + problem.shared]
    return (
        found.cost.reshape(shape),
        found.gradient[:, order].reshape(*shape, -1),
        found.normal[:, order][:, :, order].reshape(*shape, len(order), len(order)),
    )


def _sparse(x: Tensor, substeps: int) -> Tensor:
    """Put samples [T, rows] on the last of every ``substeps`` steps, zeros between them."""
    fine = x.new_zeros(len(x), substeps, x.shape[1])
    fine[:, -1] = x
    return fine.flatten(0, 1)
