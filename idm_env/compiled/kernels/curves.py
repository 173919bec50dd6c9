"""Look-ups of printed loops, for one lane after the other: curves in tables, the past, and columns of records.

They stand in a file of their own: numba keeps with a compiled loop where each function that it calls was defined, and a
printed file is not there to be imported in a process that has printed another.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.extras import needed

with needed("a compiled loop"):
    from idm_env.compiled.kernels.compiler import compiler


@compiler(forceinline=True)
def recall(h, now, steps, signal, lane):
    """Return a signal so many steps ago, or the oldest that is kept."""
    return h[np.uint64(max(now - int(steps), 0)), np.uint64(signal), np.uint64(lane)]


@compiler(forceinline=True)
def column(signals, sample, number):
    """Return a number of a record; numba asks of no index without a sign whether it counts from the end."""
    return signals[np.uint64(sample), np.uint64(number)]


@compiler()
def curve(phi, driver, number, tables, x):
    """Piecewise linear through evenly spaced knots (periodic where a period is given), or a trapezoid."""
    form, count, place = tables[number, 0], tables[number, 1], np.uint64(tables[number, 2])
    row = np.uint64(driver)
    first, by, period = phi[row, place], phi[row, place + np.uint64(1)], phi[row, place + np.uint64(3)]
    knots = place + np.uint64(4)
    if period > 0.0:
        x = x - period * np.floor(x / period)
    if form == 2:
        edge = phi[row, place + np.uint64(2)]
        up = min(max((x - first + edge) / (2.0 * edge), 0.0), 1.0)
        down = min(max((by + edge - x) / (2.0 * edge), 0.0), 1.0)
        return phi[row, knots] * min(up, down)
    position = (x - first) * by
    if period > 0.0:
        position = position - count * np.floor(position / count)
        low = int(position)
        one, other = low % count, (low + 1) % count
    else:
        position = min(max(position, 0.0), count - 1.0)
        low = min(int(position), count - 2)
        one, other = low, low + 1
    share = position - low
    return (1.0 - share) * phi[row, knots + np.uint64(one)] + share * phi[row, knots + np.uint64(other)]
