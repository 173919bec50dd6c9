"""What errors of prediction look like where nothing is missing: their covariance within and between windows.

The errors e_w of one window (speed every 0.5 s, gap at half and full horizon) are correlated, because drivers' own
noise adds up, and so are neighbouring windows. The model of noise is a vector autoregression,
``e_w = B e_{w−1} + ε, ε ~ N(0, Σ)``, estimated from the errors themselves, so white measurement noise, an
Ornstein–Uhlenbeck driver and anything between are one case. The null and every candidate are judged by the same one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from idm_env.discovery.records import Rows

SHRINK = 0.02
HEAVY = 3.0
"""A window whose whitened error exceeds this many times the usual is weighed down, for all models alike."""


@dataclass(frozen=True, eq=False)
class Noise:
    """Autoregression B [m, m], whiteners of first and later windows [m, m], and weights of rows [R]."""

    carry: np.ndarray
    first: np.ndarray
    later: np.ndarray
    weight: np.ndarray

    def whiten(self, errors: np.ndarray, joined: np.ndarray) -> np.ndarray:
        """Return whitened errors [..., R, m]: independent and of unit variance where nothing is missing."""
        before = np.zeros_like(errors)
        before[..., 1:, :] = errors[..., :-1, :]
        before *= joined[:, None]
        rest = errors - before @ self.carry.T
        white = np.where(joined[:, None], rest @ self.later.T, rest @ self.first.T)
        return white * np.sqrt(self.weight)[:, None]

    @property
    def wander(self) -> float:
        """By how much errors of the speed grow (m/s) from the first sample to half the horizon: drivers' own noise.

        Noise of sensors is the same at both.
        """
        spread = np.linalg.inv(self.first)
        variance = (spread**2).sum(1)[: len(spread) - 2]
        return float(np.sqrt(max(variance[len(variance) // 2 - 1] - variance[0], 0.0)))

    def unweighted(self, rows: int) -> Noise:
        """Return the same noise for so many other rows, of which none is weighed down."""
        return replace(self, weight=np.ones(rows))


def first_noise(rows: Rows) -> Noise:
    """Return independent errors of 0.15 m/s and 0.3 m, to begin with."""
    size = rows.valid.shape[1] + 2
    white = np.diag(1.0 / np.append(np.full(size - 2, 0.15), [0.2, 0.4]))
    return Noise(np.zeros((size, size)), white, white, np.ones(len(rows)))


def estimate(errors: np.ndarray, joined: np.ndarray, rounds: int = 3) -> Noise:
    """Return the noise of errors [R, m], by weighted least squares with heavy windows weighed down."""
    rows, size = errors.shape
    before = np.zeros_like(errors)
    before[1:] = errors[:-1]
    before *= joined[:, None]
    weight = np.ones(rows)
    for _ in range(rounds):
        w = weight * joined
        past = (before * w[:, None]).T @ before
        ridge = (SHRINK * np.trace(past) / size + 1e-12) * np.eye(size)
        carry = np.linalg.solve(past + ridge, (before * w[:, None]).T @ errors).T
        rest = errors - before @ carry.T
        later = _whitener(rest[joined], weight[joined], errors, weight)
        first = _whitener(errors, weight, errors, weight)
        white = np.where(joined[:, None], rest @ later.T, errors @ first.T)
        size_of = np.sqrt((white**2).mean(1) / max(float(np.median((white**2).mean(1))), 1e-12))
        weight = np.minimum(1.0, HEAVY / np.maximum(size_of, 1e-9))
    return Noise(carry, first, later, weight)


def _whitener(rest: np.ndarray, weight: np.ndarray, everything: np.ndarray, all_weight: np.ndarray) -> np.ndarray:
    if len(rest) < 3 * rest.shape[1]:
        rest, weight = everything, all_weight
    covariance = (rest * weight[:, None]).T @ rest / weight.sum()
    diagonal = np.diag(np.diag(covariance)) + 1e-10 * np.eye(len(covariance))
    factor = np.linalg.cholesky((1.0 - SHRINK) * covariance + SHRINK * diagonal)
    return np.asarray(solve_triangular(factor, np.eye(len(factor)), lower=True))
