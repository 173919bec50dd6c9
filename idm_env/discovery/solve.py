"""What discovery solves: every trial of a candidate's parameters φ lets every driver's own parameters θ follow.

Predictions come from the compiled loop, derivatives from its differences (one extra copy of the rows per parameter);
the solver is that of fits, ``idm_env.fitting.solver``, with log θ as own parameters and φ as shared ones.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from idm_env.discovery import march
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.noise import Noise
from idm_env.discovery.records import Rows
from idm_env.fitting.solver import Box, Normal, Progress, minimise
from idm_env.jobs.storage import fingerprint
from idm_env.parameters import Parameter

STEP = 1e-4
"""Relative difference by which derivatives with respect to θ are taken."""
PINNED = 1e8
"""Inverse variance of a knot that stays where it is."""
LONGEST = 0.5
"""Largest step of log θ in one iteration."""
LONG_S = 0.2
"""CPU time (s) from which on a solution is kept for a run that goes on."""


@dataclass(frozen=True, eq=False)
class Population:
    """Drivers' own θ as the prior of each: log-normal, centre [P] and width [P] of log θ, which is what moves here.

    Both may be [G, P]. Fits know another one (``fitting.prior.Prior``), of θ itself, with the noise of their residuals.
    The centre moves with the drivers where ``centre_follows``.
    ``error_correlation_s`` is its weight in closed loop: errors of so many seconds count as one (``closed_loop``).
    ``seen`` are the groups that have data: their mean is the centre, so that a shift of all of them costs nothing.
    """

    centre: np.ndarray
    width: np.ndarray
    centre_follows: bool = True
    error_correlation_s: float = 5.0
    seen: tuple[int, ...] = ()

    def equations(self, own: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the prior adds to cost [..., G], gradient [..., G, 5] and matrix [..., 5, 5]; own is log θ."""
        off, weight = own - torch.from_numpy(self.centre), torch.from_numpy(self.width**-2.0)
        return (weight * off.square()).sum(-1), weight * off, torch.diag_embed(weight)

    def following(self, own: Tensor) -> Population:
        """Return the prior centred at the mean of the drivers [1, G, 5], if there are enough of them."""
        if not self.centre_follows or len(self.seen) < 5:
            return self
        return replace(self, centre=own[0, list(self.seen)].mean(0).numpy())


