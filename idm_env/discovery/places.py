"""Where and when: responses to short pulses, projected off the drivers' own parameters, and scans over all intervals.

In every second of every window something is changed a little: an acceleration added, T, v0, or a and b raised. The
responses of the predictions are added up over any WHERE (an interval of places or times, a ramp, a phase of a period),
so that thousands of places cost one rollout of 21 copies.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import torch

from idm_env.discovery.march import PULSED
from idm_env.discovery.records import Rows
from idm_env.discovery.solve import Problem, Solution, equations
from idm_env.discovery.units import Units, units
from idm_env.effects.free import FREE

PULSE = 0.05


@dataclass(frozen=True, eq=False)
class Responses:
    """Responses [what, second, R, m] per unit, residual [R, m], and every row's coordinates in every second [R, J].

    ``units`` are what a test counts, and ``square`` [units] the squared residuals there.
    """

    rows: Rows
    units: Units
    change: np.ndarray
    residual: np.ndarray
    by_theta: np.ndarray
    absorbed: np.ndarray
    coordinates: dict[str, np.ndarray]
    square: np.ndarray

    def answer(self, what: str, basis: np.ndarray) -> np.ndarray:
        """Return the response [R, m, B] to a basis [R, J, B] over the coordinates.

        It is projected off what re-calibrated drivers would absorb.
        """
        rows = self.rows
        response = np.einsum("jrm,rjb->rmb", self.change[PULSED.index(what)], basis)
        cross = np.zeros((len(rows.records.groups), self.by_theta.shape[-1], basis.shape[-1]))
        np.add.at(cross, rows.group, np.einsum("rmi,rmb->rib", self.by_theta, response))
        follow = np.einsum("gij,gjb->gib", self.absorbed, cross)
        response -= np.einsum("rmi,rib->rmb", self.by_theta, follow[rows.group])
        return response

    def design(self, what: str, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return per unit the matrix [units, B, B] and vector [units, B] of ``answer``."""
        response, count = self.answer(what, basis), basis.shape[-1]
        unit_of_row = self.units.of_record[self.rows.record]
        matrix, vector = np.zeros((len(self.units), count, count)), np.zeros((len(self.units), count))
        for unit in range(len(self.units)):
            mine = response[unit_of_row == unit].reshape(-1, count)
            matrix[unit] = mine.T @ mine
            vector[unit] = -mine.T @ self.residual[unit_of_row == unit].reshape(-1)
        return matrix, vector

    def gains(self, c: np.ndarray, matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Return gains [units] in log RMSE by coefficients c [units, B]; no square falls by more than nine tenths."""
        gained = 2 * np.einsum("ub,ub->u", c, vector) - np.einsum("ub,ubc,uc->u", c, matrix, c)
        return -0.5 * np.log(1.0 - np.clip(gained / np.maximum(self.square, 1e-12), -9.0, 0.9))


def respond(problem: Problem, solution: Solution) -> Responses:
    """Return the responses at a solution."""
    rows, records = problem.rows, problem.rows.records
    every = [(w + 1, *part, PULSE) for w in range(len(PULSED)) for part in pairwise(rows.seconds)]
    pulses = np.array([(0, 0, 0, 0), *every], dtype=float)
    copies = len(pulses)
    theta = np.repeat(solution.theta[None], copies, axis=0)
    values = np.repeat(solution.values[None], copies, axis=0)
    residual = problem.residual(problem.errors(theta, solution.model, values, pulses))
    change = (residual[1:] - residual[0]).reshape(len(PULSED), -1, *residual.shape[1:]) / PULSE
    middle, speed, place = rows.middle, records.speed[rows.middle], records.column("place")[rows.middle]
    coordinates = {
        "position": np.mod(place, records.period) if records.period else place,
        "time": records.column("time")[middle],
        "speed": speed,
        "gap": records.gap[middle],
        "closing_speed": speed - records.column("lead_speed")[middle],
        "lead_accel": records.column("lead_accel")[middle],
        "relative_gap": relative_gap(solution, rows, middle),
        **{name: x[middle] for name, x in records.past.items()},
        # At the window's start: later it has felt the driver's own noise, as the errors have.
        "own_accel": np.broadcast_to(records.past["own_accel"][rows.start][:, None], middle.shape),
    }
    linear = solution.linear
    matrix = equations(problem, solution.theta, linear)[1][:, : linear.own, : linear.own]
    counted = units(records)
    square = counted.sums(rows.record, (linear.residual**2).sum(-1))
    return Responses(
        rows, counted, change, linear.residual, linear.by_theta,
        np.linalg.inv(matrix + 1e-9 * np.eye(len(matrix[0]))), coordinates, square,
    )  # fmt: skip


def relative_gap(solution: Solution, rows: Rows, at: np.ndarray) -> np.ndarray:
    """Return the gap over the one that each driver keeps, at samples [R, J]: the feature of that name."""
    records, catalogue = rows.records, solution.model.catalogue
    theta = torch.from_numpy(np.exp(solution.theta[rows.group]))[..., None]
    own = {p.name: theta[:, i] for i, (_, p) in enumerate(catalogue.of_driver[: len(catalogue.base.parameters)])}
    driver = catalogue.base.driver(own)
    speed = torch.from_numpy(records.speed[at])
    desired = driver.min_gap + driver.extra_gap + driver.time_gap * speed
    return np.clip(records.gap[at] / desired.numpy(), 0.0, FREE)


@dataclass(frozen=True, eq=False)
class Found:
    """The best interval [begin, end) and amount on all runs, and honest gains of every unit.

    Edges are those of bins of ``width``.

    ``gains`` [units] is the gain in log RMSE of each with interval and amount from the other runs; ``stable`` [units]
    says whether they chose nearly the same interval.
    """

    begin: float
    end: float
    amount: float
    gains: np.ndarray
    stable: np.ndarray
    width: float


def bins_of(values: np.ndarray, width: float, most: int = 60) -> tuple[np.ndarray, float]:
    """Return the edges [bins + 1] of at most ``most`` bins over a coordinate's values, in its unit, and their width."""
    low, high = float(values.min()), float(values.max()) + 1e-6
    width = max(width, (high - low) / most)
    count = max(1, int(np.ceil((high - low) / width)))
    return low + width * np.arange(count + 1), width


def scan(
    responses: Responses, what: str, coordinate: str, width: float, *, open_end: bool = False, shortest: int = 1,
    longest: float = np.inf,
) -> Found | None:  # fmt: skip
    """Return the interval of a coordinate in which a change of ``what`` explains most, or None without enough data.

    ``open_end`` takes only intervals that last to the end: steps; ``shortest`` bins, ``longest`` in its own unit.
    """
    values = responses.coordinates[coordinate]
    edges, width = bins_of(values, width)
    count = len(edges) - 1
    if count < 2 + shortest:
        return None
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, count - 1)
    basis = np.zeros((*values.shape, count))
    np.put_along_axis(basis, index[..., None], 1.0, axis=-1)
    matrix, vector = responses.design(what, basis)
    allowed = _allowed(count, open_end, shortest, coordinate == "time" and not open_end)
    allowed &= np.subtract.outer(edges[:-1], edges[1:]) >= -longest
    if not allowed.any():
        return None
    total = _best(matrix.sum(0), vector.sum(0), allowed)
    without, stable = np.zeros_like(vector), np.zeros(len(vector), bool)
    for mine in _by_run(responses):
        i, j, amount = _best(matrix.sum(0) - matrix[mine].sum(0), vector.sum(0) - vector[mine].sum(0), allowed)
        without[mine, i : j + 1] = amount
        stable[mine] = abs(i - total[0]) <= 1 and abs(j - total[1]) <= 1
    i, j, amount = total
    gains = responses.gains(without, matrix, vector)
    return Found(float(edges[i]), float(edges[j + 1]), amount, gains, stable, width)


