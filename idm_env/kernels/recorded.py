"""Fits behind recorded leaders: rollout, gradient, sensitivities and normal equations, each in one fused pass.

The step is that of ``Simulator(Lane(), (IDM(), Brakes(), Replay()), dt)`` with two vehicles per batch row, the leader
replayed and the driver free. Time comes first, then drivers::

    gap[t+1] = gap[t] + (lead_position[t+1] − lead_position[t]) − displacement(gap[t], speed[t], lead_speed[t])

All tensors are CPU tensors of one precision, float32 or float64. Needs numba: ``pip install 'idm-env[kernels]'``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from idm_env.kernels import recorded_loops as loops
from idm_env.kernels import threads as pool
from idm_env.kernels.equations import Array, constants
from idm_env.kernels.workspace import take

PARAMETERS = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")
"""Order of the five parameters in every last dimension of size 5 here."""


class Followed(NamedTuple):
    """State of every driver after each step, each ``(time, drivers)``: gap (m), speed (m/s), acceleration (m/s²)."""

    gap: Tensor
    speed: Tensor
    accel: Tensor


class Sensitivities(NamedTuple):
    """Derivatives of gap (m) and speed (m/s) by the five parameters, each ``(time, drivers, 5)``.

    A driver's position falls by what his gap rises, so the derivative of a position is ``−gap``.
    """

    gap: Tensor
    speed: Tensor


class NormalEquations(NamedTuple):
    """``Σ r²`` ``(drivers,)``, ``Jᵀ r`` ``(drivers, 5)`` and ``Jᵀ J`` ``(drivers, 5, 5)`` of weighted residuals r."""

    cost: Tensor
    gradient: Tensor
    normal: Tensor


class _Problem(NamedTuple):
    gap: Array
    speed: Array
    lead_position: Array
    lead_speed: Array
    params: Array
    constants: Array
    is_euler: bool
    threads: int

    @property
    def shape(self) -> tuple[int, int]:
        """Steps and drivers."""
        return self.lead_position.shape[0] - 1, self.lead_position.shape[1]

    def run(self, loop: Any, *arrays: Array) -> None:
        """Call a compiled loop over all drivers, on one thread or several."""
        pool.split(
            lambda begin, end: loop(*arrays, begin, end, self.is_euler, self.constants),
            self.shape[1], loops.TILE, self.threads,
        )  # fmt: skip


def _array(name: str, value: Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> Array:
    if value.dtype != dtype or value.device.type != "cpu":
        raise ValueError(f"{name} is {value.dtype} on {value.device}; gap is {dtype} on the CPU. Give both the same.")
    if tuple(value.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(value.shape)}, and {shape} is needed: (time, drivers).")
    return value.detach().contiguous().numpy()


def _problem(
    gap: Tensor,
    speed: Tensor,
    lead_position: Tensor,
    lead_speed: Tensor,
    params: Tensor,
    max_decel: Tensor | float,
    dt: float,
    width: float,
    integration: str,
    threads: int | None,
) -> _Problem:
    if gap.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"gap is {gap.dtype}; kernels take float32 or float64. Convert it.")
    if integration not in ("ballistic", "euler"):
        raise ValueError(f"integration = '{integration}' is unknown. Known: ballistic, euler.")
    if gap.dim() != 1 or lead_position.dim() != 2 or lead_position.shape[0] < 2:
        raise ValueError(
            f"gap {tuple(gap.shape)} and lead_position {tuple(lead_position.shape)} must be (drivers,) and "
            "(steps + 1, drivers), with at least one step."
        )
    drivers, kind = len(gap), gap.dtype
    times = (lead_position.shape[0], drivers)
    floor = torch.as_tensor(max_decel, dtype=kind).detach().expand(drivers)
    packed = np.empty((6, drivers), dtype=_array("gap", gap, kind, (drivers,)).dtype)
    packed[:5] = _array("params", params, kind, (drivers, 5)).T
    packed[5] = floor.numpy()
    return _Problem(
        _array("gap", gap, kind, (drivers,)),
        _array("speed", speed, kind, (drivers,)),
        _array("lead_position", lead_position, kind, times),
        _array("lead_speed", lead_speed, kind, times),
        packed,
        constants(dt, width, packed.dtype),
        integration == "euler",
        pool.count((times[0] - 1) * drivers, threads),
    )


def _forward(problem: _Problem) -> tuple[Array, Array, Array]:
    gap, speed, accel = (take(problem.shape, problem.gap.dtype) for _ in range(3))
    p = problem
    p.run(loops.forward, p.gap, p.speed, p.lead_position, p.lead_speed, p.params, gap, speed, accel)
    return gap, speed, accel


class _Rollout(torch.autograd.Function):
    """Saves nothing but what it returns: gap and speed of every step are its tape."""

    @staticmethod
    def forward(
        ctx: Any, gap: Tensor, speed: Tensor, params: Tensor, max_decel: Tensor | float, problem: _Problem
    ) -> tuple[Tensor, Tensor, Tensor]:
        out = tuple(torch.from_numpy(x) for x in _forward(problem))
        ctx.problem = problem
        ctx.save_for_backward(out[0], out[1])
        return out[0], out[1], out[2]

    @staticmethod
    @once_differentiable  # second derivatives need the torch path: an error says so, not a silent zero
    def backward(ctx: Any, *seeds: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        p: _Problem = ctx.problem
        gap, speed = (x.numpy() for x in ctx.saved_tensors)
        seed = [x.contiguous().numpy() for x in seeds]
        on_gap, on_speed, on_params = np.empty_like(p.gap), np.empty_like(p.gap), np.empty_like(p.params)
        p.run(loops.adjoint, p.gap, p.speed, p.lead_speed, p.params, gap, speed, *seed, on_gap, on_speed, on_params)
        on = torch.from_numpy(on_params)
        return torch.from_numpy(on_gap), torch.from_numpy(on_speed), on[:5].T, on[5], None


def rollout(
    gap: Tensor,
    speed: Tensor,
    lead_position: Tensor,
    lead_speed: Tensor,
    params: Tensor,
    *,
    max_decel: Tensor | float = 9.0,
    dt: float = 0.1,
    width: float = 0.1,
    integration: str = "ballistic",
    threads: int | None = None,
) -> Followed:
    """Roll drivers out behind recorded leaders; differentiable in ``gap``, ``speed``, ``params`` and ``max_decel``.

    ``gap`` (m) and ``speed`` (m/s) at the start, ``(drivers,)``; ``lead_position`` (m, front bumper) and ``lead_speed``
    (m/s), ``(steps + 1, drivers)``, row 0 at the start; ``params`` ``(drivers, 5)`` in the order of ``PARAMETERS``;
    ``max_decel`` b_max (m/s²), a number or ``(drivers,)``; ``width`` (m/s²) is that of ``Brakes``. No gradient flows
    into the record. ``threads`` None decides by the size of the work. ValueError for shapes and precisions that do not
    fit together.
    """
    problem = _problem(gap, speed, lead_position, lead_speed, params, max_decel, dt, width, integration, threads)
    floor = torch.as_tensor(max_decel, dtype=gap.dtype).expand(len(gap))
    return Followed(*_Rollout.apply(gap, speed, params, floor, problem))


def sensitivities(
    gap: Tensor,
    speed: Tensor,
    lead_position: Tensor,
    lead_speed: Tensor,
    params: Tensor,
    *,
    max_decel: Tensor | float = 9.0,
    dt: float = 0.1,
    width: float = 0.1,
    integration: str = "ballistic",
    threads: int | None = None,
) -> tuple[Followed, Sensitivities]:
    """Return the rollout and its Jacobian by the five parameters, in one forward pass; arguments as in ``rollout``.

    The Jacobians are views of memory laid out ``(time, 5, drivers)``; nothing here records a graph.
    """
    problem = _problem(gap, speed, lead_position, lead_speed, params, max_decel, dt, width, integration, threads)
    steps, drivers = problem.shape
    out = [take((steps, drivers), problem.gap.dtype) for _ in range(3)]
    by = [take((steps, 5, drivers), problem.gap.dtype) for _ in range(2)]
    p = problem
    p.run(loops.sensitivities, p.gap, p.speed, p.lead_position, p.lead_speed, p.params, *out, *by)
    jacobians = [torch.from_numpy(x).transpose(1, 2) for x in by]
    return Followed(*(torch.from_numpy(x) for x in out)), Sensitivities(*jacobians)


def normal_equations(
    gap: Tensor,
    speed: Tensor,
    lead_position: Tensor,
    lead_speed: Tensor,
    params: Tensor,
    *,
    gap_target: Tensor,
    speed_target: Tensor,
    gap_weight: Tensor,
    speed_weight: Tensor,
    max_decel: Tensor | float = 9.0,
    dt: float = 0.1,
    width: float = 0.1,
    integration: str = "ballistic",
    threads: int | None = None,
) -> NormalEquations:
    """Return cost, Jᵀr and JᵀJ of ``r = (w_s (gap − target), w_v (speed − target))`` without storing a Jacobian.

    Targets and weights are ``(steps, drivers)``: what was measured after each step, and 0 where nothing was. One pass
    costs about twice a plain rollout and its gradient, so a Gauss–Newton or Levenberg–Marquardt step is cheap for every
    driver at once. Other arguments as in ``rollout``.
    """
    problem = _problem(gap, speed, lead_position, lead_speed, params, max_decel, dt, width, integration, threads)
    kind, shape = gap.dtype, problem.shape
    given = {
        "gap_target": gap_target,
        "speed_target": speed_target,
        "gap_weight": gap_weight,
        "speed_weight": speed_weight,
    }
    data = [_array(name, value, kind, shape) for name, value in given.items()]
    drivers = shape[1]
    out = [np.empty((*size, drivers), problem.gap.dtype) for size in ((), (5,), (5, 5))]
    p = problem
    p.run(loops.normal_equations, p.gap, p.speed, p.lead_position, p.lead_speed, p.params, *data, *out)
    cost, gradient, normal = (torch.from_numpy(x) for x in out)
    return NormalEquations(cost, gradient.T, normal.permute(2, 0, 1))
