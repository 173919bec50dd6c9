"""What candidates do for free simulation, on stretches of time that the drivers' own parameters have not seen.

Predictions over five seconds, whitened, do not see a slow set-point that is wrong: a driver's noise looks the same
there. In free simulation it shows. θ of every driver comes from every other block of time, φ from other runs, and the
blocks between are scored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from idm_env.discovery import judge
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.records import Records, whole
from idm_env.discovery.score import interval_of, log_gain, without
from idm_env.discovery.solve import Linear, Population, Problem, Solution, finish, linearise, solve
from idm_env.discovery.units import MANY_RUNS, Units, units

GRID_S = (5.0, 15.0, 50.0, 150.0, 500.0)
"""Times (s) over which errors of free simulation may be taken to be alike: the longer, the more the prior weighs."""
BEYOND = 10.0**0.5
"""Factor by which the grid goes on where its best value is an end of it."""
ENDS_S = (0.5, 5e5)
"""Weights beyond these change nothing: a sample counts for itself, or everybody is the population's middle."""


@dataclass(frozen=True, eq=False)
class ClosedLoopFit:
    """A model in closed loop: ``problem`` over all time, θ from the part that is not ``scored``, and errors (m) there.

    ``rmse_m`` are the gap's errors on the scored time by weight (s); ``problem.prior.error_correlation_s`` is the best.
    ``absorb`` [G, P, P] is the inverse curvature of that calibration, ``weight`` [R] what a row's squares count: one
    over its own mean square plus the usual one, so that a few hopeless followers do not decide.
    """

    problem: Problem
    scored: np.ndarray
    model: Hypothesis
    values: np.ndarray
    theta: np.ndarray
    linear: Linear
    absorb: np.ndarray
    weight: np.ndarray
    units: Units
    rmse_m: dict[float, float]

    def across(self, response: np.ndarray) -> np.ndarray:
        """Return a response [R, m, Q] on the scored time, after θ has followed it on the rest."""
        rows = self.problem.rows
        part = (rows.valid & ~self.scored)[..., None]
        pull = self.problem.per_group(np.einsum("rmi,rmq->riq", self.linear.by_theta * part, response))
        follow = np.einsum("gij,gjq->giq", self.absorb, pull / self.problem.sigma**2)
        moved = response - np.einsum("rmi,riq->rmq", self.linear.by_theta, follow[rows.group])
        return moved * self.scored[..., None]

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted sums over units of values [R, ...]."""
        rows = self.problem.rows
        return self.units.sums(rows.record, values * self.weight.reshape(-1, *[1] * (values.ndim - 1)))

    @property
    def errors(self) -> np.ndarray:
        """Errors of the gap (m) on the scored time [R, m]."""
        return self.linear.residual * self.scored


def evaluate(
    records: Records, model: Hypothesis, values: np.ndarray, prior: Population, theta: np.ndarray
) -> ClosedLoopFit:
    """Calibrate a model on every other block of time in closed loop, from log θ [G, P], and evaluate it on the rest.

    The weight of the prior decides more on short or noisy records than any effect does: with too light a one drivers
    are over-fitted, and an effect that only regularises them looks like a finding. So every model has the weight with
    which it predicts best what its drivers' parameters have not seen, on the validation runs.
    """
    rows, frozen = whole(records).settled(), model.fixed(values)
    scored = judge.halves(rows)
    part = replace(rows, valid=rows.valid & ~scored)
    problem = Problem(part, None, replace(prior, centre_follows=False))
    near = solve(problem, frozen, theta, np.zeros(0), iterations=15, tolerance=1e-4).theta
    heard = replace(problem, rows=replace(rows, valid=scored))
    fits: dict[float, tuple[Problem, Solution]] = {}
    square: dict[float, float] = {}
    grid: Sequence[float] = GRID_S
    while grid:
        for seconds in grid:
            heavier = judge.scaled(
                replace(problem, prior=replace(problem.prior, error_correlation_s=seconds)), model, values, near
            )
            start = min(fits.items(), key=lambda fit: abs(np.log(fit[0] / seconds)))[1][1].theta if fits else near
            fits[seconds] = heavier, solve(heavier, frozen, start, np.zeros(0), iterations=10, tolerance=1e-4)
            errors = heard.errors(fits[seconds][1].theta[None], frozen, np.zeros((1, 0)))
            square[seconds] = float((errors**2).sum()) / max(int(scored.sum()), 1)
        grid = further(square)
    error_correlation_s = min(square, key=lambda seconds: square[seconds])
    problem, fitted = fits[error_correlation_s]
    matrix = problem.per_group(np.einsum("rmi,rmj->rij", fitted.linear.by_theta, fitted.linear.by_theta))
    matrix += np.diag(prior.width**-2.0)
    meters = linearise(replace(problem, rows=rows, sigma=1.0), frozen, fitted.theta, np.zeros(0))
    of_row = (meters.residual**2 * scored).sum(1) / np.maximum(scored.sum(1), 1)
    usual = max(float(np.median(of_row)), 1e-6)
    fit = replace(problem, rows=rows), scored, model, values, fitted.theta, meters
    inverse, weight = np.linalg.inv(matrix + 1e-9 * np.eye(matrix.shape[-1])), 1.0 / (of_row + usual)
    sizes = {seconds: float(np.sqrt(square[seconds])) for seconds in sorted(square)}
    return ClosedLoopFit(*fit, inverse, weight, units(records, MANY_RUNS), sizes)


def further(square: dict[float, float]) -> Sequence[float]:
    """Return the next weight (s) where the best of those tried is at an end and better than its neighbour, or none."""
    tried = sorted(square)
    best = min(tried, key=lambda seconds: square[seconds])
    if best == tried[-1] and best < ENDS_S[1] and square[best] < (1.0 - 1e-3) * square[tried[-2]]:
        return (best * BEYOND,)
    if best == tried[0] and best > ENDS_S[0] and square[best] < (1.0 - 1e-3) * square[tried[1]]:
        return (max(best / BEYOND, ENDS_S[0]),)
    return ()


def linear_screen(at: ClosedLoopFit, term: Term) -> tuple[np.ndarray, np.ndarray]:
    """Score a candidate by its responses at its starts, each scaled by one number from other runs.

    Return gains of units [units], and the values [q] of its parameters that all runs speak for. Finite responses rather
    than derivatives at the null: what acts beyond a threshold shows, too.
    """
    model, meters = at.model.adding(term), replace(at.problem, sigma=1.0)
    starts = np.array(term.starts)
    null = np.array([p.default if p.null is None else p.null for p in term.parameters])
    strengths = np.array([p.role == "strength" or p.null is not None for p in term.parameters])
    values = np.concatenate([np.repeat(at.values[None], len(starts), axis=0), starts], axis=1)
    errors = meters.errors(np.repeat(at.theta[None], len(starts), axis=0), model, values)
    response = at.across(np.moveaxis(errors - at.linear.residual, 0, -1))
    square = at.sums((response**2).sum(1))
    push = at.sums((response * at.errors[..., None]).sum(1))
    own = at.sums((at.errors**2).sum(1))

    def amount(square: np.ndarray, push: np.ndarray) -> np.ndarray:
        # A ridge, for what hardly anybody shows; no more than four times the start, for it is a line.
        return np.clip(-push / (1.02 * square + 1e-9), -4.0, 4.0)

    others, pushed = at.units.others(square), at.units.others(push)
    best = (pushed**2 / (others + 1e-9)).argmax(1)
    unit = np.arange(len(at.units))
    scale = amount(others, pushed)[unit, best]
    left = own + 2 * scale * push[unit, best] + scale**2 * square[unit, best]
    total, pull = square.sum(0), push.sum(0)
    which = int((pull**2 / (total + 1e-9)).argmax())
    first = np.where(strengths, null + float(amount(total, pull)[which]) * (starts[which] - null), starts[which])
    low, high = (np.array([getattr(p, side) for p in term.parameters]) for side in ("low", "high"))
    return log_gain(own, np.maximum(left, 0.05 * own)), np.clip(first, low, high)


def joint(at: ClosedLoopFit, model: Hypothesis, values: np.ndarray) -> Solution:
    """Fit all terms of a model at once in free simulation over all time, from φ ``values`` [Q]."""
    return solve(at.problem, model, at.theta, values, iterations=8, tolerance=1e-3)


def refitted(records: Records, solution: Solution) -> tuple[Solution, np.ndarray]:
    """Fit φ of a model of windows once more, in free simulation over all time; also return intervals [Q, 3]."""
    fit = evaluate(records, solution.model, solution.values, solution.prior, solution.theta)
    again = joint(fit, solution.model, solution.values)
    return again, interval_of(again, fit.problem)


def gains(before: ClosedLoopFit, solution: Solution) -> np.ndarray:
    """Return the gain of every unit [units] by a model fitted in free simulation, with φ from the other runs.

    φ moves by one Newton step where a run is left out, and the errors with it to first order.
    """
    after = evaluate(before.problem.rows.records, solution.model, solution.values, before.problem.prior, solution.theta)
    change = without(before.problem, solution)
    rows = before.problem.rows
    by_phi = linearise(replace(after.problem, sigma=1.0), solution.model, after.theta, solution.values).by_phi
    moved = after.errors + np.einsum("rmq,rq->rm", after.across(by_phi), change[rows.run])
    squares = [before.sums((e**2).sum(1)) for e in (before.errors, moved)]
    return log_gain(*squares)


def in_windows(problem: Problem, solution: Solution) -> Solution:
    """Return a model that was fitted in free simulation as one of windows: φ stands, θ follows."""
    frozen = solution.model.fixed(solution.values)
    theta = solve(problem, frozen, solution.theta, np.zeros(0)).theta
    linear = linearise(problem, solution.model, theta, solution.values)
    return finish(problem, solution.model, theta, solution.values, linear, solution.cost)
