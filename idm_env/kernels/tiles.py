"""Tiles of lanes and rings: which vehicles one holds, and how the rows of its workspace are filled.

Batch rows of ``size`` vehicles lie one behind the other in memory. Short rows share a tile, whole. A row longer than a
tile is cut, and each piece carries a halo: over some steps a vehicle feels nobody further ahead (and an adjoint nobody
further behind) than a step reaches, times the steps, so a piece computes that many neighbours once more and needs no
exchange while it stays in cache.

A workspace ``w`` is one flat array of rows that lie ``ROW`` apart. Printed phases run over rows at distances that the
compiler knows, so it need not test dozens of arrays for overlap, which it refuses to do and then emits scalar code.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
from numpy.typing import NDArray

from idm_env.scalar import library

Array = NDArray[Any]

_settings: Any = numba.config


@lru_cache(maxsize=1)
def _cache_of_loops() -> str:
    """Return the folder of compiled loops, named by the digest of all files here.

    Numba notices a change of the file that holds a function, not of one that it calls, and then runs machine code of
    another day. Its setting for the place of its cache is read when a function is decorated.
    """
    sources = sorted(Path(__file__).parent.glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
    place = Path(_settings.CACHE_DIR or library.folder()) / f"loops_{digest}"
    if not place.exists():
        library.announce()
    return str(place)


def compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a loop with these options of numba, in the cache of this version of it."""

    def compiled(function: Callable[..., Any]) -> Any:
        place, _settings.CACHE_DIR = _settings.CACHE_DIR, _cache_of_loops()
        try:
            return numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
        finally:
            _settings.CACHE_DIR = place

    return compiled


exact = compiler()
"""Compiler for whatever yields values: IEEE arithmetic as written, so values do not depend on the loop around them."""

TILE = 1024
"""Most vehicles per tile: some forty rows of 4 kB and the states of a time block stay in the second-level cache."""

NARROW = 256
"""Vehicles per tile where a block has few steps: then the rows in use should stay in the first-level cache."""

ROW = TILE + 16
"""Distance of two rows: not a power of two, or all rows would compete for the same cache sets."""


def width(size: int, steps: int) -> int:
    """Return how many vehicles a tile should hold."""
    return NARROW if steps <= 2 and (size <= NARROW or size > TILE) else TILE


def halo(steps: int, reach: int) -> int:
    """Return how many neighbours on either side a piece of a long row computes once more."""
    return reach * steps + 1 + (reach > 1)


def tiles(rows: int, size: int, wide: int, around: int) -> int:
    """Return how many tiles hold ``rows`` batch rows of ``size`` vehicles, with a halo of ``around`` where cut."""
    if size <= wide:
        return -(-rows // (wide // size))
    return rows * -(-size // (wide - 2 * around))


@exact
def place(tile, rows, size, wide, around, is_ring):
    """Return first batch row, first vehicle (negative: round the ring), vehicles, and of these: skipped, own."""
    if size <= wide:
        several = wide // size
        row = tile * several
        n = min(several, rows - row) * size
        return row, 0, n, 0, n
    span = wide - 2 * around
    pieces = -(-size // span)
    row, begin = tile // pieces, tile % pieces * span
    own = min(span, size - begin)
    head, tail = around, around
    if not is_ring:
        head, tail = min(head, begin), min(tail, size - begin - own)
    return row, begin - head, head + own + tail, head, own


# -- neighbours --------------------------------------------------------------------------------------------------


@exact
def look_ahead(w, to, source, n, size, is_ring):
    """Fill row ``to`` with each leader's value; whoever has no leader gets what he will not read."""
    w[to] = w[source]
    _copy(w[to + 1 :], w[source:], padded(n) - 1)
    if is_ring and n >= size:
        for j in range(0, n, size):
            w[to + j] = w[source + j + size - 1]


@exact
def look_back(w, to, source, n, size, is_ring):
    """Fill row ``to`` with each follower's value; whoever has no follower gets what he will not read."""
    _copy(w[to:], w[source + 1 :], padded(n))
    w[to + n - 1] = w[source + n - 1]
    if is_ring and n >= size:
        for j in range(0, n, size):
            w[to + j + size - 1] = w[source + j]


@exact
def _add(target, source, n):
    for j in range(n):
        target[j] += source[j]


@exact
def send_ahead(w, to, source, n, size, is_ring):
    """Add to row ``to`` what each follower sends to his leader: adjoint of looking ahead."""
    if not (is_ring and n >= size):
        _add(w[to:], w[source + 1 :], n - 1)
        return
    for j in range(0, n, size):
        _add(w[to + j :], w[source + j + 1 :], size - 1)
        w[to + j + size - 1] += w[source + j]


@exact
def send_back(w, to, source, n, size, is_ring):
    """Add to row ``to`` what each leader sends to his follower: adjoint of looking back."""
    if not (is_ring and n >= size):
        _add(w[to + 1 :], w[source:], n - 1)
        return
    for j in range(0, n, size):
        _add(w[to + j + 1 :], w[source + j :], size - 1)
        w[to + j] += w[source + j + size - 1]


# -- memory ------------------------------------------------------------------------------------------------------


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
def uniform(w, row, n):
    """Whether all values of a workspace row are the same."""
    values, others = w[row:], 0
    first = values[0]
    for j in range(n):
        others += values[j] != first
    return others == 0


@exact
def store(target, base, w, row, n):
    """Copy ``n`` values from index ``row`` of the workspace."""
    _copy(target[base:], w[row:], n)


@exact
def add(target, base, w, row, n):
    """Add ``n`` values from index ``row`` of the workspace."""
    _add(target[base:], w[row:], n)


@exact
def clear(w, row, n):
    """Zero ``n`` values of the workspace."""
    for j in range(n):
        w[row + j] = 0
