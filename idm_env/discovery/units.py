"""What a test counts: whole runs where there are many, else followers within runs, whose signs depend on each other.

Model of their dependence: with probability ``sqrt(rho)`` the gain of a follower takes the sign that its run has by
chance, else one of its own, so that signs of one run correlate by ``rho`` and those of different runs not at all. Whole
runs are the case ``rho = 1``. Where followers are counted ``rho`` is at least ``LEAST_RHO``, and what the gains of all
candidates say where that is more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from idm_env.discovery.records import Records

MANY_RUNS = 8
"""From so many runs on a run counts as one in free simulation, and `none` may be said; the smallest p is then 2^−8."""
ENOUGH_RUNS = 5
"""From so many runs on a run counts as one in windows."""
LEAST_RHO = 0.25
FLIPS = 4096


@dataclass(frozen=True, eq=False)
class Units:
    """The unit of every record [records], and the run of every unit [units]."""

    of_record: np.ndarray
    run: np.ndarray

    def __len__(self) -> int:
        return len(self.run)

    def others(self, values: np.ndarray) -> np.ndarray:
        """Return, for every unit, the sum of values [units, ...] over the units of all other runs."""
        total = np.zeros((int(self.run.max(initial=-1)) + 1, *values.shape[1:]))
        np.add.at(total, self.run, values)
        return total.sum(0) - total[self.run]

    def sums(self, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the sums over units of values [R, ...], row i of record ``rows[i]``."""
        total = np.zeros((len(self), *values.shape[1:]))
        np.add.at(total, self.of_record[rows], values)
        return total


def units(records: Records, many: int = ENOUGH_RUNS) -> Units:
    """Return what is counted in a test on these records: runs, or followers (run, vehicle) of fewer than ``many``."""
    if len(np.unique(records.run)) >= many:
        return Units(records.run, np.arange(len(records.runs)))
    keys = [(e.run_id, e.vehicle_id) for e in records.episodes]
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    of_record = np.array([number[key] for key in keys])
    run = np.zeros(len(number), int)
    run[of_record] = records.run
    return Units(of_record, run)


def signs(run: np.ndarray, rho: float, seed: int) -> np.ndarray:
    """Return signs of chance [flips, units] that correlate by ``rho`` within runs; the first row is all ones.

    All of them where every unit is a run and runs are few, else a sample.
    """
    _, of_run = np.unique(run, return_inverse=True)
    runs = int(of_run.max()) + 1
    if len(run) == runs and runs <= 12:
        return 1.0 - 2.0 * ((np.arange(2**runs)[:, None] >> np.arange(runs)) & 1)
    random = np.random.default_rng(seed)
    own = random.choice([-1.0, 1.0], (FLIPS - 1, len(run)))
    if len(run) > runs:
        common = random.choice([-1.0, 1.0], (FLIPS - 1, runs))[:, of_run]
        own = np.where(random.random(own.shape) < np.sqrt(rho), common, own)
    return np.concatenate([np.ones((1, len(run))), own])


def rho(roots: np.ndarray, run: np.ndarray) -> float:
    """Return the correlation within runs that roots of gains of candidates [K, units] speak for, LEAST_RHO to 1.

    From the candidates' intraclass correlations (one-way analysis of variance): what all units of a candidate have in
    common, its gain or its loss, is no dependence. Their upper quartile, because of few runs most come out too low, and
    a quarter more, because signs carry less of a sum's variance than values do (``tests/discovery/test_units.py``).
    """
    _, of_run, sizes = np.unique(run, return_inverse=True, return_counts=True)
    runs, count = len(sizes), len(run)
    if runs in (1, count):
        return 1.0
    totals = np.zeros((len(roots), runs))
    np.add.at(totals.T, of_run, roots.T)
    means = totals / sizes
    within = ((roots - means[:, of_run]) ** 2).sum(1) / (count - runs)
    between = ((means - roots.mean(1, keepdims=True)) ** 2 * sizes).sum(1) / (runs - 1)
    usual = (count - (sizes**2).sum() / count) / (runs - 1)
    each = (between - within) / np.maximum(between + (usual - 1.0) * within, 1e-12)
    return float(np.clip(1.25 * np.quantile(each, 0.75), LEAST_RHO, 1.0))


def smallest_p(run: np.ndarray) -> float:
    """Return the smallest p-value that units of these runs [units] can have."""
    sizes = np.unique(run, return_counts=True)[1]
    if (sizes == 1).all():
        return float(2.0 ** -len(sizes))
    same, other = 0.5 * (1.0 + np.sqrt(LEAST_RHO)), 0.5 * (1.0 - np.sqrt(LEAST_RHO))
    return float(np.prod(0.5 * (same**sizes + other**sizes)))
