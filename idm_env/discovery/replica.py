"""The same drivers once more: records as a calibrated model and its drivers' own noise would have made them.

Noise of drivers is an Ornstein–Uhlenbeck acceleration, ``da = −a dt/τ + σ √(2/τ) dW``, matched to how errors of the
speed grow in windows of 5 s. Every follower drives behind his measured leader. What a smooth function of the scene
tells of errors in them is what noise alone does: the scene has felt it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from idm_env.discovery import ladder, tails
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.records import Records, Rows, whole, windows
from idm_env.discovery.ridge import by_group
from idm_env.discovery.score import held_out, log_gain
from idm_env.discovery.solve import Population, Problem, Solution, solve

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

    def drive(self, records: Records, random: np.random.Generator, noise_m: float = 0.0) -> Records:
        """Return the records that these drivers would have made behind the same leaders, positions with white noise."""
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
        moved += noise_m * random.standard_normal(len(moved))
        for name in ("position", "place"):
            driven.column(name)[samples] += moved
        driven.speed[samples] = speed
        for first, end in zip(records.first, records.bounds[1:], strict=True):
            accel[first:end] = np.gradient(driven.speed[first:end], records.dt)
        pushed[:] = 1.0
        # ``gap`` of what was driven is that of other positions.
        return replace(driven)


def drivers_of(problem: Problem, solution: Solution, noise_m: float) -> NoisyDrivers:
    """Return a calibrated model of windows with its drivers' noise: as records driven with it look most alike.

    Noise makes drivers look as if they pulled less at their gaps: what changed a gap goes on. So θ is moved by as much
    as drivers fitted to a replica are off, in the mean of all.
    """
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
    seen, goal = np.unique(problem.rows.group), np.median(ahead(problem, solution.theta, model) ** 2)
    low, high = model.catalogue.bounds.T
    for _ in range(2):
        replica, theta = _fitted(problem, best, np.random.default_rng(0), noise_m)
        off = np.median((theta - best.theta)[seen], axis=0)
        # Increments tell what is drift and its memory; how large it is shows better in what it comes to.
        scale = np.sqrt(goal / np.median(ahead(replica, theta, model) ** 2))
        best = replace(best, theta=np.clip(solution.theta - off, low, high), sigma=best.sigma * scale)
    return best


def _fitted(
    problem: Problem, drivers: NoisyDrivers, random: np.random.Generator, noise_m: float
) -> tuple[Problem, np.ndarray]:
    """Return the windows of a replica, and log θ [G, P] of drivers fitted to it in them."""
    replica = replace(problem, rows=windows(drivers.drive(problem.rows.records, random, noise_m)))
    return replica, solve(replica, drivers.model, drivers.theta, EMPTY[0], iterations=3).theta


def ahead(problem: Problem, theta: np.ndarray, model: Hypothesis) -> np.ndarray:
    """Return errors of the gap 5 s ahead (m) [W] with log θ [G, P]."""
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


def agreement(
    problem: Problem, solution: Solution, noise_m: float, seed: int, term: Term | None = None
) -> tuple[NoisyDrivers, dict[str, ladder.Agreement]]:
    """Return a model's drivers with their noise, and whether its errors 5 s ahead agree with that noise.

    Posterior predictive p-values of shares of the squared error. ``scene``: what a smooth function of the scene takes
    beside drift. ``sizes``: what it tells of the errors' sizes, which even noise leaves alone. ``past``: what a
    driver's other errors take. ``tails``: what lies in the worst windows. ``leading``: what a ``term`` takes in
    whitened windows. Every replica has drivers' noise and that of sensors (``noise_m``). Drivers are fitted to it in
    windows of 5 s, as those of ``solution`` are to the data.
    """
    drivers, random = drivers_of(problem, solution, noise_m), np.random.default_rng(seed)

    def scene(rows: Rows, error: np.ndarray) -> float:
        return ladder.structure(rows, error, seed, FEATURES).share

    def past(rows: Rows, error: np.ndarray) -> float:
        return ladder.followed(rows, error).share

    def sizes(rows: Rows, error: np.ndarray) -> float:
        size = np.abs(error)
        return scene(rows, size / by_group(rows, size + tails.FLOOR_M) - 1.0)

    def gain(windowed: Problem, theta: np.ndarray) -> float:
        assert term is not None
        before = solve(windowed, solution.model, theta, solution.values, iterations=1)
        begin = np.append(before.values, term.starts[0])
        after = solve(windowed, solution.model.adding(term), before.theta, begin, iterations=2)
        mean = float(log_gain(held_out(windowed, before), held_out(windowed, after)).mean())
        return 1.0 - float(np.exp(-2.0 * mean))

    of_errors = {"scene": scene, "tails": tails.concentration, "sizes": sizes, "past": past}

    def told(windowed: Problem, theta: np.ndarray, names: Sequence[str]) -> dict[str, float]:
        error = ahead(windowed, theta, drivers.model)
        return {n: of_errors[n](windowed.rows, error) if n in of_errors else gain(windowed, theta) for n in names}

    mine = told(problem, solution.theta, [*of_errors, *([] if term is None else ["leading"])])
    above, draws = dict.fromkeys(mine, 0), dict.fromkeys(mine, 0)
    for draw in range(1, DRAWS + 1):
        if not (still := [name for name in mine if above[name] < ENOUGH]):
            break
        replica, theta = _fitted(problem, drivers, random, noise_m)
        for name, value in told(replica, theta, still).items():
            above[name] += value >= mine[name]
            draws[name] = draw
    p = {name: a / draws[name] if a == ENOUGH else (a + 1) / (draws[name] + 1) for name, a in above.items()}
    return drivers, {name: ladder.Agreement(mine[name], p[name], draws[name]) for name in mine}


def _no_prior(theta: np.ndarray) -> Population:
    return Population(theta.mean(0), np.ones(theta.shape[-1]))
