"""Errors by cross-fitting: every run is held out once, and whatever is judged there was calibrated on the others.

A quarter of the runs, kept back once, leaves a handful of followers to decide, and one of them can. Here all count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from idm_env.data import DataError
from idm_env.discovery import closed_loop, judge
from idm_env.discovery.calibrate import first_prior, population
from idm_env.discovery.closed_loop import GRID_S, further
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.noise import estimate, first_noise
from idm_env.discovery.records import Records, Rows, block_seconds, whole, windows
from idm_env.discovery.score import without
from idm_env.discovery.solve import Population, Problem, Solution, solve

FOLDS = 4
POOLED_S = closed_loop.ENDS_S[1]
"""Weight (s) of the population at which every driver is its middle."""
FURTHER_S = 10.0
"""The longer horizon of predictions, whose windows must lie in a block that drivers were not fitted to."""
EMPTY = np.zeros(0)


def folds_of(runs: Sequence[str], kept: Sequence[str], seed: int) -> np.ndarray:
    """Return the fold of every run [runs]: 0 of those kept back, whom no choice has seen, and up to three more."""
    left = [i for i, run in enumerate(runs) if run not in set(kept)]
    fold = np.zeros(len(runs), int)
    count = min(FOLDS - 1, len(left))
    fold[np.random.default_rng(seed).permutation(left)] = 1 + np.arange(len(left)) % max(count, 1)
    return fold


def values_of(problem: Problem, solution: Solution, runs: Sequence[str], fold: np.ndarray) -> np.ndarray:
    """Return φ [folds, Q] without the runs of each fold; ``problem`` is what φ was fitted to, ``runs`` are all."""
    of_run = fold[[runs.index(run) for run in problem.rows.records.runs]]
    return np.asarray(solution.values + without(problem, solution, of_run, int(fold.max()) + 1))


@dataclass(frozen=True, eq=False)
class _Fold:
    """Drivers of one fold, the others' population, and log θ [2, G, P] by weight, from each half of their time.

    ``left`` [drivers] is what every weight leaves of the gap on the half that was not fitted (m²).
    """

    prior: Population
    frozen: Hypothesis
    thetas: dict[float, np.ndarray]
    left: dict[float, np.ndarray]


def _loss(left: np.ndarray) -> float:
    """Return what a weight costs: the mean over drivers of squares times their geometric mean.

    The mean alone is that of a few hopeless followers, the geometric mean alone does not see what becomes of them.
    """
    return float(np.mean(left) * np.exp(np.log(left + 1e-9).mean()))


def crossed(
    records: Records,
    model: Hypothesis,
    values: np.ndarray,
    fold: np.ndarray,
    start: np.ndarray | None = None,
    pooled: bool = False,
) -> judge.Judged:
    """Return a model's errors on all runs, each judged by what the other folds say.

    A driver's parameters are fitted to every second block of his time and judged between, then the other way round;
    their population and φ come from other folds. Every error has the calibration that serves it: closed-loop
    simulation that of closed-loop simulation, with the weight of the population that other folds choose. Predictions
    5 s ahead have the same or, where that leaves less, that of predictions whitened by the noise of the model's errors.
    So a model's errors are its own, whatever it is compared with.

    Args:
        records: All runs.
        model: What is judged.
        values: φ [folds, Q] without the runs of each fold.
        fold: Fold of every run.
        start: log θ [G, P] of the model as it is calibrated on all of their time, if it is.
        pooled: Whether every driver is the population's middle.
    """
    rows, own = whole(records), model.catalogue.own
    problem, theta = judge.unweighed(
        records, model, values.mean(0), first_prior(own), start=start, calibrated=start is not None
    )
    second = judge.halves(rows)
    halves = [replace(rows, valid=part).settled() for part in (rows.valid & ~second, second)]
    middle = model.fixed(values.mean(0))
    # Where every driver is the population's middle, no driver needs to be fitted to half of his time.
    apart = [] if pooled else [replace(problem, rows=half) for half in halves]
    ends = [solve(half, middle, theta, EMPTY, iterations=10, tolerance=1e-4).theta for half in apart]
    near = np.stack(ends or [theta, theta])
    of_row = fold[rows.run]
    parts: dict[int, _Fold] = {}
    for k in np.unique(of_row):
        prior = population(theta, rows.some(of_row != k), own)
        mine = [half.some(of_row == k) for half in halves]
        frozen = model.fixed(values[k])
        if pooled:
            everyone = {POOLED_S: np.broadcast_to(prior.centre, near.shape)}
            parts[int(k)] = _Fold(prior, frozen, everyone, {POOLED_S: np.ones(1)})
        else:
            parts[int(k)] = _weighed(mine, prior, frozen, near)
    gap, speed, thetas = _simulated(rows, second, fold, parts)
    short, longer = windows(records), in_blocks(records)
    problem = Problem(short, None, first_prior(own))
    ahead = _predicted(problem, model, values, fold, thetas)
    if not pooled:
        whitened = replace(problem, noise=first_noise(short))
        noise = estimate(_predicted(whitened, model, values, fold, thetas), short.joined)
        others = _whitened(replace(problem, noise=noise.unweighted(len(short))), model, values, fold, theta)
        other = _predicted(problem, model, values, fold, others)
        left = [_loss(np.bincount(short.group, x[:, -1] ** 2)[np.unique(short.group)]) for x in (ahead, other)]
        ahead, thetas = (other, others) if left[1] < left[0] else (ahead, thetas)
    further = EMPTY
    if longer is not None:
        further = _predicted(replace(problem, rows=longer), model, values, fold, thetas)[:, -1]
    judged = [th[:, np.unique(rows.group[of_row == k])] for k, th in thetas.items()]
    return judge.Judged(rows, gap, speed, ahead[:, -1], short.record, further, np.concatenate(judged, axis=1))


def in_blocks(records: Records) -> Rows | None:
    """Return the windows of 10 s that end in the block that they begin in, or None where there are none."""
    try:
        rows = windows(records, FURTHER_S)
    except DataError:
        return None
    since, dt = rows.start - records.first[rows.record], records.dt
    spans = (records.bounds[1:] - records.first)[rows.record] * dt
    sizes = np.array([block_seconds(span) for span in spans])
    inside = ((since + rows.steps) * dt // sizes).astype(int) == rows.block
    return rows.some(inside) if inside.any() else None


def _weighed(mine: list[Rows], prior: Population, frozen: Hypothesis, near: np.ndarray) -> _Fold:
    """Fit the drivers of a fold to each half of their time with every weight of the population."""
    thetas: dict[float, np.ndarray] = {}
    left: dict[float, np.ndarray] = {}
    seen = np.unique(mine[0].group)
    count = np.sum([Problem(half, None, prior).per_group(half.valid.sum(1)) for half in mine], axis=0)
    grid: Sequence[float] = GRID_S[::2]
    while grid:
        for seconds in grid:
            begin = thetas[min(thetas, key=lambda s: abs(np.log(s / seconds)))] if thetas else near
            fitted, square = [], np.zeros(near.shape[1])
            for i, half in enumerate(mine):
                problem = Problem(half, None, replace(prior, centre_follows=False, error_correlation_s=seconds))
                problem = judge.scaled(problem, frozen, EMPTY, near[i])
                fitted.append(solve(problem, frozen, begin[i], EMPTY, iterations=10, tolerance=1e-4).theta)
                other_half = replace(problem, rows=mine[1 - i])
                errors = other_half.errors(fitted[i][None], frozen, EMPTY[None])[0]
                square += other_half.per_group((errors**2).sum(1))
            thetas[seconds], left[seconds] = np.stack(fitted), square[seen] / np.maximum(count[seen], 1)
        grid = further({s: _loss(x) for s, x in left.items()})
    return _Fold(prior, frozen, thetas, left)


def _simulated(
    rows: Rows, second: np.ndarray, fold: np.ndarray, parts: dict[int, _Fold]
) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Return gaps and speeds of closed-loop simulation with the weight that the other folds choose, and log θ there."""
    (gap, speed), chosen = np.zeros((2, *rows.valid.shape)), {}
    # Of two copies, the second is scored where the first was fitted.
    copy, weights = (~second).astype(int), set.intersection(*(set(p.left) for p in parts.values()))
    for k, part in parts.items():
        others = [p.left for j, p in parts.items() if j != k or len(parts) == 1]
        best = min(sorted(weights), key=lambda s: _loss(np.concatenate([left[s] for left in others])))
        chosen[k], in_fold = part.thetas[best], fold[rows.run] == k
        one = Problem(rows.some(in_fold), None, part.prior).predict(chosen[k], part.frozen, np.zeros((2, 0)))
        gap[in_fold], speed[in_fold] = (np.take_along_axis(x, copy[in_fold][None], 0)[0] for x in one)
    return gap, speed, chosen


