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
from idm_env.discovery.score import left_out
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
    change = left_out(problem, solution, part=of_run)[0]
    return np.asarray(solution.values + np.pad(change, ((0, int(fold.max()) + 1 - len(change)), (0, 0))))


@dataclass(frozen=True, eq=False)
class Halves:
    """Records twice, once for each half of the drivers' time: so both halves in all folds are solved at once.

    A driver is a group of its own in each: ``fold``, ``half`` and ``group`` [D] say which. ``model`` has the folds' φ.
    """

    records: Records
    model: Hypothesis
    fold: np.ndarray
    half: np.ndarray
    group: np.ndarray

    @classmethod
    def split(cls, records: Records, model: Hypothesis, values: np.ndarray, fold: np.ndarray) -> "Halves":
        """Return the halves of records whose runs have a ``fold`` [runs], and the model with its ``values``."""
        size, half = len(records.signals), np.repeat([0, 1], len(records))
        each = np.stack([np.tile(fold[records.run], 2), half, np.tile(records.group, 2)])
        keys, group = np.unique(each, axis=1, return_inverse=True)
        doubled = replace(
            records, episodes=2 * records.episodes, signals=np.tile(records.signals, (2, 1)), group=group.ravel(),
            bounds=np.append(records.bounds, records.bounds[1:] + size), length=np.tile(records.length, 2),
            first=np.append(records.first, records.first + size), run=np.tile(records.run, 2),
            groups=tuple(map(str, keys.T.tolist())),
        )  # fmt: skip
        return cls(doubled, model.fixed(values[keys[0]]), *keys)

    def rows(self, rows: Rows, half: np.ndarray) -> Rows:
        """Return rows of the records as rows of a ``half`` [R] of them."""
        record, start = rows.record + half * (len(self.records) // 2), half * (len(self.records.signals) // 2)
        return replace(rows, records=self.records, record=record, start=rows.start + start)

    def by_fold(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return values [D, ...] of the groups as [2, drivers, ...] of every fold."""
        return {int(k): x[self.fold == k].reshape(2, -1, *x.shape[1:]) for k in np.unique(self.fold)}

    def prior(self, theta: np.ndarray, rows: Rows, fold: np.ndarray) -> Population:
        """Return the population of all other folds for every group, from log θ [G, P] on rows of the records."""
        of_row, own = fold[rows.run], self.model.catalogue.own
        others = {int(k): population(theta, rows.some(of_row != k), own) for k in np.unique(of_row)}
        centre, width = (np.stack([getattr(others[int(k)], x) for k in self.fold]) for x in ("centre", "width"))
        return Population(centre, width, centre_follows=False)


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
    second, halves = judge.halves(rows), Halves.split(records, model, values, fold)
    twice = halves.rows(rows.some(np.tile(np.arange(len(rows)), 2)), np.repeat([0, 1], len(rows)))
    settled = replace(twice, valid=np.concatenate([rows.valid & ~second, second])).settled()
    prior = halves.prior(theta, rows, fold)
    best = prior.centre
    if not pooled:
        apart, middle = replace(problem, rows=settled), model.fixed(values.mean(0))
        near = solve(apart, middle, theta[halves.group], EMPTY, iterations=10, tolerance=1e-4).theta
        best = _weighed(halves, replace(apart, prior=prior), near)
    both = Problem(twice, None, prior).predict(best[None], halves.model, EMPTY[None])
    # A sample is scored with the drivers of the half that it is not in.
    gap, speed = (np.where(second, *x[0].reshape(2, *second.shape)) for x in both)
    short, longer = windows(records), in_blocks(records)
    problem = Problem(short, None, first_prior(own))
    ahead = predicted(problem, halves, best)
    if not pooled:
        noise = estimate(predicted(replace(problem, noise=first_noise(short)), halves, best), short.joined)
        by_noise = replace(problem, noise=noise.unweighted(len(short)))
        others = whitened(by_noise, halves, middle, fold, theta)
        other = predicted(problem, halves, others)
        losses = [_loss(np.bincount(short.group, x[:, -1] ** 2)[np.unique(short.group)]) for x in (ahead, other)]
        ahead, best = (other, others) if losses[1] < losses[0] else (ahead, best)
    further = EMPTY if longer is None else predicted(replace(problem, rows=longer), halves, best)[:, -1]
    judged = np.concatenate(list(halves.by_fold(best).values()), axis=1)
    return judge.Judged(rows, gap, speed, ahead[:, -1], short.record, further, judged)


def in_blocks(records: Records) -> Rows | None:
    """Return the windows of 10 s that end in the block that they begin in, or None where there are none."""
    try:
        rows = windows(records, FURTHER_S)
    except DataError:
        return None
    since, dt = rows.start - records.first[rows.record], records.dt
    sizes = block_seconds((records.bounds[1:] - records.first) * dt)[rows.record]
    inside = ((since + rows.steps) * dt // sizes).astype(int) == rows.block
    return rows.some(inside) if inside.any() else None


def _weighed(halves: Halves, problem: Problem, near: np.ndarray) -> np.ndarray:
    """Return log θ [D, P] of all drivers fitted to each half of their time, from ``near`` [D, P].

    Every weight of the population is tried; the other folds choose one, by the gap on the half that was not fitted.
    """
    thetas: dict[float, np.ndarray] = {}
    count, side = halves.by_fold(problem.per_group(problem.rows.valid.sum(1))), 2 * halves.fold + halves.half
    squares = (problem.errors(near[None], halves.model, EMPTY[None])[0] ** 2).sum(1)
    squares /= np.maximum(problem.rows.valid.sum(1), 1)
    # Errors of so many seconds count as one, as in ``judge.scaled``: by fold and half.
    middles = {s: max(np.median(squares[side[problem.rows.group] == s]), 1e-4) for s in np.unique(side)}
    usual = np.array([middles[s] for s in side[problem.rows.group]])
    left: dict[int, dict[float, np.ndarray]] = {k: {} for k in count}
    grids: dict[int, Sequence[float]] = dict.fromkeys(left, GRID_S[::2])
    while any(grids.values()):
        for seconds in sorted({s for grid in grids.values() for s in grid}):
            asks = [k for k, grid in grids.items() if seconds in grid]
            begin, fitted = near.copy(), np.isin(halves.fold, asks)
            for k in asks:
                if left[k]:
                    mine = halves.fold == k
                    begin[mine] = thetas[min(left[k], key=lambda s: abs(np.log(s / seconds)))][mine]
            size = np.sqrt(usual * seconds / (problem.rows.every * problem.rows.records.dt))
            part = replace(problem, sigma=size[:, None]).of_rows(fitted[problem.rows.group])
            thetas[seconds] = solve(part, halves.model, begin, EMPTY, iterations=10, tolerance=1e-4).theta
            other_half = replace(part.rows, valid=np.roll(part.rows.valid, len(part.rows) // 2, axis=0))
            errors = replace(part, rows=other_half).errors(thetas[seconds][None], halves.model, EMPTY[None])[0]
            total = halves.by_fold(part.per_group((errors**2).sum(1)))
            for k in asks:
                left[k][seconds] = total[k].sum(0) / np.maximum(count[k].sum(0), 1)
        grids = {k: further({s: _loss(x) for s, x in left[k].items()}) for k in left}
    weights, best = sorted(set.intersection(*map(set, left.values()))), np.empty_like(thetas[min(thetas)])
    for k in left:
        others = [x for j, x in left.items() if j != k or len(left) == 1]
        seconds = min(weights, key=lambda s: _loss(np.concatenate([x[s] for x in others])))
        best[halves.fold == k] = thetas[seconds][halves.fold == k]
    return best


def whitened(problem: Problem, halves: Halves, middle: Hypothesis, fold: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return log θ [D, P] from whitened predictions 5 s ahead of each half of the drivers' blocks, from [G, P]."""
    # The window before the first of a block is in the other half.
    rows = replace(problem.rows, joined=problem.rows.joined & (problem.rows.block == np.roll(problem.rows.block, 1)))
    free = replace(problem, rows=rows, prior=replace(problem.prior, centre_follows=False))
    theta = solve(free, middle, theta, EMPTY, iterations=15, tolerance=1e-3).theta
    apart = replace(free, rows=halves.rows(rows, rows.block % 2), prior=halves.prior(theta, rows, fold))
    return solve(apart, halves.model, theta[halves.group], EMPTY, iterations=10).theta


def predicted(problem: Problem, halves: Halves, theta: np.ndarray) -> np.ndarray:
    """Return errors of predictions [windows, m] with log θ [D, P] of the half that is not scored."""
    rows = halves.rows(problem.rows, 1 - problem.rows.block % 2)
    return np.asarray(replace(problem, rows=rows).errors(theta[None], halves.model, EMPTY[None])[0])
