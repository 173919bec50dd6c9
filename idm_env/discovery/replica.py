"""The same drivers once more: records as a calibrated model and its drivers' own noise would have made them.

Noise of drivers is an Ornstein–Uhlenbeck acceleration, ``da = −a dt/τ + σ √(2/τ) dW``, matched to how errors of the
speed grow in windows of 5 s. Every follower drives behind his measured leader. What a smooth function of the scene
tells of errors in them is what noise alone does: the scene has felt it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from idm_env.discovery import ladder
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import Records, Rows, whole, windows
from idm_env.discovery.solve import Prior, Problem, Solution, solve

LAGS_S = (0.5, 1.5)
"""Lags at which increments of the speed's error are compared: at these, white noise of sensors is gone."""
MEMORIES_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Memories of drivers' noise that are tried."""
DRAWS, ENOUGH = 39, 3
"""Replicas at most, and how many that look as structured as the data end the drawing (Besag and Clifford 1991)."""
FEATURES = 40
EMPTY = np.zeros((1, 0))


@dataclass(frozen=True, eq=False)
class NoisyDrivers:
    """A calibrated model: φ stands in ``model``, log θ [G, P]; noise of σ [G] (m/s²) with a memory of τ (s)."""

    model: Hypothesis
    theta: np.ndarray
    sigma: np.ndarray
    memory_s: float

    def drive(self, records: Records, random: np.random.Generator) -> Records:
        """Return the records that these drivers would have made behind the same leaders."""
        driven = replace(records, signals=records.signals.copy())
        pushed, accel = driven.column("pushed"), driven.column("accel")
        keep = np.exp(-records.dt / self.memory_s)
        for r, (first, end) in enumerate(zip(records.bounds[:-1], records.bounds[1:], strict=True)):
            fresh = random.standard_normal(end - first)
            fresh[1:] *= np.sqrt(1.0 - keep**2)
            noise = lfilter([1.0], [1.0, -keep], fresh)
            pushed[first:end] = self.sigma[records.group[r]] * noise
        rows = whole(driven, longest_s=np.inf, every_s=0.0)
        pulse = np.array([[1.0, 0.0, rows.steps, 1.0]])
        problem = Problem(rows, None, _no_prior(self.theta))
        gap, speed = (x[0][rows.valid] for x in problem.predict(self.theta[None], self.model, EMPTY, pulse))
        samples = rows.samples[rows.valid]
        moved = driven.column("lead_rear")[samples] - gap - driven.column("position")[samples]
        for name in ("position", "place"):
            driven.column(name)[samples] += moved
        driven.speed[samples] = speed
        for first, end in zip(records.first, records.bounds[1:], strict=True):
            accel[first:end] = np.gradient(driven.speed[first:end], records.dt)
        pushed[:] = 1.0
        # ``gap`` of what was driven is that of other positions.
        return replace(driven)


def drivers_of(problem: Problem, solution: Solution) -> NoisyDrivers:
    """Return a calibrated model of windows with its drivers' noise: as records driven with it look most alike."""
    records, model = problem.rows.records, solution.model.fixed(solution.values)
    near, far, of_group = _increments(problem.rows, model, solution.theta)
    none = NoisyDrivers(model, solution.theta, np.zeros(problem.groups), MEMORIES_S[0])
    if near <= 0.0:
        return none
    tried: list[tuple[float, NoisyDrivers]] = []
    for memory in MEMORIES_S:
        first = replace(none, sigma=np.sqrt(near * of_group) / LAGS_S[0], memory_s=memory)
        driven = first.drive(records, np.random.default_rng(0))
        sooner, later, _ = _increments(replace(problem.rows, records=driven), model, solution.theta)
        if sooner > 0.0:
            tried.append((abs(later / sooner - far / near), replace(first, sigma=first.sigma * np.sqrt(near / sooner))))
    if not tried:
        return none
    best = min(tried, key=lambda one: one[0])[1]
    # Increments tell what is drift and its memory; how large it is shows better in what it comes to.
    replica, theta = _fitted(problem, best, np.random.default_rng(0))
    sizes = [float(np.median(_ahead(t, x, model) ** 2)) for t, x in ((problem, solution.theta), (replica, theta))]
    return replace(best, sigma=best.sigma * np.sqrt(sizes[0] / sizes[1]))


def _fitted(problem: Problem, drivers: NoisyDrivers, random: np.random.Generator) -> tuple[Problem, np.ndarray]:
    """Return the windows of a replica, and log θ [G, P] of drivers fitted to it in them."""
    replica = replace(problem, rows=windows(drivers.drive(problem.rows.records, random)))
    return replica, solve(replica, drivers.model, drivers.theta, EMPTY[0], iterations=3).theta


def _ahead(problem: Problem, theta: np.ndarray, model: Hypothesis) -> np.ndarray:
    """Return errors of the gap 5 s ahead [W]."""
    errors: np.ndarray = Problem(problem.rows, None, problem.prior).errors(theta[None], model, EMPTY)[0][:, -1]
    return errors


def _increments(rows: Rows, model: Hypothesis, theta: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return the covariance of increments of the speed's error at both lags (m²/s²), and drivers' shares of it [G].

    A driver counts by one over his own mean square plus the usual one.
    """
    speed = Problem(rows, None, _no_prior(theta)).predict(theta[None], model, EMPTY)[1][0]
    step = np.diff(speed - rows.records.speed[rows.samples], axis=1, prepend=0.0)
    own = np.mean(step**2, axis=1)
    square = np.bincount(rows.group, own, len(theta)) / np.maximum(np.bincount(rows.group, minlength=len(theta)), 1)
    usual = float(np.median(square[square > 0.0])) if square.any() else 1.0
    weight = usual / (square[rows.group] + usual)
    lags = [max(1, round(s / (rows.every * rows.records.dt))) for s in LAGS_S]
    near, far = (float(np.mean(weight * np.mean(step[:, :-lag] * step[:, lag:], axis=1))) for lag in lags)
    total = float(np.mean(weight * square[rows.group]))
    return near / total * usual, far / total * usual, square / usual


def agreement(problem: Problem, solution: Solution, floor_m: float, seed: int) -> ladder.Agreement:
    """Return whether a model's errors 5 s ahead agree with noise, by a posterior predictive p-value.

    The statistic is the share of the squared error that a smooth function of the scene takes beside drift, as on the
    ladder with fewer features. Every replica has drivers' noise, that of sensors (``floor_m``), and drivers fitted to
    it in windows of 5 s, as those of ``solution`` are to the data.
    """
    drivers, random, above = drivers_of(problem, solution), np.random.default_rng(seed), 0

    def share(rows: Rows, error: np.ndarray) -> float:
        return ladder.structure(rows, error, seed, FEATURES)[0]

    mine = share(problem.rows, _ahead(problem, solution.theta, drivers.model))
    for draw in range(1, DRAWS + 1):
        replica, theta = _fitted(problem, drivers, random)
        noise = floor_m * random.standard_normal(len(replica.rows))
        above += share(replica.rows, _ahead(replica, theta, drivers.model) + noise) >= mine
        if above == ENOUGH:
            return ladder.Agreement(mine, above / draw, draw)
    return ladder.Agreement(mine, (above + 1) / (DRAWS + 1), DRAWS)


def _no_prior(theta: np.ndarray) -> Prior:
    return Prior(theta.mean(0), np.ones(theta.shape[-1]))
