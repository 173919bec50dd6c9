"""Tiles of lanes and rings: which vehicles one holds, the rows of its workspace, and how they are filled.

Batch rows of ``size`` vehicles lie one behind the other in memory. Short rows share a tile, whole. A row longer than a
tile is cut, and each piece carries a halo: over ``steps`` steps a vehicle feels nobody further ahead than ``steps``
vehicles (and an adjoint nobody further behind), so a piece computes that many neighbours once more and needs no
exchange while it stays in cache.

A workspace ``w`` is one flat array; the names below are first indices of its rows.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from idm_env.kernels.equations import exact

TILE = 1024
"""Most vehicles per tile: some forty rows of 4 kB and the states of a time block stay in the second-level cache."""

NARROW = 256
"""Vehicles per tile where a block has few steps: then the rows in use should stay in the first-level cache."""

ROW = TILE + 16
"""Distance of two rows: not a power of two, or all rows would compete for the same cache sets."""

GAP, SPEED, POSITION, ACCEL = (ROW * row for row in range(4))
LED, LEAD_SPEED, MOVED, LEAD_MOVED, RAW = (ROW * row for row in range(4, 9))
P_A, P_B, P_TIME, P_MIN, P_V0, P_MAX, P_SIGMA = (ROW * row for row in range(9, 16))
NORMALS, COMMAND, ACTIVE, PLACE, PACE, PULL, PLACED = (ROW * row for row in range(16, 23))
ON_GAP, ON_SPEED, ON_POSITION, ON_ACCEL, ON_MOVED, SENT, BEHIND = (ROW * row for row in range(23, 30))
G_A, G_B, G_TIME, G_MIN, G_V0, G_MAX, G_SIGMA = (ROW * row for row in range(30, 37))
G_COMMAND, G_NORMALS, G_PLACE, G_PACE, G_PULL = (ROW * row for row in range(37, 42))
P_BRAKE, P_FREE = ROW * 42, ROW * 43
ROWS = 44


def width(size: int, steps: int) -> int:
    """Return how many vehicles a tile should hold."""
    return NARROW if steps <= 2 and (size <= NARROW or size > TILE) else TILE


def tiles(rows: int, size: int, steps: int, wide: int) -> int:
    """Return how many tiles hold ``rows`` batch rows of ``size`` vehicles over a block of ``steps`` steps."""
    if size <= wide:
        return -(-rows // (wide // size))
    return rows * -(-size // (wide - 2 * (steps + 1)))


@exact
def place(tile, rows, size, steps, wide, is_ring):
    """Return first batch row, first vehicle (negative: round the ring), vehicles, and of these: skipped, own."""
    if size <= wide:
        several = wide // size
        row = tile * several
        n = min(several, rows - row) * size
        return row, 0, n, 0, n
    halo = steps + 1
    span = wide - 2 * halo
    pieces = -(-size // span)
    row, begin = tile // pieces, tile % pieces * span
    own = min(span, size - begin)
    head, tail = halo, halo
    if not is_ring:
        head, tail = min(head, begin), min(tail, size - begin - own)
    return row, begin - head, head + own + tail, head, own


@exact
def padded(n):
    """Return ``n`` rounded up to whole vectors: loops over a workspace then leave no scalar remainder.

    What they compute beyond ``n`` is never read.
    """
    return (n + 15) // 16 * 16


@exact
def _copy(target, source, n):
    # Slices that begin at 0: an index of unknown sign would be wrapped round at run time, and nothing vectorises.
    for j in range(n):
        target[j] = source[j]


@exact
def _fill(target, value, n):
    for j in range(n):
        target[j] = value


@exact
def load(w, to, source, t, stride, row, first, n, size):
    """Fill a workspace row from a batch whose strides by step, row and vehicle are ``stride``; ``t`` is the step."""
    by_row, by_vehicle = stride[1], stride[2]
    base = t * stride[0] + row * by_row
    if by_row == 0 and by_vehicle == 0:
        _fill(w[to:], source[base], n)
    elif n > size or (first == 0 and n == size):
        if by_row == size and by_vehicle == 1:
            _copy(w[to:], source[base:], n)
            return
        for left in range(0, n, size):
            if by_vehicle == 0:
                _fill(w[to + left :], source[base], size)
            else:
                _copy(w[to + left :], source[base:], size)
            base += by_row
    elif by_vehicle == 0:
        _fill(w[to:], source[base], n)
    else:
        # A piece of one row, which may reach round a ring at either end.
        low, high = max(0, -first), min(n, size - first)
        if low > 0:
            _copy(w[to:], source[base + size + first :], low)
        _copy(w[to + low :], source[base + first + low :], high - low)
        if high < n:
            _copy(w[to + high :], source[base + first + high - size :], n - high)


@exact
def repeats(stride, n, size):
    """Whether every tile holds the same values: whole rows, and all rows alike."""
    return stride[1] == 0 and (n >= size or stride[2] == 0)


@exact
def store(target, base, w, row, n):
    """Copy ``n`` values from index ``row`` of the workspace."""
    _copy(target[base:], w[row:], n)


@exact
def add(target, base, w, row, n):
    """Add ``n`` values from index ``row`` of the workspace."""
    left, right = target[base:], w[row:]
    for j in range(n):
        left[j] += right[j]


@exact
def clear(w, row, n):
    """Zero ``n`` values of the workspace."""
    for j in range(n):
        w[row + j] = 0