def _whitened(
    problem: Problem, model: Hypothesis, values: np.ndarray, fold: np.ndarray, theta: np.ndarray
) -> dict[int, np.ndarray]:
    """Return log θ [2, G, P] of every fold, from whitened predictions 5 s ahead of each half of the drivers' blocks."""
    # The window before the first of a block is in the other half.
    rows = replace(problem.rows, joined=problem.rows.joined & (problem.rows.block == np.roll(problem.rows.block, 1)))
    free, second = replace(problem, rows=rows, prior=replace(problem.prior, centre_follows=False)), rows.block % 2 == 1
    all_time = solve(free, model.fixed(values.mean(0)), theta, EMPTY, iterations=15, tolerance=1e-3).theta
    thetas = {}
    for k in np.unique(fold[rows.run]):
        mine = fold[rows.run] == k
        prior = replace(population(all_time, rows.some(~mine), model.catalogue.own), centre_follows=False)
        own = replace(free, prior=prior)
        parts = [own.of_rows(mine & half) for half in (~second, second)]
        ends = [solve(part, model.fixed(values[k]), all_time, EMPTY, iterations=10) for part in parts]
        thetas[int(k)] = np.stack([end.theta for end in ends])
    return thetas


def _predicted(
    problem: Problem, model: Hypothesis, values: np.ndarray, fold: np.ndarray, thetas: dict[int, np.ndarray]
) -> np.ndarray:
    """Return errors of predictions [windows, m] with log θ [2, G, P] of every fold, from the half not scored."""
    rows, copy = problem.rows, (problem.rows.block % 2 == 0).astype(int)
    errors, order = [], []
    for k, theta in thetas.items():
        mine = np.flatnonzero(fold[rows.run] == k)
        both = replace(problem, rows=rows.some(mine)).errors(theta, model.fixed(values[k]), np.zeros((2, 0)))
        errors.append(both[copy[mine], np.arange(len(mine))])
        order.append(mine)
    return np.concatenate(errors)[np.argsort(np.concatenate(order))]
