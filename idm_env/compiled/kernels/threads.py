"""Threads for kernels that release the interpreter lock: plain Python threads, no runtime of their own.

A compiled loop is called on halves (thirds, …) of its range. Handing a piece over and waiting for it costs some 20 µs,
what one thread needs for 6000 vehicle-steps; below ``GRAIN`` per thread one thread does it all.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch

GRAIN = 40_000
"""Vehicle-steps per thread below which there is no second thread: well above what handing over costs."""


@lru_cache(maxsize=4)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    # Keyed by process: threads do not survive a fork.
    return ThreadPoolExecutor(threads, thread_name_prefix="idm_env")


def count(work: int) -> int:
    """Return how many threads share ``work`` vehicle-steps; at most torch's number."""
    return max(1, min(torch.get_num_threads(), work // GRAIN))


def split(run: Callable[[int, int], None], total: int, align: int, threads: int) -> None:
    """Call ``run(begin, end)`` over 0 … total in ``threads`` pieces whose ends are multiples of ``align``."""
    pieces = min(threads, -(-total // align))
    if pieces <= 1:
        run(0, total)
        return
    tiles = -(-total // align)
    cuts = [min(total, align * (tiles * i // pieces)) for i in range(pieces + 1)]
    pool = _pool(os.getpid(), threads)
    others = [pool.submit(run, cuts[i], cuts[i + 1]) for i in range(1, pieces)]
    run(cuts[0], cuts[1])
    for other in others:
        other.result()
