"""Scores on held-out runs, and the test over the whole list of candidates."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from idm_env.discovery.solve import Linear, Problem, Solution, cost_of, equations, prior_of, projected, solve
from idm_env.discovery.units import rho, signs, units

ALPHA = 0.05
CLOSED_LOOP_SHARE = 0.2
"""Share of the level that goes to candidates in free simulation, the rest to the same in windows (Bonferroni)."""
LONG = 0.05
"""Share of a run's residual that a Newton step may move: of a run that says more than all others it is no solution."""
FAINT = 0.003
"""Gain in log RMSE of a run that is hardly worth the name."""
SYSTEMATIC, NOISY, MOST_NOISY = 0.01, 0.5, 0.1
"""Share of a strength that averages do not remove, the same per m/s that drivers' noise moves the speed, and at most.

In generated sets without drivers' noise it was 0.6 % in the median; with 0.1 m/s² of it, which moves the speed by 0.1
m/s, 5 of 24 strengths were off by 4 to 20 %, three to seven times what runs differ by (2026-11-23). More
noise than that of these sets, 0.2 m/s² at most, has not been held against a truth.
"""


def held_out(problem: Problem, solution: Solution, exact: bool = True) -> np.ndarray:
    """Return the held-out squared residual of every unit of the test [units], in units of noise.

    φ for a run comes from all other runs: one Newton step from the common optimum, on the normal equations without
    that run, or, if ``exact``, a solution on the others where that step is long. The run's drivers follow with their
    own θ, as they do in the null. Both models have the same θ, fitted to the same data, so nothing but φ, which has not
    seen the run, can make a difference. (Scoring blocks of time that θ has not seen either is fair too, but drivers'
    noise makes a θ from 90 s so uncertain that most of the power is lost: an effect that lowered the error of every run
    by 4 % was missed.)
    """
    rows, model, linear = problem.rows, solution.model, solution.linear
    change, far = left_out(problem, solution, exact)
    counted = units(rows.records)
    if _spans_runs(problem):
        # Drivers of several runs share θ, which then stays that of all runs: to first order.
        moved = linear.residual + np.einsum("rmq,rq->rm", projected(solution), change[rows.run])
        return counted.sums(rows.record, (moved**2).sum(-1))
    own, part = linear.own, replace(problem, prior=solution.prior)
    shifted = linear.residual + np.einsum("rmq,rq->rm", linear.by_phi, change[rows.run])
    gradient, matrix = equations(part, solution.theta, Linear(shifted, linear.jacobian[:own], own))
    step = -np.linalg.solve(matrix + 1e-9 * np.eye(own), gradient[..., None])[..., 0]
    theta = np.clip(solution.theta + np.clip(step, -0.5, 0.5), *model.catalogue.bounds.T)
    for run in far:
        mine, fixed = rows.run == run, model.fixed(solution.values + change[run])
        group = rows.group[mine]
        theta[group] = solve(part.of_rows(mine), fixed, solution.theta, np.zeros(0), iterations=6).theta[group]
    by_group = np.zeros((problem.groups, len(solution.values)))
    by_group[rows.group] = change[rows.run]
    values = np.repeat((solution.values + by_group)[None], 2, axis=0)
    both = np.stack([theta, solution.theta])
    residual = problem.residual(problem.errors(both, model, values))
    better, square = cost_of(part, both, residual).argmin(0)[rows.group], (residual**2).sum(-1)
    return counted.sums(rows.record, np.where(better == 0, *square))


def _spans_runs(problem: Problem) -> bool:
    """Tell whether any group has rows in more than one run."""
    pairs = np.unique(np.stack([problem.rows.group, problem.rows.run]), axis=1)
    return len(np.unique(pairs[0])) < pairs.shape[1]


