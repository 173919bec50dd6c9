"""The same drivers once more: records as a calibrated model and its drivers' own noise would have made them.

Noise of drivers is an Ornstein–Uhlenbeck acceleration, ``da = −a dt/τ + σ √(2/τ) dW``, matched to errors of the gap
5 s ahead. Every follower drives behind his measured leader. What a smooth function of the scene
tells of errors in them is what noise alone does: the scene has felt it. What claims that something is missing must hold
against drivers' own residuals, too: these are heavy, and have more than one memory.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.signal import lfilter

from idm_env.discovery import ladder, tails
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.records import Records, Rows, whole, windows
from idm_env.discovery.ridge import by_group
from idm_env.discovery.score import held_out, log_gain
from idm_env.discovery.solve import Population, Problem, Solution, solve

FIRST_SIGMA = 0.1
"""Noise (m/s²) of the median driver from which its size is sought."""
WIDEST = 2.0
"""Times that drivers are spread at most in one step."""
MEMORIES_S = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Memories of drivers' noise that are tried."""
ALIKE = 5
"""Replicas in whose mean noise of a kind is held against the data."""
DRAWS, ENOUGH = 39, 3
"""Replicas for a likeness, and how many that look as structured as the data are enough (Besag and Clifford 1991)."""
CLEAR, MOST = 99, 199
"""Replicas after which none such is refusal enough, and replicas at most, of what claims that something is missing."""
FEW = 19
"""Replicas that must all be smaller where one costs a fit of every law: p ≤ 0.05."""
FIRST, FAR = 5, 10.0
"""Replicas that are enough where data lie so many standard deviations above their mean: Student's t has p < 0.001."""
BLOCK_S = 30.0
"""Length of a block of a driver's own residuals: 10 s cut a memory of 5 s."""
FEATURES = 40
EMPTY = np.zeros((1, 0))
Statistic = Callable[[Rows, np.ndarray], float]
"""Of errors of the gap 5 s ahead [W]."""


