"""The cross-entropy method (Rubinstein 1999), for rules of few numbers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np


def cross_entropy(
    costs: Callable[[np.ndarray, int], np.ndarray], mean: Any, width: Any, *, rows: int, keep: int, floor: Any,
    inertia: float = 0.0, ends: Any = (-math.inf, math.inf), with_mean: bool = False, seconds: float = math.inf,
    generations: float = math.inf,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """Return the mean of k numbers with least costs, the ``keep`` best of the last generation, and the CPU time (s).

    A generation draws ``rows`` candidates, ``mean + width ε``, cut off at ``ends``; the first is the mean itself
    ``with_mean``. With the mean m and deviation s of the best, and ``inertia`` i::

        mean ← i mean + (1 − i) m,   width ← i width + (1 − i) (s + floor)

    ``costs(candidates (rows, k), generation)`` has shape ``(rows,)``. It ends by CPU ``seconds`` or ``generations``.
    """
    random, start, turn, best = np.random.default_rng(0), time.process_time(), 0, np.atleast_2d(mean)
    while turn < generations and time.process_time() - start < seconds:
        candidates = (mean + width * random.standard_normal((rows, len(mean)))).clip(*ends)
        candidates[: int(with_mean)] = mean
        best = candidates[costs(candidates, turn).argsort()[:keep]]
        mean = inertia * mean + (1.0 - inertia) * best.mean(0)
        width = inertia * width + (1.0 - inertia) * (best.std(0) + floor)
        turn += 1
    return mean, best, time.process_time() - start
