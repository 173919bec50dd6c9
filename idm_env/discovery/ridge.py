"""Errors of windows told by a ridge, runs left out: on plain columns, or on random features, a smooth function."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from idm_env.discovery.records import Rows

FEATURES = 200
"""Random features of a smooth function, or an eighth of the windows where these are few."""
RIDGES = (1e-2, 1e-1, 1.0, 10.0, 100.0)
"""Weights of the ridge per window, of which other runs choose."""
FOLDS = 5
FURTHEST = 3.0
"""A coordinate counts at most so many standard deviations: beyond what was seen nothing is added."""


@dataclass(frozen=True, eq=False)
class Smooth:
    """Turns points [P, C] into coordinates in standard deviations, and cosines of random sums of them [P, C + F]."""

    middle: np.ndarray
    scale: np.ndarray
    turn: np.ndarray
    phase: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, seed: int, features: int = FEATURES) -> Smooth:
        """Return what turns points like these [W, C], with ``features`` or W / 8 cosines."""
        count, random = int(np.clip(len(points) // 8, 20, features)), np.random.default_rng(seed)
        turn = random.standard_normal((points.shape[1], count)) / np.sqrt(points.shape[1])
        return cls(points.mean(0), points.std(0) + 1e-9, turn, random.uniform(0.0, 2.0 * np.pi, count))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the columns [P, C + F] of points [P, C]."""
        scaled = np.clip((points - self.middle) / self.scale, -FURTHEST, FURTHEST)
        return np.hstack([scaled, np.cos(scaled @ self.turn + self.phase)])


@dataclass(frozen=True, eq=False)
class Ridge:
    """Errors [W] as ``predicted`` by other runs, and ``coefficients`` [1 + columns, folds] without each part of runs.

    Columns count in standard deviations ``scale`` from their ``middle``.
    """

    predicted: np.ndarray
    coefficients: np.ndarray
    middle: np.ndarray
    scale: np.ndarray

    @classmethod
    def fit(cls, rows: Rows, error: np.ndarray, columns: np.ndarray) -> Ridge:
        """Return the ridge that tells ``error`` [W] by ``columns`` [W, columns]."""
        middle, scale = columns.mean(0), columns.std(0) + 1e-9
        basis = np.hstack([np.ones((len(rows), 1)), (columns - middle) / scale])
        weight, unit = weights(rows, error), units(rows)
        fold = np.searchsorted(np.unique(unit), unit) % FOLDS
        predicted, coefficients = np.zeros(len(rows)), []
        for k in np.unique(fold):
            mine, inner = fold == k, (fold + k) % FOLDS % 2 == 0
            first, second = ~mine & inner, ~mine & ~inner
            loss = np.zeros(len(RIDGES))
            for one, other in ((first, second), (second, first)):
                prediction = basis[other] @ _ridges(basis[one], error[one], weight[one])
                loss += ((error[other, None] - prediction) ** 2 * weight[other, None]).sum(0)
            coefficients.append(_ridges(basis[~mine], error[~mine], weight[~mine])[:, loss.argmin()])
            predicted[mine] = basis[mine] @ coefficients[-1]
        return cls(predicted, np.stack(coefficients, axis=1), middle, scale)

    def at(self, columns: np.ndarray) -> np.ndarray:
        """Return what each part's absence predicts [P, folds] at ``columns`` [P, columns], or at means of such."""
        return self.coefficients[0] + (columns - self.middle) / self.scale @ self.coefficients[1:]


def _ridges(basis: np.ndarray, error: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return coefficients [features, ridges]."""
    value, vector = np.linalg.eigh((basis * weight[:, None]).T @ basis)
    push = vector.T @ (basis.T @ (weight * error))
    scale = value[:, None] + np.array(RIDGES) * weight.sum() + 1e-12  # of no windows nothing is predicted
    return vector @ (push[:, None] / scale)


def units(rows: Rows) -> np.ndarray:
    """Return what is left out together [W]: the run, or the driver where runs are few."""
    return rows.run if len(np.unique(rows.run)) >= FOLDS else rows.group


def weights(rows: Rows, error: np.ndarray) -> np.ndarray:
    """Return what a window counts [W]: one over its driver's mean square plus the usual one."""
    square = by_group(rows, error**2)
    usual = max(float(np.median(square)), 1e-9)
    return usual / (square + usual)


def by_group(rows: Rows, values: np.ndarray) -> np.ndarray:
    """Return values [W] as the mean over the driver's windows of every window [W]."""
    return (np.bincount(rows.group, values) / np.maximum(np.bincount(rows.group), 1))[rows.group]
