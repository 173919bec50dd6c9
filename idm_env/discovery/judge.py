"""Errors on runs that neither fitted nor chose anything, parameters for the drivers in them, and what is left."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from idm_env.data import noise_sigma
from idm_env.discovery import places
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.noise import HEAVY
from idm_env.discovery.records import Records, Rows, block_seconds, whole, windows
from idm_env.discovery.solve import Population, Problem, Solution, cost_of, solve
from idm_env.discovery.units import units

LEAST_SIZE = 0.01
"""Share of the error at constant speeds 5 s ahead below which a difference of predictions has no practical size.

In generated sets half the usual strengths of the catalogue move them by 1.5 % and more, another integrator by 0.1 %.
"""
STUCK = 5.0
"""Times the median group's error (RMS) from which a fit is begun once more."""


@dataclass(frozen=True, eq=False)
class Judged:
    """Errors of every row's free simulation [R, samples], what was simulated, and errors 5 s ahead of windows [W].

    ``gap`` and ``speed`` are the simulated ones; a driver's record may be cut into several rows, and a driver may have
    several records: figures per driver are those of ``followers``.
    """

    rows: Rows
    gap: np.ndarray
    speed: np.ndarray
    ahead: np.ndarray
    ahead_record: np.ndarray
    further: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Errors of the gap 10 s ahead [windows of 10 s] with the drivers of those 5 s ahead; empty on short blocks."""
    theta: np.ndarray | None = None
    """log θ [2, G, P] of predictions 5 s ahead, of groups that are judged, from each half of their time."""

    @cached_property
    def gap_error(self) -> np.ndarray:
        """Simulated less measured gap (m) [R, samples], 0 where it does not count."""
        records = self.rows.records
        return np.where(self.rows.valid, np.clip(self.gap - records.gap[self.rows.samples], -200, 200), 0.0)

    @cached_property
    def followers(self) -> tuple[tuple[str, str], ...]:
        """Run and vehicle of every driver, once each."""
        return tuple(dict.fromkeys((e.run_id, e.vehicle_id) for e in self.rows.records.episodes))

    @cached_property
    def follower(self) -> np.ndarray:
        """Number in ``followers`` of every record."""
        number = {key: i for i, key in enumerate(self.followers)}
        return np.array([number[e.run_id, e.vehicle_id] for e in self.rows.records.episodes])

    @cached_property
    def squares(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Sums of squares and numbers of samples [followers] of every error."""
        speed_error = np.where(self.rows.valid, self.speed - self.rows.records.speed[self.rows.samples], 0.0)
        of_row = self.follower[self.rows.record]
        samples = self._summed(of_row, self.rows.valid.sum(1))
        of_window = self.follower[self.ahead_record]
        horizon = self._summed(of_window, self.ahead**2), self._summed(of_window, np.ones(len(of_window)))
        return {
            "gap_rmse_m": (self._summed(of_row, (self.gap_error**2).sum(1)), samples),
            "horizon_rmse_m": horizon,
            "speed_rmse_mps": (self._summed(of_row, (speed_error**2).sum(1)), samples),
        }

    def _summed(self, follower: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.bincount(follower, values, minlength=len(self.followers)).astype(float)

    @property
    def gap_rmse(self) -> np.ndarray:
        """Gap RMSE of every follower (m), NaN where there is nothing to score."""
        square, count = self.squares["gap_rmse_m"]
        return np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.nan)

    def summary(self) -> dict[str, float]:
        """Return the four errors of the report; the pooled ones weigh every sample alike."""
        pooled = {
            key: float(np.sqrt(square.sum() / count.sum())) if count.sum() else float("nan")
            for key, (square, count) in self.squares.items()
        }
        median = float(np.nanmedian(self.gap_rmse)) if np.isfinite(self.gap_rmse).any() else float("nan")
        return pooled | {"gap_rmse_median_driver_m": median}


def calibrate(
    records: Records, model: Hypothesis, values: np.ndarray, prior: Population, rows: Rows | None = None,
    start: np.ndarray | None = None,
) -> Solution:  # fmt: skip
    """Fit θ of every group in free simulation behind the measured leader, with φ as it stands: ``values`` [Q].

    A first fit, from the prior's centre and log θ ``start`` [G, P], tells how large errors are. In the second, errors
    of ``prior.error_correlation_s`` seconds count as one, so that the population, as prior, speaks for a driver whose
    record is short or noisy.
    """
    problem, theta = unweighed(records, model, values, prior, rows, start)
    return weighed(problem, model, values, theta)


