"""Nested least squares: every trial of a candidate's parameters φ lets every driver's own parameters θ follow.

Predictions come from the compiled loop, derivatives from its differences (one extra copy of the rows per parameter).
Each iteration solves the normal equations of all drivers at once and eliminates their θ (Schur complement), so a step
of φ already knows how θ will follow: variable projection (Golub and Pereyra 1973).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from idm_env.discovery import march as twin
from idm_env.discovery.model import Model
from idm_env.discovery.noise import Noise
from idm_env.discovery.records import Rows
from idm_env.effects import IDM
from idm_env.parameters import Parameter

NAMES = tuple(p.name for p in IDM.declared)
BOUNDS = np.log(np.array([(p.low, p.high) for p in IDM.declared]))
STEP = 1e-4
"""Relative difference by which derivatives with respect to θ are taken."""
LONGEST = 0.5
"""Largest step of log θ in one iteration."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Log-normal prior of θ: centre [5] and width [5] of log θ; ``free`` lets the centre follow the drivers.

    ``alike_s`` is its weight in free simulation, where errors of so many seconds count as one (``free.stand``).
    """

    centre: np.ndarray
    width: np.ndarray
    free: bool = True
    alike_s: float = 5.0


@dataclass(frozen=True, eq=False)
class Task:
    """Rows, how their errors are judged, and the prior: everything that is common to the null and all candidates.

    ``noise`` None means free simulation: plain gap errors in units of ``sigma`` (m). ``counts`` [R] is 1 for rows
    that are fitted.
    """

    rows: Rows
    noise: Noise | None
    prior: Prior
    counts: np.ndarray
    sigma: float = 0.3

    @property
    def groups(self) -> int:
        """Number of groups."""
        return len(self.rows.records.groups)

    def predict(
        self, theta: np.ndarray, model: Model, values: np.ndarray, pulse: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return predicted gap and speed [C, R, samples]; log θ [C, G, 5], values [C, Q] or [C, G, Q]."""
        rows, records = self.rows, self.rows.records
        copies = len(theta)
        if values.ndim == 2:
            values = np.broadcast_to(values[:, None], (copies, self.groups, values.shape[-1]))
        count = rows.steps // rows.every
        gap, speed = np.empty((2, copies, len(rows), count))
        catalogue, dt = model.catalogue, records.dt
        phi = np.ascontiguousarray(model.phi(values))
        on = np.tile(model.on, (copies, 1))
        pulse = np.zeros((copies, 3)) if pulse is None else twin.pulsed(catalogue, pulse, on, phi)
        loop = twin.loop(catalogue, dt)
        loop.march(
            records.signals, records.bounds, rows.record, rows.start, rows.steps, rows.group, records.length,
            np.exp(theta), phi, on, model.tables, twin.back_steps(model.named, dt),
            *twin.lead_steps(model.named, dt), rows.every, dt, loop.varying, pulse, gap, speed,
        )  # fmt: skip
        return gap, speed

    def errors(
        self, theta: np.ndarray, model: Model, values: np.ndarray, pulse: np.ndarray | None = None
    ) -> np.ndarray:
        """Return prediction errors [C, R, m]: in windows speed and two gaps, in free simulation the gap."""
        gap, speed = self.predict(theta, model, values, pulse)
        at = self.rows.samples
        gap = np.where(self.rows.valid, gap - self.rows.records.gap[at], 0.0)
        if self.noise is None:
            return np.nan_to_num(np.clip(gap, -100.0, 100.0), nan=100.0)
        speed = speed - self.rows.records.speed[at]
        count = gap.shape[-1]
        both = np.concatenate([speed, gap[..., [count // 2 - 1, count - 1]]], axis=-1)
        return np.nan_to_num(np.clip(both, -30.0, 30.0), nan=30.0)

    def residual(self, errors: np.ndarray) -> np.ndarray:
        """Return errors in units of their noise [C, R, m], rows that do not count included."""
        if self.noise is None:
            return errors / self.sigma
        return self.noise.whiten(errors, self.rows.joined)

    def per_group(self, x: np.ndarray) -> np.ndarray:
        """Sum [R, ...] over the rows of every group."""
        total = np.zeros((self.groups, *x.shape[1:]))
        np.add.at(total, self.rows.group, x)
        return total


@dataclass(frozen=True, eq=False)
class Linear:
    """Residual [R, m] and its derivatives by log θ [R, m, 5] and φ [R, m, Q] at one point."""

    residual: np.ndarray
    by_theta: np.ndarray
    by_phi: np.ndarray


@dataclass(frozen=True, eq=False)
class Solution:
    """log θ [G, 5], values [Q], cost, and the linearisation there."""

    model: Model
    theta: np.ndarray
    values: np.ndarray
    cost: float
    linear: Linear
    reduced_gradient: np.ndarray
    reduced_hessian: np.ndarray
    prior: Prior
    row_group: np.ndarray
    follow: np.ndarray


def differences(parameters: tuple[Parameter, ...], values: np.ndarray) -> np.ndarray:
    """Return the step of every entry of φ by which its derivative is taken, pointing into its bounds."""
    size = np.empty(len(parameters))
    for i, p in enumerate(parameters):
        if p.role == "place":
            size[i] = 1.0 if p.unit == "m" else 0.1
        elif p.role == "threshold":
            size[i] = 0.04 * p.default
        else:
            size[i] = 2e-3 * max(abs(p.default), 1e-2 * (p.high - p.low), 1e-5)
        if values[i] + size[i] > p.high:
            size[i] = -size[i]
    return size


def linearise(task: Task, model: Model, theta: np.ndarray, values: np.ndarray) -> Linear:
    """Return the residual and its derivatives by forward differences."""
    count = model.entries.size
    step = differences(model.parameters, values)
    many = np.repeat(theta[None], 6 + count, axis=0)
    shared = np.repeat(values[None], 6 + count, axis=0)
    for i in range(5):
        many[1 + i, :, i] += STEP
    for i in range(count):
        shared[6 + i, i] += step[i]
    residual = task.residual(task.errors(many, model, shared))
    change = residual[1:] - residual[0]
    change[:5] /= STEP
    change[5:] /= step[:, None, None]
    moved = np.moveaxis(change, 0, -1)
    return Linear(residual[0], moved[..., :5], moved[..., 5:])


def prior_of(model: Model) -> np.ndarray:
    """Return the inverse variance of the prior of every entry of φ: 0 but for knots of curves."""
    if not model.entries.size:
        return np.zeros(0)
    return np.concatenate([np.full(t.size, t.smoothness**-2.0 if t.smoothness else 0.0) for t in model.terms])


def equations(task: Task, model: Model, theta: np.ndarray, values: np.ndarray, linear: Linear) -> tuple[Any, ...]:
    """Return per group gradient [G, 5], matrix [G, 5, 5], cross [G, 5, Q], and of φ gradient [G, Q], matrix."""
    w = task.counts[:, None, None]
    jt, jp, r = linear.by_theta * w, linear.by_phi, linear.residual
    gradient = task.per_group(np.einsum("rmi,rm->ri", jt, r))
    matrix = task.per_group(np.einsum("rmi,rmj->rij", jt, linear.by_theta))
    cross = task.per_group(np.einsum("rmi,rmq->riq", jt, jp))
    weight = task.prior.width**-2.0
    gradient += weight * (theta - task.prior.centre)
    matrix += np.diag(weight)
    phi_gradient = task.per_group(np.einsum("rmq,rm->rq", jp * w, r))
    phi_matrix = task.per_group(np.einsum("rmq,rms->rqs", jp * w, jp))
    return gradient, matrix, cross, phi_gradient, phi_matrix


def cost_of(task: Task, theta: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the cost of every copy and group [C, G]: squared residuals and the prior."""
    square = (residual**2).sum(-1) * task.counts
    total = np.stack([task.per_group(x) for x in square])
    return total + (((theta - task.prior.centre) / task.prior.width) ** 2).sum(-1)


def solve(
    task: Task, model: Model, theta: np.ndarray, values: np.ndarray, *, iterations: int = 12, tolerance: float = 2e-4,
    on_step: Callable[[], None] | None = None,
) -> Solution:  # fmt: skip
    """Minimise over θ of every group and φ, from log θ [G, 5] and values [Q]."""
    low, high = (np.array([getattr(p, side) for p in model.parameters]) for side in ("low", "high"))
    ridge = prior_of(model)
    task = centred(task, theta)
    linear = linearise(task, model, theta, values)
    now = cost_of(task, theta[None], linear.residual[None])[0]
    total = now.sum() + (ridge * values**2).sum()
    # Every group has a damping of its own, or one that refuses its step would wait for ever while others improve.
    damping = np.full(task.groups, 1e-3)
    shared_damping = 1e-3
    seen = np.isin(np.arange(task.groups), task.rows.group)
    for _ in range(iterations):
        if on_step is not None:
            on_step()
        step_theta, step_phi, alone = _step(
            task, model, theta, values, linear, damping, shared_damping, low, high, ridge
        )  # fmt: skip
        sizes = np.array([1.0, 0.4, 0.1]) if len(values) else np.zeros(0)
        trial_values = np.clip(values + sizes[:, None] * step_phi, low, high)
        trial_theta = theta + sizes[:, None, None] * step_theta
        # The last trial leaves φ where it is, and every group decides for itself.
        trial_theta = np.clip(np.concatenate([trial_theta, (theta + alone)[None]]), BOUNDS[:, 0], BOUNDS[:, 1])
        trial_values = np.concatenate([trial_values, values[None]])
        residual = task.residual(task.errors(trial_theta, model, trial_values))
        costs = cost_of(task, trial_theta, residual)
        sums = costs.sum(1) + (ridge * trial_values**2).sum(1)
        keep = costs[-1] < now
        sums[-1] = np.where(keep, costs[-1], now).sum() + (ridge * values**2).sum()
        best = int(sums.argmin())
        gain = float(total - sums[best])
        damping = np.where(keep, 0.3 * damping, np.minimum(10.0 * damping, 1e6))
        if best == len(sums) - 1:
            theta = np.where(keep[:, None], trial_theta[-1], theta)
            shared_damping *= 10.0
        elif gain > 0:
            theta, values = trial_theta[best], trial_values[best]
            shared_damping *= 0.3 if best == 0 else 1.0
        if gain > 0:
            task = centred(task, theta)
            linear = linearise(task, model, theta, values)
            now = cost_of(task, theta[None], linear.residual[None])[0]
            total = now.sum() + (ridge * values**2).sum()
        # Candidates start where every driver of the null has arrived: they need not wait for each.
        waiting = not len(values) and (~keep & seen & (damping < 1.0)).any()
        if gain <= tolerance * total and not waiting and (not len(values) or shared_damping > 1e-2 or gain > 0):
            break
    return finish(task, model, theta, values, linear, float(total))


def _step(
    task: Task, model: Model, theta: np.ndarray, values: np.ndarray, linear: Linear, damping: np.ndarray,
    shared_damping: float, low: np.ndarray, high: np.ndarray, ridge: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    gradient, matrix, cross, phi_gradient, phi_matrix = equations(task, model, theta, values, linear)
    out = ((theta <= BOUNDS[:, 0] + 1e-9) & (gradient > 0)) | ((theta >= BOUNDS[:, 1] - 1e-9) & (gradient < 0))
    free = ~out
    matrix = matrix * free[:, :, None] * free[:, None, :]
    diagonal = np.einsum("gii->gi", matrix)
    matrix = matrix + np.einsum("gi,ij->gij", np.where(free, damping[:, None] * diagonal + 1e-9, 1.0), np.eye(5))
    gradient, cross = gradient * free, cross * free[:, :, None]
    alone = -np.linalg.solve(matrix, gradient[..., None])[..., 0]
    if not len(values):
        alone = np.clip(alone, -LONGEST, LONGEST)
        return alone, np.zeros(0), alone
    follow = np.linalg.solve(matrix, cross)
    s = phi_gradient.sum(0) + ridge * values - np.einsum("giq,gi->q", follow, gradient)
    big = (phi_matrix - np.einsum("giq,gis->gqs", cross, follow)).sum(0) + np.diag(ridge)
    active = ~(((values <= low) & (s > 0)) | ((values >= high) & (s < 0)))
    scale = np.maximum(np.diag(big), 1e-12)
    big = big * active[:, None] * active[None, :] + np.diag(np.where(active, shared_damping * scale, 1.0) + 1e-12)
    step = -np.linalg.solve(big, s * active)
    most = np.array([
        200.0 if p.role == "place" and p.unit == "m" else 20.0 if p.role == "place" else 0.5 * (h - lo)
        for p, lo, h in zip(model.parameters, low, high, strict=True)
    ])  # fmt: skip
    step = np.clip(step, -most, most)
    following = alone - np.einsum("giq,q->gi", follow, step)
    return np.clip(following, -LONGEST, LONGEST), step, np.clip(alone, -LONGEST, LONGEST)


def finish(task: Task, model: Model, theta: np.ndarray, values: np.ndarray, linear: Linear, cost: float) -> Solution:
    """Return the solution with φ's normal equations per group, θ eliminated."""
    gradient, matrix, cross, phi_gradient, phi_matrix = equations(task, model, theta, values, linear)
    follow = np.linalg.solve(matrix + 1e-9 * np.eye(5), cross)
    s = phi_gradient - np.einsum("giq,gi->gq", follow, gradient)
    big = phi_matrix - np.einsum("giq,gis->gqs", cross, follow)
    return Solution(model, theta, values, cost, linear, s, big, task.prior, task.rows.group, follow)


def centred(task: Task, theta: np.ndarray) -> Task:
    """Return the task with the prior's centre at the drivers' mean, so that a shift of all of them costs nothing."""
    seen = np.unique(task.rows.group)
    if not task.prior.free or len(seen) < 5:
        return task
    return replace(task, prior=replace(task.prior, centre=theta[seen].mean(0)))


def projected(solution: Solution) -> np.ndarray:
    """Return the response to φ [R, m, Q] after the drivers' own parameters have followed."""
    linear = solution.linear
    return linear.by_phi - np.einsum("rmi,riq->rmq", linear.by_theta, solution.follow[solution.row_group])


def with_noise(task: Task, noise: Noise) -> Task:
    """Return the task judged by another model of noise."""
    return replace(task, noise=noise)
