"""Curves in tables, for printed loops.

They stand in a file of their own: numba keeps with a compiled loop where each function that it calls was defined, and a
printed file is not there to be imported in a process that has printed another.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.extras import needed

with needed("a compiled loop"):
    from idm_env.compiled.kernels.compiler import compiler


@compiler()
def curve(p, number, tables, x):
    """Piecewise linear through evenly spaced knots (periodic where a period is given), or a trapezoid."""
    form, count = tables[number, 0], tables[number, 1]
    first = tables[number, 2]
    period = p[first + 3]
    if period > 0.0:
        x = x - period * np.floor(x / period)
    if form == 2:
        begin, end, edge, amount = p[first], p[first + 1], p[first + 2], p[first + 4]
        up = min(max((x - begin + edge) / (2.0 * edge), 0.0), 1.0)
        down = min(max((end + edge - x) / (2.0 * edge), 0.0), 1.0)
        return amount * min(up, down)
    position = (x - p[first]) * p[first + 1]
    if period > 0.0:
        position = position - count * np.floor(position / count)
        low = int(position)
        share = position - low
        return (1.0 - share) * p[first + 4 + low % count] + share * p[first + 4 + (low + 1) % count]
    position = min(max(position, 0.0), count - 1.0)
    low = min(int(position), count - 2)
    share = position - low
    return (1.0 - share) * p[first + 4 + low] + share * p[first + 5 + low]
