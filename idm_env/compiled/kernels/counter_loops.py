"""Hashes of counters in one loop, with the bits of torch's dozen operations."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.compiler import compiler

_U = np.uint64


@compiler()
def halves(keys, counters, golden, factors, high, low):
    """Fill ``high`` and ``low`` (steps, rows, pairs) with both halves of SplitMix64's hashes, from 0 to 2^32.

    The counter of pair j at step t of row r is ``counters[r] + t · pairs + j``.
    """
    steps, rows, pairs = high.shape
    kind = high.dtype.type
    for t in range(steps):
        for r in range(rows):
            key, first = keys[r], counters[r] + _U(t * pairs)
            for j in range(pairs):
                z = (first + _U(j)) * golden + key
                z = (z ^ (z >> _U(30))) * factors[0]
                z = (z ^ (z >> _U(27))) * factors[1]
                z = z ^ (z >> _U(31))
                high[t, r, j], low[t, r, j] = kind(z >> _U(32)), kind(z & _U(0xFFFFFFFF))