def unweighed(
    records: Records, model: Hypothesis, values: np.ndarray, prior: Population, rows: Rows | None = None,
    start: np.ndarray | None = None, calibrated: bool = False,
) -> tuple[Problem, np.ndarray]:  # fmt: skip
    """Return the problem of a calibration and its first fit: log θ [G, P] with a prior that hardly weighs anything.

    From two starts, the prior's centre and ``start`` [G, P]; every group keeps the better one. From ``start`` alone
    where that is of a model already ``calibrated`` on these records. Groups whose errors are ``STUCK`` times the
    median's begin once more, from the median of all: a law of many parameters may stop in a corner.
    """
    rows = (whole(records) if rows is None else rows).settled()
    frozen, empty = model.fixed(values), np.zeros(0)
    problem = Problem(rows, None, replace(prior, centre_follows=False))
    centre = np.tile(prior.centre, (problem.groups, 1))
    fits = [
        solve(problem, frozen, x, empty, iterations=25, tolerance=1e-5)
        for x in ([] if calibrated else [centre]) + ([] if start is None else [start])
    ]
    costs = [_costs(problem, fit) for fit in fits]
    theta, cost = _better(fits[0].theta, costs[0], fits[-1].theta, costs[-1])
    samples = problem.per_group(rows.valid.sum(1))
    each = cost / np.maximum(samples, 1)
    stuck = (each > STUCK**2 * np.median(each[samples > 0])) & (samples > 0)
    if stuck.any():
        middle = np.broadcast_to(np.median(theta[samples > 0], axis=0), theta.shape)
        some = problem.of_rows(stuck[rows.group])
        again = solve(some, frozen, middle, empty, iterations=25, tolerance=1e-5)
        theta, _ = _better(theta, cost, again.theta, np.where(stuck, _costs(some, again), np.inf))
    return problem, theta


def _costs(problem: Problem, s: Solution) -> np.ndarray:
    """Return the cost of every group [G]."""
    return cost_of(problem, s.theta[None], s.linear.residual[None])[0]