def per_run(problem: Problem, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Return φ's gradient [runs, Q] and matrix [runs, Q, Q] of every run, the drivers' own parameters eliminated."""
    rows = problem.rows
    across = projected(solution)
    runs, count = len(rows.records.runs), len(solution.values)
    gradient, matrix = np.zeros((runs, count)), np.zeros((runs, count, count))
    np.add.at(gradient, rows.run, np.einsum("rmq,rm->rq", across, solution.linear.residual))
    np.add.at(matrix, rows.run, np.einsum("rmq,rms->rqs", across, across))
    return gradient, matrix


def without(problem: Problem, solution: Solution, part: np.ndarray | None = None) -> np.ndarray:
    """Return by how much φ changes [parts, Q] when the runs of a part are left out; ``part`` [runs] is that of each.

    Every run is a part of its own unless it is given.
    """
    part = np.arange(len(problem.rows.records.runs)) if part is None else part
    count = len(solution.values)
    change = np.zeros((int(part.max()) + 1, count))
    if not count:
        return change
    low, high = (np.array([getattr(p, side) for p in solution.model.parameters]) for side in ("low", "high"))
    ridge = prior_of(solution.model)
    s, big = per_run(problem, solution)
    for one in np.unique(part):
        mine = part == one
        rest = big[~mine].sum(0) + np.diag(ridge)
        rest = rest + np.diag(1e-6 * np.diag(rest) + 1e-12)
        # At the optimum all runs together pull nowhere, so the others pull against these.
        step = np.linalg.solve(rest, s[mine].sum(0))
        change[one] = np.clip(solution.values + step, low, high) - solution.values
    return change


def left_out(
    problem: Problem, solution: Solution, exact: bool = True, part: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``without`` [parts, Q], solved where that step is ``LONG``, and the numbers of these parts.

    Every run is a part of its own unless ``part`` [runs] says otherwise. In free simulation, and where drivers share θ
    across runs, none is solved; nor is any unless ``exact``.
    """
    rows, change = problem.rows, without(problem, solution, part)
    if not exact or problem.noise is None or _spans_runs(problem):
        return change, np.zeros(0, int)
    of_row = rows.run if part is None else part[rows.run]
    moved = np.einsum("rmq,rq->rm", projected(solution), change[of_row])
    size, whole = (np.bincount(of_row, (x**2).sum(-1), len(change)) for x in (moved, solution.linear.residual))
    far = np.flatnonzero(size > LONG**2 * whole)
    for one in far:
        fitted = solve(problem.of_rows(of_row != one), solution.model, solution.theta, solution.values, tolerance=1e-6)
        change[one] = fitted.values - solution.values
    return change, far


def log_gain(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the gains in log RMSE [units] from squares before and after; 0 where a unit has nothing to tell."""
    seen = (before > 0.0) & (after > 0.0)
    return 0.5 * np.log(np.where(seen, before, 1.0) / np.where(seen, after, 1.0))


@dataclass(frozen=True)
class Tested:
    """Of every candidate: p-value corrected for the whole list, mean gain in log RMSE, and its 95 % interval."""

    p_value: np.ndarray
    gain: np.ndarray
    interval: np.ndarray


def westfall_young(gains: np.ndarray, seed: int = 0, run: np.ndarray | None = None) -> Tested:
    """Test candidates [K, units] by sign flips, with the maximum over all candidates (Westfall, Young 1993).

    Units are runs, or followers in runs ``run`` [units], whose signs depend on each other as ``units`` says.

    The statistic is the mean of signed square roots of the gains over their root mean square, to which ``FAINT`` is
    added: an effect that shows in a few runs much more than in others is not taken for chance (as Student's t does),
    and a tiny gain that is the same in all runs does not outdo it. Under the null, a unit's gain is as likely positive
    as negative. With few runs all 2^R flips are taken, otherwise a sample; the smallest p-value of runs is 2^−R.
    """
    run = np.arange(gains.shape[1]) if run is None else run
    roots = np.sign(gains) * np.sqrt(np.abs(gains))
    flips = signs(run, rho(roots, run), seed)
    # With signs flipped [flips, K], first as it is.
    statistic = flips @ roots.T / np.sqrt(np.abs(gains).sum(1) + FAINT * gains.shape[1])
    p_value = (statistic.max(1)[:, None] >= statistic[0] - 1e-12).mean(0)
    mean, width = _mean_of(gains, run)
    return Tested(p_value, mean, np.stack([mean - width, mean + width], axis=1))


def _mean_of(gains: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means over units [K] and half their 95 % intervals, robust against dependence within runs."""
    candidates, count = gains.shape
    runs, mean = len(np.unique(run)), gains.mean(1)
    off = np.zeros((candidates, int(run.max(initial=0)) + 1))
    np.add.at(off.T, run, (gains - mean[:, None]).T)
    error = np.sqrt((off**2).sum(1) * runs / (runs - 1)) / count if runs > 1 else np.full(candidates, np.inf)
    return mean, student.ppf(0.975, max(runs - 1, 1)) * error


def rivals(gains: np.ndarray, winner: int, run: np.ndarray) -> list[int]:
    """Return which candidates [K, units] gain beyond chance, and not less than ``winner`` beyond chance, best first."""
    less, width = _mean_of(gains[winner] - gains, run)
    own, own_width = _mean_of(gains, run)
    near = [i for i in np.argsort(-own) if i != winner and own[i] > own_width[i] and less[i] <= width[i]]
    return [int(i) for i in near]


def interval_of(solution: Solution, problem: Problem) -> np.ndarray:
    """Return estimate, low and high [Q, 3] of φ, within its bounds; see ``half_width``."""
    if not len(solution.values):
        return np.zeros((0, 3))
    width = half_width(solution, problem)
    low, high = (np.array([getattr(p, side) for p in solution.model.parameters]) for side in ("low", "high"))
    return np.stack(
        [solution.values, np.maximum(solution.values - width, low), np.minimum(solution.values + width, high)], axis=1
    )


def at_level(tested: Tested, share: float) -> Tested:
    """Return a test whose p-values are those of the whole family, of whose level this part has a share."""
    return replace(tested, p_value=np.minimum(tested.p_value / share, 1.0))


def half_width(solution: Solution, problem: Problem) -> np.ndarray:
    """Return half the 95 % interval [Q] of φ: jackknife over runs, t with runs − 1 degrees of freedom.

    A run that says much of φ pulls it towards itself, which a spread of gradients at the common φ does not show. Where
    the jackknife's spread is smaller than the noise allows, the noise decides. ``SYSTEMATIC`` of the strength is added
    in squares, and ``NOISY`` of it: what smoothing, steps of 0.1 s, and the noise of drivers, which changes what they
    see, do alike in every run, so that no spread shows it.
    """
    spread, noise, times = _variances(solution, problem)
    width = np.maximum(
        times * np.sqrt(np.maximum(np.diag(spread), 0.0)), 1.96 * np.sqrt(np.maximum(np.diag(noise), 0.0))
    )
    null = np.array([p.null or 0.0 if p.role == "strength" else 0.0 for p in solution.model.parameters])
    own = np.array([p.role != "place" for p in solution.model.parameters])
    share = SYSTEMATIC + min(NOISY * (0.0 if problem.noise is None else problem.noise.wander), MOST_NOISY)
    return np.sqrt(width**2 + (1.96 * share * own * (solution.values - null)) ** 2)


def _variances(solution: Solution, problem: Problem) -> tuple[np.ndarray, np.ndarray, float]:
    """Return φ's covariance [Q, Q] by the spread of runs, and by the noise, and Student's t of the former."""
    runs = len(problem.rows.records.runs)
    big = per_run(problem, solution)[1].sum(0) + np.diag(prior_of(solution.model))
    big = big + np.diag(1e-9 * np.diag(big) + 1e-12)
    off = left_out(problem, solution)[0]
    off = off - off.mean(0)
    jackknife = off.T @ off * (runs - 1) / max(runs, 1)
    variance = float((solution.linear.residual**2).mean())
    return jackknife, np.linalg.inv(big) * variance, float(student.ppf(0.975, max(runs - 1, 1)))


@dataclass(frozen=True)
class Contrast:
    """The ends of a curve that surely differ most: numbers of the lower and the higher knot, and by how much."""

    low_knot: int
    high_knot: int
    estimate: float
    low: float
    high: float


def contrast_of(solution: Solution, problem: Problem, label: str) -> Contrast:
    """Return which two knots of the curve ``label`` differ most, by the near end of the difference's 95 % interval.

    Single knots say less: drivers' own parameters move a curve up and down as a whole, and its contrasts stay.
    """
    entries = solution.model.where(label)
    values, (spread, noise, times) = solution.values[entries], _variances(solution, problem)
    wide = np.zeros((len(values), len(values)))
    for matrix, factor in ((spread[entries, entries], times), (noise[entries, entries], 1.96)):
        own = np.diag(matrix)
        wide = np.maximum(wide, factor * np.sqrt(np.maximum(own[:, None] + own - matrix - matrix.T, 0.0)))
    off = np.subtract.outer(values, values)
    i, j = np.unravel_index((off - wide).argmax(), off.shape)
    if i == j:  # no two differ beyond chance
        i, j = np.unravel_index(off.argmax(), off.shape)
    return Contrast(int(j), int(i), float(off[i, j]), float(off[i, j] - wide[i, j]), float(off[i, j] + wide[i, j]))