def _by_run(responses: Responses) -> list[np.ndarray]:
    """Return the units of every run, which are left out together."""
    run = responses.units.run
    return [np.flatnonzero(run == r) for r in np.unique(run)]


def _allowed(count: int, open_end: bool, shortest: int, inner: bool) -> np.ndarray:
    i, j = np.indices((count, count))
    allowed = j - i + 1 >= shortest
    # An interval that covers nearly everything is no place, and one that reaches the end of time is a step.
    allowed &= j - i + 1 <= max(1, int(0.9 * count))
    if inner:
        margin = max(1, count // 10)
        allowed &= (i >= margin) & (j <= count - 1 - margin)
    if open_end:
        allowed &= (j == count - 1) & (i >= 1)
    return allowed


def _best(matrix: np.ndarray, vector: np.ndarray, allowed: np.ndarray) -> tuple[int, int, float]:
    count = len(vector)
    sums = np.zeros((count + 1, count + 1))
    sums[1:, 1:] = matrix.cumsum(0).cumsum(1)
    along = np.append(0.0, vector.cumsum())
    i, j = np.indices((count, count))
    up = j + 1
    weight = sums[up, up] - sums[i, up] - sums[up, i] + sums[i, i]
    push = along[up] - along[i]
    # A little ridge keeps intervals that hardly anybody passed from winning by chance.
    weight = weight + 0.02 * np.trace(matrix) / count
    weight = np.maximum(weight, 1e-12)  # of a single run, left out, nothing remains
    gain = np.where(allowed, push**2 / weight, -np.inf)
    best = np.unravel_index(gain.argmax(), gain.shape)
    return int(best[0]), int(best[1]), float(push[best] / weight[best])


def linear_curve(
    responses: Responses, what: str, basis: np.ndarray, spread: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coefficients [B] of a basis [R, J, B], with a prior of width spread, and honest gains per unit.

    The last are the coefficients [units, B] without the runs of each unit.
    """
    matrix, vector = responses.design(what, basis)
    ridge = np.eye(vector.shape[1]) / spread**2
    without = np.zeros_like(vector)
    for mine in _by_run(responses):
        others = matrix.sum(0) - matrix[mine].sum(0) + ridge
        without[mine] = np.linalg.solve(others, vector.sum(0) - vector[mine].sum(0))
    gains = responses.gains(without, matrix, vector)
    return np.linalg.solve(matrix.sum(0) + ridge, vector.sum(0)), gains, without


def hats(values: np.ndarray, first: float, distance: float, count: int, period: float = 0.0) -> np.ndarray:
    """Return the hat functions of a piecewise-linear curve at values [R, J]: [R, J, count]."""
    knot = (np.mod(values, period) if period else values) - first
    knot = knot / distance
    if period:
        low = np.floor(knot).astype(int)
        share = knot - low
        low %= count
        high = (low + 1) % count
    else:
        knot = np.clip(knot, 0.0, count - 1.0)
        low = np.minimum(knot.astype(int), count - 2)
        share, high = knot - low, low + 1
    basis = np.zeros((*values.shape, count))
    np.put_along_axis(basis, low[..., None], (1.0 - share)[..., None], axis=-1)
    held = np.take_along_axis(basis, high[..., None], axis=-1)
    np.put_along_axis(basis, high[..., None], held + share[..., None], axis=-1)
    return basis


def best_period(responses: Responses, shortest: float = 6.0, longest: float = 150.0) -> tuple[str, float, np.ndarray]:
    """Return quantity and period (s) of the sine over the clock that explains most, and honest gains [units]."""
    tries = list(product(PULSED, np.geomspace(shortest, longest, 60).tolist()))
    designs = []
    for what, period in tries:
        phase = 2 * np.pi * responses.coordinates["time"] / period
        designs.append(responses.design(what, np.stack([np.cos(phase), np.sin(phase)], axis=-1)))
    matrix, vector = (np.array([design[i] for design in designs]) for i in (0, 1))

    def best(skipped: np.ndarray) -> tuple[int, np.ndarray]:
        left, push = (x.sum(1) - x[:, skipped].sum(1) for x in (matrix, vector))
        ridge = 1e-6 * np.trace(left, axis1=1, axis2=2) + 1e-12
        c = np.linalg.solve(left + ridge[:, None, None] * np.eye(2), push[..., None])[..., 0]
        k = int((c * push).sum(-1).argmax())
        return k, c[k]

    gains = np.zeros(matrix.shape[1])
    for mine in _by_run(responses):
        k, c = best(mine)
        gains[mine] = responses.gains(np.broadcast_to(c, vector[k].shape), matrix[k], vector[k])[mine]
    return *tries[best(np.zeros(0, int))[0]], gains
