"""Scores on held-out runs, and the test over the whole list of candidates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from idm_env.discovery.solve import BOUNDS, Solution, Task, cost_of, equations, prior_of, projected

FLIPS = 4096
FAINT = 0.003
"""Gain in log RMSE of a run that is hardly worth the name."""
SYSTEMATIC = 0.01
"""Error of a strength that averages do not remove: 0.6 % in the median of generated sets without drivers' noise."""


def held_out(task: Task, solution: Solution) -> np.ndarray:
    """Return the held-out squared residual of every run [runs], in units of noise.

    φ for a run comes from all other runs (one Newton step from the common optimum, on the normal equations without
    that run), and the run's drivers follow with their own θ, as they do in the null. Both models have the same θ,
    fitted to the same data, so nothing but φ, which has not seen the run, can make a difference. (Scoring blocks of
    time that θ has not seen either is fair too, but drivers' noise makes a θ from 90 s so uncertain that most of the
    power is lost: an effect that lowered the error of every run by 4 % was missed.)
    """
    rows = task.rows
    model = solution.model
    linear = solution.linear
    change = _without_own_run(task, solution)
    shifted = linear.residual + np.einsum("rmq,rq->rm", linear.by_phi, change[rows.run])
    total = np.zeros(len(rows.records.runs))
    if _spans_runs(task):
        # Drivers of several runs share θ, which then stays that of all runs: to first order.
        moved = linear.residual + np.einsum("rmq,rq->rm", projected(solution), change[rows.run])
        np.add.at(total, rows.run, (moved**2).sum(-1) * task.counts)
        return total
    part = Task(rows, task.noise, solution.prior, task.counts, task.sigma)
    moved_linear = type(linear)(shifted, linear.by_theta, linear.by_phi)
    gradient, matrix, *_ = equations(part, model, solution.theta, solution.values, moved_linear)
    step = -np.linalg.solve(matrix + 1e-9 * np.eye(5), gradient[..., None])[..., 0]
    theta = np.clip(solution.theta + np.clip(step, -0.5, 0.5), BOUNDS[:, 0], BOUNDS[:, 1])
    by_group = np.zeros((task.groups, len(solution.values)))
    by_group[rows.group] = change[rows.run]
    values = np.repeat((solution.values + by_group)[None], 2, axis=0)
    both = np.stack([theta, solution.theta])
    residual = task.residual(task.errors(both, model, values))
    better = cost_of(part, both, residual).argmin(0)[rows.group]
    square = (residual**2).sum(-1) * task.counts
    np.add.at(total, rows.run, np.where(better == 0, square[0], square[1]))
    return total


def _spans_runs(task: Task) -> bool:
    """Tell whether any group has rows in more than one run."""
    pairs = np.unique(np.stack([task.rows.group, task.rows.run]), axis=1)
    return len(np.unique(pairs[0])) < pairs.shape[1]


