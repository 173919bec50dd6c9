"""Large arrays that are used again: faulting in fresh pages costs more than the mathematics that fills them.

``take`` hands out an array; once nobody holds it or a view of it, the next ``take`` of that size gets the same memory.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np

from idm_env import compat
from idm_env.compiled.kernels.memory import LINE
from idm_env.compiled.kernels.tiles import Array

SMALLEST = 1 << 17
"""Bytes below which an allocator reuses memory by itself: larger arrays may go back to the system when freed."""

MOST = 24
"""Arrays that are kept for another use."""

_lock = threading.Lock()
_kept: list[Array] = []


def _free(size: int, arrays: list[Array], unheld: int) -> Array | None:
    for base in arrays:
        if base.nbytes == size and compat.references(base) <= unheld:
            return base
    return None


def _references_of_an_unheld_array() -> int:
    """Count as ``_free`` does: how many references its own bookkeeping makes differs between interpreters."""
    array = [np.empty(1, np.uint8)]
    return next(count for count in range(1, 10) if _free(1, array, count) is not None)


_UNHELD = _references_of_an_unheld_array()


def take(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    """Return an uninitialised array that begins on a cache line, where possible in memory used before."""
    size = math.prod(shape) * dtype.itemsize
    if size < SMALLEST:
        return np.empty(shape, dtype)
    with _lock:
        base = _free(size + LINE, _kept, _UNHELD)
        if base is None:
            base = np.empty(size + LINE, np.uint8)
            _kept.append(base)
            del _kept[:-MOST]
        begin = -base.ctypes.data % LINE
        return base[begin : begin + size].view(dtype).reshape(shape)