@dataclass(frozen=True, eq=False)
class NoisyDrivers:
    """A calibrated model: φ stands in ``model``, log θ [G, P]; noise of σ [G] (m/s²) with a memory of τ (s).

    Noise ``by_speed`` grows in proportion to it, and has σ in the root mean square of a record. Where the drivers'
    ``own`` residuals [G] of samples (m/s²) are given, it is σ times blocks of these.
    """

    model: Hypothesis
    theta: np.ndarray
    sigma: np.ndarray
    memory_s: float
    by_speed: bool = False
    own: tuple[np.ndarray, ...] = ()

    def _noise(self, records: Records, record: int, random: np.random.Generator) -> np.ndarray:
        """Return accelerations (m/s²) that push a record's driver [samples]."""
        first, end = records.bounds[record : record + 2]
        count, group = end - first, records.group[record]
        if self.own:
            own, block = self.own[group], round(BLOCK_S / records.dt)
            begins = random.integers(0, len(own), count // block + 1)
            which = (begins[:, None] + np.arange(block)).ravel()[:count] % len(own)
            return np.asarray(self.sigma[group] * own[which])
        fresh, keep = random.standard_normal(count), np.exp(-records.dt / self.memory_s)
        fresh[1:] *= np.sqrt(1.0 - keep**2)
        noise = self.sigma[group] * lfilter([1.0], [1.0, -keep], fresh)
        speed = np.maximum(records.speed[first:end], 0.0)
        return np.asarray(noise * (speed / (np.sqrt(np.mean(speed**2)) + 0.1) if self.by_speed else 1.0))

    def drive(self, records: Records, random: np.random.Generator, noise_m: float = 0.0) -> Records:
        """Return the records that these drivers would have made behind the same leaders, positions with white noise."""
        driven = replace(records, signals=records.signals.copy())
        pushed, accel = driven.column("pushed"), driven.column("accel")
        for r, (first, end) in enumerate(zip(records.bounds[:-1], records.bounds[1:], strict=True)):
            pushed[first:end] = self._noise(records, r, random)
        rows = whole(driven, longest_s=np.inf, every_s=0.0)
        pulse = np.array([[1.0, 0.0, rows.steps, 1.0]])
        problem = Problem(rows, None, Population(self.theta.mean(0), np.ones(self.theta.shape[-1])))
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


def drivers_of(
    problem: Problem, solution: Solution, noise_m: float, of_errors: Mapping[str, Statistic]
) -> NoisyDrivers:
    """Return a calibrated model of windows with its drivers' noise: as records driven with it look most alike.

    The memory is the one by which other errors of a driver foresee as much as in the data (``past``). Noise grows with
    speed if the scene then tells as much of the errors' ``sizes``.
    """
    model, rows = solution.model.fixed(solution.values), problem.rows
    error, sigma = ahead(problem, solution.theta, model), FIRST_SIGMA * _shares(problem, model, solution.theta)

    def mean_share(name: str, drivers: NoisyDrivers) -> float:
        random = np.random.default_rng(1)
        replicas = [_fitted(problem, drivers, random, noise_m) for _ in range(ALIKE)]
        return float(np.mean([of_errors[name](x.rows, ahead(x, theta, model)) for x, theta in replicas]))

    past, sizes = (of_errors[name](rows, error) for name in ("past", "sizes"))
    each = [NoisyDrivers(model, solution.theta, sigma, memory) for memory in MEMORIES_S]
    shares = [mean_share("past", _as_large(problem, solution, drivers, noise_m)) for drivers in each]
    memory = np.exp(np.interp(past, np.maximum.accumulate(shares), np.log(MEMORIES_S)))
    best = replace(each[0], memory_s=float(memory))
    both = [_as_large(problem, solution, replace(best, by_speed=more), noise_m) for more in (False, True)]
    return min(both, key=lambda drivers: abs(mean_share("sizes", drivers) - sizes))


def _as_large(problem: Problem, solution: Solution, drivers: NoisyDrivers, noise_m: float) -> NoisyDrivers:
    """Return drivers whose errors 5 s ahead are as large as the data's.

    Noise makes drivers look as if they pulled less at their gaps: what changed a gap goes on. And their population
    pulls them together. So θ is moved and spread until drivers fitted to a replica are where those of the data are.
    """
    model, best = drivers.model, drivers
    seen, goal = np.unique(problem.rows.group), np.median(ahead(problem, solution.theta, model) ** 2)
    low, high = model.catalogue.bounds.T
    for _ in range(2):
        replica, theta = _fitted(problem, best, np.random.default_rng(0), noise_m)
        (mine, wide), (its, its_wide), (middle, _) = (_spread(x[seen]) for x in (solution.theta, theta, best.theta))
        moved = middle + mine - its + (best.theta - middle) * np.clip(wide / its_wide, 1.0 / WIDEST, WIDEST)
        scale = np.sqrt(goal / np.median(ahead(replica, theta, model) ** 2))
        best = replace(best, theta=np.clip(moved, low, high), sigma=best.sigma * scale)
    return best


def _spread(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the median of log θ [G, P] and the median deviation from it [P]."""
    middle = np.median(theta, axis=0)
    return middle, np.median(np.abs(theta - middle), axis=0) + 1e-6


def _own_noise(problem: Problem, solution: Solution, drivers: NoisyDrivers, noise_m: float) -> NoisyDrivers:
    """Return drivers whose noise is what they do beside the model, in means of a second."""
    records, theta = problem.rows.records, solution.theta
    rows = windows(records, 1.0)
    speed = Problem(rows, None, problem.prior).predict(theta[None], drivers.model, EMPTY)[1][0, :, -1]
    residual = (records.speed[rows.samples[:, -1]] - speed) / (rows.steps * records.dt)
    # Of a group without a window nothing is known.
    each = (residual[rows.group == g] for g in range(len(theta)))
    own = tuple(np.repeat(x if len(x) else np.zeros(1), rows.steps) for x in each)
    return _as_large(problem, solution, replace(drivers, theta=theta, sigma=np.ones(len(theta)), own=own), noise_m)


def _fitted(
    problem: Problem, drivers: NoisyDrivers, random: np.random.Generator, noise_m: float
) -> tuple[Problem, np.ndarray]:
    """Return the windows of a replica, and log θ [G, P] of drivers fitted to it in them."""
    replica = replace(problem, rows=windows(drivers.drive(problem.rows.records, random, noise_m)))
    return replica, solve(replica, drivers.model, drivers.theta, EMPTY[0], iterations=3).theta


def stands_out(
    problem: Problem, solution: Solution, noise_m: float, seed: int, statistic: Callable[[Problem], float]
) -> bool:
    """Tell whether a statistic of windows is larger than in all of ``FEW`` replicas with drivers' own residuals.

    Noise alone passes once in twenty times. As a rule it is told by the ``FIRST`` replicas, as is what lies ``FAR``
    above these.
    """
    theta, random = solution.theta, np.random.default_rng(seed)
    bare = NoisyDrivers(solution.model.fixed(solution.values), theta, np.ones(len(theta)), 1.0)
    drivers, mine = _own_noise(problem, solution, bare, noise_m), statistic(problem)
    driven = (windows(drivers.drive(problem.rows.records, random, noise_m)) for _ in range(FEW))
    gains = (statistic(replace(problem, rows=rows)) for rows in driven)
    first = [next(gains) for _ in range(FIRST)]
    far = mine > np.mean(first) + FAR * np.std(first)
    return bool(mine > max(first) and (far or all(gain < mine for gain in gains)))


def ahead(problem: Problem, theta: np.ndarray, model: Hypothesis) -> np.ndarray:
    """Return errors of the gap 5 s ahead (m) [W] with log θ [G, P]."""
    return np.asarray(Problem(problem.rows, None, problem.prior).errors(theta[None], model, EMPTY)[0][:, -1])


def _shares(problem: Problem, model: Hypothesis, theta: np.ndarray) -> np.ndarray:
    """Return every driver's root mean square of increments of the speed's error over the median one [G]."""
    rows, speed = problem.rows, problem.predict(theta[None], model, EMPTY)[1][0]
    own = np.mean(np.diff(speed - rows.records.speed[rows.samples], axis=1, prepend=0.0) ** 2, axis=1)
    square = np.bincount(rows.group, own, len(theta)) / np.maximum(np.bincount(rows.group, minlength=len(theta)), 1)
    return np.asarray(np.sqrt(square / np.median(square[square > 0.0])))


def statistics(seed: int) -> dict[str, Statistic]:
    """Return by name what ``agreement`` holds against replicas, with random features of a seed."""
    scene = partial(ladder.structure, seed=seed, features=FEATURES)

    def sizes(rows: Rows, error: np.ndarray) -> float:
        size = np.abs(error)
        return scene(rows, size / by_group(rows, size + tails.FLOOR_M) - 1.0)

    return {"scene": scene, "tails": tails.concentration, "sizes": sizes, "past": ladder.followed}


def agreement(
    problem: Problem, solution: Solution, noise_m: float, seed: int, term: Term | None = None
) -> tuple[NoisyDrivers, dict[str, ladder.Agreement]]:
    """Return a model's drivers with their noise, and whether its errors 5 s ahead agree with that noise.

    Posterior predictive p-values of shares of the squared error. ``scene``: what a smooth function of the scene takes
    beside drift. ``sizes``: what it tells of the errors' sizes, which even noise leaves alone. ``past``: what a
    driver's other errors take. ``tails``: what lies in the worst windows. ``leading``: what a ``term`` takes in
    whitened windows. Every replica has drivers' noise and that of sensors (``noise_m``). Drivers are fitted to it in
    windows of 5 s, as those of ``solution`` are to the data. Scene, tails and leading claim that something is missing,
    and have more replicas until that is clear; scene and leading against drivers' own residuals, too. In tails an
    effect lies together in residuals as well.
    """
    of_errors, random = statistics(seed), np.random.default_rng(seed)
    gaussian = drivers_of(problem, solution, noise_m, of_errors)

    def gain(windowed: Problem, theta: np.ndarray) -> float:
        assert term is not None
        before = solve(windowed, solution.model, theta, solution.values, iterations=1)
        begin = np.append(before.values, term.starts[0])
        after = solve(windowed, solution.model.adding(term), before.theta, begin, iterations=2)
        mean = float(log_gain(held_out(windowed, before), held_out(windowed, after)).mean())
        return 1.0 - float(np.exp(-2.0 * mean))

    def told(windowed: Problem, theta: np.ndarray, names: Sequence[str]) -> dict[str, float]:
        error = ahead(windowed, theta, gaussian.model)
        return {n: of_errors[n](windowed.rows, error) if n in of_errors else gain(windowed, theta) for n in names}

    leading = [] if term is None else ["leading"]
    mine = told(problem, solution.theta, [*of_errors, *leading])

    def likenesses(drivers: NoisyDrivers, names: Sequence[str], claims: Sequence[str]) -> dict[str, ladder.Agreement]:
        shares: dict[str, list[float]] = {name: [] for name in names}

        def exceedances(name: str) -> int:
            return sum(share >= mine[name] for share in shares[name])

        def likeness(name: str) -> ladder.Agreement:
            count, replicas = exceedances(name), len(shares[name])
            p_value = count / replicas if count == ENOUGH else (count + 1) / (replicas + 1)
            return ladder.Agreement(mine[name], p_value, replicas, float(np.mean(shares[name])))

        for draw in range(1, MOST + 1):
            still = [n for n in names if exceedances(n) < ENOUGH and (draw <= DRAWS or n in claims)]
            # Of what is clearly refused no more is asked, and nothing else then: something is missing.
            if not still or (draw > CLEAR and not all(exceedances(n) for n in claims)):
                break
            replica, theta = _fitted(problem, drivers, random, noise_m)
            for name, share in told(replica, theta, still).items():
                shares[name].append(share)
        return {name: likeness(name) for name in names}

    agree = likenesses(gaussian, list(mine), ["scene", "tails", *leading])
    if claims := [name for name in ("scene", *leading) if agree[name].is_refused]:
        agree |= likenesses(_own_noise(problem, solution, gaussian, noise_m), claims, claims)
    return gaussian, agree