def per_run(task: Task, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Return φ's gradient [runs, Q] and matrix [runs, Q, Q] of every run, the drivers' own parameters eliminated."""
    rows = task.rows
    across = projected(solution) * task.counts[:, None, None]
    runs, count = len(rows.records.runs), len(solution.values)
    gradient, matrix = np.zeros((runs, count)), np.zeros((runs, count, count))
    np.add.at(gradient, rows.run, np.einsum("rmq,rm->rq", across, solution.linear.residual))
    np.add.at(matrix, rows.run, np.einsum("rmq,rms->rqs", across, across))
    return gradient, matrix


def _without_own_run(task: Task, solution: Solution) -> np.ndarray:
    """Return by how much φ changes for every run [runs, Q] when that run is left out."""
    runs, count = len(task.rows.records.runs), len(solution.values)
    change = np.zeros((runs, count))
    if not count:
        return change
    low, high = (np.array([getattr(p, side) for p in solution.model.parameters]) for side in ("low", "high"))
    ridge = prior_of(solution.model)
    s, big = per_run(task, solution)
    for run in range(runs):
        rest = big.sum(0) - big[run] + np.diag(ridge)
        rest = rest + np.diag(1e-6 * np.diag(rest) + 1e-12)
        # At the optimum all runs together pull nowhere, so the others pull against this one.
        step = np.linalg.solve(rest, s[run])
        change[run] = np.clip(solution.values + step, low, high) - solution.values
    return change


@dataclass(frozen=True)
class Tested:
    """Of every candidate: p-value corrected for the whole list, mean gain in log RMSE, and its 95 % interval."""

    p_value: np.ndarray
    gain: np.ndarray
    interval: np.ndarray


def westfall_young(gains: np.ndarray, seed: int = 0) -> Tested:
    """Test candidates [K, runs] by sign flips of runs, with the maximum over all candidates (Westfall, Young 1993).

    The statistic is the mean of signed square roots of the gains over their root mean square, to which ``FAINT`` is
    added: an effect that shows in a few runs much more than in others is not taken for chance (as Student's t does),
    and a tiny gain that is the same in all runs does not outdo it. Under the null, a run's gain is as likely positive
    as negative. With few runs all 2^R flips are taken, otherwise a sample; the smallest p-value is 2^−R.
    """
    candidates, runs = gains.shape
    if runs <= 12:
        flips = 1.0 - 2.0 * ((np.arange(2**runs)[:, None] >> np.arange(runs)) & 1)
    else:
        random = np.random.default_rng(seed)
        flips = np.concatenate([np.ones((1, runs)), random.choice([-1.0, 1.0], (FLIPS - 1, runs))])
    roots = np.sign(gains) * np.sqrt(np.abs(gains))
    statistic = flips @ roots.T / np.sqrt(np.abs(gains).sum(1) + FAINT * runs)
    highest = statistic.max(1)
    p_value = (highest[:, None] >= statistic[0] - 1e-12).mean(0)
    mean = gains.mean(1)
    error = gains.std(1, ddof=1) / np.sqrt(runs) if runs > 1 else np.full(candidates, np.inf)
    width = student.ppf(0.975, max(runs - 1, 1)) * error
    return Tested(p_value, mean, np.stack([mean - width, mean + width], axis=1))


def interval_of(solution: Solution, task: Task) -> np.ndarray:
    """Return estimate, low and high [Q, 3] of φ: cluster-robust over runs, t with runs − 1 degrees of freedom.

    Where the runs' spread is smaller than the noise allows, the noise decides. ``SYSTEMATIC`` of the strength is added
    in squares: what smoothing and steps of 0.1 s do, alike in every run, so that no spread shows it.
    """
    count = len(solution.values)
    if not count:
        return np.zeros((0, 3))
    runs = len(task.rows.records.runs)
    gradient, matrix = per_run(task, solution)
    big = matrix.sum(0) + np.diag(prior_of(solution.model))
    big = big + np.diag(1e-9 * np.diag(big) + 1e-12)
    inverse = np.linalg.inv(big)
    spread = gradient - gradient.mean(0)
    sandwich = inverse @ (spread.T @ spread * runs / max(runs - 1, 1)) @ inverse
    variance = float((solution.linear.residual**2).mean())
    plain = inverse * variance
    width = np.maximum(
        student.ppf(0.975, max(runs - 1, 1)) * np.sqrt(np.maximum(np.diag(sandwich), 0.0)),
        1.96 * np.sqrt(np.maximum(np.diag(plain), 0.0)),
    )
    null = np.array([p.null or 0.0 if p.role == "strength" else 0.0 for p in solution.model.parameters])
    own = np.array([p.role != "place" for p in solution.model.parameters])
    width = np.sqrt(width**2 + (1.96 * SYSTEMATIC * own * (solution.values - null)) ** 2)
    low, high = (np.array([getattr(p, side) for p in solution.model.parameters]) for side in ("low", "high"))
    return np.stack(
        [solution.values, np.maximum(solution.values - width, low), np.minimum(solution.values + width, high)], axis=1
    )