def _better(
    theta: np.ndarray, cost: np.ndarray, other: np.ndarray, its_cost: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return log θ [G, P] and cost [G] of the fit that costs less, by group."""
    return np.where((its_cost < cost)[:, None], other, theta), np.minimum(its_cost, cost)


def weighed(problem: Problem, model: Hypothesis, values: np.ndarray, theta: np.ndarray) -> Solution:
    """Return the calibration in which errors of ``error_correlation_s`` count as one, from a first fit [G, P]."""
    problem = scaled(problem, model, values, theta)
    return solve(problem, model.fixed(values), theta, np.zeros(0), iterations=25, tolerance=1e-5)


def scaled(problem: Problem, model: Hypothesis, values: np.ndarray, theta: np.ndarray) -> Problem:
    """Return a problem of closed-loop simulation in whose cost errors of ``error_correlation_s`` count as one.

    They are as large as at log θ [G, P] and φ [Q].
    """
    rows = problem.rows
    errors = problem.errors(theta[None], model.fixed(values), np.zeros((1, 0)))[0]
    square = (errors**2).sum(1) / np.maximum(rows.valid.sum(1), 1)
    correlated = problem.prior.error_correlation_s / (rows.every * rows.records.dt)
    return replace(problem, sigma=float(np.sqrt(max(np.median(square), 1e-4) * correlated)))


def closed_loop_squares(records: Records, s: Solution) -> np.ndarray:
    """Return squared gap errors (m²) of closed-loop simulation [units], θ fitted to it; one counts 30 m at most."""
    fitted = calibrate(records, s.model, s.values, s.prior, start=s.theta)
    rows = whole(records)
    problem = Problem(rows, None, s.prior)
    errors = problem.errors(fitted.theta[None], s.model.fixed(s.values), np.zeros((1, 0)))[0]
    return units(records).sums(rows.record, (np.clip(errors, -30.0, 30.0) ** 2).sum(1))


def confirmed(records: Records, problem: Problem, null: Solution, final: Solution) -> float:
    """Return the gain in log RMSE of predictions on runs never used: φ as found, θ of their drivers fitted in both.

    Judged by the noise of ``problem``, as the choice was. (Errors of closed loops are dominated by drivers' own noise:
    with 0.1 m/s² of it they refused every second right finding of half strength.)
    """
    rows = windows(records)
    assert problem.noise is not None
    on_test = Problem(rows, problem.noise.unweighted(len(rows)), problem.prior)
    squares = []
    for s in (null, final):
        start = np.tile(s.prior.centre, (on_test.groups, 1))
        fitted = solve(on_test, s.model.fixed(s.values), start, np.zeros(0), iterations=20)
        squares.append((np.minimum((fitted.linear.residual**2).mean(1), 9.0 * HEAVY**2)).sum())
    return float(0.5 * np.log(squares[0] / squares[1]))


def windowed(records: Records, problem: Problem, solution: Solution) -> tuple[Problem, Solution]:
    """Return a model in windows of all records, and its problem: φ as it stands, θ fitted, the noise of ``problem``."""
    assert problem.noise is not None
    rows = windows(records)
    in_windows = Problem(rows, problem.noise.unweighted(len(rows)), replace(problem.prior, centre_follows=False))
    start = np.tile(problem.prior.centre, (in_windows.groups, 1))
    fitted = solve(in_windows, solution.model.fixed(solution.values), start, np.zeros(0))
    return in_windows, replace(fitted, model=solution.model, values=solution.values)


def halves(rows: Rows) -> np.ndarray:
    """Return [R, samples] which samples lie in every second block of time: 30 s, or a quarter of a shorter record."""
    records, first = rows.records, rows.records.first[rows.record]
    sizes = block_seconds((records.bounds[rows.record + 1] - first) * records.dt)
    number = (rows.samples - first[:, None]) * records.dt // sizes[:, None]
    return np.asarray((number.astype(int) % 2 == 1) & rows.valid)


def judge(records: Records, model: Hypothesis, values: np.ndarray, theta: np.ndarray) -> Judged:
    """Return the errors of a model with log θ [G, P] and values [Q] on all of the records."""
    rows, short, frozen, empty = whole(records), windows(records), model.fixed(values), np.zeros((1, 0))
    prior = Population(theta.mean(0), np.ones(theta.shape[-1]))
    gap, speed = (x[0] for x in Problem(rows, None, prior).predict(theta[None], frozen, empty))
    ahead = Problem(short, None, prior).errors(theta[None], frozen, empty)[0][:, -1]
    return Judged(rows, gap, speed, ahead, short.record)


def floor(records: Records) -> dict[str, float]:
    """Return the errors that measurement noise alone would leave: third differences of gap and speed.

    Over a horizon that is the noise of its end; the noise of its start fades, because drivers correct it.
    """
    gaps = [noise_sigma(e.gap_m) for e in records.episodes]
    speeds = [noise_sigma(e.speed_mps) for e in records.episodes]
    gap = float(np.sqrt(np.mean(np.square(gaps))))
    return {
        "gap_rmse_m": gap,
        "gap_rmse_median_driver_m": float(np.median(gaps)),
        "horizon_rmse_m": gap,
        "speed_rmse_mps": float(np.sqrt(np.mean(np.square(speeds)))),
    }


def least_m(records: Records) -> float:
    """Return the least practical size of an error 5 s ahead (m): ``LEAST_SIZE`` of that at constant speeds (RMS)."""
    rows = windows(records)
    opening = records.column("lead_speed")[rows.start] - records.speed[rows.start]
    change = records.gap[rows.samples[:, -1]] - records.gap[rows.start]
    return LEAST_SIZE * float(np.sqrt(np.mean((change - rows.steps * records.dt * opening) ** 2)))


def ceiling(responses: places.Responses, prior_spread: float = 0.15) -> np.ndarray:
    """Return the honest gain of every unit [units] from any smooth acceleration over the state: what is left.

    A ridge regression on products of speed, gap, closing speed and the leader's acceleration, and on what the leader
    did up to 1.5 s ago, through the responses of the predictions, projected off the drivers' own parameters. It knows
    no names. The driver's own past is left out: it would tell of the driver's noise, which lasts.
    """
    rows = responses.rows
    records, dt = rows.records, rows.records.dt
    middle = rows.middle
    v, gap, lead_speed = records.speed[middle], records.gap[middle], records.column("lead_speed")
    closing, lead_accel = v - lead_speed[middle], records.column("lead_accel")[middle]
    now = [v / 10.0, 2.0 * np.log(np.maximum(gap, 0.5) / 15.0), closing / 2.0, lead_accel]
    features = [*now, *(a * b for i, a in enumerate(now) for b in now[i:])]
    features += [a * b * c for a in now[:3] for b in now[:3] for c in now[:3]][::3]
    features += [np.abs(now[2]), np.minimum(now[3], 0.0)]
    for lag in (0.5, 1.0, 1.5):
        j = np.maximum(middle - round(lag / dt), records.bounds[rows.record][:, None])
        change = (lead_speed[j] - lead_speed[middle]) / 2.0
        features += [change, change * now[1], change * now[0], np.abs(change)]
    for name in ("second_speed", "behind_speed"):
        present = records.column(name.replace("speed", "present"))[middle]
        features.append((records.column(name)[middle] - v) / 3.0 * present)
    basis = np.clip(np.stack(features, axis=-1), -10.0, 10.0)
    scale = basis.std((0, 1)) + 1e-9
    keep = scale > 1e-6
    return places.linear_curve(responses, "acceleration", basis[..., keep] / scale[keep], prior_spread)[1]