@dataclass(frozen=True, eq=False)
class Problem:
    """Rows, how their errors are judged, and the prior: everything that is common to the null and all candidates.

    ``noise`` None means free simulation: plain gap errors in units of ``sigma`` (m), one for all rows or [R, 1].
    """

    rows: Rows
    noise: Noise | None
    prior: Population
    sigma: float | np.ndarray = 0.3

    @property
    def groups(self) -> int:
        """Number of groups."""
        return len(self.rows.records.groups)

    def predict(
        self, theta: np.ndarray, model: Hypothesis, values: np.ndarray, pulse: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return predicted gap and speed [C, R, samples]; log θ [C, G, P], values [C, Q] or [C, G, Q]."""
        if not model.terms and pulse is None:
            model, values = model.bare, values[..., :0]
        if values.ndim == 2:
            values = np.broadcast_to(values[:, None], (len(theta), self.groups, values.shape[-1]))
        catalogue, on = model.catalogue, model.on
        phi = np.require(model.phi(values), requirements=["C", "W"])  # a loop is compiled for each layout
        pulse = np.zeros((0, 4)) if pulse is None else march.pulsed(catalogue, pulse, on, phi)
        return march.loop(catalogue, self.rows.records.dt).roll(self.rows, np.exp(theta), phi, on, model.tables, pulse)

    def errors(
        self, theta: np.ndarray, model: Hypothesis, values: np.ndarray, pulse: np.ndarray | None = None
    ) -> np.ndarray:
        """Return prediction errors [C, R, m]: in windows speed and two gaps, in free simulation the gap."""
        gap, speed = self.predict(theta, model, values, pulse)
        samples = self.rows.samples
        gap = np.where(self.rows.valid, gap - self.rows.records.gap[samples], 0.0)
        if self.noise is None:
            return np.nan_to_num(np.clip(gap, -100.0, 100.0), nan=100.0)
        speed = speed - self.rows.records.speed[samples]
        count = gap.shape[-1]
        both = np.concatenate([speed, gap[..., [count // 2 - 1, count - 1]]], axis=-1)
        return np.nan_to_num(np.clip(both, -30.0, 30.0), nan=30.0)

    def residual(self, errors: np.ndarray) -> np.ndarray:
        """Return errors in units of their noise [C, R, m], rows that do not count included."""
        if self.noise is None:
            return errors / self.sigma
        return self.noise.whiten(errors, self.rows.joined)

    @cached_property
    def known(self) -> Population:
        """The prior, which knows what groups have data."""
        return replace(self.prior, seen=tuple(np.unique(self.rows.group)))

    @cached_property
    def of_group(self) -> list[tuple[int, slice]]:
        """Groups that have rows, and theirs in ``order``."""
        group, begin, count = np.unique(self.rows.group[self.order], return_index=True, return_counts=True)
        return [(int(g), slice(b, b + n)) for g, b, n in zip(group, begin, count, strict=True)]

    @cached_property
    def order(self) -> np.ndarray | slice:
        """Numbers of rows [R] in the order of their groups; as a rule they are so already."""
        group = self.rows.group
        return slice(None) if (np.diff(group) >= 0).all() else np.argsort(group, kind="stable")

    def per_group(self, x: np.ndarray) -> np.ndarray:
        """Sum [R, ...] over the rows of every group."""
        total = np.zeros((self.groups, *x.shape[1:]))
        total[[g for g, _ in self.of_group]] = np.add.reduceat(x[self.order], [r.start for _, r in self.of_group])
        return total

    def of_rows(self, mask: np.ndarray) -> Problem:
        """Return the problem of some rows ``mask`` [R], all those of their groups."""
        noise = self.noise and replace(self.noise, weight=self.noise.weight[mask])
        sigma = self.sigma[mask] if isinstance(self.sigma, np.ndarray) else self.sigma
        return replace(self, rows=self.rows.some(mask), noise=noise, sigma=sigma)


@dataclass(frozen=True, eq=False)
class Linear:
    """Residual [R, m] and its derivatives by log θ and φ [P + Q, R, m] at one point; P is ``own``."""

    residual: np.ndarray
    jacobian: np.ndarray
    own: int

    @property
    def by_theta(self) -> np.ndarray:
        """Derivatives by log θ [R, m, P]."""
        return np.moveaxis(self.jacobian[: self.own], 0, -1)

    @property
    def by_phi(self) -> np.ndarray:
        """Derivatives by φ [R, m, Q]."""
        return np.moveaxis(self.jacobian[self.own :], 0, -1)


@dataclass(frozen=True, eq=False)
class Solution:
    """log θ [G, P], values [Q], cost, the linearisation there, and how θ follows φ [G, P, Q] (times −1)."""

    model: Hypothesis
    theta: np.ndarray
    values: np.ndarray
    cost: float
    linear: Linear
    reduced_hessian: np.ndarray
    prior: Population
    row_group: np.ndarray
    follow: np.ndarray


def differences(parameters: tuple[Parameter, ...], values: np.ndarray) -> np.ndarray:
    """Return the steps [Q] by which derivatives by φ ``values`` [Q] are taken, in their units, into their bounds."""
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


def linearise(
    problem: Problem, model: Hypothesis, theta: np.ndarray, values: np.ndarray, base: np.ndarray | None = None
) -> Linear:
    """Return the residual at log θ [G, P] and φ [Q], ``base`` [R, m] or not, and its forward differences."""
    count, own = model.entries.size, theta.shape[-1]
    step = np.append(np.full(own, STEP), differences(model.parameters, values))
    many = np.repeat(theta[None], 1 + own + count, axis=0)
    shared = np.repeat(values[None], 1 + own + count, axis=0)
    many[1 + np.arange(own), :, np.arange(own)] += STEP
    shared[1 + own + np.arange(count), np.arange(count)] += step[own:]
    first = int(base is not None)
    residual = problem.residual(problem.errors(many[first:], model, shared[first:]))
    here, moved = (residual[0], residual[1:]) if base is None else (base, residual)
    return Linear(here, (moved - here) / step[:, None, None], own)


def prior_of(model: Hypothesis) -> np.ndarray:
    """Return the inverse variance of the prior of φ [Q]: 0 but for knots of curves."""
    if not model.entries.size:
        return np.zeros(0)
    pinned = [np.isin(np.arange(t.size), t.pinned) for t in model.terms]
    soft = [t.smoothness**-2.0 if t.smoothness else 0.0 for t in model.terms]
    return np.concatenate([np.where(fast, PINNED, x) for fast, x in zip(pinned, soft, strict=True)])


def equations(problem: Problem, theta: np.ndarray, linear: Linear) -> tuple[np.ndarray, np.ndarray]:
    """Return every group's gradient [G, P + Q] and matrix [G, P + Q, P + Q], with the prior of θ in them."""
    gradient, matrix = _sums(problem, linear)
    _, pull, stiffness = problem.prior.equations(torch.from_numpy(theta))
    gradient[:, : linear.own] += pull.numpy()
    matrix[:, : linear.own, : linear.own] += stiffness.numpy()
    return gradient, matrix


def _sums(problem: Problem, linear: Linear) -> tuple[np.ndarray, np.ndarray]:
    """Return Jᵀr [G, N] and JᵀJ [G, N, N] over the rows of every group."""
    count = len(linear.jacobian)
    gradient, matrix = np.zeros((problem.groups, count)), np.zeros((problem.groups, count, count))
    jacobian, residual = linear.jacobian[:, problem.order], linear.residual[problem.order]
    for group, rows in problem.of_group:
        j = jacobian[:, rows].reshape(count, -1)
        gradient[group], matrix[group] = j @ residual[rows].reshape(-1), j @ j.T
    return gradient, matrix


def cost_of(problem: Problem, theta: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the cost of every copy and group [C, G]: squared residuals and the prior."""
    return problem.per_group(_squares(residual).T).T + problem.prior.equations(torch.from_numpy(theta))[0].numpy()


def _squares(residual: np.ndarray) -> np.ndarray:
    """Return the sums of squares of rows: [..., R] of [..., R, m]."""
    return np.asarray(np.einsum("...m,...m->...", residual, residual))


class _Nested:
    """A problem and a model as the solver sees them: log θ of every group is its own, φ is shared."""

    def __init__(self, problem: Problem, model: Hypothesis) -> None:
        self.problem, self.model = problem, model
        self.prior = problem.known
        self.stiffness = torch.from_numpy(prior_of(model))
        of_phi = np.array([(p.low, p.high, _longest(p)) for p in model.parameters]).reshape(-1, 3)
        bounds = model.catalogue.bounds
        of_theta = np.column_stack((bounds, np.full(len(bounds), LONGEST)))
        self.boxes = Box(*torch.from_numpy(of_theta.T)), Box(*torch.from_numpy(of_phi.T))
        self.at: tuple[Tensor, Tensor, Linear] | None = None
        self.tried: list[tuple[Tensor, Tensor, np.ndarray]] = []
        self.parts: dict[bytes, Problem] = {}

    def costs(self, own: Tensor, shared: Tensor) -> Tensor:
        """Return the sums of squared residuals [C, G]; of one copy only groups that have moved are rolled out."""
        part, moved = self._moved(own, shared)
        residual = part.residual(part.errors(own.numpy(), self.model, shared.numpy()))
        if self.at is not None and not moved.all():
            part_of_it, residual = residual[0], self.at[2].residual[None].copy()
            residual[0, moved] = part_of_it
        self.tried = list(zip(own, shared, residual, strict=True))
        return torch.from_numpy(self.problem.per_group(_squares(residual).T)).T

    def _moved(self, own: Tensor, shared: Tensor) -> tuple[Problem, np.ndarray]:
        """Return the problem of groups that are not where they were linearised, and which rows [R] it has."""
        moved = np.ones(len(self.problem.rows), bool)
        if self.at is not None and len(own) == 1 and torch.equal(self.at[1], shared):
            moved = (own[0] != self.at[0][0]).any(-1).numpy()[self.problem.rows.group]
        key = moved.tobytes()
        if key not in self.parts:
            if len(self.parts) >= 8:  # each is a copy of rows, and groups that are done change slowly
                self.parts.clear()
            self.parts[key] = self.problem if moved.all() else self.problem.of_rows(moved)
        return self.parts[key], moved

    def normal(self, own: Tensor, shared: Tensor) -> Normal:
        """Return the normal equations of one copy."""
        linear = self.linear(own, shared)
        gradient, matrix = _sums(self.problem, linear)
        cost = self.problem.per_group(_squares(linear.residual))
        return Normal(*(torch.from_numpy(x[None]) for x in (cost, gradient, matrix)))

    def linear(self, own: Tensor, shared: Tensor) -> Linear:
        """Return the linearisation of one copy; of groups at which nothing has changed the last one is kept."""
        part, moved = self._moved(own, shared)
        # What was tried there has its residual already.
        group, values = part.rows.group, shared[0]
        trials = [r[moved] for x, v, r in self.tried if torch.equal(v, values) and torch.equal(x[group], own[0][group])]
        new = linearise(part, self.model, own[0].numpy(), values.numpy(), trials[0] if trials else None)
        if self.at is not None and not moved.all():
            residual, jacobian = self.at[2].residual.copy(), self.at[2].jacobian.copy()
            residual[moved], jacobian[:, moved] = new.residual, new.jacobian
            new = Linear(residual, jacobian, new.own)
        self.at = own, shared, new
        return new


def _longest(p: Parameter) -> float:
    """Return the longest step of an entry of φ in one iteration."""
    if p.role == "place":
        return 200.0 if p.unit == "m" else 20.0
    return 0.5 * (p.high - p.low)


def solve(
    problem: Problem,
    model: Hypothesis,
    theta: np.ndarray,
    values: np.ndarray,
    *,
    iterations: int = 12,
    tolerance: float = 2e-4,
) -> Solution:
    """Minimise over θ of every group and φ, from log θ [G, P] and values [Q].

    What takes long is kept with the records, if they keep anything, by all that it depends on.
    """
    store, key = problem.rows.records.kept, ""
    if store is not None:
        key = _mark(problem, model, theta, values, iterations, tolerance)
        if (stored := store.get(key)) is not None:
            own, shared = stored["own"].numpy(), stored["shared"].numpy()
            return finish(problem, model, own, shared, linearise(problem, model, own, shared), stored["cost"])
    clock, nested = time.process_time(), _Nested(problem, model)
    begin = Progress.begin(torch.tensor(theta[None]), torch.tensor(values[None]), damping=1e-3)
    optimum, now = minimise(nested, begin, iterations, tolerance=tolerance)
    linear = nested.linear(optimum.own, optimum.shared)
    own, shared = optimum.own[0].numpy(), optimum.shared[0].numpy()
    cost = float(now.cost.sum()) + float((prior_of(model) * shared**2).sum())
    if store is not None and time.process_time() - clock > LONG_S:
        store.put(key, {"own": optimum.own[0], "shared": optimum.shared[0], "cost": cost})
    return finish(problem, model, own, shared, linear, cost)


def _mark(problem: Problem, model: Hypothesis, *begin: object) -> str:
    """Return a digest of a problem, a model and where and how it is solved."""
    rows, noise, prior = problem.rows, problem.noise, problem.known
    parts = [getattr(x, f.name) for x in (rows, prior, noise) if x for f in fields(x) if f.name != "records"]
    fixed = np.zeros(0) if model.fixed_phi is None else model.fixed_phi
    return fingerprint(rows.records.mark, *parts, problem.sigma, model.terms, model.catalogue, fixed, *begin)


def finish(
    problem: Problem, model: Hypothesis, theta: np.ndarray, values: np.ndarray, linear: Linear, cost: float
) -> Solution:
    """Return the solution at log θ [G, P] and φ [Q]: φ's matrix per group without θ, and the prior centred there."""
    prior = problem.known.following(torch.from_numpy(theta[None]))
    _, matrix = equations(replace(problem, prior=prior), theta, linear)
    own = linear.own
    cross = matrix[:, :own, own:]
    follow = np.linalg.solve(matrix[:, :own, :own] + 1e-9 * np.eye(own), cross)
    big = matrix[:, own:, own:] - np.einsum("giq,gis->gqs", cross, follow)
    return Solution(model, theta, values, cost, linear, big, prior, problem.rows.group, follow)


def projected(solution: Solution) -> np.ndarray:
    """Return the response to φ [R, m, Q] after the drivers' own parameters have followed."""
    linear = solution.linear
    return linear.by_phi - np.einsum("rmi,riq->rmq", linear.by_theta, solution.follow[solution.row_group])
